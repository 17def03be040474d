"""One word, one meaning: no public name of the package stands for two things."""

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "gis_radar"
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
IN_EACH_READER = {"FORMAT"}  # by which recordings/formats.py finds it


def public_names(package):
    """Map each public function and class to the rooms where it is defined."""
    rooms = defaultdict(set)
    for path in sorted(package.rglob("*.py")):
        room = path.relative_to(package).with_suffix("").parts[0]
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, DEFINITIONS) or node.name.startswith("_"):
                continue
            if room != "cli" or not is_command(node):
                rooms[node.name].add(room)
    return rooms


def is_command(node):
    """Tell whether a function is a command of click: it bears the verb of the API."""
    used = (d.func if isinstance(d, ast.Call) else d for d in node.decorator_list)
    return any(ast.unparse(each).rpartition(".")[2] in {"command", "group"} for each in used)


def test_no_public_name_in_two_rooms():
    twice = {name: sorted(rooms) for name, rooms in public_names(PACKAGE).items() if len(rooms) > 1}
    assert not twice


def constants(text):
    """Yield the constants of a module, each with its value, or with the code that computes it."""
    for node in ast.parse(text).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets if getattr(node, "value", None) else ():
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            values = parts(node.value, len(names)) if len(names) > 1 else [value_of(node.value)]
            pairs = zip(names, values, strict=True)
            yield from ((each.id, value) for each, value in pairs if isinstance(each, ast.Name))


def parts(node, count):
    """Return the values that an assignment to several names unpacks."""
    if isinstance(node, ast.Tuple):
        return [value_of(each) for each in node.elts]
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "range":
        return list(range(*map(value_of, node.args)))
    return [f"{ast.unparse(node)}[{k}]" for k in range(count)]


def value_of(node):
    try:
        return ast.literal_eval(node)
    except ValueError:
        return ast.unparse(node)


def test_no_public_constant_with_two_values():
    found = defaultdict(dict)
    for path in sorted(PACKAGE.rglob("*.py")):
        for name, value in constants(path.read_text(encoding="utf-8")):
            if name.isupper() and not name.startswith("_") and name not in IN_EACH_READER:
                found[name][str(path.relative_to(PACKAGE))] = value
    assert len(found) > 500
    values = {name: list(of_file.values()) for name, of_file in found.items()}
    assert {n: found[n] for n, known in values.items() if any(v != known[0] for v in known)} == {}


def test_a_constant_of_one_module_begins_with_an_underscore():
    words = defaultdict(set)
    for folder in ("gis_radar", "tests", "bench", "simulation", "tools", "qgis_plugin", "docs"):
        for path in (path for end in ("py", "pyi") for path in (ROOT / folder).rglob(f"*.{end}")):
            for word in set(re.findall(r"\w+", path.read_text(encoding="utf-8"))):
                words[word].add(path)
    found = [
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for name, _ in constants(path.read_text(encoding="utf-8"))
        if name.isupper() and not name.startswith("_") and words[name] == {path}
    ]
    assert found == []


def test_constants_have_the_values_of_their_code():
    text = "A, B = range(2, 4)\nC: int = 1 << 2\nD, E = 0.5, A\nF, G = PAIR\nH = (1, 2)\nI: int"
    assert dict(constants(text)) == {
        "A": 2, "B": 3, "C": "1 << 2", "D": 0.5, "E": "A", "F": "PAIR[0]", "G": "PAIR[1]",
        "H": (1, 2),
    }  # fmt: skip
