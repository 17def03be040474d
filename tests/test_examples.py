"""What the README and the notebooks show runs as it stands."""

import json
import re
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

from gis_radar.cli.commands import group

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    yield tmp_path
    plt.close("all")


def test_the_python_of_the_readme(elsewhere, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})  # noqa: S102 - our own example
    printed = capsys.readouterr().out
    assert "HeatMap" in printed
    assert "occupancy" in printed
    assert (elsewhere / "occupancy" / "hits.parquet").is_file()


def test_the_commands_of_the_readme_exist():
    shown = set(re.findall(r"^gis-radar (\w+)", README, flags=re.MULTILINE))
    assert len(shown) >= 4
    assert shown <= set(group.commands)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(elsewhere, path):
    names = {}
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert code
    for number, source in enumerate(code):
        exec(compile(source, f"{path.name} cell {number}", "exec"), names)  # noqa: S102
    assert plt.get_fignums()


def test_there_are_notebooks():
    assert NOTEBOOKS
