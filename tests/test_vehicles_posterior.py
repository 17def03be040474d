"""Vehicles as one estimate: what the posterior says of tracks, right, wrong or too short."""

import math
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from gis_radar.hdmap import lane_graph
from gis_radar.tracking import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.paths import Path
from gis_radar.tracking.posterior import Posterior, improve, with_existence
from gis_radar.tracking.posterior.cuts import best_stretches
from gis_radar.tracking.posterior.ends import with_undetected_ends
from gis_radar.tracking.posterior.likelihood import body_coordinates, log_likelihood_ratio, overlap
from gis_radar.tracking.posterior.neighbours import join_neighbours, split_long

BEGIN, RATE = 1e9, 20
EYE = np.array([-30.0, -20.0])
CAR, BUS = 4.5, 12.0


@pytest.fixture(name="graph", scope="module")
def straight_lane():
    line = shapely.LineString([(0, 0, 0), (300, 0, 0)])
    sides = [shapely.force_3d(shapely.offset_curve(line, d), 0.0) for d in (1.75, -1.75)]
    row = (1, *sides, ["vehicle"], True, [])
    names = ["lanelet_id", "left", "right", "participants", "one_way", "successors"]
    return lane_graph(gpd.GeoDataFrame([row], columns=names, geometry="left", crs="EPSG:25832"))


def returns(rng, begin_s, end_s, start_m, speed, length=CAR, each=2.0):
    """Return (n, 4) time, east, north, range rate of a vehicle's rear and its side to the eye."""
    rows = []
    for time in np.arange(begin_s, end_s, 1.0 / RATE):
        for _ in range(rng.poisson(each)):
            at_rear = rng.random() < 0.4
            along = -length / 2 if at_rear else rng.uniform(-length / 2, length / 2)
            left = rng.uniform(-0.9, 0.9) if at_rear else -0.9
            east = start_m + speed * (time - begin_s) + along + rng.normal(0.0, 0.15)
            north = left + rng.normal(0.0, 0.15)
            away = np.array([east, north]) - EYE
            rate = speed * away[0] / np.hypot(*away) + rng.normal(0.0, 0.05)
            rows.append((BEGIN + time, east, north, rate))
    return np.array(rows)


def clutter(rng, seconds, a_frame=1.0):
    """Return (n, 4) detections at rest all over the lane."""
    count = rng.poisson(seconds * RATE * a_frame)
    time = BEGIN + rng.integers(0, int(seconds * RATE), count) / RATE
    east, north = rng.uniform(0, 250, count), rng.uniform(-1.7, 1.7, count)
    return np.column_stack([time, east, north, np.zeros(count)])


def detected(*parts):
    rows = np.vstack(parts)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    away = rows[:, 1:3] - EYE
    range_m = np.hypot(*away.T)
    return MapDetections(
        time=rows[:, 0], points=rows[:, 1:3].copy(), height_m=np.full(len(rows), np.nan),
        range_rate=rows[:, 3], sight=away / range_m[:, None], range_m=range_m,
        sensor=np.zeros(len(rows), np.int64), rcs=np.zeros(len(rows)),
    )  # fmt: skip


def track(detections, begin_s, end_s, start_m, speed, length=CAR):
    """Return a motion along the lane, with the detections that lie on it."""
    first = round((BEGIN + begin_s) * RATE)
    count = round((end_s - begin_s) * RATE)
    s_m = start_m + speed / RATE * np.arange(count)
    time = detections.time - BEGIN
    off = detections.points[:, 0] - start_m - speed * (time - begin_s)
    rows = np.flatnonzero((np.abs(off) < length / 2 + 0.5) & (time >= begin_s) & (time < end_s))
    return Motion(
        rows=rows, path=Path(np.column_stack([np.arange(300.0), np.zeros(300)])), first_step=first,
        s_m=s_m, speed=np.full(count, speed), var_s=np.full(count, 0.1), length_m=length,
        width_m=1.8, length_sigma_m=1.0, p_heavy=0.1, along_m=off[rows],
        left_m=np.zeros(len(rows)),
    )  # fmt: skip


def span_s(motion):
    return motion.first_step / RATE - BEGIN, motion.last_step / RATE - BEGIN


def test_a_right_track_stays_and_one_of_nothing_goes(graph):
    rng = np.random.default_rng(1)
    found = detected(returns(rng, 0, 12, 20.0, 10.0), clutter(rng, 20))
    right = track(found, 0, 12, 20.0, 10.0)
    wrong = track(found, 4, 16, 200.0, -10.0)
    assert Posterior(found, [right]).total_rate.min() > 0.0
    kept = improve([right, wrong], found, graph)
    assert len(kept) == 1
    assert span_s(kept[0]) == pytest.approx((0.0, 12.0), abs=1.0)
    places = np.interp(5.0, np.arange(len(kept[0].s_m)) / RATE, kept[0].places[0][:, 0])
    assert places == pytest.approx(70.0, abs=1.0)


def test_a_track_that_runs_on_without_support_is_trimmed(graph):
    rng = np.random.default_rng(2)
    found = detected(
        returns(rng, 0, 8, 20.0, 10.0), returns(rng, 10, 20, 20.0, 10.0), clutter(rng, 20)
    )
    others = track(found, 10, 20, 20.0, 10.0)
    (first, *_), *_ = sorted(
        (span_s(each), k)
        for k, each in enumerate(improve([track(found, 0, 14, 20.0, 10.0), others], found, graph))
    )
    assert first == pytest.approx((0.0, 8.0), abs=1.0)


def test_a_track_goes_on_along_the_lane_as_far_as_it_is_detected(graph):
    rng = np.random.default_rng(3)
    found = detected(returns(rng, 0, 15, 20.0, 10.0), clutter(rng, 20))
    (longer,) = improve([track(found, 6, 9, 80.0, 10.0)], found, graph)
    assert span_s(longer) == pytest.approx((0.0, 15.0), abs=1.6)
    assert len(longer.rows) > 400


@pytest.mark.parametrize(("each", "least_s", "most_s"), [(2.0, 0.3, 1.7), (0.1, 2.3, 4.0)])
def test_a_vehicle_is_there_undetected_until_silence_costs_as_much_as_an_end(
    each, least_s, most_s, graph
):
    """In plain view sooner; four seconds of which little is due cost less."""
    rng = np.random.default_rng(14)
    found = detected(returns(rng, 4, 16, 50.0, 10.0, each=each), clutter(rng, 20, 0.2))
    known = track(found, 4, 16, 50.0, 10.0)
    (longer,) = with_undetected_ends(Posterior(found, [known]), [known], graph)
    begin, end = span_s(longer)
    assert least_s <= 4.0 - begin <= most_s
    assert least_s <= end - span_s(known)[1] <= most_s
    moved = longer.places[0][0, 0] - known.places[0][0, 0]
    assert moved == pytest.approx(-10.0 * (4.0 - begin), abs=0.01)


@pytest.mark.parametrize(("through", "least_s", "most_s"), [(0, 3.0, 10.1), (4, 0.0, 1.6)])
def test_vehicles_drive_on_where_the_radar_is_blind(through, least_s, most_s, graph):
    """None of eight is detected beyond 100 m: they drive on. Where four others are, they end."""
    rng = np.random.default_rng(18)
    spans = [(4.0 * k, 4.0 * k + (8 if k < 8 else 18)) for k in range(8 + through)]
    parts = [returns(rng, *each, 20.0, 10.0) for each in spans]
    found = detected(*parts, clutter(rng, 80, 0.2))
    known = [track(found, *each, 20.0, 10.0) for each in spans]
    longer = with_undetected_ends(Posterior(found, known), known, graph)
    for one, other in list(zip(known, longer, strict=True))[:8]:
        assert least_s <= span_s(other)[1] - span_s(one)[1] <= most_s


@pytest.mark.parametrize("lasts_s", [0.5, 1.0])
def test_who_is_detected_for_a_moment_is_extended_for_no_longer(lasts_s, graph):
    """Where its silence would cost an end in plain view only after over two seconds."""
    rng = np.random.default_rng(23)
    moment = returns(rng, 4, 4 + lasts_s, 80.0, 10.0, each=2.0)
    others = returns(rng, 20, 32, 50.0, 10.0, each=0.1)
    found = detected(moment, others, clutter(rng, 40, 0.2))
    known = [track(found, 4, 4 + lasts_s, 80.0, 10.0), track(found, 20, 32, 50.0, 10.0)]
    longer, _ = with_undetected_ends(Posterior(found, known), known, graph)
    assert 0.0 < span_s(longer)[1] - (4.0 + lasts_s) <= lasts_s


@pytest.mark.parametrize(("speed", "least_s", "most_s"), [(2.0, 0.3, 0.5), (6.0, 1.0, 1.5)])
def test_the_slower_a_vehicle_is_the_sooner_its_place_is_unknown(speed, least_s, most_s, graph):
    """Who drives at 6 m/s may drive at 3 after 1.5 s."""
    rng = np.random.default_rng(21)
    found = detected(returns(rng, 4, 10, 20.0, speed, each=0.3), clutter(rng, 40, 0.2))
    known = track(found, 4, 10, 20.0, speed)
    (longer,) = with_undetected_ends(Posterior(found, [known]), [known], graph)
    assert least_s <= round(span_s(longer)[1] - span_s(known)[1], 3) <= most_s


def stops(found, begin_s, stops_s, end_s, start_m, speed):
    """Return a motion that drives along the lane, then stands."""
    drives = track(found, begin_s, stops_s, start_m, speed)
    stands = track(found, stops_s, end_s, start_m + speed * (stops_s - begin_s), 0.0)
    both = ("rows", "s_m", "speed", "var_s", "along_m", "left_m")
    joined = {n: np.concatenate([getattr(drives, n), getattr(stands, n)]) for n in both}
    return replace(drives, **joined)


@pytest.mark.parametrize(
    ("each", "least_s", "most_s"), [(2.0, 0.0, 1.6), (0.3, 1.0, 6.0), (0.02, 9.5, 10.1)]
)
def test_who_stopped_is_there_undetected_until_silence_costs_as_much_as_an_end(
    each, least_s, most_s, graph
):
    """In plain view hardly, at the edge of range for ten seconds; nobody who never drove is."""
    rng = np.random.default_rng(21)
    stood = returns(rng, 15, 45, 120.0, 0.0, each=each)
    found = detected(returns(rng, 5, 15, 20.0, 10.0), stood, clutter(rng, 60, 0.2))
    end = stood[-1, 0] - BEGIN
    known = [stops(found, 5, 15, end, 20.0, 10.0), track(found, 15, end, 120.0, 0.0)]
    held, other = (with_undetected_ends(Posterior(found, [m]), [m], graph)[0] for m in known)
    assert least_s <= span_s(held)[1] - span_s(known[0])[1] <= most_s
    assert span_s(other)[1] == pytest.approx(span_s(known[1])[1], abs=0.05)
    assert held.places[0][-1] == pytest.approx(known[0].places[0][-1], abs=0.01)
    assert held.speed[-1] == 0.0


def test_nobody_stands_undetected_where_another_one_drives(graph):
    """Beyond 100 m nobody is detected, but some seconds later another one drives over the place."""
    rng = np.random.default_rng(23)
    parts = [returns(rng, 0, 10, 20.0, 10.0), returns(rng, 10, 15, 120.0, 0.0, each=0.05)]
    found = detected(*parts, returns(rng, 10, 18, 20.0, 10.0), clutter(rng, 60, 0.2))
    stood = stops(found, 0, 10, 15, 20.0, 10.0)
    other = track(found, 10, 26, 20.0, 10.0)
    alone, held = (
        with_undetected_ends(Posterior(found, all_of), all_of, graph)[0]
        for all_of in ([stood], [stood, other])
    )
    assert span_s(alone)[1] > 22.0
    assert 17.0 < span_s(held)[1] < 20.0


def test_an_undetected_vehicle_drives_into_no_other(graph):
    """It ends before the one that stands 20 m ahead of where it was detected last."""
    rng = np.random.default_rng(19)
    found = detected(returns(rng, 0, 20, 130.0, 0.0), returns(rng, 4, 10, 50.0, 10.0, each=0.05))
    known = [track(found, 0, 20, 130.0, 0.0), track(found, 4, 10, 50.0, 10.0)]
    _, longer = with_undetected_ends(Posterior(found, known), known, graph)
    assert longer.places[0][-1, 0] < 128.0


def test_nobody_is_there_before_the_first_frame_or_after_the_last(graph):
    rng = np.random.default_rng(15)
    found = detected(returns(rng, 0, 12, 50.0, 10.0, each=0.1))
    known = track(found, 0, 12, 50.0, 10.0)
    (same,) = with_undetected_ends(Posterior(found, [known]), [known], graph)
    assert span_s(same) == pytest.approx(span_s(known), abs=0.2)


def test_two_tracks_on_one_bus_become_one_that_is_as_long(graph):
    rng = np.random.default_rng(4)
    found = detected(returns(rng, 0, 12, 30.0, 10.0, length=BUS, each=5.0), clutter(rng, 14))
    parts = [track(found, 0, 12, 30.0 + shift, 10.0) for shift in (-3.7, 3.7)]
    (bus,) = improve(parts, found, graph)
    assert bus.length_m == pytest.approx(BUS, abs=0.6)
    assert bus.p_heavy > 0.5


def test_a_track_on_two_cars_becomes_two(graph):
    """They stand 7 m apart behind each other and were followed as one lorry."""
    rng = np.random.default_rng(9)
    found = detected(
        *(returns(rng, 0, 30, place, 0.0, each=4.0) for place in (100.0, 112.0)),
        returns(rng, 0, 9, 10.0, 9.0), clutter(rng, 30, 0.3),
    )  # fmt: skip
    lorry, car = track(found, 0, 30, 106.0, 0.0, length=16.5), track(found, 0, 9, 10.0, 9.0)
    posterior = Posterior(found, [lorry, car])
    assert len(split_long(posterior)) == 3
    standing = [each for each in improve([lorry, car], found, graph) if each.speed.max() < 1.0]
    places = sorted(float(each.places[0][0, 0]) for each in standing)
    assert places == pytest.approx([100.0, 112.0], abs=1.0)


def test_nobody_drives_three_metres_behind_another(graph):
    """What returns like two cars is one lorry where no two drivers keep such a gap for so long."""
    rng = np.random.default_rng(10)
    ends = [returns(rng, 0, 25, 10.0 + shift, 10.0) for shift in (-3.75, 3.75)]
    found = detected(*ends, clutter(rng, 25))
    lorry = track(found, 0, 25, 10.0, 10.0, length=BUS)
    assert len(split_long(Posterior(found, [lorry]))) == 1
    ends = [returns(rng, 0, 2, 10.0 + shift, 14.0, each=3.0) for shift in (-3.75, 3.75)]
    soon = detected(*ends, clutter(rng, 25, 0.3))
    lorry = track(soon, 0, 2, 10.0, 14.0, length=BUS)
    assert len(split_long(Posterior(soon, [lorry]))) == 1
    slow = detected(*(returns(rng, 0, 25, 50.0 + shift, 1.0) for shift in (-3.75, 3.75)))
    queue = track(slow, 0, 25, 50.0, 1.0, length=BUS)
    assert len(split_long(Posterior(slow, [queue]))) == 2


@pytest.mark.parametrize(
    ("apart", "faster", "left", "lasts", "speed"),
    [
        (8.0, 0.02, 1, 14, 10.0),  # ends of a lorry, 3.5 m between them at 36 km/h
        (9.5, 0.02, 1, 14, 10.0),  # of one of 14 m
        (8.0, 0.4, 2, 14, 10.0),  # the second falls behind by 5 m
        (14.0, 0.02, 2, 14, 10.0),  # cars a second apart
        (13.0, 0.01, 2, 40, 6.5),  # in a platoon, however long it keeps together
    ],
)
def test_who_keeps_no_distance_is_the_end_of_another(apart, faster, left, lasts, speed):
    """Both returned like a car of its own, so what lies where does not tell."""
    rng = np.random.default_rng(11)
    starts, speeds = (30.0 + apart, 30.0), (speed, speed - faster)
    parts = [returns(rng, 0, lasts, *each) for each in zip(starts, speeds, strict=True)]
    found = detected(*parts, clutter(rng, lasts + 1))
    motions = [track(found, 0, lasts, *each) for each in zip(starts, speeds, strict=True)]
    assert len(join_neighbours(Posterior(found, motions))) == left


def test_ends_of_tracks_that_are_off_do_not_keep_a_lorry_two():
    """The rear's track was extrapolated: in its first and last 2 s it is up to 5 m off."""
    rng = np.random.default_rng(11)
    found = detected(*(returns(rng, 0, 14, start, 10.0) for start in (38.0, 30.0)))
    front, rear = track(found, 0, 14, 38.0, 10.0), track(found, 0, 14, 30.0, 9.98)
    off = np.interp(np.arange(len(rear.s_m)) / RATE, [0, 2, 12, 14], [-5.0, 0.0, 0.0, 5.0])
    rear = replace(rear, s_m=rear.s_m + off)
    assert len(join_neighbours(Posterior(found, [front, rear]))) == 1


def test_what_the_end_of_another_drives_alone_is_kept():
    """The rear is followed for three seconds longer than the front: that time is not lost."""
    rng = np.random.default_rng(13)
    parts = returns(rng, 0, 18, 38.0, 10.0), returns(rng, 4, 22, 69.92, 9.98)
    found = detected(*parts, clutter(rng, 23))
    front, rear = track(found, 0, 18, 38.0, 10.0), track(found, 4, 21, 69.92, 9.98)
    whole, alone = join_neighbours(Posterior(found, [front, rear]))
    assert span_s(whole) == pytest.approx(span_s(front))
    assert span_s(alone) == pytest.approx((18.0, 21.0), abs=0.2)


def test_tracks_of_one_half_second_that_are_never_there_together_are_not_compared():
    """One ends within the half second in which the other, a brief one, begins."""
    rng = np.random.default_rng(15)
    found = detected(returns(rng, 0, 13, 20.0, 10.0), clutter(rng, 14))
    long, brief = track(found, 0, 12.1, 20.0, 10.0), track(found, 12.2, 12.4, 142.0, 10.0)
    assert len(join_neighbours(Posterior(found, [long, brief]))) == 2


@given(along=st.floats(-9.0, 9.0), left=st.floats(-1.5, 1.5), bend=st.floats(-0.08, 0.08))
def test_places_on_a_bent_body_are_those_along_its_path(along, left, bend):
    """The oracle is a polyline through the same arc."""
    s = np.linspace(-20.0, 20.0, 8001)
    turn = bend * s
    line = np.column_stack([np.cumsum(np.cos(turn)), np.cumsum(np.sin(turn))]) * (s[1] - s[0])
    line -= line[4000]
    at = int(np.searchsorted(s, along))
    place = line[at] + left * np.array([-np.sin(turn[at]), np.cos(turn[at])])
    shape = np.array([0.0, 0.0, 1.0, 0.0, 10.0, 18.0, 2.5, bend, bend])
    found = body_coordinates(shape, *place)
    assert found[:2] == pytest.approx((along, left), abs=0.13)  # less bent is straight
    assert found[2] == pytest.approx(bend * along, abs=0.1 * abs(bend) + 0.03)


def test_who_stands_throughout_is_not_taken_for_what_is_built(graph):
    rng = np.random.default_rng(5)
    found = detected(
        returns(rng, 0, 60, 100.0, 0.0), returns(rng, 0, 9, 10.0, 9.0), clutter(rng, 60, 0.3)
    )
    stands = track(found, 0, 60, 100.0, 0.0)
    kept = improve([stands, track(found, 0, 9, 10.0, 9.0)], found, graph)
    assert max(len(each.s_m) for each in kept if each.speed.max() < 1.0) > 55 * RATE


def test_no_two_are_in_one_place_for_over_a_second(graph):
    rng = np.random.default_rng(6)
    found = detected(returns(rng, 0, 12, 20.0, 10.0, each=4.0), clutter(rng, 14))
    twice = [track(found, 0, 12, 20.0 + shift, 10.0) for shift in (0.0, 0.5)]
    assert len(improve(twice, found, graph)) == 1


def test_who_exists_is_told_from_a_second_one_on_the_same_detections():
    rng = np.random.default_rng(21)
    found = detected(
        returns(rng, 0, 12, 20.0, 10.0), returns(rng, 0, 12, 60.0, 10.0), clutter(rng, 14)
    )
    right, double, other = (track(found, 0, 12, start, 10.0) for start in (20.0, 20.8, 60.0))
    alone = with_existence(Posterior(found, [right, other]), [right, other])
    assert min(each.p_exists for each in alone) > 0.85
    (_, second, far) = with_existence(
        Posterior(found, [right, double, other]), [right, double, other]
    )
    assert second.p_exists < 0.75
    assert far.p_exists == pytest.approx(alone[1].p_exists, abs=0.02)


def test_no_two_are_side_by_side_nearer_than_they_are_wide(graph):
    rng = np.random.default_rng(11)
    found = detected(returns(rng, 0, 12, 20.0, 10.0, each=4.0), clutter(rng, 14))
    one, beside = (track(found, 0, 12, 20.0, 10.0) for _ in range(2))
    beside.path = Path(one.path.points + np.array([0.0, 1.3]))
    posterior = Posterior(found, [one, beside])
    states = posterior.states
    rows = np.arange(states.first[1], states.first[2])
    share = overlap(rows, states.frame, states.shape, posterior.alive, *posterior.by_frame)
    assert share.min() > 0.9
    for aside, overlaps in ((2.0, True), (2.4, False)):  # cars abreast keep 0.3 m clear
        beside.path = Path(one.path.points + np.array([0.0, aside]))
        posterior = Posterior(found, [one, beside])
        states = posterior.states
        share = overlap(rows, states.frame, states.shape, posterior.alive, *posterior.by_frame)
        assert (share.min() > 0.9) == overlaps


def test_the_same_detections_give_the_same_vehicles(graph):
    rng = np.random.default_rng(7)
    found = detected(
        returns(rng, 0, 12, 20.0, 10.0), returns(rng, 3, 12, 20.0, 12.0), clutter(rng, 14)
    )
    given_tracks = [track(found, 0, 12, 20.0, 10.0), track(found, 3, 12, 20.0, 12.0)]
    one, other = (improve(given_tracks, found, graph) for _ in range(2))
    assert [each.s_m.tobytes() for each in one] == [each.s_m.tobytes() for each in other]
    assert improve([], found, graph) == []


def test_gains_are_those_of_the_sum_of_all_vehicles():
    """Adding a vehicle raises each detection's rate by its own; taking it away restores it."""
    rng = np.random.default_rng(8)
    found = detected(returns(rng, 0, 6, 20.0, 10.0), clutter(rng, 8))
    posterior = Posterior(found, [track(found, 0, 6, 20.0, 10.0)])
    before = posterior.total_rate.copy()
    posterior.exclude(0)
    assert (posterior.total_rate <= before + 1e-12).all()
    assert posterior.total_rate.sum() < before.sum()
    posterior.include(0)
    np.testing.assert_allclose(posterior.total_rate, before, rtol=1e-9, atol=1e-15)


@given(
    count=st.integers(0, 30), due=st.floats(0.1, 50.0), alpha=st.floats(0.5, 8.0),
    rest=st.floats(1e-6, 1e-3),
)  # fmt: skip
def test_brightness_is_integrated_out(count, due, alpha, rest):
    """Where the background is faint, the gain is that of a negative binomial distribution."""
    room = np.column_stack([np.full(max(count, 1), 50.0), np.full(max(count, 1), rest)])
    gain, bright = log_likelihood_ratio(room, count, due, alpha)
    exact = (
        math.lgamma(alpha + count) - math.lgamma(alpha) + alpha * math.log(alpha)
        - (alpha + count) * math.log(alpha + due) + count * math.log(50.0 / rest)
    )  # fmt: skip
    assert bright == pytest.approx((alpha + count) / (alpha + due), rel=1e-3)
    assert gain == pytest.approx(exact, rel=1e-3, abs=1e-3)


@given(
    value=st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=9),
    cost=st.floats(0.0, 10.0), end=st.floats(0.0, 8.0),
)  # fmt: skip
def test_stretches_are_the_best_of_all(value, cost, end):
    value = np.array(value)
    n = len(value)

    def worth(kept):
        runs = np.diff(np.concatenate([[0], kept.astype(int), [0]]))
        return value[kept].sum() - (runs == 1).sum() * cost - (runs == -1).sum() * end

    best = max(worth(np.array([k >> j & 1 for j in range(n)], bool)) for k in range(2**n))
    kept = best_stretches(value, np.full(n, cost), np.full(n, end))
    assert worth(kept) == pytest.approx(best, abs=1e-9)
