"""The stages of the search for vehicles, each on a road made for it."""

from itertools import pairwise
from types import SimpleNamespace

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.ops import substring

import gis_radar as gr
from gis_radar.hdmap import lane_graph
from gis_radar.tracking import ForwardFilter, MapDetections
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.motion import fit_motion, non_decreasing
from gis_radar.tracking.paths import Path, path_through
from gis_radar.tracking.start import bodies
from gis_radar.tracking.start.bodies import join_directions
from gis_radar.tracking.start.stationary import STRIP_CELL_M, pack
from gis_radar.tracking.tracker import vehicles_in


def lanelets(*rows):
    """Return lanelets of (id, centre points, width, successors)."""
    table = []
    for number, points, width, after in rows:
        line = shapely.LineString([(*point, 0.0) for point in points])
        left, right = (
            shapely.force_3d(shapely.offset_curve(line, side * width / 2), 0.0) for side in (1, -1)
        )
        table.append((number, left, right, ["vehicle"], True, list(after)))
    names = ["lanelet_id", "left", "right", "participants", "one_way", "successors"]
    return gpd.GeoDataFrame(table, columns=names, geometry="left", crs="EPSG:25832")


@pytest.fixture(scope="module")
def straight():
    """Return two lanelets one after the other without a common node, and one beside them."""
    return lane_graph(
        lanelets(
            (1, [(0, 0), (100, 0)], 3.5, []),
            (2, [(100.4, 0.1), (200, 0)], 3.5, []),
            (3, [(200, 3.5), (0, 3.5)], 3.5, []),
        )
    )


def detections_at(time, points, rate, eye=(-50.0, 0.0)):
    time, points = np.asarray(time, float), np.asarray(points, float)
    away = points - eye
    range_m = np.hypot(*away.T)
    return MapDetections(
        time=time, points=points, height_m=np.full(len(time), 0.8), range_rate=np.asarray(rate),
        sight=away / range_m[:, None], range_m=range_m, sensor=np.zeros(len(time), np.int64),
        rcs=np.zeros(len(time)),
    )  # fmt: skip


def driving(speed, begin_s, end_s, start_m, rng, left_m=0.0, length_m=4.5):
    """Return detections of the rear of a vehicle that drives east: times, places, range rates."""
    time = np.arange(begin_s, end_s, 0.05) + 1e9
    x = start_m + speed * (time - 1e9 - begin_s) - length_m / 2 + rng.normal(0, 0.1, len(time))
    points = np.column_stack([x, left_m + rng.normal(0, 0.2, len(time))])
    return time, points, speed + rng.normal(0, 0.03, len(time))


def test_lanelets_that_share_no_nodes_follow_each_other(straight):
    assert [each.tolist() for each in straight.successors] == [[1], [], []]
    assert [each.tolist() for each in straight.reversed.successors] == [[], [0], []]


@pytest.mark.parametrize(("lane", "begin", "way"), [(0, 0.0, 1.0), (2, 200.0, -1.0)])
def test_points_by_metre_lie_in_the_middle_of_the_lane(straight, lane, begin, way):
    points, left = straight.by_metre(lane)
    along = 0.5 + np.arange(100 if lane == 0 else 200)
    assert points[:, 0] + straight.origin[0] == pytest.approx(begin + way * along, abs=1e-3)
    assert left == pytest.approx(np.tile([0.0, way], (len(along), 1)), abs=1e-3)
    assert straight.by_metre(lane)[0] is points


@given(x=st.floats(-5, 205), y=st.floats(-6, 8))
def test_lanes_at_a_point_as_shapely_finds_them(straight, x, y):
    found = straight.field.lanes(np.array([[x, y]]) - straight.origin)
    shapes = {
        0: shapely.LineString([(0, 0), (100, 0)]),
        1: shapely.LineString([(100.4, 0.1), (200, 0)]),
        2: shapely.LineString([(200, 3.5), (0, 3.5)]),
    }
    wide = 3.5 / 2 + 1.0
    for lane, line in shapes.items():
        s = line.project(shapely.Point(x, y))
        inside = 0.01 < s < line.length - 0.01
        apart = line.distance(shapely.Point(x, y))
        row = found[found["lane"] == lane]
        if inside and apart < wide - 0.01:
            assert row["s_m"].item() == pytest.approx(s, abs=0.05)
            assert abs(row["d_m"].item()) == pytest.approx(apart, abs=0.02)
        elif apart > wide + 0.01:
            assert row.empty


def test_the_filter_follows_one_vehicle_from_end_to_end(straight):
    rng = np.random.default_rng(1)
    time, points, rate = driving(12.0, 0.0, 15.0, 5.0, rng)
    keep = rng.random(len(time)) < 0.5
    detections = detections_at(time[keep], points[keep] - straight.origin, rate[keep])
    number, state = ForwardFilter(straight).push(detections)
    assert set(number.tolist()) <= {NONE, 0}
    assert (number == 0).mean() > 0.95
    assert state[number == 0][50:, 3] == pytest.approx(12.0, abs=0.5)


@pytest.fixture(scope="module")
def fork():
    """Return a lanelet that goes on straight, and to the left through a quarter of a circle."""
    bend = np.linspace(0.0, np.pi / 2, 30)
    left = [(100 + 15 * np.sin(a), 15 - 15 * np.cos(a)) for a in bend]
    return lane_graph(
        lanelets(
            (1, [(0, 0), (100, 0)], 3.5, [2, 3]),
            (2, [(100, 0), (200, 0)], 3.5, []),
            (3, [*left, (115, 115)], 3.5, []),
        )
    )


def through(fork, *, turns, strays=False):
    """Return detections of one at 8 m/s through a fork, and where it truly is and heads to.

    One that strays drives to the left at first and comes back to the lane that goes on straight.
    """
    rng = np.random.default_rng(3)
    s = np.arange(60.0, 160.0, 0.4)
    angle = np.clip((s - 100.0) / 15.0, 0.0, np.pi / 2) * turns
    after = np.maximum(s - 100.0 - 15.0 * np.pi / 2, 0.0) * turns
    east = np.minimum(s, 100.0) + 15.0 * np.sin(angle) if turns else s
    left = np.minimum(np.maximum(s - 100.0, 0.0) ** 2 / 30.0, 0.2 * np.maximum(118.0 - s, 0.0))
    aside = left * strays
    true = np.column_stack([east, 15.0 * (1.0 - np.cos(angle)) + after + aside])
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    eye = np.array([20.0, -20.0])
    sight = (true - eye) / np.hypot(*(true - eye).T)[:, None]
    rate = 8.0 * (sight * way).sum(axis=1)
    points = true + rng.normal(0.0, 0.2, true.shape) - fork.origin
    return detections_at(1e9 + (s - 60.0) / 8.0, points, rate, eye - fork.origin), true, angle


def test_speeds_in_a_bend_that_is_drawn_in_chords_are_right_where_it_is_seen_across():
    """Seen across, a direction off by 12 degrees makes the speed of a range rate wrong by half."""
    corner = np.linspace(0.0, np.pi / 2, 5)
    bend = [(100.0 + 13.0 * np.sin(a), 13.0 - 13.0 * np.cos(a)) for a in corner]
    graph = lane_graph(
        lanelets(
            (1, [(40.0, 0.0), (100.0, 0.0)], 3.5, [2]),
            (2, bend, 3.5, [3]),
            (3, [bend[-1], (113.0, 80.0)], 3.5, []),
        )
    )
    rng, speed = np.random.default_rng(5), 9.0
    time = np.repeat(np.arange(0.0, 13.0, 0.05), 3)
    s = 45.0 + speed * time
    angle = np.clip((s - 100.0) / 13.0, 0.0, np.pi / 2)
    after = np.maximum(s - 100.0 - 13.0 * np.pi / 2, 0.0)
    middle = np.column_stack([np.minimum(s, 100.0) + 13.0 * np.sin(angle),
                              13.0 * (1.0 - np.cos(angle)) + after])  # fmt: skip
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    on = rng.uniform(-2.2, 2.2, (len(s), 1)) * way
    points = middle + on + rng.normal(0.0, 0.1, middle.shape)
    eye = np.array([127.6, -14.6])
    sight = (points - eye) / np.hypot(*(points - eye).T)[:, None]
    rate = speed * (sight * way).sum(axis=1) + rng.normal(0.0, 0.05, len(s))
    kept = rng.random(len(s)) < 0.5
    detections = detections_at(
        1e9 + time[kept], points[kept] - graph.origin, rate[kept], eye - graph.origin
    )
    number, state = ForwardFilter(graph).push(detections)
    assert set(number.tolist()) <= {NONE, 0}
    motion = fit_motion(detections, np.flatnonzero(number == 0), state)
    assert motion.speed[20:-20] == pytest.approx(speed, abs=1.0)


@pytest.mark.parametrize("turns", [False, True])
def test_where_lanes_fork_the_filter_follows_the_branch_that_was_taken(fork, turns):
    detections, true, angle = through(fork, turns=turns)
    number, state = ForwardFilter(fork).push(detections)
    assert set(number[10:].tolist()) == {0}
    away = state[10:, :2] + fork.origin - true[10:]
    assert np.hypot(*away.T).max() < 2.0  # also where the lanes still lie on each other
    off = np.angle(np.exp(1j * (state[10:, 2] - angle[10:])))
    assert np.abs(off).max() < 0.4


def test_what_comes_later_tells_which_branch_was_taken(fork):
    detections, _, _ = through(fork, turns=False, strays=True)
    number, state = ForwardFilter(fork).push(detections)
    alone = ForwardFilter(fork)
    singly = [alone.push(detections.take(slice(k, k + 1))) for k in range(len(detections))]
    then = np.vstack([each for _, each in singly])
    own = number[10:] == 0
    assert own.mean() > 0.95
    off, before = (np.abs(each[10:, 2][own]).max() for each in (state, then))
    assert off < 0.15 < before
    assert np.concatenate([each for each, _ in singly])[10:].tolist() == number[10:].tolist()


@pytest.mark.parametrize("size", [1, 3, 50])
def test_detections_in_chunks_are_of_the_same_vehicles(fork, size):
    detections, _, _ = through(fork, turns=True)
    whole, state = ForwardFilter(fork).push(detections)
    chunked = ForwardFilter(fork)
    parts = [
        chunked.push(detections.take(slice(k, k + size))) for k in range(0, len(detections), size)
    ]
    assert np.concatenate([each for each, _ in parts])[50:].tolist() == whole[50:].tolist()
    assert parts[-1][1][-1] == pytest.approx(state[-1])


@settings(max_examples=30)
@given(k=st.integers(5, 95), heading=st.floats(0.8, 5.4))
def test_a_state_off_the_way_that_a_vehicle_can_turn_makes_no_loop(k, heading):
    x = np.arange(0.0, 100.0)
    states = np.column_stack([x, np.zeros(100), np.zeros(100), x / 8.0])
    way = np.array([np.cos(heading), np.sin(heading)])
    states[k, :3] = [*(states[k - 1, :2] + 1.5 * way), heading]
    path, along = path_through(states, 1.0)
    places, headings = path.at(np.arange(15.0, path.s_m[-1] - 15.0))
    assert np.abs(places[:, 1]).max() < 0.5
    assert np.abs(headings).max() < 0.3
    assert np.all(np.diff(along) >= 0.0)
    assert path.at(along)[0][:, 0] == pytest.approx(x, abs=2.5)


def test_a_path_keeps_the_radius_of_its_bend():
    """A bell of that width alone would lay it 0.7 m inside the bend."""
    s, radius_m = np.arange(0.0, 100.0), 13.0
    angle = np.clip((s - 40.0) / radius_m, 0.0, np.pi / 2)
    after = np.maximum(s - 40.0 - radius_m * np.pi / 2, 0.0)
    states = np.column_stack([
        np.minimum(s, 40.0) + radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle)) + after,
        angle, s / 8.0,
    ])  # fmt: skip
    path, along = path_through(states, 1.0)
    true = shapely.LineString(states[:, :2])
    assert true.distance(shapely.points(path.at(along)[0])).max() < 0.2


@pytest.mark.parametrize("strays", [[0, 1, 2], [50, 51], [97, 98, 99], [20, 40, 60, 80]])
def test_states_that_no_vehicle_could_reach_in_time_are_no_part_of_its_path(strays):
    """They lie 70 m ahead, as of one ahead of it that is followed against time."""
    x = np.arange(0.0, 100.0)
    states = np.column_stack([x, np.zeros(100), np.zeros(100), x / 8.0])
    states[strays, 0] += 70.0
    states[strays, 1] = 8.0
    path, along = path_through(states, 1.0)
    places, headings = path.at(np.arange(15.0, path.s_m[-1] - 15.0))
    assert np.abs(places[:, 1]).max() < 0.5
    assert np.abs(headings).max() < 0.3
    assert np.all(np.diff(along) >= 0.0)
    kept = np.setdiff1d(np.arange(100), strays)
    assert path.at(along)[0][kept, 0] == pytest.approx(x[kept], abs=5.0)


@pytest.mark.parametrize("at", ["begin", "end"])
def test_a_few_detections_of_something_else_do_not_spoil_a_motion(at):
    """Three of one who walks behind, before or after a car drives by, 40 m away."""
    time = np.arange(0.0, 8.0, 0.1)
    s = 20.0 + 12.0 * time
    walk = np.arange(3.0) * 0.5 + (-3.5 if at == "begin" else 11.0)
    all_time = np.concatenate([time, walk])
    order = np.argsort(all_time)
    there = -20.0 if at == "begin" else 60.0
    places = np.concatenate([s, np.full(3, there)])[order]
    points = np.column_stack([places, np.zeros(len(places))])
    rates = np.concatenate([np.full(len(time), 12.0), np.full(3, 0.5)])[order]
    walks = (np.arange(len(order)) >= len(time))[order]
    eye = np.array([-200.0, -10.0])
    detections = detections_at(1e9 + all_time[order], points, rates, eye)
    states = np.column_stack([points, np.zeros(len(points)), rates, np.full((len(points), 2), 2.0)])
    motion = fit_motion(detections, np.arange(len(points)), states)
    s_m, speed = motion.at(detections.time[~walks])
    sure = (time > 1.5) & (time < 6.5)
    assert speed[sure] == pytest.approx(12.0, abs=0.5)
    assert np.abs(motion.path.at(s_m)[0][:, 0] - places[~walks])[sure].max() < 4.0


def test_who_is_followed_for_long_is_not_given_up_for_one_who_comes_behind():
    """It stands for 10 s and leaves; another one comes to stand 2 m behind for 10 s."""
    time = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(22.0, 30.0, 0.1)])
    s = np.where(time < 16.0, 40.0, 40.0 + 3.0 * np.clip(time - 16.0, 0.0, None) ** 2)
    behind = time > 21.0
    s[behind] = 34.0
    rate = np.where((time > 16.0) & ~behind, 6.0 * (time - 16.0), 0.0)
    points = np.column_stack([s, np.zeros(len(s))])
    detections = detections_at(1e9 + time, points, rate, (-200.0, -10.0))
    states = np.column_stack([points, np.zeros(len(s)), rate, np.full((len(s), 2), 2.0)])
    motion = fit_motion(detections, np.arange(len(s)), states)
    s_m, _ = motion.at(detections.time[~behind])
    assert motion.path.at(s_m)[0][:, 0] == pytest.approx(s[~behind], abs=4.0)
    assert motion.speed[-1] > 10.0  # as far as its own detections tell


def test_places_never_go_back_and_stay_as_near_as_they_can():
    ahead = np.concatenate([np.arange(50.0), [80.0, 81.0], np.arange(50.0, 100.0)])
    assert np.abs(non_decreasing(ahead) - ahead).sum() < 100.0
    assert (np.diff(non_decreasing(ahead)) >= 0.0).all()
    late = np.concatenate([np.arange(50.0), [20.0, 21.0], np.arange(50.0, 100.0)])
    assert np.abs(non_decreasing(late) - late).sum() < 100.0
    assert (np.diff(non_decreasing(late)) >= 0.0).all()


def test_numbers_of_both_directions_become_one():
    time = np.arange(8.0)
    number = np.array([0, 0, 0, 0, NONE, 1, 1, 1])
    against = np.array([5, 5, 5, 5, 5, 5, 5, 5])
    number = np.repeat(number, 4)
    joined = join_directions(number, np.repeat(against, 4), np.repeat(time, 4))
    assert len(set(joined.tolist())) == 1


def test_two_that_drive_beside_each_other_in_time_stay_two():
    time = np.tile(np.arange(0.0, 4.0, 0.1), 2)
    number = np.repeat([0, 1], 40)
    joined = join_directions(number, np.zeros(80, np.int64), time)
    assert set(joined.tolist()) == {0, 1}


def test_speed_place_and_length_of_a_vehicle_that_stops_and_goes(straight):
    rng = np.random.default_rng(2)
    time = np.arange(0.0, 32.0, 0.05)
    speed = np.interp(time, [0.0, 4.0, 9.0, 20.0, 25.0, 32.0], [10.0, 10.0, 0.0, 0.0, 10.0, 10.0])
    middle = 5.0 + np.cumsum(speed) * 0.05
    points = np.column_stack([middle - 2.25, np.zeros(len(time))])
    points += rng.normal(0.0, (0.1, 0.2), points.shape)
    rate = speed + rng.normal(0, 0.02, len(time))
    rate[speed == 0.0] = 0.0
    (one,) = vehicles_in(detections_at(time + 1e9, points - straight.origin, rate), straight)
    own = np.arange(one.first_step, one.last_step + 1) / 20.0 - 1e9
    assert own[[0, -1]] == pytest.approx([0.0, 32.0], abs=0.3)
    stationary = (own > 10.0) & (own < 19.0)
    assert one.speed[stationary].max() < 0.2
    place, _ = one.places
    assert place[stationary, 0] + straight.origin[0] == pytest.approx(70.0, abs=1.0)
    assert one.length_m == pytest.approx(4.5, abs=1.0)


def test_a_sign_at_the_edge_of_a_lane_is_no_vehicle(straight):
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 60.0, 0.05) + 1e9
    points = np.column_stack([rng.normal(60, 0.1, len(time)), rng.normal(-1.7, 0.05, len(time))])
    detections = detections_at(time, points - straight.origin, np.zeros(len(time)))
    assert vehicles_in(detections, straight) == []


def test_what_others_drive_over_does_not_stand(straight):
    rng = np.random.default_rng(4)
    plate_t = np.arange(0.0, 60.0, 0.1) + 1e9
    plate = np.column_stack([rng.normal(60, 0.1, len(plate_t)), rng.normal(0, 0.1, len(plate_t))])
    parts = [(plate_t, plate, np.zeros(len(plate_t)))]
    parts += [driving(12.0, at, at + 12.0, 5.0, rng) for at in (3.0, 12.0, 21.0, 30.0, 39.0, 48.0)]
    order = np.argsort(np.concatenate([each[0] for each in parts]), kind="stable")
    time, points, rate = (np.concatenate([each[k] for each in parts])[order] for k in range(3))
    found = vehicles_in(detections_at(time, points - straight.origin, rate), straight)
    standing_s = sum(float((each.speed < 0.5).sum()) / 20.0 for each in found)
    assert sum(each.speed.max() > 5.0 for each in found) == 6
    assert standing_s < 30.0


@given(gap_m=st.floats(1.5, 6.0), count=st.integers(1, 4))
def test_a_queue_is_packed_into_its_vehicles(gap_m, count):
    weights = np.zeros((3, 400))
    rears = [10.0 + k * (4.5 + gap_m) for k in range(count)]
    for rear in rears:
        for place, kind in ((rear + 0.1, 1), (rear + 4.4, 0)):
            weights[kind, int(place / STRIP_CELL_M)] = 8.0
    found = pack(weights, np.full(401, NONE, np.int64)) * STRIP_CELL_M
    assert len(found) == count
    assert np.sort(found[:, 0]) == pytest.approx(rears, abs=0.6)
    assert np.sort(found[:, 1]) == pytest.approx(np.add(rears, 4.5), abs=0.6)


@given(s=st.floats(-3, 30), left=st.floats(-2, 2))
def test_a_path_gives_back_what_is_laid_on_it(s, left):
    path = Path(np.column_stack([np.arange(0.0, 26.0), np.zeros(26)]))
    along, beside = path.project(np.array([[s, left]]), np.array([s]), 10.0)
    assert along[0] == pytest.approx(s, abs=1e-9)
    assert beside[0] == pytest.approx(left, abs=1e-9)


@given(
    turns=st.lists(st.floats(-0.9, 0.9), min_size=2, max_size=40),
    steps=st.lists(st.floats(0.2, 6.0), min_size=40, max_size=40),
    guess=st.floats(0.0, 120.0),
    off=st.tuples(st.floats(-25.0, 25.0), st.floats(-25.0, 25.0)),
    reach=st.floats(1.0, 40.0),
)
def test_a_place_on_a_path_is_the_nearest_one_about_the_guess(turns, steps, guess, off, reach):
    """Shapely is the oracle: no place within reach of the guess is nearer, ends go on straight."""
    heading, step = np.cumsum(turns), np.array(steps[: len(turns)])
    ways = step[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    path = Path(np.vstack([[0.0, 0.0], np.cumsum(ways, axis=0)]))
    guess = min(guess, float(path.s_m[-1]))
    place, _ = path.at(np.array([guess]))
    point = place[0] + off
    along, left = path.project(point[None], np.array([guess]), reach)
    nearest, _ = path.at(along)
    beyond = 200.0 * np.column_stack([np.cos(heading), np.sin(heading)])[[0, -1]]
    line = shapely.LineString([-beyond[0], *path.points, path.points[-1] + beyond[1]])
    within = substring(line, 200.0 + guess - reach, 200.0 + guess + reach)
    found_m = float(np.hypot(*(point - nearest[0])))
    assert found_m <= within.distance(shapely.Point(point)) + 1e-6
    assert abs(left[0]) <= found_m + 1e-6
    # at most one segment farther than the reach, or beyond an end, where the path goes on
    inside = 0.0 <= along[0] <= path.s_m[-1]
    assert not inside or abs(along[0] - guess) <= reach + max(steps)


def test_a_map_without_lanes_for_vehicles_is_refused():
    table = lanelets((1, [(0, 0), (10, 0)], 2.0, []))
    table["participants"] = [["pedestrian"]]
    with pytest.raises(gr.NoAnswerError, match="no lanelet for vehicles"):
        lane_graph(table)


def joined_one_by_one(parts, is_one):
    """Return the parts of each body: the largest first, anew with all others once it grew."""
    sets, gone = [{k} for k in range(len(parts))], set()
    rows = [len(each) for each in parts]
    for base in sorted(range(len(parts)), key=lambda k: -len(parts[k])):
        grew = base not in gone
        while grew:
            grew = False
            for other in range(len(parts)):
                fits = other != base and other not in gone and rows[other] <= rows[base]
                if fits and is_one(sets[base], sets[other]):
                    sets[base] |= sets[other]
                    rows[base] += rows[other]
                    gone.add(other)
                    grew = True
    return [each for k, each in enumerate(sets) if k not in gone]


@given(st.lists(st.integers(1, 4), min_size=1, max_size=7), st.data())
@settings(max_examples=60)
def test_parts_of_a_body_are_joined_as_one_by_one(sizes, data):
    """A body that has grown may be one with parts that it was not one with before."""
    ends = np.cumsum([0, *sizes])
    parts = [np.arange(*span) for span in pairwise(ends)]
    pairs = [(a, b) for a in range(len(parts)) for b in range(len(parts)) if a != b]
    one = data.draw(st.sets(st.sampled_from(pairs))) if pairs else set()
    is_one = lambda body, other: any((a, b) in one for a in body for b in other)  # noqa: E731
    number = np.repeat(np.arange(len(parts)), sizes)
    of = lambda motion: set(number[motion.rows].tolist())  # noqa: E731
    place = detections_at(np.full(ends[-1], 1e9), np.zeros((ends[-1], 2)), np.zeros(ends[-1]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bodies, "purified", lambda _, rows, __: [SimpleNamespace(rows=rows)])
        patch.setattr(bodies, "fit_motion", lambda _, rows, __: SimpleNamespace(rows=rows))
        patch.setattr(bodies, "log_odds", lambda _, *two: float(is_one(*map(of, two))))
        found = bodies.absorb(place, parts, np.zeros((ends[-1], 6)))
    assert [of(each) for each in found] == joined_one_by_one(parts, is_one)
