"""Routes of vehicles: the lanelet that each follows at each step, and its front's place on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats, Integers, compiled, heading_difference
from gis_radar.hdmap import FieldArrays, LaneGraph, lanes_at

_MOST = 8  # most lanelets at one point
# Sigma of the front's distance from the lanelet's centre, and of the heading from the lanelet's.
_LEFT_M, _TURN_RAD = 1.0, 0.3
_MOST_RAD = 1.0  # largest difference of headings at which a vehicle follows a lanelet
_OFF_LANE_COST = 9.0  # cost of a step off all lanelets: that of three sigma beside one
# Cost of a change to a lanelet that is no successor: half a second beside the lane.
_CHANGE_COST = 30.0


@dataclass(frozen=True, kw_only=True)
class Route:
    """Route of a vehicle: its place on the lanes, step by step.

    Parameters
    ----------
    lane : (n,) int64 array
        Position of the lanelet in the graph; -1 off the lanes.
    s_m, d_m : (n,) arrays
        Place along it, and distance to the left of its centre, metres; NaN off the lanes.
    """

    lane: Integers
    s_m: Floats
    d_m: Floats

    def lanelets(self, graph: LaneGraph) -> Integers:
        """Return the ids of the lanelets in the order in which they are driven."""
        lane = self.lane[self.lane >= 0]
        kept = np.concatenate([[True], np.diff(lane) != 0]) if len(lane) else np.zeros(0, bool)
        return np.asarray(graph.lanelet_id[lane[kept]])


def route_of(fronts: Floats, heading: Floats, graph: LaneGraph) -> Route:
    """Return the likeliest sequence of lanelets under a vehicle (Viterbi 1967).

    A vehicle stays on its lanelet or goes on to one that follows it; a change to another one,
    beside or across, has a cost, so that being near it for a moment is not enough.

    Parameters
    ----------
    fronts : (n, 2) array
        The middle of its front at each step, from the origin of the graph.
    heading : (n,) array
        Its heading, radians.
    graph : LaneGraph
        The lanes.
    """
    counts = np.array([len(each) for each in graph.successors], np.int64)
    first = np.concatenate([[0], np.cumsum(counts)])
    after = np.concatenate([*graph.successors, np.zeros(0, np.int64)]).astype(np.int64)
    lane, s_m, d_m = _likeliest(
        np.ascontiguousarray(fronts), heading, first, after, graph.field.arrays
    )
    return Route(lane=lane, s_m=s_m, d_m=d_m)


@compiled
def _likeliest(
    fronts: Floats, heading: Floats, first: Integers, after: Integers, field: FieldArrays
) -> tuple[Integers, Floats, Floats]:  # pragma: no cover - compiled
    """Return lane, s and d of the likeliest sequence of lanelets at each step (Viterbi)."""
    count, lanes = len(fronts), np.empty((_MOST, 6))
    # candidates (lane, s, d) of each step; the last one stands for off the lanes
    candidates = np.full((count, _MOST + 1, 3), np.nan)
    cost, parent = np.full((count, _MOST + 1), 1e18), np.zeros((count, _MOST + 1), np.int64)
    for i in range(count):
        number = lanes_at(fronts[i, 0], fronts[i, 1], field, lanes)
        for j in range(_MOST + 1):
            if j == _MOST:
                emission = _OFF_LANE_COST
                candidates[i, j, 0] = -1.0
            elif j < number:
                turn = abs(heading_difference(lanes[j, 3], heading[i]))
                if turn > _MOST_RAD:
                    continue
                emission = (lanes[j, 2] / _LEFT_M) ** 2 + (turn / _TURN_RAD) ** 2
                candidates[i, j] = lanes[j, :3]
            else:
                continue
            cost[i, j] = emission
            if i > 0:
                best, parent[i, j] = _cheapest(
                    candidates[i - 1, :, 0], cost[i - 1], candidates[i, j, 0], first, after
                )
                cost[i, j] += best
    lane, s_m, d_m = np.empty(count, np.int64), np.empty(count), np.empty(count)
    j = int(np.argmin(cost[count - 1]))
    for i in range(count - 1, -1, -1):
        lane[i], s_m[i], d_m[i] = int(candidates[i, j, 0]), candidates[i, j, 1], candidates[i, j, 2]
        j = parent[i, j]
    return lane, s_m, d_m


@compiled
def _cheapest(
    lanes: Floats, costs: Floats, new: float, first: Integers, after: Integers
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Return the least cost of reaching a lanelet, and the candidate it is reached from."""
    best, chosen = 1e18, 0
    for k in range(len(lanes)):
        if costs[k] < 1e18:
            total = costs[k] + _change_cost(lanes[k], new, first, after)
            if total < best:
                best, chosen = total, k
    return best, chosen


@compiled
def _change_cost(
    old: float, new: float, first: Integers, after: Integers
) -> float:  # pragma: no cover - compiled
    """Return the cost of a change from one lanelet to another."""
    if old == new:
        return 0.0
    if old < 0.0 or new < 0.0:
        return 0.5 * _CHANGE_COST
    for k in range(first[int(old)], first[int(old) + 1]):
        if after[k] == int(new):
            return 0.0
    return _CHANGE_COST
