"""Small moves of a sensor from what stands still around it, with a known truth."""

import copy
import pickle

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from gis_radar.calibration.monitoring.stationary_targets import (
    BLOCKS,
    GONE_BLOCKS,
    LEAST_AGE,
    LEAST_MOVE_SCORE,
    StationaryTargets,
    Watch,
    by_move,
    polar_of,
)
from gis_radar.recordings import Detections

FRAME_S, FRAMES = 0.5, 40  # one frame of ten
SETTLED = 60  # blocks


class Yard:
    """Still targets whose places wander by as much as recorded ones do, and stay so for a block."""

    def __init__(self, count=45, seed=0):
        self.rng = np.random.default_rng(seed)
        reach = self.rng.uniform(8.0, 90.0, count)
        azimuth = self.rng.uniform(-1.0, 1.0, count)
        over = self.rng.uniform(-6.0, 4.0, count)
        self.points = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), over])
        self.blocks = 0

    def feed(self, targets, blocks=1, move=None, points=None):
        """Push blocks as a sensor sees them that was moved, metres and a turn in its own axes."""
        for _ in range(blocks):
            targets.push(*self.block(move, points))
            targets.end_block()
        return targets

    def block(self, move=None, points=None):
        """Return time, points and range rates of a block."""
        rng, points = self.rng, self.points if points is None else points
        own = polar_of(points) + rng.normal(size=points.shape) * [0.03, 0.001, 0.006]
        frame, target = np.nonzero(rng.random((FRAMES, len(points))) < 0.9)
        polar = own[target] + rng.normal(size=(len(target), 3)) * [0.01, 0.0008, 0.005]
        seen = cartesian(polar)
        if move is not None:
            seen = Rotation.from_rotvec(move[3:]).inv().apply(seen - move[:3])
        time = FRAME_S * (frame + FRAMES * self.blocks)
        self.blocks += 1
        return time, seen, rng.normal(0.0, 0.02, len(seen))


def is_sensitive(verdict):
    """Whether a shift by 0.3 m or a turn by 0.5 degrees is three times its standard deviation."""
    sigma = np.sqrt(np.diag(verdict.displacement.covariance))[[0, 1, 3, 4, 5]]
    return (sigma < np.repeat([0.1, np.radians(0.5) / 3.0], [2, 3])).all()


def cartesian(polar):
    reach, azimuth, elevation = polar.T
    level = np.cos(elevation)
    way = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return reach[:, None] * np.column_stack(way)


@given(
    arrays(float, 3, elements=st.floats(-50.0, 50.0)), arrays(float, 6, elements=st.floats(-1, 1))
)
def test_places_change_by_a_move_as_their_derivatives_say(point, way):
    point = point + [80.0, 0.0, 0.0]
    step = 1e-5 * way
    moved = Rotation.from_rotvec(step[3:]).inv().apply(point - step[:3])
    change = polar_of(moved[None])[0] - polar_of(point[None])[0]
    told = by_move(polar_of(point[None]))[0] @ step
    assert change == pytest.approx(told, abs=1e-7)


MOVES = {
    "ahead": [0.3, 0, 0, 0, 0, 0],
    "aside": [0, -0.3, 0, 0, 0, 0],
    "roll": [0, 0, 0, np.radians(0.5), 0, 0],
    "pitch": [0, 0, 0, 0, np.radians(-0.5), 0],
    "yaw": [0, 0, 0, 0, 0, np.radians(0.5)],
}


@pytest.fixture(scope="module")
def taught():
    yard = Yard()
    return yard, yard.feed(StationaryTargets(), SETTLED)


def again(taught, seed):
    """A copy of what was learnt, and the same yard with other noise."""
    yard, targets = taught
    other = Yard()
    other.rng = np.random.default_rng(seed)
    other.blocks = yard.blocks
    return other, copy.deepcopy(targets)


@pytest.mark.parametrize("name", MOVES)
def test_a_small_move_is_noticed_within_three_minutes_with_its_size(taught, name):
    yard, targets = again(taught, 1)
    step = np.array(MOVES[name])
    yard.feed(targets, 8, step)
    told = targets.verdict(6)
    assert is_sensitive(told)
    assert told.displacement.score > LEAST_MOVE_SCORE
    assert told.displacement.seconds == 120.0
    error = told.displacement.move - step
    assert error @ np.linalg.solve(told.displacement.covariance, error) < 22.5  # 0.1 % of chi2, 6
    assert np.abs(error)[[0, 1]].max() < 0.05


def test_a_sensor_at_rest_is_not_moved_whatever_is_parked(taught):
    """A third of the targets leave, others come beside their places, in the same few minutes."""
    yard, targets = again(taught, 2)
    points = yard.points.copy()
    points[:15, 0] += 60.0
    points[15:22, :2] += yard.rng.normal(0.3, 0.3, (7, 2))
    worst = 0.0
    for _ in range(30):
        yard.feed(targets, points=points)
        told = targets.tested
        worst = max(worst, *(each.displacement.score for each in told))
    assert worst < LEAST_MOVE_SCORE
    assert is_sensitive(told[1])


def test_targets_are_learnt_again_after_others_have_left(taught):
    yard, targets = again(taught, 3)
    held = len(pickle.dumps(targets))
    points = yard.points.copy()
    points[:30, 1] += 9.0
    yard.feed(targets, 6, points=points)
    assert targets.verdict(6) is None  # most have gone: nothing is said
    yard.feed(targets, GONE_BLOCKS + 40, points=points)
    told = targets.verdict(6)
    assert is_sensitive(told)
    assert told.displacement.score < LEAST_MOVE_SCORE
    assert len(pickle.dumps(targets)) < held + 50_000  # bytes; of 22 million
    assert len(targets) < 60


@pytest.mark.parametrize(
    ("move", "count"),
    [([3.0, -2.0, 0, 0, 0, 0], 45), ([0, 0, 0, 0, 0, 0.1], 45), ([0.0] * 6, 0), ([0.0] * 6, 9)],
)
def test_nothing_is_said_after_a_blow_in_snow_or_of_few_targets(taught, move, count):
    yard, targets = again(taught, 4)
    yard.feed(targets, 8, np.array(move), yard.points[:count])
    assert targets.tested == []
    assert targets.verdict(1) is None


def test_targets_that_are_told_later_begin_anew(taught):
    yard, targets = again(taught, 6)
    yard.feed(targets, 8, np.array(MOVES["ahead"]))
    assert targets.tested[0].displacement.score > LEAST_MOVE_SCORE
    targets.set_targets(polar_of(yard.points[:30]), np.full(30, 0.9))
    assert targets.tested == []
    assert targets.verdict(1) is None
    yard.feed(targets, BLOCKS[-1] + LEAST_AGE)
    assert len(targets) >= 30
    told = targets.verdict(6)
    assert told.displacement.score < LEAST_MOVE_SCORE


def test_what_drives_or_stands_for_a_while_is_no_target():
    yard, targets = Yard(3), StationaryTargets()
    queue = np.array([[30.0, 2.0, -4.0]])
    for block in range(30):
        points = np.vstack([yard.points, queue + [0.4 * block, 0, 0]]) if block % 6 == 0 else None
        yard.feed(targets, points=points)
    assert len(targets) == 3


def test_the_watch_gives_a_move_in_the_axes_of_the_map_without_any_traffic():
    turn = Rotation.from_euler("ZYX", [120.0, 5.0, -2.0], degrees=True)
    step = np.array([0.25, -0.15, 0, 0, 0, np.radians(0.4)])  # axes of the map
    own = np.concatenate([turn.inv().apply(step[:3]), turn.inv().apply(step[3:])])
    yard, watch, noticed = Yard(), Watch(), []
    assert not watch.unmoved
    watch.find_move(turn.as_matrix(), 0.0)
    for block in range(1, 75):
        time, points, rate = yard.block(own if block > 65 else None)
        nothing = np.full(len(time), np.nan)
        record = pa.RecordBatch.from_pydict({"none": nothing})
        watch.push(
            Detections(time=time, points=points, range_rate=rate, rcs=nothing, further=record)
        )
        found = watch.find_move(turn.as_matrix(), 20.0 * block)
        noticed += [(block, found)] if found is not None else []
        assert watch.find_move(turn.as_matrix(), 20.0 * block + 5.0) is None  # within a block
        if block == 65:
            assert watch.unmoved
    assert not watch.unmoved
    first, found = noticed[0]
    assert 67 < first < 72
    assert found.move == pytest.approx(step, abs=0.03)
    error = found.move - step
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    watch.restart()
    assert not watch.unmoved
