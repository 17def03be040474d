"""Match tracks to their likeliest path through the lanes (Viterbi 1967).

If each sample took the nearest of parallel lanes, a rotated or shifted pose would be explained by
lane changes that did not happen. On a path each change of lanes costs its negative log likelihood.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import Floats, Integers, compiled
from gis_radar.calibration.registration.lanes import LANE_STEP_M, Lanes, Placed
from gis_radar.calibration.registration.matches import Matches, lanes_near
from gis_radar.calibration.registration.model import Model
from gis_radar.calibration.registration.residuals import (
    FRONT_PLACES,
    NO_VEHICLE,
    STRAY_SHARE,
    faces,
    lateral_constants,
    weights,
)

_MOST_LANES = 6  # lanes of a sample among which a path chooses: three, and their successors
# Negative log likelihood of a change of lanes: one vehicle in fifty in a track of eight seconds.
CHANGE_COST = 4.0
# Another lane continues the path, without a change, if it begins within _SIDE_STEP_M across the
# path, and turns by no more than a bend of _LEAST_RADIUS_M or a kink of _KINK (radians).
_SIDE_STEP_M = 1.0
_LEAST_RADIUS_M = 6.0
_KINK = 0.5
_LEAST_KINK_COSINE = math.cos(_KINK)
# Cost of each metre farther than _PAST_M past the last sample of a lane, up to that of a sample on
# no vehicle.
_PAST_COST, _PAST_M = 1.0, 1.5 * LANE_STEP_M


def match_paths(
    lanes: Lanes, placed: Placed, aside: Floats, *, model: Model, scale_m: float
) -> Matches:
    """Find for each sample the lane on the likeliest path of its track.

    Parameters
    ----------
    lanes : Lanes
        The map.
    placed : Placed
        Traces, placed by the assumed state of the sensor.
    aside : (tracks,) array
        Offset of each vehicle to the left of the drivers' mean, metres.
    model : Model
        How vehicles drive and reflect.
    scale_m : float
        Standard deviation added in squares to all others, metres.
    """
    samples = placed.samples
    near = lanes_near(lanes, placed, most=_MOST_LANES)
    weight = weights(samples, model)
    cost = _lane_costs(
        lateral_constants(model, scale_m), np.array(FRONT_PLACES), near, lanes.points, lanes.along,
        placed.points, placed.flat, placed.sight, aside[samples.track], weight,
    )  # fmt: skip
    road = lanes.points, lanes.along, lanes.lane
    previous, from_choice = _sum_forward(near, cost, samples.in_order, samples.track, *road)
    chosen = _trace_back(near, cost, samples.in_order, previous, from_choice)
    lane, found = np.maximum(chosen, 0), chosen >= 0
    path_cost = _path_costs(chosen, previous, placed.points, weight, *road)
    return Matches(lane=lane, found=found, path_cost=path_cost)


@compiled
def _lane_costs(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    constants: Floats,
    front: Floats,
    near: Integers,
    lane_points: Floats,
    along: Floats,
    points: Floats,
    flat: Floats,
    sight: Floats,
    aside: Floats,
    weight: Floats,
) -> Floats:
    """Return the negative log likelihood of each sample on each of its lanes, as `near`."""
    habit, half_width, queues = constants[0], constants[1], constants[7]
    stray, cost = np.exp(-NO_VEHICLE), np.full(near.shape, np.inf)
    for i in range(len(near)):
        for m in range(near.shape[1]):
            k = near[i, m]
            if k < 0:
                break
            offset, left, square, visible, hidden = faces(
                constants, i, k, lane_points, along, points, flat, sight
            )
            offset -= aside[i] + habit
            side = visible + queues * (hidden - visible)
            density = side * np.exp(-0.5 / square * (offset - half_width * np.sign(left)) ** 2)
            for j in range(len(front)):
                end = np.exp(-0.5 / square * (offset - half_width * front[j]) ** 2)
                density += (1.0 - side) / len(front) * end
            density *= (1.0 - STRAY_SHARE) / np.sqrt(square)
            past_cost = _cost_past_end(points[i, 0], points[i, 1], k, lane_points, along)
            cost[i, m] = weight[i] * (past_cost - np.log(density + stray))
    return cost


@compiled
def _cost_past_end(
    x: float, y: float, lane: int, points: Floats, along: Floats
) -> float:  # pragma: no cover
    """Return the cost of a point past the end of a lane, given the lane's nearest sample."""
    ahead = (x - points[lane, 0]) * along[lane, 0] + (y - points[lane, 1]) * along[lane, 1]
    return float(min(_PAST_COST * max(abs(ahead) - _PAST_M, 0.0), NO_VEHICLE))


@compiled
def _sum_forward(  # pragma: no cover - compiled
    near: Integers,
    cost: Floats,
    order: Integers,
    track: Integers,
    lane_points: Floats,
    along: Floats,
    lane: Integers,
) -> tuple[Integers, NDArray[np.int8]]:
    """Run the forward pass of Viterbi: add to each cost that of the cheapest path to it, in place.

    Returns the previous sample of each one on its track, -1 for none, and for each lane of a sample
    the column of the lane from which the cheapest path comes.
    """
    previous, from_choice = np.full(len(cost), -1), np.zeros(cost.shape, dtype=np.int8)
    last = -1
    for i in order:
        if near[i, 0] < 0:
            continue
        if last >= 0 and track[last] == track[i]:
            previous[i] = last
            for m in range(cost.shape[1]):
                k, least = near[i, m], np.inf
                if k < 0:
                    break
                for n in range(cost.shape[1]):
                    total, q = cost[last, n], near[last, n]
                    if q < 0:
                        break
                    if total < least and lane[q] != lane[k]:
                        total += _transition_cost(q, k, lane_points, along, lane)
                    if total < least:
                        least, from_choice[i, m] = total, n
                cost[i, m] += least
        last = i
    return previous, from_choice


@compiled
def _trace_back(  # pragma: no cover - compiled
    near: Integers, cost: Floats, order: Integers, previous: Integers, from_choice: NDArray[np.int8]
) -> Integers:
    """Return the lane of each sample on the cheapest path of its track, -1 for none."""
    choice, lane = np.full(len(cost), -1), np.full(len(cost), -1)
    for i in order[::-1]:
        if near[i, 0] < 0:
            continue
        if choice[i] < 0:
            choice[i] = np.argmin(cost[i])
        lane[i] = near[i, choice[i]]
        if previous[i] >= 0:
            choice[previous[i]] = from_choice[i, choice[i]]
    return lane


@compiled
def _path_costs(  # pragma: no cover - compiled
    chosen: Integers, previous: Integers, points: Floats, weight: Floats, lane_points: Floats,
    along: Floats, lane: Integers,
) -> Floats:  # fmt: skip
    """Return for each sample the cost of a change of lanes before it and of being past the end."""
    cost = np.zeros(len(chosen))
    for i in range(len(chosen)):
        if chosen[i] >= 0:
            past = _cost_past_end(points[i, 0], points[i, 1], chosen[i], lane_points, along)
            cost[i] = weight[i] * past
        if previous[i] >= 0:
            cost[i] += _transition_cost(chosen[previous[i]], chosen[i], lane_points, along, lane)
    return cost


@compiled
def _transition_cost(  # pragma: no cover - compiled
    leaving: int, entering: int, points: Floats, along: Floats, lane: Integers
) -> float:
    """Return the cost to go from a lane sample to another; 0 on one lane or its continuation.

    The distance across the path is measured from the mean direction of both lanes, which is that
    of the chord of an arc.
    """
    if lane[leaving] == lane[entering]:
        return 0.0
    x, y = points[entering, 0] - points[leaving, 0], points[entering, 1] - points[leaving, 1]
    east, north = along[leaving, 0] + along[entering, 0], along[leaving, 1] + along[entering, 1]
    cosine = along[leaving, 0] * along[entering, 0] + along[leaving, 1] * along[entering, 1]
    across = y * east - x * north
    if across**2 > _SIDE_STEP_M**2 * (east**2 + north**2):
        return CHANGE_COST
    if cosine < _LEAST_KINK_COSINE:
        most_turn = min(_KINK + np.hypot(x, y) / _LEAST_RADIUS_M, np.pi)
        return CHANGE_COST if cosine < np.cos(most_turn) else 0.0
    return 0.0
