"""Hit share as xarray, against a count by pandas; and heat maps read back."""

from __future__ import annotations

import shutil
import sqlite3
import sys
import tracemalloc
from contextlib import closing

import numpy as np
import pandas as pd
import pytest
from datasets import recordings_of, write_dataset
from test_heatmap import T0, lane_tiles, two_sensors

import gis_radar as gr
from gis_radar.dataset import FRAMES, STEPS_PER_HOUR
from gis_radar.dataset.tables import OBSERVED
from gis_radar.products.heatmap.heatmap import require_room

xr = pytest.importorskip("xarray")
pytestmark = pytest.mark.usefixtures("without_picture")


@pytest.fixture(scope="module")
def site():
    return two_sensors()


def counted(site, steps, within=None):
    """Count hit and observed steps by tile and interval with pandas, step by step."""
    rows = [
        (step, tile)
        for key, delivered in site.delivered.items()
        for step in delivered
        for tile in site.seen.get(key, ())
    ]
    observed = pd.DataFrame(rows, columns=["step", "tile"]).drop_duplicates()
    hits = pd.DataFrame(sorted(site.hit), columns=["step", "tile"]).assign(hit=1)
    table = observed.merge(hits, how="left").fillna({"hit": 0})
    if within:
        table = table[(table["step"] >= within[0]) & (table["step"] < within[1])]
    table["time"] = pd.to_datetime(table["step"] // steps * steps * 50, unit="ms")
    return table.groupby(["tile", "time"])["hit"].agg(["sum", "count"]) / 20.0


def compared(cube, expected):
    """Compare every cell of a cube with the count."""
    for tile in cube["tile_id"].to_numpy():
        for time in cube["time"].to_numpy():
            cell = cube.sel(tile_id=tile, time=time)
            hit, observed = float(cell["hit_s"]), float(cell["observed_s"])
            if (tile, time) in expected.index:
                sum_s, count_s = expected.loc[(tile, time)]
                assert (hit, observed) == pytest.approx((sum_s, count_s))
                assert float(cell["hit_share"]) == pytest.approx(sum_s / count_s)
            else:
                assert observed == 0.0
                assert np.isnan([hit, float(cell["hit_share"])]).all()


def test_a_heat_map_as_a_cube(site):
    heat = gr.make_heatmap(site.dataset, interval="5s")
    cube = heat.to_xarray()
    assert dict(cube.sizes) == {"tile": 16, "time": 4}
    compared(cube, counted(site, 100))
    assert cube.attrs["crs"] == "EPSG:25832"
    assert cube.attrs["fingerprint"] == site.dataset.manifest.fingerprint
    assert {name: cube[name].attrs["units"] for name in cube} == {
        "hit_s": "s", "observed_s": "s", "hit_share": "1",
    }  # fmt: skip
    assert cube["begin"].dtype == np.dtype("datetime64[ns]")
    assert ((cube["end"] - cube["begin"]) == np.timedelta64(5, "s")).all()
    centre = site.tiles.geometry.iloc[3].centroid
    assert float(cube["easting"][3]) == pytest.approx(centre.x)
    assert cube["lanelet_id"].to_numpy().tolist() == site.tiles["lanelet_id"].tolist()


@pytest.mark.parametrize(("interval", "steps"), [("50ms", 1), ("2s", 40)])
def test_a_series_of_chosen_tiles_and_times(site, interval, steps):
    begin, end = (pd.Timestamp((T0 + k) * 50, unit="ms", tz="UTC") for k in (90, 171))
    cube = gr.make_heatmap(
        site.dataset, interval=interval, tile_ids=[9, 2, 5], begin=begin, end=end
    ).to_xarray()
    assert cube["tile_id"].to_numpy().tolist() == [2, 5, 9]
    assert cube["begin"].to_numpy().max() < end.to_datetime64() <= cube["end"].to_numpy().max()
    expected = counted(site, steps, (T0 + 90, T0 + 171))
    cut = expected.reset_index()
    cut["time"] = cut["time"].clip(lower=begin.tz_localize(None))  # intervals are cut at the ends
    compared(cube, cut.set_index(["tile", "time"]))
    assert float(cube["hit_s"].sum()) > 0.0


def test_memory_is_that_of_the_result(tmp_path):
    """Hits of 20 times the memory allowed pass through."""
    tiles, steps = lane_tiles(400), 24_000
    ids = tiles["tile_id"].to_numpy()
    step = np.arange(T0, T0 + steps)
    frames = {"sensor": np.full(steps, "R1"), "time_us": step * 50_000, "first_step": step,
              "last_step": step, "pose": np.full(steps, "R1-a")}  # fmt: skip
    zeros = [name for name in FRAMES.names if name not in frames]
    hours = np.unique(step // STEPS_PER_HOUR)
    edges = [(max(T0, h * STEPS_PER_HOUR), min(T0 + steps, (h + 1) * STEPS_PER_HOUR) - 1)
             for h in hours.tolist()]  # fmt: skip
    runs = np.array([(tile, *edge) for tile in ids.tolist() for edge in edges])
    tables = {
        "frames": frames | dict.fromkeys(zeros, np.zeros(steps, np.int64)),
        "hits": {"tile_id": np.repeat(ids, steps), "step": np.tile(step, len(ids))},
        "observed": dict(zip(OBSERVED.names, runs.T, strict=True)),
    }
    dataset = write_dataset(
        tmp_path / "site", tables, tiles=tiles, vehicles=False, recordings=recordings_of({"R1"}),
        sights={"pose": np.full(len(ids), "R1-a"), "tile_id": ids},
    )  # fmt: skip
    del tables
    tracemalloc.start()
    cube = gr.make_heatmap(dataset, interval="1min").to_xarray()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert float(cube["hit_s"].sum()) == pytest.approx(400 * steps / 20)
    assert peak < 400 * steps * 16 / 5


def test_too_large_a_cube_is_refused(site):
    heat = gr.make_heatmap(site.dataset, interval="50ms")
    with pytest.raises(gr.UsageError, match=r"16 tiles in .* over 0.01 MiB") as error:
        heat.to_xarray(most_mib=0.01)
    for way in ("longer interval", "tile_ids", "begin"):
        assert way in error.value.hint
    with pytest.raises(gr.UsageError, match="60000 tiles in 1728000 intervals take 3164062 MiB"):
        require_room(60_000, 1_728_000, 1024.0)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"tile_ids": [3, 99]}, gr.InputError, "tile 99"),
        ({"tile_ids": []}, gr.UsageError, "names no tile"),
        ({"begin": "2023-11-14T22:13:21Z", "end": "2023-11-14T22:13:20Z"}, gr.UsageError, "ascend"),
        ({"begin": "2001-01-01", "end": "2001-01-02"}, gr.InputError, "no sensor"),
        ({"begin": "noon"}, gr.UsageError, "expected a time such as"),
    ],
)
def test_what_makes_no_sense_is_refused(site, options, error, words):
    with pytest.raises(error, match=words):
        gr.make_heatmap(site.dataset, interval="1s", **options)


def test_a_map_of_some_tiles_is_not_written(site, tmp_path):
    heat = gr.make_heatmap(site.dataset, tile_ids=[3])
    assert len(heat.wide()) == 1
    with pytest.raises(gr.UsageError, match="a heat map of some tiles is not written"):
        heat.write(tmp_path / "map")


def test_without_xarray_the_install_line_is_given(site, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(gr.InputError, match="needs xarray") as error:
        gr.make_heatmap(site.dataset).to_xarray()
    assert error.value.hint == "pip install gis_radar[notebooks]"


@pytest.mark.parametrize("options", [{}, {"interval": "5s"}, {"interval": "50ms"}])
def test_a_heat_map_is_read_back_as_it_was(site, tmp_path, options):
    made = gr.make_heatmap(site.dataset, **options)
    made.write(tmp_path / "heat")
    for path in (tmp_path / "heat", tmp_path / "heat" / "heatmap.gpkg"):
        read = gr.read_heatmap(path)
        assert read.figures() == made.figures()
        assert read.metadata == made.metadata
        for name in ("wide", "long"):
            mine, theirs = (pd.DataFrame(getattr(h, name)()) for h in (read, made))
            pd.testing.assert_frame_equal(
                mine.drop(columns="geometry"), theirs.drop(columns="geometry")
            )
        assert read.wide().geometry.geom_equals(made.wide().geometry).all()
    read.write(tmp_path / "again")
    names = ("hits.tif", "heatmap.parquet", "heatmap.qml")
    for name in names:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "heat" / name).read_bytes()


def test_a_heat_map_that_was_changed_is_not_read(site, tmp_path):
    gr.make_heatmap(site.dataset).write(tmp_path / "heat")
    file = tmp_path / "heat" / "heatmap.gpkg"
    changes = (
        ("UPDATE tiles SET lanelet_id = 8 WHERE tile_id = 15", "changed since"),
        ("DELETE FROM steps_by_interval WHERE tile_id = 3", "damaged"),
        ("DELETE FROM gpkg_metadata_reference", "lacks fingerprint"),
    )
    for number, (change, words) in enumerate(changes):
        other = tmp_path / f"{number}.gpkg"
        shutil.copyfile(file, other)
        with closing(sqlite3.connect(other)) as database, database:
            named = database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
            for (trigger,) in named.fetchall():  # they need functions that SQLite lacks
                database.execute(f'DROP TRIGGER "{trigger}"')
            database.execute(change)
        with pytest.raises(gr.InputError, match=words):
            gr.read_heatmap(other)
    with pytest.raises(gr.InputError, match="no such file"):
        gr.read_heatmap(tmp_path)
    (tmp_path / "text.gpkg").write_text("no")
    with pytest.raises(gr.InputError, match="not a heat map"):
        gr.read_heatmap(tmp_path / "text.gpkg")
