"""Traces: sources of ICP, windows and tracks against plain ways to make them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from sites import START, recording, table

from gis_radar.calibration.registration.traces import Moving, link_tracks, thin, vehicles_of
from gis_radar.calibration.single import moving as reading
from gis_radar.calibration.single.icp import source_voxels, voxels
from gis_radar.calibration.single.moving import MovingWindow, read_moving
from gis_radar.recordings import Detections


def plain_dbscan(points, eps, least):
    """Cores joined within eps, from the full matrix of distances; borders left out."""
    near = cdist(points, points) < eps
    core = near.sum(axis=1) >= least
    _, labels = connected_components(near & core[:, None] & core[None])
    return core, np.where(core, labels, -1), near


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_the_sources_of_icp_are_the_largest_cluster_of_dbscan(seed):
    pytest.importorskip("open3d", reason="needs the extra localize", exc_type=ImportError)
    rng = np.random.default_rng(seed)
    lumps = zip(rng.uniform(-20, 20, (3, 3)), (400, 250, 100), strict=True)
    points = np.vstack([rng.normal(at, 1.5, (n, 3)) for at, n in lumps])
    points = np.vstack([points, rng.uniform(-40, 40, (60, 3))])
    time = np.arange(len(points)) * 0.05
    moving = Moving(
        time=time, points=points, range_rate=np.ones(len(time)), frames=len(time),
        begin=0.0, end=time[-1],
    )  # fmt: skip
    found = source_voxels(moving)
    centres = voxels(points, 0.5)
    core, labels, near = plain_dbscan(centres, 2.0, 10)
    groups = [labels == label for label in np.unique(labels[core])]
    reached = [near[:, group].any(axis=1) for group in groups]
    mine = (centres[:, None] == found[None]).all(axis=2).any(axis=1)
    best = max(range(len(groups)), key=lambda k: (mine & groups[k]).sum())
    assert mine[groups[best]].all()
    assert reached[best][mine].all()
    assert mine.sum() >= max(group.sum() for group in groups)


def batch(time, rate):
    count = len(time)
    return Detections(
        time=np.asarray(time, dtype=float),
        points=np.ones((count, 3)),
        range_rate=np.asarray(rate, dtype=float),
        rcs=np.zeros(count),
        further=table([], np.empty((0, 3))).to_batches() or None,
    )


def test_a_window_keeps_the_last_frames_across_batches(monkeypatch):
    monkeypatch.setattr(reading, "WINDOW_FRAMES", 3)
    window = MovingWindow()
    window.push(batch([0, 0, 1, 1], [1, 0, 1, 1]))
    window.push(batch([1, 2, 3], [1, 0.1, -2]))
    window.push(batch([4], [5]))
    found = window.moving()
    assert found.time.tolist() == [3.0, 4.0]
    assert found.range_rate.tolist() == [-2.0, 5.0]
    assert found.frames == 3
    assert (found.begin, found.end) == (2.0, 4.0)


def test_moving_is_read_from_a_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "WINDOW_FRAMES", 20)
    time = START + np.repeat(np.arange(30), 4) * 0.05
    rate = np.tile([0.0, 0.1, 0.2, -3.0], 30)
    path = recording(tmp_path / "R1.parquet", time, np.ones((120, 3)), range_rate=rate)
    found = read_moving(path)
    assert (found.frames, len(found)) == (20, 40)
    assert (np.abs(found.range_rate) > 0.15).all()


@pytest.fixture
def passing():
    """Two vehicles on parallel lanes, a tree in the wind and false alarms."""
    rng = np.random.default_rng(3)
    moment = np.arange(0.0, 4.0, 0.05)
    rows = []
    for owner, (y, speed) in enumerate([(3.0, 10.0), (-5.0, -12.0)]):
        x = 30.0 + speed * (moment - 2.0)
        point = np.column_stack([x, np.full_like(x, y), np.full_like(x, -5.0)])
        rows.append((moment, point, speed * x / np.linalg.norm(point, axis=1), owner))
    often = np.sort(rng.uniform(0, 4, 400))
    rows.append((often, rng.normal([15, 12, 1], 1.0, (400, 3)), rng.normal(0, 0.4, 400), 2))
    alone = np.sort(rng.uniform(0, 4, 25))
    rows.append((alone, rng.uniform(-60, 60, (25, 3)), rng.uniform(-14, 14, 25), 3))
    time, points, rate = (np.concatenate([row[i] for row in rows]) for i in range(3))
    owner = np.repeat(np.arange(4), [len(row[0]) for row in rows])
    order = np.argsort(time, kind="stable")
    moving = Moving(
        time=time[order], points=points[order] + rng.normal(0, 0.1, (len(time), 3)),
        range_rate=rate[order], frames=80, begin=0.0, end=4.0,
    )  # fmt: skip
    return moving, owner[order]


def test_vehicles_become_tracks_and_clutter_does_not(passing):
    moving, owner = passing
    tracks = link_tracks(moving)
    for vehicle in (0, 1):
        mine = tracks[owner == vehicle]
        assert np.mean(mine >= 0) > 0.9
        assert len(set(mine[mine >= 0])) <= 2
    assert not set(tracks[owner == 0]) & set(tracks[owner == 1]) - {-1}
    assert np.mean(tracks[owner >= 2] >= 0) < 0.05


@pytest.mark.parametrize(("vehicles", "walkers_kept"), [(14, False), (40, True), (0, False)])
def test_walkers_carry_no_weight_but_where_all_traffic_creeps(vehicles, walkers_kept):
    moment, rows = np.arange(0.0, 7.9, 0.1), []
    speeds = [10.0] * vehicles + [1.6] * 6
    for k, speed in enumerate(speeds):
        x, y = 20.0 + speed * moment, 8.0 * (k - len(speeds) / 2)
        points = np.column_stack([x, np.full_like(x, y), np.full_like(x, -5.0)])
        rows.append((moment, points, speed * x / np.linalg.norm(points, axis=1)))
    time, points, rate = (np.concatenate([row[i] for row in rows]) for i in range(3))
    walks = np.repeat(np.array(speeds) < 3.0, len(moment))
    order = np.argsort(time, kind="stable")
    moving = Moving(
        time=time[order], points=points[order], range_rate=rate[order],
        frames=79, begin=0.0, end=7.8,
    )  # fmt: skip
    tracks = link_tracks(moving)
    assert (tracks[~walks[order]] >= 0).all()
    assert (tracks[walks[order]] >= 0).all() == walkers_kept
    assert (tracks[walks[order]] >= 0).any() == walkers_kept


def test_limbs_that_swing_make_no_vehicle_of_a_walker():
    """Their feet are two and a half times as fast as they are; a car that sets off is a vehicle."""
    rng, moment, rows = np.random.default_rng(5), np.arange(0.0, 7.9, 0.05), []
    sets_off = 0.5 * moment**2
    ways = [20.0 + 10.0 * moment] * 4 + [20.0 + sets_off] + [60.0 + 1.8 * moment] * 6
    for k, x in enumerate(ways):
        points = np.column_stack([x, np.full_like(x, 8.0 * (k - 5)), np.full_like(x, -5.0)])
        limb = (rng.random(len(x)) < 0.4) & (k > 4)
        share = np.where(limb, rng.uniform(0.0, 2.5, len(x)), rng.normal(1.0, 0.05, len(x)))
        speed = np.gradient(x, moment)
        rows.append((moment, points, share * speed * x / np.linalg.norm(points, axis=1)))
    time, points, rate = (np.concatenate([row[i] for row in rows]) for i in range(3))
    order = np.argsort(time, kind="stable")
    order = order[np.abs(rate[order]) > 0.15]
    moving = Moving(
        time=time[order], points=points[order], range_rate=rate[order],
        frames=158, begin=0.0, end=7.85,
    )  # fmt: skip
    owner = np.repeat(np.arange(len(ways)), len(moment))[order]
    tracks = link_tracks(moving)
    assert (tracks[owner > 4] == -1).all()
    assert np.mean(tracks[owner <= 4] >= 0) > 0.9


def test_thinning_keeps_tracks_and_a_limit(passing):
    moving, _ = passing
    tracks = link_tracks(moving)
    samples = thin(moving, tracks, most=50)
    assert len(samples) == 50
    assert samples.tracks == tracks.max() + 1
    again = thin(moving, tracks, most=50)
    assert np.array_equal(samples.points, again.points)


def driven_past(begin, end, *, x, y, speed, step=0.05):
    """Return time, place and range rate of what drives along x, 30 m beside the sensor."""
    time = np.arange(begin, end, step)
    place = np.column_stack([x + speed * time, np.full(len(time), y), np.zeros(len(time))])
    return time, place, speed * place[:, 0] / np.hypot(place[:, 0], y)


def test_tracks_of_one_vehicle_are_told_from_those_of_others():
    tracks = [
        driven_past(0.0, 2.0, x=-40.0, y=30.0, speed=10.0),  # hidden for 1.5 s
        driven_past(3.5, 6.0, x=-40.0, y=30.0, speed=10.0),
        driven_past(4.0, 7.0, x=-43.0, y=30.8, speed=10.0),  # its rear, linked apart
        driven_past(1.0, 6.0, x=-70.0, y=30.0, speed=10.0),  # 30 m behind it
        driven_past(1.0, 6.0, x=30.0, y=33.5, speed=-10.0),  # comes the other way
        driven_past(9.0, 10.0, x=120.0, y=30.0, speed=10.0),
    ]
    time, points, rate = (np.concatenate(part) for part in zip(*tracks, strict=True))
    number = np.repeat(np.arange(len(tracks)), [len(part[0]) for part in tracks])
    order = np.argsort(time, kind="stable")
    moving = Moving(
        time=time[order], points=points[order], range_rate=rate[order], frames=200,
        begin=0.0, end=10.0,
    )  # fmt: skip
    assert vehicles_of(moving, number[order]).tolist() == [0, 0, 0, 1, 2, 3]
    alone = vehicles_of(moving, np.where(number[order] == 4, 0, -1))
    assert alone.tolist() == [0]
    samples = thin(moving, number[order])
    assert samples.vehicles.tolist() == [0, 0, 0, 1, 2, 3]
