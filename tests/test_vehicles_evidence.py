"""Evidence of vehicles: expected detections, heights, and the scatterers of a body."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gis_radar.hdmap import LaneGraph
from gis_radar.tracking import MOVING_MPS, ForwardFilter, MapDetections, still_rate
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.paths import Path
from gis_radar.tracking.size import size_of
from gis_radar.tracking.start import stationary
from gis_radar.tracking.start.bodies import one_tall_odds, tall_odds
from gis_radar.tracking.start.detectability import Detectability, Occluders
from gis_radar.tracking.start.links import Part, chains
from gis_radar.tracking.start.passes import Passes
from gis_radar.tracking.start.resting import rate_without, with_rest, without_gaps
from gis_radar.tracking.start.stationary import without_fixed
from gis_radar.tracking.start.strips import Strips

BEGIN = 1_700_000_000.0
RATE = 20


def detections_at(time, points, height_m=0.7):
    away = np.hypot(points[:, 0], points[:, 1])
    return MapDetections(
        time=time,
        points=points,
        height_m=np.full(len(time), height_m),
        range_rate=np.full(len(time), 10.0),
        sight=points / away[:, None],
        range_m=away,
        sensor=np.zeros(len(time), np.int64),
        rcs=np.zeros(len(time)),
    )


def driven(begin, seconds, speed, rows):
    """A vehicle along the line y = 30 m from x = 0, seen from the origin at each of its steps."""
    count = int(seconds * RATE)
    s = 10.0 + speed / RATE * np.arange(count)
    return Motion(
        rows=rows,
        path=Path(np.column_stack([np.arange(-10.0, 200.0), np.full(210, 30.0)])),
        first_step=round(begin * RATE),
        s_m=s,
        speed=np.full(count, speed),
        var_s=np.ones(count),
        length_m=4.5,
        width_m=1.8,
        length_sigma_m=0.5,
        p_heavy=0.0,
        along_m=np.zeros(count),
        left_m=np.zeros(count),
    )


@pytest.fixture(name="learned", scope="module")
def learned_from_two_passages():
    count = 10 * RATE
    time = np.concatenate([BEGIN + np.arange(count) / RATE, BEGIN + 60.0 + np.arange(count) / RATE])
    x = np.tile(10.0 / RATE * np.arange(count), 2)
    detections = detections_at(time, np.column_stack([x, np.full(len(x), 30.0)]))
    motions = [
        driven(BEGIN, 10.0, 10.0, np.arange(count)),
        driven(BEGIN + 60.0, 10.0, 10.0, count + np.arange(count)),
    ]
    return Detectability.learned(detections, motions)


def halves(begin, seconds):
    return int(2 * begin) + np.arange(int(2 * seconds))


def test_a_vehicle_is_expected_to_be_detected_as_often_as_others_there(learned):
    places = np.tile([50.0, 30.0], (8, 1))
    assert learned.expected(places, halves(BEGIN, 4.0), (0, -1)) == pytest.approx(80.0, rel=0.2)


def test_nothing_is_expected_where_nobody_drove(learned):
    places = np.tile([50.0, 90.0], (8, 1))
    assert learned.expected(places, halves(BEGIN, 4.0), (0, -1)) == 0.0


def test_nothing_is_expected_while_the_sensor_is_off(learned):
    places = np.tile([50.0, 30.0], (8, 1))
    assert learned.expected(places, halves(BEGIN + 30.0, 4.0), (-1, -1)) == 0.0


def test_nothing_is_expected_behind_another_vehicle(learned):
    in_the_way = Occluders.stationary(
        7, (BEGIN, BEGIN + 10.0), 25.0, 15.0, np.arctan2(30.0, 50.0), 4.5
    )
    hidden = Detectability(**{**vars(learned), "occluders": in_the_way})
    places = np.tile([50.0, 30.0], (8, 1))
    assert hidden.expected(places, halves(BEGIN, 4.0), (0, -1)) == 0.0
    assert hidden.expected(places, halves(BEGIN, 4.0), (7, -1)) > 40.0
    aside = np.tile([80.0, 30.0], (8, 1))
    assert hidden.expected(aside, halves(BEGIN, 4.0), (0, -1)) > 40.0


def test_too_short_a_silence_is_none(learned):
    places = np.array([[50.0, 30.0], [51.0, 30.0]])
    assert learned.expected_between(places, (BEGIN + 1.0, BEGIN + 1.4), (0, -1)) == 0.0
    assert learned.expected_between(places, (BEGIN + 1.0, BEGIN + 6.0), (0, -1)) > 40.0


def ends_from(cos):
    sin = np.sqrt(1.0 - cos**2)
    return np.column_stack([-np.sign(cos), np.abs(cos), sin])


@pytest.mark.parametrize("length", [4.5, 8.5, 12.0, 16.5])
@pytest.mark.parametrize("often", [5, 400])
def test_a_length_is_found_however_often_the_front_returns(length, often):
    places = np.linspace(-length / 2 + 0.2, length / 2 - 0.2, int(length / 0.5))
    along = np.concatenate([np.repeat(places, 8), np.full(often, length / 2)])
    time = np.concatenate([np.tile(np.arange(8.0), len(places)), np.linspace(0, 8, often)])
    cos = np.full(len(along), -0.95)
    size, ahead = size_of(
        along, ends_from(cos), np.full(len(along), 0.3), time, np.ones(len(along))
    )
    assert size.length_m == pytest.approx(length, abs=0.8)
    assert ahead == pytest.approx(0.0, abs=0.5)


def test_seen_from_one_end_only_a_length_is_that_of_a_car():
    along = np.full(400, 2.2)
    size, _ = size_of(
        along, ends_from(np.full(400, -1.0)), np.full(400, 0.3), np.linspace(0, 20, 400),
        np.ones(400),
    )  # fmt: skip
    assert size.length_m == pytest.approx(4.5, abs=0.5)
    assert size.sigma_m > 1.0


def test_what_passes_by_makes_no_longer():
    along = np.concatenate([np.repeat(np.linspace(-2.0, 2.0, 9), 10), [-9.0, -8.0, -7.0, -6.0]])
    time = np.concatenate([np.tile(np.arange(10.0), 9), [4.0, 4.1, 4.2, 4.3]])
    cos = np.full(len(along), -0.9)
    size, _ = size_of(along, ends_from(cos), np.full(len(along), 0.3), time, np.ones(len(along)))
    assert size.length_m < 6.0


def test_nothing_to_trust_is_a_car():
    none = np.zeros(3)
    size, ahead = size_of(none, ends_from(none + 0.5), none + 0.3, none, none)
    assert (size.length_m, ahead) == (4.5, 0.0)


def test_heights_tell_lorries_from_cars_when_they_are_near():
    near, far = np.full(200, 30.0), np.full(200, 180.0)
    assert tall_odds(np.full(200, 1.8), near) > 2.0
    assert tall_odds(np.full(200, 0.7), near) < -1.0
    assert abs(tall_odds(np.full(200, 1.8), far)) < 1.0
    assert tall_odds(np.full(200, np.nan), near) == 0.0
    assert tall_odds(np.full(3, 1.8), near[:3]) == 0.0


def test_who_stands_on_does_so_until_a_silence():
    time = np.array([0.0, 2.0, 40.0, 45.0, 50.0, 52.0, 58.0, 90.0])
    kept = without_gaps(time, (46.0, 51.0), 10.0)
    assert time[kept].tolist() == [40.0, 45.0, 50.0, 52.0, 58.0]
    assert time[without_gaps(time, (100.0, 101.0), 5.0)].tolist() == []


def road_of(lanes):
    """Return so many lanelets beside each other, 0.3 m apart, along x."""
    s = np.arange(201.0)
    points = [np.column_stack([s, np.full(201, 0.3 * k), np.zeros(201)]) for k in range(lanes)]
    return LaneGraph(
        lanelet_id=np.arange(lanes) + 1,
        length_m=np.full(lanes, 200.0),
        first=np.arange(lanes + 1) * 201,
        points=np.vstack(points),
        s_m=np.tile(s, lanes),
        heading=np.zeros(201 * lanes),
        half_width_m=np.full(201 * lanes, 1.75),
        successors=[np.zeros(0, np.int64)] * lanes,
        origin=np.zeros(2),
    )


def test_branches_that_stay_on_each_other_are_one_way():
    count = 5000
    s = 0.03 * np.arange(count)
    detections = detections_at(
        0.003 * np.arange(count), np.column_stack([10.0 + s, np.zeros(count)])
    )
    forward = ForwardFilter(road_of(2))
    number, _ = forward.push(detections)
    assert set(number[10:].tolist()) == {0}
    assert len(forward.bodies) == 1
    assert forward.branches == 1


@pytest.mark.parametrize("lanes", [1, 2, 3])
def test_a_detection_on_lanes_that_overlap_counts_once_for_a_new_vehicle(lanes):
    x = 50.0 + 0.5 * np.arange(3.0)
    detections = detections_at(0.05 * np.arange(3.0), np.column_stack([x, np.zeros(3)]))
    two, _ = ForwardFilter(road_of(lanes)).push(detections.take(slice(0, 2)))
    three, _ = ForwardFilter(road_of(lanes)).push(detections)
    assert two.tolist() == [-1, -1]
    assert three.tolist() == [0, 0, 0]


def setting_off(fixed):
    """Return detections of one that sets off after 40 s along x = 50 m, or of what is fixed there.

    Detections of the place come all 60 s if they are fixed, else until it has left.
    """
    still = np.arange(0.0, 60.0 if fixed else 40.0, 0.2)
    moving = np.arange(40.05, 50.0, 0.05)
    time = np.concatenate([still, moving])
    x = np.concatenate([np.full(len(still), 50.0), 50.0 + (moving - 40.0) ** 2])
    order = np.argsort(time, kind="stable")
    detections = detections_at(time[order], np.column_stack([x[order], np.zeros(len(time))]))
    drives = (order >= len(still)).nonzero()[0]
    detections.range_rate[:] = 0.0
    detections.range_rate[drives] = 2.0 * (detections.time[drives] - 40.0)
    return detections, drives


def states_of(detections, drives):
    """Return states along x, the motion of the one that drives, and what stands and is not its."""
    states = np.zeros((len(detections), 6))
    states[:, 0], states[:, 3] = detections.points[:, 0], detections.range_rate
    free = np.abs(detections.range_rate) < 0.15
    free[drives] = False
    return states, fit_motion(detections, drives, states), free


@pytest.mark.parametrize("fixed", [False, True])
def test_who_sets_off_stood_before_unless_its_place_returns_without_it(fixed):
    detections, drives = setting_off(fixed)
    states, motion, free = states_of(detections, drives)
    passes = Passes.of([], detections, Strips.of(road_of(1)))
    seen = Detectability.learned(detections, [])
    whole = with_rest(0, motion, detections, free, states, passes, seen)
    begin = whole.first_step / RATE
    assert begin > 39.0 if fixed else begin < 1.0


def test_a_place_is_judged_by_the_seconds_that_were_recorded():
    detections, _ = setting_off(fixed=True)
    detections = detections.take(detections.time < 44.0)
    _, motion, free = states_of(detections, np.flatnonzero(detections.range_rate > 0.0))
    seen = Detectability.learned(detections, [])
    rate = rate_without(0, motion, 0, detections, free, seen)
    assert rate == pytest.approx(5.0, rel=0.2)


def test_a_follower_that_takes_the_place_is_not_of_the_road():
    detections, drives = setting_off(fixed=True)
    states, motion, free = states_of(detections, drives)
    passes = Passes.of([], detections, Strips.of(road_of(1)))
    follower = Occluders.stationary(1, (41.0, 60.0), 50.0, 0.0, 0.0, 4.5)
    seen = Detectability.learned(detections, [])
    seen = Detectability(**{**vars(seen), "occluders": follower})
    whole = with_rest(0, motion, detections, free, states, passes, seen)
    assert whole.first_step / RATE < 1.0


@pytest.mark.parametrize(("crosses_m", "since"), [(2.0, 20.0), (None, 0.0)])
def test_nobody_stood_where_another_crossed_the_place_of_its_front(crosses_m, since):
    """One of 8 m sets off at 40 s; across the lane another drives 2 m ahead of its middle."""
    detections, drives = setting_off(fixed=False)
    states = np.zeros((len(detections), 6))
    states[:, 0], states[:, 3] = detections.points[:, 0], detections.range_rate
    motion = replace(fit_motion(detections, drives, states), length_m=8.0)
    free = np.abs(detections.range_rate) < 0.15
    free[drives] = False
    over = []
    if crosses_m is not None:
        time = 18.0 + np.arange(40.0) / RATE
        front = motion.places[0][0, 0] + crosses_m
        across = np.column_stack([np.full(40, front), 12.0 * (time - 19.0)])
        way = np.zeros((40, 6))
        way[:, :2], way[:, 2], way[:, 3] = across, 0.5 * np.pi, 12.0
        seen_across = detections_at(time, across)
        other = fit_motion(seen_across, np.arange(40), way)
        over = [
            replace(other, rows=np.flatnonzero((detections.time > 17.9) & (detections.time < 20.1)))
        ]
    passes = Passes.of(over, detections, Strips.of(road_of(1)))
    seen = Detectability.learned(detections, [])
    whole = with_rest(0, motion, detections, free, states, passes, seen)
    assert since - 2.0 < whole.first_step / RATE < since + 2.0


def lasting(x, seconds, rows, begin=0.0, left_m=0.0):
    """Return a vehicle that drives eastward from x at 10 m/s, with so many detections."""
    count = int(seconds * RATE)
    path = Path(np.column_stack([np.arange(-200.0, 600.0), np.full(800, left_m)]))
    return Motion(
        rows=np.arange(rows), path=path,
        first_step=int(begin * RATE), s_m=200.0 + x + 0.5 * np.arange(count),
        speed=np.full(count, 10.0), var_s=np.ones(count), length_m=4.5, width_m=1.8,
        length_sigma_m=0.5, p_heavy=0.0, along_m=np.zeros(rows), left_m=np.zeros(rows),
    )  # fmt: skip


@given(step=st.tuples(st.integers(-50, 700), st.integers(-50, 700)))
def test_a_part_of_a_motion_is_where_the_whole_is(step):
    time = np.arange(0.0, 30.0, 0.05)
    whole = lasting(0.0, 30.0, 600)
    first, last = min(step), max(step)
    part = whole.between(first, last, time)
    inside = (np.arange(600) >= first) & (np.arange(600) <= last)
    if not inside.any():
        assert part is None
        return
    assert part.rows.tolist() == np.flatnonzero(inside).tolist()
    assert part.at(time[inside])[0] == pytest.approx(whole.at(time[inside])[0])


@given(odds=st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)), more=st.floats(0.0, 2.0))
def test_one_lorry_needs_two_tall_parts(odds, more):
    given = one_tall_odds(odds)
    assert one_tall_odds((odds[1], odds[0])) == pytest.approx(given)
    assert one_tall_odds((odds[0] + more, odds[1])) >= given
    assert one_tall_odds((4.0, -3.0)) < 0.0 < one_tall_odds((2.0, 2.0))


def part(begin, end, places, speeds, *, stationary=False):
    return Part(
        time=np.array([begin, end]), place=np.array([[x, 0.0] for x in places]),
        heading=np.zeros(2), speed=np.array(speeds, float), stationary=stationary,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("other", "follows"),
    [
        (part(12.0, 20.0, (70.0, 150.0), (10.0, 10.0)), True),  # drove on for 2 s
        (part(12.0, 20.0, (56.0, 150.0), (10.0, 10.0)), False),  # 6 m in 2 s between 10 m/s
        (part(18.0, 20.0, (130.0, 150.0), (10.0, 10.0)), False),  # missed for too long
        (part(12.0, 20.0, (40.0, 150.0), (10.0, 10.0)), False),  # behind
        (part(12.0, 20.0, (70.0, 70.0), (0.0, 0.0), stationary=True), False),  # from 10 m/s to none
    ],
)
def test_who_drove_on_unseen_is_one(other, follows, learned):
    nothing = detections_at(np.zeros(1), np.ones((1, 2)))
    passes = Passes.of([], nothing, Strips.of(road_of(1)))
    one = part(0.0, 10.0, (0.0, 50.0), (10.0, 10.0))
    found = chains([one, other], passes, learned)
    assert found == ([[0, 1]] if follows else [[0], [1]])


@pytest.mark.parametrize(("driven_over", "follows"), [(False, True), (True, False)])
def test_who_waited_is_one_unless_its_place_was_driven_over(driven_over, follows, learned):
    one = part(0.0, 10.0, (0.0, 50.0), (10.0, 0.5))
    other = part(40.0, 50.0, (51.0, 150.0), (0.5, 10.0))
    time = np.arange(0.0, 60.0, 0.05)
    over = [lasting(-150.0, 30.0, 600)] if driven_over else []
    detections = detections_at(time, np.ones((len(time), 2)))
    passes = Passes.of(over, detections, Strips.of(road_of(1)))
    found = chains([one, other], passes, learned)
    assert found == ([[0, 1]] if follows else [[0], [1]])


@pytest.mark.parametrize("through", [True, False])
def test_what_is_seen_while_others_drive_over_it_holds_no_vehicle(through):
    graph = road_of(1)
    time = np.arange(0.0, 60.0, 0.1)
    detections = detections_at(time, np.tile([100.0, 0.0], (len(time), 1)))
    beside_m = 0.0 if through else 30.0
    drivers = [lasting(0.0, 20.0, len(time), begin, beside_m) for begin in (0, 20, 40)]
    passes = Passes.of(drivers, detections, Strips.of(graph))
    left = without_fixed(detections, np.ones(len(time), bool), passes)
    assert left.all() != through
    assert left.any() != through


def test_what_comes_more_often_than_the_road_returns_is_none_of_it():
    """The road returns all the time; one stands on it between the second and the third driver."""
    rng = np.random.default_rng(3)
    begins, graph = (0, 20, 60, 80), road_of(1)
    road, still = np.sort(rng.uniform(0.0, 100.0, 4000)), np.sort(rng.uniform(30.0, 55.0, 1500))
    time = np.concatenate([road, still])
    order = np.argsort(time)
    places = rng.uniform([97.0, -1.0], [103.0, 1.0], (len(time), 2))
    detections = detections_at(time[order], places[order])
    drivers = [lasting(0.0, 20.0, len(time), begin) for begin in begins]
    passes = Passes.of(drivers, detections, Strips.of(graph))
    left = detections.time[without_fixed(detections, np.ones(len(time), bool), passes)]
    inside = (left > 29.0) & (left < 56.0)
    assert inside.mean() > 0.97
    assert inside.sum() > 0.9 * len(still)


def test_a_radar_with_more_noise_needs_more_to_seem_to_move():
    rng = np.random.default_rng(1)
    quiet, noisy = (rng.normal(0.0, sigma, 50_000) for sigma in (0.016, 0.05))
    driven = rng.uniform(-20.0, 20.0, 5_000)
    assert still_rate(np.append(quiet, driven)) == MOVING_MPS
    limit = still_rate(np.append(noisy, driven))
    assert limit == pytest.approx(0.25, rel=0.05)
    assert (np.abs(noisy) > limit).mean() < 1e-4
    # where nothing that stands is recorded, nothing tells how much it would scatter
    creeping = rng.uniform(-2.0, 2.0, 50_000)
    assert still_rate(driven) == MOVING_MPS
    assert still_rate(np.append(creeping, driven)) == MOVING_MPS


def test_fixed_returns_do_not_hold_one_who_drives_across_the_view():
    """Seen from the side it has the range rate of what stands beside the lane, and drives on."""
    time = np.arange(0.0, 8.0, 0.05)
    car = np.column_stack([60.0 + 10.0 * time, np.zeros(len(time))])
    points = np.concatenate([car, np.tile([101.0, 1.5], (len(time), 1))])
    when = np.tile(time, 2)
    order = np.argsort(when, kind="stable")
    away = points - [100.0, -30.0]
    sight = away / np.hypot(*away.T)[:, None]
    rate = np.append(10.0 * sight[: len(time), 0], np.zeros(len(time)))
    detections = MapDetections(
        time=when[order], points=points[order], height_m=np.full(len(when), 0.7),
        range_rate=rate[order], sight=sight[order], range_m=np.hypot(*away.T)[order],
        sensor=np.zeros(len(when), np.int64), rcs=np.zeros(len(when)),
    )  # fmt: skip
    number, state = ForwardFilter(road_of(1)).push(detections)
    fixed = order >= len(time)
    assert (number[fixed] < 0).all()
    moving = ~fixed & (np.abs(detections.range_rate) > 0.15)
    assert len(np.unique(number[moving])) == 1
    assert state[moving][-1, 3] == pytest.approx(10.0, abs=0.5)


@pytest.mark.parametrize("rate", [0.25, 0.5, 5.0])
def test_a_fixed_thing_that_returns_seldom_is_built_too(rate, monkeypatch):
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0.0, 300.0, int(300.0 * rate)))
    detections = detections_at(time, np.tile([100.0, 0.0], (len(time), 1)))
    drivers = [lasting(0.0, 20.0, len(time), begin) for begin in range(0, 280, 20)]
    monkeypatch.setattr(stationary, "FIXED_SHARE", 0.2)
    passes = Passes.of(drivers, detections, Strips.of(road_of(1)))
    left = without_fixed(detections, np.ones(len(time), bool), passes)
    assert left.mean() < 0.1
