"""Sizes of vehicles by the posterior, and neighbours that are one long vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.cuts import EXISTS
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import COS, LENGTH, SIN, SPEED, WIDTH, X, Y
from gis_radar.tracking.posterior.likelihood import STANDS_MPS
from gis_radar.tracking.size import LONG_M, LONGEST_M, length_prior, width_of

# Shorter ones are only the tracker's: one scatterer looks like a motorcycle.
TRIED_M = (4.0, 4.5, 5.0, 6.0, 7.5, 9.0, 10.5, 12.0, 14.0, 16.5, 18.5)
STAYS = (-1.0, 0.0, 1.0)  # what of a body stays where it is: rear, middle, front
MOST_WINDOWS = 20  # half seconds that are looked at, spread over its time: no more count
DRIVEN, AT_REST = 20.0, 2.0  # half seconds after which the same scatterers tell no more of a body
LEAST_GAIN, LEAST_JOIN = 2.0, 1.0  # of the log-probability
ASIDE_M, SAME_WAY = 1.7, 0.9  # of two that may be one: lateral distance, cosine of headings
TOGETHER = 0.6  # and so much of the shorter's time
SHORTEST_M = 4.0


def prior(length: float) -> float:
    """Return the log prior density of a length."""
    return float(length_prior(np.array([length]))[0])


_PRIORS = {length: prior(length) for length in TRIED_M}


def resized(shape: Floats, length: float, ahead: float) -> Floats:
    """Return shapes with another length, their middle moved ahead."""
    new = shape.copy()
    new[:, X] += ahead * shape[:, COS]
    new[:, Y] += ahead * shape[:, SIN]
    new[:, LENGTH], new[:, WIDTH] = length, width_of(length)
    return new


def with_size(motion: Motion, length: float, ahead: float) -> Motion:
    """Return a motion with another length, its middle moved ahead."""
    heavy = float(length > LONG_M)
    if (motion.p_heavy > 0.5) == (heavy > 0.5):
        heavy = 0.5 * (motion.p_heavy + heavy)
    return replace(
        motion, s_m=motion.s_m + ahead, length_m=length, width_m=width_of(length),
        along_m=motion.along_m - ahead, p_heavy=heavy,
    )  # fmt: skip


def resize(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with the lengths that fit their detections best.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    found = []
    for vehicle, motion in enumerate(posterior.motions):
        length, ahead, gain = _best_size(posterior, vehicle)
        found.append(with_size(motion, length, ahead) if gain > LEAST_GAIN else motion)
    return found


def _best_size(posterior: Posterior, vehicle: int) -> tuple[float, float, float]:
    """Return the length that fits best, how far ahead the middle is then, and the gain."""
    motion = posterior.motions[vehicle]
    rows, weight = _sample(posterior, (vehicle,))
    best = (motion.length_m, 0.0, 0.0)
    shape = posterior.states.shape[rows[0]]
    if len(shape) == 0:
        return best
    posterior.lift(vehicle)
    now = weight * posterior.gains(rows[0], shape)[:, 0].sum() + prior(motion.length_m)
    for length in TRIED_M:
        for stays in STAYS:
            ahead = 0.5 * stays * (motion.length_m - length)
            new = posterior.gains(rows[0], resized(shape, length, ahead))[:, 0].sum()
            gain = float(weight * new + _PRIORS[length] - now)
            if gain > best[2]:
                best = (length, ahead, gain)
    posterior.lift(vehicle, 1.0)
    return best


def _sample(posterior: Posterior, vehicles: Sequence[int]) -> tuple[list[Integers], float]:
    """Return states of vehicles in some half seconds of their time, and what one counts."""
    states = posterior.states
    rows = [np.arange(part.start, part.stop) for part in map(states.rows, vehicles)]
    windows = np.unique(np.concatenate([states.window[each] for each in rows]))
    some = windows[:: max(len(windows) // MOST_WINDOWS, 1)]
    speed = states.shape[rows[0], SPEED]
    rests = len(speed) > 0 and len(vehicles) > 1 and float((speed < STANDS_MPS).mean()) > 0.5
    weight = min(1.0, (AT_REST if rests else DRIVEN) / max(len(some), 1))
    return [each[np.isin(states.window[each], some)] for each in rows], weight


def join_neighbours(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with one long vehicle in place of two where that is more likely.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    motions: list[Motion | None] = list(posterior.motions)
    found = []
    for one, other in _neighbours(posterior):
        if len(posterior.motions[one].s_m) < len(posterior.motions[other].s_m):
            one, other = other, one  # noqa: PLW2901 - the longer track is kept
        length, ahead, gain = _as_one(posterior, one, other)
        if gain > LEAST_JOIN:
            found.append((-gain, one, other, length, ahead))
    used: set[int] = set()
    for _, one, other, length, ahead in sorted(found):
        if used.isdisjoint((one, other)):
            used |= {one, other}
            motions[one] = with_size(posterior.motions[one], length, ahead)
            motions[other] = None
    return [each for each in motions if each is not None]


def _neighbours(posterior: Posterior) -> list[tuple[int, int]]:
    """Return pairs that may be one body for most of the time of the shorter-lived one."""
    states = posterior.states
    count = len(posterior.motions)
    _, rows = np.unique(states.vehicle * (1 << 40) + states.window, return_index=True)
    life = np.bincount(states.vehicle[rows], minlength=count)
    rows = rows[np.argsort(states.window[rows], kind="stable")]
    edges = np.flatnonzero(np.diff(states.window[rows], prepend=-1, append=-1))
    pairs = []
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        here = rows[low:high]
        a, b = _near(states.shape[here])
        one, other = states.vehicle[here[a]], states.vehicle[here[b]]
        pairs.append(np.minimum(one, other) * count + np.maximum(one, other))
    keys, times = np.unique(np.concatenate([np.zeros(0, np.int64), *pairs]), return_counts=True)
    enough = times >= TOGETHER * np.minimum(life[keys // count], life[keys % count])
    return [(int(key) // count, int(key) % count) for key in keys[enough]]


def _near(shape: Floats) -> tuple[Integers, Integers]:
    """Return the pairs of bodies behind each other that are together no longer than a lorry."""
    dx, dy = (shape[:, None, k] - shape[:, k] for k in (X, Y))
    along = dx * shape[:, COS] + dy * shape[:, SIN]
    aside = dy * shape[:, COS] - dx * shape[:, SIN]
    cos = shape[:, None, COS] * shape[:, COS] + shape[:, None, SIN] * shape[:, SIN]
    span = np.abs(along) + 0.5 * (shape[:, None, LENGTH] + shape[:, LENGTH])
    near = (np.abs(aside) < ASIDE_M) & (cos > SAME_WAY) & (span < LONGEST_M)
    one, other = np.nonzero(np.triu(near, 1))
    return one, other


def _as_one(posterior: Posterior, one: int, other: int) -> tuple[float, float, float]:
    """Return length, middle ahead of the first's, and gain of one vehicle in place of two."""
    states = posterior.states
    (a, b), weight = _sample(posterior, (one, other))
    lengths = [posterior.motions[k].length_m for k in (one, other)]
    _, mine, theirs = np.intersect1d(
        states.frame[a], states.frame[b], assume_unique=True, return_indices=True
    )
    best = (0.0, 0.0, -np.inf)
    if len(mine) == 0:
        return best
    sa, sb = states.shape[a[mine]], states.shape[b[theirs]]
    along = float(np.median(
        (sb[:, X] - sa[:, X]) * sa[:, COS] + (sb[:, Y] - sa[:, Y]) * sa[:, SIN]
    ))  # fmt: skip
    front = max(0.5 * lengths[0], along + 0.5 * lengths[1])
    rear = min(-0.5 * lengths[0], along - 0.5 * lengths[1])
    for each in (one, other):
        posterior.lift(each)
    alone = posterior.total.copy()
    old = posterior.gains(a, states.shape[a], add=True)[:, 0].sum()
    old += posterior.gains(b, states.shape[b])[:, 0].sum()
    posterior.total[:] = alone
    before = sum(map(prior, lengths)) - EXISTS
    for longer in (-2.0, 0.0, 2.0):
        length = min(max(front - rear + longer, SHORTEST_M), LONGEST_M)
        for ahead in (-1.0, 0.0, 1.0):
            middle = 0.5 * (front + rear) + ahead
            new = posterior.gains(a, resized(states.shape[a], length, middle))[:, 0].sum()
            gain = float(weight * (new - old) + prior(length) - before)
            if gain > best[2]:
                best = (length, middle, gain)
    for each in (one, other):
        posterior.lift(each, 1.0)
    return best
