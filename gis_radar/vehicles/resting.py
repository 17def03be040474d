"""Vehicles that come to rest, or set off: their still detections before and after they move."""

from __future__ import annotations

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.columns import NONE
from gis_radar.vehicles.detectability import Detectability
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.motion import Motion, fit_motion
from gis_radar.vehicles.settings import VehicleSettings
from gis_radar.vehicles.sweeps import Sweeps

END_M = 1.0  # by which an end of a vehicle may be off


def with_rest(
    number: int, motion: Motion, echoes: Echoes, free: Booleans, states: Floats, sweeps: Sweeps,
    seen: Detectability, settings: VehicleSettings,
) -> Motion:  # fmt: skip
    """Return a motion with the free still detections on it while it stands, which it takes.

    One that comes to rest stands on until it is silent or another drives over its place, and one
    that sets off stood there before.
    """
    limits = settings.lives
    slow = np.flatnonzero(motion.speed < limits.slow_mps)
    place, heading = motion.places
    time = echoes.time[motion.rows]
    s_m, speed = motion.at(time)
    states[motion.rows, :2], states[motion.rows, 2] = motion.path.at(s_m)
    states[motion.rows, 3] = speed
    if len(slow) == 0:
        return motion
    ends = (motion.first_step + slow[[0, -1]]) / STEPS_PER_SECOND
    last = len(motion.speed) - 1
    if slow[0] == 0:
        ends[0] = sweeps.before(_inner(motion, 0), float(ends[0]))
    if slow[-1] == last:
        ends[1] = sweeps.after(_inner(motion, -1), float(ends[1]))
    rows = _in_span(echoes, free, ends)
    reach = 3.0 * _half_m(motion) + np.ptp(place[slow], axis=0)
    rows = rows[(np.abs(echoes.points[rows] - place[slow].mean(axis=0)) < reach).all(axis=1)]
    step = np.round(echoes.time[rows] * STEPS_PER_SECOND).astype(np.int64) - motion.first_step
    step = np.clip(step, 0, last)
    at_rest = motion.speed[step] < limits.slow_mps
    rows, step = rows[at_rest], step[at_rest]
    on = _on_body(motion, motion.s_m[step], echoes, rows, settings)
    rows, step = rows[on], step[on]
    span = (float(time[0]), float(time[-1]))
    kept = unbroken(echoes.time[rows], span, settings.standing.silence_s)
    rows, step = rows[kept], step[kept]
    for at in (0, -1):
        side = echoes.time[rows] > span[1] if at else echoes.time[rows] < span[0]
        if side.any():
            ends = np.sort([span[at], float(echoes.time[rows[side][at]])])
            due = seen.due_between(place[[at, at]], (ends[0], ends[1]), (number, NONE))
            fixed = (ends[1] - ends[0]) * _rate_without(
                number, motion, at, echoes, free, seen, settings
            )
            own, count = side.sum() - fixed, side.sum()
            if own < settings.standing.rate_share * due or own < limits.own_share * count:
                rows, step = rows[~side], step[~side]
    if len(rows) == 0:
        return motion
    free[rows] = False
    states[rows, :2], states[rows, 2], states[rows, 3] = place[step], heading[step], 0.0
    return fit_motion(echoes, np.concatenate([motion.rows, rows]), states, settings.motion)


def _inner(motion: Motion, at: int) -> Floats:
    """Return points (k, 2) along the middle of a vehicle at a step, a metre inside of its ends."""
    place, heading = (each[at] for each in motion.places)
    half = max(0.5 * motion.length_m - END_M, 0.0)
    way = np.array([np.cos(heading), np.sin(heading)])
    return np.asarray(place + np.linspace(-half, half, 2 * int(half) + 1)[:, None] * way)


def _half_m(motion: Motion) -> float:
    """Return how far from its middle detections of a vehicle may lie: half of it and an error."""
    return 0.5 * max(motion.length_m, 4.0) + 0.5


def _in_span(echoes: Echoes, free: Booleans, ends: Floats) -> Integers:
    """Return the free detections between two times."""
    low, high = np.searchsorted(echoes.time, ends)
    return np.asarray(low + np.flatnonzero(free[low:high]))


def _on_body(
    motion: Motion, s_m: Floats, echoes: Echoes, rows: Integers, settings: VehicleSettings
) -> Booleans:
    """Tell which detections lie on a vehicle whose middle is so far along its path."""
    if len(rows) == 0:
        return np.zeros(0, np.bool_)
    along, left = motion.path.project(echoes.points[rows], s_m, 25.0)
    beside = settings.lives.left_m + settings.motion.azimuth_rad * echoes.range_m[rows]
    return np.asarray((np.abs(along - s_m) < _half_m(motion)) & (np.abs(left) < beside))


def _rate_without(
    number: int, motion: Motion, at: int, echoes: Echoes, free: Booleans, seen: Detectability,
    settings: VehicleSettings,
) -> float:  # fmt: skip
    """Return how often a second its place is detected before it came, or after it left.

    What stands there then, and is no other vehicle, is of the road or is parked beside it. The
    nearest seconds count in which no other vehicle is there.
    """
    limits = settings.lives
    away = np.abs(motion.s_m - motion.s_m[at]) > motion.length_m + limits.away_m
    if not away.any():
        return 0.0
    when = (motion.first_step + np.flatnonzero(away)[at]) / STEPS_PER_SECOND
    ends = np.array([when - limits.search_s, when] if at else [when, when + limits.search_s])
    ends = np.clip(ends, echoes.time[0], echoes.time[-1])
    halves = np.arange(int(2.0 * ends[0]), int(2.0 * ends[1]) + 1)
    others = seen.occluders.near(motion.places[0][at], halves, number, motion.length_m)
    empty, count = np.setdiff1d(halves, others), round(2.0 * limits.empty_s)
    empty = empty[-count:] if at else empty[:count]
    if len(empty) == 0:
        return 0.0
    rows = _in_span(echoes, free, np.array([0.5 * empty[0], 0.5 * empty[-1] + 0.5]))
    s_m = np.full(len(rows), motion.s_m[at])
    rows = rows[_on_body(motion, s_m, echoes, rows, settings)]
    return float(
        2.0 * np.isin((2.0 * echoes.time[rows]).astype(np.int64), empty).sum() / len(empty)
    )


def unbroken(time: Floats, span: tuple[float, float], silence_s: float) -> slice:
    """Return which of ascending times go on from a span, both ways, without a longer silence."""
    early = np.append(time[time < span[0]], span[0])
    late = np.insert(time[time > span[1]], 0, span[1])
    breaks = np.flatnonzero(np.diff(early) > silence_s)
    first = int(breaks[-1]) + 1 if len(breaks) else 0
    breaks = np.flatnonzero(np.diff(late) > silence_s)
    missing = len(late) - 1 - int(breaks[0]) if len(breaks) else 0
    return slice(first, len(time) - missing)
