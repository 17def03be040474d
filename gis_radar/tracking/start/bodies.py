"""Bodies: find which detections are of one vehicle while it moves.

The filter follows detections forward and backward in time; where both agree, a vehicle is followed
whole. Several vehicles of the filter are often the ends of one long vehicle, or one vehicle as two
sensors see it: they keep their places in the frame that moves along, as no other vehicle does.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, nearest
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.detections import MOVING_MPS, MapDetections
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.start.tall import one_tall_odds, tall_odds

LEAST_SPREAD_M = 0.1  # two detections of one scatterer
UNKNOWN_SIZE = -1.0  # log odds of a person of unknown size: on lanes persons are fewer
# A part is split, MOST_SPLIT times at most, while a smaller share of it keeps its place in the
# moving frame; parts of fewer rows are dropped.
LEAST_PURE, MOST_SPLIT, LEAST_ROWS = 0.95, 3, 5
SEEN_S = 0.35  # time before and after a detection in which the state of its vehicle is known
LEFT_M, BEARING_RAD = 1.7, 0.006  # half the width of a truck, error of a bearing: sideways
# Tolerance of a range rate: noise, a share of the speed, and a share of it at which the ends of a
# turning body swing.
RATE_MPS, WHEEL_SHARE, SWING = 0.8, 0.08, 0.6
LEAST_FIT = 0.7  # share of detections whose places and range rates fit
SCATTER_M = 2.5  # largest median scatter of places: scatterers change along a body
PLACE_M = 0.4  # sigma of a mean place, for which scatterers last
REACH_M = 16.5  # from the middle of its detections to any part of a truck with trailer
CAR_M = 4.7  # length of a car
GAP_S, GAP_SPREAD = 1.8, 0.6  # median time gap between drivers, and sigma of its logarithm
LONG_SHARE = 0.12  # share of vehicles over 7 m in traffic
LEAST_ODDS = 0.5  # logarithm of the odds above which two parts are joined
DRIVEN_MPS = 8.0  # vehicles above this speed certainly drive
CYCLIST_MPS = 7.5  # largest speed of cyclists
# Mean and sigma of the cross section, dB over that of vehicles, and of the logarithm of the spread
# of detections, metres: most people return 4 to 10 dB less; a cyclist of 1.8 x 0.6 m spreads by
# 0.55 m, a car by 1.4 m, bearing and smoothing add 0.5 m. The sigma of vehicles' cross sections is
# that of the recordings where enough of them drive fast.
PERSON, VEHICLE = (-7.0, 3.0, -0.3, 0.45), (0.0, 4.0, 0.4, 0.5)
LEAST_DRIVEN, LEAST_DB = 5, 3.0  # fast vehicles that tell the sigma, which is this at least, dB
FAINT_DB = 9.0  # detections weaker by this are faint: persons, also next to a passing vehicle
FAINT_SIGMAS = 3.0  # a track weaker by so many may be a person at any speed
# Share of faint detections of a vehicle, and one less that of a person: a tenth of a car's, a fifth
# of a lorry's or a motorcycle's; nine tenths of a walker's, two thirds of a cyclist's.
FAINT_SHARE = 0.2
FAINT_ODDS = 10.0  # log odds above which an end of a track is of a person: eight in a row
STEADY = 0.5  # share of the 90 % quantile of its speed that a person exceeds half of the time


def rows_by_number(number: Integers) -> list[Integers]:
    """Return the rows of each number in ascending order; rows of `NONE` are left out."""
    rows = np.flatnonzero(number != NONE)
    rows = rows[np.argsort(number[rows], kind="stable")]
    return np.split(rows, np.flatnonzero(np.diff(number[rows])) + 1) if len(rows) else []


def join_directions(number: Integers, against: Integers, time: Floats) -> Integers:
    """Return one number for each detection from those of both directions of time.

    A detection that only the backward direction claims gets the number of its neighbour there. Two
    vehicles that one vehicle of the other direction follows one after the other are one.

    Parameters
    ----------
    number, against : (n,) int64 arrays
        The filter's numbers of detections, forward and backward in time.
    time : (n,) array
        Times of the detections, seconds.
    """
    rows = rows_by_number(number)
    if not rows:
        return against.copy()
    spans = {int(number[r[0]]): (float(time[r].min()), float(time[r].max())) for r in rows}
    sizes = {int(number[r[0]]): len(r) for r in rows}
    groups = _Groups(spans)
    joined, fresh = number.copy(), int(number.max()) + 1
    for part in rows_by_number(against):
        known = np.flatnonzero(number[part] != NONE)
        if len(known) == 0:
            joined[part] = fresh
            fresh += 1
            continue
        free = np.flatnonzero(number[part] == NONE)
        joined[part[free]] = number[part[known[nearest(time[part[known]], time[part[free]])]]]
        values, counts = np.unique(number[part[known]], return_counts=True)
        strong = [
            value for value, count in zip(values.tolist(), counts.tolist(), strict=True)
            if count >= max(4, 0.3 * sizes[value])
        ]  # fmt: skip
        strong.sort(key=lambda value: spans[value])
        for one, other in pairwise(strong):
            groups.join(one, other)
    mapped = np.arange(fresh)
    for value in spans:
        mapped[value] = groups.of(value)
    return np.where(joined == NONE, NONE, mapped[joined])


class _Groups:
    """Groups of tracks of one vehicle, by the spans of time in which they are followed."""

    MOST_BOTH_S = 0.7  # longest time that a vehicle is followed twice, where one track ends

    def __init__(self, spans: dict[int, tuple[float, float]]) -> None:
        self._head = {value: value for value in spans}
        self._spans = {value: [span] for value, span in spans.items()}

    def of(self, value: int) -> int:
        """Return the number that represents a vehicle's group."""
        while self._head[value] != value:
            self._head[value] = self._head[self._head[value]]
            value = self._head[value]
        return value

    def join(self, one: int, other: int) -> None:
        """Join two groups, unless both were followed at the same time."""
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
    """Join parts of one body, those with the highest odds first; return each vehicle's motion.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    parts : list of int64 arrays
        Rows that were followed as one vehicle.
    states : (n, 6) array
        State of the vehicle, for every detection.
    """
    found = [each for rows in parts for each in purified(detections, rows, states)]
    boxes = [_box(detections, each.rows) for each in found]
    gone: set[int] = set()
    for strong in sorted(range(len(found)), key=lambda k: -len(found[k].rows)):
        again = strong not in gone
        while again:
            again = False
            for other in range(len(found)):
                weaker = len(found[other].rows) <= len(found[strong].rows)
                if other == strong or other in gone or not weaker:
                    continue
                if (boxes[other][0] > boxes[strong][1]).any() or (
                    boxes[other][1] < boxes[strong][0]
                ).any():
                    continue
                odds = log_odds(detections, found[strong], found[other])
                if odds > LEAST_ODDS:
                    rows = np.concatenate([found[strong].rows, found[other].rows])
                    found[strong] = fit_motion(detections, rows, states)
                    boxes[strong] = _box(detections, rows)
                    gone.add(other)
                    again = True
    return [each for k, each in enumerate(found) if k not in gone]


def _box(detections: MapDetections, rows: Integers) -> Floats:
    """Return the least and most of time, easting and northing, widened by a long body."""
    table = np.column_stack([detections.time[rows], detections.points[rows]])
    reach = np.array([0.1, 20.0, 20.0])
    return np.stack([table.min(axis=0) - reach, table.max(axis=0) + reach])


def log_odds(detections: MapDetections, body: Motion, other: Motion) -> float:
    """Return the logarithm of the odds that two parts are one body.

    In the frame that moves with the first, the second keeps its place if it is of the same body;
    another vehicle drifts, and keeps its distance: time gaps between drivers are log-normal, with a
    median of 1.8 s (Treiber and Kesting, *Traffic Flow Dynamics*, 2013, ch. 4).
    """
    rows = other.rows[np.abs(detections.range_rate[other.rows]) > MOVING_MPS]
    own = detections.time[body.rows]
    rows = rows[(detections.time[rows] > own[0] - 0.2) & (detections.time[rows] < own[-1] + 0.2)]
    if len(rows) < 3:
        return -np.inf
    # the first body's frame is known well only while it is seen, too
    near = nearest(own, detections.time[rows])
    rows = rows[np.abs(own[near] - detections.time[rows]) < SEEN_S]
    if len(rows) < 3 or np.ptp(detections.time[rows]) < 0.1:
        return -np.inf
    along, left, rate = body.frame(detections, rows)
    _, speed = body.at(detections.time[rows])
    beside = LEFT_M + BEARING_RAD * detections.range_m[rows]
    fits = (np.abs(left) < beside) & (np.abs(rate) < _slack(body, along, speed))
    if fits.mean() < LEAST_FIT or fits.sum() < 3:
        return -np.inf
    one, two = (
        tall_odds(detections.height_m[each.rows], detections.range_m[each.rows])
        for each in (body, other)
    )
    long = one_tall_odds((one, two))
    return _odds_of_places(detections.time[rows][fits], along[fits], speed[fits], body, long)


def _slack(body: Motion, along: Floats, speed: Floats) -> Floats:
    """Return the tolerance of range rates of a body: in a bend its ends swing."""
    swing = SWING * min(body.path.most_bend, 0.1) * speed * np.abs(along)
    return np.asarray(RATE_MPS + WHEEL_SHARE * speed + swing)


def purified(detections: MapDetections, rows: Integers, states: Floats) -> list[Motion]:
    """Return the motions of a part, which is split where it cannot be of one body."""
    found: list[Motion] = []
    while len(rows) >= LEAST_ROWS and len(found) < MOST_SPLIT:
        body = fit_motion(detections, rows, states)
        along, left, rate = body.frame(detections, body.rows)
        _, speed = body.at(detections.time[body.rows])
        own = np.abs(along) < 0.5 * REACH_M + 1.0
        own &= np.abs(left) < 2.0 * LEFT_M
        own &= np.abs(rate) < 2.0 * _slack(body, along, speed) + speed
        if own.mean() >= LEAST_PURE or own.sum() < LEAST_ROWS:
            return [*found, body]
        kept = fit_motion(detections, body.rows[own], states)
        found.append(kept)
        rows = body.rows[~own]
    return found


def _odds_of_places(time: Floats, along: Floats, speed: Floats, body: Motion, long: float) -> float:
    """Return the log odds from places in a moving frame: whether they stay, and are too near.

    The other evidence for a long vehicle counts only for places beyond the body.
    """
    span = float(np.ptp(time))
    away = abs(float(np.median(along)))
    if away > REACH_M:
        return -np.inf
    stays = 0.0
    if span > 0.3:
        centred = time - time.mean()
        drift = float(centred @ (along - along.mean()) / (centred @ centred))
        rest = np.abs(along - np.median(along) - drift * centred)
        if np.median(rest) > SCATTER_M:
            return -np.inf
        # sigma of the slope of places that are independent every half second
        sigma = np.hypot(PLACE_M * np.sqrt(12.0) / (span * np.sqrt(max(2 * span, 1))), 0.1)
        wide = np.hypot(1.0, sigma)  # 1 m/s: sigma of the difference of drivers' speeds
        stays = 0.5 * (drift / wide) ** 2 - 0.5 * (drift / sigma) ** 2 + np.log(wide / sigma)
    within = np.abs(along) < 0.5 * max(body.length_m, 3.0) + 1.0
    if within.mean() > 0.6:
        return 5.0 + min(stays, 0.0)
    pace = max(float(np.quantile(speed, 0.8)), 2.0)
    gap_s = max(away - CAR_M, 0.05) / pace
    z = np.log(gap_s / GAP_S) / GAP_SPREAD
    follows = -0.5 * z * z - np.log(gap_s * GAP_SPREAD * 2.5066 * pace)
    return float(stays + long + np.log(LONG_SHARE / 12.0) - follows)


def merge_states(number: Integers, states: tuple[Floats, Floats], joined: Integers) -> Floats:
    """Return forward states, and backward ones where only these claim a detection."""
    return np.where(((number == NONE) & (joined != NONE))[:, None], states[1], states[0])


def is_person(detections: MapDetections, motions: Sequence[Motion]) -> list[bool]:
    """Return for each motion whether it is a walker or a cyclist: weak, small, slow and steady.

    The cross section of vehicles is that of fast ones in the same recordings, since radars
    state cross sections on scales of their own. Still detections are about as strong: where no
    vehicle drives fast, a track far weaker than these is a person. People keep their pace; a track
    that mostly stands cannot be told from its surroundings by its returns.
    """
    rcs = np.array([usual_rcs(detections.rcs[each.rows]) for each in motions])
    fast = np.array([_fast(each) for each in motions])
    spread = np.array([np.hypot(np.std(each.along_m), np.std(each.left_m)) for each in motions])
    steady = [np.median(each.speed) > STEADY * v for each, v in zip(motions, fast, strict=True)]
    still, told = still_rcs(detections), np.array(steady, np.bool_)
    return list(are_persons(rcs, fast, spread, told, still).tolist())


def are_persons(
    rcs: Floats, fast: Floats, spread_m: Floats, steady: Booleans, still: float
) -> Booleans:
    """Return which tracks are persons by their size, cross section, and motion.

    Parameters
    ----------
    rcs, fast, spread_m : (n,) arrays
        Median cross section of each, dBm2; its speed, m/s; and the standard deviation of its
        detections' places on it, metres, NaN where that is not known.
    steady : (n,) bool array
        Whether it keeps its pace.
    still : float
        Median cross section of still detections, dBm2.
    """
    faint = rcs < still - FAINT_DB
    usual, sigma = _driven_rcs(rcs, fast, faint)
    if np.isnan(usual):
        return np.asarray(faint)
    size = np.log(np.maximum(spread_m, LEAST_SPREAD_M))
    weak = np.maximum(rcs - usual, _weakest_told(sigma))
    odds = _log_density(weak, PERSON[:2]) - _log_density(weak, (VEHICLE[0], sigma))
    by_size = _log_density(size, PERSON[2:]) - _log_density(size, VEHICLE[2:])
    odds += np.where(np.isnan(by_size), UNKNOWN_SIZE, by_size)
    may_be = steady & (fast < CYCLIST_MPS) | (rcs < usual - FAINT_SIGMAS * sigma)
    return np.asarray(may_be & (odds > 0.0))


def _weakest_told(sigma: float) -> float:
    """Return the cross section, dB over that of vehicles, where the odds of a person are highest.

    Vehicles vary by more than persons, so that by normal densities what is weaker still would be
    rather a vehicle again.
    """
    wide, narrow = sigma**2, PERSON[1] ** 2
    return PERSON[0] * wide / (wide - narrow) if wide > narrow else -np.inf


def _log_density(value: Floats, usual: Sequence[float]) -> Floats:
    """Return the logarithm of a normal density up to a constant; `usual` is mean and sigma."""
    mean, sigma = usual
    return np.asarray(-0.5 * ((value - mean) / sigma) ** 2 - np.log(sigma))


def still_rcs(detections: MapDetections) -> float:
    """Return the median cross section of still detections, dBm2."""
    return usual_rcs(detections.rcs[np.abs(detections.range_rate) < MOVING_MPS])


def _driven_rcs(rcs: Floats, fast: Floats, faint: Booleans) -> tuple[float, float]:
    """Return the median cross section of fast vehicles, NaN if there are none, and its sigma."""
    driven = rcs[(fast > DRIVEN_MPS) & ~faint & np.isfinite(rcs)]
    usual = usual_rcs(driven)
    if len(driven) < LEAST_DRIVEN:
        return usual, VEHICLE[1]
    # the median of absolute deviations, in sigmas of a normal distribution
    return usual, max(float(np.median(np.abs(driven - usual))) / 0.6745, LEAST_DB)


def without_faint_ends(
    detections: MapDetections, motions: list[Motion], states: Floats
) -> list[Motion]:
    """Cut off begins and ends of motions in which a person was followed, too.

    Nearly all detections of a person are faint, of a vehicle few: the cut is where the sum of their
    log odds is highest. Motions of which less than a body remains are dropped.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    motions : list of Motion
        Motions of vehicles.
    states : (n, 6) array
        State of the vehicle, for every detection.
    """
    found = []
    rcs = np.array([usual_rcs(detections.rcs[each.rows]) for each in motions])
    fast = np.array([_fast(each) for each in motions])
    usual, _ = _driven_rcs(rcs, fast, np.zeros(len(rcs), np.bool_))
    odds = np.log(FAINT_SHARE / (1.0 - FAINT_SHARE))
    for each in motions:
        faint = detections.rcs[each.rows] < usual - FAINT_DB
        tells = np.where(faint, -odds, odds)
        ends = []
        for way in (tells, tells[::-1]):
            summed = np.cumsum(way)
            most = int(summed.argmax())
            ends.append(most + 1 if summed[most] > FAINT_ODDS else 0)
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
