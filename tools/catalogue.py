"""Update the German catalogue: add the source's new texts, delete those that are gone.

    python tools/catalogue.py

Then fill in each empty msgstr of the file that it names.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from io import BytesIO
from pathlib import Path

from babel.messages.catalog import Catalog
from babel.messages.pofile import read_po, write_po

from gis_radar.cli.usage import CLICK_TEXTS
from gis_radar.dataset.files.tables import HOUR_TABLES
from gis_radar.poses import COMPONENTS
from gis_radar.products.report.basis import HIT_TOTALS, OCCUPIED_TOTALS

ROOT = Path(__file__).parents[1]
PACKAGE, PLUGIN = ROOT / "gis_radar", ROOT / "qgis_plugin" / "gis_radar_plugin"
GERMAN = PACKAGE / "base" / "languages" / "de" / "LC_MESSAGES" / "gis_radar.po"
HEADER = """# German of gis_radar and its QGIS plugin.
msgid ""
msgstr ""
"Language: de\\n"
"Plural-Forms: nplurals=2; plural=(n != 1);\\n"
"MIME-Version: 1.0\\n"
"Content-Type: text/plain; charset=utf-8\\n"
"Content-Transfer-Encoding: 8bit\\n"

"""
# Arguments that are texts for users, by the name of the function; keywords of errors that are.
PLACES = {
    "tr": (0,), "Text": (0,), "log": (0,), "warn": (0,), "remark": (0,), "progress": (0,),
    "plural": (1, 2),
}  # fmt: skip
KEYWORDS = {"hint", "message", "expected"}
_HOLE, _WORDS = re.compile(r"\{[^}]*\}"), re.compile("[A-Za-z]{2}")
_WORDS_OF_SEVERAL = re.compile(r"[\w{].* .*[a-z]{2}.*\S")
NO_TEXTS = {"DEFINITIONS", "KEYS", "_NO_MEMORY_TEXTS", "_OURS"}  # names whose texts no user sees
# Functions whose dictionaries have names of figures that commands and the plugin show.
FIGURES = {"figures", "split_map", "totals_of", "_summary", "range_scale_figures", "view"}
SERVERS = PACKAGE / "live"  # whose log is English
OTHERS = ("*.html", "*.jinja", "*.qgs", "*.qpt", "*.qml")  # files with texts, beside modules


@cache
def trees(folder: Path) -> dict[Path, list[ast.AST]]:
    """Return the syntax nodes of each module in a folder."""
    return {
        path: list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        for path in sorted(folder.rglob("*.py"))
    }


def _name(node: ast.AST) -> str:
    return str(getattr(node, "id", "") or getattr(node, "attr", ""))


@cache
def errors() -> frozenset[str]:
    """Return the names of the package's errors, which are raised with a template and values."""
    classes = [n for nodes in trees(PACKAGE).values() for n in nodes if isinstance(n, ast.ClassDef)]
    names = {"GisRadarError"}
    while more := {
        each.name
        for each in classes
        if each.name not in names and {_name(base) for base in each.bases} & names
    }:
        names |= more
    return frozenset(names)


def _texts(node: ast.AST) -> Iterator[str]:
    """Yield the texts that an expression may have; an f-string, which is no template, as source."""
    if isinstance(node, ast.IfExp):
        yield from _texts(node.body)
        yield from _texts(node.orelse)
    elif isinstance(node, ast.JoinedStr):
        yield ast.unparse(node)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def told() -> Iterator[tuple[str, str]]:
    """Yield the texts given to errors, messages and `tr`, each with its file."""
    for path, nodes in trees(PACKAGE).items():
        where = str(path.relative_to(ROOT))
        for node in nodes:
            if not isinstance(node, ast.Call) or SERVERS in path.parents:
                continue
            called = _name(node.func)
            of_logging = called == "log" and _name(getattr(node.func, "value", node)) in {"", "np"}
            places = (0,) if called in errors() else () if of_logging else PLACES.get(called, ())
            given = [node.args[place] for place in places if place < len(node.args)]
            if places or called in {"Unfit", "Meaning"}:
                given += [each.value for each in node.keywords if each.arg in KEYWORDS]
            yield from ((where, text) for each in given for text in _texts(each))


def _names(*nodes: ast.AST) -> set[str]:
    return {_name(each) for node in nodes for each in ast.walk(node)} - {""}


def _flows(nodes: list[ast.AST]) -> Iterator[tuple[set[str], ast.AST]]:
    """Yield names with the expression they get: by assignments, loops, calls in the module."""
    functions = {each.name: each.args for each in nodes if isinstance(each, ast.FunctionDef)}
    for node in nodes:
        if isinstance(node, ast.For | ast.comprehension):
            yield _names(node.target), node.iter
        elif isinstance(node, ast.Assign):
            yield _names(*node.targets), node.value
        elif isinstance(node, ast.NamedExpr | ast.AnnAssign) and node.value:
            yield _names(node.target), node.value
        elif isinstance(node, ast.Call) and (takes := functions.get(_name(node.func))):
            names = [each.arg for each in takes.args if each.arg not in {"self", "cls"}]
            rest = {takes.vararg.arg} if takes.vararg else set()
            for place, value in enumerate(node.args):
                yield set(names[place : place + 1]) or rest, value
            yield from (({each.arg}, each.value) for each in node.keywords if each.arg)


def carried() -> Iterator[tuple[str, str]]:
    """Yield texts of several words that reach a user by a name, each with its file."""
    for path, nodes in trees(PACKAGE).items():
        names: set[str] = set()
        for node in nodes:
            if isinstance(node, ast.Call) and SERVERS not in path.parents:
                for place in PLACES.get(_name(node.func), ()):
                    names |= _names(*node.args[place : place + 1])
        flows = [(to, _names(value), value) for to, value in _flows(nodes) if not to & NO_TEXTS]
        while more := {name for to, given, _ in flows if to & names for name in given} - names:
            names |= more
        for part in (part for to, _, value in flows if to & names for part in ast.walk(value)):
            if isinstance(part, ast.Constant):
                texts = filter(_WORDS_OF_SEVERAL.fullmatch, _texts(part))
                yield from ((str(path.relative_to(ROOT)), text) for text in texts)


def figures() -> Iterator[tuple[str, str]]:
    """Yield the names of figures as commands and the plugin show them, each with its file."""
    yield from (("gis_radar/dataset/files/tables.py", table.name) for table in HOUR_TABLES)
    others = (*OCCUPIED_TOTALS, *HIT_TOTALS, *COMPONENTS)
    yield from (("", name.replace("_", " ")) for name in others)
    for path, nodes in trees(PACKAGE).items():
        if SERVERS in path.parents:
            continue
        made = [n for n in nodes if isinstance(n, ast.FunctionDef) and n.name in FIGURES]
        given = [n.value for n in nodes if isinstance(n, ast.keyword) and n.arg == "summary"]
        for node in (each for top in (*made, *given) for each in ast.walk(top)):
            keys = node.keys if isinstance(node, ast.Dict) else []
            if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
                keys = [node.slice]
            names = (text for key in keys if key is not None for text in _texts(key))
            yield from ((str(path.relative_to(ROOT)), name.replace("_", " ")) for name in names)


@cache
def asked() -> dict[str, str]:
    """Return the texts that need a translation, with their files; those without words do not."""
    texts = (*carried(), *told(), *figures())
    found = {text: where for where, text in texts if _WORDS.search(_HOLE.sub("", text))}
    for place in (path for kind in ("*.html", "*.jinja") for path in PACKAGE.rglob(kind)):
        for text in re.findall(r'\btr\("([^"]+)"', place.read_text(encoding="utf-8")):
            found[text] = str(place.relative_to(ROOT))
    return found | dict.fromkeys(definitions(), "definitions.toml") | dict.fromkeys(CLICK_TEXTS, "")


def definitions() -> set[str]:
    """Return the words that the report explains, and their explanations."""
    text = (PACKAGE / "products" / "report" / "definitions.toml").read_text(encoding="utf-8")
    return {each for group in tomllib.loads(text).values() for each in (*group, *group.values())}


def shown() -> tuple[set[str], str]:
    """Return all texts in modules of package and plugin, and the package's other files as one."""
    constants = {
        text
        for folder in (PACKAGE, PLUGIN)
        for nodes in trees(folder).values()
        for node in nodes
        if isinstance(node, ast.Constant)
        for text in _texts(node)
    }
    files = (path for kind in OTHERS for path in PACKAGE.rglob(kind))
    kinds = {kind.partition(" (")[0] for text in constants for kind in text.split(";;")}
    return constants | kinds | definitions(), "".join(map(_unescaped, files))


def _unescaped(path: Path) -> str:
    return path.read_text(encoding="utf-8").replace("&lt;", "<").replace("&gt;", ">")


def unused(texts: set[str]) -> list[str]:
    """Return the catalogue's texts that are not in the source; names of figures have `_` there."""
    constants, others = shown()
    return sorted(
        text
        for text in texts - constants
        if text not in others and text.replace(" ", "_") not in constants
    )


def plurals() -> dict[str, str]:
    """Return the plural texts by the singular ones."""
    pairs = [
        [text for each in node.args[1:] for text in _texts(each)]
        for nodes in trees(PACKAGE).values()
        for node in nodes
        if isinstance(node, ast.Call) and _name(node.func) == "plural"
    ]
    return {pair[0]: pair[1] for pair in pairs if len(pair) == 2}


def write(translations: dict[str, str]) -> None:
    """Write the catalogue, sorted, so that changes of two people rarely conflict."""
    catalogue, many = Catalog(), plurals()
    for text, translation in translations.items():
        if text in many:
            pair = (text, many[text])
            catalogue.add(pair, (translation, translations[many[text]]))
        elif text not in many.values():
            catalogue.add(text, translation)
    file = BytesIO()
    write_po(file, catalogue, no_location=True, sort_output=True, width=0, omit_header=True)
    GERMAN.write_text(HEADER + file.getvalue().decode(), encoding="utf-8")


def read() -> dict[str, str]:
    """Return the translations of the catalogue by text; singular and plural are two texts."""
    with GERMAN.open("rb") as file:
        messages = [each for each in read_po(file) if each.id]
    pairs = ((each.id, each.string) for each in messages if not each.pluralizable)
    found = {str(text): str(translation) for text, translation in pairs}
    for each in messages:
        if each.pluralizable:
            found.update(zip(each.id, each.string or (), strict=True))
    return found


def main() -> None:
    """Write the catalogue anew, and print the texts that lack a translation."""
    known = read()
    old = unused(set(known))
    kept = {text: each for text, each in known.items() if text not in old}
    write(dict.fromkeys(asked(), "") | kept)
    missing = [f"{where}: {text}" for text, where in asked().items() if not kept.get(text)]
    print("\n".join(sorted(missing)))
    print(f"{len(old)} are gone; see {GERMAN}")


if __name__ == "__main__":
    main()
