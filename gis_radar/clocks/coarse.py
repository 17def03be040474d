"""The rough offset of two clocks: by which lag the traffic on the lanes agrees best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.clocks.sightings import Sightings

BIN_S = 0.25
CELL_M = 4.0
SPEED_MPS = 3.0
PEAK_BINS = 5
AROUND_BINS = 161
APART_BINS = 20
LEAST_SCORE = 8.0  # robust standard deviations over the agreement at other lags
LEAST_LEAD = 1.25  # over the next best lag
LEAST_PAIRS = 20
VALUES_AT_ONCE = 1 << 22


def rough_offset(one: Sightings, other: Sightings, most_s: float) -> tuple[float, str]:
    """Return by how much the clock of `other` is ahead of that of `one`, and why not.

    Counts in which cells of the lanes both saw a vehicle of the same speed, lag by lag, and
    compares the best lag with all others.

    Parameters
    ----------
    one, other : Sightings
        Of two sensors.
    most_s : float
        The largest offset that is looked for, beyond what the begins of the times differ by.

    Returns
    -------
    offset_s : float
        To about half a second; NaN where there is no trustworthy one.
    reason : str
        Why there is none, else empty.
    """
    key_one, key_other = _cells(one), _cells(other)
    common = np.intersect1d(key_one, key_other)
    if len(common) < LEAST_PAIRS:
        return np.nan, "they see no common traffic"
    apart_s = float(other.time[0] - one.time[0])
    bins_one = _bins(one.time - one.time[0])
    bins_other = _bins(other.time - other.time[0])
    agreement = _agreement(key_one, bins_one, key_other, bins_other, common)
    lag = np.arange(len(agreement)) - bins_one.max()
    shift_s = lag * BIN_S + apart_s
    allowed = np.abs(shift_s) <= abs(apart_s) + most_s
    return _best(agreement, shift_s, allowed)


def _best(agreement: Floats, shift_s: Floats, allowed: Booleans) -> tuple[float, str]:
    smooth = uniform_filter1d(agreement, PEAK_BINS, mode="constant") * PEAK_BINS
    around = uniform_filter1d(smooth, AROUND_BINS, mode="constant")
    score = (smooth - around) / np.sqrt(around + 1.0)
    filled = allowed & (around > 0.0)
    if smooth[allowed].max(initial=0.0) < LEAST_PAIRS or filled.sum() < APART_BINS:
        return np.nan, "they see too little common traffic"
    spread = 1.4826 * np.median(np.abs(score[filled] - np.median(score[filled])))
    score = np.where(allowed, score / max(spread, 0.5), -np.inf)
    best = int(score.argmax())
    elsewhere = np.abs(np.arange(len(score)) - best) > APART_BINS
    second = float(score[elsewhere & allowed].max(initial=0.0))
    if score[best] < LEAST_SCORE or score[best] < LEAST_LEAD * second:
        return np.nan, "no lag stands out in their common traffic"
    near = slice(max(best - PEAK_BINS // 2, 0), best + PEAK_BINS // 2 + 1)
    weight = np.maximum(agreement[near] - around[best] / PEAK_BINS, 1e-9)
    return float(np.average(shift_s[near], weights=weight)), ""


def _cells(sightings: Sightings) -> Integers:
    """Return the cell of each sighting: lanelet, place and speed."""
    place = (sightings.s_m / CELL_M).astype(np.int64)
    speed = (sightings.speed / SPEED_MPS).astype(np.int64)
    return (sightings.lanelet * 100_000 + place) * 100 + speed


def _bins(time: Floats) -> Integers:
    return np.asarray((time / BIN_S).astype(np.int64))


def _agreement(
    key_one: Integers, bins_one: Integers, key_other: Integers, bins_other: Integers,
    common: Integers,
) -> Floats:  # fmt: skip
    """Return for each lag in how many cells both had a sighting; lag 0 at `bins_one.max()`."""
    room = int(bins_one.max() + bins_other.max() + 1)
    length = fft.next_fast_len(room, real=True)
    total = np.zeros(length // 2 + 1, np.complex128)
    at_once = max(VALUES_AT_ONCE // length, 1)
    for begin in range(0, len(common), at_once):
        cells = common[begin : begin + at_once]
        spectra = [
            fft.rfft(_filled(key, bins, cells, length), axis=1)
            for key, bins in ((key_one, bins_one), (key_other, bins_other))
        ]
        total += np.einsum("ij,ij->j", np.conj(spectra[0]), spectra[1])
    circular = fft.irfft(total, length)
    return np.maximum(np.roll(circular, int(bins_one.max()))[:room], 0.0)


def _filled(key: Integers, bins: Integers, cells: Integers, length: int) -> NDArray[np.float32]:
    row = np.searchsorted(cells, key)
    row[row == len(cells)] = 0
    mine = cells[row] == key
    table = np.zeros((len(cells), length), np.float32)
    table[row[mine], bins[mine]] = 1.0
    return table
