"""Merge and split: neighbours that are one long vehicle, long vehicles that are two neighbours."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Floats, Integers, compiled
from gis_radar.tracking.motion import GAP_S, GAP_SPREAD, Motion
from gis_radar.tracking.posterior.cuts import VEHICLE_COST
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import AHEAD, BEHIND, COS, LENGTH, SIN, WIDTH, X, Y
from gis_radar.tracking.posterior.likelihood import aspect, body_coordinates
from gis_radar.tracking.posterior.sizes import gains_of_sizes, log_prior, sample, with_size
from gis_radar.tracking.size import LONG_M, LONGEST_M, length_prior, width_of

_LEAST_GAIN = 1.0  # least log odds of a merge or a split
# Share of the log likelihood ratio that counts for a change: detections of one scatterer repeat
# each other.
EVIDENCE_SHARE = 0.1
# Two vehicles may be one if their lateral distance and the cosine of their headings allow, and for
# this share of the time of the shorter track.
_ASIDE_M, _SAME_COS, _LEAST_TOGETHER = 1.7, 0.9, 0.6
_SHORTEST_M = 4.0  # least length of a merged vehicle
_CAR_M, _QUEUE_GAP_M = 4.5, 2.0  # usual length of a car, and gap in a queue
# The gap that a driver keeps is log-normal about _QUEUE_GAP_M + GAP_S x speed.
_QUEUE_MPS = 2.0  # slower vehicles stand in a queue
_GAP_LASTS_S = 5.0  # time after which a gap counts as chosen anew
_LEAST_GAP_M = 0.5  # a shorter gap, or an overlap, is within the error of two lengths
LENGTH_CHANGES_M = (2.0, 1.0, 0.5)  # steps of the search for a merged length, coarse to fine
# Log odds by coarse lengths, nats, below which no pair was merged by finer ones (of 1,326 pairs).
_HOPELESS = -300.0
# Sigma of the distance of parts of one body. Above _FLOWING_MPS two drivers' speeds differ by
# _DRIFT_MPS, but a follower lets the gap vary by this share of it at most. Least time of both so.
_RIGID_M, _FLOWING_MPS, _DRIFT_MPS, _GAP_VARIES, _LEAST_S = 0.4, 5.0, 1.0, 0.25, 1.0
_SIGMA_OF_MEDIAN = 1.4826  # sigma of a normal variable over the median of its absolute value


def join_neighbours(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with neighbours merged to one long vehicle where that is more likely.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; it does not change.
    """
    motions: list[Motion | None] = list(posterior.motions)
    candidates = []
    for first, second in _neighbours(posterior):
        if len(posterior.motions[first].s_m) < len(posterior.motions[second].s_m):
            first, second = second, first  # noqa: PLW2901 - the longer track is kept
        driven = _driven_as_one_odds(posterior.motions[first], posterior.motions[second])
        least = _HOPELESS if driven <= _LEAST_GAIN else -np.inf
        length, ahead, gain = _merged(posterior, first, second, least)
        gain = max(gain, driven)
        if gain > _LEAST_GAIN and length > 0.0:
            candidates.append((-gain, first, second, length, ahead))
    used: set[int] = set()
    for _, first, second, length, ahead in sorted(candidates):
        if used.isdisjoint((first, second)):
            used |= {first, second}
            motions[first] = with_size(posterior.motions[first], length, ahead)
            motions[second] = None
            motions += _outside(posterior.motions[first], posterior.motions[second], posterior)
    return [each for each in motions if each is not None]


def _outside(first: Motion, second: Motion, posterior: Posterior) -> list[Motion]:
    """Return the parts of the second motion before and after the first, of a second at least."""
    time = posterior.detections.time
    spans = ((second.first_step, first.first_step - 1), (first.last_step + 1, second.last_step))
    long = [span for span in spans if span[1] - span[0] >= STEPS_PER_SECOND]
    return [each for each in (second.between(*span, time) for span in long) if each is not None]


def _neighbours(posterior: Posterior) -> list[tuple[int, int]]:
    """Return pairs of vehicles that may be one body for most of the time of the shorter track."""
    states = posterior.states
    count, vehicle, window = len(posterior.motions), states.vehicle, posterior.windows(slice(None))
    _, rows = np.unique(vehicle * (1 << 40) + window, return_index=True)
    windows_of = np.bincount(vehicle[rows], minlength=count)
    rows = rows[np.argsort(window[rows], kind="stable")]
    edges = np.flatnonzero(np.diff(window[rows], prepend=-1, append=-1))
    pairs = []
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        states_now = rows[low:high]
        a, b = _may_be_one(states.shape[states_now])
        one, other = vehicle[states_now[a]], vehicle[states_now[b]]
        pairs.append(np.minimum(one, other) * count + np.maximum(one, other))
    keys, times = np.unique(np.concatenate([np.zeros(0, np.int64), *pairs]), return_counts=True)
    shorter = np.minimum(windows_of[keys // count], windows_of[keys % count])
    enough = times >= _LEAST_TOGETHER * shorter
    return [(int(key) // count, int(key) % count) for key in keys[enough]]


def _may_be_one(shape: Floats) -> tuple[Integers, Integers]:
    """Return the pairs of shapes, one behind the other, that span no more than a lorry."""
    one, other = np.triu_indices(len(shape), 1)
    apart = np.hypot(*(shape[one, k] - shape[other, k] for k in (X, Y)))
    close = apart < LONGEST_M
    one, other = one[close], other[close]
    along, aside, turn = _relative(shape[one], shape[other])
    span = np.abs(along) + 0.5 * (shape[one, LENGTH] + shape[other, LENGTH])
    near = (np.abs(aside) < _ASIDE_M) & (np.cos(turn) > _SAME_COS) & (span < LONGEST_M)
    return one[near], other[near]


@compiled
def _relative(one: Floats, other: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the second bodies in coordinates of the first: distance ahead, left, and turn."""
    along, left, turn = np.empty(len(one)), np.empty(len(one)), np.empty(len(one))
    for k in range(len(one)):
        east, north = other[k, 0] - one[k, 0], other[k, 1] - one[k, 1]
        along[k], left[k], bent = body_coordinates(one[k], east, north)
        cos, sin = aspect(one[k, 2], one[k, 3], bent, other[k, 2:4])
        turn[k] = math.atan2(sin, cos)
    return along, left, turn


def _merged(
    posterior: Posterior, first: int, second: int, least: float
) -> tuple[float, float, float]:
    """Return the best vehicle in place of two: length, middle ahead of the first's, log odds.

    The search ends where the odds by the coarsest lengths are below `least`.
    """
    states = posterior.states
    a, b = sample(posterior, (first, second))
    lengths = [posterior.motions[k].length_m for k in (first, second)]
    _, in_a, in_b = np.intersect1d(
        states.frame[a], states.frame[b], assume_unique=True, return_indices=True
    )
    if len(in_a) == 0:
        return 0.0, 0.0, -np.inf
    sa, sb = states.shape[a[in_a]], states.shape[b[in_b]]
    along = float(np.median(_relative(sa, sb)[0]))
    front = max(0.5 * lengths[0], along + 0.5 * lengths[1])
    rear = min(-0.5 * lengths[0], along - 0.5 * lengths[1])
    for each in (first, second):
        posterior.exclude(each)
    detected = posterior.rows_in_frames_of(np.concatenate([a, b]))
    rates_without = posterior.total_rate[detected]
    gain_of_two = _add(posterior, a, states.shape[a]) + _add(posterior, b, states.shape[b])
    posterior.total_rate[detected] = rates_without
    gap = abs(along) - 0.5 * sum(lengths)
    # the gap is that at the speeds of the first in all its time, not in the sample alone
    prior_of_two = sum(map(log_prior, lengths)) - VEHICLE_COST
    prior_of_two += _log_gap_prior(gap, posterior.motions[first].speed)
    # tried too: the first as it is, where the second is a duplicate of a part of it
    best, gain, extra = (front - rear, 0.5 * (front + rear)), -np.inf, [(lengths[0], 0.0)]
    for change in LENGTH_CHANGES_M:
        tried = [
            (min(max(best[0] + longer * change, _SHORTEST_M), LONGEST_M), best[1] + ahead * change)
            for longer in (-1.0, 0.0, 1.0) for ahead in (-0.5, 0.0, 0.5)
        ] + extra  # fmt: skip
        gains = _tempered(gains_of_sizes(posterior, a, tried) - gain_of_two)
        gains += length_prior(np.array([length for length, _ in tried])) - prior_of_two
        k = int(np.argmax(gains))
        best, gain, extra = tried[k], float(gains[k]), []
        if gain < least:
            break
    for each in (first, second):
        posterior.include(each)
    return (*best, gain)


def _driven_as_one_odds(first: Motion, second: Motion) -> float:
    """Return the log odds, by their motion, that two driving vehicles are one long vehicle.

    Parts of one body keep their distance better than two drivers do, and are nearer to each other
    than drivers follow; each part may have any length up to that of the body. The places of
    detections do not count, since a body returns from a few scatterers only.
    """
    low, high = max(first.first_step, second.first_step), min(first.last_step, second.last_step)
    if low > high:  # both are in one half second, but one begins after the other ends
        return -np.inf
    a, b = (slice(low - each.first_step, high + 1 - each.first_step) for each in (first, second))
    flowing = np.minimum(first.speed[a], second.speed[b]) > _FLOWING_MPS
    time = float(flowing.sum()) * STEP_S
    # halves of one that was just split drive alike, step by step
    if time < _LEAST_S or np.array_equal(first.speed[a], second.speed[b]):
        return -np.inf
    distances = np.hypot(*(first.places[0][a] - second.places[0][b])[flowing].T)
    distance, bodies = float(np.median(distances)), first.length_m + second.length_m
    gap = max(distance - 0.5 * bodies, _LEAST_GAP_M)
    drift = max(min(_DRIFT_MPS * time / math.sqrt(12.0), _GAP_VARIES * gap), _RIGID_M)
    # robust, as the ends of a track are extrapolated and may be metres off
    half_variance = 0.5 * (_SIGMA_OF_MEDIAN * float(np.median(np.abs(distances - distance)))) ** 2
    odds = 2.0 * (math.log(drift / _RIGID_M) - half_variance * (_RIGID_M**-2 - drift**-2))
    speed = np.maximum(first.speed[a], second.speed[b])[flowing]
    merged_m = min(distance + 0.5 * bodies, LONGEST_M)
    odds += log_prior(merged_m) - 2.0 * math.log(merged_m)
    odds -= log_prior(first.length_m) + log_prior(second.length_m)
    odds -= _log_gap_prior(gap, speed)
    mode_m = _QUEUE_GAP_M + GAP_S * float(np.mean(speed))  # whose density is 1 / (spread x gap)
    return odds + math.log(math.sqrt(2.0 * math.pi) * GAP_SPREAD * mode_m)


def split_long(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with long ones split in two where that is more likely.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; it does not change.
    """
    found = []
    for vehicle, motion in enumerate(posterior.motions):
        sizes = _split(posterior, vehicle) if motion.length_m > LONG_M else []
        parts = [_split_part(motion, *size) for size in sizes]
        found += parts if parts and all(len(each.rows) for each in parts) else [motion]
    return found


def _split(posterior: Posterior, vehicle: int) -> list[tuple[float, float]]:
    """Return lengths, and middles ahead, of two vehicles in place of one; empty if less likely."""
    motion = posterior.motions[vehicle]
    (rows,) = sample(posterior, (vehicle,))
    if len(rows) == 0:
        return []
    shape, length = posterior.states.shape[rows], motion.length_m
    rest = length - _CAR_M - _QUEUE_GAP_M
    best_sizes: list[tuple[float, float]] = []
    pairs = [(_CAR_M, min(_CAR_M, rest))]
    pairs += [(_CAR_M, rest), (rest, _CAR_M)] if rest > _CAR_M else []
    posterior.exclude(vehicle)
    detected = posterior.rows_in_frames_of(rows)
    rates_without = posterior.total_rate[detected]
    gain_of_one = _add(posterior, rows, shape)
    posterior.total_rate[detected] = rates_without
    best = _LEAST_GAIN
    for front, rear in pairs:
        if rear < _SHORTEST_M - _QUEUE_GAP_M:
            continue
        sizes = [(front, 0.5 * (length - front)), (rear, 0.5 * (rear - length))]
        new = sum(_add(posterior, rows, _resized(shape, *size)) for size in sizes)
        posterior.total_rate[detected] = rates_without
        gap = length - front - rear
        gain = float(_tempered(np.array(new - gain_of_one)))
        gain += log_prior(front) + log_prior(rear) - VEHICLE_COST - log_prior(length)
        gain += _log_gap_prior(gap, motion.speed)
        if gain > best:
            best, best_sizes = gain, sizes
    posterior.include(vehicle)
    return best_sizes


def _add(posterior: Posterior, rows: Integers, shape: Floats) -> float:
    """Add the rates of a vehicle's shapes to the total rates; return its gain, nats."""
    return float(posterior.gains(rows, shape, add=True)[:, 0].sum())


def _tempered(gain: Floats) -> Floats:
    """Return log likelihood ratios of a change, positive ones reduced to `EVIDENCE_SHARE`."""
    return np.where(gain > 0.0, EVIDENCE_SHARE * gain, gain)


def _log_gap_prior(gap_m: float, speed: Floats) -> float:
    """Return the log prior of a gap at the follower's speeds, relative to that of the usual gap.

    Only gaps shorter than usual have a cost: once, and again for each `_GAP_LASTS_S` of driving.
    """
    drives = speed > _QUEUE_MPS
    usual_m = _QUEUE_GAP_M + GAP_S * (speed[drives] if drives.any() else np.zeros(1))
    shortfall = np.minimum(np.log(max(gap_m, _LEAST_GAP_M) / usual_m), 0.0) / GAP_SPREAD
    times = 1.0 + float(drives.sum()) * STEP_S / _GAP_LASTS_S
    return -0.5 * times * float(np.mean(shortfall**2))


def _resized(shape: Floats, length: float, ahead: float) -> Floats:
    """Return shapes with another length, their middle moved ahead along their bend, metres."""
    new = shape.copy()
    bend = shape[:, AHEAD] if ahead > 0.0 else shape[:, BEHIND]
    turn = bend * ahead
    chord = ahead * np.sinc(0.5 * turn / np.pi)
    heading = np.arctan2(shape[:, SIN], shape[:, COS])
    new[:, X] += chord * np.cos(heading + 0.5 * turn)
    new[:, Y] += chord * np.sin(heading + 0.5 * turn)
    new[:, COS], new[:, SIN] = np.cos(heading + turn), np.sin(heading + turn)
    new[:, BEHIND] = new[:, AHEAD] = bend
    new[:, LENGTH], new[:, WIDTH] = length, width_of(length)
    return new


def _split_part(motion: Motion, length: float, ahead: float) -> Motion:
    """Return one of the two vehicles of a split, with the detections on its half."""
    own = (motion.along_m > 0.0) == (ahead > 0.0)
    part = replace(
        motion, rows=motion.rows[own], along_m=motion.along_m[own], left_m=motion.left_m[own]
    )
    return with_size(part, length, ahead)
