"""The templates of all that the package tells a user, read from its source.

An f-string becomes a template with a hole `{}` for each value; a value that is one of a few texts
of the source gives a template each.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import gis_radar
from gis_radar.cli.usage import CLICK_TEXTS

PACKAGE = Path(gis_radar.__file__).parent
HOLE = "{}"
MOST = 24  # alternatives of one message
DEEPEST = 7  # names of names
# Functions whose texts are lines of warnings, reasons and verdicts that others hand on.
TELLING = re.compile(
    r"_?(\w*warnings?|\w*remarks?|unmatched|_overlaps|_why_unmatched|_reason|_zone_warning|_wrong_place|"
    r"verdict_of|_verdicts?|_doubt\w*|_lost\w*|_faults?|_described|_contradiction\w*|"
    r"report_contradictions|words|faults_of)"
)
TOLD = {"log": 0, "remark": 0}  # methods, and which argument is told
ALARMED = {
    "alarm": 1,
    "_refuse": 1,
    "_pass_over": 5,
}  # of the live system: details that its page shows
NO_REPORTERS = {"np", "math", "logging", "_LOGGER", "pc"}
# Single words of a sentence; other single words are names, as of fields and options.
WORDS = {
    "left", "right", "fast", "slow", "missing", "there", "map", "nothing", "none", "s", "repaired",
    "doubtful", "millimetres", "centimetres", "behind",
}  # fmt: skip
Where = tuple[Path, ast.AST]
OUTSIDE = (
    ast.Yield, ast.List, ast.ListComp, ast.Return, ast.Tuple, ast.IfExp, ast.GeneratorExp,
    ast.Assign,
)  # fmt: skip
FRAGMENTS: dict[str, Where] = {}  # texts that stand in the holes of others


@cache
def trees() -> dict[Path, ast.Module]:
    """Parse the package; nodes get the parent they are in."""
    found = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}
    for tree in found.values():
        for node in ast.walk(tree):
            for child in ast.iter_child_nodes(node):
                child.parent = node  # type: ignore[attr-defined]
    return found


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of a module; to walk its tree for each question took seconds."""
    return tuple(ast.walk(trees()[path]))


@cache
def calls(path: Path) -> dict[str, list[ast.Call]]:
    """Return the calls in a module by the name that is called."""
    found: dict[str, list[ast.Call]] = {}
    for node in nodes(path):
        if isinstance(node, ast.Call):
            found.setdefault(name_of(node.func), []).append(node)
    return found


def name_of(node: ast.AST | None) -> str:
    return getattr(node, "id", "") or getattr(node, "attr", "")


@cache
def exceptions() -> frozenset[str]:
    """Return the names of all exceptions of the package, and those of Python that it raises."""
    names = {"Exception", "ValueError", "TypeError"}
    classes = [
        node for path in trees() for node in nodes(path)
        if isinstance(node, ast.ClassDef)
    ]  # fmt: skip
    while more := {
        each.name for each in classes
        if each.name not in names and {name_of(base) for base in each.bases} & names
    }:  # fmt: skip
        names |= more
    return frozenset(names)


@cache
def named(path: Path) -> dict[str, ast.AST]:
    """Return constants and functions of a module by name."""
    found: dict[str, ast.AST] = {}
    for node in trees()[path].body:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=False))
                found |= {name_of(one): value for one, value in pairs}
        elif isinstance(node, ast.AnnAssign) and node.value:
            found[name_of(node.target)] = node.value
        elif isinstance(node, ast.FunctionDef):
            found[node.name] = node
    return found


@cache
def imported(path: Path) -> dict[str, tuple[Path, str]]:
    """Return what a module takes from others of the package: their file and their name."""
    found = {}
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("gis_radar"):
            place = PACKAGE.parent.joinpath(*str(node.module).split("."))
            files = (place.with_suffix(".py"), place / "__init__.py")
            source = next((each for each in files if each in trees()), None)
            if source:
                found |= {each.asname or each.name: (source, each.name) for each in node.names}
    return found


def definition(path: Path, name: str) -> Where | None:
    """Return where a name of a module is defined."""
    for _ in range(DEEPEST):
        if name in named(path):
            return path, named(path)[name]
        if name not in imported(path):
            return None
        path, name = imported(path)[name]
    return None


def function_around(node: ast.AST | None) -> ast.FunctionDef | None:
    while node is not None and not isinstance(node, ast.FunctionDef):
        node = getattr(node, "parent", None)
    return node


def assigned(function: ast.FunctionDef, name: str) -> Iterator[ast.AST | None]:
    """Yield what a name may be in a function; None for what is not plain."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if name_of(target) == name and isinstance(target, ast.Name):
                    yield node.value
                elif isinstance(target, ast.Tuple):
                    at = [k for k, each in enumerate(target.elts) if name_of(each) == name]
                    known = isinstance(node.value, ast.Tuple)
                    yield from (node.value.elts[k] if known else None for k in at)
        elif isinstance(node, (ast.AnnAssign, ast.NamedExpr)) and name_of(node.target) == name:
            yield node.value
        elif isinstance(node, ast.AugAssign) and name_of(node.target) == name:
            before = next(iter(assigned_before(function, name)), None)
            yield ast.BinOp(left=before, op=ast.Add(), right=node.value) if before else None
        elif isinstance(node, (ast.For, ast.comprehension)):
            yield from looped(node, name)


def looped(loop: ast.For | ast.comprehension, name: str) -> Iterator[ast.AST | None]:
    """Yield what a name of a loop may be."""
    if name_of(loop.target) == name and isinstance(loop.iter, (ast.Tuple, ast.List)):
        yield from loop.iter.elts
    elif any(name_of(each) == name for each in ast.walk(loop.target)):
        yield None


def assigned_before(function: ast.FunctionDef, name: str) -> Iterator[ast.AST]:
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and name_of(node.targets[0]) == name:
            yield node.value


def given(path: Path, function: ast.FunctionDef, name: str) -> Iterator[tuple[Path, ast.AST]]:
    """Yield what callers give for a parameter."""
    arguments = function.args
    places = [each.arg for each in (*arguments.posonlyargs, *arguments.args)]
    called = function.name
    if called == "__init__":
        called, places = function.parent.name, places[1:]  # type: ignore[attr-defined]
    elif places[:1] in (["self"], ["cls"]):
        places = places[1:]
    defaults = dict(zip(reversed(places), reversed(arguments.defaults), strict=False)) | {
        each.arg: value
        for each, value in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
        if value is not None
    }
    for source in trees():
        if source != path and called not in imported(source):
            continue
        for node in calls(source).get(called, []):
            by_name = {each.arg: each.value for each in node.keywords}
            if name in by_name:
                yield source, by_name[name]
            elif name in places and places.index(name) < len(node.args):
                yield source, node.args[places.index(name)]
            elif name in defaults:
                yield path, defaults[name]


def parameters(function: ast.FunctionDef) -> set[str]:
    arguments = function.args
    return {each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}


def unique(groups: Iterator[list[str]]) -> list[str]:
    return list(dict.fromkeys(itertools.chain.from_iterable(groups)))


def texts(path: Path, node: ast.AST | None, deep: int = 0, *, inner: bool = False) -> list[str]:
    """Return the templates that an expression may be; a hole for what the source leaves open."""
    if deep > DEEPEST:
        return [HOLE]
    found = joined(path, node, deep, inner=inner)
    if found is None:
        found = named_text(path, node, deep, inner=inner)
    return found


def joined(path: Path, node: ast.AST | None, deep: int, *, inner: bool) -> list[str] | None:
    """Return the templates of texts that are put together; None for what is none."""
    match node:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.JoinedStr(values=values):
            parts = [filling(path, each, deep) for each in values]
            if len(list(itertools.islice(itertools.product(*parts), MOST + 1))) > MOST:
                FRAGMENTS.update({text: (path, node) for each in parts[1:] for text in each})
                parts = [each if len(each) == 1 else [HOLE] for each in parts]
            return list(dict.fromkeys(map("".join, itertools.product(*parts))))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            both = (texts(path, each, deep + 1, inner=inner) for each in (left, right))
            return list(dict.fromkeys(map("".join, itertools.product(*both))))
    return None


def named_text(path: Path, node: ast.AST | None, deep: int, *, inner: bool) -> list[str]:
    """Return the templates of a choice, a call or a name."""
    choices = {ast.IfExp: ("body", "orelse"), ast.NamedExpr: ("value",)}
    if isinstance(node, (ast.IfExp, ast.NamedExpr, ast.BoolOp)):
        ways = (
            node.values
            if isinstance(node, ast.BoolOp)
            else [getattr(node, name) for name in choices[type(node)]]
        )
        return unique(texts(path, each, deep + 1, inner=inner) for each in ways)
    match node:
        case ast.Subscript(value=ast.Constant(value=str(text))):
            return ["", text]  # `"s"[: count > 1]`
        case ast.Subscript(value=ast.Name(id="REASONS")):
            return looked_up(path, "REASONS")
        case ast.Call(func=ast.Name(id=name)):
            return returned(path, name, deep)
        case ast.Name():
            return of_name(path, node, deep, inner=inner)
    return [HOLE]


def filling(path: Path, part: ast.AST, deep: int) -> list[str]:
    """Return what a part of an f-string may be: several only where the source has them all."""
    if isinstance(part, ast.Constant):
        return [str(part.value)]
    assert isinstance(part, ast.FormattedValue)
    if part.format_spec is not None or part.conversion != -1:
        return [HOLE]
    ways = [
        each if " " in each or each in WORDS or not re.fullmatch(r"[\w.]+", each) else HOLE
        for each in texts(path, part.value, deep + 1, inner=True)
    ]
    if HOLE in ways:  # one of them is open: the others are texts of their own within it
        FRAGMENTS.update({each: (path, part) for each in ways if each != HOLE})
        return [HOLE]
    return list(dict.fromkeys(ways))


def looked_up(path: Path, name: str) -> list[str]:
    """Return the texts of a table of the package, where all are texts."""
    found = definition(path, name)
    values = found[1].values if found and isinstance(found[1], ast.Dict) else []
    ways = [getattr(each, "value", None) for each in values]
    return ways if ways and all(isinstance(each, str) for each in ways) else [HOLE]


def returned(path: Path, name: str, deep: int) -> list[str]:
    """Return what a function of the package may return, where that is text."""
    found = definition(path, name)
    if found is None or not isinstance(found[1], ast.FunctionDef):
        return [HOLE]
    source, function = found
    if "str" not in ast.unparse(function.returns or ast.Name("")).split(" | "):
        return [HOLE]
    ways = [each.value for each in ast.walk(function) if isinstance(each, ast.Return)]
    return unique(texts(source, each, deep + 1, inner=True) for each in ways if each)


def of_name(path: Path, node: ast.Name, deep: int, *, inner: bool) -> list[str]:
    function = function_around(node)
    while function is not None:
        if values := list(assigned(function, node.id)):
            return unique(texts(path, each, deep + 1, inner=inner) for each in values)
        if node.id in parameters(function):
            asked = [] if inner and deep > 2 else list(given(path, function, node.id))
            ways = unique(texts(source, each, deep + 1, inner=inner) for source, each in asked)
            return [HOLE] if not ways or (inner and HOLE in ways) else ways
        function = function_around(function.parent)  # type: ignore[attr-defined]
    found = definition(path, node.id)
    if found is None or isinstance(found[1], ast.FunctionDef):
        return [HOLE]
    return texts(found[0], found[1], deep + 1, inner=inner)


def told() -> Iterator[tuple[Path, ast.AST]]:
    """Yield all expressions that a user meets as an error, a hint or a remark."""
    for path in trees():
        if "live" in path.relative_to(PACKAGE).with_suffix("").parts:
            yield from ((path, each) for each in alarmed(path))
            continue  # servers, whose log is English
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef) and TELLING.fullmatch(node.name):
                yield from ((path, each) for each in told_lines(node))
            if not isinstance(node, ast.Call):
                continue
            called = name_of(node.func)
            if called in exceptions() or called == "Meaning":
                yield from ((path, each) for each in node.args[:1])
                yield from ((path, each.value) for each in node.keywords
                            if each.arg in {"hint", "message", "expected"})  # fmt: skip
            elif called in TOLD and name_of(getattr(node.func, "value", None)) not in NO_REPORTERS:
                yield from ((path, each) for each in node.args[:1])


def alarmed(path: Path) -> Iterator[ast.AST]:
    """Yield what the page of the live system shows beside an alarm: details, damaged messages."""
    for node in nodes(path):
        if isinstance(node, ast.Call):
            name = name_of(node.func)
            if name in ALARMED:
                yield from node.args[ALARMED[name] : ALARMED[name] + 1]
            elif path.stem in {"payload", "detections", "intake"} and name in exceptions():
                yield from node.args[:1]
        elif isinstance(node, ast.FunctionDef) and node.name == "_reason_against":
            yield from told_lines(node)


def told_lines(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the outermost texts of a function that makes lines."""
    for node in ast.walk(function):
        text = isinstance(node, ast.JoinedStr) or (
            isinstance(node, ast.Constant) and isinstance(node.value, str)
        )
        around = getattr(node, "parent", None)
        appended = isinstance(around, ast.Call) and name_of(around.func) == "append"
        if text and (appended or isinstance(around, OUTSIDE)):
            yield node


def own_letters(template: str) -> int:
    return len(re.sub(r"\{\w*\}|[^A-Za-z]", "", template))


def plain(template: str) -> str:
    """Return a template as the catalogue has it: on one line, without names before it."""
    text = re.sub(r"(\{\})+", HOLE, " ".join(template.split()))
    while text.startswith(f"{HOLE}: ") and own_letters(text):
        text = text.removeprefix(f"{HOLE}: ")
    return text


@cache
def message_templates() -> dict[str, str]:
    """Return all templates with words of their own, and the file where each is."""
    found: dict[str, str] = {}

    def keep(text: str, path: Path, node: ast.AST) -> None:
        key = plain(text)
        whole = key[:1] != "," and key[-1:] != ":" and not re.search(r"\{\w+\}", key)
        if own_letters(key) >= 3 and not key.isidentifier() and whole:
            found.setdefault(key, f"{path.relative_to(PACKAGE)}:{getattr(node, 'lineno', 0)}")

    for path, node in told():
        for text in texts(path, node):
            keep(text, path, node)
    for text in CLICK_TEXTS:
        keep(text, PACKAGE / "cli" / "usage.py", ast.Module())
    for text, (path, node) in FRAGMENTS.items():
        keep(text, path, node)
    return found
