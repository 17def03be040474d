"""The texts of the QGIS plugin and of QGIS projects that people read, taken from their source."""

import ast
import re
from pathlib import Path
from xml.etree.ElementTree import parse

from gis_radar.products.heatmap import style

FOLDER = Path(__file__).parents[1] / "qgis_plugin" / "gis_radar_plugin"
PACKAGE = Path(__file__).parents[1] / "gis_radar"
CLASS_TEXTS = ("TITLE", "SUBTITLE", "HELP")
CONSTANTS = (
    "SITE", "TRAFFIC", "RESULTS", "SET_UP", "WINDS", "_GONE",
)  # fmt: skip
ERRORS = ("WorkerError", "NoWorkerError")


def texts():
    """Return every text that goes through `tr`, in the order of the source."""
    found = {}
    for path in sorted(FOLDER.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for part in _said(node):
                if isinstance(part, ast.Constant) and isinstance(part.value, str) and part.value:
                    found.setdefault(part.value, path.name)
    return found


def _said(node):
    """Yield the texts in a node: of `tr`, of `about=`, of a class, of a constant."""
    if isinstance(node, ast.Call):
        name = getattr(node.func, "id", getattr(node.func, "attr", ""))
        if name in ("tr", "stage"):
            yield from node.args[:1]
        if name in ERRORS:
            yield from (each for each in node.args[:1] if has_words(each))
        yield from (word.value for word in node.keywords if word.arg in ("about", "title"))
        if name in PARAMETERS or getattr(node.func, "id", "") == "replace":
            yield from _declared(node)
    elif isinstance(node, ast.Assign):
        targets = [name for target in node.targets for name in _names(target)]
        if set(targets) & {*CLASS_TEXTS, *CONSTANTS}:
            yield from getattr(node.value, "elts", [node.value])
        if {"SENSOR_TABLES", "LANE_TABLES"} & set(targets):
            yield from node.value.keys
    elif isinstance(node, ast.For) and isinstance(node.iter, ast.Tuple):
        yield from (node.iter.elts if _is_legend(node) else ())


def has_words(node):
    """Tell whether a text has words beside its holes."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    texts = [part.value for part in parts if isinstance(part, ast.Constant)]
    return any(re.search("[A-Za-z]", re.sub(r"\{\w*\}", "", text)) for text in texts)


def errors_with_values_inside():
    """Return errors whose text is put together where they are raised: no catalogue has them."""
    return [
        f"{path.name}:{node.lineno}"
        for path in sorted(FOLDER.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ERRORS
        for each in node.args[:1] if isinstance(each, ast.JoinedStr) and has_words(each)
    ]  # fmt: skip


PARAMETERS = {
    node.name
    for node in ast.parse((FOLDER / "parameters.py").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ClassDef)
} | {"Roads", "Poses"}  # fmt: skip


def _declared(node):
    """Yield title, help, labels and kinds of files of a parameter that is declared."""
    yield from node.args[1:3] if node.args[0:1] and isinstance(node.args[0], ast.Constant) else ()
    for word in node.keywords:
        if word.arg == "labels":
            yield from word.value.elts
        if word.arg == "default" and " " in str(getattr(word.value, "value", "")):
            yield word.value
        if word.arg == "kinds" and isinstance(word.value, ast.Constant):
            kinds = [kind.partition(" (")[0] for kind in word.value.value.split(";;")]
            yield from (ast.Constant(kind) for kind in kinds if has_words(ast.Constant(kind)))


def _names(target):
    if isinstance(target, ast.Tuple):
        return [name for part in target.elts for name in _names(part)]
    return [target.id] if isinstance(target, ast.Name) else []


def _is_legend(node):
    """Tell the loop over the words of class labels in loading.py."""
    return isinstance(node.target, ast.Name) and node.target.id == "words"


def project_texts():
    """Return names of layers, of groups and of the layout, and labels of classes, of a project."""
    found = {"Source", "Made with gis_radar"}
    for path in (
        PACKAGE / "products" / "qgis" / "project.qgs",
        PACKAGE / "products" / "qgis" / "sheet.qpt",
    ):
        root = parse(path).getroot()  # noqa: S314 - our own files
        named = [root, *root.iter("layer-tree-layer"), *root.iter("layer-tree-group")]
        found |= {element.get("name", "") for element in named}
        found |= {element.text for element in root.iter("layername")}
        found |= {
            each.get("labelText") for each in root.iter("LayoutItem")
            if each.get("id", "").startswith("meaning")
        }  # fmt: skip
    for words in style.MAP_WORDS.values():
        found |= {words.title, words.subtitle}
    for path in PACKAGE.glob("*/*.qml"):
        root = parse(path).getroot()  # noqa: S314 - our own files
        classes = (*root.iter("category"), *root.iter("rule"), *root.iter("range"))
        found |= {element.get("label", "") for element in classes}
    return sorted(found - {""})
