"""Links between parts of the tracks of vehicles, moving or standing.

A part that ends at a place may continue in one that begins there later, unless another vehicle
drove over the place in between, or it should have been detected in between. All ends and begins are
associated together, at least cost.
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

_END_STEPS = 10  # steps over which the speed at an end is taken: half a second
_MOST_EXPECTED = 60.0  # without a single one of so many expected detections no vehicle is there
# Costs are negative log odds.
END_COST = 8.0  # cost of a track that ends, and of another one that begins, in view
_OVERLAP_S = 2.0  # largest overlap in time of the second part with the first
# Largest speed at both ends, largest distance and turn of a vehicle that waits between its parts.
_WAITING_MPS, _WAITING_M, _WAITING_RAD = 5.0, 9.0, 0.6
_BRAKING_MPS2 = 3.0  # usual braking and acceleration, which give the way to and from a stop
_PLACE_M = 1.0  # error of the ends of two parts of one vehicle: half a car
# Cost of a stop, and of each second of it: two minutes cost half as much as an end.
_STOP_COST, _WAIT_COST = 0.5, 0.03
# Longest time without detections and largest turn of a moving vehicle.
_UNDETECTED_S, _TURNING_RAD = 6.0, 1.9
# How much slower than the mean of both ends, and faster than the faster end, the mean speed of an
# undetected moving vehicle may be, per second: it may stop and start in between.
_SLOWING_MPS2, _GAINING_MPS2 = 0.6, 0.5
# For gaps up to this duration it is not slower than the slower end after braking so.
BRIEF_S, _BRAKED_MPS2 = 3.0, 1.2
# Sigma of the mean speed about that of both ends, per second; cost of the square root of an
# undetected second, and of each metre.
_CHANGE_MPS2, _UNDETECTED_COST, _METRE_COST = 0.7, 0.15, 0.03
# Sigma of the speed at an end; parts that differ by more sigmas are of different vehicles.
_SPEED_MPS, _MOST_SIGMA = 0.5, 3.0
# How far the next part may begin behind the expected place, and beside the straight continuation;
# the latter grows by so much a metre.
_BACK_M, _BESIDE_M, _DRIFT = 3.0, 1.6, 0.15


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a track, moving or stationary.

    Parameters
    ----------
    time, heading, speed : (2,) arrays
        At its begin and its end: UNIX seconds, radians, m/s.
    place : (2, 2) array
        Its middle there, metres.
    stationary : bool
        Whether it stands throughout.
    """

    time: Floats
    place: Floats
    heading: Floats
    speed: Floats
    stationary: bool

    @classmethod
    def of_motion(cls, motion: Motion) -> Part:
        """Return the part of a motion."""
        place, heading = motion.places
        speeds = [np.median(motion.speed[:_END_STEPS]), np.median(motion.speed[-_END_STEPS:])]
        steps = np.array([motion.first_step, motion.last_step])
        return cls(
            time=steps / STEPS_PER_SECOND, place=place[[0, -1]], heading=heading[[0, -1]],
            speed=np.array(speeds), stationary=False,
        )  # fmt: skip

    @classmethod
    def of_target(cls, target: StationaryTarget, place: tuple[Floats, float]) -> Part:
        """Return the part of a stationary target with its middle and heading."""
        return cls(
            time=np.array([target.begin, target.end]), place=np.stack([place[0]] * 2),
            heading=np.full(2, place[1]), speed=np.zeros(2), stationary=True,
        )  # fmt: skip


def chains(parts: Sequence[Part], passes: Passes, detectability: Detectability) -> list[list[int]]:
    """Link parts to tracks; return the numbers of the parts of each track, by time.

    Parameters
    ----------
    parts : sequence of Part
        Parts of all tracks.
    passes : Passes
        Times at which vehicles drove over places.
    detectability : Detectability
        Expected numbers of detections; its occluders are numbered as the parts.
    """
    following = _following(parts, passes, detectability)
    found = []
    for head in np.setdiff1d(np.arange(len(parts)), following).tolist():
        chain = [head]
        while following[chain[-1]] != NONE:
            chain.append(int(following[chain[-1]]))
        found.append(chain)
    return found


def _following(parts: Sequence[Part], passes: Passes, detectability: Detectability) -> Integers:
    """Return the part that follows each part, or `NONE`, by the assignment of least cost."""
    following = np.full(len(parts), NONE, np.int64)
    costs = [
        each for a in range(len(parts)) for each in _costs(a, parts, passes)
        if not _is_missed(parts, each[0], each[1], detectability)
    ]  # fmt: skip
    if not costs:
        return following
    a, b = np.array([each[:2] for each in costs], np.int64).T
    befores, row = np.unique(a, return_inverse=True)
    afters, column = np.unique(b, return_inverse=True)
    matrix = np.full((len(befores), len(afters) + len(befores)), 1e6)
    matrix[row, column] = [each[2] for each in costs]
    row_number = np.arange(len(befores))
    matrix[row_number, len(afters) + row_number] = END_COST
    for i, k in zip(*linear_sum_assignment(matrix), strict=True):
        if k < len(afters) and matrix[i, k] < END_COST:
            following[befores[i]] = afters[k]
    return following


def _is_missed(parts: Sequence[Part], a: int, b: int, detectability: Detectability) -> bool:
    """Return whether a vehicle of both parts should have been detected in between."""
    span = (float(parts[a].time[1]), float(parts[b].time[0]))
    if span[1] - span[0] < SILENT_S:
        return False
    places = np.stack([parts[a].place[1], parts[b].place[0]])
    return detectability.expected_between(places, span, (a, b)) > _MOST_EXPECTED


@dataclass(frozen=True, kw_only=True)
class _Gaps:
    """Gaps from the end of one part to the begins of all parts, an entry for each.

    Parameters
    ----------
    lapse : (n,) array
        Time from the end to the begin, seconds.
    along, left, apart : (n,) arrays
        Distance ahead of the end, to either side, and in all, metres.
    turn : (n,) array
        Difference of headings, radians.
    speed : (n,) array
        Speed at the begin, m/s.
    later : (n,) bool array
        Whether the part begins and ends later than the one.
    stationary : (n,) bool array
        Whether the part stands throughout.
    """

    lapse: Floats
    along: Floats
    left: Floats
    apart: Floats
    turn: Floats
    speed: Floats
    later: Booleans
    stationary: Booleans

    @classmethod
    def of(cls, a: int, parts: Sequence[Part]) -> _Gaps:
        """Return the gaps from the end of part `a`."""
        part = parts[a]
        begin, end = (np.array([each.time[k] for each in parts]) for k in (0, 1))
        gap = np.array([each.place[0] for each in parts]) - part.place[1]
        heading = float(part.heading[1])
        c, s = np.cos(heading), np.sin(heading)
        turned = np.array([each.heading[0] for each in parts]) - heading
        later = (begin > part.time[0]) & (end > part.time[1]) & (np.arange(len(parts)) != a)
        return cls(
            lapse=begin - part.time[1], along=gap @ np.array([c, s]),
            left=np.abs(gap @ np.array([-s, c])), apart=np.hypot(*gap.T),
            turn=np.abs(np.angle(np.exp(1j * turned))),
            speed=np.array([each.speed[0] for each in parts]), later=later,
            stationary=np.array([each.stationary for each in parts]),
        )  # fmt: skip


def _costs(a: int, parts: Sequence[Part], passes: Passes) -> Iterator[tuple[int, int, float]]:
    """Yield (a, b, cost) for each part b that may follow part a: after a stop, or driving on."""
    part, gaps = parts[a], _Gaps.of(a, parts)
    speed = float(part.speed[1])
    slow = (speed < _WAITING_MPS) & (gaps.speed < _WAITING_MPS)
    waits = gaps.later & slow & (gaps.lapse > -_OVERLAP_S) & (gaps.apart < _WAITING_M)
    waits &= (gaps.turn < _WAITING_RAD) & (gaps.left < _BESIDE_M)
    drives_on = gaps.later & ~gaps.stationary & (gaps.lapse > -_OVERLAP_S)
    drives_on &= (gaps.lapse < _UNDETECTED_S) & (gaps.turn < _TURNING_RAD)
    excess = gaps.along - 0.5 * (speed + gaps.speed) * gaps.lapse
    drives_on &= (excess > -_BACK_M) & ((gaps.lapse >= 0.0) | (excess < _BACK_M))
    bend = 0.5 * np.maximum(gaps.along, 0.0) * np.sin(np.minimum(gaps.turn, 0.5 * np.pi))
    drives_on &= gaps.left < _BESIDE_M + bend + _DRIFT * gaps.apart
    if part.stationary:
        drives_on[:] = False
    free_until = passes.after(part.place[1], float(part.time[1])) if waits.any() else np.inf
    for b in np.flatnonzero(waits | drives_on).tolist():
        cost = _cost_of_driving(speed, gaps, b) if drives_on[b] else np.inf
        if waits[b] and part.time[1] + gaps.lapse[b] < free_until + 0.5:
            cost = min(cost, _cost_of_waiting(speed, gaps, b))
        cost += (gaps.left[b] / (1.0 + 0.1 * gaps.apart[b])) ** 2
        cost += 0.5 * (gaps.turn[b] / _WAITING_RAD) ** 2
        if cost < END_COST:
            yield a, b, float(cost)


def _cost_of_waiting(speed: float, gaps: _Gaps, b: int) -> float:
    """Return the cost of a stop between two parts, by its duration and their distance."""
    creep = (speed**2 + gaps.speed[b] ** 2) / (2.0 * _BRAKING_MPS2)
    off = max(abs(gaps.along[b] - creep) - _PLACE_M, 0.0) / (1.5 * _PLACE_M)
    return float(off**2 + _STOP_COST + _WAIT_COST * max(gaps.lapse[b], 0.05))


def _cost_of_driving(speed: float, gaps: _Gaps, b: int) -> float:
    """Return the cost of driving on undetected between two parts, by the mean speed between."""
    lapse = max(float(gaps.lapse[b]), 0.05)
    mean, middle = gaps.apart[b] * np.sign(gaps.along[b]) / lapse, 0.5 * (speed + gaps.speed[b])
    slowest = 0.0
    if lapse < BRIEF_S:
        slowest = max(min(speed, gaps.speed[b]) - _BRAKED_MPS2 * lapse, 0.0)
    low = min(slowest, max(middle - _SLOWING_MPS2 * lapse, 0.0))
    high = max(speed, gaps.speed[b]) + _GAINING_MPS2 * lapse
    place = _PLACE_M / lapse
    miss = max(low - mean, mean - high, 0.0) / (_SPEED_MPS + place)
    if miss >= _MOST_SIGMA:
        return np.inf
    sigma = _CHANGE_MPS2 * lapse + 2.0 * _SPEED_MPS + place
    undetected = _UNDETECTED_COST * np.sqrt(lapse) + _METRE_COST * gaps.apart[b]
    return float(miss**2 + 0.5 * ((mean - middle) / sigma) ** 2 + undetected)
