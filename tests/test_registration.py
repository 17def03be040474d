"""Registration: derivatives, directions, levelling and the evidence's parts."""

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from streets import CROSSING, Street

from gis_radar.base import NoAnswerError
from gis_radar.calibration.registration.adaptation import adapted, heights
from gis_radar.calibration.registration.certainty import (
    advantage,
    agreed_rise,
    along_valley,
    certainty,
    widened_along,
    with_information_along,
)
from gis_radar.calibration.registration.hypotheses import Hypothesis, level, look_around, prior_at
from gis_radar.calibration.registration.lanes import Lanes, Scene, place, sample_lanes
from gis_radar.calibration.registration.matches import match, match_along
from gis_radar.calibration.registration.model import MODEL
from gis_radar.calibration.registration.residuals import (
    STRAY_HEIGHT_M,
    STRAY_SHARE,
    VIEW_EDGE,
    LaneComparison,
    assemble,
    height,
    height_covariance,
    height_over_road,
    lateral,
)
from gis_radar.calibration.registration.solver import Rest, Schedule, at_least, settle, solve
from gis_radar.calibration.registration.state import (
    POSE_PART,
    SIZE,
    TURN,
    State,
    angles_from_turn,
    from_arc,
)
from gis_radar.calibration.registration.traces import SPELL_S, Moving, Samples, link_tracks, thin
from gis_radar.poses import Pose


@pytest.fixture(scope="module")
def scene():
    street = Street(lanes=CROSSING)
    pose = street.pose()
    time, xyz, rate = street.detections(pose)
    moving = Moving(
        time=time, points=xyz, range_rate=rate, frames=600,
        begin=time[0], end=time[-1],
    )  # fmt: skip
    samples = thin(moving, link_tracks(moving), most=400)
    place = np.array(street.middle)
    lanes = sample_lanes(street.roads().lanelets, street.road_points(), place=place, reach_m=150.0)
    state = State(
        position=pose.position - [*place, 0.0], R_map_sensor=pose.R_map_sensor, reflection=0.6
    )
    return Scene(lanes=lanes, samples=samples), state, pose


def matched(scene, scale_m):
    scene, state, _ = scene
    lanes, samples = scene.lanes, scene.samples
    placed = place(samples, state)
    compared = LaneComparison(
        lanes=lanes, placed=placed, matches=match(lanes, placed),
        model=replace(MODEL, hidden_share=1e-9), scale_m=scale_m,
    )  # fmt: skip
    return compared, state, [np.zeros((samples.tracks, 1)), np.zeros_like(samples.spell_reach)]


def at(compared, state):
    return replace(compared, placed=place(compared.placed.samples, state))


@pytest.mark.parametrize(
    ("family", "column"),
    # turned, a sensor also sees other faces, which the derivatives leave out
    [(lateral, 0), (lateral, 1), *((height, column) for column in range(SIZE))],
)
def test_derivatives_are_those_of_the_loss(scene, family, column):
    compared, state, own = matched(scene, 0.5)
    own = own[[lateral, height].index(family)]
    rows = family(compared, own)
    gradient = rows.jacobian[:, column] * rows.precision * rows.value
    step = np.zeros(SIZE)
    step[column] = 1e-6
    plus, minus = (family(at(compared, state.moved(s * step)), own).loss for s in (1, -1))
    slack = 0.02 * np.abs(rows.jacobian[:, column]) + 1e-6
    close = np.abs(gradient - (plus - minus) / 2e-6) <= slack
    assert close.mean() > 0.97


@pytest.mark.parametrize("family", [lateral, height])
def test_curvatures_are_second_derivatives_of_the_loss(scene, family):
    compared, _, own = matched(scene, 0.1)
    own = own[[lateral, height].index(family)]
    rows = family(compared, own)
    plus, minus = (family(compared, own + d).loss for d in (1e-3, -1e-3))
    numeric = (plus - 2.0 * rows.loss + minus) / 1e-6
    assert np.allclose(rows.curvature, numeric, atol=0.05)
    assert (rows.curvature <= rows.precision + 1e-9).all()


def test_heights_are_a_mixture_of_two_bells_and_strays(scene):
    compared, state, (_, own) = matched(scene, 0.1)
    own[:] = np.random.default_rng(1).normal(0.0, 0.3, own.shape)
    model, samples = compared.model, compared.placed.samples
    rows = height(compared, own)
    over = height_over_road(compared.lanes, compared.placed, compared.matches)
    noise = np.hypot(model.elevation * samples.reach, compared.scale_m)
    away = over - state.reflection - own.ravel()[samples.spells]
    tall = model.body_share
    bells = [
        share * np.exp(-0.5 * (value / sigma) ** 2) / sigma
        for share, value, sigma in (
            (1.0 - tall, away, np.hypot(model.low, noise)),
            (tall, away - model.body_over, np.hypot(model.body, noise)),
        )
    ]
    stray = STRAY_SHARE * np.sqrt(2.0 * np.pi) / STRAY_HEIGHT_M
    loss = -np.log((1.0 - STRAY_SHARE) * sum(bells) + stray)
    assert np.allclose(rows.loss, np.where(np.isfinite(over), loss, 0.0), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("family", [lateral, height])
@pytest.mark.parametrize("curved", [False, True])
def test_the_random_effects_are_eliminated_from_the_normal_equations(scene, family, curved):
    compared, _, own = matched(scene, 0.3)
    effect = own[[lateral, height].index(family)] + 0.1
    rows = family(compared, effect)
    normal = assemble([rows], [effect], curved=curved)
    of_effect = -(rows.group[:, None] == np.arange(effect.size)).astype(float)
    whole = np.hstack([rows.jacobian, of_effect])
    p = rows.curvature if curved else rows.precision
    mass = -of_effect.T @ (rows.weight * p)
    p = rows.weight * np.where(mass[rows.group] > 0.0, p, 0.0)
    stiffness = block_diag(*rows.stiffness)
    dense = whole.T @ (p[:, None] * whole)
    dense[SIZE:, SIZE:] += stiffness
    pull = whole.T @ (rows.weight * rows.precision * rows.value)
    pull[SIZE:] += stiffness @ effect.ravel()
    out = dense[:SIZE, SIZE:] @ np.linalg.inv(dense[SIZE:, SIZE:])
    expected = dense[:SIZE, :SIZE] - out @ dense[SIZE:, :SIZE]
    assert np.allclose(normal.information, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    gradient = pull[:SIZE] - out @ pull[SIZE:]
    assert np.allclose(normal.gradient, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())
    # a metre more on all rows
    raised = -whole.T @ p
    shift = raised[:SIZE] - out @ raised[SIZE:]
    found = normal.offsets[0].sum(axis=0)
    assert np.allclose(found, shift, rtol=1e-9, atol=1e-9 * np.abs(shift).max())


def test_how_much_higher_a_vehicle_appears_lasts_for_seconds_and_grows_with_the_range(scene):
    samples = scene[0].samples
    model = replace(MODEL, vehicle=0.3, bent=0.02, lasting=4.0)
    covariance, reach = height_covariance(samples, model), samples.spell_reach
    k = int((reach > 0.0).sum(axis=1).argmax())
    seen = np.flatnonzero(reach[k] > 0.0)
    assert len(seen) > 3
    for i in seen:
        for j in seen:
            apart = np.sqrt(3.0) * abs(i - j) * SPELL_S / 4.0
            common = 0.3**2 + 0.02**2 * reach[k, i] * reach[k, j] * (1 + apart) * np.exp(-apart)
            assert covariance[k, i, j] == pytest.approx(common, abs=1e-3)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert not covariance[k][np.ix_(seen, np.flatnonzero(reach[k] == 0.0))].any()


@pytest.mark.parametrize("bent_deg", [0.0, 1.0])
def test_an_error_of_elevation_that_lasts_is_told_from_noise(scene, bent_deg):
    """And the tilt of the sensor is then known less well than from independent returns."""
    scene, state, _ = scene
    rng, samples = np.random.default_rng(6), scene.samples
    bias, noise = np.radians([bent_deg, 0.3])
    angle = bias * rng.normal(size=samples.tracks)[samples.track]
    angle += noise * rng.normal(size=len(samples))
    x, y, z = samples.points.T
    flat = np.hypot(x, y)
    bent_up = np.column_stack([x, y, z + flat * np.tan(angle)])
    recorded = scene.of(replace(samples, points=bent_up))
    fit = solve(recorded, state, prior_at(state))
    _, model = adapted(recorded, fit, prior_at(state), MODEL)
    if bent_deg:
        assert np.degrees(model.bent) == pytest.approx(bent_deg, rel=0.4)
    assert (model.bent > model.elevation) == bool(bent_deg)
    white = replace(model, elevation=np.hypot(model.elevation, model.bent), bent=0.0)
    known, sure = (
        solve(recorded, state, prior_at(state), model=m).information for m in (model, white)
    )
    if bent_deg:
        tilt = [np.linalg.inv(i)[3, 3] for i in (known, sure)]
        assert tilt[0] > 1.1 * tilt[1]


def test_a_start_beside_the_truth_comes_back(scene):
    scene, state, _ = scene
    start = state.moved(np.array([0.8, -0.6, 0.5, 0.01, -0.01, 0.02, 0.0]))
    fit = solve(scene, start, prior_at(start))
    assert fit.converged
    assert np.abs(fit.state.difference(state)[:3]).max() < 0.4
    assert np.linalg.eigvalsh(fit.information)[0] > 0.0


def test_every_match_has_a_doppler_that_its_lane_allows(scene):
    scene, state, _ = scene
    lanes, samples = scene.lanes, scene.samples
    matches = match(lanes, place(samples, state))
    assert matches.found.mean() > 0.95
    sight = (samples.points @ state.R_map_sensor.T)[:, :2]
    sight = sight / np.hypot(*sight.T)[:, None]
    away = np.sum(lanes.along[matches.lane] * sight, axis=1)
    clear = matches.found & (np.abs(samples.range_rate) > 0.6)
    assert (np.sign(away[clear]) == np.sign(samples.range_rate[clear])).all()


@pytest.mark.parametrize(("turn_deg", "bends"), [(0.0, False), (25.0, False), (35.0, True)])
def test_a_lane_that_turns_by_more_than_30_degrees_bends(turn_deg, bends):
    angle = np.radians(np.linspace(0.0, turn_deg, 40))
    step = np.column_stack([np.cos(angle), np.sin(angle)])
    arc, road = np.cumsum(step, axis=0), [[-40.0, 8.0], [40.0, 8.0]]
    centre = gpd.GeoSeries([shapely.LineString(line) for line in (arc, road)], crs="EPSG:25832")
    table = gpd.GeoDataFrame(
        {"centre": centre, "participants": [("vehicle",)] * 2, "speed_limit_kmh": np.nan,
         "one_way": True},
        geometry=centre.buffer(1.5), crs="EPSG:25832",
    )  # fmt: skip
    lanes = sample_lanes(table, np.empty((0, 3)), place=np.zeros(2), reach_m=100.0)
    assert set(lanes.bends[lanes.lane == 0]) == {bends}
    assert set(lanes.bends[lanes.lane == 1]) == {False}


def test_between_two_lanes_a_sample_lies_on_the_nearer_one():
    """Also where the middle of its cell of the raster is nearer to the other lane."""
    street = Street(lanes=CROSSING)
    lanes = sample_lanes(
        street.roads().lanelets, street.road_points(), place=np.array(street.middle), reach_m=60.0
    )
    rng = np.random.default_rng(3)
    k = rng.integers(len(lanes.points), size=3000)
    normal = np.column_stack([-lanes.along[k, 1], lanes.along[k, 0]])
    off = rng.uniform(-2.5, 2.5, len(k))
    spots = lanes.points[k] + np.column_stack([off[:, None] * normal, np.zeros(len(k))])
    spots = spots[np.isfinite(spots[:, 2])]
    samples = Samples(
        points=spots, range_rate=np.zeros(len(spots)), track=np.zeros(len(spots), dtype=np.int64),
        tracks=1, elevation=1.0,
    )  # fmt: skip
    state = State(position=np.zeros(3), R_map_sensor=np.eye(3), reflection=0.6)
    matches = match(lanes, place(samples, state))
    chosen = np.hypot(*(spots - lanes.points[matches.lane])[:, :2].T)
    nearest = cKDTree(lanes.points[:, :2]).query(spots[:, :2])[0]
    # within the half metre by which samples along one lane may be taken for each other
    assert (chosen[matches.found] < np.hypot(nearest, 1.6)[matches.found]).mean() > 0.97
    away = (spots - lanes.points[matches.lane])[:, :2]
    across = np.abs(np.sum(normal_of(lanes, matches.lane) * away, axis=1))
    assert np.mean((across > nearest + 0.3)[matches.found]) < 0.01


def normal_of(lanes, lane):
    return np.column_stack([-lanes.along[lane, 1], lanes.along[lane, 0]])


def test_places_along_a_lane_ascend_as_it_is_driven():
    """On a street that is driven both ways each way has a number and places of its own."""
    street = Street(one_way=False)
    table, place = street.roads().lanelets, street.pose().position[:2]
    lanes = sample_lanes(table, street.road_points(), place=place, reach_m=60.0)
    assert len(np.unique(lanes.lane)) == 2 * len(table)
    same = np.diff(lanes.lane) == 0
    step = np.sum(np.diff(lanes.points[:, :2], axis=0) * lanes.along[1:], axis=1)
    assert step[same] == pytest.approx(np.diff(lanes.s_m)[same], abs=1e-6)
    assert lanes.s_m.min() >= 0.0


def test_a_point_of_unknown_height_lies_on_the_lane_under_it(scene):
    lanes = scene[0].lanes
    points = np.vstack([lanes.points[:50], lanes.points[:50] + [0.0, 0.0, 9.0]])
    points[:50, 2] = np.nan
    way = np.tile(lanes.along[:50], (2, 1))
    found = match_along(lanes, points, way, np.full(100, 5.0), np.full(100, 20.0), least_cosine=0.9)
    assert found.found.tolist() == [True] * 50 + [False] * 50
    ahead, left, _ = lanes.beside(found.lane[:50], points[:50])
    assert np.hypot(ahead, left).max() < 1.0


def test_matching_turned_round_fails(scene):
    scene, state, _ = scene
    backward = scene.of(replace(scene.samples, range_rate=-scene.samples.range_rate))
    loss = [solve(s, state, prior_at(state)).loss.mean() for s in (scene, backward)]
    assert loss[0] + 0.5 < loss[1]


def test_lanes_have_direction_and_the_scanned_height(scene):
    lanes = scene[0].lanes
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


@settings(max_examples=30)
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
    found = level(Scene(lanes=None, samples=samples))
    assert np.linalg.det(found.R_level_sensor) == pytest.approx(1.0)
    up = turn.inv().apply([0, 0, 1])
    assert np.degrees(np.arccos(np.clip(found.R_level_sensor[2] @ up, -1, 1))) < 2.0
    assert found.depth_m == pytest.approx(over_m, abs=0.7)


@settings(max_examples=50)
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
    expected = (angles_from_turn(np.radians(yaw), np.radians(pitch)) @ step[POSE_PART])[TURN]
    assert np.allclose(change[::-1], expected, atol=1e-9)
    assert np.allclose(state.moved(step).difference(state), step, atol=1e-9)


@settings(max_examples=200)
@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda axis: np.linalg.norm(axis) > 1e-3),
    st.one_of(st.floats(0.0, np.pi - 1e-4), st.floats(0.0, 1e-7), st.just(np.pi - 1e-9)),
)
def test_turns_are_those_of_scipy(axis, angle):
    turn = np.array(axis) / np.linalg.norm(axis) * angle
    state = State(position=np.zeros(3), R_map_sensor=np.eye(3), reflection=0.6)
    there = state.moved(np.concatenate([np.zeros(3), turn, [0.0]]))
    assert np.allclose(there.R_map_sensor, Rotation.from_rotvec(turn).as_matrix(), atol=1e-12)
    assert np.allclose(there.difference(state)[TURN], turn, atol=1e-7)


def test_vehicles_vote(scene):
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    rng, samples = np.random.default_rng(2), scene.samples
    worse = replace(fit, loss=fit.loss + rng.uniform(0.1, 0.5, len(samples)))
    assert advantage(fit, worse, samples) > 5.0
    assert advantage(worse, fit, samples) < -5.0
    assert advantage(fit, fit, samples) == 0.0
    one = np.where(samples.track == samples.track[0], 50.0, 0.0)
    assert advantage(fit, replace(fit, loss=fit.loss + one), samples) < 1.5


def test_a_rival_whose_vehicles_all_drive_aside_is_worse(scene):
    """Laid aside by less than a lane, vehicles keep their loss by places of their own."""
    scene, state, _ = scene
    fit, samples = solve(scene, state, prior_at(state)), scene.samples
    there = np.unique(samples.track)
    own = fit.effects[0][:, 0]
    assert fit.aside == pytest.approx(0.5 * np.square(own / MODEL.driver))
    assert fit.aside[there].sum() > 0.0
    rng = np.random.default_rng(4)
    aside = replace(fit, aside=fit.aside + rng.uniform(1.0, 2.0, len(fit.aside)))
    assert advantage(replace(fit, habits=0.0), replace(aside, habits=0.0), samples) > 5.0


def test_less_is_known_by_vehicles_but_what_they_share_moves_the_answer_as_far(scene):
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    hold = np.array([1.0, 0, 0, 0, 0, 0, 0])
    flat = with_information_along(fit, hold, 1.0 / np.linalg.inv(fit.information)[0, 0], 40.0)
    inverse, wide = (np.linalg.inv(each.information) for each in (fit, flat))
    assert flat.biases @ wide == pytest.approx(fit.biases @ inverse)
    assert flat.considered() @ wide == pytest.approx(fit.considered() @ inverse)
    spread, wider = [
        np.linalg.norm(each.scores @ known, axis=0)
        for each, known in ((fit, inverse), (flat, wide))
    ]
    grows = np.sqrt(wide[0, 0] / inverse[0, 0])
    assert grows > 1.2
    assert wider[0] == pytest.approx(grows * spread[0])


def test_a_fit_on_a_bump_begins_again_from_the_lowest_place(scene):
    scene, state, _ = scene
    prior = prior_at(state)
    fit = solve(scene, state, prior)
    bump = replace(fit, state=fit.state.moved(np.array([0.3, 0.3, 0, 0, 0, 0, 0])),
                   cost=fit.cost + 30.0)  # fmt: skip
    again = along_valley(scene, bump, prior, MODEL)
    assert again.cost == pytest.approx(fit.cost, abs=1.0)
    assert again.state.position[:2] == pytest.approx(fit.state.position[:2], abs=0.05)


@given(parts=st.integers(1, 6), turn=st.floats(-3.0, 3.0), way=st.floats(-20.0, 20.0))
def test_parts_of_a_step_along_an_arc_lead_to_its_end(parts, turn, way):
    begin = State(position=np.zeros(3), R_map_sensor=np.eye(3), reflection=0.6)
    step = np.array([way, -0.3 * way, 0.1, 0.0, 0.0, turn, 0.0])
    end, state = begin.moved_along_arc(step), begin
    for _ in range(parts):
        state = state.moved_along_arc(state.to_heading(step, begin) / parts)
    assert np.abs(state.difference(end)).max() < 1e-9
    gap = end.difference(begin)
    assert from_arc(gap[0], gap[1], turn) == pytest.approx(step[:2], abs=1e-9)


def test_what_all_drivers_of_a_lane_do_alike_is_no_preference(scene):
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    prior_cost = 1.5
    there = Rest(
        state=fit.state,
        cost=fit.cost + 0.2 * np.count_nonzero(fit.costs) + prior_cost,
        costs=fit.costs + 0.2 * (fit.costs != 0.0),
        by_offset=fit.by_offset,
        effects=fit.effects,
    )
    agreed = agreed_rise(fit, there, fit.groups)  # by all vehicles alike, so it counts in full
    assert agreed == pytest.approx(there.cost - fit.cost)
    aside = replace(there, by_offset=fit.by_offset + 5.0 * (fit.costs != 0.0))
    assert prior_cost < agreed_rise(fit, aside, fit.groups) < prior_cost + 0.1


@pytest.mark.parametrize("asked_m", [5.0, 12.0, 40.0])
def test_sigma_along_a_valley_grows_no_further_than_the_prior(scene, asked_m):
    """Traffic cannot know less than nothing."""
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    hold = np.array([1.0, 0, 0, 0, 0, 0, 0])
    wide = widened_along(fit, hold, asked_m)
    assert min(asked_m, 6.5) <= certainty(wide).sigma[0] < min(1.1 * asked_m, 12.0)
    assert np.linalg.eigvalsh(wide.data_information).min() > -1e-4
    assert widened_along(wide, hold, 1.0) is wide


def test_a_fit_starts_where_another_one_stopped_with_its_vehicles_places(scene):
    scene, state, _ = scene
    prior, hold = prior_at(state), np.array([1.0, 0, 0, 0, 0, 0, 0])
    schedule = Schedule(scales_m=(0.0,), rounds=20)
    rest = settle(scene, state, prior, schedule=schedule, model=MODEL, hold=hold)
    none = Schedule(scales_m=(0.0,), rounds=0)
    assert solve(scene, rest, prior, schedule=none).cost == pytest.approx(rest.cost)
    assert rest.costs.sum() < rest.cost < solve(scene, rest.state, prior, schedule=none).cost
    held = solve(scene, rest, prior, schedule=schedule, hold=hold)
    assert held.state.position[0] == pytest.approx(state.position[0])


def test_a_rival_that_is_the_same_answer_widens_sigma(scene):
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    alone = certainty(fit).covariance
    both = certainty(fit, rival=fit.state.moved(np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])))
    assert both.covariance[0, 0] - alone[0, 0] == pytest.approx(0.6**2 / 2.0)
    assert both.covariance[1:, 1:] == pytest.approx(alone[1:, 1:])


def test_samples_of_a_vehicle_side_by_side_share_their_weight(scene):
    samples, (compared, _, own) = scene[0].samples, matched(scene, 0.0)
    scene, state, _ = scene
    weight = lateral(compared, own[0]).weight
    assert (weight <= 1.0).all()
    assert weight[samples.crowd == 1].min() > weight[samples.crowd > 4].max()
    twice = replace(
        samples,
        points=np.tile(samples.points, (2, 1)),
        range_rate=np.tile(samples.range_rate, 2),
        track=np.tile(samples.track, 2),
        spell=np.tile(samples.spell, 2),
    )
    once = solve(scene, state, prior_at(state)).data_information
    again = solve(scene.of(twice), state, prior_at(state)).data_information
    assert (np.diag(again)[:2] < 1.7 * np.diag(once)[:2]).all()


def test_each_constant_of_the_model_changes_one_family_alone(scene):
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    compared = replace(
        matched((scene, fit.state, None), 0.0)[0], matches=fit.matches, model=MODEL
    )  # fmt: skip

    def gradient(model):
        families = [
            family(replace(compared, model=model), effect)
            for family, effect in zip((lateral, height), fit.effects, strict=True)
        ]
        return assemble(families, fit.effects, curved=True).gradient

    whole = np.array([(gradient(b) - gradient(a)) / 2.0 for _, a, b in MODEL.variations()])
    assert (np.abs(whole).max(axis=1) > 1e-3).all()
    assert np.allclose(fit.considered(), whole, rtol=1e-6, atol=1e-6 * np.abs(whole).max())


def test_heights_over_the_road_follow_its_slope_and_end_with_the_view(scene):
    scene, state, _ = scene
    placed = place(scene.samples, state)
    matches = match(scene.lanes, placed)
    lanes = replace(scene.lanes, slope=np.linspace(-0.1, 0.1, len(scene.lanes.slope)))
    off = placed.points - lanes.points[matches.lane]
    ahead = np.einsum("ij,ij->i", off[:, :2], lanes.along[matches.lane])
    over = off[:, 2] - lanes.slope[matches.lane] * ahead
    found = height_over_road(lanes, placed, matches)
    seen = ~np.isnan(found)
    assert np.allclose(found[seen], over[seen], atol=1e-9)
    up, flat, upward = placed.arms[:, 2], placed.flat, scene.samples.upward
    lower = np.abs(np.arctan2(up - off[:, 2], flat) - np.arctan2(up, flat))
    widest = scene.samples.elevation - VIEW_EDGE
    in_view = np.abs(upward + np.sign(upward) * lower) < widest
    assert (seen == (matches.found & np.isfinite(over) & in_view)).all()
    assert 0.2 < seen.mean() < 1.0


@pytest.mark.parametrize("higher_m", [-0.2, 0.0, 0.2])
def test_the_height_of_reflections_is_told_by_their_lower_edge(scene, higher_m):
    scene, state, _ = scene
    fit = solve(scene, state, prior_at(state))
    wrong = state.moved(np.array([0.0, 0.0, higher_m, 0.0, 0.0, 0.0, 0.0]))
    seen = replace(fit, state=replace(wrong, reflection=state.reflection + higher_m))
    told = heights(scene, seen)
    right = heights(scene, replace(fit, state=state))
    # whatever the height at which the sensor is thought to be, the edge stays where it is
    assert told.mean_m == pytest.approx(right.mean_m, abs=0.03)


@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_information_keeps_over_its_floor(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 7, 7))
    floor, other = a @ a.T + 0.01 * np.eye(7), b + b.T
    kept = at_least(other, floor)
    assert np.linalg.eigvalsh(kept - floor).min() > -1e-8 * np.abs(kept).max()
    assert np.allclose(at_least(floor + b @ b.T, floor), floor + b @ b.T)


def test_a_look_around_finds_the_better_optimum_beside_one(scene):
    scene, state, _ = scene
    prior, once = prior_at(state), Schedule(scales_m=(0.0,), rounds=1)
    aside = state.moved(np.array([1.0, -1.0, 0.0, 0.0, 0.0, 0.02, 0.0]))
    stuck = Hypothesis(fit=solve(scene, aside, prior, schedule=once), prior=prior)
    found = look_around(scene, stuck)
    best = solve(scene, state, prior)
    assert stuck.fit.cost > best.cost + 50.0
    assert found.fit.cost < best.cost + 5.0
    assert np.abs(found.fit.state.difference(best.state)[:2]).max() < 0.2


def test_tracks_of_one_vehicle_are_one_cluster(scene):
    """Each vehicle twice, as two tracks, whose errors are the same."""
    scene, state, _ = scene
    samples = scene.samples
    twice = replace(
        samples,
        points=np.tile(samples.points, (2, 1)),
        range_rate=np.tile(samples.range_rate, 2),
        track=np.concatenate([samples.track, samples.track + samples.tracks]),
        tracks=2 * samples.tracks,
        spell=np.tile(samples.spell, 2),
        vehicle=None,
    )
    joined = replace(twice, vehicle=np.tile(np.arange(samples.tracks), 2))
    apart, together = (
        solve(scene.of(each), state, prior_at(state)).scores for each in (twice, joined)
    )
    assert np.allclose(together[: samples.tracks], apart.reshape(2, samples.tracks, -1).sum(axis=0))
    assert not together[samples.tracks :].any()
