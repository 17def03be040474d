"""What the set-up needs and leaves alone."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
CONDA_NAMES = {
    "duckdb": ["python-duckdb"],
    "laspy": ["laspy", "lazrs-python"],
    "matplotlib": ["matplotlib-base"],
    "tzdata": ["python-tzdata"],
}


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
