"""Deleted, trimmed and split tracks: what the posterior does not support goes."""

from __future__ import annotations

import numpy as np

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, compiled
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import WINDOW_S
from gis_radar.tracking.posterior.likelihood import overlap

EXISTS = 4.0  # log-odds against one more vehicle
END_SHARE, END_MOST, END_WINDOWS = 0.5, 8.0, 4  # who ends in plain view pays for what is due in 2 s
PARTLY, MOSTLY, LASTS = 0.25, 0.5, 3  # shares of a vehicle on another one; and half seconds
PARTLY_COSTS, MOSTLY_COSTS = 2.0, 1000.0  # half a second each; two bodies are not in one place
SWEEPS = 2


def cut(posterior: Posterior) -> list[Motion]:
    """Return what is left of the vehicles: those stretches that raise the posterior.

    The weakest vehicle is looked at first; what it loses the others gain.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; what goes is removed from it.
    """
    count = len(posterior.motions)
    kept: list[Booleans] = [np.zeros(0, np.bool_)] * count
    for sweep in range(SWEEPS):
        if sweep > 0:
            posterior.cover()
        for k in np.argsort(posterior.strengths(), kind="stable").tolist():
            kept[k] = _kept(posterior, k)
            rows = posterior.states.rows(k)
            window = posterior.states.window[rows]
            gone = ~kept[k][window - window.min()] if len(window) else np.zeros(0, np.bool_)
            posterior.remove(rows.start + np.flatnonzero(gone & posterior.alive[rows]))
    return [part for k in range(count) for part in _parts(posterior, k, kept[k])]


def _by_window(posterior: Posterior, vehicle: int) -> tuple[Floats, Floats]:
    """Return in each half second of a vehicle how much it raises the posterior, and what is due."""
    states, part = posterior.states, posterior.states.rows(vehicle)
    if part.start == part.stop:
        return np.zeros(0), np.zeros(0)
    found = posterior.own_gains(vehicle)
    window = states.window[part][np.diff(states.group[part], prepend=-1) > 0]
    window -= window.min()
    value, due = (np.bincount(window, found[:, k]).astype(np.float64) for k in (0, 1))
    return value, due


def _kept(posterior: Posterior, vehicle: int) -> Booleans:
    """Return which half seconds of a vehicle are kept."""
    value, due = _by_window(posterior, vehicle)
    n = len(value)
    if n == 0:
        return np.zeros(0, np.bool_)
    share = _on_others(posterior, vehicle)
    value = value - np.where(share > PARTLY, PARTLY_COSTS, 0.0)
    value -= np.where(_lasting(share > MOSTLY), MOSTLY_COSTS, 0.0)
    beyond = np.concatenate([np.full(END_WINDOWS, due[0]), due, np.full(END_WINDOWS, due[-1])])
    total = np.concatenate([[0.0], np.cumsum(beyond)])
    before = total[END_WINDOWS : END_WINDOWS + n] - total[:n]
    after = total[2 * END_WINDOWS + 1 :] - total[END_WINDOWS + 1 : END_WINDOWS + 1 + n]
    begin = EXISTS + np.minimum(END_SHARE * before, END_MOST)
    return best_stretches(value, begin, np.minimum(END_SHARE * after, END_MOST))


def _on_others(posterior: Posterior, vehicle: int) -> Floats:
    """Return which share of a vehicle lies on another one in each of its half seconds."""
    states, part = posterior.states, posterior.states.rows(vehicle)
    rows = part.start + np.flatnonzero(np.diff(states.group[part], prepend=-1))
    share = overlap(rows, states.frame, states.shape, posterior.alive, *posterior.by_frame)
    window = states.window[rows] - states.window[rows].min()
    return np.asarray(np.bincount(window, share) / np.maximum(np.bincount(window), 1))


def _runs(flags: Booleans) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int64), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _lasting(flags: Booleans) -> Booleans:
    """Return which flags are in runs that last."""
    found = np.zeros(len(flags), np.bool_)
    for low, high in _runs(flags):
        found[low:high] = high - low >= LASTS
    return found


@compiled
def best_stretches(value: Floats, begin: Floats, end: Floats) -> Booleans:
    """Return the stretches with the highest sum of values, less the costs of begins and ends.

    Parameters
    ----------
    value : (n,) array
        What it gains to keep a place, nats; negative where it costs.
    begin, end : (n,) array
        What a stretch costs that begins or ends at a place, nats.

    Returns
    -------
    (n,) array of bool
        Which places are kept; none where nothing gains.
    """
    n = len(value)
    kept, before = np.zeros(n, np.bool_), np.zeros((n, 2), np.bool_)
    on, off = -1e18, 0.0
    for k in range(n):
        start = off - begin[k]
        stop = on - end[k - 1] if k > 0 else -1e18
        before[k, 0], before[k, 1] = on >= start, stop > off  # whether it was there before
        on, off = value[k] + max(on, start), max(stop, off)
    there = on - end[n - 1] > off
    for k in range(n - 1, -1, -1):
        kept[k] = there
        there = before[k, 0] if there else before[k, 1]
    return kept


def _parts(posterior: Posterior, vehicle: int, kept: Booleans) -> list[Motion]:
    """Return the parts of a vehicle that are kept and have detections."""
    motion = posterior.motions[vehicle]
    if kept.all():
        return [motion] if len(kept) else []
    base = int(posterior.states.window[posterior.states.rows(vehicle)].min())
    found = []
    for low, high in _runs(kept):
        first, after = (_step_of(base + each) for each in (low, high))
        if low == 0:
            first = motion.first_step
        last = motion.last_step if high == len(kept) else after - 1
        found.append(motion.between(first, last, posterior.given.time))
    return [each for each in found if each is not None]


def _step_of(window: int) -> int:
    return int(np.ceil(window * WINDOW_S * STEPS_PER_SECOND))
