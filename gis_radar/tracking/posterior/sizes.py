"""Sizes of vehicles: the lengths under which their detections are most likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.base import Floats, Integers, compiled
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import SHAPE_SPEED
from gis_radar.tracking.posterior.likelihood import (
    REACH_M,
    STANDS_MPS,
    DetectionArrays,
    RateModel,
    aspect,
    body_coordinates,
    class_and_cell,
    density_across,
    density_along,
    height_ratio,
    log_likelihood_ratio,
    rate_density,
)
from gis_radar.tracking.size import LONG_M, length_prior, width_of

# Lengths that are tried, metres. Shorter ones come from the start only: one scatterer looks like a
# motorcycle.
_LENGTHS_M = (4.0, 4.5, 5.0, 6.0, 7.5, 9.0, 10.5, 12.0, 14.0, 16.5, 18.5)
FIXED_POINTS = (-1.0, 0.0, 1.0)  # what keeps its place in another length: rear, middle, front
# Most half seconds of a vehicle that are evaluated, while it drives and while it stands, spread
# over its time: more show the same scatterers again.
MOST_WINDOWS = 20
_LEAST_GAIN = 2.0  # least gain of another length, nats


def log_prior(length: float) -> float:
    """Return the log prior density of a length (metres)."""
    return float(length_prior(np.array([length]))[0])


_LOG_PRIORS = [log_prior(length) for length in _LENGTHS_M]


def with_size(motion: Motion, length: float, ahead: float) -> Motion:
    """Return a motion with another length, its middle moved ahead by so many metres."""
    heavy = float(length > LONG_M)
    if (motion.p_heavy > 0.5) == (heavy > 0.5):
        heavy = 0.5 * (motion.p_heavy + heavy)
    return replace(
        motion, s_m=motion.s_m + ahead, length_m=length, width_m=width_of(length),
        along_m=motion.along_m - ahead, p_heavy=heavy,
    )  # fmt: skip


def resize(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with the lengths that maximize the posterior.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; it does not change.
    """
    found = []
    for vehicle, motion in enumerate(posterior.motions):
        length, ahead, gain = _best_size(posterior, vehicle)
        found.append(with_size(motion, length, ahead) if gain > _LEAST_GAIN else motion)
    return found


def _best_size(posterior: Posterior, vehicle: int) -> tuple[float, float, float]:
    """Return the best length, the shift of the middle ahead (both metres), and the gain, nats."""
    motion = posterior.motions[vehicle]
    (rows,) = sample(posterior, (vehicle,))
    if len(rows) == 0:
        return motion.length_m, 0.0, 0.0
    tried = [(motion.length_m, 0.0)]
    for length in _LENGTHS_M:
        tried += [(length, 0.5 * fixed * (motion.length_m - length)) for fixed in FIXED_POINTS]
    posterior.exclude(vehicle)
    found = gains_of_sizes(posterior, rows, tried)
    posterior.include(vehicle)
    found += [log_prior(motion.length_m), *np.repeat(_LOG_PRIORS, len(FIXED_POINTS))]
    best = int(np.argmax(found))
    return (*tried[best], float(found[best] - found[0]))


def gains_of_sizes(
    posterior: Posterior, rows: Integers, sizes: Sequence[tuple[float, float]]
) -> Floats:
    """Return the gain of states with each of some sizes, nats.

    Parameters
    ----------
    posterior : Posterior
        The vehicle's own rates must not be among its total rates.
    rows : (n,) int64 array
        States of one vehicle.
    sizes : sequence of (float, float)
        Length, and how far ahead its middle is then, metres.
    """
    table = np.array([(length, width_of(length), ahead) for length, ahead in sizes])
    states, frame = posterior.states, posterior.states.frame[rows]
    return _sum_gains(
        states.group[rows], frame, posterior.frames.sensor[frame],
        states.shape[rows], posterior.visible_share[rows], table, posterior.rate_model,
        posterior.detection_arrays, posterior.alpha,
    )  # fmt: skip


@compiled
def _sum_gains(  # noqa: PLR0917 - numba takes plain arrays
    group: Integers, frame: Integers, sensor: Integers, shape: Floats, visible_share: Floats,
    sizes: Floats, model: RateModel, arrays: DetectionArrays, alpha: Floats,
) -> Floats:  # fmt: skip
    """Return the gain, nats, with each row (length, width, middle ahead) of `sizes`."""
    begin, row, pair = _pairs(frame, shape, sizes, arrays)
    work, new = np.empty((len(row), 2)), np.empty(shape.shape[1])
    across = np.empty((len(row), 3))
    gains = np.zeros(len(sizes))
    for k in range(len(sizes)):
        length, width, ahead = sizes[k, 0], sizes[k, 1], sizes[k, 2]
        half, side, e = 0.5 * length, 0.5 * width + REACH_M, 0
        if k == 0 or width != sizes[k - 1, 1]:
            for q in range(len(row)):
                left, cos, sin = pair[q, 1], pair[q, 2], pair[q, 3]
                found = density_across(left, cos, sin, width, arrays[3][row[q]])
                across[q, 0], across[q, 1], across[q, 2] = found
        while e < len(group):
            g, n, expected = group[e], 0, 0.0
            stands = 1 if shape[e, 4] < STANDS_MPS else 0
            while e < len(group) and group[e] == g:
                new[0] = shape[e, 0] + ahead * shape[e, 2]
                new[1] = shape[e, 1] + ahead * shape[e, 3]
                new[2], new[3], new[4] = shape[e, 2], shape[e, 3], shape[e, 4]
                new[5] = length
                rate_class, cell = class_and_cell(new, sensor[e], model)
                mu = model[1][rate_class] * model[2][cell] * visible_share[e]
                expected += mu
                for q in range(begin[e], begin[e + 1]):
                    along, left = pair[q, 0] - ahead, pair[q, 1]
                    if abs(along) < half + REACH_M and abs(left) < side:
                        density = pair[q, 4] * density_along(
                            along, pair[q, 2], pair[q, 3], length, width,
                            across[q, 0], across[q, 1], across[q, 2],
                        )  # fmt: skip
                        if length > LONG_M:
                            density *= pair[q, 5]
                        work[n, 0], work[n, 1] = mu * density, arrays[6][row[q]]
                        n += 1
                e += 1
            gains[k] += log_likelihood_ratio(work, n, expected, alpha[stands])[0]
    return gains


@compiled
def _pairs(
    frame: Integers, shape: Floats, sizes: Floats, arrays: DetectionArrays
) -> tuple[Integers, Integers, Floats]:
    """Return the pairs of states, in any of the sizes, and detections near them.

    Returns
    -------
    begin : (states + 1,) int64 array
        Index of the first pair of each state.
    row : (n,) int64 array
        The detection.
    pair : (n, 6) array
        Place ahead and left of the middle, cosine and sine of the angle to the line of sight,
        density of the range rate, likelihood ratio of the height for a lorry.
    """
    first, points, sight, range_m, rate, height, _ = arrays
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
            along, left, turn = body_coordinates(shape[e], dx, dy)
            if rear - REACH_M < along < front + REACH_M and abs(left) < side:
                cos, sin = aspect(c, s, turn, sight[d])
                pair[n, 0], pair[n, 1], pair[n, 2], pair[n, 3] = along, left, cos, sin
                pair[n, 4] = rate_density(rate[d], speed * cos)
                pair[n, 5] = height_ratio(height[d], range_m[d])
                row[n] = d
                n += 1
        begin[e + 1] = n
    return begin, row[:n], pair[:n]


def sample(posterior: Posterior, vehicles: Sequence[int]) -> list[Integers]:
    """Return the states of some vehicles in a sample of half seconds, an array of rows each.

    The sample has at most `MOST_WINDOWS` half seconds in which the first vehicle drives, and as
    many of the others.
    """
    states = posterior.states
    parts = [states.rows(each) for each in vehicles]
    windows_of = [posterior.windows(each) for each in parts]
    slow = windows_of[0][states.shape[parts[0], SHAPE_SPEED] < STANDS_MPS]
    windows = np.unique(np.concatenate(windows_of))
    standing = np.isin(windows, slow)
    parts_of_time = (windows[~standing], windows[standing])
    every = [max(-(-len(each) // MOST_WINDOWS), 1) for each in parts_of_time]
    sampled = np.concatenate([each[::n] for each, n in zip(parts_of_time, every, strict=True)])
    return [
        part.start + np.flatnonzero(np.isin(window, sampled))
        for part, window in zip(parts, windows_of, strict=True)
    ]
