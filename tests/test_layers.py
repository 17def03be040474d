"""A module of gis_radar imports only from rows of the table below that stand above its own."""

import ast
import re
from collections import defaultdict
from contextlib import suppress
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "gis_radar"

# "gis_radar" is the package's own front,
# `__init__.py`: what `import gis_radar` offers.
ROWS = """
    base
    sample
    poses
    hdmap
    recordings
    scans
    calibration
    measures
    tracking
    dataset
    products
    site
    live
    city
    demo
    gis_radar
    cli
    __main__
"""
ORDER = ROWS.split()


def module_name(path, package):
    """Give the dotted name of a file below the package; the front is called like the package."""
    parts = path.relative_to(package).with_suffix("").parts
    if parts[-1] == "__init__":
        parts = parts[:-1]
    return ".".join(parts) or package.name


@cache
def imports_in(text):
    """Return the import statements of a file, by its text: each file is asked several times."""
    kinds = ast.Import | ast.ImportFrom
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)]


@cache
def read_imports(package):
    """Map each module to the modules of the same package that it imports, wherever it does so."""
    files = {module_name(path, package): path for path in sorted(package.rglob("*.py"))}
    return {
        name: {known for target in targets(path, package.name) if (known := owner(target, files))}
        for name, path in files.items()
    }


def targets(path, package):
    """Yield the dotted names below the package that a file imports."""
    for node in imports_in(path.read_text(encoding="utf-8")):
        names = [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: write imports in full, not relative"
            names = [f"{node.module}.{name}" for name in names]
        for name in names:
            if name == package or name.startswith(f"{package}."):
                yield name.removeprefix(package).removeprefix(".")


def owner(target, files):
    """Find the module that an imported name belongs to: itself, or the nearest one around it."""
    while target and target not in files:
        target = target.rpartition(".")[0]
    return target or "gis_radar"


def top(module):
    return module.partition(".")[0]


def against_the_order(imports, order):
    """List the imports of a module that stands later in the order."""
    place = {module: index for index, module in enumerate(order)}
    return [
        f"{module} imports {target}"
        for module, found in imports.items()
        for target in sorted(found)
        if top(module) != top(target) and place[top(target)] > place[top(module)]
    ]


def test_every_module_has_its_row():
    modules = {top(module) for module in read_imports(PACKAGE)}
    new, gone = sorted(modules - set(ORDER)), sorted(set(ORDER) - modules)
    assert not new, f"new modules {new}: add them to ROWS, in the lowest row that works"
    assert not gone, f"modules {gone} are gone: take them out of ROWS"


def test_imports_go_one_way():
    known = {m: found for m, found in read_imports(PACKAGE).items() if top(m) in ORDER}
    known = {m: {t for t in found if top(t) in ORDER} for m, found in known.items()}
    assert against_the_order(known, ORDER) == []


def test_no_cycle_between_files():
    imports = read_imports(PACKAGE)
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as cycle:
        raise AssertionError("imports in a circle: " + " <- ".join(cycle.args[1])) from None


def between_folders(imports, room):
    """Map each folder and file of a room to those that it imports."""
    found = defaultdict(set)
    for module, targets in imports.items():
        for target in targets:
            if top(module) == top(target) == room and module != room != target:
                pair = [each.split(".")[1] for each in (module, target)]
                found[pair[0]] |= {pair[1]} - {pair[0]}
    return found


def test_no_cycle_between_folders_of_a_room():
    imports = read_imports(PACKAGE)
    assert between_folders(imports, "dataset")["days"] == {"files"}
    for room in ORDER:
        try:
            TopologicalSorter(between_folders(imports, room)).prepare()
        except CycleError as cycle:
            raise AssertionError(f"{room}: in a circle: {' <- '.join(cycle.args[1])}") from None


def offered_by(room):
    """Return the names that a room offers: those that its stub imports."""
    stub = PACKAGE / room / "__init__.pyi"
    text = stub.read_text(encoding="utf-8") if stub.exists() else ""
    return {alias.asname for node in imports_in(text) for alias in node.names}


def past_the_front(text, offered=None, *, room=""):
    """Yield the lines that import from an inner module of another room.

    With `offered`, only those that take what that room offers.
    """
    for node in imports_in(text):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gis_radar."):
            _, other, *inner = node.module.split(".")
            names = {alias.name for alias in node.names}
            known = names if offered is None else names & offered.get(other, set())
            if inner and known and other != room:
                yield f"{node.lineno}: {sorted(known)} of {other}"


def test_rooms_take_from_each_other_what_they_offer():
    found = [
        f"{path.relative_to(PACKAGE)}:{line}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line in past_the_front(
            path.read_text(encoding="utf-8"), room=path.relative_to(PACKAGE).parts[0]
        )
    ]
    assert found == []


def test_others_take_from_a_room_what_it_offers():
    rooms = [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    offered = {room: offered_by(room) for room in rooms}
    assert len(offered["live"]) > 20  # names of a stub
    root = PACKAGE.parent
    found = [
        f"{path.relative_to(root)}:{line}"
        for folder in ("tests", "bench", "simulation", "tools", "qgis_plugin")
        for path in sorted((root / folder).rglob("*.py"))
        for line in past_the_front(path.read_text(encoding="utf-8"), offered)
    ]
    assert found == []


def test_what_a_room_offers_is_used_by_another():
    """A name that only its own room uses is no part of its front, if the docs do not show it."""
    texts = [
        (path.relative_to(PACKAGE.parent).parts[:2], path.read_text(encoding="utf-8"))
        for folder in ("gis_radar", "tests", "bench", "simulation", "tools")
        for path in sorted((PACKAGE.parent / folder).rglob("*.py"))
    ]
    texts.append((("gis_radar", ""), (PACKAGE / "__init__.pyi").read_text(encoding="utf-8")))
    taken = {
        (room, name)
        for place, text in texts
        for room, name in taken_from_rooms(text)
        if place != ("gis_radar", room)
    }
    api = (PACKAGE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    taken |= set(re.findall(r"^\.\. auto\w+:: gis_radar\.(\w+)\.(\w+)$", api, flags=re.MULTILINE))
    rooms = [path.parent.name for path in PACKAGE.glob("*/__init__.pyi")]
    assert [
        f"{room}: {name}"
        for room in rooms
        for name in sorted(offered_by(room))
        if (room, name) not in taken
    ] == []


def taken_from_rooms(text):
    """Yield the rooms and names that a file takes from their fronts: imported, or as room.name."""
    rooms = {}
    for node in imports_in(text):
        if isinstance(node, ast.ImportFrom):
            room = (node.module or "").removeprefix("gis_radar.")
            yield from ((room, alias.name) for alias in node.names)
            if node.module == "gis_radar":
                rooms |= {alias.asname or alias.name: alias.name for alias in node.names}
    for node in ast.walk(ast.parse(text)) if rooms else ():
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", None) in rooms:
            yield rooms[node.value.id], node.attr


def test_names_are_taken_by_import_and_from_a_room():
    text = "from gis_radar import poses as p\nfrom gis_radar.scans import Scan\np.Pose.of(q.View)"
    taken = {each for each in taken_from_rooms(text) if each[0] != "gis_radar"}
    assert taken == {("scans", "Scan"), ("poses", "Pose")}


# Public in spite of the underscore: of Jupyter, of named tuples, of the module `os`.
PUBLIC = {"_repr_html_", "_asdict", "_exit"}
OF_US = re.compile(r"\b(import|from) gis_radar\b")  # in code that a test runs in another process


def is_private(name):
    return name.startswith("_") and not name.endswith("__") and name not in PUBLIC


def past_the_public(text):
    """Yield where a test looks past the public names of what it tests, in code within it, too."""
    tree = ast.parse(text)
    ours = set(imported_from_us(tree))
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    derived = [
        node for node in classes
        if any(ast.unparse(base).partition(".")[0] in ours for base in node.bases)
    ]  # fmt: skip
    own = {name for node in classes if node not in derived for name in made_by(node)}
    for node in derived:
        yield from (f"{node.lineno}: {node.name}.{name}" for name in made_by(node))
    for node in ast.walk(tree):
        yield from (f"{node.lineno}: {name}" for name in private_in(node, own))
        if isinstance(node, ast.Constant) and OF_US.search(str(node.value)):
            with suppress(SyntaxError):
                yield from (f"{node.lineno}: code: {each}" for each in past_the_public(node.value))


def imported_from_us(tree):
    """Yield the names that stand for something of the package."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom | ast.Import):
            for alias in node.names:
                if (getattr(node, "module", None) or alias.name).startswith("gis_radar"):
                    yield (alias.asname or alias.name).partition(".")[0]


def made_by(node):
    """Yield the private names that a class defines, or assigns to its objects."""
    for each in ast.walk(node):
        is_stored = isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store)
        if isinstance(each, ast.FunctionDef) and is_private(each.name):
            yield each.name
        elif is_stored and is_own(each) and is_private(each.attr):
            yield each.attr


def is_own(node):
    return ast.unparse(node.value) in {"self", "cls", "super()"}


def called(node):
    """Return the last name of what a call calls."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def private_in(node, own):
    """Yield the private names of others that a node imports, takes or sets."""
    names = []
    if isinstance(node, ast.Attribute) and not (node.attr in own and is_own(node)):
        names = [node.attr]
    elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gis_radar"):
        names = [*node.module.split("."), *(alias.name for alias in node.names)]
    elif isinstance(node, ast.Call) and called(node).endswith("attr"):
        texts = [each.value for each in node.args[:2] if isinstance(each, ast.Constant)]
        names = [name for each in map(str, texts) for name in each.split(".")["." in each :]]
    yield from filter(is_private, names)


def test_tests_use_public_names():
    found = [
        f"{path.name}:{line}"
        for folder in (Path(__file__).parent, PACKAGE.parent / "qgis_plugin" / "tests")
        for path in sorted(folder.rglob("*.py"))
        for line in past_the_public(path.read_text(encoding="utf-8"))
    ]
    assert found == []
