"""Rules of the tree that a machine can see."""

import ast
import re
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
FILE_LINES = 501
BODY_LINES = 50

# One letter in brackets keeps a pattern from finding itself.
FOREIGN = {
    "a package registry": r"(pypi|pythonhosted|npmjs)[.](org|com)|(deb|security)[.]debian",
    "a package mirror": r"index[-_]url|find[-_]links|PIP_[A-Z]+|UV_[I]NDEX",
    "a path of one machine": r"(?<![\w.*])/([r]oot|[w]ork|[h]ome/\w+|Users/\w+|opt/\w+)/",
}


@cache
def tree():
    """List the files of the project: those in git, and those new that git does not ignore."""
    git = ["git", "-c", "safe.directory=*", "ls-files", "-z", "-co", "--exclude-standard"]
    done = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"no git checkout: {done.stderr.strip()}")
    names = sorted(set(done.stdout.split("\0")) - {""})
    return [Path(name) for name in names if (ROOT / name).is_file()]


def text_of(path):
    """Read a file of the tree; a file that is not text reads as empty."""
    try:
        return (ROOT / path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def find(pattern, paths):
    return [
        f"{path}:{number}: {line.strip()[:80]}"
        for path in paths
        for number, line in enumerate(text_of(path).splitlines(), 1)
        if re.search(pattern, line)
    ]


def code(*folders):
    return [path for path in tree() if path.suffix == ".py" and path.parts[0] in folders]


def project():
    return tomllib.loads(text_of("pyproject.toml"))


def body_lines(function):
    """Count the lines of a function after its docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def test_files_are_short():
    lines = {
        str(path): len(text_of(path).splitlines()) for path in code("gis_radar", "qgis_plugin")
    }
    assert {path: count for path, count in lines.items() if count >= FILE_LINES} == {}


def test_functions_are_short():
    long = [
        f"{path}:{node.lineno}: {node.name} has {body_lines(node)} lines"
        for path in code("gis_radar", "qgis_plugin")
        for node in ast.walk(ast.parse(text_of(path)))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and body_lines(node) >= BODY_LINES
    ]
    assert long == []


@pytest.mark.parametrize("what", FOREIGN)
def test_nothing_of_one_machine(what):
    assert find(FOREIGN[what], tree()) == []


def test_the_version_stands_once():
    version = re.escape(project()["project"]["version"])
    elsewhere = {"pyproject.toml", "CHANGELOG.md", "constraints.txt", "qgis_plugin/metadata.txt"}
    paths = [
        path
        for path in tree()
        if str(path) not in elsewhere
        and path.suffix in {"", ".py", ".md", ".toml", ".cfg", ".txt", ".sh", ".yml", ".ipynb"}
    ]
    assert find(rf"(?<![\w.]){version}(?![\w.])", paths) == []


def test_the_change_log_knows_this_version():
    version = re.escape(project()["project"]["version"])
    assert re.search(rf"(?m)^## .*({version}|[Uu]nreleased)", text_of("CHANGELOG.md"))


def test_every_target_explains_itself():
    makefile = text_of("Makefile")
    targets = set(re.findall(r"(?m)^([a-z][\w-]*):", makefile))
    assert targets == set(re.findall(r"(?m)^([a-z][\w-]*):.*## \w", makefile))
    phony = re.search(r"(?ms)^\.PHONY:(.*?[^\\])$", makefile)
    assert phony
    benches = re.search(r"(?ms)^BENCHES :=(.*?[^\\])$", makefile)
    assert benches
    named = phony[1].replace("$(BENCHES)", benches[1])
    assert targets == set(named.replace("\\", " ").split())


def test_pins_are_plain():
    lines = text_of("constraints.txt").splitlines()
    assert [line for line in lines if not re.fullmatch(r"[a-z\d.-]+==[\w.+!]+( ; .+)?", line)] == []


def test_every_requirement_is_pinned():
    pins = dict(re.findall(r"(?m)^([^=\s]+)==(\S+)", text_of("constraints.txt")))
    settings = project()
    wanted = [
        *settings["build-system"]["requires"],
        *settings["project"]["dependencies"],
        *settings["dependency-groups"]["dev"],
    ]
    for requirement in map(Requirement, wanted):
        pin = pins.get(canonicalize_name(requirement.name))
        assert pin is not None, f"{requirement.name} has no pin: run `make constraints`"
        assert requirement.specifier.contains(pin), f"{requirement} does not admit {pin}"


def test_ci_runs_what_the_readme_says():
    lines = text_of(".ci/run").splitlines()
    assert [line for line in lines if not line.startswith(("#", "set ", "cd ", "export "))] == [
        "make test"
    ]
    assert re.search(r"\bmake test\b", text_of("README.md"))
    assert re.search(r"\bmake demo\b", text_of("README.md"))


def test_the_tests_of_other_versions_are_there():
    (parts,) = re.findall(r'parts="([^"]+)"', text_of("tools/test_versions.sh"))
    assert len(parts.split()) > 10
    assert not [part for part in parts.split() if not (ROOT / f"tests/test_{part}.py").is_file()]
