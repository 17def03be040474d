"""Find wrong clocks: sensors that see the same vehicles at the same places at different times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np

from gis_radar.base import NoAnswerError, Text
from gis_radar.calibration.check.evidence import LaneMap
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.findings import CLOCKS_APART, Cause, Finding, wrong
from gis_radar.calibration.timing.clock_offsets import ClockOffset, measured_offset
from gis_radar.calibration.timing.lane_detections import LaneDetections, placed_on_lanes

# Clocks contradict each other from this offset on; a car drives its length in it.
CONTRADICTION_S, _CLOCK_SIGMAS = 0.3, 5.0
_LEAST_PART = 1.0 / 3.0  # of the detections: less has too few vehicles
# Of a third: the other sensor has so many at the same times if no clock was set
_LEAST_SHARED = 0.5
_PARTNERS = 3  # comparisons that suffice for a sensor: two of them are the majority


def odd_clocks(seen: Mapping[str, LaneDetections]) -> dict[str, Finding]:
    """Return the findings on sensors whose clock contradicts those of sensors with a common view.

    The sensor with most contradictions is off; of two that contradict each other alone, both are
    named.

    Parameters
    ----------
    seen : mapping of str to LaneDetections
        Detections that move along lanes, by sensor.
    """
    contradictions: dict[str, list[tuple[str, float, float]]] = {}
    for (one, other), offset in clock_offsets_between(seen).items():
        if _excess(offset) > 1.0:
            contradictions.setdefault(one, []).append((other, -offset.offset_s, offset.sigma_s))
            contradictions.setdefault(other, []).append((one, offset.offset_s, offset.sigma_s))
    findings = dict[str, Finding]()
    while contradictions:
        most = max(map(len, contradictions.values()))
        blamed = {name for name, pairs in contradictions.items() if len(pairs) == most}
        findings |= {name: _clocks_apart(name, *contradictions[name][0]) for name in blamed}
        contradictions = {
            key: remaining
            for key, pairs in contradictions.items()
            if key not in blamed
            and (remaining := [each for each in pairs if each[0] not in blamed])
        }
    return dict(sorted(findings.items()))


def clock_offsets_between(seen: Mapping[str, LaneDetections]) -> dict[tuple[str, str], ClockOffset]:
    """Measure clock offsets between sensors, those with most common places first.

    Two sensors that have `_PARTNERS` comparisons each are compared only if no chain of comparisons
    links them yet: a comparison takes a second, and a hundred sensors make five thousand pairs.

    Parameters
    ----------
    seen : mapping of str to LaneDetections
        Detections that move along lanes, by sensor.

    Returns
    -------
    dict
        By (one, other), how far the clock of `other` is ahead of that of `one`.
    """
    places = {name: np.unique(each.places) for name, each in seen.items()}
    shared = {
        (one, other): len(np.intersect1d(places[one], places[other], assume_unique=True))
        for one, other in combinations(seen, 2)
    }
    offsets, partners = dict[tuple[str, str], ClockOffset](), Counter[str]()
    linked = {name: {name} for name in seen}
    for one, other in sorted(shared, key=lambda pair: -shared[pair]):
        if other in linked[one] and min(partners[one], partners[other]) >= _PARTNERS:
            continue
        found = _offset_between(seen[one], seen[other])
        if found is None:  # no common view
            continue
        offsets[one, other] = found
        partners.update((one, other))
        linked |= dict.fromkeys(chain := linked[one] | linked[other], chain)
    return offsets


def _offset_between(one: LaneDetections, other: LaneDetections) -> ClockOffset | None:
    """Return the offset that contradicts most: of all times, of the first third, or of the last.

    A clock that was set on the way contradicts the other one in a part. None without any offset.
    """
    if len(one) == 0 or len(other) == 0:
        return None
    found = list[ClockOffset]()
    for pair in ((one, other), _parts(one, other, 0.0), _parts(one, other, 1.0 - _LEAST_PART)):
        with suppress(NoAnswerError):
            found.append(measured_offset(*pair))
    return max(found, key=_excess, default=None)


def _parts(
    one: LaneDetections, other: LaneDetections, begin: float
) -> tuple[LaneDetections, LaneDetections]:
    """Return a third of the detections of both sensors, which begins at a share of them.

    It is of the same times if both recorded then: where one falls silent, their own thirds are of
    other times, at which traffic may look alike, one cycle of signals later. It is each one's own
    third if neither recorded at the times of the other's, as where a clock was set by an hour.
    """
    thirds = [
        each.take(np.arange(int(begin * len(each)), int((begin + _LEAST_PART) * len(each))))
        for each in (one, other)
    ]
    share, best = 0.0, (thirds[0], thirds[1])
    for third in (each for each in thirds if len(each) > 0):
        pair = _within(one, third), _within(other, third)
        if min(map(len, pair)) > max(share, _LEAST_SHARED) * len(third):
            share, best = min(map(len, pair)) / len(third), pair
    return best


def _within(seen: LaneDetections, part: LaneDetections) -> LaneDetections:
    """Return the detections at the times of a part."""
    first, last = part.time[[0, -1]]
    return seen.take(np.flatnonzero((seen.time >= first) & (seen.time <= last)))


def _excess(offset: ClockOffset) -> float:
    """Return an offset as a multiple of the least one that contradicts, given its error."""
    return abs(offset.offset_s) / max(CONTRADICTION_S, _CLOCK_SIGMAS * offset.sigma_s)


def _clocks_apart(name: str, other: str, ahead_s: float, sigma_s: float) -> Finding:
    """Return the finding that a sensor's clock is ahead of another's, or behind."""
    amount = abs(ahead_s), sigma_s
    evidence = Text("by vehicles that both see, this one is {:.2f} \u00b1 {:.2f} s behind", *amount)
    if ahead_s > 0.0:
        evidence = Text(
            "by vehicles that both see, this one is {:.2f} \u00b1 {:.2f} s ahead", *amount
        )
    advice = Text("find the offset with gis-radar clocks, or cut the recording where it was set")
    return replace(wrong(evidence, Cause(Text(CLOCKS_APART, other), advice)), sensor=name)


def on_lanes(excerpt: Excerpt, lanes: LaneMap) -> LaneDetections:
    """Return the detections that move along lanes, for the comparison of clocks.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    """
    moving, by_pose = excerpt.moving, list[LaneDetections]()
    for number, pose in enumerate(excerpt.poses):
        rows, near = excerpt.moving_pose == number, lanes.around(pose, excerpt.reach_m)
        if near is None:
            continue
        by_pose.append(
            placed_on_lanes(
                near, moving.time[rows], moving.points[rows], moving.range_rate[rows], pose
            )
        )
    detections = LaneDetections.joined(by_pose)
    return detections.take(np.argsort(detections.time, kind="stable"))
