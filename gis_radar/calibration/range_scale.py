"""Measure the scale of range: change of range over the integral of range rate.

The range of an object changes by the integral of its range rate, whatever map and pose are. A scale
other than 1 shows ranges too long or in yards, range rates in km/h, and wrong or lost signs, with
which the fit of a pose to lanes may look certain, as all traces are scaled alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, Integers, compiled, heading_difference
from gis_radar.calibration.registration.traces import NONE, Moving, link_tracks, vehicles_of
from gis_radar.calibration.unit_mistakes import SIGMAS, RangeScale

# Time between the detections of a pair: a vehicle moves farther than its length.
_PAIR_S = 0.5
_LEAST_MOVE_M = 2.0  # least change of range of a pair: reflections wander by a metre on a vehicle
_LEAST_SHARE = 0.15  # least range rate of a pair, as a share of the fastest
_SIMILAR = 0.15  # largest relative difference of the range rates of a pair
# Largest distance of a pair across the line of sight: vehicle size, and speed of crossing vehicles.
_ACROSS_M, _ACROSS_MPS = 1.5, 6.0
_MOST_PAIRED = 20_000  # detections that are paired; of more every n-th frame
_RATIOS = np.exp(np.arange(math.log(0.02), math.log(50.0), 0.02))  # tried scales, with both signs
_LOG_TOLERANCE = 0.1  # largest difference of logarithms at which a pair counts for a ratio
_LEAST_PAIRS = 30  # least number of pairs at the best ratio
# Least ratio of the lower peak to the higher, of the two signs, where range rates have no sign.
_BOTH_SIGNS = 0.2

_LEAVES_MPS = 0.5  # slower detections are of leaves
_DRIVE_MPS = 4.0  # least mean range rate of a track: slower ones may be limbs of walkers
# Least detections of a track, and its least change of range.
_LEAST_POINTS, _LEAST_TRAVEL_M = 6, 5.0
# Least cosine between path and line of sight: of vehicles seen from the side, the visible faces
# change fast.
_LEAST_PATH_COSINE = 0.8
_MIXED_M = 1.5  # a track half of whose residuals are larger mixes two vehicles
# Scale of the Cauchy weights of residuals: least, and as a multiple of their median.
_LEAST_SCALE_M, _SPREAD = 0.3, 1.5
_TRACK_COUNT = 4.0  # independent detections as which a track counts: its residuals are correlated
_ROUNDS, _ITERATIONS = 2, 12  # rounds of linking and regression; iterations of the weights
_LEAST_VEHICLES = 5  # fewer clusters give no standard error
_HALF_LENGTH_M, _HALF_WIDTH_M = 2.25, 0.9  # half length and half width of a car
# Where a car reflects on average, as a share of the distance from its middle to its visible faces
# (0.3 to 1.2 in three simulations by different authors); prior information of slope and share.
_FACE_SHARE, _PRIOR = 0.7, np.diag([0.0, 0.4**-2])
# 1 sigma of an error that all tracks share: vehicles come into view front first, and near the
# sensor more of their rear is seen.
_SHARED_M = 0.35


@dataclass(frozen=True, kw_only=True)
class _Tracks:
    """Detections on tracks of vehicles, sorted by track."""

    track: Integers
    vehicle: Integers
    time: Floats
    range_m: Floats
    stated_m: Floats  # integral of the track's range rate
    face_m: Floats  # distance from the visible faces back to the middle of a car

    def where(self, keep: Booleans) -> _Tracks:
        """Return the detections where `keep` is true."""
        return _Tracks(**{name: values[keep] for name, values in vars(self).items()})

    def extent(self, values: Floats) -> Floats:
        """Return for each detection the largest less the least value of its track."""
        first = np.flatnonzero(np.append(True, np.diff(self.track) != 0))
        extents = np.maximum.reduceat(values, first) - np.minimum.reduceat(values, first)
        return np.repeat(extents, np.diff(np.append(first, len(values))))

    @property
    def travel_m(self) -> Floats:
        """Change of range of the track of each detection by its range rates, metres."""
        return self.extent(self.stated_m)


def measure_range_scale(moving: Moving) -> RangeScale | None:
    """Measure the scale of range; None in too little traffic.

    A search over pairs of detections half a second apart gives a first factor, with which
    detections are linked to tracks. A robust regression of range over the integral of range rate
    refines it; its standard error takes vehicles as clusters.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.
    """
    searched = _search_factor(moving)
    if searched is None:
        return None
    factor, absolute, one_sign = searched
    for _ in range(_ROUNDS):
        tracks = _link_scaled(moving, factor)
        if absolute:
            tracks = _concatenate(tracks, _link_scaled(moving, -factor))
        regression = _regress_range(tracks)
        if regression is None:
            return None
        slope, sigma, vehicles = regression
        factor, sigma = factor * slope, abs(factor) * sigma
    return RangeScale(
        factor=abs(factor) if absolute else factor,
        sigma=sigma,
        vehicles=vehicles,
        absolute=absolute,
        one_sign=one_sign,
    )


def _search_factor(moving: Moving) -> tuple[float, bool, bool] | None:
    """Return the factor that most pairs show, whether signs are lost, and whether one occurs."""
    rate = moving.range_rate
    if len(rate) == 0:
        return None
    fast = np.abs(rate) >= _LEAST_SHARE * np.percentile(np.abs(rate), 99.0)
    ratios = _pair_ratios(moving.time[fast], np.nan_to_num(moving.points[fast]), rate[fast])
    peaks = []
    for sign in (1.0, -1.0):
        logs = np.sort(np.log(sign * ratios[sign * ratios > 0.0]))
        low, high = (
            np.searchsorted(logs, np.log(_RATIOS) + side)
            for side in (-_LOG_TOLERANCE, _LOG_TOLERANCE)
        )
        density = (high - low) / _RATIOS  # pairs of unrelated vehicles have equal density
        best = int(density.argmax())
        peaks.append((float(density[best]), sign * float(_RATIOS[best])))
    (rarer, _), (peak, factor) = sorted(peaks)
    if peak * abs(factor) < _LEAST_PAIRS:
        return None
    one_sign = bool((rate > 0.0).all() or (rate < 0.0).all())
    return factor, one_sign and rarer > _BOTH_SIGNS * peak, one_sign


def _pair_ratios(time: Floats, points: Floats, rate: Floats) -> Floats:
    """Return change of range over that by range rates, of pairs that may be of one vehicle."""
    frame_times, begins = np.unique(time, return_index=True)
    first = np.arange(0, len(frame_times), max(len(time) // _MOST_PAIRED, 1))
    second = np.searchsorted(frame_times, frame_times[first] + _PAIR_S)
    range_m, azimuth = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    in_time = second < len(frame_times)
    in_time[in_time] = frame_times[second[in_time]] - frame_times[first[in_time]] <= 1.5 * _PAIR_S
    frames = np.column_stack([first, second])[in_time]
    return _ratios(frames, np.append(begins, len(time)), time, range_m, azimuth, rate)


@compiled
def _ratios(  # pragma: no cover - compiled
    frames: Integers, begins: Integers, time: Floats, range_m: Floats, azimuth: Floats, rate: Floats
) -> Floats:
    """Return the ratios of pairs of detections of each two frames that may be of one vehicle."""
    ratios = [np.nan for _ in range(0)]
    for first, second in frames:
        lapse_s = time[begins[second]] - time[begins[first]]
        for i in range(begins[first], begins[first + 1]):
            for j in range(begins[second], begins[second + 1]):
                stated, change_m = (rate[i] + rate[j]) / 2.0, range_m[j] - range_m[i]
                across_m = abs(heading_difference(azimuth[j], azimuth[i])) * range_m[i]
                similar = abs(rate[i] - rate[j]) <= _SIMILAR * abs(stated)
                near = across_m <= _ACROSS_M + _ACROSS_MPS * lapse_s
                if similar and near and abs(change_m) >= _LEAST_MOVE_M:
                    ratios.append(change_m / (stated * lapse_s))
    return np.array(ratios)


def _link_scaled(moving: Moving, factor: float) -> _Tracks:
    """Return the detections on tracks linked with range rates times `factor`."""
    fast = np.abs(factor * moving.range_rate) >= _LEAVES_MPS
    # of a radar without elevation x and y hold the slant range
    points, rate = np.nan_to_num(moving.points), factor * moving.range_rate
    moving = replace(moving, points=points, range_rate=rate).where(fast)
    linked = link_tracks(moving)
    vehicle = vehicles_of(moving, linked)
    rows = np.flatnonzero(linked != NONE)
    rows = rows[np.lexsort((moving.time[rows], linked[rows]))]
    track, time, points = linked[rows], moving.time[rows], moving.points[rows]
    cosine = _sight_cosine(track, points)
    tracks = _Tracks(
        track=track,
        vehicle=vehicle[track],
        time=time,
        range_m=np.linalg.norm(points, axis=1),
        stated_m=_integrate(track, time, moving.range_rate[rows]),
        face_m=_face_offset(cosine),
    ).where(cosine >= _LEAST_PATH_COSINE)
    if len(tracks.time) == 0:
        return tracks
    count = np.bincount(tracks.track)[tracks.track]
    least_m = np.maximum(_LEAST_TRAVEL_M, _DRIVE_MPS * tracks.extent(tracks.time))
    return tracks.where((count >= _LEAST_POINTS) & (tracks.travel_m >= least_m))


def _integrate(track: Integers, time: Floats, rate: Floats) -> Floats:
    """Return the integral (m) of range rate from each track's begin, by the means of its frames."""
    if len(track) == 0:
        return time
    new = np.append(True, (np.diff(track) != 0) | (np.diff(time) > 0.0))
    row = np.cumsum(new) - 1
    mean = np.bincount(row, rate) / np.bincount(row)
    step = np.append(0.0, np.diff(time[new]) * (mean[1:] + mean[:-1]) / 2.0)
    step[np.append(True, np.diff(track[new]) != 0)] = 0.0
    return np.asarray(np.cumsum(step)[row])


def _sight_cosine(track: Integers, points: Floats) -> Floats:
    """Return for each detection the cosine between its track's axis and its line of sight."""
    count, (x, y) = np.bincount(track), points[:, :2].T
    dx, dy = (v - (np.bincount(track, v) / count)[track] for v in (x, y))
    xx, yy, xy = (np.bincount(track, v) for v in (dx * dx, dy * dy, dx * dy))
    heading = 0.5 * np.arctan2(2.0 * xy, xx - yy)[track]  # direction of the longest axis
    return np.asarray(np.abs(np.cos(heading - np.arctan2(y, x))))


def _face_offset(cosine: Floats) -> Floats:
    """Return by how much the visible faces of a car are nearer than its middle, metres."""
    sine = np.sqrt(1.0 - cosine**2)
    # mean over end (half a length / cosine nearer) and side (half a width / sine), weighted by
    # their visible shares; cosine and sine drop out of the sum
    return np.asarray(
        _HALF_LENGTH_M * _HALF_WIDTH_M / (_HALF_WIDTH_M * cosine + _HALF_LENGTH_M * sine)
    )


def _concatenate(first: _Tracks, second: _Tracks) -> _Tracks:
    """Concatenate two sets of tracks; the second's numbers follow the first's."""
    shift = {name: int(getattr(first, name).max(initial=-1)) + 1 for name in ("track", "vehicle")}
    return _Tracks(
        **{name: np.concatenate([values, getattr(second, name) + shift.get(name, 0)])
           for name, values in vars(first).items()}
    )  # fmt: skip


def _regress_range(tracks: _Tracks) -> tuple[float, float, int] | None:
    """Regress range on the integral of range rate: slope, standard error, number of vehicles."""
    if len(np.unique(tracks.vehicle)) < _LEAST_VEHICLES:
        return None
    track = np.unique(tracks.track, return_inverse=True)[1]
    count = np.bincount(track)
    weight, scale_m = np.ones(len(track)), _LEAST_SCALE_M
    for _ in range(_ITERATIONS):
        total = np.maximum(np.bincount(track, weight), 1e-9)
        x, face, y = (
            values - (np.bincount(track, weight * values) / total)[track]
            for values in (tracks.stated_m, -tracks.face_m, tracks.range_m)
        )
        columns, precision = np.column_stack([x, face]), _TRACK_COUNT / (scale_m**2 * count[track])
        information = columns.T @ (columns * (weight * precision)[:, None]) + _PRIOR
        coefficients = np.linalg.solve(
            information, columns.T @ (weight * precision * y) + _PRIOR @ [0.0, _FACE_SHARE]
        )
        residual = y - columns @ coefficients
        mixed = (np.bincount(track, np.abs(residual) > _MIXED_M) > count / 2.0)[track]
        if mixed.all():
            return None
        scale_m = max(_LEAST_SCALE_M, _SPREAD * float(np.median(np.abs(residual[~mixed]))))
        weight = np.where(mixed, 0.0, 1.0 / (1.0 + (residual / scale_m) ** 2))
    precision = precision * weight
    vehicle = np.unique(tracks.vehicle, return_inverse=True)[1]
    used = int(np.count_nonzero(np.bincount(vehicle, precision)))
    if used < _LEAST_VEHICLES:
        return None
    # second derivative of the cost, where it is positive
    curvature = columns * (precision * np.maximum(2.0 * weight - 1.0, 0.0))[:, None]
    sigma, effective = _jackknife_error(columns, curvature, precision * residual, vehicle)
    if effective <= 1.0:
        return None
    shared_sigma = _SHARED_M * float(np.average(1.0 / tracks.travel_m, weights=precision * x**2))
    return float(coefficients[0]), math.hypot(sigma, shared_sigma), used


def _jackknife_error(
    columns: Floats, curvature: Floats, gradients: Floats, vehicle: Integers
) -> tuple[float, float]:
    """Return the jackknife's standard error of the slope, and the effective number of vehicles.

    The jackknife leaves out one vehicle at a time. Student's distribution with the effective number
    of vehicles widens the error, so that `SIGMAS` standard errors have the probability that they
    have of a normal distribution.
    """
    count = int(vehicle.max()) + 1
    information = np.zeros((count, 2, 2))
    np.add.at(information, vehicle, columns[:, :, None] * curvature[:, None, :])
    gradient = np.column_stack([np.bincount(vehicle, gradients * each) for each in columns.T])
    informative = information[:, 0, 0] > 0.0
    without_one = information.sum(axis=0) + _PRIOR - information[informative]
    if informative.sum() < _LEAST_VEHICLES or (np.linalg.det(without_one) <= 0.0).any():
        return np.inf, 0.0
    change = np.linalg.solve(without_one, gradient[informative][:, :, None])[:, 0, 0]
    number = len(change)
    weight = information[informative, 0, 0]
    effective = float(weight.sum() ** 2 / np.square(weight).sum())
    tail = float(scipy.special.ndtr(-SIGMAS))
    widening = -float(scipy.special.stdtrit(max(effective - 1.0, 1.0), tail)) / SIGMAS
    return widening * math.sqrt((number - 1) / number * float(np.square(change).sum())), effective
