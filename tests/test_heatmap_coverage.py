"""Coverage in heat maps, against sets of steps counted one by one."""

import json
import sqlite3
import xml.etree.ElementTree as ET
import zipfile
from collections import defaultdict
from contextlib import closing
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import rasterio
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from PIL import Image
from test_heatmap import T0, lane_tiles, runs_of
from test_vehicles_folder import FIRST, drive, straight_tiles, write
from test_vehicles_folder import POSE as WHOLE_POSE

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.errors import InputError
from gis_radar.heatmap import MapLabels, make_heatmap, read_heatmap
from gis_radar.heatmap.covering import ERRORS, CoverageShares, mean_coverage
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.folder import frames_of, frames_table, views_table
from gis_radar.occupancy.frame_steps import steps_in
from gis_radar.tiles.lanes import lanes_of
from gis_radar.tiles.tiles import fingerprint
from gis_radar.vehicles.folder import RunBlock, Vehicles
from gis_radar.vehicles.provenance import Provenance
from gis_radar.vehicles.tables import BLOCK_STEPS, COVERED, FRAMES, PASSAGES, VEHICLES, VISIBLE

BEGIN = T0 // BLOCK_STEPS * BLOCK_STEPS + BLOCK_STEPS - 60  # 3 s before the edge of a block
POSE = {"crs": "EPSG:25832", "easting": 1.0, "sensor": "R1"}


def frames_in(steps):
    rows = pd.DataFrame({"first_step": sorted(steps), "last_step": sorted(steps)})
    return frames_table(frames_of("R1", "a", steps_in(rows)))


def occupancy_in(tiles, steps, **changed):
    frames = frames_in(steps)
    known = {
        "fingerprint": fingerprint(tiles),
        "frames": frames,
        "views": views_table(frames, {"a": tiles["tile_id"].to_numpy()}),
        "hits_by_sensor": lambda _: iter(()),
        "sources": [{"recording": "R1", "sensor": "R1", "poses": [POSE]}],
        "hold_s": {"R1": 0.0},
    }
    return Occupancy(**(known | changed))


def table_of(sets, kind):
    """Give the runs of sets of steps, by tile or by tile and seen, cut at blocks."""
    rows = []
    for key, steps in sets.items():
        for block in {step // BLOCK_STEPS for step in steps}:
            mine = sorted(step for step in steps if step // BLOCK_STEPS == block)
            rows += [(*key, run[0], run[-1]) for run in runs_of(mine)]
    names = ["tile_id", "seen", "first_step", "last_step"]
    return kind.typed(pd.DataFrame(rows, columns=names).astype({"seen": bool}))


def vehicles_in(tiles, steps, covered, visible, **changed):
    tables = table_of(covered, COVERED), table_of(visible, VISIBLE)
    blocks = sorted({step // BLOCK_STEPS for step in steps})

    def read():
        for number in blocks:
            parts = [t[t["first_step"] // BLOCK_STEPS == number] for t in tables]
            parts = [t.sort_values(["tile_id", "first_step"], ignore_index=True) for t in parts]
            yield RunBlock(number=number, covered=parts[0], visible=parts[1])

    known = {
        "fingerprint": fingerprint(tiles),
        "map": {},
        "hold_s": {"R1": 0.0},
        "sources": [{"recording": "R1", "sensor": "R1", "poses": [POSE]}],
    }
    return Vehicles(
        provenance=Provenance(**(known | changed)), frames=FRAMES.typed(frames_in(steps)),
        vehicles=VEHICLES.empty(), passages=PASSAGES.empty(),
        read_tracks=lambda _: iter(()), blocks=read,
    )  # fmt: skip


def both_of(tiles, *, steps=400, seed=3, late=0):
    """Make an occupancy, vehicles and the sets that they hold."""
    rng = np.random.default_rng(seed)
    span = set(range(BEGIN, BEGIN + steps)) - {BEGIN + 7, BEGIN + 90}
    covered, visible = defaultdict(set), {}
    for tile in range(len(tiles) - 2):
        hidden = BEGIN + int(rng.integers(0, steps))
        visible[tile, True] = span - set(range(hidden, hidden + 40))
        at = BEGIN + int(rng.integers(-20, 30))
        while at < BEGIN + steps:
            length = int(rng.integers(1, 60))
            seen = bool(rng.random() < 0.7)
            covered[tile, seen] |= set(range(max(at, BEGIN), min(at + length, BEGIN + steps)))
            at += length + int(rng.integers(1, 60))
    occupancy = occupancy_in(tiles, {step + late for step in span})
    return occupancy, vehicles_in(tiles, span, covered, visible), covered, visible


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 1000), late=st.sampled_from([0, 25]),
    interval=st.sampled_from([None, "50ms", "1s", "7s"]),
)  # fmt: skip
def test_steps_are_counted_as_one_by_one(seed, late, interval):
    tiles = lane_tiles(9)
    occupancy, vehicles, covered, visible = both_of(tiles, seed=seed, steps=250, late=late)
    heat = make_heatmap(occupancy, tiles, interval=interval, vehicles=vehicles)
    delivered = [occupancy.frames, vehicles.frames]
    common = set.intersection(
        *(
            {s for a, b in f[["first_step", "last_step"]].to_numpy() for s in range(a, b + 1)}
            for f in delivered
        )
    )
    assert (heat.whole.begin[0], heat.whole.end[0]) == (min(common), max(common) + 1)
    for i in [None, *range(len(heat.timeline))]:
        times = heat.whole if i is None else heat.timeline
        inside = set(range(int(times.begin[i or 0]), int(times.end[i or 0]))) & common
        got = heat.coverage_shares(i)
        assert heat.shares(i).observed_s[0] == pytest.approx(0.05 * len(inside))
        for tile in range(len(tiles)):
            shown = visible.get((tile, True), set()) & inside
            under = (covered.get((tile, True), set()) | covered.get((tile, False), set())) & shown
            assert got.visible_s[tile] == pytest.approx(0.05 * len(shown))
            if not shown:
                assert np.isnan(
                    [got.covered_s[tile], got.coverage[tile], got.coverage_se[tile]]
                ).all()
                continue
            assert got.covered_s[tile] == pytest.approx(0.05 * len(under))
            assert got.coverage[tile] == pytest.approx(len(under) / len(shown))


def test_the_error_follows_its_formula():
    """Two lanes; on tile 3 a seen run of 20 steps and one of 80, on tile 5 one that is inferred."""
    tiles = lane_tiles(12).assign(index=np.tile(np.arange(6), 2), s_m=np.tile(np.arange(6), 2) / 2)
    span = set(range(BEGIN - 200, BEGIN + 60))  # of one block
    covered = {
        (3, True): set(range(BEGIN - 190, BEGIN - 170)) | set(range(BEGIN - 100, BEGIN - 20)),
        (5, False): set(range(BEGIN - 190, BEGIN - 90)),
    }
    visible = {(tile, True): span for tile in range(12)}
    vehicles = vehicles_in(tiles, span, covered, visible)
    got = make_heatmap(occupancy_in(tiles, span), tiles, vehicles=vehicles).coverage_shares()
    seen = [(0.16 * 20) ** 2 + (0.3 * 20) ** 2, 10.0**2 + (0.3 * 80) ** 2]
    slope = 0.3 * (100 / 260) / 0.5
    assert got.coverage_se[3] == pytest.approx(np.hypot(np.sqrt(sum(seen)) / 260, slope), rel=1e-5)
    inferred = np.hypot(10.0, 0.7 * 100) / 260
    assert got.coverage_se[5] == pytest.approx(np.hypot(inferred, slope), rel=1e-5)
    assert got.coverage_se[4] == pytest.approx(slope, rel=1e-5)  # beside both
    assert got.coverage_se[6] == pytest.approx(2 / 260, rel=1e-5)  # of the other lane
    assert ERRORS.least_s == 0.1


def test_hidden_time_adds_to_the_error_and_does_not_cut_runs():
    tiles = lane_tiles(12).assign(index=np.tile(np.arange(6), 2), s_m=np.tile(np.arange(6), 2) / 2)
    span = set(range(BEGIN - 200, BEGIN + 60))
    hidden = set(range(BEGIN - 60, BEGIN))  # from the middle of the run on
    every = {(tile, True): set(range(BEGIN - 100, BEGIN - 20)) for tile in range(12)}
    visible = {(tile, True): span - hidden for tile in range(12)}
    visible |= {(tile, False): hidden for tile in range(12)}
    vehicles = vehicles_in(tiles, span, every, visible)
    got = make_heatmap(occupancy_in(tiles, span), tiles, vehicles=vehicles).coverage_shares()
    run, share = 10.0**2 + (0.3 * 80) ** 2, 80 / 260
    unknown = (0.7 * 60) ** 2 * share * (1 - share)
    assert got.visible_s[3] == pytest.approx(13.0)
    assert got.coverage_se[3] == pytest.approx(np.sqrt(run + unknown) / 260, rel=1e-5)


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"fingerprint": "other"}, "different tiles"),
        ({"sight": {"scan": "x"}}, "different sight"),
        ({"sources": [{"sensor": "R1", "poses": [POSE | {"easting": 2.0}]}]}, "different poses"),
    ],
)
def test_vehicles_of_another_origin_are_refused(changed, what):
    tiles = lane_tiles(4)
    vehicles = vehicles_in(tiles, {BEGIN}, {}, {}, **changed)
    with pytest.raises(InputError, match=what):
        make_heatmap(occupancy_in(tiles, {BEGIN}), tiles, vehicles=vehicles)


def test_vehicles_of_another_time_or_tile_are_refused():
    tiles = lane_tiles(4)
    with pytest.raises(InputError, match="no time in common"):
        make_heatmap(
            occupancy_in(tiles, {BEGIN}), tiles, vehicles=vehicles_in(tiles, {BEGIN + 9}, {}, {})
        )
    odd = vehicles_in(tiles, {BEGIN}, {}, {(77, True): {BEGIN}})
    with pytest.raises(InputError, match="name tile 77, which the tiles lack"):
        make_heatmap(occupancy_in(tiles, {BEGIN}), tiles, vehicles=odd)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    tiles = lane_tiles(12)
    occupancy, vehicles, _, _ = both_of(tiles)
    heat = make_heatmap(occupancy, tiles, interval="5s", vehicles=vehicles)
    folder = tmp_path_factory.mktemp("map") / "heat"
    heat.write(folder)
    return heat, folder


def test_all_files_carry_coverage(written):
    heat, folder = written
    wide = heat.wide()
    names = [name for name in wide if name.startswith("cov_")]
    assert [name.replace("cov_", "occ_") for name in names] == [n for n in wide if "occ_" in n]
    known = heat.coverage_shares()
    layer = pyogrio.read_dataframe(folder / "heatmap.gpkg", layer="heatmap")
    table = gpd.read_parquet(folder / "heatmap.parquet")
    for read in (wide, layer, table):
        for name, values in known._asdict().items():
            np.testing.assert_array_equal(read[name], values)
        for i, name in enumerate(names):
            np.testing.assert_array_equal(read[name], heat.coverage_shares(i).covered_s)
    assert "coverage_se" in json.loads(
        pyogrio.read_info(folder / "heatmap.gpkg", layer="heatmap")["layer_metadata"]["definitions"]
    )


def test_the_raster_shows_coverage_and_occupancy_stands_beside(written):
    heat, folder = written
    tops = {
        "heatmap.tif": heat.coverage_shares().coverage,
        "occupancy.tif": heat.shares().occupancy,
    }
    for name, values in tops.items():
        with rasterio.open(folder / name) as raster:
            assert raster.count == 1 + len(heat.timeline)
            assert np.nanmax(raster.read(1)) == pytest.approx(np.nanmax(values), abs=1e-6)
    assert 'attr="coverage"' in (folder / "heatmap.qml").read_text()


def test_the_layer_by_interval_reads_as_made(written):
    heat, folder = written
    read = pyogrio.read_dataframe(folder / "heatmap.gpkg", layer="occupancy_by_interval")
    long = heat.long()
    assert read.geometry.geom_equals(long.geometry).all()
    pd.testing.assert_frame_equal(
        pd.DataFrame(read.drop(columns="geometry")),
        pd.DataFrame(long.drop(columns="geometry")),
        check_dtype=False,
    )


def test_plots_browser_map_and_cube_show_coverage(written):
    heat, _ = written
    labels = [
        text.get_text() for text in heat.plot(Figure().add_subplot()).get_legend().get_texts()
    ]
    assert labels[-3:] == ["0 %, no vehicle", "uncertain", "not visible"]
    assert "0 %, no vehicle" in heat.explore(tiles=None).get_root().render()
    cube = heat.to_xarray()
    for i in range(len(heat.timeline)):
        for name, values in heat.coverage_shares(i)._asdict().items():
            np.testing.assert_array_equal(cube[name][:, i], values.astype(np.float32))
    assert cube["covered_s"].attrs["units"] == "s"
    assert "vehicle was on it" in cube["covered_s"].attrs["long_name"]


def test_a_qgis_project_of_it_shows_coverage(written, tmp_path):
    gr.write_qgis_project(tmp_path / "site.qgz", heatmap=written[1])
    with zipfile.ZipFile(tmp_path / "site.qgz") as archive:
        text = archive.read("site.qgs").decode()
    assert 'attr="coverage"' in text
    assert 'attr="occupancy"' not in text
    assert "Coverage by interval" in text
    assert "Coverage|share of time with a vehicle" in text
    assert "Occupancy" not in text


def test_maps_and_qgis_hatch_the_same_tiles(written):
    """The rule of the QGIS style is valid SQL too, so SQLite is asked the same."""
    heat, folder = written
    by_interval = np.concatenate([heat.uncertain(i) for i in range(len(heat.timeline))])
    assert 0 < by_interval.sum() < len(by_interval)
    with closing(sqlite3.connect(folder / "heatmap.gpkg")) as database:
        for table, vague in (
            ("heatmap", heat.uncertain()),
            ("occupancy_by_interval", by_interval),
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
            visible = f"SELECT coverage IS NOT NULL AND ({rule}) FROM {table}"  # noqa: S608
            assert [bool(row[0]) for row in database.execute(visible)] == vague.tolist()


def test_uncertain_is_what_is_as_wrong_as_it_is_high_or_hardly_seen():
    shares = CoverageShares(
        visible_s=np.array([0.0, 100, 100, 100, 100, 49]),
        covered_s=np.array([np.nan, 0, 0, 3, 10, 10]),
        coverage=np.array([np.nan, 0, 0, 0.03, 0.1, 0.2]),
        coverage_se=np.array([np.nan, 0.019, 0.02, 0.03, 0.09, 0.01]),
    )
    assert shares.uncertain(50.0).tolist() == [False, False, True, True, False, True]


def test_the_error_of_the_mean_adds_up_along_a_lane_but_not_across():
    shares = CoverageShares(*np.array([[10.0, 30.0], [1, 6], [0.1, 0.2], [0.04, 0.02]]))
    off_s = (10 * 0.04, 30 * 0.02)
    for tiles, lanes, whole_s in (
        (straight_tiles(2), 1, sum(off_s)),
        (lane_tiles(2), 2, np.hypot(*off_s)),
    ):
        assert len(lanes_of(tiles)) == lanes
        assert mean_coverage(tiles, shares) == pytest.approx((7 / 40, whole_s / 40))


def test_a_picture_names_site_zone_and_sources(tmp_path, written):
    labels = MapLabels(title="A", timezone="Europe/Berlin", sources=("simulated",))
    heat = replace(written[0], labels=labels)
    heat.write(tmp_path / "heat")
    assert read_heatmap(tmp_path / "heat").labels == labels
    about = Image.open(tmp_path / "heat" / "heatmap.png").text
    assert (about["Title"], about["Source"]) == ("A, Coverage heat map", "simulated")
    assert about["Description"] == (
        "14 November 2023, 23:14:57 to 23:15:17 (Europe/Berlin, UTC+01:00)"
    )
    with pytest.raises(gr.UsageError, match="no time zone"):
        MapLabels(timezone="Europe/Bayern")


def test_it_is_read_back_equal(written):
    heat, folder = written
    read = read_heatmap(folder)
    for i in [None, *range(len(heat.timeline)), slice(1, 3)]:
        for one, other in zip(read.coverage_shares(i), heat.coverage_shares(i), strict=True):
            np.testing.assert_array_equal(one, other)
    assert read.figures() == heat.figures()


def test_the_command_adds_coverage_of_all_folders(tmp_path):
    """Two folders of vehicles, one after the other, beside one occupancy."""
    tiles = straight_tiles(30)
    gr.write_tiles(tiles, tmp_path / "tiles.gpkg", problems=tiles[:0][["lanelet_id", "geometry"]])
    for name, first in (("a", FIRST), ("b", FIRST + 40)):
        write(tmp_path / name, tiles, drive(0, first, np.arange(0, 10, 0.25), speed=5.0))
    source = {"recording": "a", "sensor": "R1", "poses": [WHOLE_POSE]}
    occupancy_in(tiles, range(FIRST, FIRST + 100), sources=[source]).write(tmp_path / "occ")
    words = ["heatmap", "occ", "--tiles", "tiles.gpkg", "-o", "map", "--interval", "1s"]
    words = [str(tmp_path / each) if (tmp_path / each).exists() else each for each in words]
    words[words.index("map")] = str(tmp_path / "map")
    for name in ("a", "b"):
        words += ["--vehicles", str(tmp_path / name)]
    done = CliRunner().invoke(group, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    heat = gr.read_heatmap(tmp_path / "map")
    assert heat.whole.end[0] - heat.whole.begin[0] == 80  # what both hold
    known = heat.coverage_shares()
    assert known.covered_s[0] == pytest.approx(2 * 0.05 * 19)  # 0.25 to 4.75 m
    assert known.visible_s[0] == pytest.approx(4.0)
    with pytest.raises(InputError, match="have steps in common"):
        CliRunner().invoke(group, [*words, *words[-2:]], catch_exceptions=False)
