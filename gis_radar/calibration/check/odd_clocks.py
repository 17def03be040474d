"""Find odd clocks: sensors that see the vehicles of a common view at different times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from gis_radar.base import NoAnswerError, Text
from gis_radar.calibration.findings import CLOCKS_APART, Finding, wrong
from gis_radar.calibration.timing.clock_offsets import ClockOffset, measured_offset
from gis_radar.calibration.timing.lane_detections import LaneDetections

CLOCK_S, CLOCK_SIGMAS = 0.3, 5.0  # largest offset in a common view: a car's length and more
PARTNERS = 3  # comparisons that suffice for a sensor: two of them are the majority


def odd_clocks(seen: Mapping[str, LaneDetections]) -> dict[str, Finding]:
    """Return the findings on sensors whose clock is off those of sensors with a common view.

    Parameters
    ----------
    seen : mapping of str to LaneDetections
        Detections that move along lanes, by sensor.
    """
    odd: dict[str, list[tuple[str, float, float]]] = {}
    for (one, other), offset in clock_offsets_between(seen).items():
        if abs(offset.offset_s) > max(CLOCK_S, CLOCK_SIGMAS * offset.sigma_s):
            odd.setdefault(one, []).append((other, -offset.offset_s, offset.sigma_s))
            odd.setdefault(other, []).append((one, offset.offset_s, offset.sigma_s))
    told = dict[str, Finding]()
    while odd:  # the sensor with most contradictions is off; of two alone, either may be
        most = max(map(len, odd.values()))
        named = {name for name, pairs in odd.items() if len(pairs) == most}
        told |= {name: _apart(name, *odd[name][0]) for name in named}
        odd = {
            key: left
            for key, pairs in odd.items()
            if key not in named and (left := [each for each in pairs if each[0] not in named])
        }
    return dict(sorted(told.items()))


def clock_offsets_between(seen: Mapping[str, LaneDetections]) -> dict[tuple[str, str], ClockOffset]:
    """Measure the clock of each sensor against those that see most of its places.

    Two sensors with `PARTNERS` each are compared only where no chain of comparisons links them yet,
    as with two recorders: a comparison takes a second, and a hundred sensors of one view make five
    thousand pairs.

    Parameters
    ----------
    seen : mapping of str to LaneDetections
        What moved along lanes, by sensor.

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
    found, partners = dict[tuple[str, str], ClockOffset](), Counter[str]()
    linked = {name: {name} for name in seen}
    for one, other in sorted(shared, key=lambda pair: -shared[pair]):
        if other in linked[one] and min(partners[one], partners[other]) >= PARTNERS:
            continue
        try:
            found[one, other] = measured_offset(seen[one], seen[other])
        except NoAnswerError:  # no common view
            continue
        partners.update((one, other))
        linked |= dict.fromkeys(joined := linked[one] | linked[other], joined)
    return found


def _apart(name: str, other: str, ahead_s: float, sigma_s: float) -> Finding:
    ahead = Text(
        "by vehicles that both see, this one is {:.2f} \u00b1 {:.2f} s ahead", ahead_s, sigma_s
    )
    behind = Text(
        "by vehicles that both see, this one is {:.2f} \u00b1 {:.2f} s behind", -ahead_s, sigma_s
    )
    evidence = ahead if ahead_s > 0.0 else behind
    cause = Text(CLOCKS_APART, other)
    found = wrong(evidence, cause, Text("find the offset with gis-radar clocks"))
    return replace(found, sensor=name)
