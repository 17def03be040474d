"""Still detections of vehicles that come to rest or set off."""

from __future__ import annotations

import numpy as np

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.detections import AZIMUTH_RAD, MapDetections
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.start.detectability import Detectability
from gis_radar.tracking.start.forward import STANDING_MPS
from gis_radar.tracking.start.passes import Passes
from gis_radar.tracking.start.stationary import RATE_SHARE, SILENCE_S

_END_M = 1.0  # error of the place of an end of a vehicle
_LEFT_M = 1.1  # half the width of a vehicle, with the error of its place
# Still detections are of a vehicle that comes to rest or sets off if its place gives fewer of them
# while it is empty: in the nearest _EMPTY_S of the _SEARCH_S before or after it, in which it is
# more than its length and AWAY_M away. At least _OWN_SHARE of the detections must be the vehicle's.
AWAY_M, _EMPTY_S, _SEARCH_S, _OWN_SHARE = 2.0, 3.0, 60.0, 0.5


def with_rest(
    number: int,
    motion: Motion,
    detections: MapDetections,
    free: Booleans,
    states: Floats,
    passes: Passes,
    detectability: Detectability,
) -> Motion:
    """Return a motion extended by the unassigned still detections on it while it is at rest.

    A vehicle that comes to rest stands until it is not detected for `SILENCE_S`, or until another
    one drives over its place; a vehicle that sets off stood before, back to such a time.

    Parameters
    ----------
    number : int
        Number of the vehicle among the occluders.
    motion : Motion
        Its motion.
    detections : MapDetections
        All detections.
    free : (n,) bool array
        Which are still and unassigned; those that it takes are cleared.
    states : (n, 6) array
        States of the filter; set to the motion for its detections.
    passes : Passes
        Times at which vehicles drove over places.
    detectability : Detectability
        Expected numbers of detections.
    """
    slow = np.flatnonzero(motion.speed < STANDING_MPS)
    place, heading = motion.places
    time = detections.time[motion.rows]
    s_m, speed = motion.at(time)
    states[motion.rows, :2], states[motion.rows, 2] = motion.path.at(s_m)
    states[motion.rows, 3] = speed
    if len(slow) == 0:
        return motion
    ends = (motion.first_step + slow[[0, -1]]) / STEPS_PER_SECOND
    last = len(motion.speed) - 1
    if slow[0] == 0:
        ends[0] = passes.before(_axis(motion, 0), float(ends[0]))
    if slow[-1] == last:
        ends[1] = passes.after(_axis(motion, -1), float(ends[1]))
    rows = _free_between(detections, free, ends)
    reach = 3.0 * _half_m(motion) + np.ptp(place[slow], axis=0)
    rows = rows[(np.abs(detections.points[rows] - place[slow].mean(axis=0)) < reach).all(axis=1)]
    step = np.round(detections.time[rows] * STEPS_PER_SECOND).astype(np.int64) - motion.first_step
    step = np.clip(step, 0, last)
    at_rest = motion.speed[step] < STANDING_MPS
    rows, step = rows[at_rest], step[at_rest]
    on_body = _on_body(motion, motion.s_m[step], detections, rows)
    rows, step = rows[on_body], step[on_body]
    span = (float(time[0]), float(time[-1]))
    kept = without_gaps(detections.time[rows], span, SILENCE_S)
    rows, step = rows[kept], step[kept]
    for end in (0, -1):
        side = detections.time[rows] > span[1] if end else detections.time[rows] < span[0]
        if side.any():
            ends = np.sort([span[end], float(detections.time[rows[side][end]])])
            expected = detectability.expected_between(
                place[[end, end]], (ends[0], ends[1]), (number, NONE)
            )
            rate = rate_without(number, motion, end, detections, free, detectability)
            fixed = (ends[1] - ends[0]) * rate
            own_count, count = side.sum() - fixed, side.sum()
            if own_count < RATE_SHARE * expected or own_count < _OWN_SHARE * count:
                rows, step = rows[~side], step[~side]
    if len(rows) == 0:
        return motion
    free[rows] = False
    states[rows, :2], states[rows, 2], states[rows, 3] = place[step], heading[step], 0.0
    return fit_motion(detections, np.concatenate([motion.rows, rows]), states)


def _axis(motion: Motion, end: int) -> Floats:
    """Return points (k, 2) along a vehicle's axis at its first (0) or last (-1) step.

    They lie a metre inside its ends, where errors of its length do not matter.
    """
    place, heading = (each[end] for each in motion.places)
    half = max(0.5 * motion.length_m - _END_M, 0.0)
    way = np.array([np.cos(heading), np.sin(heading)])
    return np.asarray(place + np.linspace(-half, half, 2 * int(half) + 1)[:, None] * way)


def _half_m(motion: Motion) -> float:
    """Return the largest distance of detections from a vehicle's middle, metres."""
    return 0.5 * max(motion.length_m, 4.0) + 0.5


def _free_between(detections: MapDetections, free: Booleans, ends: Floats) -> Integers:
    """Return the unassigned still detections between two times."""
    low, high = np.searchsorted(detections.time, ends)
    return np.asarray(low + np.flatnonzero(free[low:high]))


def _on_body(
    motion: Motion,
    s_m: Floats,
    detections: MapDetections,
    rows: Integers,
) -> Booleans:
    """Return which detections lie on a vehicle whose middle is at `s_m` along its path."""
    if len(rows) == 0:
        return np.zeros(0, np.bool_)
    along, left = motion.path.project(detections.points[rows], s_m, 25.0)
    beside = _LEFT_M + AZIMUTH_RAD * detections.range_m[rows]
    return np.asarray((np.abs(along - s_m) < _half_m(motion)) & (np.abs(left) < beside))


def rate_without(
    number: int,
    motion: Motion,
    end: int,
    detections: MapDetections,
    free: Booleans,
    detectability: Detectability,
) -> float:
    """Return the rate of still detections at a vehicle's place without it, before or after.

    Such detections are of fixed objects or of parked cars. They are counted in the nearest seconds
    in which no other vehicle is there.

    Parameters
    ----------
    number : int
        Number of the vehicle among the occluders.
    motion : Motion
        Motion of the vehicle.
    end : int
        0 for its first place, before it came; -1 for its last place, after it left.
    detections : MapDetections
        Detections of all sensors, by time.
    free : (n,) array of bool
        Which detections are of no vehicle.
    detectability : Detectability
        Has the places of other vehicles as occluders.

    Returns
    -------
    float
        Detections a second; 0 where the place is never without vehicles.
    """
    away = np.abs(motion.s_m - motion.s_m[end]) > motion.length_m + AWAY_M
    if not away.any():
        return 0.0
    when = (motion.first_step + np.flatnonzero(away)[end]) / STEPS_PER_SECOND
    ends = np.array([when - _SEARCH_S, when] if end else [when, when + _SEARCH_S])
    ends = np.clip(ends, detections.time[0], detections.time[-1])
    halves = np.arange(int(2.0 * ends[0]), int(2.0 * ends[1]) + 1)
    others = detectability.occluders.near(motion.places[0][end], halves, number, motion.length_m)
    empty, count = np.setdiff1d(halves, others), round(2.0 * _EMPTY_S)
    empty = empty[-count:] if end else empty[:count]
    if len(empty) == 0:
        return 0.0
    rows = _free_between(detections, free, np.array([0.5 * empty[0], 0.5 * empty[-1] + 0.5]))
    s_m = np.full(len(rows), motion.s_m[end])
    rows = rows[_on_body(motion, s_m, detections, rows)]
    return float(
        2.0 * np.isin((2.0 * detections.time[rows]).astype(np.int64), empty).sum() / len(empty)
    )


def without_gaps(time: Floats, span: tuple[float, float], silence_s: float) -> slice:
    """Return the slice of ascending times around a span that has no gap over `silence_s`."""
    early = np.append(time[time < span[0]], span[0])
    late = np.insert(time[time > span[1]], 0, span[1])
    breaks = np.flatnonzero(np.diff(early) > silence_s)
    first = int(breaks[-1]) + 1 if len(breaks) else 0
    breaks = np.flatnonzero(np.diff(late) > silence_s)
    missing = len(late) - 1 - int(breaks[0]) if len(breaks) else 0
    return slice(first, len(time) - missing)
