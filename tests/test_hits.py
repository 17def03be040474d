"""Hits: views, tracks, filters, and what does not fit, on tiles without a map."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from maps import Listener
from sites import EAST, NORTH, START, crossing, lane_quads, pose, recording, tiles_of

import gis_radar as gr
from gis_radar.base import CrsError, InputError, NoAnswerError, UsageError
from gis_radar.hdmap import fingerprint
from gis_radar.measures import Filters, sight_owners
from gis_radar.poses import PoseTrack, View
from gis_radar.scans import SightTiles, find_sight

FIRST_STEP = int(START * 20)


def hits_of(recordings, poses, tiles, folder, **options):
    """Measure hits alone, which need no map."""
    return gr.measure(
        recordings, poses, tiles, None, folder, hits_only=True, check=False, **options
    )


def steps_of(times):
    return (times.astype("datetime64[us, UTC]").astype("int64") // 50_000).tolist()


def pairs_of(ds):
    found = ds.hits()
    return list(zip(found["tile_id"].tolist(), steps_of(found["time"]), strict=True))


def test_tiles_seen_follow_the_view(tmp_path):
    tiles = crossing()
    narrow = pose(view=View(azimuth_deg=20, elevation_deg=90, max_range_m=25))
    path = recording(tmp_path / "r.parquet", [START], [[10.0, 0.0, -5.0]])
    ds = hits_of([path], [narrow], tiles, tmp_path / "site")
    centres = tiles.geometry.centroid
    offset = np.hypot(centres.x - EAST, centres.y - NORTH)
    angle = np.degrees(np.arctan2(centres.y - NORTH, centres.x - EAST))
    expected = tiles["tile_id"][(np.hypot(offset, 5.0) <= 25) & (np.abs(angle) <= 10)].tolist()
    assert 10 < len(expected) < len(tiles)
    assert ds.sights()["tile_id"].tolist() == expected
    runs = ds.observed()
    assert runs["tile_id"].tolist() == expected
    assert set(steps_of(runs["begin"])) == {FIRST_STEP}
    assert set(steps_of(runs["end"])) == {FIRST_STEP + 3}  # valid for 100 ms


def test_a_pose_that_moves_changes_view_and_place(tmp_path):
    near = View(max_range_m=25.0, elevation_deg=90.0)
    poses = (pose(view=near), pose(easting=EAST + 2, view=near))
    track = PoseTrack(poses=poses, since=np.array([START, START + 0.5]))
    time = START + np.arange(20) * 0.05
    path = recording(tmp_path / "r.parquet", time, np.tile([12.25, 0.0, -5.0], (20, 1)))
    ds = hits_of([path], [track], crossing(), tmp_path / "site")
    expected = [(4, FIRST_STEP + k) for k in range(10)]
    assert pairs_of(ds) == expected + [(8, FIRST_STEP + k) for k in range(10, 22)]
    frames, known = ds.frames(), ds.poses().set_index("pose")
    assert frames["pose"].nunique() == 2
    assert known.loc[frames["pose"], "easting"].tolist() == [EAST] * 10 + [EAST + 2] * 10
    assert set(ds.sights()["pose"]) == set(frames["pose"])


@pytest.mark.parametrize(("sigma", "told"), [(0.9, False), (5.6, True)])
def test_a_track_that_is_not_sure_of_its_pose_is_told(tmp_path, sigma, told):
    """A sensor that was knocked: what is measured until its pose is found again may be wrong."""
    sure, unsure = ({"sigma": {"easting": 0.1, "northing": 0.1, "yaw": s}} for s in (0.1, sigma))
    poses = tuple(pose(evidence=each) for each in (sure, unsure, unsure, sure))
    track = PoseTrack(poses=poses, since=START + np.array([0.0, 10.0, 50.0, 80.0]))
    time = START + np.arange(2000) * 0.05
    path = recording(tmp_path / "r.parquet", time, np.tile([12.25, 0.0, -5.0], (2000, 1)))
    notes = Listener()
    hits_of([path], [track], crossing(), tmp_path / "site", reporter=notes)
    line = "R1: from 2023-11-14T22:13:30Z to 2023-11-14T22:14:40Z its pose track is uncertain by"
    assert any(line in text for _, text in notes.messages) == told
    assert len([*track.warn_uncertain(START, START + 60.0)]) == 0  # less than a minute of it


@pytest.mark.parametrize(
    ("later_s", "named"), [(-86_400.0, 1), (0.0, 0), (60.0, 0), (7200.0, 1), (86_400.0, 1)]
)
def test_a_pose_track_of_another_time_is_named(later_s, named):
    track = PoseTrack(poses=(pose(), pose()), since=np.array([START, START + 5.0]))
    said = [*track.warn_uncertain(START + later_s, START + later_s + 10.0)]
    assert len(said) == named
    assert all("is it the track of another day" in each for each in said)
    always = PoseTrack(poses=(pose(),), since=np.array([-np.inf]))
    assert not [*always.warn_uncertain(START + later_s, START + later_s + 10.0)]


@pytest.mark.parametrize("rows", [1, 2])
def test_a_pose_that_holds_until_it_is_changed_by_hand_is_of_no_other_time(rows):
    since = START + 30.0 * 86_400.0 * np.arange(rows)
    track = PoseTrack(poses=(pose(),) * rows, since=since)
    later = since[-1] + 86_400.0
    assert not [*track.warn_uncertain(later, later + 10.0)]


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
    exact = {find_sight(each, road).seen.tobytes() for each in seeing}
    assert len(exact) > 1  # or the test could not fail
    for moved, sights in (((), 1), ((500,), 2)):
        track = corrected(1000, moved=moved, view=view)
        ds = hits_of([path], [track], crossing(), tmp_path / f"site{len(moved)}")
        frames = ds.frames()
        assert frames["pose"].nunique() == sights
        assert frames["pose_in_force"].nunique() == len(ds.poses()) == 1000
        assert len(frames) == 5000
    late = frames["pose"].to_numpy()
    assert set(late[:2500]) & set(late[2500:]) == set()


def test_frames_name_the_pose_in_force_and_join_to_what_it_sees(tmp_path):
    track = corrected(4, view=View(max_range_m=25.0))
    time = START + np.arange(20)
    path = recording(tmp_path / "r.parquet", time, np.tile([12.25, 0.0, -5.0], (20, 1)))
    ds = hits_of([path], [track], crossing(), tmp_path / "site")
    frames, poses = ds.frames(), ds.poses().set_index("pose")
    assert frames["pose"].nunique() == 1
    placed = poses.loc[frames["pose_in_force"], "easting"]
    assert placed.tolist() == [p.easting for p in track.poses for _ in range(5)]
    assert poses.loc[frames["pose_in_force"], "sight"].tolist() == frames["pose"].tolist()
    in_sight = ds.sights()["pose"].value_counts()
    assert in_sight.loc[frames["pose"]].tolist() == frames["tiles_seen"].tolist()


def test_a_pose_shares_a_view_with_near_ones_only():
    def track(*places, **fields):
        return [pose(easting=EAST + place, **fields) for place in places]

    moved = pose(evidence={"event": "moved"})
    assert sight_owners(track(0.0, 0.15, 0.3, 0.1, 0.4, -0.1)).tolist() == [0, 0, 2, 2, 2, 0]
    assert sight_owners([*track(0.0, 0.0), moved, *track(0.0)]).tolist() == [0, 0, 2, 2]
    turned = [pose(yaw=10.0), pose(yaw=10.15), pose(yaw=10.25), pose(yaw=10.25, pitch=0.15)]
    assert sight_owners(turned).tolist() == [0, 0, 2, 2]
    assert sight_owners([pose(), pose(view=View(max_range_m=9.0))]).tolist() == [0, 1]


def test_a_track_gives_the_same_hour_to_parts_of_a_recording(tmp_path):
    """Views follow from the track, whatever part of the time a recording shows."""
    rng = np.random.default_rng(3)
    base = corrected(40, view=View(max_range_m=25.0), moved=(20,))
    walk = np.cumsum(rng.normal(0.0, 0.3, 40))
    poses = tuple(
        replace(each, easting=each.easting + w) for each, w in zip(base.poses, walk, strict=True)
    )
    track = PoseTrack(poses=poses, since=START + 0.05 * np.arange(40))
    time = np.repeat(START + 0.05 * np.arange(40), 5)
    points = np.column_stack([rng.uniform(5, 35, 200), rng.uniform(-14, 14, 200), [-4.0] * 200])
    cuts = [0, 35, 105, 165, 200]  # between frames
    paths = [
        recording(tmp_path / f"{low}.parquet", time[low:high], points[low:high])
        for low, high in pairwise(cuts)
    ]
    whole = recording(tmp_path / "whole.parquet", time, points)
    one = hits_of([whole], [track], crossing(), tmp_path / "a")
    other = hits_of(paths, [track] * 4, crossing(), tmp_path / "b")
    assert one.frames()["pose_in_force"].nunique() == 40
    assert 3 < one.frames()["pose"].nunique() < 40
    for path in (tmp_path / "a").rglob("*.parquet"):
        if path.name != "recordings.parquet":
            assert (
                path.read_bytes()
                == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()
            ), path.name
    assert len(other.recordings()) == 4


def bridge():
    """A road at 370 m and a bridge over it at 376 m."""
    return tiles_of(
        [lane_quads(EAST + 10, NORTH, 0.0), lane_quads(EAST + 20, NORTH - 10, 90.0)],
        height_m=[370.0, 376.0],
    )


def hits_at(folder, height_m, filters, *, range_m=None, tiles=None, **columns):
    x = 20.25 if range_m is None else range_m
    folder.mkdir(exist_ok=True)
    path = recording(folder / "r.parquet", [START], [[x, 0.25, height_m - 375.0]], **columns)
    site = bridge() if tiles is None else tiles
    ds = hits_of([path], [pose()], site, folder / "site", filters=filters)
    return {tile // 40 for tile, _ in pairs_of(ds)}


@pytest.mark.parametrize(
    ("height_m", "levels"), [(370.6, {0}), (376.8, {1}), (374.6, {0}), (394.0, set())]
)
def test_clearance_chooses_the_level(tmp_path, height_m, levels):
    assert hits_at(tmp_path / "a", height_m, Filters(clearance=(0.0, 4.5))) == levels
    assert hits_at(tmp_path / "b", height_m, Filters()) == {0, 1}


@pytest.mark.parametrize(
    ("view", "levels"),
    [
        ({}, {0, 1}),
        ({"max_range_m": 20.0}, set()),
        ({"min_range_m": 21.0}, set()),
        ({"azimuth_deg": 1.0}, set()),
        ({"elevation_deg": 20.0}, set()),
    ],
)
def test_what_is_outside_the_view_of_its_sensor_hits_nothing(tmp_path, view, levels):
    """Also where another sensor observes the tile, on which it would count."""
    path = recording(tmp_path / "r.parquet", [START], [[20.25, 0.25, -4.4]])
    seeing = pose(view=View(**{"max_range_m": 100.0, "elevation_deg": 90.0} | view))
    ds = hits_of([path], [seeing], bridge(), tmp_path / "site")
    assert {tile // 40 for tile, _ in pairs_of(ds)} == levels


def test_clearance_widens_with_range(tmp_path):
    far = tiles_of([lane_quads(EAST + 90, NORTH, 0.0)], height_m=370.0)
    near = tiles_of([lane_quads(EAST + 9, NORTH, 0.0)], height_m=370.0)
    low = 370.0 - 1.0
    for site, range_m, expected in ((near, 12.0, set()), (far, 95.0, {0})):
        for sharp in (False, True):
            filters = Filters(clearance=(0.0, 4.5), elevation_error_deg=0.0 if sharp else 0.5)
            place = tmp_path / f"{range_m}-{sharp}"
            found = hits_at(place, low, filters, range_m=range_m, tiles=site)
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
    found = hits_at(tmp_path / "a", 370.5, filters, range_rate=-0.12, rcs=5.0)
    assert bool(found) is kept


def test_clearance_needs_heights(tmp_path):
    with pytest.raises(InputError, match="no road heights"):
        hits_at(tmp_path / "a", 370.5, Filters(clearance=(0, 4)), tiles=crossing(np.nan))
    assert not (tmp_path / "a" / "site").exists()


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
        hits_of([path], [pose(), pose()], crossing(), tmp_path / "site")
    with pytest.raises(CrsError, match="EPSG:32632"):
        hits_of([path], [pose(crs="EPSG:32632")], crossing(), tmp_path / "site")
    assert not (tmp_path / "site").exists()


def test_a_fingerprint_knows_vertices_ids_and_crs():
    tiles = crossing()
    moved = tiles.assign(geometry=tiles.geometry.translate(1e-6))
    renamed = tiles.assign(lanelet_id=tiles["lanelet_id"] + 1)
    other_crs = tiles.set_crs("EPSG:32632", allow_override=True)
    marks = {fingerprint(site) for site in (tiles, moved, renamed, other_crs)}
    assert len(marks) == 4
    assert fingerprint(tiles.assign(height_m=1.0)) == fingerprint(tiles)


def test_a_sensor_that_sees_nothing_is_warned_of(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [[12.25, 0.0, -5.0]])
    other = recording(tmp_path / "o.parquet", [START], [[13.25, 0.0, -5.0]])
    far = pose(sensor="R2", easting=EAST + 5000)
    notes = Listener()
    both = hits_of([path, other], [pose(), far], crossing(), tmp_path / "both", reporter=notes)
    assert any("R2" in line and "no tile" in line for _, line in notes.messages)
    assert set(both.frames()["sensor"]) == {"R1", "R2"}
    assert set(both.sights()["pose"].str[:2]) == {"R1"}
    with pytest.raises(NoAnswerError, match="no tile lies in the view of R2"):
        hits_of([path], [far], crossing(), tmp_path / "blind")
    for height, words in ((330.0, "40 m under it"), (375.0, "5 m over it")):
        placed = pose(sensor="R2", easting=EAST + 5000, height=height)
        with pytest.raises(NoAnswerError) as caught:
            hits_of([path], [placed], crossing().assign(height_m=370.0), tmp_path / "blind")
        assert words in caught.value.hint
    assert not (tmp_path / "blind").exists()


def test_a_view_far_beyond_the_detections_is_warned_of(tmp_path):
    path = recording(tmp_path / "r.parquet", [START] * 3, [[10.0, 0.0, -5.0]] * 3)
    for reach, lines in ((100.0, 1), (12.0, 0)):
        notes = Listener()
        seeing = replace(pose(), view=View(max_range_m=reach, elevation_deg=90.0))
        ds = hits_of([path], [seeing], crossing(), tmp_path / f"{reach}", reporter=notes)
        levels = [level for level, _ in notes.messages]
        assert levels == ["info", *["warning"] * lines]  # sight: view only
        assert ds.recordings()["rows"].tolist() == [3]
