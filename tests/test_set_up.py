"""What the set-up needs and leaves alone."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
CONDA_NAMES = {
    "duckdb": ["python-duckdb"],
    "laspy": ["laspy", "lazrs-python"],
    "matplotlib": ["matplotlib-base"],
    "tzdata": ["python-tzdata"],
}


needs_sh = pytest.mark.skipif(os.name == "nt", reason="the set-up is a shell script")


def write_program(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Give an empty folder for the set-up, and programs that stand before the system's."""
    folder = tmp_path / "check out"
    (folder / "tools").mkdir(parents=True)
    (tmp_path / "programs").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "programs"), prepend=os.pathsep)
    return folder


WITHOUT_EXTRAS = """
import importlib.abc, sys
sys.path.insert(0, "tools")
import missing_libraries as tool

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {
            "movingpandas", "open3d", "paho", "prometheus_client", "starlette", "uvicorn"
        }:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
tool.modules_of = lambda _: []
for known in ("gis_radar.live.served.page", "gis_radar.cli", "gis_radar.demo"):
    tool.own_modules = lambda: [known]
    print(known, tool.load_all("run"), "uvicorn" in sys.modules)
tool.own_modules = lambda: ["gis_radar.nowhere"]
print(tool.load_all("run"))
"""


def test_what_extras_bring_is_not_needed_for_the_demo():
    """A bare machine has no web server: `make demo` sets up what gis-radar asks for, no more."""
    command = [sys.executable, "-c", WITHOUT_EXTRAS]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.stdout.splitlines() == [
        "gis_radar.live.served.page [] False",
        "gis_radar.cli [] False",
        "gis_radar.demo [] False",
        "[\"gis_radar.nowhere: No module named 'gis_radar.nowhere'\"]",
    ], done.stderr


def test_conda_gets_what_pyproject_asks_for():
    text = (ROOT / "environment.yml").read_text(encoding="utf-8")
    entries = re.findall(r"(?m)^  - ([\w-]+)((?:>=[\d.]+)?)$", text)
    given = {name: floor for name, floor in entries if name not in {"conda-forge", "pip"}}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {"python": project["requires-python"], "pdal": ">=2.2"}
    for requirement in map(
        Requirement, project["dependencies"] + project["optional-dependencies"]["pdf"]
    ):
        first, *more = CONDA_NAMES.get(requirement.name, [requirement.name])
        wanted |= {first: str(requirement.specifier)} | dict.fromkeys(more, "")
    assert given == wanted


@needs_sh
def test_an_environment_of_another_checkout_is_not_emptied(checkout):
    """A link in the place of ours is taken away, not what it leads to."""
    shutil.copy(ROOT / "tools" / "set_up.sh", checkout / "tools")
    other = checkout.parent / "other"
    write_program(other / "bin" / "python", "exit 0")
    (checkout / ".venv").symlink_to(other)
    python = checkout.parent / "programs" / "python"
    write_program(python, 'case "$*" in *"-m venv"*) rm -rf .venv/*; exit 1;; esac')
    done = subprocess.run(
        ["/bin/sh", checkout / "tools" / "set_up.sh", "run"], capture_output=True, text=True,
        env=os.environ | {"PYTHON": str(python)}, check=False,
    )  # fmt: skip
    assert "could not make .venv" in done.stderr
    assert (other / "bin" / "python").exists()
