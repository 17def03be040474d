"""Measure the offset of two clocks by the traffic that both sensors see.

Two sensors that see a vehicle at (nearly) one moment see it at (nearly) one place. If the clock of
one is ahead by tau, it sees a vehicle of speed v in the wrong place by -v tau; what is left
besides is that one may see the front of a vehicle and the other its rear, which does not depend
on the speed. So, over pairs of sightings,

    s_other - s_one - v (t_other - t_one)  =  d(place, sides)  -  v (tau + drift (t - t_mid))

is solved by robust least squares, with what is known of d beforehand: a vehicle is some metres
long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

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


APART_S = 0.35
APART_MPS = 1.5
APART_M = (12.0, 9.0, 7.0)
PLACE_M = 10.0
VEHICLE_S = 4.0  # sightings on one lanelet within it are counted as one vehicle
MOST_SIGHTINGS = 15_000
HALF_LENGTH_M = 1.2  # how far the reflections of a face lie from the vehicle's middle
SIDES_SIGMA_M = 1.0
PLACE_SIGMA_M = 0.7
LEAST_VEHICLE_SIGMA_M = 0.5
ROUNDS = 12
LEAST_VEHICLES = 8
MOST_SIGMA_S = 0.25
DRIFT_PRIOR = 100e-6  # one standard deviation of what clocks in radars do


@dataclass(frozen=True, kw_only=True)
class Offset:
    """How far one clock is ahead of another.

    Parameters
    ----------
    offset_s, sigma_s : float
        At the time `at`, with one standard deviation.
    drift, drift_sigma : float
        Seconds a second.
    at : float
        UNIX seconds of the other clock.
    vehicles : int
        How many passages it rests on.
    """

    offset_s: float
    sigma_s: float
    drift: float
    drift_sigma: float
    at: float
    vehicles: int


def fine_offset(one: Sightings, other: Sightings, rough_s: float) -> tuple[Offset | None, str]:
    """Refine the offset of two clocks.

    Parameters
    ----------
    one, other : Sightings
        Of two sensors.
    rough_s : float
        By how much the clock of `other` is ahead, within a second.

    Returns
    -------
    Offset or None
        None where there is no trustworthy one.
    reason : str
        Why there is none, else empty.
    """
    one, at = _common(one, other, rough_s)
    values = np.array([rough_s, 0.0])
    sigma = np.full(2, np.inf)
    vehicles = 0
    for turn in range(ROUNDS):
        apart_m = APART_M[min(turn, len(APART_M) - 1)]
        pairs = _pairs(one, other, values, at, apart_m)
        if len(pairs.gap_m) < 50 or pairs.vehicles < LEAST_VEHICLES:
            return None, f"only {pairs.vehicles} vehicles are seen by both"
        change, sigma = _solve(pairs, values[1])
        values, vehicles = values + change, pairs.vehicles
        if turn >= len(APART_M) and abs(change[0]) < 2e-4:
            break
    if not sigma[0] <= MOST_SIGMA_S:
        return None, f"their common traffic tells the offset only to {sigma[0]:.2g} s"
    if abs(values[0] - rough_s) > 2.0:
        return None, "their common traffic fits no single offset"
    found = Offset(
        offset_s=float(values[0]), sigma_s=float(sigma[0]), drift=float(values[1]),
        drift_sigma=float(sigma[1]), at=at, vehicles=vehicles,
    )  # fmt: skip
    return found, ""


def _common(one: Sightings, other: Sightings, rough_s: float) -> tuple[Sightings, float]:
    """Return the sightings of `one` while `other` recorded, not too many, and their middle."""
    time = one.time + rough_s
    keep = np.flatnonzero((time >= other.time[0] - 1.0) & (time <= other.time[-1] + 1.0))
    if len(keep) > MOST_SIGHTINGS:
        keep = np.sort(np.random.default_rng(0).choice(keep, MOST_SIGHTINGS, replace=False))
    return one.take(keep), float(np.median(time[keep])) if len(keep) else float(other.time[0])


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Sightings of one vehicle by two sensors: (k,) arrays."""

    gap_m: Floats
    speed: Floats
    late_s: Floats
    sides: Floats
    place: Integers
    vehicle: Integers

    @property
    def vehicles(self) -> int:
        return int(self.vehicle.max()) + 1 if len(self.vehicle) else 0


def _pairs(one: Sightings, other: Sightings, values: Floats, at: float, apart_m: float) -> _Pairs:
    """Pair sightings that are of one vehicle if the clocks differ by `values`."""
    time = other.time - values[0] - values[1] * (other.time - at)
    begin = min(one.time.min(initial=np.inf), time.min(initial=np.inf))
    tree = cKDTree(_points(other, time - begin, apart_m))
    found = tree.query_ball_point(
        _points(one, one.time - begin, apart_m), 1.0, p=np.inf, return_sorted=False
    )
    count = np.array([len(each) for each in np.asarray(found, object)], np.int64)
    first = np.repeat(np.arange(len(one)), count)
    second = np.concatenate([*found, []]).astype(np.int64)
    speed = (one.speed[first] + other.speed[second]) / 2
    gap = other.s_m[second] - one.s_m[first] - speed * (time[second] - one.time[first])
    near = np.abs(gap) <= apart_m
    first, second = first[near], second[near]
    block = (one.time[first] // VEHICLE_S).astype(np.int64)
    vehicle = np.unique(
        np.column_stack([one.lanelet[first], block]), axis=0, return_inverse=True
    )[1]  # fmt: skip
    place = np.column_stack([one.lanelet[first], (one.s_m[first] // PLACE_M).astype(np.int64)])
    return _Pairs(
        gap_m=gap[near],
        speed=speed[near],
        late_s=other.time[second] - at,
        sides=(one.side[first] - other.side[second]) / 2,
        place=np.unique(place, axis=0, return_inverse=True)[1],
        vehicle=vehicle,
    )


def _points(sightings: Sightings, time: Floats, apart_m: float) -> Floats:
    """Return sightings as points: near ones lie within 1 in every direction."""
    room_m = apart_m + APART_S * 60.0
    return np.column_stack(
        [
            sightings.lanelet * 1e4,
            sightings.s_m / room_m,
            time / APART_S,
            sightings.speed / APART_MPS,
        ]
    )


def _solve(pairs: _Pairs, drift: float) -> tuple[Floats, Floats]:
    """Return the changes of offset and drift, and their standard deviations.

    The columns: offset, drift, one for opposite sides, one a place; each vehicle weighs the same.
    """
    places = int(pairs.place.max()) + 1
    share = 1.0 / np.bincount(pairs.vehicle)[pairs.vehicle]
    size = 3 + places
    prior = np.full(size, PLACE_SIGMA_M**-2)
    prior[:3] = 0.0, DRIFT_PRIOR**-2, SIDES_SIGMA_M**-2
    mean = np.zeros(size)
    mean[1:3] = -drift, 2 * HALF_LENGTH_M  # the drift itself is small, not its change
    columns = np.column_stack([-pairs.speed, -pairs.speed * pairs.late_s, pairs.sides])
    spread_m, robust = 2.0, np.ones(len(share))
    for _ in range(8):
        weight = robust * share / spread_m**2
        matrix, right = _normal(columns, pairs.place, pairs.gap_m, weight, size)
        matrix[np.diag_indices(size)] += prior
        solution = np.linalg.solve(matrix, right + prior * mean)
        rest = pairs.gap_m - columns @ solution[:3] - solution[3 + pairs.place]
        by_vehicle = np.bincount(pairs.vehicle, share * rest)
        spread_m = max(1.4826 * float(np.median(np.abs(by_vehicle))), LEAST_VEHICLE_SIGMA_M)
        robust = 1.0 / np.maximum(np.abs(rest) / (1.5 * spread_m), 1.0)
    sigma = np.sqrt(np.diag(np.linalg.inv(matrix))[:2])
    return np.asarray(solution[:2]), np.asarray(sigma)


def _normal(
    columns: Floats, place: Integers, gap_m: Floats, weight: Floats, size: int
) -> tuple[Floats, Floats]:
    """Return the normal equations of the columns and one more for each place."""
    matrix, right = np.zeros((size, size)), np.zeros(size)
    matrix[:3, :3] = columns.T @ (columns * weight[:, None])
    right[:3] = columns.T @ (gap_m * weight)
    places = size - 3
    for i in range(3):
        matrix[i, 3:] = np.bincount(place, columns[:, i] * weight, places)
    matrix[3:, :3] = matrix[:3, 3:].T
    matrix[3 + np.arange(places), 3 + np.arange(places)] = np.bincount(place, weight, places)
    right[3:] = np.bincount(place, gap_m * weight, places)
    return matrix, right
