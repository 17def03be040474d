"""One word, one meaning: no public function or class of the package is defined in two rooms."""

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "gis_radar"
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


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
