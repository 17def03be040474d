"""Measure the scale of range: how much faster ranges change than the range rates state.

With ranges 5 % too long or in yards, range rates in km/h, or signs turned or lost, a found pose may
look certain, as all traces are scaled alike. But whatever the map and the pose, the range of an
object changes by the integral of its range rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.calibration.registration.traces import NONE, Moving, link_tracks, vehicles_of
from gis_radar.calibration.unit_mistakes import SIGMAS, RangeScale

# The search pairs detections so long apart: a vehicle moves farther than the length of a car.
LAPSE_S = 0.5
LEAST_MOVE_M = 2.0  # least change of range of a pair: reflections wander by a metre on a vehicle
LEAST_SHARE = 0.15  # least range rate of a pair, as a share of the fastest
ALIKE = 0.15  # largest relative difference of the range rates of a pair
ACROSS_M, ACROSS_MPS = 1.5, 6.0  # largest way of a pair across the sight: size, crossing speed
MOST_PAIRED = 20_000  # detections that are paired; of more every n-th frame
RATIOS = np.exp(np.arange(math.log(0.02), math.log(50.0), 0.02))  # tried scales, with both signs
NEAR = 0.1  # largest difference of logarithms at which a pair counts for a ratio
LEAST_PAIRS = 30  # least pairs at the best ratio
BOTH_SIGNS = 0.2  # peak of the rarer direction over the other's where range rates lost their sign

STILL_MPS = 0.5  # slower detections are leaves
DRIVE_MPS = 4.0  # mean range rate of a track: slower ones may be limbs of walkers without the trunk
LEAST_POINTS, LEAST_WAY_M = 6, 5.0  # least detections of a track, and its least change of range
LEAST_COSINE = 0.8  # between way and line of sight; seen from aside the faces change fast
STRAY_M = 1.5  # where half of a track has larger misfits, two vehicles are linked in it
WANDER_M, SPREAD = 0.3, 1.5  # scale of the misfits (Cauchy): least, and as a multiple of the median
LOOKS = 4.0  # number of independent detections as which a track counts: misfits last
ROUNDS, STEPS = 2, 12  # rounds of linking at the factor found; iterations of the weights
LEAST_VEHICLES = 5  # fewer clusters give no standard error
HALF_LENGTH_M, HALF_WIDTH_M = 2.25, 0.9  # half length and half width of a car
# Share of the way from a car's middle to its visible faces at which it reflects on average (0.3 to
# 1.2 in three simulations by different authors), and the prior information of slope and share.
FACES, KNOWN = 0.7, np.diag([0.0, 0.4**-2])
# 1 sigma of another error that the tracks of all vehicles share: they come into view front first,
# and near the sensor more of their rear is seen.
SHARED_M = 0.35


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
        return _Tracks(**{name: values[keep] for name, values in vars(self).items()})

    def extent(self, values: Floats) -> Floats:
        """Return the range (largest less least) of values in the track of each detection."""
        first = np.flatnonzero(np.append(True, np.diff(self.track) != 0))
        reach = np.maximum.reduceat(values, first) - np.minimum.reduceat(values, first)
        return np.repeat(reach, np.diff(np.append(first, len(values))))

    @property
    def way_m(self) -> Floats:
        """Change of range over the track of each detection, metres."""
        return self.extent(self.stated_m)


def measure_range_scale(moving: Moving) -> RangeScale | None:
    """Measure how much faster ranges change than the range rates state; None in too little traffic.

    A search over all factors, by pairs of detections half a second apart, gives the one at which
    detections are linked to tracks. A robust regression of range over the integral of range rate
    refines it; its error takes the vehicles as clusters.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.
    """
    found = _search(moving)
    if found is None:
        return None
    factor, absolute = found
    for _ in range(ROUNDS):
        tracks = _tracks(moving, factor)
        if absolute:
            tracks = _joined(tracks, _tracks(moving, -factor))
        regressed = _regressed(tracks)
        if regressed is None:
            return None
        slope, sigma, vehicles = regressed
        factor, sigma = factor * slope, abs(factor) * sigma
    return RangeScale(
        factor=abs(factor) if absolute else factor,
        sigma=sigma,
        vehicles=vehicles,
        absolute=absolute,
    )


def _search(moving: Moving) -> tuple[float, bool] | None:
    """Return the factor that most pairs of detections show, and whether signs are lost."""
    rate = moving.range_rate
    if len(rate) == 0:
        return None
    fast = np.abs(rate) >= LEAST_SHARE * np.percentile(np.abs(rate), 99.0)
    ratios = _pair_ratios(moving.time[fast], np.nan_to_num(moving.points[fast]), rate[fast])
    peaks = []
    for sign in (1.0, -1.0):
        logs = np.sort(np.log(sign * ratios[sign * ratios > 0.0]))
        low, high = (np.searchsorted(logs, np.log(RATIOS) + side) for side in (-NEAR, NEAR))
        density = (high - low) / RATIOS  # even for pairs of unrelated vehicles
        best = int(density.argmax())
        peaks.append((float(density[best]), sign * float(RATIOS[best])))
    (rarer, _), (peak, factor) = sorted(peaks)
    if peak * abs(factor) < LEAST_PAIRS:
        return None
    one_sign = bool((rate > 0.0).all() or (rate < 0.0).all())
    return factor, one_sign and rarer > BOTH_SIGNS * peak


def _pair_ratios(time: Floats, points: Floats, rate: Floats) -> Floats:
    """Return change of range over stated change, for pairs that may be of one vehicle."""
    reach, azimuth = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    frames, begins = np.unique(time, return_index=True)
    ends = np.append(begins[1:], len(time))
    later = np.searchsorted(frames, frames + LAPSE_S)
    found = [np.empty(0)]
    for one in range(0, len(frames), max(len(time) // MOST_PAIRED, 1)):
        other = int(later[one])
        if other == len(frames) or frames[other] - frames[one] > 1.5 * LAPSE_S:
            continue
        a, b = (slice(begins[i], ends[i]) for i in (one, other))
        lapse_s, stated = frames[other] - frames[one], (rate[a, None] + rate[b]) / 2.0
        moved = reach[b] - reach[a, None]
        turn = np.abs((azimuth[b] - azimuth[a, None] + np.pi) % (2.0 * np.pi) - np.pi)
        alike = np.abs(rate[a, None] - rate[b]) <= ALIKE * np.abs(stated)
        alike &= turn * reach[a, None] <= ACROSS_M + ACROSS_MPS * lapse_s
        alike &= np.abs(moved) >= LEAST_MOVE_M
        found.append(moved[alike] / (stated[alike] * lapse_s))
    return np.concatenate(found)


def _tracks(moving: Moving, factor: float) -> _Tracks:
    """Link detections whose ranges change by a factor times their range rates."""
    fast = np.abs(factor * moving.range_rate) >= STILL_MPS
    # of a radar without elevation x and y hold the slant range
    points, rate = np.nan_to_num(moving.points), factor * moving.range_rate
    moving = replace(moving, points=points, range_rate=rate).where(fast)
    track = link_tracks(moving)
    vehicle = vehicles_of(moving, track)
    on = np.flatnonzero(track != NONE)
    on = on[np.lexsort((moving.time[on], track[on]))]
    number, time, points = track[on], moving.time[on], moving.points[on]
    cosine = _cosine(number, points)
    tracks = _Tracks(
        track=number,
        vehicle=vehicle[number],
        time=time,
        range_m=np.linalg.norm(points, axis=1),
        stated_m=_integral(number, time, moving.range_rate[on]),
        face_m=_nearer(cosine),
    ).where(cosine >= LEAST_COSINE)
    if len(tracks.time) == 0:
        return tracks
    count = np.bincount(tracks.track)[tracks.track]
    least_m = np.maximum(LEAST_WAY_M, DRIVE_MPS * tracks.extent(tracks.time))
    return tracks.where((count >= LEAST_POINTS) & (tracks.way_m >= least_m))


def _integral(track: Integers, time: Floats, rate: Floats) -> Floats:
    """Return the integral (m) of each track's range rate, by the means of frames."""
    if len(track) == 0:
        return time
    new = np.append(True, (np.diff(track) != 0) | (np.diff(time) > 0.0))
    row = np.cumsum(new) - 1
    mean = np.bincount(row, rate) / np.bincount(row)
    step = np.append(0.0, np.diff(time[new]) * (mean[1:] + mean[:-1]) / 2.0)
    step[np.append(True, np.diff(track[new]) != 0)] = 0.0
    return np.asarray(np.cumsum(step)[row])


def _cosine(track: Integers, points: Floats) -> Floats:
    """Return the cosine between the straight line of each track and the lines of sight."""
    count, (x, y) = np.bincount(track), points[:, :2].T
    dx, dy = (v - (np.bincount(track, v) / count)[track] for v in (x, y))
    xx, yy, xy = (np.bincount(track, v) for v in (dx * dx, dy * dy, dx * dy))
    way = 0.5 * np.arctan2(2.0 * xy, xx - yy)[track]  # direction of the longest axis
    return np.asarray(np.abs(np.cos(way - np.arctan2(y, x))))


def _nearer(cosine: Floats) -> Floats:
    """Return how much nearer the visible faces of a car are than its middle, metres."""
    sine = np.sqrt(1.0 - cosine**2)
    # mean over end (half a length / cosine nearer) and side (half a width / sine), weighted by
    # their visible shares; cosine and sine drop out of the sum
    return np.asarray(HALF_LENGTH_M * HALF_WIDTH_M / (HALF_WIDTH_M * cosine + HALF_LENGTH_M * sine))


def _joined(one: _Tracks, other: _Tracks) -> _Tracks:
    """Concatenate two sets of tracks; the second's numbers follow the first's."""
    shift = {n: int(getattr(one, n).max(initial=-1)) + 1 for n in ("track", "vehicle")}
    return _Tracks(
        **{n: np.concatenate([v, getattr(other, n) + shift.get(n, 0)])
           for n, v in vars(one).items()}
    )  # fmt: skip


def _regressed(tracks: _Tracks) -> tuple[float, float, int] | None:
    """Return slope of range over integral, its standard error, and the number of vehicles."""
    if len(np.unique(tracks.vehicle)) < LEAST_VEHICLES:
        return None
    track = np.unique(tracks.track, return_inverse=True)[1]
    count = np.bincount(track)
    weight, scale_m = np.ones(len(track)), WANDER_M
    for _ in range(STEPS):
        total = np.maximum(np.bincount(track, weight), 1e-9)
        x, face, y = (
            values - (np.bincount(track, weight * values) / total)[track]
            for values in (tracks.stated_m, -tracks.face_m, tracks.range_m)
        )
        columns, share = np.column_stack([x, face]), LOOKS / (scale_m**2 * count[track])
        squares = columns.T @ (columns * (weight * share)[:, None]) + KNOWN
        found = np.linalg.solve(squares, columns.T @ (weight * share * y) + KNOWN @ [0.0, FACES])
        misfit = y - columns @ found
        stray = (np.bincount(track, np.abs(misfit) > STRAY_M) > count / 2.0)[track]
        if stray.all():
            return None
        scale_m = max(WANDER_M, SPREAD * float(np.median(np.abs(misfit[~stray]))))
        weight = np.where(stray, 0.0, 1.0 / (1.0 + (misfit / scale_m) ** 2))
    share = share * weight
    vehicle = np.unique(tracks.vehicle, return_inverse=True)[1]
    used = int(np.count_nonzero(np.bincount(vehicle, share)))
    if used < LEAST_VEHICLES:
        return None
    # second derivative of the cost, where it is positive
    bends = columns * (share * np.maximum(2.0 * weight - 1.0, 0.0))[:, None]
    drawn, carry = _drawn(columns, bends, share * misfit, vehicle)
    if carry <= 1.0:
        return None
    shared = SHARED_M * float(np.average(1.0 / tracks.way_m, weights=share * x**2))
    return float(found[0]), math.hypot(drawn, shared), used


def _drawn(columns: Floats, bends: Floats, pulls: Floats, vehicle: Integers) -> tuple[float, float]:
    """Return the jackknife's standard error of the slope, and how many vehicles determine it.

    The jackknife leaves out one vehicle at a time. Where few vehicles determine the slope,
    Student's distribution widens the error, so that three standard errors mean what they do for
    a normal distribution.
    """
    count = int(vehicle.max()) + 1
    bent = np.zeros((count, 2, 2))
    np.add.at(bent, vehicle, columns[:, :, None] * bends[:, None, :])
    pull = np.column_stack([np.bincount(vehicle, pulls * each) for each in columns.T])
    kept = bent[:, 0, 0] > 0.0
    left = bent.sum(axis=0) + KNOWN - bent[kept]
    if kept.sum() < LEAST_VEHICLES or (np.linalg.det(left) <= 0.0).any():
        return np.inf, 0.0
    moved = np.linalg.solve(left, pull[kept][:, :, None])[:, 0, 0]
    number = len(moved)
    carried = bent[kept, 0, 0]
    carry = float(carried.sum() ** 2 / np.square(carried).sum())
    tail = float(scipy.special.ndtr(-SIGMAS))
    wider = -float(scipy.special.stdtrit(max(carry - 1.0, 1.0), tail)) / SIGMAS
    return wider * math.sqrt((number - 1) / number * float(np.square(moved).sum())), carry
