"""Occupancy in heat maps, against sets of steps counted one by one."""

import json
import sqlite3
import tempfile
import xml.etree.ElementTree as ET
from collections import defaultdict
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import rasterio
from counted_sites import FOLDERS, T0, lane_tiles
from datasets import stepwise_dataset
from driven import straight_tiles
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from PIL import Image

import gis_radar as gr
from gis_radar.dataset import STEPS_PER_QUARTER
from gis_radar.hdmap import lanes_of
from gis_radar.products import MapLabels, make_heatmap, read_heatmap
from gis_radar.products.heatmap.occupancy import LEAST_ERROR_S, OccupancyShares, mean_occupancy

BEGIN = T0 // STEPS_PER_QUARTER * STEPS_PER_QUARTER + STEPS_PER_QUARTER - 60  # 3 s before its end
VIEW = ("R1", "a")


def dataset_of(tiles, steps, occupied=None, visible=None, **options):
    """Write a dataset of one sensor that sees all tiles; give it."""
    folder = Path(tempfile.mkdtemp(dir=FOLDERS.name)) / "site"
    return stepwise_dataset(
        folder, tiles, {VIEW: set(steps)}, {VIEW: set(tiles["tile_id"])}, set(),
        occupied=occupied, visible=visible, **options,
    )  # fmt: skip


def both_of(tiles, *, steps=400, seed=3):
    """Make a dataset and the sets that it holds."""
    rng = np.random.default_rng(seed)
    span = set(range(BEGIN, BEGIN + steps)) - {BEGIN + 7, BEGIN + 90}
    occupied, visible = defaultdict(set), {}
    for tile in range(len(tiles) - 2):
        hidden = BEGIN + int(rng.integers(0, steps))
        visible[tile, True] = span - set(range(hidden, hidden + 40))
        at = BEGIN + int(rng.integers(-20, 30))
        while at < BEGIN + steps:
            length = int(rng.integers(1, 60))
            seen = bool(rng.random() < 0.7)
            occupied[tile, seen] |= set(range(max(at, BEGIN), min(at + length, BEGIN + steps)))
            at += length + int(rng.integers(1, 60))
    return dataset_of(tiles, span, occupied, visible), occupied, visible, span


@settings(max_examples=10)
@given(
    seed=st.integers(0, 1000), interval=st.sampled_from([None, "50ms", "1s", "7s", "15min"]),
)  # fmt: skip
def test_steps_are_counted_as_one_by_one(seed, interval):
    tiles = lane_tiles(9)
    dataset, occupied, visible, common = both_of(tiles, seed=seed, steps=250)
    heat = make_heatmap(dataset, interval=interval)
    assert (heat.whole.begin[0], heat.whole.end[0]) == (min(common), max(common) + 1)
    for i in [None, *range(len(heat.timeline))]:
        times = heat.whole if i is None else heat.timeline
        inside = set(range(int(times.begin[i or 0]), int(times.end[i or 0]))) & common
        got = heat.occupancy_shares(i)
        assert heat.shares(i).observed_s[0] == pytest.approx(0.05 * len(inside))
        for tile in range(len(tiles)):
            shown = visible.get((tile, True), set()) & inside
            under = (occupied.get((tile, True), set()) | occupied.get((tile, False), set())) & shown
            assert got.visible_s[tile] == pytest.approx(0.05 * len(shown))
            if not shown:
                assert np.isnan(
                    [got.occupied_s[tile], got.occupancy[tile], got.occupancy_se[tile]]
                ).all()
                continue
            assert got.occupied_s[tile] == pytest.approx(0.05 * len(under))
            assert got.occupancy[tile] == pytest.approx(len(under) / len(shown))


def test_the_error_follows_its_formula():
    """Two lanes; on tile 3 a seen run of 20 steps and one of 80, on tile 5 one that is inferred."""
    tiles = lane_tiles(12).assign(index=np.tile(np.arange(6), 2), s_m=np.tile(np.arange(6), 2) / 2)
    span = set(range(BEGIN - 200, BEGIN + 60))  # of one block
    occupied = {
        (3, True): set(range(BEGIN - 190, BEGIN - 170)) | set(range(BEGIN - 100, BEGIN - 20)),
        (5, False): set(range(BEGIN - 190, BEGIN - 90)),
    }
    visible = {(tile, True): span for tile in range(12)}
    got = make_heatmap(dataset_of(tiles, span, occupied, visible)).occupancy_shares()
    seen = [(0.16 * 20) ** 2 + (0.45 * 20) ** 2, 10.0**2 + (0.45 * 80) ** 2]
    slope = 0.3 * (100 / 260) / 0.5
    assert got.occupancy_se[3] == pytest.approx(np.hypot(np.sqrt(sum(seen)) / 260, slope), rel=1e-5)
    inferred = np.hypot(10.0, 0.7 * 100) / 260
    assert got.occupancy_se[5] == pytest.approx(np.hypot(inferred, slope), rel=1e-5)
    assert got.occupancy_se[4] == pytest.approx(slope, rel=1e-5)  # beside both
    assert got.occupancy_se[6] == pytest.approx(2 / 260, rel=1e-5)  # of the other lane
    assert LEAST_ERROR_S == 0.1


def test_hidden_time_adds_to_the_error_and_does_not_cut_runs():
    tiles = lane_tiles(12).assign(index=np.tile(np.arange(6), 2), s_m=np.tile(np.arange(6), 2) / 2)
    span = set(range(BEGIN - 200, BEGIN + 60))
    hidden = set(range(BEGIN - 60, BEGIN))  # from the middle of the run on
    every = {(tile, True): set(range(BEGIN - 100, BEGIN - 20)) for tile in range(12)}
    visible = {(tile, True): span - hidden for tile in range(12)}
    visible |= {(tile, False): hidden for tile in range(12)}
    got = make_heatmap(dataset_of(tiles, span, every, visible)).occupancy_shares()
    run, share = 10.0**2 + (0.45 * 80) ** 2, 80 / 260
    unknown = (0.7 * 60) ** 2 * share * (1 - share)
    assert got.visible_s[3] == pytest.approx(13.0)
    assert got.occupancy_se[3] == pytest.approx(np.sqrt(run + unknown) / 260, rel=1e-5)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    tiles = lane_tiles(12)
    heat = make_heatmap(both_of(tiles)[0], interval="5s")
    folder = tmp_path_factory.mktemp("map") / "heat"
    heat.write(folder)
    return heat, folder


def test_all_files_carry_occupancy(written):
    heat, folder = written
    wide = heat.wide()
    names = [name for name in wide if name.startswith("occ_2")]
    assert [name.replace("occ_", "hit_") for name in names] == [n for n in wide if "hit_2" in n]
    known = heat.occupancy_shares()
    layer = pyogrio.read_dataframe(folder / "heatmap.gpkg", layer="heatmap")
    table = gpd.read_parquet(folder / "heatmap.parquet")
    for read in (wide, layer, table):
        for name, values in known._asdict().items():
            np.testing.assert_array_equal(read[name], values)
        for i, name in enumerate(names):
            np.testing.assert_array_equal(read[name], heat.occupancy_shares(i).occupied_s)
    assert "occupancy_se" in json.loads(
        pyogrio.read_info(folder / "heatmap.gpkg", layer="heatmap")["layer_metadata"]["definitions"]
    )


def test_the_raster_shows_occupancy_and_hits_stands_beside(written):
    heat, folder = written
    tops = {
        "heatmap.tif": heat.occupancy_shares().occupancy,
        "hits.tif": heat.shares().hit_share,
    }
    for name, values in tops.items():
        with rasterio.open(folder / name) as raster:
            assert raster.count == 1 + len(heat.timeline)
            assert np.nanmax(raster.read(1)) == pytest.approx(np.nanmax(values), abs=1e-6)
    assert 'attr="occupancy"' in (folder / "heatmap.qml").read_text()


def test_the_layer_by_interval_reads_as_made(written):
    heat, folder = written
    again = read_heatmap(folder)
    for i in [None, *range(len(heat.timeline)), slice(1, 3)]:
        for one, other in zip(again.occupancy_shares(i), heat.occupancy_shares(i), strict=True):
            np.testing.assert_array_equal(one, other)
    assert again.figures() == heat.figures()
    read = pyogrio.read_dataframe(folder / "heatmap.gpkg", layer="by_interval")
    long = heat.long()
    assert read.geometry.geom_equals(long.geometry).all()
    pd.testing.assert_frame_equal(
        pd.DataFrame(read.drop(columns="geometry")),
        pd.DataFrame(long.drop(columns="geometry")),
        check_dtype=False,
    )


def test_plots_show_occupancy(written):
    heat, _ = written
    labels = [
        text.get_text() for text in heat.plot(Figure().add_subplot()).get_legend().get_texts()
    ]
    assert labels[-3:] == ["0 %, no vehicle", "uncertain", "not visible"]


def test_maps_and_qgis_hatch_the_same_tiles(written):
    """The rule of the QGIS style is valid SQL too, so SQLite is asked the same."""
    heat, folder = written
    by_interval = np.concatenate([heat.uncertain(i) for i in range(len(heat.timeline))])
    assert 0 < by_interval.sum() < len(by_interval)
    with closing(sqlite3.connect(folder / "heatmap.gpkg")) as database:
        for table, vague in (
            ("heatmap", heat.uncertain()),
            ("by_interval", by_interval),
        ):
            (qml,) = database.execute(
                "SELECT styleQML FROM layer_styles WHERE f_table_name = ?", (table,)
            ).fetchone()
            rules = {
                option.get("value")
                for option in ET.fromstring(qml).iterfind(".//Option[@name='expression']")  # noqa: S314
            }
            assert len(rules) == 1
            rule = rules.pop().removeprefix("if(").removesuffix(", 'solid', 'no')")
            visible = f"SELECT occupancy IS NOT NULL AND ({rule}) FROM {table}"  # noqa: S608
            assert [bool(row[0]) for row in database.execute(visible)] == vague.tolist()


def test_uncertain_is_what_is_as_wrong_as_it_is_high_or_hardly_seen():
    shares = OccupancyShares(
        visible_s=np.array([0.0, 100, 100, 100, 100, 49]),
        occupied_s=np.array([np.nan, 0, 0, 3, 10, 10]),
        occupancy=np.array([np.nan, 0, 0, 0.03, 0.1, 0.2]),
        occupancy_se=np.array([np.nan, 0.019, 0.02, 0.03, 0.09, 0.01]),
    )
    assert shares.uncertain(50.0).tolist() == [False, False, True, True, False, True]


def test_the_error_of_the_mean_adds_up_along_a_lane_but_not_across():
    shares = OccupancyShares(*np.array([[10.0, 30.0], [1, 6], [0.1, 0.2], [0.04, 0.02]]))
    off_s = (10 * 0.04, 30 * 0.02)
    for tiles, lanes, whole_s in (
        (straight_tiles(2), 1, sum(off_s)),
        (lane_tiles(2), 2, np.hypot(*off_s)),
    ):
        assert len(lanes_of(tiles)) == lanes
        assert mean_occupancy(tiles, shares) == pytest.approx((7 / 40, whole_s / 40))


def test_a_picture_names_site_zone_and_sources(tmp_path, written):
    labels = MapLabels(title="A", timezone="Europe/Berlin", sources=("simulated",))
    heat = replace(written[0], labels=labels)
    heat.write(tmp_path / "heat")
    assert read_heatmap(tmp_path / "heat").labels == labels
    about = Image.open(tmp_path / "heat" / "heatmap.png").text
    assert (about["Title"], about["Source"]) == ("A, Occupancy heat map", "simulated")
    assert about["Description"] == (
        "14 November 2023, 23:14:57 to 23:15:17 (Europe/Berlin, UTC+01:00)"
    )
    assert MapLabels(title="A\x07\n B").title == "A\\x07 B"
    with pytest.raises(gr.UsageError, match="no time zone"):
        MapLabels(timezone="Europe/Bayern")


def test_intervals_of_quarters_are_those_counted_step_by_step():
    """Tile counts and exact tables give the same numbers and the same errors."""
    tiles = lane_tiles(9)
    dataset, *_ = both_of(tiles)
    coarse, fine = (make_heatmap(dataset, interval=each) for each in ("15min", "5min"))
    assert len(coarse.timeline) == 2
    for i, part in enumerate((slice(0, 1), slice(1, 2))):
        for one, other in (
            (coarse.shares(i), fine.shares(part)),
            (coarse.occupancy_shares(i)[:3], fine.occupancy_shares(part)[:3]),
        ):
            np.testing.assert_allclose(one, other, rtol=1e-12)
    np.testing.assert_allclose(
        coarse.occupancy_shares().occupancy_se, fine.occupancy_shares().occupancy_se, rtol=1e-6
    )
