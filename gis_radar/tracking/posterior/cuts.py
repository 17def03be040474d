"""Death of tracks: delete, trim and split those that do not raise the posterior."""

from __future__ import annotations

import numpy as np

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, compiled
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import WINDOW_S
from gis_radar.tracking.posterior.likelihood import overlap

VEHICLE_COST = 4.0  # cost of a vehicle: prior log odds against one more, nats
# Cost of a begin or an end in plain view: so many nats for each detection expected in so many half
# seconds beyond, and at most so many nats.
_END_SHARE, _END_WINDOWS, MOST_END_COST = 0.5, 4, 8.0
# Shares of a body on another one: over the first a half second costs PARTLY_COST nats, over the
# second, for so many half seconds on end, MOSTLY_COST: two bodies cannot be in one place.
_PARTLY, _MOSTLY, _LEAST_WINDOWS = 0.25, 0.5, 3
PARTLY_COST, MOSTLY_COST = 2.0, 1000.0
SWEEPS = 2  # times that all vehicles are examined: what one loses another one gains


def cut(posterior: Posterior) -> list[Motion]:
    """Return the stretches of vehicles that raise the posterior, as vehicles of their own.

    Vehicles are examined in ascending order of their gain; what one loses the others gain.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; the states that are cut are deleted from it.
    """
    count = len(posterior.motions)
    kept: list[Booleans] = [np.zeros(0, np.bool_)] * count
    for sweep in range(SWEEPS):
        if sweep > 0:
            posterior.update_occlusion()
        for k in np.argsort(posterior.vehicle_gains(), kind="stable").tolist():
            kept[k] = _windows_to_keep(posterior, k)
            rows = posterior.states.rows(k)
            window = posterior.windows(rows)
            gone = ~kept[k][window - window.min()] if len(window) else np.zeros(0, np.bool_)
            posterior.delete_states(rows.start + np.flatnonzero(gone & posterior.alive[rows]))
    return [part for k in range(count) for part in _parts(posterior, k, kept[k])]


def _window_gains(posterior: Posterior, vehicle: int) -> tuple[Floats, Floats]:
    """Return the gain of a vehicle and its expected detections in each of its half seconds."""
    states, part = posterior.states, posterior.states.rows(vehicle)
    if part.start == part.stop:
        return np.zeros(0), np.zeros(0)
    found = posterior.own_gains(vehicle)
    window = posterior.windows(part)[np.diff(states.group[part], prepend=-1) > 0]
    window -= window.min()
    value, expected = (np.bincount(window, found[:, k]).astype(np.float64) for k in (0, 1))
    return value, expected


def _windows_to_keep(posterior: Posterior, vehicle: int) -> Booleans:
    """Return which half seconds of a vehicle to keep: those of the best stretches."""
    value, expected = _window_gains(posterior, vehicle)
    n = len(value)
    if n == 0:
        return np.zeros(0, np.bool_)
    share = _overlapped_share(posterior, vehicle)
    value = value - np.where(share > _PARTLY, PARTLY_COST, 0.0)
    value -= np.where(_lasting(share > _MOSTLY), MOSTLY_COST, 0.0)
    beyond = np.pad(expected, _END_WINDOWS, mode="edge")
    total = np.concatenate([[0.0], np.cumsum(beyond)])
    before = total[_END_WINDOWS : _END_WINDOWS + n] - total[:n]
    after = total[2 * _END_WINDOWS + 1 :] - total[_END_WINDOWS + 1 : _END_WINDOWS + 1 + n]
    begin = VEHICLE_COST + np.minimum(_END_SHARE * before, MOST_END_COST)
    return best_stretches(value, begin, np.minimum(_END_SHARE * after, MOST_END_COST))


def _overlapped_share(posterior: Posterior, vehicle: int) -> Floats:
    """Return the share of a vehicle that overlaps another one in each of its half seconds."""
    states, part = posterior.states, posterior.states.rows(vehicle)
    rows = part.start + np.flatnonzero(np.diff(states.group[part], prepend=-1))
    share = overlap(rows, states.frame, states.shape, posterior.alive, *posterior.by_frame)
    window = posterior.windows(rows)
    window = window - window.min()
    return np.asarray(np.bincount(window, share) / np.maximum(np.bincount(window), 1))


def _runs(flags: Booleans) -> list[tuple[int, int]]:
    """Return the begin and the exclusive end of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int64), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _lasting(flags: Booleans) -> Booleans:
    """Return which flags are in runs of `_LEAST_WINDOWS` or more."""
    found = np.zeros(len(flags), np.bool_)
    for low, high in _runs(flags):
        found[low:high] = high - low >= _LEAST_WINDOWS
    return found


@compiled
def best_stretches(value: Floats, begin: Floats, end: Floats) -> Booleans:
    """Return the stretches with the highest sum of values less the costs of begins and ends.

    Dynamic programming finds them.

    Parameters
    ----------
    value : (n,) array
        Gain of keeping each half second, nats; negative if it is a loss.
    begin, end : (n,) arrays
        Cost of a stretch that begins with, and that ends with each half second, nats.

    Returns
    -------
    (n,) array of bool
        Which half seconds are kept; none if no stretch gains.
    """
    n = len(value)
    kept, before = np.zeros(n, np.bool_), np.zeros((n, 2), np.bool_)
    on, off = -1e18, 0.0
    for k in range(n):
        start = off - begin[k]
        stop = on - end[k - 1] if k > 0 else -1e18
        # whether the one before is kept, if this one is, and if not
        before[k, 0], before[k, 1] = on >= start, stop > off
        on, off = value[k] + max(on, start), max(stop, off)
    there = on - end[n - 1] > off
    for k in range(n - 1, -1, -1):
        kept[k] = there
        there = before[k, 0] if there else before[k, 1]
    return kept


def _parts(posterior: Posterior, vehicle: int, kept: Booleans) -> list[Motion]:
    """Return the stretches of a vehicle that are kept and have detections."""
    motion = posterior.motions[vehicle]
    if kept.all():
        return [motion] if len(kept) else []
    base = int(posterior.windows(posterior.states.rows(vehicle)).min())
    found = []
    for low, high in _runs(kept):
        first, after = (_step_of(base + each) for each in (low, high))
        if low == 0:
            first = motion.first_step
        last = motion.last_step if high == len(kept) else after - 1
        found.append(motion.between(first, last, posterior.detections.time))
    return [each for each in found if each is not None]


def _step_of(window: int) -> int:
    """Return the first step of a half second."""
    return int(np.ceil(window * WINDOW_S * STEPS_PER_SECOND))
