"""Registration: derivatives, directions, levelling and the evidence's parts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from streets import CROSSING, Street

from gis_radar.errors import NoAnswerError
from gis_radar.pose import Pose
from gis_radar.registration import Lanes, State, advantage, sample_lanes
from gis_radar.registration.hypotheses import prior_at
from gis_radar.registration.level import level
from gis_radar.registration.matching import match
from gis_radar.registration.residuals import height, lateral
from gis_radar.registration.solver import solve
from gis_radar.registration.state import FREE, SIZE, TURN, angles_from_turn
from gis_radar.traces import Moving, Samples, thin, track


@pytest.fixture(scope="module")
def scene():
    street = Street(lanes=CROSSING)
    pose = street.pose()
    time, xyz, rate = street.detections(pose)
    moving = Moving(
        time=time, points=xyz, range_rate=rate, frames=600, detections=len(time),
        begin=time[0], end=time[-1],
    )  # fmt: skip
    samples = thin(moving, track(moving), most=400)
    place = np.array(street.middle)
    lanes = sample_lanes(street.roads().lanelets, street.road_points(), place=place, reach_m=150.0)
    state = State(
        position=pose.position - [*place, 0.0], R_map_sensor=pose.R_map_sensor, reflection=0.6
    )
    return lanes, samples, state, pose


@pytest.mark.parametrize("family", [lateral, height])
def test_derivatives_are_those_of_the_residuals(scene, family):
    lanes, samples, state, _ = scene
    matches = match(lanes, samples, state)
    own = np.zeros(samples.tracks)
    rows = family(lanes, samples, matches, state, own, 0.3)
    for column in range(SIZE):
        step = np.zeros(SIZE)
        step[column] = 1e-6
        plus, minus = (
            family(lanes, samples, matches, state.moved(s * step), own, 0.3).value for s in (1, -1)
        )
        numeric = (plus - minus) / 2e-6
        counts = rows.weight > 1e-6
        assert np.allclose(rows.jacobian[counts, column], numeric[counts], atol=1e-5), column


def test_weights_lead_the_cost_downhill(scene):
    lanes, samples, state, _ = scene
    matches = match(lanes, samples, state)
    own = np.zeros(samples.tracks)
    for family in (lateral, height):
        rows = family(lanes, samples, matches, state, own, 0.5)
        gradient = rows.jacobian.T @ (rows.weight * rows.value)
        for column in range(3):
            step = np.zeros(SIZE)
            step[column] = 1e-5
            plus, minus = (
                family(lanes, samples, matches, state.moved(s * step), own, 0.5).loss.sum()
                for s in (1, -1)
            )
            assert gradient[column] == pytest.approx((plus - minus) / 2e-5, abs=0.5, rel=0.02)


def test_a_start_beside_the_truth_comes_back(scene):
    lanes, samples, state, _ = scene
    start = state.moved(np.array([0.8, -0.6, 0.5, 0.01, -0.01, 0.02, 0.0, 0.0, 0.0]))
    fit = solve(lanes, samples, start, prior_at(start))
    assert fit.converged
    assert np.abs(fit.state.difference(state)[:3]).max() < 0.4
    assert np.linalg.eigvalsh(fit.information[FREE, FREE])[0] > 0.0


def test_every_match_has_a_doppler_that_its_lane_allows(scene):
    lanes, samples, state, _ = scene
    matches = match(lanes, samples, state)
    assert matches.found.mean() > 0.95
    sight = (samples.points @ state.R_map_sensor.T)[:, :2]
    sight = sight / np.hypot(*sight.T)[:, None]
    away = np.sum(lanes.along[matches.lane] * sight, axis=1)
    clear = matches.found & (np.abs(samples.range_rate) > 0.6)
    assert (np.sign(away[clear]) == np.sign(samples.range_rate[clear])).all()


def test_matching_turned_round_fails(scene):
    lanes, samples, state, _ = scene
    backward = replace(samples, range_rate=-samples.range_rate)
    loss = [solve(lanes, s, state, prior_at(state)).loss.mean() for s in (samples, backward)]
    assert loss[0] + 0.5 < loss[1]


def test_lanes_have_direction_and_the_scanned_height(scene):
    lanes, *_ = scene
    street = Street(lanes=CROSSING)
    assert np.allclose(np.hypot(*lanes.along.T), 1.0)
    assert np.allclose(lanes.points[:, 2], street.ground(lanes.points[:, :2]), atol=0.05)
    rise = lanes.along @ np.array(street.slope)
    assert np.allclose(lanes.slope, rise, atol=0.01)
    assert isinstance(lanes, Lanes)
    assert lanes.directed


def test_no_lane_within_reach_is_refused():
    street = Street()
    with pytest.raises(NoAnswerError, match="no lane"):
        sample_lanes(
            street.roads().lanelets, street.road_points(), place=np.zeros(2), reach_m=200.0
        )


@settings(max_examples=30, deadline=None)
@given(st.floats(-8, 8), st.floats(-8, 8), st.floats(3, 10), st.booleans(), st.integers(0, 1000))
def test_levelling_finds_which_way_is_up(pitch, roll, over_m, upside_down, seed):
    rng = np.random.default_rng(seed)
    flat = rng.uniform([5, -40, 0], [90, 40, 0], (400, 3)) - [0, 0, over_m]
    turn = Rotation.from_euler("ZYX", [0, pitch, roll + 180 * upside_down], degrees=True)
    points = turn.inv().apply(flat) + rng.normal(0, 0.1, (400, 3))
    samples = Samples(
        points=points, range_rate=np.ones(400), track=np.zeros(400, dtype=np.int64), tracks=1,
        elevation=1.0,
    )  # fmt: skip
    found = level(samples)
    assert np.linalg.det(found.R_level_sensor) == pytest.approx(1.0)
    up = turn.inv().apply([0, 0, 1])
    assert np.degrees(np.arccos(np.clip(found.R_level_sensor[2] @ up, -1, 1))) < 2.0
    assert found.depth_m == pytest.approx(over_m, abs=0.7)


@settings(max_examples=50, deadline=None)
@given(st.floats(-180, 180), st.floats(-60, 60), st.floats(-180, 180), st.integers(0, 99))
def test_turns_become_angles(yaw, pitch, roll, seed):
    step = np.zeros(SIZE)
    step[TURN] = np.random.default_rng(seed).normal(0, 1e-6, 3)
    pose = Pose(
        sensor="R", crs=25832, easting=0.0, northing=0.0, height=0.0, yaw=yaw, pitch=pitch,
        roll=roll,
    )  # fmt: skip
    state = State(position=np.zeros(3), R_map_sensor=pose.R_map_sensor, reflection=0.6)
    change = state.moved(step).yaw_pitch_roll - state.yaw_pitch_roll
    change = (change + np.pi) % (2 * np.pi) - np.pi
    expected = angles_from_turn(np.radians(yaw), np.radians(pitch)) @ step[TURN]
    assert np.allclose(change[::-1], expected, atol=1e-9)
    assert np.allclose(state.moved(step).difference(state), step, atol=1e-9)


def test_vehicles_vote(scene):
    lanes, samples, state, _ = scene
    fit = solve(lanes, samples, state, prior_at(state))
    worse = replace(fit, loss=fit.loss + 0.3)
    assert advantage(fit, worse, samples) > 3.0
    assert advantage(worse, fit, samples) < -3.0
    assert advantage(fit, fit, samples) == 0.0
