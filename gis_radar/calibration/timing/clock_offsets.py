"""Estimate and validate the offset of two clocks by the traffic that both sensors see.

If the clock of a sensor is ahead by tau, its detections of a vehicle of speed v are displaced by
-v tau at one time stamp. That one sensor sees the front of a vehicle and the other its rear gives a
displacement d that does not depend on the speed. Over pairs of detections of one vehicle,

    s_other - s_one - v (t_other - t_one)  =  d(place, sides)  -  v (tau + drift (t - t_mid))

is solved by robust least squares, with a prior on d from the length of vehicles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, Integers, NoAnswerError, ranges
from gis_radar.calibration.timing.lane_detections import LaneDetections

# Sensitivity, on the sample's two sensors (sigma 10 ms): half or twice any constant of the rough
# search does not change the offset.
# Largest offset that is searched, from 0 and from the difference of the recordings' begins: over an
# hour, the usual mistake of a time zone.
_MAX_OFFSET_S = 4000.0
_BIN_S = 0.25  # width of the bins of time in which agreement is counted
# Size of the cells of place and speed in which agreement is counted: a vehicle passes about one in
# a bin.
_AGREEMENT_CELL_M = 4.0
_CELL_MPS = 3.0
# Width of a peak (1.25 s, a vehicle's time in a cell), of its background (40 s, within a cycle of
# signals), and least distance of another peak (5 s).
_PEAK_BINS = 5
_AROUND_BINS = 161
_APART_BINS = 20
# Least score of the best lag, in robust standard deviations of all lags, and least number of cells
# with a vehicle of both sensors at it.
_ROUGH_SCORE, ROUGH_PAIRS = 8.0, 20
_ROUGH_RATIO = 1.25  # least ratio of the best lag's score to that of the next peak
# Largest differences of time and speed of a pair: error of the rough offset, and turning vehicles.
_PAIR_S = 0.35
_PAIR_MPS = 1.5
# Fewer pairs or vehicles, or a larger sigma (five steps), are refused.
_LEAST_PAIRS, _LEAST_VEHICLES, _MAX_SIGMA_S = 50, 8, 0.25
# Largest gap along the lane in each iteration, the last one in all further ones: a car's length and
# the error of both poses.
_PAIR_M: tuple[float, ...] = (12.0, 9.0, 7.0)
_VEHICLE_S = 4.0  # detections of a lanelet within this time count as one vehicle: a short headway
# Most detections of a pair of sensors in the fit and in the validation; time grows in proportion.
_MOST_FITTED = 15_000
_MOST_CHECKED = 20_000
# Distance from a vehicle's middle to the reflections of its front or rear, and 1 sigma.
_FACE_M = 1.2
_FACE_SIGMA_M = 1.0
# 1 sigma of the bias of a place, by errors of poses, and least 1 sigma of a vehicle's gap, by the
# scatter of reflections.
PLACE_SIGMA_M = 0.7
_VEHICLE_SIGMA_M = 0.5
_DRIFT_SIGMA = 100e-6  # prior sigma of a drift: quartz clocks of radars keep within 100 ppm
# A drift above ODD_DRIFT and _ODD_DRIFT_SIGMAS standard errors is not that of a quartz clock, and
# is fitted with the wide prior _ODD_DRIFT_SIGMA. One ARS430 was 0.8 % slow; above _MOST_DRIFT the
# unit of time is wrong.
ODD_DRIFT = 1e-3
_ODD_DRIFT_SIGMAS = 5.0
_ODD_DRIFT_SIGMA = 0.01
_MOST_DRIFT = 0.012
_HUBER = 1.5  # residuals of more standard deviations have lower weight (Huber 1964)
# Most rounds of pairing in the fit, and reweightings in each.
_PAIRING_ROUNDS = 12
_WEIGHT_ROUNDS = 8
_CONVERGED_S = 2e-4  # a smaller change of the offset ends the fit
_MAX_CHANGE_S = 2.0  # a fit farther from the rough offset is of another lag
# In the validation two detections are of one vehicle if place, time and speed differ by less.
_NEAR_M = 8.0
_NEAR_S = 0.2
_NEAR_MPS = 1.0
# Differences from the offset at which far fewer detections must agree.
_DECOYS_S: tuple[float, ...] = (-3.0, -2.0, -1.5, 1.5, 2.0, 3.0)
_LEAST_SHARE = 0.45  # least share of detections that agree at the offset
_LEAST_RATIO = 1.3  # least ratio of that share to the one at any decoy
_LEAST_CHECKED = 50  # least detections of a sensor at places and times that the other one saw

# Pairs of detections of a cell: at most, which takes 2 s of CPU, and at once, in 24 MiB.
_MOST_PAIRS, _PAIRS_AT_ONCE = 1 << 25, 1 << 20


class NoCommonTrafficError(NoAnswerError):
    """Error of two sensors that see no common traffic."""


def measured_offset(
    one: LaneDetections, other: LaneDetections, *, max_offset_s: float = _MAX_OFFSET_S
) -> ClockOffset:
    """Measure how far the clock of `other` is ahead of that of `one`.

    Offsets about 0 come first, then those by which both began at about the same time.

    Parameters
    ----------
    one, other : LaneDetections
        Detections of two sensors.
    max_offset_s : float
        Largest difference from either.

    Raises
    ------
    NoAnswerError
        If there is no trustworthy offset.
    """
    try:
        return _offset_about(one, other, 0.0, max_offset_s)
    except NoCommonTrafficError:
        raise
    except NoAnswerError:
        begins_apart_s = float(other.time[0] - one.time[0])
        if abs(begins_apart_s) < 0.5 * max_offset_s:  # its neighbourhood was searched
            raise
    return _offset_about(one, other, begins_apart_s, max_offset_s)


def _offset_about(
    one: LaneDetections, other: LaneDetections, middle_s: float, max_offset_s: float
) -> ClockOffset:
    """Measure an offset that differs by at most `max_offset_s` from another one."""
    rough_s = rough_offset(one, other, middle_s, max_offset_s=max_offset_s)
    offset = fine_offset(one, other, rough_s)
    validate_offset(one, other, offset.offset_s)
    return offset


def rough_offset(
    one: LaneDetections,
    other: LaneDetections,
    middle_s: float = 0.0,
    *,
    max_offset_s: float = _MAX_OFFSET_S,
) -> float:
    """Estimate how many seconds the clock of `other` is ahead of that of `one`, to half a second.

    For each lag it counts the cells of place and speed in which both saw a vehicle, and compares
    the best lag with all others.

    Parameters
    ----------
    one, other : LaneDetections
        Detections of two sensors.
    middle_s, max_offset_s : float
        Middle of the offsets that are searched, and largest difference from it.

    Raises
    ------
    NoAnswerError
        If there is no trustworthy one.
    """
    common = np.intersect1d(_cell_numbers(one), _cell_numbers(other))
    if len(common) < ROUGH_PAIRS:
        raise NoCommonTrafficError("they see no common traffic")
    reach = round(max_offset_s / _BIN_S) + _AROUND_BINS  # that background is known at all of them
    lag = round(middle_s / _BIN_S) + np.arange(-reach, reach + 1)
    shift_s = np.asarray(lag * _BIN_S, np.float64)
    agreement = _agreement_by_lag(one, other, common, lag)
    return _best_lag(agreement, shift_s, np.abs(shift_s - middle_s) <= max_offset_s)


def _best_lag(agreement: Floats, shift_s: Floats, allowed: Booleans) -> float:
    """Return the shift (s) of the highest peak; refuse one that does not exceed all others."""
    width, least_apart = _PEAK_BINS, _APART_BINS
    summed = scipy.ndimage.uniform_filter1d(agreement, width, mode="constant") * width
    background = scipy.ndimage.uniform_filter1d(summed, _AROUND_BINS, mode="constant")
    score = (summed - background) / np.sqrt(background + 1.0)
    filled = background > 0.0  # also beyond what is searched: a few seconds tell no scale
    if summed[allowed].max(initial=0.0) < ROUGH_PAIRS or filled.sum() < least_apart:
        raise NoAnswerError("they see too little common traffic")
    scale = 1.4826 * np.median(np.abs(score[filled] - np.median(score[filled])))
    score = np.where(allowed, score / max(scale, 0.5), -np.inf)
    best = int(score.argmax())
    elsewhere = np.abs(np.arange(len(score)) - best) > least_apart
    second = float(score[elsewhere & allowed].max(initial=0.0))
    if score[best] < max(_ROUGH_SCORE, _ROUGH_RATIO * second):
        raise NoAnswerError("no lag stands out in their common traffic")
    peak = slice(max(best - width // 2, 0), best + width // 2 + 1)
    weight = np.maximum(agreement[peak] - background[best] / width, 1e-9)
    return float(np.average(shift_s[peak], weights=weight))


def _cell_numbers(seen: LaneDetections) -> Integers:
    """Return the number of each detection's cell of lanelet, place and speed."""
    place = (seen.s_m / _AGREEMENT_CELL_M).astype(np.int64)
    speed = (seen.speed / _CELL_MPS).astype(np.int64)
    return (seen.lanelet * 100_000 + place) * 100 + speed


def _agreement_by_lag(
    one: LaneDetections, other: LaneDetections, common: Integers, lag: Integers
) -> Floats:
    """Return for each lag (bins, ascending by 1) in how many cells both have detections.

    Of much traffic a part of that of `one` is taken, evenly, which tells as much.
    """
    start = min(one.time[0], other.time[0])
    bins = 1 + int((max(one.time.max(), other.time.max()) - start) / _BIN_S)
    keys = [_presence(each, common, start, bins) for each in (one, other)]
    cell, place = np.divmod(keys[0], bins)
    low, high = (np.clip(place + end, -1, bins - 1) for end in (lag[0] - 1, lag[-1]))
    first, after = (
        np.searchsorted(keys[1], cell * bins + end, side="right") for end in (low, high)
    )
    every = int((after - first).sum()) // _MOST_PAIRS + 1
    first, count, place = first[::every], (after - first)[::every], place[::every]
    agreement, ends = np.zeros(len(lag)), np.cumsum(count)
    parts = np.searchsorted(ends, np.arange(_PAIRS_AT_ONCE, ends[-1], _PAIRS_AT_ONCE))
    for rows in np.split(np.arange(len(count)), parts):
        paired = keys[1][ranges(first[rows], count[rows])] % bins
        found = paired - np.repeat(place[rows], count[rows]) - lag[0]
        agreement += np.bincount(found, minlength=len(lag))
    return agreement


def _presence(seen: LaneDetections, common: Integers, start: float, bins: int) -> Integers:
    """Return cell (row of `common`) x `bins` + bin of time of each detection, each once."""
    key = _cell_numbers(seen)
    cell = np.minimum(np.searchsorted(common, key), len(common) - 1)
    on = common[cell] == key
    return np.unique(cell[on] * bins + ((seen.time[on] - start) / _BIN_S).astype(np.int64))


@dataclass(frozen=True, kw_only=True)
class ClockOffset:
    """Offset and drift of one clock against another; positive when it is ahead.

    Parameters
    ----------
    offset_s, sigma_s : float
        Offset at the time `at`, and one standard deviation.
    drift, drift_sigma : float
        Drift and one standard deviation, seconds a second.
    at : float
        UNIX seconds of the other clock.
    vehicles : int
        Number of vehicles from which it is measured.
    """

    offset_s: float
    sigma_s: float
    drift: float
    drift_sigma: float
    at: float
    vehicles: int


def fine_offset(one: LaneDetections, other: LaneDetections, rough_s: float) -> ClockOffset:
    """Fit offset and drift of two clocks, given a rough offset.

    Parameters
    ----------
    one, other : LaneDetections
        Detections of two sensors.
    rough_s : float
        Offset of the clock of `other`, within a second.

    Raises
    ------
    NoAnswerError
        If there is no trustworthy offset.
    """
    one, at = _overlapping(one, other, rough_s, _MOST_FITTED)
    values, sigma, pairs = _fit(one, other, np.array([rough_s, 0.0]), at, _DRIFT_SIGMA)
    # one step with a wide prior shows clocks that run slow by up to a percent
    change, wide_sigma = _solve(pairs, values[1], _ODD_DRIFT_SIGMA)
    drift = abs(values[1] + change[1])
    if drift > max(ODD_DRIFT, _ODD_DRIFT_SIGMAS * wide_sigma[1]):
        start = values + change
        values, sigma, pairs = _fit(one, other, start, at, _ODD_DRIFT_SIGMA)
        if abs(values[1]) > _MOST_DRIFT:
            raise NoAnswerError("their clocks run apart by {:.1%}", abs(values[1]))
    vehicles = pairs.vehicles
    if not sigma[0] <= _MAX_SIGMA_S:
        raise NoAnswerError("their common traffic gives the offset only to {:.2g} s", sigma[0])
    if abs(values[0] - rough_s) > _MAX_CHANGE_S:
        raise NoAnswerError("their common traffic fits no single offset")
    return ClockOffset(
        offset_s=float(values[0]), sigma_s=float(sigma[0]), drift=float(values[1]),
        drift_sigma=float(sigma[1]), at=at, vehicles=vehicles,
    )  # fmt: skip


def _fit(
    one: LaneDetections, other: LaneDetections, values: Floats, at: float, drift_sigma: float
) -> tuple[Floats, Floats, _Pairs]:
    """Pair detections and solve in turn; return offset and drift, their sigmas, the last pairs."""
    gaps_m = _PAIR_M
    for turn in range(_PAIRING_ROUNDS):
        pairs = _pair_detections(one, other, values, at, gaps_m[min(turn, len(gaps_m) - 1)])
        if len(pairs.gap_m) < _LEAST_PAIRS or pairs.vehicles < _LEAST_VEHICLES:
            raise NoAnswerError("only {} vehicles are seen by both", pairs.vehicles)
        change, sigma = _solve(pairs, values[1], drift_sigma)
        values = values + change
        if turn >= len(gaps_m) and abs(change[0]) < _CONVERGED_S:
            break
    return values, sigma, pairs


def _overlapping(
    one: LaneDetections, other: LaneDetections, rough_s: float, most: int
) -> tuple[LaneDetections, float]:
    """Return up to `most` detections of `one` while `other` recorded, and their median time."""
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
        """Number of vehicles."""
        return int(self.vehicle.max(initial=-1)) + 1


def _pair_detections(
    one: LaneDetections, other: LaneDetections, values: Floats, at: float, apart_m: float
) -> _Pairs:
    """Pair detections that may be of one vehicle, given offset and drift in `values`."""
    time = other.time - values[0] - values[1] * (other.time - at)
    # detections of a lanelet follow each other by time, and lanelets in turn
    number = np.unique(np.append(one.lanelet, other.lanelet), return_inverse=True)[1]
    moment = np.append(one.time, time)
    moment = moment - moment.min() + number * (np.ptp(moment) + 1.0)
    key, keys = moment[: len(one)], moment[len(one) :]
    order = np.argsort(keys, kind="stable")
    low, high = (np.searchsorted(keys[order], key + side) for side in (-_PAIR_S, _PAIR_S))
    first = np.repeat(np.arange(len(one)), high - low)
    second = order[ranges(low, high - low)]
    alike = np.abs(one.speed[first] - other.speed[second]) <= _PAIR_MPS
    first, second = first[alike], second[alike]
    speed = (one.speed[first] + other.speed[second]) / 2
    gap_m = other.s_m[second] - one.s_m[first] - speed * (time[second] - one.time[first])
    close = np.abs(gap_m) <= apart_m
    first, second = first[close], second[close]
    block = (one.time[first] // _VEHICLE_S).astype(np.int64)
    return _Pairs(
        gap_m=gap_m[close],
        speed=speed[close],
        late_s=other.time[second] - at,
        sides=(one.side[first] - other.side[second]) / 2,
        place=np.unique(one.places[first], return_inverse=True)[1],
        vehicle=np.unique(one.lanelet[first] * 10**12 + block, return_inverse=True)[1],
    )


def _solve(pairs: _Pairs, drift: float, drift_sigma: float) -> tuple[Floats, Floats]:
    """Return the changes of offset and drift, and their standard deviations.

    The unknowns are the offset, the drift, the distance between front and rear reflections, and a
    bias of each place; vehicles have equal weights.
    """
    places = int(pairs.place.max()) + 1
    vehicle_weight = 1.0 / np.bincount(pairs.vehicle)[pairs.vehicle]
    size = 3 + places
    prior = np.full(size, PLACE_SIGMA_M**-2)
    prior[:3] = 0.0, drift_sigma**-2, _FACE_SIGMA_M**-2
    mean = np.zeros(size)
    mean[1:3] = -drift, 2 * _FACE_M  # the prior is on the drift, not on its change
    columns = np.column_stack([-pairs.speed, -pairs.speed * pairs.late_s, pairs.sides])
    scale_m, robust = 2.0, np.ones(len(vehicle_weight))
    for _ in range(_WEIGHT_ROUNDS):
        weight = robust * vehicle_weight / scale_m**2
        matrix, right_side = _normal_equations(columns, pairs.place, pairs.gap_m, weight, size)
        matrix[np.diag_indices(size)] += prior
        solution = np.linalg.solve(matrix, right_side + prior * mean)
        residual = pairs.gap_m - columns @ solution[:3] - solution[3 + pairs.place]
        by_vehicle = np.bincount(pairs.vehicle, vehicle_weight * residual)
        scale_m = max(1.4826 * float(np.median(np.abs(by_vehicle))), _VEHICLE_SIGMA_M)
        robust = 1.0 / np.maximum(np.abs(residual) / (_HUBER * scale_m), 1.0)
    sigma = np.sqrt(np.diag(np.linalg.inv(matrix))[:2])
    return np.asarray(solution[:2]), np.asarray(sigma)


def _normal_equations(
    columns: Floats, place: Integers, gap_m: Floats, weight: Floats, size: int
) -> tuple[Floats, Floats]:
    """Return the normal equations of the columns and of a bias for each place."""
    matrix, right_side = np.zeros((size, size)), np.zeros(size)
    matrix[:3, :3] = columns.T @ (columns * weight[:, None])
    right_side[:3] = columns.T @ (gap_m * weight)
    places = size - 3
    for i in range(3):
        matrix[i, 3:] = np.bincount(place, columns[:, i] * weight, places)
    matrix[3:, :3] = matrix[:3, 3:].T
    matrix[3 + np.arange(places), 3 + np.arange(places)] = np.bincount(place, weight, places)
    right_side[3:] = np.bincount(place, gap_m * weight, places)
    return matrix, right_side


def validate_offset(one: LaneDetections, other: LaneDetections, offset_s: float) -> None:
    """Refuse an offset at which too few detections agree, or as many as at other offsets.

    On a road that both see, most detections of one agree with those of the other at the right
    offset, and far fewer a second or more beside it. Traffic at signals repeats from cycle to
    cycle, but not its single vehicles.

    Parameters
    ----------
    one, other : LaneDetections
        Detections of two sensors.
    offset_s : float
        Offset of the clock of `other`.

    Raises
    ------
    NoAnswerError
        If the share that agrees is below `_LEAST_SHARE`, or `_LEAST_RATIO` of that at a decoy.
    """
    lags_s = offset_s + np.array([0.0, *_DECOYS_S])
    one_by_other, other_by_one = (
        np.array(list(_shares_seen_by_both(*pair)))
        for pair in ((one, other, lags_s), (other, one, -lags_s))
    )
    share, *decoys = (one_by_other + other_by_one) / 2
    if not share >= _LEAST_SHARE:
        raise NoAnswerError("at no lag do they see the same vehicles")
    if not share >= _LEAST_RATIO * np.nanmax([0.0, *decoys]):
        raise NoAnswerError("their common traffic looks alike at other lags too")


def _shares_seen_by_both(
    one: LaneDetections, other: LaneDetections, lags_s: Floats
) -> Iterator[float]:
    """Yield for each lag the share of detections of `one`, where `other` sees, that both see."""
    begin, common = other.time[0], one.take(np.isin(one.places, other.places))
    scales = {"near_m": _NEAR_M, "near_s": _NEAR_S, "near_mps": _NEAR_MPS}
    tree = scipy.spatial.cKDTree(other.scaled(other.time - begin, **scales))
    for lag_s in lags_s:
        time = common.time + lag_s
        within = np.flatnonzero((time > begin + _NEAR_S) & (time < other.time[-1] - _NEAR_S))
        rows = within[:: max(-(-len(within) // _MOST_CHECKED), 1)]
        points = common.take(rows).scaled(time[rows] - begin, **scales)
        distance, _ = tree.query(points, p=np.inf, distance_upper_bound=1.0)
        yield float(np.isfinite(distance).mean()) if len(within) >= _LEAST_CHECKED else np.nan
