"""Several sensors on one grid of steps: overlaps, frame log, exact merging."""

import json

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import SHARED
from sites import EAST, NORTH, START, crossing, pose, recording
from test_holding import covers
from test_occupancy import Notes, pairs_of, pieces_of, steps_of, traffic

from gis_radar.clocks import SensorClock
from gis_radar.heatmap import make_heatmap
from gis_radar.lanelets import read_map
from gis_radar.occupancy import measure_occupancy, merge_occupancies
from gis_radar.occupancy.frame_log import COLUMNS
from gis_radar.poses.pose import View
from gis_radar.tiles.tiles import make_tiles

FIRST_STEP = int(START * 20)
FILES = ("hits_by_sensor.parquet", "frames.parquet", "views.parquet", "deliveries.parquet")
ON_TILE_4 = [12.25, 0.0, -5.0]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999), cuts=st.sets(st.integers(1, 39), max_size=3), data=st.data())
def test_merging_is_exact_with_cycles_and_clocks(tmp_path_factory, seed, cuts, data):
    """Any split between frames, any order, any repetition gives the same four files."""
    folder = tmp_path_factory.mktemp("merge")
    rng = np.random.default_rng(seed)
    tiles = crossing()
    poses = [pose(), pose(sensor="R2", easting=EAST + 20, northing=NORTH - 20, yaw=90.0)]
    records = [traffic(rng, 40), traffic(rng, 40, cycle_s=0.13, late_s=0.02)]
    options = {
        "cycles": {"R2": 0.13},
        "clocks": {"R1": SensorClock(offset_s=-0.31, drift_ppm=700.0, at=START)},
    }
    whole = [recording(folder / f"{i}.parquet", *r) for i, r in enumerate(records)]
    measure_occupancy(whole, poses, tiles, folder / "whole", **options)
    parts = []
    for number, (looks, record) in enumerate(zip(poses, records, strict=True)):
        (folder / str(number)).mkdir()
        mine = {
            name: {k: v for k, v in said.items() if k == looks.sensor}
            for name, said in options.items()
        }
        for path in pieces_of(folder / str(number), *record, cuts):
            out = folder / f"occ-{number}-{path.stem}"
            parts.append(measure_occupancy([path], [looks], tiles, out, **mine))
    order = data.draw(st.permutations(range(len(parts))))
    again = data.draw(st.lists(st.sampled_from(order), max_size=2))
    merge_occupancies([parts[i] for i in [*order, *again]]).write(folder / "merged")
    for file in FILES:
        assert (folder / "merged" / file).read_bytes() == (folder / "whole" / file).read_bytes()


@pytest.mark.parametrize("rows_at_once", [3, 50])
def test_pieces_never_split_a_frame(tmp_path, monkeypatch, rows_at_once):
    """However the file is cut on reading, hits and the frame log stay the same."""
    path = recording(tmp_path / "r.parquet", *traffic(np.random.default_rng(4), cycle_s=0.12))
    options = {"cycles": {"R1": 0.12}}
    measure_occupancy([path], [pose()], crossing(), tmp_path / "one", **options)
    monkeypatch.setattr("gis_radar.recordings.parquet_table.ROWS_AT_ONCE", rows_at_once)
    measure_occupancy([path], [pose()], crossing(), tmp_path / "many", **options)
    for file in FILES:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "many" / file).read_bytes()


def test_the_frame_log_has_a_row_a_frame(tmp_path):
    time = [START, START, START, START + 0.05, START + 0.1]
    nowhere = [np.nan] * 3
    points = [ON_TILE_4, ON_TILE_4, [12.25, 50.0, -5.0], nowhere, ON_TILE_4]
    rate = np.float32([0.4, -3.0, -104.0, np.nan, 0.5])
    path = recording(tmp_path / "r.parquet", time, points, range_rate=rate)
    clocks = {"R1": SensorClock(offset_s=0.5)}
    occupancy = measure_occupancy([path], [pose()], crossing(), tmp_path / "a", clocks=clocks)
    rows = pd.read_parquet(tmp_path / "a" / "deliveries.parquet")
    assert tuple(rows) == COLUMNS
    assert rows["time_us"].tolist() == [
        1_699_999_999_500_000, 1_699_999_999_550_000, 1_699_999_999_600_000,
    ]  # fmt: skip
    assert rows["detections"].tolist() == [3, 0, 1]
    assert rows["moving"].tolist() == [2, 0, 1]
    assert rows["wild"].tolist() == [1, 0, 0]
    assert rows["tiles_hit"].tolist() == [1, 0, 1]
    assert set(rows["tiles_seen"]) == {len(occupancy.views)}
    assert set(rows["shift_us"]) == {-500_000}
    assert [step for step, _ in pairs_of(occupancy)] == [FIRST_STEP - 10, FIRST_STEP - 8]


def test_folders_without_a_frame_log_still_merge(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [ON_TILE_4])
    one = measure_occupancy([path], [pose()], crossing(), tmp_path / "a")
    (tmp_path / "a" / "deliveries.parquet").unlink()
    merge_occupancies([one, one]).write(tmp_path / "b")
    assert pd.read_parquet(tmp_path / "b" / "deliveries.parquet").empty


@pytest.mark.parametrize("late_s", [3600.0, -1.7e9])
def test_clocks_that_cannot_be_right_are_warned_of(tmp_path, late_s):
    one = recording(tmp_path / "1.parquet", [START, START + 0.05], [ON_TILE_4] * 2)
    other = recording(tmp_path / "2.parquet", [START + late_s + 9], [ON_TILE_4])
    notes = Notes()
    poses = [pose(), pose(sensor="R2")]
    measure_occupancy([one, other], poses, crossing(), tmp_path / "a", reporter=notes)
    said = [line for _, line in notes.lines]
    assert any("R1 and R2 have no time in common" in line for line in said)
    assert any("since it was switched on" in line for line in said) is (late_s < 0)


@pytest.mark.skipif(not (SHARED / "town02").exists(), reason="shared data absent: town02")
def test_three_sensors_fused_are_the_union_of_the_single_ones(tmp_path):
    """The last one at 57 ms; occupied and observed counted from plain sets of pairs."""
    site = SHARED / "town02"
    tiles = make_tiles(read_map(site / "map.osm"))
    truth = json.loads((site / "truth.json").read_text())
    names = ("R1", "R2", "R3")
    fields = ("easting", "northing", "height", "yaw", "pitch", "roll")
    poses = [
        pose(sensor=name, view=View(max_range_m=200.0), **{f: truth[name][f] for f in fields})
        for name in names
    ]
    files = [_begin_of(site / f"{name}.parquet", tmp_path) for name in names]
    single = [
        measure_occupancy([path], [looks], tiles, tmp_path / looks.sensor)
        for path, looks in zip(files, poses, strict=True)
    ]
    fused = measure_occupancy(files, poses, tiles, tmp_path / "fused")
    assert set(pairs_of(fused)) == set().union(*(set(pairs_of(one)) for one in single))
    observed, hits, end = set(), set(), fused.frames["last_step"].max()
    for one in single:
        steps = {step for _, step in steps_of(one.frames)}
        held = {step: [s for s in covers(step, steps, 0.1) if s <= end] for step in steps}
        seen = set(one.views["tile_id"])
        observed |= {(s, tile) for step in steps for s in held[step] for tile in seen}
        hits |= {(s, tile) for step, tile in pairs_of(one) for s in held[step]}
    assert len(steps) < 180  # of 200: the last one lacks every eighth
    heat = make_heatmap(fused, tiles).wide().set_index("tile_id")
    for column, pairs in (("observed_s", observed), ("occupied_s", hits & observed)):
        expected = pd.Series(tile for _, tile in pairs).value_counts()
        counted = (heat[column].fillna(0) * 20).round().astype(int)
        assert counted[counted > 0].to_dict() == expected.to_dict()


def _begin_of(path, folder, seconds=10.0):
    table = pq.read_table(path, filters=[("time", "<", START + seconds)])
    pq.write_table(table, folder / path.name)
    return folder / path.name
