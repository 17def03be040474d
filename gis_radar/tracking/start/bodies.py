"""Bodies: associate the detections of moving vehicles, and distinguish persons from vehicles.

The filter follows vehicles forward and backward in time; tracks of both directions that share
detections are joined. Several tracks are often the ends of one long vehicle, or one vehicle as two
sensors see it: parts of one body keep their places in the frame that moves with it, as no other
vehicle does.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, nearest
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.detections import MOVING_MPS, MapDetections
from gis_radar.tracking.motion import GAP_S, GAP_SPREAD, Motion, fit_motion

_LEAST_SPREAD_M = 0.1  # two detections of one scatterer
_UNKNOWN_SIZE = -1.0  # log odds of a person of unknown size: on lanes persons are fewer
# A track is split, into _MOST_SPLIT parts at most, while a smaller share of its detections keeps
# its place in the moving frame; parts of fewer detections are dropped.
_LEAST_PURE, _MOST_SPLIT, LEAST_ROWS = 0.95, 3, 5
_SEEN_S = 0.35  # time before and after a detection in which the state of its vehicle is known
_LEFT_M, _BEARING_RAD = 1.7, 0.006  # tolerance sideways: half a truck, error of a bearing
# Tolerance of a range rate: noise, share of the speed for wheels, and factor on the speed at which
# the ends of a turning body swing.
_RATE_TOLERANCE_MPS, _WHEEL_SHARE, _SWING = 0.8, 0.08, 0.6
_LEAST_FIT = 0.7  # share of detections whose places and range rates fit
_SCATTER_M = 2.5  # largest median residual of places on a body: scatterers change along it
_PLACE_M = 0.4  # sigma of the mean place of a body's detections over half a second
_REACH_M = 16.5  # from the middle of its detections to any part of a truck with trailer
_CAR_M = 4.7  # length of a car
_LONG_SHARE = 0.12  # share of vehicles over 7 m, lorries and buses, in traffic
_LEAST_ODDS = 0.5  # log odds above which two parts are joined
_DRIVEN_MPS = 8.0  # vehicles above this speed certainly drive
_CYCLIST_MPS = 7.5  # largest speed of cyclists
# Mean and sigma of the cross section, dB over that of vehicles, and of the logarithm of the spread
# of detections, metres: most people return 4 to 10 dB less; a cyclist of 1.8 x 0.6 m spreads by
# 0.55 m, a car by 1.4 m, bearing and smoothing add 0.5 m. The sigma of vehicles' cross sections is
# that of the recordings where enough of them drive fast.
_PERSON, _VEHICLE = (-7.0, 3.0, -0.3, 0.45), (0.0, 4.0, 0.4, 0.5)
_LEAST_DRIVEN, _LEAST_DB = 5, 3.0  # fast vehicles to estimate the sigma, and its least value, dB
_FAINT_DB = 9.0  # detections weaker by this are faint: persons, also next to a passing vehicle
_FAINT_SIGMAS = 3.0  # a track weaker by so many may be a person at any speed
# Share of faint detections of a vehicle, and one less that of a person: a tenth of a car's, a fifth
# of a lorry's or a motorcycle's; nine tenths of a walker's, two thirds of a cyclist's.
_FAINT_SHARE = 0.2
_FAINT_ODDS = 10.0  # log odds above which an end of a track is of a person: eight in a row
_STEADY = 0.5  # share of the 90 % quantile of its speed that a person exceeds half of the time
# Mean height of the detections of a car, and of a lorry or bus, with its standard deviation between
# vehicles, metres: cars scatter from below 1.5 m, lorries and buses from all of their 3 to 4 m.
_CAR_HEIGHT_M, _LORRY_HEIGHT_M = (0.75, 0.3), (1.6, 0.5)
# Sigma of the elevation, radians: common to all detections of a vehicle, and of each.
_BIAS_RAD, _ELEVATION_RAD = 0.006, 0.0175
_LEAST_HEIGHTS = 10  # least number of heights; fewer are no evidence
_MOST_ODDS = 4.0  # largest log odds by heights


def rows_by_number(number: Integers) -> list[Integers]:
    """Return the rows of each number, by ascending number; rows of `NONE` are left out."""
    rows = np.flatnonzero(number != NONE)
    rows = rows[np.argsort(number[rows], kind="stable")]
    return np.split(rows, np.flatnonzero(np.diff(number[rows])) + 1) if len(rows) else []


def join_directions(number: Integers, against: Integers, time: Floats) -> Integers:
    """Join the tracks of both directions of time; return the number of each detection's track.

    A detection that is in a backward track only gets the number of the nearest one in time in that
    track. Two forward tracks are one where a backward track contains much of both.

    Parameters
    ----------
    number, against : (n,) int64 arrays
        Number of the track of each detection, forward and backward in time; `NONE` without.
    time : (n,) array
        Times of the detections, seconds.
    """
    rows = rows_by_number(number)
    if not rows:
        return against.copy()
    spans = {int(number[r[0]]): (float(time[r].min()), float(time[r].max())) for r in rows}
    sizes = {int(number[r[0]]): len(r) for r in rows}
    groups = _TrackGroups(spans)
    joined, next_number = number.copy(), int(number.max()) + 1
    for back in rows_by_number(against):
        known = np.flatnonzero(number[back] != NONE)
        if len(known) == 0:
            joined[back] = next_number
            next_number += 1
            continue
        free = np.flatnonzero(number[back] == NONE)
        joined[back[free]] = number[back[known[nearest(time[back[known]], time[back[free]])]]]
        values, counts = np.unique(number[back[known]], return_counts=True)
        matched = [
            value for value, count in zip(values.tolist(), counts.tolist(), strict=True)
            if count >= max(4, 0.3 * sizes[value])
        ]  # fmt: skip
        matched.sort(key=lambda value: spans[value])
        for one, other in pairwise(matched):
            groups.join(one, other)
    mapped = np.arange(next_number)
    for value in spans:
        mapped[value] = groups.of(value)
    return np.where(joined == NONE, NONE, mapped[joined])


class _TrackGroups:
    """Groups of tracks of one vehicle, which hardly overlap in time (disjoint sets)."""

    MOST_BOTH_S = 0.7  # longest overlap of two tracks of one vehicle, where one of them ends

    def __init__(self, spans: dict[int, tuple[float, float]]) -> None:
        self._head = {value: value for value in spans}
        self._spans = {value: [span] for value, span in spans.items()}

    def of(self, value: int) -> int:
        """Return the number of the track that represents the group of a track."""
        while self._head[value] != value:
            self._head[value] = self._head[self._head[value]]
            value = self._head[value]
        return value

    def join(self, one: int, other: int) -> None:
        """Join the groups of two tracks, unless they overlap in time."""
        one, other = self.of(one), self.of(other)
        if one == other:
            return
        both = max(
            min(a[1], b[1]) - max(a[0], b[0]) for a in self._spans[one] for b in self._spans[other]
        )
        if both < self.MOST_BOTH_S:
            self._spans[one] += self._spans.pop(other)
            self._head[other] = one


def absorb(
    detections: MapDetections,
    parts: list[Integers],
    states: Floats,
) -> list[Motion]:
    """Join parts of one body, beginning with the largest parts; return each vehicle's motion.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    parts : list of int64 arrays
        Rows of each track.
    states : (n, 6) array
        State of the filter at each detection.
    """
    motions = [each for rows in parts for each in purified(detections, rows, states)]
    if not motions:
        return []
    boxes = np.stack([_box(detections, each.rows) for each in motions])
    sizes = np.array([len(each.rows) for each in motions])
    is_apart = np.ones(len(motions), np.bool_)
    for base in np.argsort(-sizes, kind="stable").tolist():
        order, grew = np.arange(len(motions)), is_apart[base]
        while grew:
            near = (boxes[:, 0] <= boxes[base, 1]) & (boxes[:, 1] >= boxes[base, 0])
            may_join = is_apart & near.all(axis=1) & (sizes <= sizes[base])
            may_join[base] = False
            found = (
                other for other in order[may_join[order]].tolist()
                if log_odds(detections, motions[base], motions[other]) > _LEAST_ODDS
            )  # fmt: skip
            other = next(found, NONE)
            grew = other != NONE
            if grew:
                rows = np.concatenate([motions[base].rows, motions[other].rows])
                motions[base] = fit_motion(detections, rows, states)
                boxes[base], sizes[base] = _box(detections, rows), len(motions[base].rows)
                is_apart[other] = False
                order = np.roll(np.arange(len(motions)), -other - 1)  # all anew, the next one first
    return [motions[k] for k in np.flatnonzero(is_apart).tolist()]


def _box(detections: MapDetections, rows: Integers) -> Floats:
    """Return bounds of time, easting and northing of detections, widened by a long body."""
    table = np.column_stack([detections.time[rows], detections.points[rows]])
    reach = np.array([0.1, 20.0, 20.0])
    return np.stack([table.min(axis=0) - reach, table.max(axis=0) + reach])


def log_odds(detections: MapDetections, body: Motion, other: Motion) -> float:
    """Return the log odds that two parts are of one body.

    In the frame that moves with the first part, the second one keeps its place if it is of the same
    body. Another vehicle drifts, and keeps its distance: time gaps between drivers are log-normal,
    with a median of 1.8 s (Treiber and Kesting, *Traffic Flow Dynamics*, 2013, ch. 4).
    """
    rows = other.rows[np.abs(detections.range_rate[other.rows]) > MOVING_MPS]
    own = detections.time[body.rows]
    rows = rows[(detections.time[rows] > own[0] - 0.2) & (detections.time[rows] < own[-1] + 0.2)]
    if len(rows) < 3:
        return -np.inf
    # the moving frame is known only while the first part is detected, too
    near = nearest(own, detections.time[rows])
    rows = rows[np.abs(own[near] - detections.time[rows]) < _SEEN_S]
    if len(rows) < 3 or np.ptp(detections.time[rows]) < 0.1:
        return -np.inf
    along, left, rate, speed = body.frame(detections, rows)
    beside = _LEFT_M + _BEARING_RAD * detections.range_m[rows]
    fits = (np.abs(left) < beside) & (np.abs(rate) < _rate_tolerance(body, along, speed))
    if fits.mean() < _LEAST_FIT or fits.sum() < 3:
        return -np.inf
    one, two = (
        tall_odds(detections.height_m[each.rows], detections.range_m[each.rows])
        for each in (body, other)
    )
    long = one_tall_odds((one, two))
    return _odds_by_places(detections.time[rows][fits], along[fits], speed[fits], body, long)


def _rate_tolerance(body: Motion, along: Floats, speed: Floats) -> Floats:
    """Return the tolerance of range rates at places on a body, m/s: in a bend its ends swing."""
    swing = _SWING * min(body.path.most_bend, 0.1) * speed * np.abs(along)
    return np.asarray(_RATE_TOLERANCE_MPS + _WHEEL_SHARE * speed + swing)


def purified(detections: MapDetections, rows: Integers, states: Floats) -> list[Motion]:
    """Return the motions of a track, split where its detections cannot be of one body."""
    motions: list[Motion] = []
    while len(rows) >= LEAST_ROWS and len(motions) < _MOST_SPLIT:
        body = fit_motion(detections, rows, states)
        along, left, rate, speed = body.frame(detections, body.rows)
        fits = np.abs(along) < 0.5 * _REACH_M + 1.0
        fits &= np.abs(left) < 2.0 * _LEFT_M
        fits &= np.abs(rate) < 2.0 * _rate_tolerance(body, along, speed) + speed
        if fits.mean() >= _LEAST_PURE or fits.sum() < LEAST_ROWS:
            return [*motions, body]
        pure = fit_motion(detections, body.rows[fits], states)
        motions.append(pure)
        rows = body.rows[~fits]
    return motions


def _odds_by_places(time: Floats, along: Floats, speed: Floats, body: Motion, long: float) -> float:
    """Return the log odds of one body by the places of a part in the frame of another one.

    They are those of no drift over those of two drivers, and of a long vehicle over a follower at
    that distance. The second, and `long`, the log odds by heights, count only for places beyond the
    body.
    """
    span = float(np.ptp(time))
    distance = abs(float(np.median(along)))
    if distance > _REACH_M:
        return -np.inf
    no_drift = 0.0
    if span > 0.3:
        centred = time - time.mean()
        drift = float(centred @ (along - along.mean()) / (centred @ centred))
        residual = np.abs(along - np.median(along) - drift * centred)
        if np.median(residual) > _SCATTER_M:
            return -np.inf
        # sigma of the slope of places that are independent every half second
        sigma = np.hypot(_PLACE_M * np.sqrt(12.0) / (span * np.sqrt(max(2 * span, 1))), 0.1)
        wide = np.hypot(1.0, sigma)  # 1 m/s: sigma of the difference of drivers' speeds
        no_drift = 0.5 * (drift / wide) ** 2 - 0.5 * (drift / sigma) ** 2 + np.log(wide / sigma)
    inside = np.abs(along) < 0.5 * max(body.length_m, 3.0) + 1.0
    if inside.mean() > 0.6:
        return 5.0 + min(no_drift, 0.0)
    fast_mps = max(float(np.quantile(speed, 0.8)), 2.0)
    gap_s = max(distance - _CAR_M, 0.05) / fast_mps
    z = np.log(gap_s / GAP_S) / GAP_SPREAD
    log_follows = -0.5 * z * z - np.log(gap_s * GAP_SPREAD * 2.5066 * fast_mps)
    return float(no_drift + long + np.log(_LONG_SHARE / 12.0) - log_follows)


def merge_states(number: Integers, states: tuple[Floats, Floats], joined: Integers) -> Floats:
    """Return the forward states; backward ones for detections in backward tracks only."""
    return np.where(((number == NONE) & (joined != NONE))[:, None], states[1], states[0])


def is_person(detections: MapDetections, motions: Sequence[Motion]) -> list[bool]:
    """Return for each motion whether it is of a walker or cyclist: weak, small, slow and steady.

    Cross sections are compared with those of fast vehicles in the same recordings, since each radar
    has its own scale. Where no vehicle drives fast they are compared with still detections, which
    are about as strong. Persons keep their pace; a track that mostly stands is not judged, as it
    cannot be distinguished from its surroundings by its cross section.
    """
    rcs = np.array([usual_rcs(detections.rcs[each.rows]) for each in motions])
    fast = np.array([_fast(each) for each in motions])
    spread = np.array([np.hypot(np.std(each.along_m), np.std(each.left_m)) for each in motions])
    steady = [np.median(each.speed) > _STEADY * v for each, v in zip(motions, fast, strict=True)]
    still = still_rcs(detections)
    return list(are_persons(rcs, fast, spread, np.array(steady, np.bool_), still).tolist())


def are_persons(
    rcs: Floats, fast: Floats, spread_m: Floats, steady: Booleans, still: float
) -> Booleans:
    """Return which tracks are persons by their size, cross section, and motion.

    Parameters
    ----------
    rcs, fast, spread_m : (n,) arrays
        Median cross section of each track, dBm2; its speed (90 % quantile while it moves), m/s; and
        the standard deviation of its detections' places on the body, metres, NaN if unknown.
    steady : (n,) bool array
        Whether its speed is over `_STEADY` of that quantile half of the time.
    still : float
        Median cross section of still detections, dBm2.
    """
    faint = rcs < still - _FAINT_DB
    usual, sigma = _driven_rcs(rcs, fast, faint)
    if np.isnan(usual):
        return np.asarray(faint)
    size = np.log(np.maximum(spread_m, _LEAST_SPREAD_M))
    weak = np.maximum(rcs - usual, _least_rcs(sigma))
    odds = _log_density(weak, _PERSON[:2]) - _log_density(weak, (_VEHICLE[0], sigma))
    by_size = _log_density(size, _PERSON[2:]) - _log_density(size, _VEHICLE[2:])
    odds += np.where(np.isnan(by_size), _UNKNOWN_SIZE, by_size)
    may_be = steady & (fast < _CYCLIST_MPS) | (rcs < usual - _FAINT_SIGMAS * sigma)
    return np.asarray(may_be & (odds > 0.0))


def _least_rcs(sigma: float) -> float:
    """Return the least cross section that counts, dB over the usual one of vehicles.

    Here the odds of a person are highest. The density of vehicles is the wider one: below this
    value the odds would fall again.
    """
    wide, narrow = sigma**2, _PERSON[1] ** 2
    return _PERSON[0] * wide / (wide - narrow) if wide > narrow else -np.inf


def _log_density(value: Floats, usual: Sequence[float]) -> Floats:
    """Return the log density of a normal distribution without its constant, by (mean, sigma)."""
    mean, sigma = usual
    return np.asarray(-0.5 * ((value - mean) / sigma) ** 2 - np.log(sigma))


def still_rcs(detections: MapDetections) -> float:
    """Return the median cross section of still detections, dBm2."""
    return usual_rcs(detections.rcs[np.abs(detections.range_rate) < MOVING_MPS])


def _driven_rcs(rcs: Floats, fast: Floats, faint: Booleans) -> tuple[float, float]:
    """Return median and sigma of the cross sections of fast vehicles, dBm2; NaN without any."""
    driven = rcs[(fast > _DRIVEN_MPS) & ~faint & np.isfinite(rcs)]
    usual = usual_rcs(driven)
    if len(driven) < _LEAST_DRIVEN:
        return usual, _VEHICLE[1]
    # the median of absolute deviations, in sigmas of a normal distribution
    return usual, max(float(np.median(np.abs(driven - usual))) / 0.6745, _LEAST_DB)


def without_faint_ends(
    detections: MapDetections, motions: list[Motion], states: Floats
) -> list[Motion]:
    """Cut off begins and ends of motions in which the filter followed a person.

    Nearly all detections of a person are faint, few of a vehicle. The cut is where the cumulative
    log odds of a person are highest. Motions with fewer than `LEAST_ROWS` detections are dropped.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    motions : list of Motion
        Motions of vehicles.
    states : (n, 6) array
        State of the filter at each detection.
    """
    found = []
    rcs = np.array([usual_rcs(detections.rcs[each.rows]) for each in motions])
    fast = np.array([_fast(each) for each in motions])
    usual, _ = _driven_rcs(rcs, fast, np.zeros(len(rcs), np.bool_))
    odds = np.log(_FAINT_SHARE / (1.0 - _FAINT_SHARE))
    for each in motions:
        faint = detections.rcs[each.rows] < usual - _FAINT_DB
        log_odds = np.where(faint, -odds, odds)  # of a person, by detection
        ends = []
        for from_one_end in (log_odds, log_odds[::-1]):
            summed = np.cumsum(from_one_end)
            most = int(summed.argmax())
            ends.append(most + 1 if summed[most] > _FAINT_ODDS else 0)
        rows = each.rows[ends[0] : len(faint) - ends[1]]
        if len(rows) == len(faint):
            found.append(each)
        elif len(rows) >= LEAST_ROWS:
            found.append(fit_motion(detections, rows, states))
    return found


def usual_rcs(rcs: Floats, share: float = 0.5) -> float:
    """Return a quantile of the known cross sections, dBm2; NaN where none is known."""
    known = rcs[np.isfinite(rcs)]
    return float(np.quantile(known, share)) if len(known) else np.nan


def _fast(motion: Motion) -> float:
    """Return the speed (m/s) that a vehicle exceeds in a tenth of the time in which it moves."""
    moving = motion.speed[motion.speed > 0.2]
    return float(np.quantile(moving, 0.9)) if len(moving) else 0.0


def tall_odds(height_m: Floats, range_m: Floats) -> float:
    """Return the log odds of a lorry or bus over a car by heights.

    Parameters
    ----------
    height_m : (n,) array
        Heights of the detections over the road, metres; NaN where unknown.
    range_m : (n,) array
        Distances from the sensor, metres.
    """
    known = np.isfinite(height_m)
    if known.sum() < _LEAST_HEIGHTS:
        return 0.0
    range_ = float(np.median(range_m[known]))
    mean = float(height_m[known].mean())
    noise = _BIAS_RAD**2 + _ELEVATION_RAD**2 / known.sum()
    odds = 0.0
    for sign, (middle, spread) in ((1.0, _LORRY_HEIGHT_M), (-1.0, _CAR_HEIGHT_M)):
        variance = spread**2 + noise * range_**2
        odds += sign * (-0.5 * (mean - middle) ** 2 / variance - 0.5 * np.log(variance))
    return float(np.clip(odds, -_MOST_ODDS, _MOST_ODDS))


def one_tall_odds(odds: tuple[float, float]) -> float:
    """Return the log odds of one lorry or bus over two vehicles, by the heights of two parts.

    Parameters
    ----------
    odds : (float, float)
        Log odds of each part, from :func:`tall_odds`.
    """
    return float(-np.log((1.0 - _LONG_SHARE) * np.exp(-np.array(odds)) + _LONG_SHARE).sum())
