"""The lane of each sample by the likeliest path of its track: vehicles seldom change lanes.

Where each sample takes the nearest of parallel lanes, a turned or shifted pose explains a vehicle
by changes of lanes that did not happen. A track therefore takes one path through the lanes, and
each step to the side costs as much as a change is rare (Viterbi 1967).
"""

from __future__ import annotations

import math

import numpy as np

from gis_radar.base import Floats, Integers, compiled
from gis_radar.calibration.registration.lanes import LANE_STEP_M, Lanes, Placed
from gis_radar.calibration.registration.matches import Matches, lanes_near
from gis_radar.calibration.registration.model import Model
from gis_radar.calibration.registration.residuals import (
    FRONT,
    NO_VEHICLE,
    STRAY_SHARE,
    faces,
    lateral_constants,
    weights,
)

# Lanes of a sample among which its track chooses: three beside each other, and those that follow.
MOST_LANES = 6
# Negative log likelihood of a change of lanes: one vehicle in fifty, in the eight seconds of a
# track.
CHANGE = 4.0
# A path goes on where the next lane begins within STEP_M beside the last, and leads on as a bend of
# LEAST_RADIUS_M does, or a kink of KINK at most.
STEP_M = 1.0
LEAST_RADIUS_M = 6.0
KINK = 0.5
LEAST_COSINE = math.cos(KINK)
# Cost of each metre farther than PAST_M from the last sample of a lane, at most that of a sample on
# no vehicle: no lane is there.
PAST, PAST_M = 1.0, 1.5 * LANE_STEP_M


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
        How far each vehicle drives to the left of drivers' mean place, metres.
    model : Model
        How vehicles drive and reflect.
    scale_m : float
        Widening of all spreads (added in squares), metres.
    """
    samples = placed.samples
    near = lanes_near(lanes, placed, most=MOST_LANES)
    weight = weights(samples, model)
    cost = _costs(
        lateral_constants(model, scale_m), np.array(FRONT), near, lanes.points, lanes.along,
        placed.points, placed.flat, placed.sight, aside[samples.track], weight,
    )  # fmt: skip
    road = lanes.points, lanes.along, lanes.lane
    before, come = _summed(near, cost, samples.in_order, samples.track, *road)
    taken = _followed(near, cost, samples.in_order, before, come)
    lane, found = np.maximum(taken, 0), taken >= 0
    path_cost = _path_costs(taken, before, placed.points, weight, *road)
    return Matches(lane=lane, found=found, path_cost=path_cost)


@compiled
def _costs(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
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
    """Return the negative log likelihood of each sample on each of its lanes."""
    habit, half_width, queues = constants[0], constants[1], constants[7]
    stray, cost = np.exp(-NO_VEHICLE), np.full(near.shape, np.inf)
    for i in range(len(near)):
        for m in range(near.shape[1]):
            k = near[i, m]
            if k < 0:
                break
            off, left, square, visible, hidden = faces(
                constants, i, k, lane_points, along, points, flat, sight
            )
            off -= aside[i] + habit
            side = visible + queues * (hidden - visible)
            bell = side * np.exp(-0.5 / square * (off - half_width * np.sign(left)) ** 2)
            for j in range(len(front)):
                end = np.exp(-0.5 / square * (off - half_width * front[j]) ** 2)
                bell += (1.0 - side) / len(front) * end
            bell *= (1.0 - STRAY_SHARE) / np.sqrt(square)
            past = _past(points[i, 0], points[i, 1], k, lane_points, along)
            cost[i, m] = weight[i] * (past - np.log(bell + stray))
    return cost


@compiled
def _past(
    x: float, y: float, lane: int, points: Floats, along: Floats
) -> float:  # pragma: no cover
    """Return the cost of a place past the end of a lane, of whose samples the nearest is given."""
    ahead = (x - points[lane, 0]) * along[lane, 0] + (y - points[lane, 1]) * along[lane, 1]
    return float(min(PAST * max(abs(ahead) - PAST_M, 0.0), NO_VEHICLE))


@compiled
def _summed(  # pragma: no cover - compiled
    near: Integers,
    cost: Floats,
    order: Integers,
    track: Integers,
    lane_points: Floats,
    along: Floats,
    lane: Integers,
) -> tuple[Integers, Integers]:
    """Sum up the costs along the least path to each sample and lane, in place.

    Returns the sample before each one on its track, -1 for none, and from which of its lanes the
    least path to each lane comes.
    """
    before, come = np.full(len(cost), -1), np.zeros(cost.shape, dtype=np.int64)
    last = -1
    for i in order:
        if near[i, 0] < 0:
            continue
        if last >= 0 and track[last] == track[i]:
            before[i] = last
            for m in range(cost.shape[1]):
                k, least = near[i, m], np.inf
                if k < 0:
                    break
                for n in range(cost.shape[1]):
                    total, q = cost[last, n], near[last, n]
                    if total < least and lane[q] != lane[k]:
                        total += _change(q, k, lane_points, along, lane)
                    if total < least:
                        least, come[i, m] = total, n
                cost[i, m] += least
        last = i
    return before, come


@compiled
def _followed(  # pragma: no cover - compiled
    near: Integers, cost: Floats, order: Integers, before: Integers, come: Integers
) -> Integers:
    """Return the lane of each sample on the least path of its track, -1 for none."""
    chosen, lane = np.full(len(cost), -1), np.full(len(cost), -1)
    for i in order[::-1]:
        if near[i, 0] < 0:
            continue
        if chosen[i] < 0:
            chosen[i] = np.argmin(cost[i])
        lane[i] = near[i, chosen[i]]
        if before[i] >= 0:
            chosen[before[i]] = come[i, chosen[i]]
    return lane


@compiled
def _path_costs(  # pragma: no cover - compiled
    taken: Integers, before: Integers, points: Floats, weight: Floats, lane_points: Floats,
    along: Floats, lane: Integers,
) -> Floats:  # fmt: skip
    """Return the cost of a change of lanes before each sample, and of being past its lane's end."""
    cost = np.zeros(len(taken))
    for i in range(len(taken)):
        if taken[i] >= 0:
            past = _past(points[i, 0], points[i, 1], taken[i], lane_points, along)
            cost[i] = weight[i] * past
        if before[i] >= 0:
            cost[i] += _change(taken[before[i]], taken[i], lane_points, along, lane)
    return cost


@compiled
def _change(  # pragma: no cover - compiled
    one: int, other: int, points: Floats, along: Floats, lane: Integers
) -> float:
    """Return the cost of a vehicle's way from a sample of a lane to one of another; 0 if it is one.

    The chord of an arc has the mean of the directions at its ends.
    """
    if lane[one] == lane[other]:
        return 0.0
    x, y = points[other, 0] - points[one, 0], points[other, 1] - points[one, 1]
    east, north = along[one, 0] + along[other, 0], along[one, 1] + along[other, 1]
    cosine = along[one, 0] * along[other, 0] + along[one, 1] * along[other, 1]
    aside = y * east - x * north
    if aside**2 > STEP_M**2 * (east**2 + north**2):
        return CHANGE
    if cosine < LEAST_COSINE:
        bend = min(KINK + np.hypot(x, y) / LEAST_RADIUS_M, np.pi)
        return CHANGE if cosine < np.cos(bend) else 0.0
    return 0.0
