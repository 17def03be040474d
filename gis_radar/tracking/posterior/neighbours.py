"""Neighbours that are one long vehicle, and long vehicles that are two neighbours."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Floats, Integers, compiled
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.cuts import EXISTS
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import AHEAD, BEHIND, COS, LENGTH, SIN, WIDTH, X, Y
from gis_radar.tracking.posterior.likelihood import aspect, on_body
from gis_radar.tracking.posterior.sizes import gains_of_sizes, prior, sample, with_size
from gis_radar.tracking.size import LONG_M, LONGEST_M, length_prior, width_of

LEAST_GAIN = 1.0  # of the log-probability
TOLD = 0.1  # of what speaks for a change: detections of one scatterer repeat each other
ASIDE_M, SAME_WAY = 1.7, 0.9  # of two that may be one: lateral distance, cosine of headings
TOGETHER = 0.6  # and so much of the shorter's time
SHORTEST_M = 4.0
USUAL_M, BETWEEN_M = 4.5, 2.0  # the usual length of a car, and a gap in a queue
# The gap that a driver keeps is log-normal about BETWEEN_M + GAP_S x speed (time gaps: Treiber and
# Kesting, Traffic Flow Dynamics, ch. 4): s; standard deviation of the logarithm; the speed, m/s,
# under which a vehicle stands in a queue.
GAP_S, GAP_SPREAD, DRIVES_MPS = 1.8, 0.6, 2.0
KEPT_S = 5.0  # after which a gap counts as chosen anew
LEAST_GAP_M = 0.5  # a shorter gap, or an overlap, is within the error of two lengths
LENGTH_CHANGES_M = (2.0, 1.0, 0.5)  # by which the length of two as one is sought, ever finer
# Parts of one body keep their distance by so much, m; drivers who flow, faster than that, m/s,
# differ by so much, m/s, and who follows lets the gap vary by so large a share of it; after a
# second it can be told.
RIGID_M, FLOWS_MPS, DIFFER_MPS, VARIES, LEAST_S = 0.4, 5.0, 1.0, 0.25, 1.0


def join_neighbours(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with one long vehicle in place of two where that is more likely.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    motions: list[Motion | None] = list(posterior.motions)
    found = []
    for one, other in _neighbours(posterior):
        if len(posterior.motions[one].s_m) < len(posterior.motions[other].s_m):
            one, other = other, one  # noqa: PLW2901 - the longer track is kept
        length, ahead, gain = _as_one(posterior, one, other)
        gain = max(gain, _driven_as_one(posterior.motions[one], posterior.motions[other]))
        if gain > LEAST_GAIN and length > 0.0:
            found.append((-gain, one, other, length, ahead))
    used: set[int] = set()
    for _, one, other, length, ahead in sorted(found):
        if used.isdisjoint((one, other)):
            used |= {one, other}
            motions[one] = with_size(posterior.motions[one], length, ahead)
            motions[other] = None
            motions += _alone(posterior.motions[one], posterior.motions[other], posterior)
    return [each for each in motions if each is not None]


def _alone(one: Motion, other: Motion, posterior: Posterior) -> list[Motion]:
    """Return what a vehicle drives before another is there, and after it is gone: a second each."""
    time = posterior.given.time
    spans = ((other.first_step, one.first_step - 1), (one.last_step + 1, other.last_step))
    long = [span for span in spans if span[1] - span[0] >= STEPS_PER_SECOND]
    return [each for each in (other.between(*span, time) for span in long) if each is not None]


def _neighbours(posterior: Posterior) -> list[tuple[int, int]]:
    """Return pairs that may be one body for most of the time of the shorter-lived one."""
    states = posterior.states
    count = len(posterior.motions)
    _, rows = np.unique(states.vehicle * (1 << 40) + states.window, return_index=True)
    life = np.bincount(states.vehicle[rows], minlength=count)
    rows = rows[np.argsort(states.window[rows], kind="stable")]
    edges = np.flatnonzero(np.diff(states.window[rows], prepend=-1, append=-1))
    pairs = []
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        here = rows[low:high]
        a, b = _near(states.shape[here])
        one, other = states.vehicle[here[a]], states.vehicle[here[b]]
        pairs.append(np.minimum(one, other) * count + np.maximum(one, other))
    keys, times = np.unique(np.concatenate([np.zeros(0, np.int64), *pairs]), return_counts=True)
    enough = times >= TOGETHER * np.minimum(life[keys // count], life[keys % count])
    return [(int(key) // count, int(key) % count) for key in keys[enough]]


def _near(shape: Floats) -> tuple[Integers, Integers]:
    """Return the pairs of bodies behind each other that are together no longer than a lorry."""
    one, other = np.triu_indices(len(shape), 1)
    apart = np.hypot(*(shape[one, k] - shape[other, k] for k in (X, Y)))
    close = apart < LONGEST_M
    one, other = one[close], other[close]
    along, aside, turn = _relative(shape[one], shape[other])
    span = np.abs(along) + 0.5 * (shape[one, LENGTH] + shape[other, LENGTH])
    near = (np.abs(aside) < ASIDE_M) & (np.cos(turn) > SAME_WAY) & (span < LONGEST_M)
    return one[near], other[near]


@compiled
def _relative(one: Floats, other: Floats) -> tuple[Floats, Floats, Floats]:
    """Return how far others are along the bodies of some, left of them, and turned from them."""
    along, left, turn = np.empty(len(one)), np.empty(len(one)), np.empty(len(one))
    for k in range(len(one)):
        east, north = other[k, 0] - one[k, 0], other[k, 1] - one[k, 1]
        along[k], left[k], bent = on_body(one[k], east, north)
        cos, sin = aspect(one[k, 2], one[k, 3], bent, other[k, 2:4])
        turn[k] = math.atan2(sin, cos)
    return along, left, turn


def _as_one(posterior: Posterior, one: int, other: int) -> tuple[float, float, float]:
    """Return length, middle ahead of the first's, and gain of one vehicle in place of two."""
    states = posterior.states
    a, b = sample(posterior, (one, other))
    lengths = [posterior.motions[k].length_m for k in (one, other)]
    _, mine, theirs = np.intersect1d(
        states.frame[a], states.frame[b], assume_unique=True, return_indices=True
    )
    if len(mine) == 0:
        return 0.0, 0.0, -np.inf
    sa, sb = states.shape[a[mine]], states.shape[b[theirs]]
    along = float(np.median(_relative(sa, sb)[0]))
    front = max(0.5 * lengths[0], along + 0.5 * lengths[1])
    rear = min(-0.5 * lengths[0], along - 0.5 * lengths[1])
    for each in (one, other):
        posterior.lift(each)
    near = posterior.detections_by(np.concatenate([a, b]))
    alone = posterior.total[near]
    old = _sum(posterior, a, states.shape[a]) + _sum(posterior, b, states.shape[b])
    posterior.total[near] = alone
    apart = abs(along) - 0.5 * sum(lengths)
    # at the speeds of all its time: who follows the first does so while it drives, too
    before = sum(map(prior, lengths)) - EXISTS + _gap_prior(apart, posterior.motions[one].speed)
    # tried too: the first as it is, where the second is a duplicate of a part of it
    best, gain, extra = (front - rear, 0.5 * (front + rear)), -np.inf, [(lengths[0], 0.0)]
    for change in LENGTH_CHANGES_M:
        tried = [
            (min(max(best[0] + longer * change, SHORTEST_M), LONGEST_M), best[1] + ahead * change)
            for longer in (-1.0, 0.0, 1.0) for ahead in (-0.5, 0.0, 0.5)
        ] + extra  # fmt: skip
        gains = _tempered(gains_of_sizes(posterior, a, tried) - old)
        gains += length_prior(np.array([length for length, _ in tried])) - before
        k = int(np.argmax(gains))
        best, gain, extra = tried[k], float(gains[k]), []
    for each in (one, other):
        posterior.lift(each, 1.0)
    return (*best, gain)


def _driven_as_one(one: Motion, other: Motion) -> float:
    """Return the log odds that two who drive are one long vehicle.

    Parts of one keep their distance as drivers do not, and are nearer than drivers follow; each
    may be of any length up to that of the whole. Where detections lie on them tells nothing: a
    body returns from a few places.
    """
    low, high = max(one.first_step, other.first_step), min(one.last_step, other.last_step)
    a, b = (slice(low - each.first_step, high + 1 - each.first_step) for each in (one, other))
    flows = np.minimum(one.speed[a], other.speed[b]) > FLOWS_MPS
    time = float(flows.sum()) * STEP_S
    # halves of one that was just split drive alike, step by step
    if time < LEAST_S or np.array_equal(one.speed[a], other.speed[b]):
        return -np.inf
    apart = np.hypot(*(one.places[0][a] - other.places[0][b])[flows].T)
    away, bodies = float(np.median(apart)), one.length_m + other.length_m
    gap = max(away - 0.5 * bodies, LEAST_GAP_M)
    differ = max(min(DIFFER_MPS * time / math.sqrt(12.0), VARIES * gap), RIGID_M)
    off = 0.5 * float(np.var(apart))
    odds = 2.0 * (math.log(differ / RIGID_M) - off * (RIGID_M**-2 - differ**-2))
    speed = np.maximum(one.speed[a], other.speed[b])[flows]
    whole = min(away + 0.5 * bodies, LONGEST_M)
    odds += prior(whole) - 2.0 * math.log(whole)
    odds -= prior(one.length_m) + prior(other.length_m)
    odds -= _gap_prior(gap, speed)
    usual = BETWEEN_M + GAP_S * float(np.mean(speed))  # whose density is 1 / (spread x gap)
    return odds + math.log(math.sqrt(2.0 * math.pi) * GAP_SPREAD * usual)


def split_long(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with two behind each other in place of a long one where that is likelier.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    found = []
    for vehicle, motion in enumerate(posterior.motions):
        sizes = _as_two(posterior, vehicle) if motion.length_m > LONG_M else []
        parts = [_part(motion, *size) for size in sizes]
        found += parts if parts and all(len(each.rows) for each in parts) else [motion]
    return found


def _as_two(posterior: Posterior, vehicle: int) -> list[tuple[float, float]]:
    """Return length and middle ahead of those of two vehicles in place of one, if they are."""
    motion = posterior.motions[vehicle]
    (rows,) = sample(posterior, (vehicle,))
    if len(rows) == 0:
        return []
    shape, length = posterior.states.shape[rows], motion.length_m
    other = length - USUAL_M - BETWEEN_M
    found: list[tuple[float, float]] = []
    pairs = [(USUAL_M, min(USUAL_M, other))]
    pairs += [(USUAL_M, other), (other, USUAL_M)] if other > USUAL_M else []
    posterior.lift(vehicle)
    near = posterior.detections_by(rows)
    alone = posterior.total[near]
    now = _sum(posterior, rows, shape)
    posterior.total[near] = alone
    best = LEAST_GAIN
    for front, rear in pairs:
        if rear < SHORTEST_M - BETWEEN_M:
            continue
        sizes = [(front, 0.5 * (length - front)), (rear, 0.5 * (rear - length))]
        new = sum(_sum(posterior, rows, _resized(shape, *size)) for size in sizes)
        posterior.total[near] = alone
        apart = length - front - rear
        gain = float(_tempered(np.array(new - now)))
        gain += prior(front) + prior(rear) - EXISTS - prior(length)
        gain += _gap_prior(apart, motion.speed)
        if gain > best:
            best, found = gain, sizes
    posterior.lift(vehicle, 1.0)
    return found


def _sum(posterior: Posterior, rows: Integers, shape: Floats) -> float:
    """Add states to what is there; return their gain over all else."""
    return float(posterior.gains(rows, shape, add=True)[:, 0].sum())


def _tempered(gain: Floats) -> Floats:
    """Return gains of the log-likelihood, those that speak for a change as far as they tell."""
    return np.where(gain > 0.0, TOLD * gain, gain)


def _gap_prior(gap_m: float, speed: Floats) -> float:
    """Return the log prior of a gap between two at these speeds, relative to the usual gap's.

    Longer gaps cost nothing.
    """
    drives = speed > DRIVES_MPS
    usual = BETWEEN_M + GAP_S * (speed[drives] if drives.any() else np.zeros(1))
    short = np.minimum(np.log(max(gap_m, LEAST_GAP_M) / usual), 0.0) / GAP_SPREAD
    often = 1.0 + float(drives.sum()) * STEP_S / KEPT_S
    return -0.5 * often * float(np.mean(short**2))


def _resized(shape: Floats, length: float, ahead: float) -> Floats:
    """Return shapes with another length, their middle moved ahead along their path."""
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


def _part(motion: Motion, length: float, ahead: float) -> Motion:
    """Return a part of a vehicle as one of its own, with the detections on its side."""
    mine = (motion.along_m > 0.0) == (ahead > 0.0)
    part = replace(
        motion, rows=motion.rows[mine], along_m=motion.along_m[mine], left_m=motion.left_m[mine]
    )
    return with_size(part, length, ahead)
