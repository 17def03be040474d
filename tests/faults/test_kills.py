"""`kill -9` at random moments of every command that writes: the old result, the new one or nothing.

A run of the next day clears what the killed one left, and nobody is locked out. `make test` kills a
sample, `make faults` all.
"""

import hashlib
import os
import random
import shutil
import sqlite3
import sys
import time
import zlib
from contextlib import closing

import pyarrow.parquet as pq
import pytest

import gis_radar as gr
from faults.inputs import HEATMAP, MASK, MEASURE, Kind
from faults.test_faults import ALL, words_of

SAMPLE = gr.sample_folder()
LANES = f"--map {SAMPLE}/junction.osm --road sample/road.laz"

COMMANDS = {
    "tiles": "tiles map.osm -o out.gpkg",
    "mask": MASK.format("map.osm"),
    "convert": "convert table.csv -o out.parquet",
    "measure": MEASURE,
    "measure hits": f"{MEASURE} --hits-only",
    "heatmap": HEATMAP,
    "project gpkg": "project R1.parquet --pose R1.json -o out.gpkg",
    "project laz": "project R1.parquet --pose R1.json -o out.laz",
    "project parquet": "project R1.parquet --pose R1.json -o out.parquet",
    "report": "report heatmap --dataset dataset -o out",
    "qgis": "qgis heatmap -o out.qgz",
    "sensors": "sensors R1.json -o out.gpkg",
    "quality": "quality dataset -o out.csv",
    "sight": "sight --pose R1.json --tiles tiles.gpkg --scan scan.laz -o out.gpkg",
    "run": "run SITE.toml -o out",
    "localize": f"localize {SAMPLE}/R1.parquet {LANES} --guess 690356,5336183 -o out.json",
    "track": f"track {SAMPLE}/R1.parquet {LANES} --pose {SAMPLE}/R1.json -o out.csv",
    "clocks": f"clocks {SAMPLE}/R1.parquet {SAMPLE}/R2.parquet --pose {SAMPLE}/R1.json "
    f"--pose {SAMPLE}/R2.json --tiles sample/tiles.gpkg -o out.json",
    "footprints": "footprints dataset -o out.gpkg",
    "traffic": "traffic dataset --interval 1min -o out",
    "demo": "demo -o out",
}
EACH = 4
CASES = [(name, number) for name in COMMANDS for number in range(EACH)]
CHOSEN = CASES if ALL else [("mask", 0), ("heatmap", 1), ("project gpkg", 2), ("measure", 3)]
OLD = b"old"
# Several files that are moved one after the other, which the next run ends.
MAIN = {"mask": "out.laz", "report": "out/report.html"}
RUNS = {"run", "demo"}
DATASETS = {"measure", "measure hits"}  # what has a record is whole, the next run makes the rest
# A run goes on where it stopped, a project that was edited stays, a dataset is added to.
GROWN = {*RUNS, *DATASETS, "qgis"}
LONGEST_S = 1200.0
PATIENCE_S = 60.0  # for workers of a killed run to see that it is gone

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of processes are Linux's")


@pytest.fixture(scope="module")
def commands(runner, inputs, tmp_path_factory):
    """Run a command; each has run to its end once: how long it takes, and what it writes."""
    known = {}
    if ALL:
        inputs = _with_sample(inputs, tmp_path_factory.mktemp("more") / "inputs")

    def run(name, folder=None, **limits):
        place = folder or shutil.copytree(inputs, tmp_path_factory.mktemp("whole") / "case")
        (place / "tmp").mkdir(exist_ok=True)
        words = words_of(Kind(path="", words=COMMANDS[name]), place)
        limits |= {"temporary": str(place / "tmp"), "processor_s": LONGEST_S}
        return place, runner.run(place, words, **limits)

    def whole(name):
        if name not in known:
            place, answer = run(name, seconds=LONGEST_S)
            assert answer["code"] == 0, answer["err"]
            known[name] = answer["seconds"], written(place)
        return known[name]

    run.whole, run.inputs = whole, inputs
    return run


def _with_sample(inputs, folder):
    """Return the inputs with what commands need that want real traffic."""
    shutil.copytree(inputs, folder)
    (folder / "sample").mkdir()
    roads = gr.read_map(SAMPLE / "junction.osm")
    gr.write_tiles(gr.make_tiles(roads), folder / "sample/tiles.gpkg", problems=roads.problems)
    mask = gr.mask_road([SAMPLE / "scan.laz"], roads, engine="laspy")
    mask.write(folder / "sample/road.laz")
    return folder


def written(folder):
    """Return the contents of all that a command named its output writes."""
    files = [path for top in folder.glob("out*") for path in [top, *top.rglob("*")]]
    shown = {path.relative_to(folder): path for path in files if path.is_file()}
    hidden = {name for name in shown if any(part.startswith(".") for part in name.parts)}
    return {str(name): content(shown[name]) for name in shown.keys() - hidden}


def content(path):
    """Return what tells a whole file from a part: GeoPackages and logs also hold the time."""
    if path.read_bytes() == OLD:
        return OLD
    if path.suffix == ".gpkg":
        with closing(sqlite3.connect(path)) as base:
            assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            names = sorted(base.execute("SELECT table_name FROM gpkg_contents"))
            return [(name, *base.execute(f'SELECT count(*) FROM "{name}"')) for (name,) in names]  # noqa: S608
    if path.name == "recordings.parquet":  # it names where they lie
        return pq.read_table(path).drop_columns("path").to_pylist()
    alone = path.name in {"out.json", "out.csv"}
    if alone or path.suffix in {".laz", ".parquet", ".tif", ".png"}:
        return hashlib.blake2b(path.read_bytes()).hexdigest()
    return "there"


def left(folder):
    """Return what no finished run leaves."""
    hidden = [path.name for path in folder.rglob(".*") if path.suffix in {".part", ".lock"}]
    return hidden + [path.name for path in (folder / "tmp").iterdir()]


@pytest.mark.parametrize(("name", "number"), CHOSEN)
def test_kill(commands, tmp_path, name, number):
    seconds, new = commands.whole(name)
    folder = shutil.copytree(commands.inputs, tmp_path / "case")
    old = {}
    if number % 2 and name not in GROWN:
        for path in new:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(OLD)
        old = dict.fromkeys(new, OLD)
    chance = random.Random(zlib.crc32(f"{name} {number}".encode()))  # noqa: S311 - a moment
    _, answer = commands(name, folder, seconds=chance.uniform(0.0, 1.0) * seconds)
    found = written(folder)
    state = "old" if found == old else "new" if found == new else "partly new"
    state += "" if answer["late"] else ", had ended"
    sys.stderr.write(f"kill: {name}: {state}\n")  # `pytest -s` shows it
    if name in MAIN and found not in (old, new):  # the file that is asked for comes last
        assert found.get(MAIN[name], OLD) == OLD
        assert all(each in (old.get(path), new[path]) for path, each in found.items())
    elif name in DATASETS:
        if (folder / "out" / "dataset.json").is_file():
            gr.open_dataset(folder / "out").check()
    elif name not in RUNS:
        assert found in (old, new), f"{state}: {sorted(found)}"
    end = time.monotonic() + PATIENCE_S
    while (_next := commands(name, folder, seconds=LONGEST_S)[1])[
        "code"
    ] and time.monotonic() < end:
        assert name in RUNS, _next["err"]
        time.sleep(0.2)
    assert _next["code"] == 0, _next["err"]
    assert written(folder) == new
    for path in folder.rglob("*"):
        os.utime(path, (1.0, 1.0))
    assert commands(name, folder, seconds=LONGEST_S)[1]["code"] == 0
    assert left(folder) == []
