"""Size of a vehicle from the places of detections on its body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats, compiled


@dataclass(frozen=True, kw_only=True)
class Size:
    """Length and width with their errors; by default those of a car."""

    length_m: float = 4.5
    width_m: float = 1.8
    sigma_m: float = 1.0
    p_heavy: float = 0.1


LONGEST_M = 18.75  # a lorry with trailer (directive 96/53/EC, annex I)
LONG_M = 7.0  # longer vehicles are lorries and buses
# Share of detections of the end of a vehicle, if the sensor sees it squarely; others: of all the
# body.
END_SHARE = 0.75
_SCATTERER_M, _ASPECT_RAD = 0.5, 0.3  # detections nearer along the body and in aspect are of one
# Weight of each detection of a scatterer, whose sum is 1 at most; less where a metre of the body is
# detected in fewer than _LASTING_HALVES half seconds.
_REPEAT_WEIGHT, _LASTING_HALVES = 0.25, 4.0
# Grid of lengths, and of the middle ahead of its first guess, metres.
LENGTHS = np.concatenate([np.arange(2.0, 7.1, 0.5), np.arange(8.0, 19.1, 1.0)])
_SHIFTS = np.arange(-6.0, 6.1, 0.5)


def width_of(length: float) -> float:
    """Return the usual width of a vehicle of some length, metres."""
    return 2.5 if length > LONG_M else (0.8 if length < 2.8 else 1.85)


def length_prior(lengths: Floats) -> Floats:
    """Return the log density of lengths in traffic: motorcycles, cars, vans, lorries, trailers."""
    groups = ((0.03, 2.2, 0.25), (0.72, 4.5, 0.4), (0.10, 5.6, 0.5))
    density = np.full(len(lengths), 1e-4)
    for share, mean, sigma in groups:
        density += share * np.exp(-0.5 * ((lengths - mean) / sigma) ** 2) / (sigma * 2.5066)
    density += np.where((lengths >= 6.0) & (lengths <= 12.6), 0.11 / 6.6, 0.0)
    density += np.where(lengths > 12.6, 0.04 / 6.0, 0.0)
    return np.asarray(np.log(density))


_LOG_PRIOR = length_prior(LENGTHS)[:, None] - 0.5 * (_SHIFTS / 3.0) ** 2
_LENGTH_WIDTHS = np.gradient(LENGTHS)


def size_of(
    along: Floats, ends: Floats, noise: Floats, time: Floats, trust: Floats
) -> tuple[Size, float]:
    """Estimate the size and the middle of a vehicle from the places of detections on it.

    Parameters
    ----------
    along, noise : (n,) arrays
        Distances ahead of a first guess of the middle, and their sigma, metres.
    ends : (n, 3) array
        The end that the sensor sees (1 front, -1 rear), and how squarely it sees the end and the
        side, from 0 to 1.
    time : (n,) array
        UNIX seconds.
    trust : (n,) array
        Weight of each, from 0 to 1.

    Returns
    -------
    size : Size
    ahead_m : float
        Distance of the middle ahead of the first guess, metres.
    """
    fits = trust > 0.0
    if not fits.any():
        return Size(), 0.0
    along, ends, noise, weight = _scatterers(
        along[fits], ends[fits], noise[fits], time[fits], trust[fits]
    )
    coarse = _log_likelihood(along, ends, noise, weight, LENGTHS, _SHIFTS)
    coarse += _LOG_PRIOR
    top = np.unravel_index(int(coarse.argmax()), coarse.shape)
    fine_l = np.maximum(LENGTHS[top[0]] + np.arange(-0.75, 0.76, 0.25), 1.5)
    fine_d = _SHIFTS[top[1]] + np.arange(-0.5, 0.51, 0.125)
    fine = _log_likelihood(along, ends, noise, weight, fine_l, fine_d)
    fine += length_prior(fine_l)[:, None] - 0.5 * (fine_d / 3.0) ** 2
    share = np.exp(coarse - coarse.max())
    by_length = share.sum(axis=1) * _LENGTH_WIDTHS
    by_length /= by_length.sum()
    mean = float(by_length @ LENGTHS)
    sigma = float(np.sqrt(by_length @ (LENGTHS - mean) ** 2))
    near = np.exp(fine - fine.max())
    near /= near.sum()
    length = float(near.sum(axis=1) @ fine_l)
    p_heavy = float(by_length[LENGTHS > LONG_M].sum())
    size = Size(length_m=length, width_m=width_of(length), sigma_m=max(sigma, 0.1), p_heavy=p_heavy)
    return size, float(near.sum(axis=0) @ fine_d)


def _scatterers(
    along: Floats, ends: Floats, noise: Floats, time: Floats, trust: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Group detections to scatterers; return place, visible end, noise and weight of each.

    From one side a sensor sees the same few scatterers of a body, and how often it detects each is
    no evidence of the length. Detections in one half second only may be of a passing vehicle.
    """
    aspect = np.arctan2(ends[:, 2], -ends[:, 0] * ends[:, 1]) / _ASPECT_RAD
    cell = np.clip(np.floor(along / _SCATTERER_M), -400, 400).astype(np.int64)
    key = np.floor(aspect).astype(np.int64) * 1000 + cell
    _, which, count = np.unique(key, return_inverse=True, return_counts=True)
    metre = cell // int(1.0 / _SCATTERER_M)
    half = (2.0 * (time - time.min())).astype(np.int64)
    halves = int(half.max()) + 1
    seen = np.bincount(np.unique(metre * halves + half) // halves + 400, None, 801)
    lasts = np.minimum(seen[metre + 400] / _LASTING_HALVES, 1.0)
    table = np.column_stack([along, ends, noise])
    mean = np.stack([np.bincount(which, column) for column in table.T], axis=1) / count[:, None]
    most = np.zeros(len(count))
    np.maximum.at(most, which, trust)
    weight = np.minimum(np.bincount(which, lasts * trust) * _REPEAT_WEIGHT, most)
    return mean[:, 0], mean[:, 1:4], mean[:, 4], weight


@compiled
def _log_likelihood(
    along: Floats, ends: Floats, noise: Floats, weight: Floats, lengths: Floats, shifts: Floats
) -> Floats:  # pragma: no cover - compiled
    """Return the log likelihood of each length and shift of the middle, (lengths, shifts)."""
    out = np.zeros((len(lengths), len(shifts)))
    for a in range(len(lengths)):
        half = 0.5 * lengths[a]
        width = 2.5 if lengths[a] > LONG_M else 1.8
        for i in range(len(along)):
            share = END_SHARE * width * ends[i, 1]
            share /= width * ends[i, 1] + lengths[a] * ends[i, 2] + 1e-9
            sigma = noise[i]
            for b in range(len(shifts)):
                z = along[i] - shifts[b]
                e = (z - ends[i, 0] * half) / sigma
                end = np.exp(-0.5 * e * e) / (sigma * 2.5066) if abs(e) < 5.0 else 0.0
                near = abs(z) - half
                if near > 3.0 * sigma:
                    side = 0.0
                elif near < -3.0 * sigma:
                    side = 1.0 / lengths[a]
                else:
                    side = 1.0 / (lengths[a] * (1.0 + np.exp(1.7 * near / sigma)))
                out[a, b] += weight[i] * np.log(share * end + (1.0 - share) * side + 0.004)
    return out
