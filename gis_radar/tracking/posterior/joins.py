"""Two tracks of one vehicle made one: the later one goes on where it meets the earlier one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, STEPS_PER_SECOND
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.paths import Path
from gis_radar.tracking.posterior.cuts import END_MOST, END_SHARE, END_WINDOWS, EXISTS
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import window_of
from gis_radar.tracking.posterior.neighbours import TOLD
from gis_radar.tracking.posterior.sizes import with_size
from gis_radar.tracking.size import LONGEST_M

LEAST_GAIN = 1.0  # of the log-probability
APART_STEPS = STEPS_PER_SECOND // 2  # between the end of one and the begin of the next, at most
ASIDE_M, ALONG_M = 1.5, 2.5  # of two tracks of one vehicle where they meet: errors of places
TURNED, FASTER_MPS = 0.5, 3.0  # and by how much headings, rad, and speeds differ there
HALF_LONGER_M = 2.0  # difference of lengths, halved: a car is no part of a lorry that it follows
BLEND_STEPS = STEPS_PER_SECOND  # over which the difference of places is made up


def join_ends(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with one track in place of two where they meet and that is more likely.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    found = []
    for one, other in _meetings(posterior.motions):
        joined = _joined(posterior, one, other)
        gain = -np.inf if joined is None else _gain(posterior, one, other, joined)
        if joined is not None and gain > LEAST_GAIN:
            found.append((-gain, one, other, joined))
    motions: list[Motion | None] = list(posterior.motions)
    used: set[int] = set()
    for _, one, other, joined in sorted(found, key=lambda each: each[:3]):
        if used.isdisjoint((one, other)):
            used |= {one, other}
            motions[one], motions[other] = joined, None
    return [each for each in motions if each is not None]


def _meetings(motions: list[Motion]) -> list[tuple[int, int]]:
    """Return pairs of which the second begins before the first ends, or just after, and lasts."""
    if not motions:
        return []
    first = np.array([each.first_step for each in motions], np.int64)
    last = np.array([each.last_step for each in motions], np.int64)
    begins = (first[:, None] < first) & (first <= last[:, None] + APART_STEPS)
    one, other = np.nonzero(begins & (last[:, None] < last))
    there = np.array([each.places[0][0] for each in motions])[other]
    at = np.minimum(first[other], last[one]) - first[one]
    pairs = zip(one.tolist(), at.tolist(), strict=True)
    here = np.array([motions[k].places[0][step] for k, step in pairs]).reshape(-1, 2)
    near = np.hypot(*(there - here).T) < LONGEST_M
    return list(zip(one[near].tolist(), other[near].tolist(), strict=True))


def _joined(posterior: Posterior, one: int, other: int) -> Motion | None:
    """Return one motion that goes over from the first to the second where they meet, if they do."""
    a, b = posterior.motions[one], posterior.motions[other]
    low, high = min(b.first_step, a.last_step), max(b.first_step, a.last_step)
    steps = np.arange(low, high + 1)
    time = steps.astype(np.float64) * STEP_S
    (s_a, v_a), (s_b, v_b) = (each.at(time) for each in (a, b))
    (at_a, turn_a), (at_b, turn_b) = a.path.at(s_a), b.path.at(s_b)
    east, north = (at_b - at_a).T
    along = east * np.cos(turn_a) + north * np.sin(turn_a)
    aside = np.abs(north * np.cos(turn_a) - east * np.sin(turn_a))
    half = 0.5 * (a.length_m - b.length_m)
    # either may be known by its front or its rear alone
    by_end = np.stack([along, along - half, along + half])
    off = np.abs(by_end).min(axis=0)
    turned = np.abs(np.angle(np.exp(1j * (turn_b - turn_a))))
    meets = (off < ALONG_M) & (aside < ASIDE_M)
    meets &= (turned < TURNED) & (np.abs(v_b - v_a) < FASTER_MPS) & (abs(half) < HALF_LONGER_M)
    one_place = (np.abs(along) < 0.5 * (a.length_m + b.length_m)) & (aside < 2.0 * ASIDE_M)
    if not meets.any() or not one_place.all():
        return None
    at = int(np.argmin(np.where(meets, off + aside, np.inf)))
    end = int(np.argmin(np.abs(by_end[:, at])))
    ahead = (0.0, half, -half)[end]  # by which the second is moved to be as long
    if len(a.rows) < len(b.rows):
        a = with_size(a, b.length_m, -ahead)
    else:
        b = with_size(b, a.length_m, ahead)
    return _switched(posterior, a, b, int(steps[at]))


def _switched(posterior: Posterior, a: Motion, b: Motion, step: int) -> Motion:
    """Return the first motion up to a step, then the second; both are of one size."""
    early, late = np.arange(a.first_step, step + 1.0), np.arange(step, b.last_step + 1.0)
    (s_a, v_a), (s_b, v_b) = a.at(early * STEP_S), b.at(late * STEP_S)
    (ends, _), (begins, _) = a.path.at(s_a[-1:]), b.path.at(s_b[:1])
    heading = float(b.path.heading_at(s_b[:1])[0])
    ahead = float((begins - ends)[0] @ np.array([np.cos(heading), np.sin(heading)]))
    lead = a.path.points[a.path.s_m < s_a[-1] - 0.5]
    rest = b.path.points[b.path.s_m > s_b[0] + 0.5]
    path = Path(np.vstack([lead, 0.5 * (ends + begins), rest]))
    joint = float(path.s_m[len(lead)])
    fade = 0.5 * ahead * np.clip(1.0 - np.arange(len(early) + len(late)) / BLEND_STEPS, 0.0, 1.0)
    s_early = joint + s_a - s_a[-1] - 0.5 * ahead + fade[: len(early)][::-1]
    s_late = joint + s_b - s_b[0] + 0.5 * ahead - fade[: len(late)]
    variance = [
        np.interp(span, np.arange(each.first_step, each.last_step + 1), each.var_s)
        for span, each in ((early, a), (late[1:], b))
    ]
    time = posterior.given.time
    rows = [a.rows[time[a.rows] < step * STEP_S], b.rows[time[b.rows] >= step * STEP_S]]
    motion = replace(
        a if len(a.rows) >= len(b.rows) else b, rows=np.concatenate(rows), path=path,
        first_step=a.first_step, speed=np.concatenate([v_a, v_b[1:]]),
        s_m=np.maximum.accumulate(np.concatenate([s_early, s_late[1:]])),
        var_s=np.concatenate(variance),
    )  # fmt: skip
    along, left, _ = motion.frame(posterior.given, motion.rows)
    return replace(motion, along_m=along, left_m=left)


def _gain(posterior: Posterior, one: int, other: int, joined: Motion) -> float:
    """Return by how much one motion in place of two raises the log-probability."""
    a, b = posterior.motions[one], posterior.motions[other]
    span = (
        (min(b.first_step, a.last_step) - BLEND_STEPS) * STEP_S,
        (max(b.first_step, a.last_step) + BLEND_STEPS) * STEP_S,
    )
    for each in (one, other):
        posterior.lift(each)
    alone = posterior.total.copy()
    two = posterior.gain(a, add=True, within=span) + posterior.gain(b, within=span)
    posterior.total[:] = alone
    single = posterior.gain(joined, within=span)
    for each in (one, other):
        posterior.lift(each, 1.0)
    ends = _end(posterior, one, last=True) + _end(posterior, other, last=False)
    return TOLD * (single - two) + EXISTS + ends


def _end(posterior: Posterior, vehicle: int, *, last: bool) -> float:
    """Return what a vehicle pays for its end or begin in plain view."""
    time, due = posterior.due(vehicle)
    if len(time) == 0:
        return 0.0
    window = window_of(time)
    there = window == (window.max() if last else window.min())
    return float(min(END_SHARE * END_WINDOWS * due[there].sum(), END_MOST))
