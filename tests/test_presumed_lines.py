"""Presumed stop lines: before junctions for which the map draws none, and nowhere else."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pytest
from forks import fork, strip
from maps import UTM

from gis_radar.measures import (
    DRAWN,
    PRESUMED,
    FrontStates,
    LaneNetwork,
    StepGrid,
    TileSteps,
    TrackedLanes,
    VehicleTable,
    VisibleRuns,
    measure_lanes,
)

WEST, ACROSS, EAST, SOUTH, UP, NORTH = 1, 2, 3, 4, 5, 6  # lanelets, each a lane of its own
WAYS = {
    WEST: ((0, 0), 0, 60), ACROSS: ((60, 0), 0, 20), EAST: ((80, 0), 0, 40),
    SOUTH: ((70, -60), 90, 50), UP: ((70, -10), 90, 20), NORTH: ((70, 10), 90, 40),
}  # fmt: skip
RIGHT = 7
EASTBOUND = {k: WAYS[k] for k in (WEST, ACROSS, EAST)}
BEFORE_BOTH = {WEST: 60.0, SOUTH: 50.0}


def laid(ways):
    """Lay the tiles of ways: lanelet, begin, direction in degrees, and length."""
    rows = []
    for lanelet, (place, turn_deg, length) in ways.items():
        rows += strip(lanelet, place, turn_deg, length, len(rows))
    return gpd.GeoDataFrame(rows, crs=UTM)


def presumed(tiles, drawn=None):
    """Return the metres to presumed lines, by the number of the lane."""
    network = LaneNetwork.of(tiles, drawn)
    lines = zip(network.lane.tolist(), network.queue_line_m, network.stop_line, strict=True)
    return {lane: pytest.approx(m) for lane, m, kind in lines if kind == PRESUMED}


def test_vehicles_wait_where_streets_cross():
    assert presumed(laid(WAYS)) == BEFORE_BOTH


def test_lanelets_of_one_lane_end_at_the_junction():
    tiles = laid(WAYS)
    tiles["lane"] = np.where(tiles["lanelet_id"] <= EAST, WEST, SOUTH)
    assert presumed(tiles) == BEFORE_BOTH


def test_a_way_through_a_junction_may_be_of_several_lanelets():
    """The first of them meets nobody: the line is where the street forks."""
    ways = WAYS | {ACROSS: ((60, 0), 0, 6), 8: ((66, 0), 0, 14), RIGHT: ((60, 0), -45, 15)}
    assert presumed(laid(ways)) == BEFORE_BOTH


def test_who_joins_another_street_after_a_turn_waits():
    """From the south round a bend to the east; on the street itself nobody waits."""
    ways = EASTBOUND | {SOUTH: ((60, -40), 90, 30), RIGHT: ((60, -10), 65, 8.0)}
    tiles = laid(ways | {8: ((63.38, -2.75), 20, 8.0)})
    bend = tiles["lanelet_id"] == 8
    tiles.loc[bend, ["lanelet_id", "lane"]] = RIGHT
    tiles.loc[bend, "index"] += 16
    tiles.loc[bend, "s_m"] += 8.0
    assert presumed(tiles) == {SOUTH: 30.0}


@pytest.mark.parametrize(
    "ways",
    [
        EASTBOUND,
        EASTBOUND | {SOUTH: ((0, -3.5), 0, 60), UP: ((60, -3.5), 0, 20)},  # side by side
        EASTBOUND | {SOUTH: ((120, 3.5), 180, 60), UP: ((60, 3.5), 180, 60)},  # oncoming
        EASTBOUND | {SOUTH: ((60, 0), -20, 40)},  # leaves a motorway
        EASTBOUND | {SOUTH: ((22.41, -13.68), 20, 20), UP: ((41.21, -6.84), 20, 20)},  # joins one
    ],
)
def test_nobody_waits_where_roads_only_fork_or_merge(ways):
    assert presumed(laid(ways)) == {}
    assert presumed(fork()) == {}


def test_nobody_waits_before_a_bridge():
    tiles = laid(WAYS)
    tiles["height_m"] = np.where(tiles["lanelet_id"] <= EAST, 6.0, 0.0)
    assert presumed(tiles) == {}


def test_where_a_map_draws_lines_the_other_ways_of_the_junction_have_right_of_way():
    network = LaneNetwork.of(laid(WAYS), {SOUTH: 48.0})
    assert [k for k in network.stop_line if k] == [DRAWN]
    lines = dict(zip(network.lane.tolist(), network.queue_line_m.tolist(), strict=True))
    assert lines[SOUTH] == 48.0
    assert np.isnan(lines[WEST])


def test_a_queue_at_a_drawn_line_goes_on_over_presumed_ones():
    network = LaneNetwork.of(laid(WAYS), {EAST: 39.0})
    strips = network.queue_strips
    at = np.searchsorted(network.lane, [EAST, ACROSS, WEST])
    assert strips.lane[strips.of_stop(at[0])].tolist() == at.tolist()
    assert strips.lane[strips.of_stop(at[2])].tolist() == [at[2]]


def test_a_queue_is_measured_from_the_presumed_line_and_vehicles_counted_in_the_middle():
    """Two cars stand; the first one has passed the middle, at 30 m, on its way."""
    network, grid = LaneNetwork.of(tiles := laid(WAYS)), StepGrid(begin=0, steps=400, count=1)
    west, step = int(np.searchsorted(network.lane, WEST)), np.arange(0, 400, 4)
    fronts = [np.minimum(20.0 + step / 4.0, 58.0), np.full(len(step), 51.0)]
    states = FrontStates(
        vehicle=np.repeat([0, 1], len(step)), step=np.tile(step, 2),
        lane=np.full(2 * len(step), west), along_m=np.concatenate(fronts),
        speed=np.concatenate([np.gradient(each, 0.2) for each in fronts]),
        seen=np.ones(2 * len(step), np.bool_),
    )  # fmt: skip
    vehicles = VehicleTable(
        vehicle=np.arange(2), length_m=np.full(2, 4.5), p_heavy=np.zeros(2),
        p_exists=np.full(2, np.nan),
    )  # fmt: skip
    ids = tiles["tile_id"].to_numpy()
    shown = ids[(tiles["lanelet_id"] != WEST) | (tiles["s_m"] >= 30.0)]  # the middle, too
    runs = VisibleRuns(
        tile_id=shown, first=np.zeros(len(shown), np.int64), last=np.full(len(shown), 399)
    )
    none, whole = np.zeros(len(shown)), np.full(len(shown), 400.0)
    counts = TileSteps(
        tile_id=shown, interval=np.zeros(len(shown), np.int64), visible=whole, hidden=none,
        occupied=none, inferred=none, variance=none,
    )  # fmt: skip
    found = measure_lanes(
        TrackedLanes(
            network=network, grid=grid, states=states, vehicles=vehicles, visible=runs,
            observed=runs,
        ),
        counts,
    ).lanes  # fmt: skip
    row = found["lane"].tolist().index(WEST)
    assert found["counted"][row] == 1
    assert found["queue_max_m"][row] == pytest.approx(60.0 - 51.0 + 4.5)
    assert np.isnan(found["queue_max_m"][found["lane"].tolist().index(EAST)])
