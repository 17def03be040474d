"""Tables and options that cannot be: one line that names them, whatever the library says."""

import json
import os
import shutil
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from gis_radar.cli.console import UNFORESEEN


@pytest.fixture(scope="module")
def inputs(sound_inputs):
    return sound_inputs


@pytest.fixture
def here(inputs, tmp_path, monkeypatch):
    folder = shutil.copytree(inputs, tmp_path / "case")
    monkeypatch.chdir(folder)
    return folder


def refused(answer, *parts, code=3):
    assert answer[0] == code, answer
    lines = [line for line in answer[2].splitlines() if line.startswith("gis-radar: ")]
    assert len(lines) == 1, answer[2]
    assert UNFORESEEN not in answer[2], answer[2]
    for part in parts:
        assert part in lines[0]


def change(path, **columns):
    table = pd.read_parquet(path)
    for name, values in columns.items():
        table[name] = values(table[name]) if callable(values) else values
    import pyarrow.parquet as pq

    metadata = pq.read_schema(path).metadata
    import pyarrow as pa

    pq.write_table(
        pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(metadata), path
    )


HEATMAP = ("heatmap", "occupancy", "--tiles", "tiles.gpkg", "-o", "out")
STEPS = {
    "text": lambda steps: steps.astype(str),
    "huge text": lambda steps: ["x" * 100] * len(steps),
    "nothing": lambda steps: pd.Series([None] * len(steps), dtype="Int64"),
    "halves": lambda steps: steps + 0.5,
    "no number": lambda steps: np.full(len(steps), np.nan),
}


@pytest.mark.parametrize("kind", STEPS)
@pytest.mark.parametrize(
    ("file", "column"),
    [("frames", "first_step"), ("frames", "last_step"), ("views", "tile_id"),
     ("hits_by_sensor", "step")],
)  # fmt: skip
def test_tables_of_an_occupancy_with_other_values(run, here, file, column, kind):
    change(here / "occupancy" / f"{file}.parquet", **{column: STEPS[kind]})
    refused(run(*HEATMAP), "occupancy")


@pytest.mark.parametrize("tiles", ["text", None, 5, b"\x80", b"\xff" * 9])
def test_sets_of_tiles_that_are_none(run, here, tiles):
    table = here / "occupancy" / "hits_by_sensor.parquet"
    change(table, tiles=lambda sets: pd.Series([tiles] * len(sets)))
    refused(run(*HEATMAP), "hits_by_sensor.parquet")


def test_frames_that_end_before_they_begin(run, here):
    change(here / "occupancy" / "frames.parquet", last_step=lambda steps: steps - 10_000)
    refused(run(*HEATMAP), "frames.parquet")


@pytest.mark.parametrize("corner", [np.nan, np.inf])
def test_tiles_with_corners_that_are_no_numbers(run, here, corner):
    tiles = gpd.read_file(here / "tiles.gpkg", layer="tiles")
    ring = shapely.get_coordinates(tiles.geometry[0])
    ring[2] = corner
    with np.errstate(invalid="ignore"):
        tiles.loc[0, "geometry"] = shapely.Polygon(ring)
    tiles.to_file(here / "tiles.gpkg", layer="tiles")
    refused(run("occupancy", "R1.parquet", "--pose", "R1.json", "--tiles", "tiles.gpkg", "-o", "o"),
            "tiles.gpkg")  # fmt: skip


@pytest.mark.parametrize("values", ["520 ft"])
def test_tiles_with_heights_that_are_none(run, here, values):
    tiles = gpd.read_file(here / "tiles.gpkg", layer="tiles")
    tiles["height_m"] = values
    tiles.to_file(here / "tiles.gpkg", layer="tiles")
    answer = run(
        "occupancy", "R1.parquet", "--pose", "R1.json", "--tiles", "tiles.gpkg", "-o", "out"
    )
    refused(answer, "tiles.gpkg")


@pytest.mark.parametrize("sigma", ["0.1", -1.0, None, {"easting": "x"}, {"easting": -1.0}, [1]])
def test_sigma_that_is_none(run, here, sigma):
    pose = json.loads((here / "R1.json").read_text()) | {"sigma": sigma}
    (here / "R1.json").write_text(json.dumps(pose))
    answer = run("sensors", "R1.json", "-o", "out.gpkg")
    if sigma is not None:
        refused(answer, "pose of R1", "sigma")


@pytest.mark.parametrize("length", ["1e-9", "1e-4", "0", "-1", "nan", "inf"])
def test_lengths_that_would_fill_the_memory(run, here, length):
    answer = run("tiles", "map.osm", "--length", length, "-o", "out.gpkg")
    assert answer[0] in {2, 3}, answer
    assert UNFORESEEN not in answer[2]
    assert not Path("out.gpkg").exists()


@pytest.mark.parametrize("name", ["a\nb.osm", os.fsdecode(b"\xff\xfe.osm"), "<b>[red].osm"])
def test_names_of_files_that_no_terminal_shows(run, here, name):
    shutil.copy(here / "map.osm", here / name)
    code, out, _ = run("tiles", name, "-o", "out.gpkg", "--json")
    assert code == 0, out
    assert json.loads(out.splitlines()[-1])["event"] == "result"
    code, out, _ = run("tiles", "map.osm", "-o", f"{name}.gpkg", "--json")
    last = json.loads(out.splitlines()[-1])
    assert last["event"] == ("result" if code == 0 else "error")  # GDAL writes no such names
    assert UNFORESEEN not in out
    code, _, err = run("tiles", f"{name}x", "-o", "out.gpkg")
    assert code in {2, 3}
    assert len(err.strip().splitlines()) == 1


def test_long_names_and_options_are_not_echoed_whole(run, here):
    refused(run("tiles", "map.osm", "--crs", "x" * 100_000, "-o", "out.gpkg"))
    _, _, err = run("tiles", "map.osm", "--crs", "x" * 100_000, "-o", "out.gpkg")
    assert len(err) < 1000
