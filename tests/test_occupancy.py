import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Point, prepare
from sites import EAST, NORTH, START, crossing, lane_quads, pose, recording, table, tiles_of

from gis_radar.errors import CrsError, InputError, NoAnswerError, UsageError
from gis_radar.occupancy import (
    Filters,
    OccupancySettings,
    measure_occupancy,
    merge_occupancies,
    read_occupancy,
)
from gis_radar.occupancy.hits import merge_rows
from gis_radar.occupancy.views import name_of_view, standing_for
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import View
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Recording
from gis_radar.sight import SightTiles, find_sight
from gis_radar.steps import step_of
from gis_radar.tiles.lookup import TileTree
from gis_radar.tiles.tiles import fingerprint

FIRST_STEP = int(START * 20)


def pairs_of(occupancy):
    pieces = list(occupancy.hits())
    return [
        (int(step), int(tile))
        for steps, tiles in pieces
        for step, tile in zip(steps, tiles, strict=True)
    ]


def steps_of(table):
    return {
        (row.sensor, step)
        for row in table.itertuples()
        for step in range(row.first_step, row.last_step + 1)
    }


def traffic(rng, frames=60, cycle_s=0.05, late_s=0.0):
    """Times and sensor-frame points of detections around the crossing; some frames are empty."""
    time, points = [], []
    for frame in range(frames):
        count = int(rng.integers(0, 12))
        at = START + late_s + frame * cycle_s
        found = np.column_stack(
            [rng.uniform(5, 35, count), rng.uniform(-14, 14, count), rng.uniform(-5, -2, count)]
        )
        found = found if count else np.full((1, 3), np.nan)
        time += [at] * len(found)
        points.append(found)
    return np.array(time), np.concatenate(points)


def test_pairs_are_those_of_a_plain_loop(tmp_path):
    rng = np.random.default_rng(5)
    tiles, looks = crossing(), pose(yaw=4.0, pitch=2.0, roll=-1.0)
    time, points = traffic(rng)
    path = recording(tmp_path / "r.parquet", time, points)
    occupancy = measure_occupancy([path], [looks], tiles, tmp_path / "occ")
    stored = np.asarray(np.float32(points), dtype=float)
    expected = set()
    for shape in tiles.geometry:
        prepare(shape)
    for at, point in zip(time, stored, strict=True):
        if np.isnan(point[0]):
            continue
        east, north, _ = looks.to_map(point[None])[0]
        for tile_id, shape in zip(tiles["tile_id"], tiles.geometry, strict=True):
            if shape.contains(Point(east, north)):
                expected.add((int(step_of(np.array([at]))[0]), tile_id))
    assert len(expected) > 50
    assert pairs_of(occupancy) == sorted(expected)
    assert steps_of(occupancy.frames) == {("R1", FIRST_STEP + k) for k in range(60)}


def test_the_paper_engine_gives_the_same_folder(tmp_path):
    path = recording(tmp_path / "r.parquet", *traffic(np.random.default_rng(1)))
    for name, options in (("grid", {}), ("rtree", {"engine": TileTree})):
        measure_occupancy([path], [pose()], crossing(), tmp_path / name, **options)
    for file in ("hits_by_sensor.parquet", "frames.parquet", "views.parquet", "manifest.json"):
        assert (tmp_path / "grid" / file).read_bytes() == (tmp_path / "rtree" / file).read_bytes()


def pieces_of(folder, time, points, cuts):
    """Split a recording by frames into files."""
    frame = np.unique(time, return_inverse=True)[1]
    edges = [0, *sorted(cuts), frame.max() + 1]
    for low, high in pairwise(edges):
        keep = (frame >= low) & (frame < high)
        if keep.any():
            yield recording(folder / f"{low}-{high}.parquet", time[keep], points[keep])


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 999), cuts=st.sets(st.integers(1, 39), max_size=3), data=st.data())
def test_merging_is_exact(tmp_path_factory, seed, cuts, data):
    """Any split, any order, any repetition gives the files of the unsplit recordings."""
    folder = tmp_path_factory.mktemp("merge")
    rng = np.random.default_rng(seed)
    tiles = crossing()
    poses = [pose(), pose(sensor="R2", easting=EAST + 20, northing=NORTH - 20, yaw=90.0)]
    records = [traffic(rng, 40), traffic(rng, 40, cycle_s=0.057, late_s=0.02)]
    whole = [recording(folder / f"{i}.parquet", *r) for i, r in enumerate(records)]
    measure_occupancy(whole, poses, tiles, folder / "whole")
    parts = []
    for number, (looks, record) in enumerate(zip(poses, records, strict=True)):
        (folder / str(number)).mkdir()
        for path in pieces_of(folder / str(number), *record, cuts):
            out = folder / f"occ-{number}-{path.stem}"
            parts.append(measure_occupancy([path], [looks], tiles, out))
    order = data.draw(st.permutations(range(len(parts))))
    again = data.draw(st.lists(st.sampled_from(order), max_size=2))
    merge_occupancies([parts[i] for i in [*order, *again]]).write(folder / "merged")
    for file in ("hits_by_sensor.parquet", "frames.parquet", "views.parquet"):
        assert (folder / "merged" / file).read_bytes() == (folder / "whole" / file).read_bytes()


@settings(deadline=None)
@given(
    streams=st.lists(
        st.lists(st.tuples(st.integers(0, 30), st.integers(0, 4)), max_size=30), max_size=4
    ),
    size=st.integers(1, 7),
)
def test_merged_streams_hold_each_pair_once(streams, size):
    def pieces(pairs):
        pairs = sorted(pairs, key=lambda pair: pair[0])
        for begin in range(0, len(pairs), size):
            part = np.array(pairs[begin : begin + size], dtype=np.int64)
            yield part[:, 0], part[:, 1]

    merged = list(merge_rows([pieces(pairs) for pairs in streams], 2))
    flat = [
        pair for step, tile in merged for pair in zip(step.tolist(), tile.tolist(), strict=True)
    ]
    assert flat == sorted({pair for pairs in streams for pair in pairs})
    borders = [(one[0][-1], other[0][0]) for one, other in pairwise(merged)]
    assert all(before < after for before, after in borders), "no step is split"


def test_tiles_seen_follow_the_view(tmp_path):
    tiles = crossing()
    narrow = pose(view=View(azimuth_deg=20, elevation_deg=90, max_range_m=25))
    path = recording(tmp_path / "r.parquet", [START], [[10.0, 0.0, -5.0]])
    seen = measure_occupancy([path], [narrow], tiles, tmp_path / "occ").views
    centres = tiles.geometry.centroid
    offset = np.hypot(centres.x - EAST, centres.y - NORTH)
    angle = np.degrees(np.arctan2(centres.y - NORTH, centres.x - EAST))
    expected = tiles["tile_id"][(np.hypot(offset, 5.0) <= 25) & (np.abs(angle) <= 10)]
    assert 10 < len(expected) < len(tiles)
    assert seen["tile_id"].tolist() == expected.tolist()
    assert set(seen["first_step"]) == set(seen["last_step"]) == {FIRST_STEP}


def test_a_low_road_leaves_the_view_where_its_height_is_known(tmp_path):
    """20 deg of elevation reach down 10 deg: 4.4 m below from 25 m on."""
    path = recording(tmp_path / "r.parquet", [START], [[10.0, 0.0, -5.0]])
    flat = pose(view=View(elevation_deg=20, max_range_m=100))
    known = measure_occupancy([path], [flat], crossing(370.0), tmp_path / "a").views
    unknown = measure_occupancy([path], [flat], crossing(np.nan), tmp_path / "b").views
    centres = crossing().geometry.centroid.iloc[known["tile_id"]]
    assert np.hypot(centres.x - EAST, centres.y - NORTH).min() > 4.4 / np.tan(np.radians(10.0))
    assert len(unknown) > len(known) > 0


def test_a_pose_that_moves_changes_view_and_place(tmp_path):
    tiles = crossing()
    track = PoseTrack(
        poses=(
            pose(view=View(max_range_m=25.0)),
            pose(easting=EAST + 2, view=View(max_range_m=25.0)),
        ),
        since=np.array([START, START + 0.5]),
    )
    time = START + np.arange(20) * 0.05
    path = recording(tmp_path / "r.parquet", time, np.tile([12.25, 0.0, -5.0], (20, 1)))
    occupancy = measure_occupancy([path], [track], tiles, tmp_path / "occ")
    assert [tile for _, tile in pairs_of(occupancy)] == [4] * 10 + [8] * 10
    held = occupancy.views.groupby("view")[["first_step", "last_step"]].agg(["min", "max"])
    spans = sorted(held.to_numpy().tolist())
    assert spans == [
        [FIRST_STEP, FIRST_STEP, FIRST_STEP + 9, FIRST_STEP + 9],
        [FIRST_STEP + 10, FIRST_STEP + 10, FIRST_STEP + 19, FIRST_STEP + 19],
    ]
    assert occupancy.frames["view"].nunique() == 2


def corrected(corrections, *, moved=(), **fields):
    """A track with a pose each 5 s that is a little off the first one."""
    rng = np.random.default_rng(7)
    off = rng.normal(0.0, 0.02, (corrections, 6)).round(6)
    poses = tuple(
        pose(
            easting=EAST + e + 2.0 * sum(index >= at for at in moved),
            northing=NORTH + n, height=375.0 + h, yaw=y, pitch=p, roll=r,
            evidence={"event": "moved"} if index in moved else {}, **fields,
        )
        for index, (e, n, h, y, p, r) in enumerate(off)
    )  # fmt: skip
    return PoseTrack(poses=poses, since=START + 5.0 * np.arange(corrections))


def test_tiny_corrections_share_a_view_and_a_move_makes_a_new_one(tmp_path):
    view = View(max_range_m=float(np.hypot(20.25, 5.0)))  # ends in the middle of a tile
    time = START + np.arange(5000)
    path = recording(tmp_path / "r.parquet", time, np.tile([12.25, 0.0, -5.0], (5000, 1)))
    road = SightTiles.of(crossing())
    seeing = corrected(1000, view=view).poses
    exact = {name_of_view(find_sight(each, road).seen) for each in seeing}
    assert len(exact) > 1  # or the test could not fail
    for moved, views in (((), 1), ((500,), 2)):
        track = corrected(1000, moved=moved, view=view)
        found = measure_occupancy([path], [track], crossing(), tmp_path / f"occ{len(moved)}")
        assert found.frames["view"].nunique() == views
        assert len(found.frames) == 5000  # a frame a second touches no other's step
    late = found.frames.sort_values("first_step")["view"].to_numpy()
    assert set(late[:2500]) & set(late[2500:]) == set()


def test_a_pose_shares_a_view_with_near_ones_only():
    def track(*places, **fields):
        return [pose(easting=EAST + place, **fields) for place in places]

    moved = pose(evidence={"event": "moved"})
    assert standing_for(track(0.0, 0.15, 0.3, 0.1, 0.4, -0.1)).tolist() == [0, 0, 2, 2, 2, 0]
    assert standing_for([*track(0.0, 0.0), moved, *track(0.0)]).tolist() == [0, 0, 2, 2]
    turned = [pose(yaw=10.0), pose(yaw=10.15), pose(yaw=10.25), pose(yaw=10.25, pitch=0.15)]
    assert standing_for(turned).tolist() == [0, 0, 2, 2]
    assert standing_for([pose(), pose(view=View(max_range_m=9.0))]).tolist() == [0, 1]


def test_merging_is_exact_with_a_track(tmp_path):
    """Views follow from the track, whatever part of the time a recording shows."""
    rng = np.random.default_rng(3)
    base = corrected(40, view=View(max_range_m=25.0), moved=(20,))
    walk = np.cumsum(rng.normal(0.0, 0.3, 40))
    poses = tuple(
        replace(each, easting=each.easting + w) for each, w in zip(base.poses, walk, strict=True)
    )
    track = PoseTrack(poses=poses, since=START + 0.05 * np.arange(40))
    record = traffic(rng, 40)
    whole = recording(tmp_path / "whole.parquet", *record)
    views = measure_occupancy([whole], [track], crossing(), tmp_path / "whole").views
    assert 3 < views["view"].nunique() < 40
    parts = [
        measure_occupancy([path], [track], crossing(), tmp_path / f"occ-{path.stem}")
        for path in pieces_of(tmp_path, *record, [7, 21, 33])
    ]
    merge_occupancies(parts[::-1]).write(tmp_path / "merged")
    for file in ("hits_by_sensor.parquet", "frames.parquet", "views.parquet"):
        same = (tmp_path / "merged" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()
        assert same, file
    met = [len(each["poses"]) for part in parts for each in part.sources]
    assert met == [7, 14, 12, 7]  # those that a recording met


def bridge():
    """A road at 370 m and a bridge over it at 376 m."""
    return tiles_of(
        [lane_quads(EAST + 10, NORTH, 0.0), lane_quads(EAST + 20, NORTH - 10, 90.0)],
        height_m=[370.0, 376.0],
    )


def hits_at(tmp_path, height_m, filters, *, range_m=None, tiles=None, **columns):
    x = 20.25 if range_m is None else range_m
    path = recording(tmp_path / "r.parquet", [START], [[x, 0.25, height_m - 375.0]], **columns)
    occupancy = measure_occupancy(
        [path], [pose()], bridge() if tiles is None else tiles, tmp_path / "occ", filters=filters
    )
    return {tile // 40 for _, tile in pairs_of(occupancy)}


@pytest.mark.parametrize(
    ("height_m", "levels"), [(370.6, {0}), (376.8, {1}), (374.6, {0}), (400.0, set())]
)
def test_clearance_chooses_the_level(tmp_path, height_m, levels):
    assert hits_at(tmp_path, height_m, Filters(clearance=(0.0, 4.5))) == levels
    assert hits_at(tmp_path, height_m, Filters()) == {0, 1}


def test_clearance_widens_with_range(tmp_path):
    far = tiles_of([lane_quads(EAST + 90, NORTH, 0.0)], height_m=370.0)
    near = tiles_of([lane_quads(EAST + 9, NORTH, 0.0)], height_m=370.0)
    low = 370.0 - 1.0
    for site, range_m, expected in ((near, 12.0, set()), (far, 95.0, {0})):
        for sharp in (False, True):
            filters = Filters(clearance=(0.0, 4.5), elevation_error_deg=0.0 if sharp else 0.5)
            found = hits_at(tmp_path, low, filters, range_m=range_m, tiles=site)
            assert found == (set() if sharp else expected)


@pytest.mark.parametrize(
    ("filters", "kept"),
    [
        (Filters(), True),
        (Filters(min_speed=0.15), False),
        (Filters(min_speed=0.1), True),
        (Filters(min_rcs=6.0), False),
        (Filters(min_rcs=5.0), True),
    ],
)
def test_doppler_and_cross_section(tmp_path, filters, kept):
    found = hits_at(tmp_path, 370.5, filters, range_rate=-0.12, rcs=5.0)
    assert bool(found) is kept


def test_clearance_needs_heights(tmp_path):
    with pytest.raises(InputError, match="no road heights"):
        hits_at(tmp_path, 370.5, Filters(clearance=(0, 4)), tiles=crossing(np.nan))
    assert not (tmp_path / "occ").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_speed": -1.0},
        {"min_rcs": np.nan},
        {"clearance": (4.0, 0.0)},
        {"elevation_error_deg": 90.0},
    ],
)
def test_filters_that_make_no_sense(wrong):
    with pytest.raises(UsageError):
        Filters(**wrong)


def test_poses_must_match_recordings_and_tiles(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [[10.0, 0.0, -5.0]])
    with pytest.raises(UsageError, match="1 recordings, but 2 poses"):
        measure_occupancy([path], [pose(), pose()], crossing(), tmp_path / "occ")
    with pytest.raises(CrsError, match="EPSG:32632"):
        measure_occupancy([path], [pose(crs="EPSG:32632")], crossing(), tmp_path / "occ")
    assert not (tmp_path / "occ").exists()


def test_folders_of_other_tiles_do_not_merge(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [[10.0, 0.0, -5.0]])
    one = measure_occupancy([path], [pose()], crossing(), tmp_path / "a")
    elsewhere = tiles_of([lane_quads(EAST + 5, NORTH, 0.0)], height_m=370.0)
    other = measure_occupancy([path], [pose()], elsewhere, tmp_path / "b")
    with pytest.raises(InputError, match="different tiles"):
        merge_occupancies([one, other])


def test_a_fingerprint_knows_vertices_ids_and_crs():
    tiles = crossing()
    moved = tiles.assign(geometry=tiles.geometry.translate(1e-6))
    renamed = tiles.assign(lanelet_id=tiles["lanelet_id"] + 1)
    other_crs = tiles.set_crs("EPSG:32632", allow_override=True)
    marks = {fingerprint(site) for site in (tiles, moved, renamed, other_crs)}
    assert len(marks) == 4
    assert fingerprint(tiles.assign(height_m=1.0)) == fingerprint(tiles)


@pytest.mark.parametrize(
    "name", ["hits_by_sensor.parquet", "frames.parquet", "views.parquet", "manifest.json"]
)
@pytest.mark.parametrize("damage", ["gone", "cut"])
def test_a_damaged_folder_is_refused(tmp_path, name, damage):
    path = recording(tmp_path / "r.parquet", [START], [[10.0, 0.0, -5.0]])
    measure_occupancy([path], [pose()], crossing(), tmp_path / "occ")
    victim = tmp_path / "occ" / name
    data = victim.read_bytes()
    victim.unlink()
    if damage == "cut":
        victim.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=f"occ.*{name}"):
        read_occupancy(tmp_path / "occ")


def made(tmp_path, name="occ", **changes):
    path = recording(tmp_path / "r.parquet", [START, START + 0.05], [[12.25, 0.0, -5.0]] * 2)
    return measure_occupancy([path], [pose(**changes)], crossing(), tmp_path / name)


def test_a_table_of_other_tiles_is_refused(tmp_path):
    made(tmp_path)
    path = recording(tmp_path / "r.parquet", [START], [[12.25, 0.0, -5.0]])
    elsewhere = tiles_of([lane_quads(EAST + 5, NORTH, 0.0)], height_m=370.0)
    measure_occupancy([path], [pose()], elsewhere, tmp_path / "other")
    for name in ("hits_by_sensor", "frames", "views"):
        kept = (tmp_path / "occ" / f"{name}.parquet").read_bytes()
        other = (tmp_path / "other" / f"{name}.parquet").read_bytes()
        (tmp_path / "occ" / f"{name}.parquet").write_bytes(other)
        with pytest.raises(InputError, match=rf"{name}\.parquet: was made from tiles"):
            read_occupancy(tmp_path / "occ")
        (tmp_path / "occ" / f"{name}.parquet").write_bytes(kept)
    read_occupancy(tmp_path / "occ")


def test_a_sensor_that_sees_nothing_is_warned_of_and_merges(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [[12.25, 0.0, -5.0]])
    far = pose(sensor="R2", easting=EAST + 5000)
    notes = Notes()
    both = measure_occupancy(
        [path, path], [pose(), far], crossing(), tmp_path / "both", reporter=notes
    )
    assert any("R2" in line and "no tile" in line for _, line in notes.lines)
    again = merge_occupancies([both, both])
    assert set(again.frames["sensor"]) == {"R1", "R2"}
    assert set(again.views["sensor"]) == {"R1"}
    with pytest.raises(NoAnswerError, match="no tile lies in the view of R2"):
        measure_occupancy([path], [far], crossing(), tmp_path / "blind")
    assert not (tmp_path / "blind").exists()


def test_a_folder_without_names_of_views_is_read(tmp_path):
    """Other programs may write just the columns that everybody knows."""
    whole = made(tmp_path)
    for name in ("frames", "views"):
        path = tmp_path / "occ" / f"{name}.parquet"
        pd.read_parquet(path).drop(columns="view").to_parquet(path)
    again = read_occupancy(tmp_path / "occ")
    pd.testing.assert_frame_equal(again.frames[whole.frames.columns], whole.frames)
    pd.testing.assert_frame_equal(again.views, whole.views)


@pytest.mark.parametrize("text", ["[]", "{}", "null", '{"fingerprint": "x"}', "{"])
def test_a_broken_manifest_is_refused(tmp_path, text):
    made(tmp_path)
    (tmp_path / "occ" / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json"):
        read_occupancy(tmp_path / "occ")


@pytest.mark.parametrize(
    ("name", "column"), [("hits_by_sensor", "step"), ("frames", "last_step"), ("views", "tile_id")]
)
def test_a_table_without_its_columns_is_refused(tmp_path, name, column):
    made(tmp_path)
    path = tmp_path / "occ" / f"{name}.parquet"
    pd.read_parquet(path).drop(columns=column).to_parquet(path)
    with pytest.raises(InputError, match=rf"{name}\.parquet: lacks the column {column}"):
        read_occupancy(tmp_path / "occ")


def test_hits_that_are_damaged_or_unsorted_are_refused(tmp_path):
    path = tmp_path / "occ" / "hits_by_sensor.parquet"
    source = recording(tmp_path / "t.parquet", *traffic(np.random.default_rng(3), frames=900))
    measure_occupancy([source], [pose()], crossing(), tmp_path / "occ")
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 255
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"hits_by_sensor\.parquet: damaged"):
        list(read_occupancy(tmp_path / "occ").hits())
    made(tmp_path)
    pd.read_parquet(path).iloc[::-1].to_parquet(path)
    with pytest.raises(InputError, match="do not ascend"):
        list(read_occupancy(tmp_path / "occ").hits())


def test_settings_take_effect_and_stand_in_the_manifest(tmp_path):
    """Folders of other settings, or from before settings were written, are read and merge."""
    one = made(tmp_path)
    (source,) = one.sources
    assert source["settings"]["moving_mps"] == 0.5
    assert source["filters"]["levels_apart_m"] == 2.5
    time = START + 0.05 * np.arange(3)
    track = PoseTrack(poses=tuple(pose(easting=EAST + 0.3 * k) for k in range(3)), since=time)
    path = recording(tmp_path / "t.parquet", time, [[12.25, 0.0, -5.0]] * 3, range_rate=0.4)
    shared = OccupancySettings(view_shared_m=5.0, moving_mps=0.3)
    other = measure_occupancy([path], [track], crossing(), tmp_path / "b", settings=shared)
    assert len(set(other.frames["view"])) == 1
    assert pd.read_parquet(tmp_path / "b" / "deliveries.parquet")["moving"].tolist() == [1, 1, 1]
    manifest = json.loads((tmp_path / "b" / "manifest.json").read_text())
    assert manifest["sources"][0]["settings"]["view_shared_m"] == 5.0
    del manifest["sources"][0]["settings"]
    (tmp_path / "b" / "manifest.json").write_text(json.dumps(manifest))
    merged = merge_occupancies([one, read_occupancy(tmp_path / "b")]).write(tmp_path / "merged")
    assert [("settings" in each) for each in read_occupancy(merged).sources].count(True) == 1


def test_an_interruption_leaves_nothing(tmp_path):
    def batches(_):
        yield table([START], [[10.0, 0.0, -5.0]]).to_batches()[0]
        raise KeyboardInterrupt

    broken = Recording(path=tmp_path / "r.parquet", rows=None, batches=batches)
    with pytest.raises(KeyboardInterrupt):
        measure_occupancy([broken], [pose()], crossing(), tmp_path / "occ")
    assert list(tmp_path.iterdir()) == []


class Notes(Reporter):
    def __init__(self):
        self.lines = []

    def log(self, message, level="info"):
        self.lines.append((level, message))


def test_a_view_far_beyond_the_detections_is_warned_of(tmp_path):
    path = recording(tmp_path / "r.parquet", [START] * 3, [[10.0, 0.0, -5.0]] * 3)
    for reach, lines in ((100.0, 1), (12.0, 0)):
        notes = Notes()
        seeing = replace(pose(), view=View(max_range_m=reach, elevation_deg=90.0))
        measure_occupancy([path], [seeing], crossing(), tmp_path / "occ", reporter=notes)
        levels = [level for level, _ in notes.lines]
        assert levels == ["info", *["warning"] * lines]  # sight: view only
    assert json.loads((tmp_path / "occ" / "manifest.json").read_text())["sources"][0]["rows"] == 3


def test_recordings_of_a_sensor_that_overlap_are_named_and_count_once(tmp_path):
    times = START + 0.05 * np.arange(60)
    points = [[10.0, 0.0, -5.0]] * 60
    whole = recording(tmp_path / "whole.parquet", times, points)
    first = recording(tmp_path / "first.parquet", times[:40], points[:40])
    second = recording(tmp_path / "second.parquet", times[20:], points[20:])
    after = recording(tmp_path / "after.parquet", times[40:], points[40:])
    near = replace(pose(), view=View(max_range_m=12.0, elevation_deg=90.0))
    found, warned = [], []
    for name, paths in (("a", [whole]), ("b", [second, first]), ("c", [first, after])):
        notes = Notes()
        found.append(measure_occupancy(
            paths, [near] * len(paths), crossing(), tmp_path / name, reporter=notes
        ))  # fmt: skip
        warned.append([text for level, text in notes.lines if level == "warning"])
    told = "R1: first.parquet and second.parquet overlap in time: what both hold counts once"
    assert warned == [[], [told], []]
    assert pairs_of(found[0]) == pairs_of(found[1]) == pairs_of(found[2]) != set()


def test_tables_have_the_columns_of_their_contract(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [[12.25, 0.0, -5.0]])
    measure_occupancy([path], [pose()], crossing(), tmp_path / "occ", pairs=True)
    hits = pd.read_parquet(tmp_path / "occ" / "hits.parquet")
    frames = pd.read_parquet(tmp_path / "occ" / "frames.parquet")
    views = pd.read_parquet(tmp_path / "occ" / "views.parquet")
    assert hits.dtypes.to_dict() == {"step": np.dtype("int64"), "tile_id": np.dtype("int64")}
    assert {"sensor", "first_step", "last_step"} <= set(frames.columns)
    assert {"sensor", "tile_id"} <= set(views.columns)
    assert hits.to_numpy().tolist() == [[FIRST_STEP, 4]]
