"""What the README and the notebooks show runs as it stands."""

import itertools
import json
import re
import sys
import time
import tomllib
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

import gis_radar as gr
import simulation.recording
from gis_radar.cli import group
from simulation.drawn_days import DayDrawer

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.fixture
def elsewhere(tmp_path, monkeypatch, measured_once):
    """A folder to work in; pictures of `write` stay empty, those of `plot` are drawn."""
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    plt.close("all")  # what other tests of this process left
    yield tmp_path
    plt.close("all")


def test_the_python_of_the_readme(elsewhere, capsys, measured_briefly):
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})  # noqa: S102 - our own example
    printed = capsys.readouterr().out
    assert "HeatMap" in printed
    assert "lanelet_id" in printed
    assert (elsewhere / "dataset" / "dataset.json").is_file()


def test_the_commands_of_the_readme_exist():
    shown = set(re.findall(r"`gis-radar (\w+)", README))
    assert len(shown) >= 3
    assert shown <= set(group.commands)


def code_of(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.fixture
def localized_of_half_a_minute(monkeypatch, first_seconds):
    """Localize by the sample's first seconds, and one of a town's sensors: all take longer."""
    localize, sample = gr.localize, gr.sample_folder()
    of_sample, of_town = itertools.chain([31.0], itertools.repeat(16.0)), itertools.count()

    def localized(recording, *given, **options):
        if recording.parent == sample:  # the first time for an answer, then to be refused
            recording = first_seconds(recording, next(of_sample))
        elif next(of_town) >= 1:
            raise gr.NoAnswerError("spared")
        return localize(recording, *given, **options)

    monkeypatch.setattr(gr, "localize", localized, raising=False)


@pytest.fixture
def one_whole_recording(monkeypatch):
    """Simulate one whole recording: those of the sensors that are spared take a second."""
    simulate, number = simulation.recording.simulate_recording, itertools.count()

    def simulated(radar, traffic, times, **options):
        return simulate(radar, traffic, times[: None if next(number) == 0 else 20], **options)

    monkeypatch.setattr(simulation.recording, "simulate_recording", simulated)


@pytest.fixture
def one_day_in_52(monkeypatch):
    """Draw one day in 52 of a year, so each day of the week once: each is the same work."""
    draw = DayDrawer.draw_day

    def drawn(drawer, span):
        return draw(drawer, span) if span[0].toordinal() % 52 == 0 else []

    monkeypatch.setattr(DayDrawer, "draw_day", drawn)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(
    elsewhere,
    path,
    request,
    measured_a_minute,
    localized_of_half_a_minute,
    one_whole_recording,
    one_day_in_52,
):
    """A notebook runs as it stands, draws something in each of its figures, and is quick."""
    names, code = {}, code_of(path)
    if any("from simulation" in source for source in code):
        request.getfixturevalue("sumo_installed")
    begin = time.process_time()  # others may use the machine, too
    for number, source in enumerate(code):
        exec(compile(source, f"{path.name} cell {number}", "exec"), names)  # noqa: S102
    assert time.process_time() - begin < 60.0
    figures = [plt.figure(number) for number in plt.get_fignums()]
    assert len(figures) == sum(source.count("plt.show()") for source in code) >= 3
    for figure in figures:
        figure.canvas.draw()
        assert all(ax.has_data() for ax in figure.axes)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stripped_and_needs_the_public_interface_only(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert cells[0]["cell_type"] == "markdown"
    for cell in cells:
        assert cell["metadata"] == {}
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    imported = re.findall(
        r"^(?:from|import) (gis_radar[.\w]*)", "\n".join(code_of(path)), re.MULTILINE
    )
    assert set(imported) == {"gis_radar"}


def test_the_extra_of_the_notebooks_brings_what_they_import():
    """Beside SUMO, which two of them name, and the checkout."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*settings["dependencies"], *settings["optional-dependencies"]["notebooks"]]
    brought = {re.match(r"[\w-]+", each)[0] for each in wanted}
    text = "\n".join(code for path in NOTEBOOKS for code in code_of(path))
    imported = set(re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE))
    assert imported - sys.stdlib_module_names - {"gis_radar", "simulation"} <= brought
    assert [*re.findall(r"pip install (duckdb-cli)", text)] == [*brought & {"duckdb-cli"}]
