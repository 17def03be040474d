"""What tests of runs look at, and ways to spare them pictures and processes."""

from __future__ import annotations

import json
import os
from contextlib import contextmanager
from importlib import import_module
from types import SimpleNamespace

import pandas as pd
import pytest
from fake_stages import threads
from matplotlib.figure import Figure
from PIL import Image

from gis_radar.calibration import FITS, Finding
from gis_radar.products import REPORT_FILES

writing = import_module("gis_radar.products.report.report")  # of this name there is also a function
PAPER = (".png", ".pdf", "report.html")  # which holds pictures
HITS_ALONE = "\n[vehicles]\nfollow = false\n"  # where a test looks at no vehicle: it takes the most


def in_a_thread(_jobs, scratch, _language):
    return threads(1, scratch)


@contextmanager
def only_pictures(looked_at=""):
    """Leave all pictures but one and the PDF empty: they take most time."""
    save = Figure.savefig

    def leave_empty(figure, place, **options):
        if looked_at and looked_at in str(place):
            here.undo()
            save(figure, place, **options)
            blank()
        else:
            Image.new("RGBA", (60, 40)).save(place, "PNG")

    def blank():
        here.setattr(Figure, "savefig", leave_empty)
        here.setattr(Figure, "draw", lambda *_: None)
        here.setattr(writing, "write_pdf", lambda _, path: path.write_bytes(b"%PDF"))
        here.setattr(writing, "draw_sights", lambda _: [])

    with pytest.MonkeyPatch.context() as here:
        blank()
        yield


@contextmanager
def unchecked():
    """Let each recording fit its pose, without a look at either."""

    def passed(sensors, *_given, **_options):
        return tuple(Finding(sensor=name, verdict=FITS, evidence="") for name in sorted(sensors))

    with pytest.MonkeyPatch.context() as here:
        here.setattr("gis_radar.dataset.measuring.check_plausibility", passed)
        yield


@contextmanager
def no_report():
    """Leave all files of the report empty: its tables, pictures and page are half of a run."""

    def empty(folder, **_options):
        for name in REPORT_FILES:
            (folder / name).touch()
        told = {"found": [], "facts": {}, "basis": [[]], "lanes_named": [[]], "remarks": []}
        return SimpleNamespace(summary=told)

    with pytest.MonkeyPatch.context() as here:
        here.setattr("gis_radar.products.write_report", empty)
        yield


def change(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def results(out):
    files = (path for path in sorted(out.rglob("*")) if path.is_file())
    shown = [path for path in files if ".gis-radar" not in path.relative_to(out).parts]
    return {path.relative_to(out).as_posix(): content(path) for path in shown}


def content(path):
    """Return what does not depend on where the recordings lie, and which of them a run counted."""
    if path.name == "recordings.parquet":
        table = pd.read_parquet(path)
        return table.assign(path=table["path"].map(os.path.basename)).to_json()
    if path.name == "run.json":
        return without_remarks(json.loads(path.read_text(encoding="utf-8")))
    return path.read_bytes().splitlines()


def without_remarks(document):
    """Return a document without the warnings about single recordings."""
    if isinstance(document, dict):  # their templates, too
        kept = {key: value for key, value in document.items() if ".parquet: " not in key[:60]}
        return {key: without_remarks(value) for key, value in kept.items()}
    if isinstance(document, list):
        return [without_remarks(each) for each in document if ".parquet: " not in str(each)[:60]]
    return document


def same(one, other, but=()):
    one, other = (
        {name: what for name, what in results(each).items() if not name.endswith(but)}
        for each in (one, other)
    )
    assert sorted(one) == sorted(other)
    assert [name for name in one if one[name] != other[name]] == []


def states(done):
    return {outcome.stage.name: outcome.state for outcome in done.outcomes}


def done_by(run):
    return [name for name, state in states(run).items() if state == "done"]
