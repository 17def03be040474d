"""Moves of a sensor: how a track takes them in, and by how much traffic they are certain."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from maps import Listener
from scipy.spatial.transform import Rotation
from streets import Street

from gis_radar.base import seconds_from_iso
from gis_radar.calibration import MOVED, track
from gis_radar.calibration.monitoring.kalman_filter import KNOCK, Estimate, Innovation, Measurement
from gis_radar.calibration.monitoring.moves import FAR_WINDOW, MoveTest, Scatter, score
from gis_radar.calibration.monitoring.stationary_targets import Displacement, Watch
from gis_radar.calibration.registration.state import State

STREET = Street()
POSE = STREET.pose()


@pytest.fixture
def constants(monkeypatch):
    """Set constants of modules of the room: `constants(moving={"WINDOW_FRAMES": 300})`."""

    def change(**modules):
        for module, changes in modules.items():
            inner = "single" if module == "moving" else "monitoring"
            for name, value in changes.items():
                monkeypatch.setattr(f"gis_radar.calibration.{inner}.{module}.{name}", value)

    return change


def state(pose=POSE):
    return State(
        position=np.array([*(pose.position[:2] - POSE.position[:2]), pose.height]),
        R_map_sensor=Rotation.from_quat(pose.quaternion).as_matrix(),
        reflection=0.5,
    )


def test_a_move_noticed_by_the_watch_moves_the_track(tmp_path, monkeypatch, constants):
    STREET.record(tmp_path / "R1.parquet", POSE, frames=700, vehicles=50)
    sigma = dict.fromkeys(("easting", "northing", "height"), 0.1)
    start = replace(POSE, evidence={"sigma": sigma | dict.fromkeys(("yaw", "pitch", "roll"), 0.1)})
    constants(moving={"WINDOW_FRAMES": 300})
    step = np.array([0.25, -0.1, 0, 0, 0, np.radians(0.4)])
    spread = np.diag([0.05**2, 0.05**2, 0, 0, 0, np.radians(0.05) ** 2])
    asked, restarts, again = [], [], Watch.restart

    def look(self, turn, time):
        assert turn == pytest.approx(state().R_map_sensor, abs=0.02)
        asked.append(time)
        move = Displacement(score=30.0, seconds=5.0, move=step, covariance=spread)
        return move if len(asked) == 5 else None

    def restart(self):
        restarts.append(1)
        again(self)

    monkeypatch.setattr(Watch, "find_move", look)
    monkeypatch.setattr(Watch, "restart", restart)
    heard = Listener()
    found = track(tmp_path / "R1.parquet", STREET.roads(), STREET.road_points(), start,
                  reporter=heard)  # fmt: skip
    moved = [event for event in found.events if event.kind == MOVED]
    assert [seconds_from_iso(event.time, what="event") for event in moved] == [
        pytest.approx(asked[4] - 5.0, abs=0.06)
    ]
    at = found.poses.at(np.array([asked[4] - 6.0, asked[4] - 4.0]))
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
    constants(moving={"WINDOW_FRAMES": 300})
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
