"""A vehicle keeps its lane: its track takes one path through the lanes, and seldom changes it."""

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely

from gis_radar.calibration.registration.lane_paths import CHANGE_COST, match_paths
from gis_radar.calibration.registration.lanes import place, sample_lanes
from gis_radar.calibration.registration.matches import lanes_near, match
from gis_radar.calibration.registration.model import MODEL
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import Samples

APART_M = 3.5  # of two lanes of one direction
STATE = State(position=np.array([0.0, -12.0, 5.0]), R_map_sensor=np.eye(3), reflection=0.6)


@pytest.fixture(scope="module")
def lanes():
    """Lanes 0 and 1 eastward beside each other, 2 goes on after 0, 3 crosses, 4 leads back."""
    beside, back = APART_M, 2.0 * APART_M
    lines = [
        [[-60.0, 0.0], [20.0, 0.0]], [[-60.0, beside], [60.0, beside]], [[20.0, 0.0], [60.0, 0.0]],
        [[0.0, -60.0], [0.0, 60.0]], [[60.0, back], [-60.0, back]],
    ]  # fmt: skip
    centre = gpd.GeoSeries([shapely.LineString(line) for line in lines], crs="EPSG:25832")
    table = gpd.GeoDataFrame(
        {"centre": centre, "participants": [("vehicle",)] * 5, "speed_limit_kmh": np.nan,
         "one_way": True},
        geometry=centre.buffer(1.75), crs="EPSG:25832",
    )  # fmt: skip
    return sample_lanes(table, np.empty((0, 3)), place=np.zeros(2), reach_m=100.0)


def driven(north_m, *, seed=0):
    """Place a vehicle's samples, which drives eastward `north_m` (of x) over the first lane."""
    rng = np.random.default_rng(seed)
    x = np.sort(rng.uniform(-50.0, 50.0, 120))
    spots = np.column_stack([x, north_m(x) + rng.normal(0.0, 0.3, len(x)), np.zeros(len(x))])
    arms = spots - STATE.position
    samples = Samples(
        points=arms, range_rate=12.0 * arms[:, 0] / np.linalg.norm(arms, axis=1),
        track=np.zeros(len(x), dtype=np.int64), tracks=1, elevation=1.0,
    )  # fmt: skip
    return place(samples, STATE)


def followed(lanes, placed, *, aside_m=0.0):
    return match_paths(lanes, placed, np.array([aside_m]), model=MODEL, scale_m=0.0)


def test_a_vehicle_that_drifts_off_its_lane_keeps_it(lanes):
    """As by a pose that is turned: the next lane is nearer at the end of its way."""
    placed = driven(lambda x: (x + 50.0) / 50.0)
    taken = lanes.lane[match(lanes, placed).lane]
    assert (taken == 1).sum() > 5
    kept = followed(lanes, placed, aside_m=0.6)
    assert kept.found.all()
    assert set(lanes.lane[kept.lane]) == {0, 2}
    assert kept.path_cost.sum() == 0.0  # also where one lanelet ends and the next begins


@pytest.mark.parametrize("begin_m", [-20.0, 30.0])
def test_a_change_of_lanes_costs_once(lanes, begin_m):
    placed = driven(lambda x: APART_M * np.clip((x - begin_m) / 10.0, 0.0, 1.0))
    changed = followed(lanes, placed)
    east = placed.points[:, 0]
    assert set(lanes.lane[changed.lane[east < begin_m]]) <= {0, 2}
    assert set(lanes.lane[changed.lane[east > begin_m + 10.0]]) == {1}
    assert changed.path_cost.sum() == pytest.approx(CHANGE_COST)
    assert begin_m < east[changed.path_cost > 0.0][0] < begin_m + 10.0


def test_the_lanes_of_which_a_sample_may_be_have_the_nearest_first(lanes):
    placed = driven(lambda x: 0.6 * APART_M + 0.0 * x)
    near = lanes_near(lanes, placed, most=6)
    assert (near[:, 0] == match(lanes, placed).lane).all()
    others = [set(lanes.lane[row[row >= 0]]) for row in near]
    assert all({0, 1} <= each or {1, 2} <= each for each in others)
    ahead = near[np.abs(placed.points[:, 0]) > 10.0]
    assert 4 not in lanes.lane[ahead[ahead >= 0]]  # range rates have the other sign there
    assert all(len(set(row[row >= 0])) == (row >= 0).sum() for row in near)
    assert (lanes_near(lanes, placed, most=1) == near[:, :1]).all()


def test_a_place_past_the_end_of_a_lane_costs_by_the_metre(lanes):
    """Lane 4 ends at 60 m to the west: two vehicles drive on beyond it, one three times as far."""
    cost = []
    for past_m in (2.0, 6.0):
        placed = driven(lambda x: 2.0 * APART_M + 0.0 * x)
        east = -60.0 - past_m + 0.0 * placed.points[:, 0]
        spots = np.column_stack([east, placed.points[:, 1], 0.0 * east])
        arms = spots - STATE.position
        rate = -12.0 * arms[:, 0] / np.linalg.norm(arms, axis=1)
        samples = replace(placed.samples, points=arms, range_rate=rate)
        cost.append(followed(lanes, place(samples, STATE)).path_cost.sum())
    assert 0.0 < cost[0] < cost[1]


@pytest.mark.parametrize("slow", [0, 2])
def test_a_slow_lane_on_one_side_leaves_the_one_on_the_other_side(slow):
    """Three lanes eastward, of which the first or the last allows 10 km/h."""
    lines = [[[-60.0, y], [60.0, y]] for y in (-APART_M, 0.0, APART_M)]
    limit = [10.0 if number == slow else 50.0 for number in range(3)]
    centre = gpd.GeoSeries([shapely.LineString(line) for line in lines], crs="EPSG:25832")
    table = gpd.GeoDataFrame(
        {"centre": centre, "participants": [("vehicle",)] * 3, "speed_limit_kmh": limit,
         "one_way": True},
        geometry=centre.buffer(1.75), crs="EPSG:25832",
    )  # fmt: skip
    lanes = sample_lanes(table, np.empty((0, 3)), place=np.zeros(2), reach_m=100.0)
    near = lanes_near(lanes, driven(lambda x: 0.0 * x), most=6)
    other = (np.where(near >= 0, lanes.lane[near], -1) == 2 - slow).any(axis=1)
    assert other.mean() > 0.9


def test_the_next_lanes_are_those_to_the_left_and_right(lanes):
    left, right = lanes.next_lanes.T
    first, second = (lanes.lane == number for number in (0, 1))
    assert set(lanes.lane[left[first]]) == {1}
    assert (right[first] == -1).all()
    assert set(lanes.lane[right[second]]) == {0, 2}
    assert (left[second] == -1).all()  # the lane beside it leads back
    gap = lanes.points[left[first], :2] - lanes.points[first, :2]
    assert gap == pytest.approx(np.tile([0.0, APART_M], (first.sum(), 1)), abs=0.6)
