"""Estimate and validate the offset of two clocks by the traffic that both sensors see.

Two sensors that see a vehicle at (nearly) one moment see it at (nearly) one place. If the clock of
one is ahead by tau, it sees a vehicle of speed v displaced by -v tau. One may also see the front of
a vehicle and the other its rear, a displacement that does not depend on the speed. So, over pairs
of detections of one vehicle,

    s_other - s_one - v (t_other - t_one)  =  d(place, sides)  -  v (tau + drift (t - t_mid))

is solved by robust least squares, with a prior on d: a vehicle is some metres long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from gis_radar.base import Booleans, Floats, Integers, NoAnswerError
from gis_radar.calibration.registration.lanes import UNLIMITED_MPS
from gis_radar.calibration.timing.lane_detections import LaneDetections

# Sensitivity, on the sample's two sensors (sigma 10 ms): half or twice any constant of the rough
# search does not change the offset.
# Largest offset looked for, beyond the difference of the recordings' begins: over an hour, the
# usual mistake of a time zone.
MAX_OFFSET_S = 4000.0
BIN_S = 0.25  # width of the bins of time in which agreement is counted
# Cells in which agreement is counted: in a bin a vehicle moves by about a cell.
CELL_M = 4.0
CELL_MPS = 3.0
# Width of a peak (1.25 s, a vehicle's time in a cell), of its surroundings (40 s, within a cycle
# of signals), and least distance of another peak (5 s).
PEAK_BINS = 5
AROUND_BINS = 161
APART_BINS = 20
# Least height of the best lag in robust standard deviations above the agreement at the tens of
# thousands of other lags; and least number of cells in which both saw a vehicle.
ROUGH_SCORE, ROUGH_PAIRS = 8.0, 20
ROUGH_RATIO = 1.25  # least height of the best lag over that of the next best
# Largest differences of time and speed of a pair: the rough offset's error, and a turn.
PAIR_S = 0.35
PAIR_MPS = 1.5
# Fewer pairs or vehicles, or a larger sigma (five steps), are refused.
LEAST_PAIRS, LEAST_VEHICLES, MAX_SIGMA_S = 50, 8, 0.25
# Largest gap along the lane, metres, iteration by iteration; the last one stays. A car's length
# and the error of both poses.
PAIR_M: tuple[float, ...] = (12.0, 9.0, 7.0)
VEHICLE_S = 4.0  # detections of one lanelet within it count as one vehicle: about the least headway
# Detections of a pair of sensors in the fit and in the validation; time grows in proportion.
MOST_FITTED = 15_000
MOST_CHECKED = 20_000
# From a vehicle's middle to the reflections of its front or rear, and one sigma, metres.
FACE_M = 1.2
FACE_SIGMA_M = 1.0
# Sigma of the bias of a place, and least one of a vehicle, metres: poses within lanes, and the
# spread of reflections.
PLACE_SIGMA_M = 0.7
VEHICLE_SIGMA_M = 0.5
DRIFT_SIGMA = 100e-6  # prior sigma of a drift: quartz clocks of radars keep within 100 ppm
# A drift over ODD_DRIFT, and over ODD_DRIFT_SIGMAS of its sigmas under the wide prior
# ODD_DRIFT_SIGMA, is not a quartz clock's and is fitted with that prior. An ARS430 was 0.8 % slow;
# over MOST_DRIFT a unit is mistaken.
ODD_DRIFT = 1e-3
ODD_DRIFT_SIGMAS = 5.0
ODD_DRIFT_SIGMA = 0.01
MOST_DRIFT = 0.012
HUBER = 1.5  # residuals over so many standard deviations weigh less (Huber 1964)
# Most rounds of pairing in the fit, and reweightings in each.
PAIRING_ROUNDS = 12
WEIGHT_ROUNDS = 8
CONVERGED_S = 2e-4  # a smaller change of the offset ends the fit: far under any sigma
MAX_CHANGE_S = 2.0  # a fit farther from the rough offset belongs to another lag
# Two detections are of one vehicle where place, time and speed differ by less.
NEAR_M = 8.0
NEAR_S = 0.2
NEAR_MPS = 1.0
# Lags off the answer at which far fewer vehicles must agree.
DECOYS_S: tuple[float, ...] = (-3.0, -2.0, -1.5, 1.5, 2.0, 3.0)
LEAST_SHARE = 0.45  # least share of vehicles that both saw at the answer
LEAST_RATIO = 1.3  # least share seen by both at the answer over that at any decoy
LEAST_CHECKED = 50  # least detections of a sensor where and while the other one recorded

VALUES_AT_ONCE = 1 << 22  # float32 values of a block of cells: 16 MiB


class NoCommonTrafficError(NoAnswerError):
    """Error of two sensors that see no common traffic: nothing can be measured between them."""


def measured_offset(
    one: LaneDetections, other: LaneDetections, *, max_offset_s: float = MAX_OFFSET_S
) -> ClockOffset:
    """Measure how far the clock of `other` is ahead of that of `one`.

    Parameters
    ----------
    one, other : LaneDetections
        Detections of two sensors.
    max_offset_s : float
        Largest offset looked for, beyond the difference of the begins of both.

    Raises
    ------
    NoAnswerError
        If there is no trustworthy one.
    """
    found = fine_offset(one, other, rough_offset(one, other, max_offset_s=max_offset_s))
    validate_offset(one, other, found.offset_s)
    return found


def rough_offset(
    one: LaneDetections, other: LaneDetections, *, max_offset_s: float = MAX_OFFSET_S
) -> float:
    """Estimate how many seconds the clock of `other` is ahead of that of `one`, to half a second.

    Counts in which cells of the lanes both saw a vehicle of the same speed, lag by lag, and
    compares the best lag with all others.

    Parameters
    ----------
    one, other : LaneDetections
        Of two sensors.
    max_offset_s : float
        As for :func:`measured_offset`.

    Raises
    ------
    NoAnswerError
        If there is no trustworthy one.
    """
    key_one, key_other = _cells(one), _cells(other)
    common = np.intersect1d(key_one, key_other)
    if len(common) < ROUGH_PAIRS:
        raise NoCommonTrafficError("they see no common traffic")
    apart_s = float(other.time[0] - one.time[0])
    bins_one, bins_other = (
        ((each.time - each.time[0]) / BIN_S).astype(np.int64) for each in (one, other)
    )
    agreement = _agreement(key_one, bins_one, key_other, bins_other, common)
    lag = np.arange(len(agreement)) - bins_one.max()
    shift_s = lag * BIN_S + apart_s
    allowed = np.abs(shift_s) <= abs(apart_s) + max_offset_s
    return _best_lag(agreement, shift_s, allowed)


def _best_lag(agreement: Floats, shift_s: Floats, allowed: Booleans) -> float:
    width, apart = PEAK_BINS, APART_BINS
    smooth = scipy.ndimage.uniform_filter1d(agreement, width, mode="constant") * width
    around = scipy.ndimage.uniform_filter1d(smooth, AROUND_BINS, mode="constant")
    score = (smooth - around) / np.sqrt(around + 1.0)
    filled = allowed & (around > 0.0)
    if smooth[allowed].max(initial=0.0) < ROUGH_PAIRS or filled.sum() < apart:
        raise NoAnswerError("they see too little common traffic")
    spread = 1.4826 * np.median(np.abs(score[filled] - np.median(score[filled])))
    score = np.where(allowed, score / max(spread, 0.5), -np.inf)
    best = int(score.argmax())
    elsewhere = np.abs(np.arange(len(score)) - best) > apart
    second = float(score[elsewhere & allowed].max(initial=0.0))
    if score[best] < max(ROUGH_SCORE, ROUGH_RATIO * second):
        raise NoAnswerError("no lag stands out in their common traffic")
    near = slice(max(best - width // 2, 0), best + width // 2 + 1)
    weight = np.maximum(agreement[near] - around[best] / width, 1e-9)
    return float(np.average(shift_s[near], weights=weight))


def _cells(seen: LaneDetections) -> Integers:
    """Return the cell of each detection: lanelet, place and speed."""
    place = (seen.s_m / CELL_M).astype(np.int64)
    speed = (seen.speed / CELL_MPS).astype(np.int64)
    return (seen.lanelet * 100_000 + place) * 100 + speed


def _agreement(
    key_one: Integers, bins_one: Integers, key_other: Integers, bins_other: Integers,
    common: Integers,
) -> Floats:  # fmt: skip
    """Count the cells in which both had a detection, by lag; lag 0 is at `bins_one.max()`."""
    room = int(bins_one.max() + bins_other.max() + 1)
    length = scipy.fft.next_fast_len(room, real=True)
    total = np.zeros(length // 2 + 1, np.complex128)
    at_once = max(VALUES_AT_ONCE // length, 1)
    for begin in range(0, len(common), at_once):
        cells = common[begin : begin + at_once]
        spectra = [
            scipy.fft.rfft(_filled(key, bins, cells, length), axis=1)
            for key, bins in ((key_one, bins_one), (key_other, bins_other))
        ]
        total += np.einsum("ij,ij->j", np.conj(spectra[0]), spectra[1])
    circular = scipy.fft.irfft(total, length)
    return np.maximum(np.roll(circular, int(bins_one.max()))[:room], 0.0)


def _filled(key: Integers, bins: Integers, cells: Integers, length: int) -> NDArray[np.float32]:
    row = np.searchsorted(cells, key)
    row[row == len(cells)] = 0
    mine = cells[row] == key
    table = np.zeros((len(cells), length), np.float32)
    table[row[mine], bins[mine]] = 1.0
    return table


@dataclass(frozen=True, kw_only=True)
class ClockOffset:
    """How far one clock is ahead of another.

    Parameters
    ----------
    offset_s, sigma_s : float
        Offset at the time `at`, with one standard deviation.
    drift, drift_sigma : float
        Drift with one standard deviation, seconds a second.
    at : float
        UNIX seconds of the other clock.
    vehicles : int
        Number of vehicles that it rests on.
    """

    offset_s: float
    sigma_s: float
    drift: float
    drift_sigma: float
    at: float
    vehicles: int


def fine_offset(one: LaneDetections, other: LaneDetections, rough_s: float) -> ClockOffset:
    """Refine the offset of two clocks.

    Parameters
    ----------
    one, other : LaneDetections
        Of two sensors.
    rough_s : float
        By how much the clock of `other` is ahead, within a second.

    Raises
    ------
    NoAnswerError
        If there is no trustworthy one.
    """
    one, at = _common(one, other, rough_s, MOST_FITTED)
    values, sigma, pairs = _fit(one, other, np.array([rough_s, 0.0]), at, DRIFT_SIGMA)
    # A clock that runs slow by a percent is far outside the prior of quartz clocks.
    change, wide_sigma = _solve(pairs, values[1], ODD_DRIFT_SIGMA)
    drift = abs(values[1] + change[1])
    if drift > max(ODD_DRIFT, ODD_DRIFT_SIGMAS * wide_sigma[1]):
        start = values + change
        values, sigma, pairs = _fit(one, other, start, at, ODD_DRIFT_SIGMA)
        if abs(values[1]) > MOST_DRIFT:
            raise NoAnswerError("their clocks run apart by {:.1%}", abs(values[1]))
    vehicles = pairs.vehicles
    if not sigma[0] <= MAX_SIGMA_S:
        raise NoAnswerError("their common traffic gives the offset only to {:.2g} s", sigma[0])
    if abs(values[0] - rough_s) > MAX_CHANGE_S:
        raise NoAnswerError("their common traffic fits no single offset")
    return ClockOffset(
        offset_s=float(values[0]), sigma_s=float(sigma[0]), drift=float(values[1]),
        drift_sigma=float(sigma[1]), at=at, vehicles=vehicles,
    )  # fmt: skip


def _fit(
    one: LaneDetections, other: LaneDetections, values: Floats, at: float, drift_sigma: float
) -> tuple[Floats, Floats, _Pairs]:
    """Pair and solve alternately; return offset and drift, their sigmas, and the last pairs."""
    gaps_m = PAIR_M
    for turn in range(PAIRING_ROUNDS):
        pairs = _pairs(one, other, values, at, gaps_m[min(turn, len(gaps_m) - 1)])
        if len(pairs.gap_m) < LEAST_PAIRS or pairs.vehicles < LEAST_VEHICLES:
            raise NoAnswerError("only {} vehicles are seen by both", pairs.vehicles)
        change, sigma = _solve(pairs, values[1], drift_sigma)
        values = values + change
        if turn >= len(gaps_m) and abs(change[0]) < CONVERGED_S:
            break
    return values, sigma, pairs


def _common(
    one: LaneDetections, other: LaneDetections, rough_s: float, most: int
) -> tuple[LaneDetections, float]:
    """Return up to `most` detections of `one` from while `other` recorded, and a median time."""
    time = one.time + rough_s
    keep = np.flatnonzero((time >= other.time[0] - 1.0) & (time <= other.time[-1] + 1.0))
    if len(keep) > most:
        keep = np.sort(np.random.default_rng(0).choice(keep, most, replace=False))
    return one.take(keep), float(np.median(time[keep])) if len(keep) else float(other.time[0])


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Pairs of detections of one vehicle by two sensors: (k,) arrays."""

    gap_m: Floats
    speed: Floats
    late_s: Floats
    sides: Floats
    place: Integers
    vehicle: Integers

    @property
    def vehicles(self) -> int:
        return int(self.vehicle.max(initial=-1)) + 1


def _pairs(
    one: LaneDetections, other: LaneDetections, values: Floats, at: float, apart_m: float
) -> _Pairs:
    """Pair detections that are of one vehicle if the clocks differ by `values`."""
    time = other.time - values[0] - values[1] * (other.time - at)
    begin = min(one.time.min(initial=np.inf), time.min(initial=np.inf))
    near = {
        "near_m": apart_m + PAIR_S * UNLIMITED_MPS,
        "near_s": PAIR_S,
        "near_mps": PAIR_MPS,
    }
    tree = scipy.spatial.cKDTree(other.scaled(time - begin, **near))
    found = tree.query_ball_point(
        one.scaled(one.time - begin, **near), 1.0, p=np.inf, return_sorted=False
    )
    count = np.array([len(each) for each in np.asarray(found, object)], np.int64)
    first = np.repeat(np.arange(len(one)), count)
    second = np.concatenate([*found, []]).astype(np.int64)
    speed = (one.speed[first] + other.speed[second]) / 2
    gap = other.s_m[second] - one.s_m[first] - speed * (time[second] - one.time[first])
    fits = np.abs(gap) <= apart_m
    first, second = first[fits], second[fits]
    block = (one.time[first] // VEHICLE_S).astype(np.int64)
    return _Pairs(
        gap_m=gap[fits],
        speed=speed[fits],
        late_s=other.time[second] - at,
        sides=(one.side[first] - other.side[second]) / 2,
        place=np.unique(one.places[first], return_inverse=True)[1],
        vehicle=np.unique(one.lanelet[first] * 10**12 + block, return_inverse=True)[1],
    )


def _solve(pairs: _Pairs, drift: float, drift_sigma: float) -> tuple[Floats, Floats]:
    """Return the changes of offset and drift, and their standard deviations.

    The unknowns are the offset, the drift, the distance of front and rear reflections, and a bias a
    place; each vehicle has the same weight.
    """
    places = int(pairs.place.max()) + 1
    share = 1.0 / np.bincount(pairs.vehicle)[pairs.vehicle]
    size = 3 + places
    prior = np.full(size, PLACE_SIGMA_M**-2)
    prior[:3] = 0.0, drift_sigma**-2, FACE_SIGMA_M**-2
    mean = np.zeros(size)
    mean[1:3] = -drift, 2 * FACE_M  # the drift itself is small, not its change
    columns = np.column_stack([-pairs.speed, -pairs.speed * pairs.late_s, pairs.sides])
    spread_m, robust = 2.0, np.ones(len(share))
    for _ in range(WEIGHT_ROUNDS):
        weight = robust * share / spread_m**2
        matrix, right = _normal(columns, pairs.place, pairs.gap_m, weight, size)
        matrix[np.diag_indices(size)] += prior
        solution = np.linalg.solve(matrix, right + prior * mean)
        rest = pairs.gap_m - columns @ solution[:3] - solution[3 + pairs.place]
        by_vehicle = np.bincount(pairs.vehicle, share * rest)
        spread_m = max(1.4826 * float(np.median(np.abs(by_vehicle))), VEHICLE_SIGMA_M)
        robust = 1.0 / np.maximum(np.abs(rest) / (HUBER * spread_m), 1.0)
    sigma = np.sqrt(np.diag(np.linalg.inv(matrix))[:2])
    return np.asarray(solution[:2]), np.asarray(sigma)


def _normal(
    columns: Floats, place: Integers, gap_m: Floats, weight: Floats, size: int
) -> tuple[Floats, Floats]:
    """Return the normal equations of the columns and of a bias for each place."""
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


def validate_offset(one: LaneDetections, other: LaneDetections, offset_s: float) -> None:
    """Refuse an offset that is not trustworthy.

    On a road that both see, each sees most of the vehicles that the other sees at the same time,
    and far fewer of those a moment before or after. Traffic that follows a signal is alike from
    cycle to cycle, but not vehicle by vehicle.

    Parameters
    ----------
    one, other : LaneDetections
        Of two sensors.
    offset_s : float
        By how much the clock of `other` is ahead.

    Raises
    ------
    NoAnswerError
        If too small a share is seen by both, or as much at other lags.
    """
    lags_s = offset_s + np.array([0.0, *DECOYS_S])
    there, back = (
        np.array([_share_seen(*pair, sign * lag_s) for lag_s in lags_s])
        for pair, sign in (((one, other), 1.0), ((other, one), -1.0))
    )
    share, *decoys = (there + back) / 2
    if not share >= LEAST_SHARE:
        raise NoAnswerError("at no lag do they see the same vehicles")
    if not share >= LEAST_RATIO * np.nanmax([0.0, *decoys]):
        raise NoAnswerError("their common traffic looks alike at other lags too")


def _share_seen(one: LaneDetections, other: LaneDetections, offset_s: float) -> float:
    """Return the share of detections of `one`, where and while `other` sees, that both see."""
    time = other.time - offset_s
    within = (one.time > time[0] + NEAR_S) & (one.time < time[-1] - NEAR_S)
    common = np.isin(one.places, other.places)
    mine = one.take(np.flatnonzero(within & common))
    if len(mine) < LEAST_CHECKED:
        return np.nan
    mine = mine.take(np.arange(0, len(mine), -(-len(mine) // MOST_CHECKED)))
    near = {"near_m": NEAR_M, "near_s": NEAR_S, "near_mps": NEAR_MPS}
    tree = scipy.spatial.cKDTree(other.scaled(time - mine.time[0], **near))
    points = mine.scaled(mine.time - mine.time[0], **near)
    apart, _ = tree.query(points, p=np.inf, distance_upper_bound=1.0)
    return float(np.isfinite(apart).mean())
