"""Tables and options that cannot be: one line that names them, whatever the library says."""

import json
import os
import shutil
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from faults.inputs import HOUR, part_of

import gis_radar as gr
from gis_radar.base import column_statistics
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


def as_recorded(folder, table):
    """Let the record of the hour give the size that a part has."""
    path = folder / "dataset" / "hours" / f"{HOUR}.json"
    record = json.loads(path.read_text())
    record["parts"][table]["size"] = (folder / part_of(table)).stat().st_size
    path.write_text(json.dumps(record))


MEASURE = (
    "measure", "R1.parquet", "--pose", "R1.json", "--tiles", "tiles.gpkg", "--map", "map.osm",
    "-o", "o",
)  # fmt: skip
STEPS = {
    "text": lambda steps: steps.astype(str),
    "huge text": lambda steps: ["x" * 100] * len(steps),
    "nothing": lambda steps: pd.Series([None] * len(steps), dtype="Int64"),
    "halves": lambda steps: steps + 0.5,
    "no number": lambda steps: np.full(len(steps), np.nan),
}


@pytest.mark.parametrize("kind", STEPS)
@pytest.mark.parametrize(
    ("table", "column"),
    [("frames", "first_step"), ("frames", "last_step"), ("observed", "tile_id"),
     ("visible", "last_step"), ("occupied", "first_step")],
)  # fmt: skip
def test_parts_of_a_dataset_with_other_values(here, table, column, kind):
    change(here / part_of(table), **{column: STEPS[kind]})
    as_recorded(here, table)
    with pytest.raises(gr.InputError, match=f"{table}/") as caught:
        getattr(gr.open_dataset("dataset"), table)()
    assert len(caught.value.message.splitlines()) == 1


def test_a_type_of_a_damaged_footer_does_not_end_the_process(tmp_path):
    """Arrow aborts where it reads the statistics of a column of another type than the schema's."""
    path = tmp_path / "table.parquet"
    pq.write_table(pa.table({"step": pa.array([1, 2], pa.int32())}), path, store_schema=False)
    assert column_statistics(pq.read_metadata(path), 0, 0).max == 2
    int32, int96 = b"\x1c\x15\x02\x19", b"\x1c\x15\x06\x19"  # Thrift, a bit apart
    whole = path.read_bytes()
    assert whole.count(int32) == 1
    path.write_bytes(whole.replace(int32, int96))
    assert column_statistics(pq.read_metadata(path), 0, 0) is None


@pytest.mark.parametrize("corner", [np.nan, np.inf])
def test_tiles_with_corners_that_are_no_numbers(run, here, corner):
    tiles = gpd.read_file(here / "tiles.gpkg", layer="tiles")
    ring = shapely.get_coordinates(tiles.geometry[0])
    ring[2] = corner
    with np.errstate(invalid="ignore"):
        tiles.loc[0, "geometry"] = shapely.Polygon(ring)
    tiles.to_file(here / "tiles.gpkg", layer="tiles")
    refused(run(*MEASURE), "tiles.gpkg")


@pytest.mark.parametrize("values", ["520 ft"])
def test_tiles_with_heights_that_are_none(run, here, values):
    tiles = gpd.read_file(here / "tiles.gpkg", layer="tiles")
    tiles["height_m"] = values
    tiles.to_file(here / "tiles.gpkg", layer="tiles")
    refused(run(*MEASURE), "tiles.gpkg")


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
