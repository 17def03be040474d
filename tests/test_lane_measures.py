"""Measures of lanes: Edie's definitions as invariants, and beside counts one vehicle at a time."""

from __future__ import annotations

import math

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from forks import APPROACH, LEFT, STRAIGHT, fork, strip
from hypothesis import example, given, settings
from hypothesis import strategies as st
from maps import EAST, NORTH, UTM
from shapely import LineString

from gis_radar.measures import (
    SPEED_CLASSES,
    FrontStates,
    LaneNetwork,
    StepGrid,
    TileSteps,
    TrackedLanes,
    VehicleTable,
    VisibleRuns,
    lane_names,
    measure_lanes,
    turn_lines,
)
from gis_radar.measures.lane_network import Turn

BEGIN, QUARTER = 34_000_020_000, 1_200
BEGIN -= BEGIN % 4
TILES = fork()
NETWORK = LaneNetwork.of(TILES, {APPROACH: 60.0}, {APPROACH: 36.0})


def states_of(cars):
    """Give the states of cars: each the exit's lane, first step, and metres at every 0.2 s."""
    rows = []
    for vehicle, (lane, first, metres) in enumerate(cars):
        step = np.arange(len(metres)) * 4 + first
        speed = np.gradient(metres, 0.2) if len(metres) > 1 else np.zeros(1)
        for at, x, v in zip(step, metres, speed, strict=True):
            on = APPROACH if x < 60.0 else lane
            rows.append((vehicle, at, on, x if on == APPROACH else x - 60.0, v))
    table = pd.DataFrame(rows, columns=["vehicle", "step", "lane", "along", "speed"])
    return FrontStates(
        vehicle=table["vehicle"].to_numpy(np.int64), step=table["step"].to_numpy(np.int64),
        lane=np.searchsorted(NETWORK.lane, table["lane"].to_numpy(np.int64)),
        along_m=table["along"].to_numpy(float), speed=table["speed"].to_numpy(float),
        seen=np.ones(len(table), np.bool_),
    )  # fmt: skip


def vehicles_of(cars, length=4.5, heavy=0.25):
    count = max(len(cars), 1)
    return VehicleTable(
        vehicle=np.arange(count), length_m=np.full(count, length),
        p_heavy=np.full(count, heavy), p_exists=np.full(count, np.nan),
    )  # fmt: skip


def tracked(network, grid, states, vehicles, visible, observed=None):
    return TrackedLanes(
        network=network, grid=grid, states=states, vehicles=vehicles, visible=visible,
        observed=observed or visible,
    )  # fmt: skip


def seen_all(grid, tiles=TILES, share=1.0):
    """Say that all tiles are visible, in the first part of each interval."""
    ids, long = tiles["tile_id"].to_numpy(), round(grid.steps * share)
    begins = grid.begin + grid.steps * np.arange(grid.count)
    tile, first = (each.ravel() for each in np.meshgrid(ids, begins, indexing="ij"))
    runs = VisibleRuns(tile_id=tile, first=first, last=first + long - 1)
    if not long:
        runs = VisibleRuns(tile_id=tile[:0], first=first[:0], last=first[:0])
    counts = TileSteps(
        tile_id=tile, interval=np.tile(np.arange(grid.count), len(ids)),
        visible=np.full(len(tile), float(long)), hidden=np.zeros(len(tile)),
        occupied=np.zeros(len(tile)), inferred=np.zeros(len(tile)), variance=np.zeros(len(tile)),
    )  # fmt: skip
    return runs, counts


def measured(cars, grid, share=1.0, counts=None, observed=None):
    """Measure cars; give lanes and turns as tables."""
    runs, steps = seen_all(grid, share=share)
    found = measure_lanes(
        tracked(NETWORK, grid, states_of(cars), vehicles_of(cars), runs, observed), counts or steps
    )
    lanes = {k: np.ma.filled(v.astype(float), np.nan) if np.ma.isMA(v) else v
             for k, v in found.lanes.items()}  # fmt: skip
    lanes["speed_counts"] = found.lanes["speed_counts"].to_pylist()
    return (
        pd.DataFrame({k: list(v) for k, v in lanes.items()}).set_index(["lane", "interval"]),
        pd.DataFrame(found.turns).set_index(["from_lane", "to_lane", "interval"]),
    )


@st.composite
def traffic(draw):
    """Cars within four intervals that drive at 0 to 15 m/s, changing speed by up to 2 m/s^2."""
    cars = []
    for _ in range(draw(st.integers(0, 5))):
        exit_lane = draw(st.sampled_from([STRAIGHT, LEFT]))
        first = BEGIN + 4 * draw(st.integers(0, 600))
        # in whole centimetres, as tables have them
        speed, metres = draw(st.floats(0.0, 15.0)), [0.01 * draw(st.integers(0, 5500))]
        for change in draw(st.lists(st.floats(-0.4, 0.4), min_size=1, max_size=40)):
            speed = min(max(speed + change, 0.0), 15.0)
            metres.append(round(min(metres[-1] + 0.2 * speed, 99.0), 2))
        cars.append((exit_lane, first, np.array(metres)))
    return cars


GRID = StepGrid(begin=BEGIN, steps=QUARTER, count=4)
WHOLE = StepGrid(begin=BEGIN, steps=4 * QUARTER, count=1)


def crossed(cars, line, lane=None):
    """Count, car by car, whose front goes from before a line to it, by the interval of that."""
    counts = [0, 0, 0, 0]
    for exit_lane, first, metres in cars:
        if lane is not None and exit_lane != lane:
            continue
        for k in range(len(metres) - 1):
            if metres[k] < line <= metres[k + 1]:
                part = (line - metres[k]) / (metres[k + 1] - metres[k])
                counts[min(int((first + 4 * (k + part) - BEGIN) // QUARTER), 3)] += 1
                break
    return counts


@given(traffic())
@settings(max_examples=60)
def test_volumes_are_the_fronts_over_the_lines(cars):
    lanes, turns = measured(cars, GRID)
    assert lanes.loc[APPROACH, "counted"].tolist() == crossed(cars, 60.0)
    for lane in (STRAIGHT, LEFT):
        assert lanes.loc[lane, "counted"].tolist() == crossed(cars, 80.0, lane)
    # turns sum to the approach's volume
    sums = turns.loc[APPROACH, "volume"].groupby("interval").sum(min_count=1)
    np.testing.assert_allclose(sums, lanes.loc[APPROACH, "volume"])
    for lane in (STRAIGHT, LEFT):
        assert turns.loc[(APPROACH, lane), "volume"].round(9).tolist() == crossed(cars, 60.0, lane)


@given(traffic())
@settings(max_examples=60)
def test_times_and_distances_are_those_of_all_cars(cars):
    lanes, _ = measured(cars, GRID)
    whole, _ = measured(cars, WHOLE)
    weight = lanes["visible_km_h"]
    seconds, metres = (lanes[name] * weight for name in ("density", "flow"))
    wanted_s = sum(0.2 * (len(metres) - 1) + 0.05 for *_, metres in cars)
    last = [np.gradient(metres, 0.2)[-1] * 0.05 for *_, metres in cars]
    wanted_m = sum(float(metres[-1] - metres[0]) for *_, metres in cars) + sum(last)
    assert 3600.0 * seconds.sum() == pytest.approx(wanted_s, abs=1e-6)
    assert 1000.0 * metres.sum() == pytest.approx(wanted_m, abs=1e-6)
    # intervals sum to the whole
    for name in ("counted", "stops", "heavy", "volume"):
        np.testing.assert_allclose(lanes[name].groupby("lane").sum(), whole[name].droplevel(1))
    for name in ("density", "flow"):
        mean = (lanes[name] * weight).groupby("lane").sum() / weight.groupby("lane").sum()
        np.testing.assert_allclose(mean, whole[name].droplevel(1), atol=1e-9)
    driven = whole[whole["flow"] > 0.0]
    np.testing.assert_allclose(
        driven["speed_mean"] * 3.6, driven["flow"] / driven["density"], rtol=1e-9
    )


@given(traffic())
@settings(max_examples=60)
def test_in_minus_out_is_the_change_inside(cars):
    """Between the stop line and the lines behind it, at the end of each interval."""
    lanes, _ = measured(cars, GRID)
    gone_in = lanes.loc[APPROACH, "counted"].cumsum().to_numpy()
    out = (lanes.loc[STRAIGHT, "counted"] + lanes.loc[LEFT, "counted"]).cumsum().to_numpy()
    for k, inside in enumerate(gone_in - out):
        after = BEGIN + (k + 1) * QUARTER
        between = 0
        for _, first, metres in cars:
            now = np.interp(after, first + 4 * np.arange(len(metres)), metres)
            between += 60.0 <= now < 80.0 and metres[0] < 60.0
        assert inside == between


def test_occupied_time_is_length_times_time():
    """The sum of occupied time x tile length is that of vehicle length x time."""
    grid = StepGrid(begin=BEGIN, steps=QUARTER, count=1)
    metres = np.arange(8.0, 50.0, 2.0)  # 10 m/s, wholly on the approach
    _, counts = seen_all(grid)
    front = 8.0 + 0.5 * np.arange(4 * (len(metres) - 1) + 1)
    middles = 0.25 + 0.5 * np.arange(120)
    on = (middles <= front[:, None]) & (middles > front[:, None] - 4.5)
    occupied = np.zeros(len(TILES))
    occupied[:120] = on.sum(axis=0)
    counts = TileSteps(**{**vars(counts), "occupied": occupied})
    lanes, _ = measured([(STRAIGHT, BEGIN, metres)], grid, counts=counts)
    row = lanes.loc[(APPROACH, 0)]
    assert row["occupancy"] / (row["density"] / 1000.0) == pytest.approx(4.5)


def test_what_is_not_visible_is_null_and_never_0():
    cars = [(STRAIGHT, BEGIN, np.arange(50.0, 90.0, 2.0))]
    lanes, turns = measured(cars, GRID, share=0.0)
    row = lanes.loc[(APPROACH, 0)]
    gone = row.drop(["visible_share", "visible_km_h", "speed_counts"])
    assert gone.isna().all()
    assert row["speed_counts"] is None
    assert row["visible_share"] == 0.0
    assert turns["volume"].isna().all()


def test_under_a_fifth_there_is_no_estimate_and_over_it_one_with_its_error():
    cars = [(STRAIGHT, BEGIN, np.arange(50.0, 90.0, 2.0))]
    lanes, turns = measured(cars, GRID, share=0.19)
    assert lanes.loc[(APPROACH, 0), "counted"] == 1.0
    assert np.isnan(lanes.loc[(APPROACH, 0), "volume"])
    lanes, turns = measured(cars, GRID, share=0.5)
    row = lanes.loc[(APPROACH, 0)]
    assert row["volume"] == 2.0
    assert row["volume_se"] == pytest.approx(math.sqrt(0.3**2 + 1.5 * 0.5) / 0.5)
    assert lanes.loc[(APPROACH, 1), "volume"] == 0.0
    assert lanes.loc[(APPROACH, 1), "volume_se"] == pytest.approx(math.sqrt(0.5 * 0.5) / 0.5)
    assert turns.loc[(APPROACH, STRAIGHT, 0), "volume"] == 2.0


def test_a_turn_that_nobody_took_has_its_part_of_the_error_of_its_approach():
    """Where the line was visible for half of the time, some may have turned unseen."""
    cars = [(STRAIGHT, BEGIN, np.arange(50.0, 90.0, 2.0))]
    lanes, turns = measured(cars, GRID, share=0.5)
    for interval in (0, 1):  # one car, none
        approach = lanes.loc[(APPROACH, interval)]
        se = turns["volume_se"].xs(interval, level="interval").loc[APPROACH]
        assert (se > 0.3).all()
        assert (se**2).sum() == pytest.approx(approach["volume_se"] ** 2)
    assert se.loc[LEFT] == pytest.approx(se.loc[STRAIGHT])


def test_who_has_one_way_on_takes_it_though_followed_to_the_line_only():
    car = [(0, 1, 5.0), (0, 1, 15.0)]
    tiles = junction(divides=False).query("lanelet_id != 4")
    network = LaneNetwork.of(tiles)
    runs, counts = seen_all(GRID, tiles, share=0.5)
    vehicle, lane, along = zip(*car, strict=True)
    states = FrontStates(
        vehicle=np.array(vehicle), step=BEGIN + 20 * np.array([0, 1]),
        lane=np.searchsorted(network.lane, lane), along_m=np.array(along),
        speed=np.full(2, 10.0), seen=np.ones(2, np.bool_),
    )  # fmt: skip
    found = measure_lanes(tracked(network, GRID, states, vehicles_of([0]), runs), counts)
    lanes, turns = (pd.DataFrame(dict(each)) for each in (
        {name: found.lanes[name] for name in ("lane", "interval", "volume", "volume_se")},
        found.turns,
    ))  # fmt: skip
    measures = ["interval", "volume", "volume_se"]
    approach, turn = lanes[lanes["lane"] == 1], turns[turns["from_lane"] == 1]
    assert approach["volume"].tolist() == [2.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(turn[measures], approach[measures])


def test_a_front_over_the_line_unseen_is_not_counted():
    cars = [(STRAIGHT, BEGIN + QUARTER // 2, np.arange(50.0, 90.0, 2.0))]
    lanes, _ = measured(cars, GRID, share=0.5)
    assert lanes.loc[(APPROACH, 0), "counted"] == 0.0


@pytest.mark.parametrize("followed", [2, 0])
def test_while_vehicles_hide_the_line_those_come_that_are_followed_across_it(followed):
    """Two cars come while the line is visible, for half of the time; then a queue hides it."""
    way = np.arange(50.0, 90.0, 2.0)
    begins = [BEGIN, BEGIN + 200, *(BEGIN + QUARTER // 2 + 200 * n for n in range(1, followed + 1))]
    _, counts = seen_all(GRID, share=0.5)
    counts = TileSteps(**{**vars(counts), "hidden": counts.visible})
    cars = [(STRAIGHT, begin, way) for begin in begins]
    lanes, _ = measured(cars, GRID, 0.5, counts, seen_all(GRID)[0])
    row = lanes.loc[(APPROACH, 0)]
    assert row["counted"] == 2.0
    assert row["volume"] == 2.0 + followed
    # up to two may have come, as before, of whom as many are missed as are not followed
    missed = (2.0 - followed) ** 2 + 2.5 * 0.5 / 0.5**2
    variance = 2 * 0.3**2 + followed * 0.7**2 + missed / 3.0
    assert row["volume_se"] == pytest.approx(math.sqrt(variance))


def test_who_is_followed_over_a_hidden_line_takes_the_turn_that_is_seen():
    cars = [(STRAIGHT, BEGIN + QUARTER // 2 + 200, np.arange(50.0, 90.0, 2.0))]
    _, counts = seen_all(GRID, share=0.5)
    counts = TileSteps(**{**vars(counts), "hidden": counts.visible})
    lanes, turns = measured(cars, GRID, 0.5, counts, seen_all(GRID)[0])
    assert lanes.loc[(APPROACH, 0), "volume"] == 1.0
    assert lanes.loc[(APPROACH, 0), "counted"] == 0
    volume = turns["volume"].loc[APPROACH]
    assert volume.loc[STRAIGHT].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert volume.loc[LEFT].tolist() == [0.0] * 4


def test_who_is_followed_while_no_sensor_observes_the_line_comes_at_the_rate_seen():
    """Cars come evenly; the line is visible, then hidden for a tenth, then its sensor is out."""
    way = np.arange(50.0, 90.0, 2.0)
    cars = [(STRAIGHT, BEGIN + QUARTER // 10 * n, way) for n in range(10)]
    _, counts = seen_all(GRID, share=0.4)
    counts = TileSteps(**{**vars(counts), "hidden": counts.visible / 4.0})
    lanes, _ = measured(cars, GRID, 0.4, counts, seen_all(GRID, share=0.5)[0])
    row = lanes.loc[(APPROACH, 0)]
    assert row["counted"] == 4.0
    assert row["volume"] == 10.0


def test_doubt_of_existence_adds_to_the_error():
    cars = [(STRAIGHT, BEGIN, np.arange(50.0, 90.0, 2.0))]
    runs, counts = seen_all(GRID)
    doubted = VehicleTable(**{**vars(vehicles_of(cars)), "p_exists": np.array([0.6])})
    found = measure_lanes(tracked(NETWORK, GRID, states_of(cars), doubted, runs), counts)
    at = list(zip(found.lanes["lane"], found.lanes["interval"], strict=True)).index((APPROACH, 0))
    assert found.lanes["volume_se"][at] == pytest.approx(math.sqrt(0.045 + 0.24))


def test_speeds_heavy_vehicles_and_travel_times():
    cars = [(STRAIGHT, BEGIN, np.arange(0.0, 98.0, 2.0)), (LEFT, BEGIN, np.arange(0.0, 98.0, 1.0))]
    lanes, _ = measured(cars, GRID)
    row = lanes.loc[(APPROACH, 0)]
    assert row["speed_time_mean"] == pytest.approx(7.5)
    assert row["heavy"] == pytest.approx(0.5)
    # 6 and 12 s over 60 m: mean 9 s; free at 36 km/h it takes 6 s
    assert row["travel_time_s"] == pytest.approx(9.0, rel=1e-6)
    assert row["delay_s"] == pytest.approx(3.0, rel=1e-6)
    assert row["speed_mean"] == pytest.approx(60.0 / 9.0, rel=1e-6)
    assert np.isnan(lanes.loc[(STRAIGHT, 0), "delay_s"])  # its free speed is not known
    counts = row["speed_counts"]
    assert len(counts) == SPEED_CLASSES
    assert [k for k, each in enumerate(counts) if each] == [3, 7]  # 18 and 36 km/h


def queue(fronts, still=30):
    """Cars that drive up to their places by the stop line and stand there."""
    came = -np.arange(4.0)[::-1]
    return [(STRAIGHT, BEGIN, front + np.concatenate([came, np.zeros(still)])) for front in fronts]


def test_a_queue_reaches_back_to_the_first_large_gap():
    lanes, _ = measured(queue([59.0, 51.0, 38.0, 20.0]), GRID)  # gaps of 1, 3.5, 8.5 and 13.5 m
    row = lanes.loc[(APPROACH, 0)]
    assert row["queue_max_m"] == pytest.approx(60.0 - 38.0 + 4.5)
    assert row["stops"] == 4.0
    assert lanes.loc[(APPROACH, 1), "queue_max_m"] == 0.0
    assert np.isnan(lanes.loc[(STRAIGHT, 0), "queue_max_m"])  # has no stop line
    assert 0.0 < row["queue_mean_m"] < row["queue_max_m"]


@pytest.mark.parametrize(
    ("hidden", "observed", "back_m"),
    [
        ((21.0, 33.0), True, 44.5),
        ((30.0, 33.0), True, 26.5),
        ((21.0, 33.0), False, 26.5),
    ],
)
def test_a_queue_goes_on_over_road_that_vehicles_hide(hidden, observed, back_m):
    """Of a gap of 13.5 m vehicles hide 12 m, or 3 m, or no sensor has 12 m of it in sight."""
    runs, counts = seen_all(GRID)
    middle = TILES.set_index("tile_id").geometry.centroid.x.loc[runs.tile_id].to_numpy() - EAST
    lane = TILES.set_index("tile_id")["lanelet_id"].loc[runs.tile_id].to_numpy()
    shown = (lane != APPROACH) | (middle < hidden[0]) | (middle > hidden[1])
    part = VisibleRuns(tile_id=runs.tile_id[shown], first=runs.first[shown], last=runs.last[shown])
    cars = queue([59.0, 51.0, 38.0, 20.0])
    in_sight = runs if observed else part
    found = measure_lanes(
        tracked(NETWORK, GRID, states_of(cars), vehicles_of(cars), part, in_sight), counts
    )
    at = list(zip(found.lanes["lane"], found.lanes["interval"], strict=True)).index((APPROACH, 0))
    assert found.lanes["queue_max_m"][at] == pytest.approx(back_m)


def test_sight_reaches_to_the_farthest_tile_in_sight():
    tiles = TILES[(TILES["lanelet_id"] == APPROACH) & (TILES["index"] >= 40)]
    sight_m = NETWORK.sight_m(tiles["tile_id"].to_numpy())
    at = np.searchsorted(NETWORK.lane, [APPROACH, STRAIGHT])
    assert sight_m[at[0]] == pytest.approx(60.0 - 20.0)
    assert np.isnan(sight_m[at[1]])  # without a stop line
    assert NETWORK.sight_m(np.zeros(0, np.int64))[at[0]] == 0.0


@pytest.mark.parametrize(("unseen_m", "sight_m"), [(9.0, 60.0), (11.0, 30.0)])
def test_sight_ends_at_a_gap_that_ends_a_queue(unseen_m, sight_m):
    """The tiles from 30 m before the line to `unseen_m` farther back are not in sight."""
    away = 60.0 - TILES["s_m"]
    shown = (TILES["lanelet_id"] == APPROACH) & ((away <= 30.0) | (away > 30.0 + unseen_m))
    found = NETWORK.sight_m(TILES.loc[shown, "tile_id"].to_numpy())
    assert found[np.searchsorted(NETWORK.lane, APPROACH)] == pytest.approx(sight_m)


def merge():
    """Give the lanes 1 and 2, 40 m long, that merge 30 m before the line of lane 3."""
    aside = (-40 * math.cos(math.radians(20)), -40 * math.sin(math.radians(20)))
    rows = strip(1, (-40, 0), 0, 40, 0)
    rows += strip(2, aside, 20, 40, len(rows))
    rows += strip(3, (0, 0), 0, 31, len(rows))
    return gpd.GeoDataFrame(rows, crs=UTM)


@pytest.mark.parametrize(
    ("on_one", "on_two", "hidden", "back_m"),
    [
        ([38, 30, 22], [], (), 30 + 18 + 4.5),  # beyond the merge on one lane
        ([38, 30, 22], [37], (), 30 + 18 + 4.5),
        ([38], [37, 29, 21], (), 30 + 19 + 4.5),  # the longer of two queues counts
        ([38, 30, 22], [15, 7], (), 30 + 18 + 4.5),  # behind 20 m of empty lane
        ([38, 30, 22], [15, 7], (2,), 30 + 33 + 4.5),  # unless that is hidden
        ([38, 30, 22], [15, 7], (1,), 30 + 18 + 4.5),  # what is hidden on the other counts not
        ([], [], (), 30 - 5 + 4.5),
    ],
)
def test_queues_beyond_a_merge_are_each_lane_s_own(on_one, on_two, hidden, back_m):
    tiles = merge()
    network = LaneNetwork.of(tiles, {3: 30.0})
    places = [(2, 29.0), (2, 21.0), (2, 13.0), (2, 5.0)]
    places += [(0, float(x)) for x in on_one] + [(1, float(x)) for x in on_two]
    count, step = len(places), np.arange(31) * 4
    lane, along = (np.repeat(np.array(each), len(step)) for each in zip(*places, strict=True))
    states = FrontStates(
        vehicle=np.repeat(np.arange(count), len(step)), step=BEGIN + np.tile(step, count),
        lane=lane, along_m=along, speed=np.zeros(len(lane)), seen=np.ones(len(lane), np.bool_),
    )  # fmt: skip
    runs, counts = seen_all(GRID, tiles)
    shown = ~np.isin(runs.tile_id, tiles.loc[tiles["lanelet_id"].isin(hidden), "tile_id"])
    part = VisibleRuns(tile_id=runs.tile_id[shown], first=runs.first[shown], last=runs.last[shown])
    found = measure_lanes(tracked(network, GRID, states, vehicles_of(places), part, runs), counts)
    at = list(zip(found.lanes["lane"], found.lanes["interval"], strict=True)).index((3, 0))
    assert found.lanes["queue_max_m"][at] == pytest.approx(back_m)


def test_who_stands_far_from_the_line_is_no_queue():
    lanes, _ = measured(queue([45.0]), GRID)
    assert lanes.loc[(APPROACH, 0), "queue_max_m"] == 0.0
    assert lanes.loc[(APPROACH, 0), "stops"] == 1.0


def brute_back(cars, step):
    """Find the back of the queue at a step, car by car."""
    at = []
    for _, first, metres in cars:
        k, slow = (step - first) // 4, np.gradient(metres, 0.2) < 5 / 3.6
        if 5 <= k < len(metres) and metres[k] < 60.0 and slow[k - 5 : k + 1].all():
            at.append(metres[k])
    back = 0.0
    for front in sorted(at, reverse=True):
        if 60.0 - front - back > 10.0:
            break
        back = 60.0 - front + 4.5
    return back


@given(st.lists(st.tuples(st.floats(8.0, 59.5), st.integers(0, 200)), max_size=5))
@settings(max_examples=40)
@example(places=[(59.0, 0), (43.5, 0)])  # 11 m apart
def test_queues_are_those_found_car_by_car(places):
    cars = [
        (STRAIGHT, BEGIN + 4 * late, metres)
        for (front, late), (*_, metres) in zip(
            places, queue([front for front, _ in places]), strict=True
        )
    ]
    lanes, _ = measured(cars, GRID)
    backs = [brute_back(cars, BEGIN + 4 * k) for k in range(QUARTER // 4)]
    assert lanes.loc[(APPROACH, 0), "queue_max_m"] == pytest.approx(max(backs))
    assert lanes.loc[(APPROACH, 0), "queue_mean_m"] == pytest.approx(np.mean(backs))


def test_who_stood_when_first_found_has_not_stopped_and_slow_for_less_than_1_s_is_no_stop():
    still = [(STRAIGHT, BEGIN, np.full(30, 50.0))]
    lanes, _ = measured(still, GRID)
    assert lanes.loc[(APPROACH, 0), "stops"] == 0.0
    assert lanes.loc[(APPROACH, 0), "queue_max_m"] == pytest.approx(14.5)
    brief = states_of([(STRAIGHT, BEGIN, np.array([0, 2, 4, 4, 4, 4, 6, 8], float))])
    assert not brief.standing()[0].any()


def test_a_front_that_wavers_over_the_line_counts_once():
    cars = [(STRAIGHT, BEGIN, np.array([58.0, 59.9, 60.1, 59.9, 60.1, 62.0, 64.0]))]
    lanes, _ = measured(cars, GRID)
    assert lanes.loc[APPROACH, "counted"].tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize("tiles_hidden", [1, 1000])
def test_exits_that_are_not_visible_keep_what_may_have_taken_them(tiles_hidden):
    """Of two cars one goes straight; the left exit is hidden, and the other car with it."""
    cars = [
        (STRAIGHT, BEGIN, np.arange(50.0, 90.0, 2.0)),
        (LEFT, BEGIN, np.array([56.0, 58.0, 59.99, 60.0])),
    ]
    runs, counts = seen_all(GRID)
    first = TILES[TILES["lanelet_id"] == LEFT].sort_values("index").head(tiles_hidden)
    left = np.isin(counts.tile_id, first["tile_id"])
    hidden = TileSteps(**{**vars(counts), "visible": np.where(left, 0.0, counts.visible)})
    states = states_of(cars)
    gone = (states.vehicle == 1) & (states.lane == np.searchsorted(NETWORK.lane, LEFT))
    short = {  # followed up to the line and no farther
        "along_m": np.where(gone, 60.0, states.along_m), "lane": np.where(gone, 0, states.lane),
    }  # fmt: skip
    states = FrontStates(**{
        name: short.get(name, getattr(states, name))
        for name in ("vehicle", "step", "lane", "along_m", "speed", "seen")
    })  # fmt: skip
    found = measure_lanes(tracked(NETWORK, GRID, states, vehicles_of(cars), runs), hidden)
    turns = pd.DataFrame(found.turns).set_index(["from_lane", "to_lane", "interval"])
    assert turns.loc[(APPROACH, STRAIGHT, 0), "volume"] == pytest.approx(1.0)
    assert np.isnan(turns.loc[(APPROACH, LEFT, 0), "volume"])


def test_a_site_without_vehicles_has_zeros_and_no_speeds():
    lanes, turns = measured([], GRID)
    assert lanes["counted"].eq(0).all()
    assert turns["volume"].eq(0.0).all()
    assert lanes["speed_mean"].isna().all()


def test_lanes_before_a_stop_line_fan_out_without_being_turns():
    rows = strip(1, (0, 0), 0, 40, 0)
    for lane, turn in ((2, 10), (3, -10)):
        rows += strip(lane, (40, 0), turn, 40, len(rows))
    tiles = gpd.GeoDataFrame(rows, crs=UTM)
    assert LaneNetwork.of(tiles, {2: 39.0, 3: 39.0}).turns() == []
    ways_on = [Turn(0, 1, ()), Turn(0, 2, ())]
    assert LaneNetwork.of(tiles).turns() == ways_on  # a diverge
    assert LaneNetwork.of(tiles, {2: 39.0}).turns() == ways_on  # so its volume is that of both
    strips = LaneNetwork.of(tiles, {2: 39.0}).queue_strips
    assert strips.lane.tolist() == [1, 0]
    assert strips.to_line_m.tolist() == [39.0, 79.0]
    assert strips.ahead.tolist() == [-1, 0]


def junction(*, divides=False):
    """Give tiles of an approach with a connector to either of two exits, where others merge.

    The second connector leads to a third exit, too, if it `divides`.
    """
    rows = strip(1, (0, 0), 0, 20, 0)
    for lane, turn in ((3, 10), (4, -10)):
        rows += strip(lane, (20, 0), turn, 20, len(rows))
    up = (20 + 20 * math.cos(math.radians(10)), 20 * math.sin(math.radians(10)))
    down = (up[0], -up[1])
    rows += strip(5, up, 10, 20, len(rows))
    rows += strip(6, down, -10, 20, len(rows))
    beside = [(up[0] - 20 * math.cos(math.radians(d)), y - 20 * math.sin(math.radians(d)))
              for d, y in ((-15, up[1]), (15, down[1]))]  # fmt: skip
    rows += strip(7, beside[0], -15, 20, len(rows))
    rows += strip(8, beside[1], 15, 20, len(rows))
    if divides:
        rows += strip(9, down, -25, 20, len(rows))
    return gpd.GeoDataFrame(rows, crs=UTM)


def test_turns_lead_over_connectors():
    network = LaneNetwork.of(junction())
    assert network.lane[network.connector].tolist() == [3, 4]
    named = [(network.lane[t.start], network.lane[t.end], [network.lane[k] for k in t.via])
             for t in network.turns()]  # fmt: skip
    assert (1, 5, [3]) in named
    assert (1, 6, [4]) in named


@pytest.mark.parametrize(
    ("reached_m", "dark", "divides", "volumes"),
    [
        (11.0, {6}, False, [1.0, 1.0]),
        (9.0, {6}, False, [2.0, 0.0]),  # it may yet be lost: shared as those that are known
        (9.0, {4, 6}, False, [1.0, np.nan]),
        (11.0, {6, 9}, True, [1.0, np.nan]),  # over the middle it may go to either exit
    ],
)
def test_who_passes_the_middle_of_a_connector_has_turned_where_the_exit_is_not_visible(
    reached_m, dark, divides, volumes
):
    """One car drives to the exit 5; one over connector 4, on which it is followed so far."""
    tiles = junction(divides=divides)
    network = LaneNetwork.of(tiles)
    runs, counts = seen_all(GRID, tiles)
    dark = np.isin(counts.tile_id, tiles.loc[tiles["lanelet_id"].isin(list(dark)), "tile_id"])
    counts = TileSteps(**{**vars(counts), "visible": np.where(dark, 0.0, counts.visible)})
    ways = [(0, 1, 5.0), (0, 1, 15.0), (0, 3, 15.0), (0, 5, 2.0)]
    ways += [(1, 1, 5.0), (1, 1, 15.0), (1, 4, reached_m)]
    vehicle, lane, along = zip(*ways, strict=True)
    states = FrontStates(
        vehicle=np.array(vehicle), step=BEGIN + 20 * np.array([0, 1, 2, 3, 0, 1, 2]),
        lane=np.searchsorted(network.lane, lane), along_m=np.array(along),
        speed=np.full(7, 10.0), seen=np.ones(7, np.bool_),
    )  # fmt: skip
    found = measure_lanes(tracked(network, GRID, states, vehicles_of([0, 0]), runs), counts)
    turns = pd.DataFrame(found.turns).set_index(["from_lane", "to_lane", "interval"])["volume"]
    assert turns.loc[[(1, 5, 0), (1, 6, 0)]].tolist() == pytest.approx(volumes, nan_ok=True)


@pytest.mark.parametrize(("offside", "right_hand"), [(3.0, True), (-3.0, False)])
def test_lanes_are_numbered_from_the_kerb(offside, right_hand):
    """Two lanes to the east, and beyond the middle of the road one to the west."""
    rows = strip(1, (0, 0), 0, 40, 0)
    rows += strip(2, (0, offside), 0, 40, len(rows))
    rows += strip(3, (40, 2 * offside), 180, 40, len(rows))
    ends = [[(0, 0), (40, 0)], [(0, offside), (40, offside)], [(40, 2 * offside), (0, 2 * offside)]]
    layer = gpd.GeoDataFrame(
        {"lane": [1, 2, 3], "street": None, "turn": None},
        geometry=[LineString(np.add(each, (EAST, NORTH))) for each in ends], crs=UTM,
    )  # fmt: skip
    for lanes in ([1, 2, 3], [1, 2]):  # without an opposite lane, the kerb is on the right
        tiles = gpd.GeoDataFrame([row for row in rows if row["lane"] in lanes], crs=UTM)
        names = lane_names(layer, LaneNetwork.of(tiles))
        from_kerb = [1, 2] if right_hand or 3 in lanes else [2, 1]
        assert names[:2] == [f"Road eastbound, lane {number}" for number in from_kerb]


def test_an_approach_without_a_stop_line_is_named_by_where_it_meets_the_junction():
    """It leads from the north round a bend of 90 degrees, and then to the east."""
    tiles = junction()
    network = LaneNetwork.of(tiles)
    bend = [(-40, 60), (-40, 0), (20, 0)]
    lines = [bend if lane == 1 else [(20, 0), (40, 0)] for lane in network.lane]
    layer = gpd.GeoDataFrame(
        {"lane": network.lane, "street": None, "turn": None},
        geometry=[LineString(np.add(each, (EAST, NORTH))) for each in lines], crs=UTM,
    )  # fmt: skip
    assert lane_names(layer, network)[0].startswith("Road eastbound, lane 1")


@pytest.mark.parametrize(
    ("of_connectors", "words"),
    [
        (["right", "straight"], ["right", "straight"]),  # as in the names of lanes
        ([None, "left;right"], ["straight", "straight"]),  # by the angle, which is 0 here
    ],
)
def test_a_turn_is_called_as_its_connector(of_connectors, words):
    network = LaneNetwork.of(junction())
    called = dict(zip([3, 4], of_connectors, strict=True))
    layer = gpd.GeoDataFrame(
        {"lane": network.lane, "turn": [called.get(lane) for lane in network.lane.tolist()]},
        geometry=[LineString([(0, 0), (20, 0)])] * len(network.lane), crs=UTM,
    )  # fmt: skip
    turns = [turn for turn in network.turns() if network.lane[turn.start] == 1]
    assert turn_lines(layer, network, turns)[0] == words
