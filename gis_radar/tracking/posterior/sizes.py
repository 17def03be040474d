"""Sizes of vehicles by the posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.base import Floats, Integers, compiled
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import SPEED
from gis_radar.tracking.posterior.likelihood import (
    REACH_M,
    STANDS_MPS,
    Rates,
    Seen,
    aspect,
    density_across,
    density_along,
    gain_of,
    kind_and_cell,
    on_body,
    rate_density,
    taller,
)
from gis_radar.tracking.size import LONG_M, length_prior, width_of

# Shorter ones are only the tracker's: one scatterer looks like a motorcycle.
TRIED_M = (4.0, 4.5, 5.0, 6.0, 7.5, 9.0, 10.5, 12.0, 14.0, 16.5, 18.5)
STAYS = (-1.0, 0.0, 1.0)  # what of a body stays where it is: rear, middle, front
# Half seconds that are looked at, driven and at rest each, spread over its time: the same
# scatterers tell no more of a length.
MOST_WINDOWS = 20
LEAST_GAIN = 2.0  # of the log-probability


def prior(length: float) -> float:
    """Return the log prior density of a length."""
    return float(length_prior(np.array([length]))[0])


_PRIORS = [prior(length) for length in TRIED_M]


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
    (rows,) = sample(posterior, (vehicle,))
    if len(rows) == 0:
        return motion.length_m, 0.0, 0.0
    tried = [(motion.length_m, 0.0)] + [
        (length, 0.5 * stays * (motion.length_m - length)) for length in TRIED_M for stays in STAYS
    ]
    posterior.lift(vehicle)
    found = gains_of_sizes(posterior, rows, tried)
    posterior.lift(vehicle, 1.0)
    found += [prior(motion.length_m), *np.repeat(_PRIORS, len(STAYS))]
    best = int(np.argmax(found))
    return (*tried[best], float(found[best] - found[0]))


def gains_of_sizes(
    posterior: Posterior, rows: Integers, sizes: Sequence[tuple[float, float]]
) -> Floats:
    """Return the gain over all else of states with each length, their middle moved ahead."""
    table = np.array([(length, width_of(length), ahead) for length, ahead in sizes])
    states = posterior.states
    return _sum_gains(
        states.group[rows], states.frame[rows], posterior.sensor[rows],
        states.shape[rows], posterior.open[rows], table, posterior.rates, posterior.seen,
        posterior.alpha,
    )  # fmt: skip


@compiled
def _sum_gains(  # noqa: PLR0917 - numba takes plain arrays
    group: Integers, frame: Integers, sensor: Integers, shape: Floats, open_share: Floats,
    sizes: Floats, rates: Rates, seen: Seen, alpha: Floats,
) -> Floats:  # fmt: skip
    """Return the gain for each (length, width, ahead) of `sizes`."""
    begin, row, pair = _pairs(frame, shape, sizes, seen)
    room, new = np.empty((len(row), 2)), np.empty(shape.shape[1])
    across = np.empty((len(row), 3))
    gains = np.zeros(len(sizes))
    for k in range(len(sizes)):
        length, width, ahead = sizes[k, 0], sizes[k, 1], sizes[k, 2]
        half, side, e = 0.5 * length, 0.5 * width + REACH_M, 0
        if k == 0 or width != sizes[k - 1, 1]:
            for q in range(len(row)):
                left, cos, sin = pair[q, 1], pair[q, 2], pair[q, 3]
                found = density_across(left, cos, sin, width, seen[3][row[q]])
                across[q, 0], across[q, 1], across[q, 2] = found
        while e < len(group):
            g, n, due = group[e], 0, 0.0
            stands = 1 if shape[e, 4] < STANDS_MPS else 0
            while e < len(group) and group[e] == g:
                new[0] = shape[e, 0] + ahead * shape[e, 2]
                new[1] = shape[e, 1] + ahead * shape[e, 3]
                new[2], new[3], new[4] = shape[e, 2], shape[e, 3], shape[e, 4]
                new[5] = length
                kind, cell = kind_and_cell(new, sensor[e], rates)
                mu = rates[1][kind] * rates[2][cell] * open_share[e]
                due += mu
                for q in range(begin[e], begin[e + 1]):
                    along, left = pair[q, 0] - ahead, pair[q, 1]
                    if abs(along) < half + REACH_M and abs(left) < side:
                        density = pair[q, 4] * density_along(
                            along, pair[q, 2], pair[q, 3], length, width,
                            across[q, 0], across[q, 1], across[q, 2],
                        )  # fmt: skip
                        if length > LONG_M:
                            density *= pair[q, 5]
                        room[n, 0], room[n, 1] = mu * density, seen[6][row[q]]
                        n += 1
                e += 1
            gains[k] += gain_of(room, n, due, alpha[stands])[0]
    return gains


@compiled
def _pairs(
    frame: Integers, shape: Floats, sizes: Floats, seen: Seen
) -> tuple[Integers, Integers, Floats]:
    """Return the detections that states of any of the sizes may explain.

    Returns
    -------
    begin : (states + 1,) int64 array
        Where those of each state begin.
    row : (n,) int64 array
        The detection.
    pair : (n, 6) array
        Ahead and left of the middle, cosine and sine of the angle to the line of sight, density of
        the range rate, and how much denser its height is for a lorry.
    """
    first, points, sight, away, rate, height, _ = seen
    rear, front = 0.0, 0.0
    for k in range(len(sizes)):
        rear = min(rear, sizes[k, 2] - 0.5 * sizes[k, 0])
        front = max(front, sizes[k, 2] + 0.5 * sizes[k, 0])
    side = 0.5 * sizes[:, 1].max() + REACH_M
    reach = max(front, -rear) + REACH_M + side
    begin, n = np.zeros(len(frame) + 1, np.int64), 0
    for e in range(len(frame)):
        n += first[frame[e] + 1] - first[frame[e]]
    row, pair = np.empty(n, np.int64), np.empty((n, 6))
    n = 0
    for e in range(len(frame)):
        x, y, c, s, speed = shape[e, 0], shape[e, 1], shape[e, 2], shape[e, 3], shape[e, 4]
        for d in range(first[frame[e]], first[frame[e] + 1]):
            dx, dy = points[d, 0] - x, points[d, 1] - y
            if (abs(dx) > reach) | (abs(dy) > reach):
                continue
            along, left, turn = on_body(shape[e], dx, dy)
            if rear - REACH_M < along < front + REACH_M and abs(left) < side:
                cos, sin = aspect(c, s, turn, sight[d])
                pair[n, 0], pair[n, 1], pair[n, 2], pair[n, 3] = along, left, cos, sin
                pair[n, 4] = rate_density(rate[d], speed * cos)
                pair[n, 5] = taller(height[d], away[d])
                row[n] = d
                n += 1
        begin[e + 1] = n
    return begin, row[:n], pair[:n]


def sample(posterior: Posterior, vehicles: Sequence[int]) -> list[Integers]:
    """Return states of vehicles in some half seconds of their time.

    In as many at most of the time in which the first one drives as of the rest.
    """
    states = posterior.states
    parts = [states.rows(each) for each in vehicles]
    slow = states.window[parts[0]][states.shape[parts[0], SPEED] < STANDS_MPS]
    windows = np.unique(np.concatenate([states.window[each] for each in parts]))
    rests = np.isin(windows, slow)
    kinds = (windows[~rests], windows[rests])
    some = np.concatenate([each[:: max(-(-len(each) // MOST_WINDOWS), 1)] for each in kinds])
    return [part.start + np.flatnonzero(np.isin(states.window[part], some)) for part in parts]
