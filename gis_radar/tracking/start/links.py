"""Links between parts of the tracks of vehicles, moving or standing.

A part that ends somewhere may continue in one that begins there later, unless another vehicle drove
over the place, or it would have been detected meanwhile. All are matched together, at least cost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.start.detectability import SILENT_S, Detectability
from gis_radar.tracking.start.passes import Passes
from gis_radar.tracking.start.stationary import StationaryTarget

END_STEPS = 10  # steps over which the speed at an end is taken: half a second
MOST_DUE = 60.0  # expected detections; if none of as many is observed, no vehicle is there
# Costs are negative logarithms of odds.
END_COST = 8.0  # cost of a track that ends or begins in view
OVERLAP_S = 2.0  # largest overlap in time of the second part with the first
# Largest speed at both ends, largest distance and turn of a vehicle that waits between its parts.
WAITING_MPS, WAITING_M, WAITING_RAD = 5.0, 9.0, 0.6
BRAKING_MPS2 = 3.0  # usual braking and acceleration, which give the way of a waiting vehicle
PLACE_M = 1.0  # error of the ends of two parts of one vehicle: half a car
# Cost of a stop and of each second of it: two minutes cost half as much as an end.
STOP_COST, WAIT_COST = 0.5, 0.03
# Longest time without detections and largest turn of a moving vehicle.
UNSEEN_S, TURNING_RAD = 6.0, 1.9
# How much slower than the mean of both ends, and faster than the faster end, the mean speed of an
# undetected moving vehicle may be, per second: it may stop and start in between.
SLOWING_MPS2, GAINING_MPS2 = 0.6, 0.5
# For gaps up to this duration it is not slower than the slower end after braking so.
BRIEFLY_S, BRAKED_MPS2 = 3.0, 1.2
# Sigma of the mean speed about that of both ends, per second; cost of the square root of an
# undetected second, and of a metre.
USUAL_MPS2, UNSEEN_COST, WAY_COST = 0.7, 0.15, 0.03
# Sigma of the speed at an end; parts that differ by more sigma are of different vehicles.
SURE_MPS, MOST_SIGMA = 0.5, 3.0
# How far behind, and how far beside the straight continuation the next part may begin, the latter
# with so much more per metre.
BACK_M, BESIDE_M, DRIFT = 3.0, 1.6, 0.15


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a track: time, place, heading and speed at its begin and end."""

    time: Floats
    place: Floats
    heading: Floats
    speed: Floats
    stationary: bool

    @classmethod
    def of_motion(cls, motion: Motion) -> Part:
        """Make a part of a moving vehicle."""
        place, heading = motion.places
        speeds = [np.median(motion.speed[:END_STEPS]), np.median(motion.speed[-END_STEPS:])]
        steps = np.array([motion.first_step, motion.last_step])
        return cls(
            time=steps / STEPS_PER_SECOND, place=place[[0, -1]], heading=heading[[0, -1]],
            speed=np.array(speeds), stationary=False,
        )  # fmt: skip

    @classmethod
    def of_target(cls, target: StationaryTarget, place: tuple[Floats, float]) -> Part:
        """Make a part of a stationary vehicle with its middle."""
        return cls(
            time=np.array([target.begin, target.end]), place=np.stack([place[0]] * 2),
            heading=np.full(2, place[1]), speed=np.zeros(2), stationary=True,
        )  # fmt: skip


def chains(parts: Sequence[Part], passes: Passes, seen: Detectability) -> list[list[int]]:
    """Return the parts of each track in their order.

    Parameters
    ----------
    parts : sequence of Part
        Parts of all tracks.
    passes : Passes
        Times at which vehicles drove over places.
    seen : Detectability
        Expected numbers of detections; its occluders are numbered as the parts.
    """
    following = _following(parts, passes, seen)
    found = []
    for head in np.setdiff1d(np.arange(len(parts)), following).tolist():
        chain = [head]
        while following[chain[-1]] != NONE:
            chain.append(int(following[chain[-1]]))
        found.append(chain)
    return found


def _following(parts: Sequence[Part], passes: Passes, seen: Detectability) -> Integers:
    """Return the part that follows each, or `NONE`: the assignment of least cost."""
    following = np.full(len(parts), NONE, np.int64)
    costs = [
        each for a in range(len(parts)) for each in _costs(a, parts, passes)
        if not _is_missed(parts, each[0], each[1], seen)
    ]  # fmt: skip
    if not costs:
        return following
    a, b = np.array([each[:2] for each in costs], np.int64).T
    befores, row = np.unique(a, return_inverse=True)
    afters, column = np.unique(b, return_inverse=True)
    matrix = np.full((len(befores), len(afters) + len(befores)), 1e6)
    matrix[row, column] = [each[2] for each in costs]
    own = np.arange(len(befores))
    matrix[own, len(afters) + own] = END_COST
    for i, k in zip(*linear_sum_assignment(matrix), strict=True):
        if k < len(afters) and matrix[i, k] < END_COST:
            following[befores[i]] = afters[k]
    return following


def _is_missed(parts: Sequence[Part], a: int, b: int, seen: Detectability) -> bool:
    """Return whether a vehicle that joins both parts would have been detected in between."""
    span = (float(parts[a].time[1]), float(parts[b].time[0]))
    if span[1] - span[0] < SILENT_S:
        return False
    places = np.stack([parts[a].place[1], parts[b].place[0]])
    return seen.due_between(places, span, (a, b)) > MOST_DUE


@dataclass(frozen=True, kw_only=True)
class _Ends:
    """Begins of all parts relative to the end of one: lapse, along, left, apart, turn, speed."""

    lapse: Floats
    along: Floats
    left: Floats
    apart: Floats
    turn: Floats
    speed: Floats
    later: Booleans
    stationary: Booleans

    @classmethod
    def of(cls, a: int, parts: Sequence[Part]) -> _Ends:
        """Return the begins of all parts relative to the end of part `a`."""
        mine = parts[a]
        begin, end = (np.array([each.time[k] for each in parts]) for k in (0, 1))
        gap = np.array([each.place[0] for each in parts]) - mine.place[1]
        heading = float(mine.heading[1])
        c, s = np.cos(heading), np.sin(heading)
        turned = np.array([each.heading[0] for each in parts]) - heading
        later = (begin > mine.time[0]) & (end > mine.time[1]) & (np.arange(len(parts)) != a)
        return cls(
            lapse=begin - mine.time[1], along=gap @ np.array([c, s]),
            left=np.abs(gap @ np.array([-s, c])), apart=np.hypot(*gap.T),
            turn=np.abs(np.angle(np.exp(1j * turned))),
            speed=np.array([each.speed[0] for each in parts]), later=later,
            stationary=np.array([each.stationary for each in parts]),
        )  # fmt: skip


def _costs(a: int, parts: Sequence[Part], passes: Passes) -> Iterator[tuple[int, int, float]]:
    """Yield (a, b, cost) of the parts b that may follow part a after waiting or driving on."""
    mine, to = parts[a], _Ends.of(a, parts)
    speed = float(mine.speed[1])
    slow = (speed < WAITING_MPS) & (to.speed < WAITING_MPS)
    waits = to.later & slow & (to.lapse > -OVERLAP_S) & (to.apart < WAITING_M)
    waits &= (to.turn < WAITING_RAD) & (to.left < BESIDE_M)
    drives = to.later & ~to.stationary & (to.lapse > -OVERLAP_S)
    drives &= (to.lapse < UNSEEN_S) & (to.turn < TURNING_RAD)
    gain = to.along - 0.5 * (speed + to.speed) * to.lapse
    drives &= (gain > -BACK_M) & ((to.lapse >= 0.0) | (gain < BACK_M))
    bend = 0.5 * np.maximum(to.along, 0.0) * np.sin(np.minimum(to.turn, 0.5 * np.pi))
    drives &= to.left < BESIDE_M + bend + DRIFT * to.apart
    if mine.stationary:
        drives[:] = False
    free_until = passes.after(mine.place[1], float(mine.time[1])) if waits.any() else np.inf
    for b in np.flatnonzero(waits | drives).tolist():
        cost = _cost_of_driving(speed, to, b) if drives[b] else np.inf
        if waits[b] and mine.time[1] + to.lapse[b] < free_until + 0.5:
            cost = min(cost, _cost_of_waiting(speed, to, b))
        cost += (to.left[b] / (1.0 + 0.1 * to.apart[b])) ** 2
        cost += 0.5 * (to.turn[b] / WAITING_RAD) ** 2
        if cost < END_COST:
            yield a, b, float(cost)


def _cost_of_waiting(speed: float, to: _Ends, b: int) -> float:
    """Return the cost of a stop between two parts, by the distance between them."""
    creep = (speed**2 + to.speed[b] ** 2) / (2.0 * BRAKING_MPS2)
    off = max(abs(to.along[b] - creep) - PLACE_M, 0.0) / (1.5 * PLACE_M)
    return float(off**2 + STOP_COST + WAIT_COST * max(to.lapse[b], 0.05))


def _cost_of_driving(speed: float, to: _Ends, b: int) -> float:
    """Return the cost of driving on undetected between two parts, by the mean speed."""
    lapse = max(float(to.lapse[b]), 0.05)
    mean, middle = to.apart[b] * np.sign(to.along[b]) / lapse, 0.5 * (speed + to.speed[b])
    slowest = 0.0
    if lapse < BRIEFLY_S:
        slowest = max(min(speed, to.speed[b]) - BRAKED_MPS2 * lapse, 0.0)
    low = min(slowest, max(middle - SLOWING_MPS2 * lapse, 0.0))
    high = max(speed, to.speed[b]) + GAINING_MPS2 * lapse
    place = PLACE_M / lapse
    miss = max(low - mean, mean - high, 0.0) / (SURE_MPS + place)
    if miss >= MOST_SIGMA:
        return np.inf
    usual = USUAL_MPS2 * lapse + 2.0 * SURE_MPS + place
    unseen = UNSEEN_COST * np.sqrt(lapse) + WAY_COST * to.apart[b]
    return float(miss**2 + 0.5 * ((mean - middle) / usual) ** 2 + unseen)
