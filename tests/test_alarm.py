"""The alarm: small moves of a sensor, from traffic with a known truth."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from maps import Listener
from scipy.spatial.transform import Rotation
from sites import START
from streets import Street

from gis_radar.base import seconds_from_iso
from gis_radar.calibration import MOVED, track
from gis_radar.calibration.monitoring.alarm import (
    BLOCKS,
    GATE,
    STRETCH_HABIT_M,
    Alarm,
    Displacement,
    Memory,
    detectors,
    normal_equations,
)
from gis_radar.calibration.monitoring.kalman_filter import KNOCK, Estimate, Innovation, Measurement
from gis_radar.calibration.monitoring.lane_places import LanePlaces, cells_along, lane_places
from gis_radar.calibration.monitoring.moves import FAR_WINDOW, MoveTest, Scatter, score
from gis_radar.calibration.monitoring.watch import Watch
from gis_radar.calibration.monitoring.windows import WindowTraffic
from gis_radar.calibration.registration.lanes import sample_lanes
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import Moving

STREET = Street()
POSE = STREET.pose()


@pytest.fixture
def constants(monkeypatch):
    """Set constants of modules of the room: `constants(alarm={"BLOCK_S": 2.0})`."""

    def change(**modules):
        for module, changes in modules.items():
            inner = "single" if module == "moving" else "monitoring"
            for name, value in changes.items():
                monkeypatch.setattr(f"gis_radar.calibration.{inner}.{module}.{name}", value)

    return change


@pytest.fixture(scope="module")
def cells():
    lanes = sample_lanes(
        STREET.roads().lanelets, STREET.road_points(), place=POSE.position[:2], reach_m=110.0
    )
    return cells_along(lanes)


def state(pose=POSE):
    return State(
        position=np.array([*(pose.position[:2] - POSE.position[:2]), pose.height]),
        R_map_sensor=Rotation.from_quat(pose.quaternion).as_matrix(),
        reflection=0.5,
    )


def minute(cells, rng, *, moved=None, vehicles=60, habit=0.0):
    """LanePlaces of vehicles through a lane's cells each, placed with the old pose."""
    middle = np.column_stack([cells.centre, np.full(len(cells), POSE.height - 6.0)])
    parts = []
    for number in range(vehicles):
        direction = cells.left[int(rng.integers(len(cells)))]
        own = np.flatnonzero(np.abs(cells.left @ direction - 1.0) < 1e-3)
        lateral = rng.normal(0.1, 0.3) + rng.normal(0.0, 0.3, len(own))
        lateral = lateral + (habit[own] if np.ndim(habit) else habit)
        place = middle[own].copy()
        place[:, :2] += lateral[:, None] * cells.left[own]
        place[:, 2] += rng.normal(0.5, 0.2) + rng.normal(0.0, 0.2, len(own))
        if moved is not None:
            seen = (place - moved.position) @ moved.R_map_sensor
            place = state().to_map(seen)
        off = place - middle[own]
        across = np.sum(off[:, :2] * cells.left[own], axis=1)
        parts.append((np.full(len(own), number), own, across, off[:, 2]))
    vehicle, cell, across, over = (np.concatenate(part) for part in zip(*parts, strict=True))
    return LanePlaces(
        vehicle=vehicle, cell=cell, across_m=across, over_m=over, count=np.full(len(cell), 10)
    )


def scores(alarm, blocks, start=0):
    found = [alarm.push(block, 60.0 * (start + k)) for k, block in enumerate(blocks)]
    return [each for each in found if each is not None]


STEPS = {
    "east": [0.3, 0, 0, 0, 0, 0],
    "north-west": [-0.21, 0.21, 0, 0, 0, 0],
    "yaw": [0, 0, 0, 0, 0, np.radians(0.5)],
    "tilt": [0, 0, 0, np.radians(0.35), np.radians(-0.35), 0],
}


@pytest.fixture(scope="module")
def taught(cells):
    """What an alarm makes of forty minutes at rest."""
    rng = np.random.default_rng(4)
    return [minute(cells, rng) for _ in range(40)]


@pytest.mark.parametrize("name", STEPS)
def test_a_small_move_is_noticed_with_its_size(cells, taught, name):
    step = np.array(STEPS[name])
    alarm, rng = Alarm(cells, np.zeros(2)), np.random.default_rng(5)
    before = scores(alarm, taught)
    assert max(each.score for each in before) < 0.6 * GATE
    moved = state().moved(np.append(step, 0.0))
    after = scores(alarm, [minute(cells, rng, moved=moved) for _ in range(9)], len(taught))
    assert max(each.score for each in after) > GATE
    last = after[-1]
    known = np.diag(last.covariance) > 0.0
    error = (last.move - step)[known]
    assert error @ np.linalg.solve(last.covariance[np.ix_(known, known)], error) < 16.3
    assert np.abs(step[~known]).max() == 0.0
    assert np.sqrt(np.diag(last.covariance))[:2].max() < 0.1


def test_obstacles_habits_and_few_vehicles_are_no_moves(cells, taught):
    alarm, rng = Alarm(cells, np.zeros(2)), np.random.default_rng(6)
    scores(alarm, taught)
    blocked = np.where(cells.stretch == cells.stretch[20], 0.9, 0.0)
    other = [minute(cells, rng, habit=blocked) for _ in range(12)]
    other += [minute(cells, rng, habit=0.08) for _ in range(12)]
    other += [minute(cells, rng, vehicles=3) for _ in range(12)]
    assert max(each.score for each in scores(alarm, other, len(taught))) < GATE


def test_a_lasting_habit_becomes_the_reference_and_memory_is_bounded(cells, taught, constants):
    constants(alarm={"REFERENCE_H": 0.2, "REFERENCE_VEHICLES": 100})
    memory = Memory(detectors(cells, np.zeros(2))[0])
    for k, block in enumerate(taught):
        memory.push(block, block.across_m, 60.0 * k)
    assert len(taught) - memory.learnt_blocks <= BLOCKS[-1]
    for k in range(200):
        seen = taught[k % 40]
        memory.push(seen, seen.across_m + 0.2, 60.0 * (40 + k))
    assert len(taught) + 200 - memory.learnt_blocks == BLOCKS[-1]
    assert memory.reference.vehicles < 1.2 * 60 * 12  # 0.2 h
    mean = np.linalg.lstsq(memory.reference.weight, memory.reference.gradient, rcond=None)[0]
    seen = np.diag(memory.reference.weight) > 100.0
    assert np.median(mean[seen]) == pytest.approx(0.3, abs=0.07)


def test_habits_are_the_normal_equations_of_vehicles_with_a_place_of_their_own(cells, taught):
    seen, count = taught[0], len(cells)
    sway = np.full(count, 0.4)
    found = normal_equations(seen, seen.across_m, sigma=(0.3, sway, 1.0), time=0.0)
    shown = found.cell
    assert 0 < len(shown) <= count
    weight, gradient = np.zeros((count, count)), np.zeros(count)
    for number in range(seen.vehicles):
        rows = seen.vehicle == number
        design = np.eye(count)[seen.cell[rows]]
        spread = 0.3**2 + np.diag(0.4**2 + 1.0 / seen.count[rows])
        weight += design.T @ np.linalg.solve(spread, design)
        gradient += design.T @ np.linalg.solve(spread, seen.across_m[rows])
    assert np.allclose(found.weight, weight[np.ix_(shown, shown)])
    assert np.allclose(found.gradient, gradient[shown])
    assert weight.sum() == pytest.approx(found.weight.sum())


def test_the_move_is_that_of_least_squares_over_all_vehicles_at_once(cells, taught, constants):
    """Reference, move and habits in one dense system; no tapering, no reweighting, no drift."""
    plain = {"DISPERSION": 1.0, "DISPERSION_BLOCKS": 1e12, "OUTLIER": 1e9}
    constants(alarm=plain | {"DRIFT": np.full(6, 1e-9)})
    detector = replace(detectors(cells, np.zeros(2))[0], edge_m=(np.inf, np.inf))
    memory = Memory(detector)
    for k, seen in enumerate(taught):
        memory.push(seen, seen.across_m, 60.0 * k)
    found = {each.seconds: each for each in memory.displacements(2400.0)}[540.0]
    parts = [normal_equations(s, s.across_m, sigma=detector.sigma, time=0.0) for s in taught]
    known = np.unique(np.concatenate([part.cell for part in parts]))
    stretches = int(cells.stretch.max()) + 1
    effects = np.eye(stretches)[cells.stretch]
    design = np.hstack([detector.by_move, detector.by_habit, effects])[known]
    size = len(known) + design.shape[1]
    square, force = np.zeros((size, size)), np.zeros(size)
    for k, part in enumerate(parts):
        weight, gradient = part.expanded(known)
        rows = np.hstack([np.eye(len(known)), design * (k >= 31)])
        square += rows.T @ weight @ rows
        force += rows.T @ gradient
    stretch_m = np.full(stretches, STRETCH_HABIT_M)
    prior = np.concatenate([np.full(3, 1e-6), detector.habit_m**-2.0, stretch_m**-2.0])
    square[len(known) :, len(known) :] += np.diag(prior)
    whole = np.linalg.inv(square)
    move = slice(len(known), len(known) + 3)
    assert found.move[[0, 1, 5]] == pytest.approx((whole @ force)[move], abs=1e-4)
    sigma = np.sqrt(np.diag(found.covariance)[[0, 1, 5]])
    assert sigma == pytest.approx(np.sqrt(np.diag(whole)[move]), rel=0.01)


@pytest.fixture(scope="module")
def detections():
    time, points, rate = STREET.detections(POSE, vehicles=300, frames=4000, seed=3)
    return time, POSE.to_map(points) - [*POSE.position[:2], 0.0], rate


def window(detections, pose_state, begin, end):
    time, points, rate = detections
    inside = (time >= START + begin) & (time < START + end)
    seen = (points[inside] - pose_state.position) @ pose_state.R_map_sensor
    return Moving(
        time=time[inside], points=seen, range_rate=rate[inside], frames=2000,
        begin=START + begin, end=START + end,
    )  # fmt: skip


def driven(cells, detections, moved):
    return lane_places(
        window(detections, moved, 0.0, 200.0), cells, state(), since=START, until=START + 200.0,
    )  # fmt: skip


def test_a_move_shifts_the_places_by_all_of_it(cells, detections):
    """Detections scatter by the width of a vehicle; what they lose at a lane's edge hides moves."""
    still = driven(cells, detections, state())
    assert 200 < still.vehicles < 450  # of 300, some of them seen in parts
    assert abs(np.median(still.across_m)) < 0.2
    assert np.std(still.across_m) < 0.4
    assert 0.3 < np.median(still.over_m) < 0.9
    moved = driven(cells, detections, state().moved(np.array([0.3, 0, 0, 0, 0, 0, 0])))
    north = np.abs(cells.left[:, 0]) > 0.9
    means = [
        np.median(p.across_m[north[p.cell]] * cells.left[p.cell[north[p.cell]], 0])
        for p in (still, moved)
    ]
    assert means[1] - means[0] == pytest.approx(-0.3, abs=0.05)


def test_overlapping_lanes_have_no_cells(cells):
    lanes = cells.lanes
    beside = replace(
        lanes,
        points=np.vstack([lanes.points, lanes.points + [0.0, 1.2, 0.0]]),
        along=np.vstack([lanes.along, lanes.along]),
        lane=np.append(lanes.lane, lanes.lane + 1000),
        s_m=np.append(lanes.s_m, lanes.s_m),
    )
    both = cells_along(beside)
    east = np.abs(both.left[:, 1]) > 0.9
    assert not east.any()
    assert len(both) > 0


class Lanes:
    """Stands for a fitter of windows: only its lanes count."""

    def __init__(self, lanes):
        self.lanes = lambda _: lanes


def test_the_watch_cuts_a_recording_in_blocks(cells, detections, constants):
    constants(
        alarm={"BLOCK_S": 10.0, "BLOCKS": (2, 3, 3), "SHARE": 0.5, "GATE": 20.0, "SETTLE_S": 2.0}
    )
    moved = state().moved(np.array([-0.5, 0.2, 0, 0, 0, np.radians(0.8), 0.0]))
    seen = {}
    for name, after in (("still", state()), ("moved", moved)):
        watch = Watch(Lanes(cells.lanes))
        found = []
        for end in np.arange(20.0, 200.0, 10.0):
            begin = end - 25.0
            parts = [window(detections, state(), begin, min(end, 120.0)),
                     window(detections, after, max(begin, 120.0), max(end, 120.0))]  # fmt: skip
            time, points, rate = (
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("time", "points", "range_rate")
            )
            both = replace(parts[0], time=time, points=points, range_rate=rate)
            number = np.zeros(len(both), dtype=np.int64)
            traffic = WindowTraffic(moving=both, number=number)
            noticed = watch.look(traffic, state(), START + end)
            found += [(end, noticed)] if noticed is not None else []
        seen[name] = found
    assert seen["still"] == []
    assert 120.0 < seen["moved"][0][0] < 170.0
    last = seen["moved"][-1][1].move
    assert last[0] < -0.2
    assert np.degrees(last[5]) > 0.3


def test_a_move_noticed_by_the_watch_moves_the_track(tmp_path, monkeypatch, constants):
    STREET.record(tmp_path / "R1.parquet", POSE, frames=700, vehicles=50)
    sigma = dict.fromkeys(("easting", "northing", "height"), 0.1)
    start = replace(POSE, evidence={"sigma": sigma | dict.fromkeys(("yaw", "pitch", "roll"), 0.1)})
    constants(alarm={"BLOCK_S": 2.0}, monitor={"SETTLE_S": 1.0}, moving={"FRAMES": 300})
    step = np.array([0.25, -0.1, 0, 0, 0, np.radians(0.4)])
    spread = np.diag([0.05**2, 0.05**2, 0, 0, 0, np.radians(0.05) ** 2])
    asked, poses = [], []

    def look(self, traffic, state, time):
        if traffic is None:
            return None
        asked.append(time)
        poses.append(state.position)
        move = Displacement(score=30.0, seconds=4.0, move=step, covariance=spread)
        return move if len(asked) == 3 else None

    restarts, again = [], Watch.restart

    def restart(self):
        restarts.append(1)
        again(self)

    monkeypatch.setattr(Watch, "look", look)
    monkeypatch.setattr(Watch, "restart", restart)
    heard = Listener()
    found = track(tmp_path / "R1.parquet", STREET.roads(), STREET.road_points(), start,
                  reporter=heard)  # fmt: skip
    moved = [event for event in found.events if event.kind == MOVED]
    assert [seconds_from_iso(event.time, what="event") for event in moved] == [
        pytest.approx(asked[2] - 5.0, abs=0.06)
    ]
    at = found.poses.at(np.array([asked[2] - 6.0, asked[2] - 4.0]))
    before, after = (found.poses.poses[i] for i in at)
    assert after.easting - before.easting == pytest.approx(0.25, abs=0.02)
    assert after.yaw - before.yaw == pytest.approx(0.4, abs=0.05)
    assert after.evidence["sigma"]["yaw"] > before.evidence["sigma"]["yaw"]
    assert len(restarts) == 2  # at the beginning, and at the move
    (line,) = [text for level, text in heard.messages if level == "warning"]
    assert "R1 was moved by about 0.27 m and 0.40 deg around 2023-11-14T22:13:" in line


def test_while_still_targets_rest_traffic_is_not_asked_for_blows(tmp_path, monkeypatch, constants):
    STREET.record(tmp_path / "R1.parquet", POSE, frames=500, vehicles=40)
    sigma = dict.fromkeys(("easting", "northing", "height"), 0.1)
    start = replace(POSE, evidence={"sigma": sigma | dict.fromkeys(("yaw", "pitch", "roll"), 0.1)})
    constants(moving={"FRAMES": 300})
    asked = []
    monkeypatch.setattr(MoveTest, "suspected", lambda *_: asked.append(1))
    for rests in (False, True):
        monkeypatch.setattr(Watch, "unmoved", rests)
        before = len(asked)
        track(tmp_path / "R1.parquet", STREET.roads(), STREET.road_points(), start)
        assert (len(asked) > before) is not rests


def test_a_sensor_whose_windows_differ_much_needs_more_for_a_move():
    scatter, rng = Scatter(), np.random.default_rng(1)
    assert scatter.ratio == 1.0
    for chi2 in rng.chisquare(6, 200):
        scatter.add(chi2)
    assert scatter.ratio < 1.4
    for chi2 in 3.0 * rng.chisquare(6, 200):
        scatter.add(chi2)
    assert 2.2 < scatter.ratio < 3.8
    for _ in range(5):  # a knock
        scatter.add(500.0)
    assert scatter.ratio < 4.2


def stub_fit(move, *, cost, vehicles=50, noise=1.0, alone=False):
    """A fit of so many vehicles that all say the same of the first component, or one of them."""
    scores = np.zeros((vehicles, 7))
    scores[:, 0] = 1.0
    measured = Measurement(
        position=np.array([move, 0.0, 0.0]), quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        covariance=0.01 * np.eye(6), noise=0.01 * noise * np.eye(6),
    )  # fmt: skip
    costs = np.full(vehicles, 100.0 / vehicles)
    costs[: 1 if alone else vehicles] += (cost - 100.0) / (1 if alone else vehicles)
    fit = SimpleNamespace(
        scores=scores, information=np.eye(7), cost=cost, costs=costs, state=state()
    )
    return SimpleNamespace(measurement=measured, fit=fit, trusted=True, on_lanes=True)


@pytest.mark.parametrize(("vehicles", "noise"), [(5, 1.0), (5, 0.25), (10_000, 1.0)])
def test_few_vehicles_are_beyond_chance_later(vehicles, noise):
    """With all variance from n alike vehicles n degrees of freedom; from a quarter of it 16 n."""
    gap = Innovation(gap=np.array([0.8, 0, 0, 0, 0, 0]), covariance=0.01 * np.eye(6))
    freedom = vehicles / noise**2
    expected = freedom * np.log1p(64.0 / freedom)
    assert score(gap, stub_fit(0.8, cost=0.0, vehicles=vehicles, noise=noise)) == pytest.approx(
        expected
    )


@pytest.mark.parametrize(
    ("gain", "alone", "suspected", "certain"),
    [
        (-5.0, False, False, False),
        (3.0, False, False, False),
        (60.0, False, True, True),
        (60.0, True, True, False),  # a bus at the edge of its lane
    ],
)
def test_a_move_is_likelier_by_all_vehicles(gain, alone, suspected, certain, monkeypatch):
    """Where traffic fixes a direction poorly, a fit is carried far along it."""
    monkeypatch.setattr(MoveTest, "lasting_change", lambda *_: None)
    seen, rest = stub_fit(2.0, cost=100.0), stub_fit(0.0, cost=100.0 + gain, alone=alone)
    held = Estimate(
        time=0.0, position=np.zeros(3), quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        covariance=0.01 * np.eye(6),
    )  # fmt: skip

    def fit(_part, _held, _reflection_m, *, near, schedule):
        assert schedule is FAR_WINDOW
        return seen if near is KNOCK else rest

    part = SimpleNamespace(moving=SimpleNamespace(begin=70.0), vehicles=40)
    traffic = SimpleNamespace(moving=SimpleNamespace(begin=0.0), between=lambda *_: part)
    test = MoveTest(
        fitter=SimpleNamespace(fit=fit), traffic=traffic, now=100.0,
        expected=lambda _: held, scatter=Scatter(),
    )  # fmt: skip
    found = test.suspected(0.6)
    assert (found is not None and found.certain) == certain
    assert (found is None) == (not suspected)
