"""Judge a pose that nearly fits: whether it is off, and whether the traffic would show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gis_radar.base import Text
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.explanations import FOUND_SHARE, likeliest, scored
from gis_radar.calibration.check.fitted_pose import FittedPose, fit_pose
from gis_radar.calibration.check.offsets import (
    OFF_DEG,
    OFF_M,
    TOO_FAR,
    Off,
    discrepancy,
    fits_if,
    hidden,
)
from gis_radar.calibration.check.rivals import (
    LaneMap,
    Rival,
    found_poses,
    score,
)
from gis_radar.calibration.findings import (
    FITS,
    ONE_PLACE,
    RECORD_MORE,
    UNKNOWN,
    UNKNOWN_CAUSE,
    Finding,
    either,
    wrong,
)
from gis_radar.calibration.registration.hypotheses import LOOK_SCALE_M, few_samples
from gis_radar.calibration.registration.solver import cost_at
from gis_radar.calibration.unit_mistakes import LEAST_WRONG, RangeScale, lengthened

OPEN = np.linspace(-2.0, 2.0, 9)  # standard errors from a measured scale of range that are tried

POSE_OFF, MAY_BE_OFF = Text("its pose is off"), Text("its pose may be off")


def pose_off(excerpt: Excerpt, lanes: LaneMap, found: Finding, scale: RangeScale | None) -> Finding:
    """Return how far a pose that nearly fits is off, or whether the traffic would show that.

    Ranges may be too long instead where the pose is right with a scale of range within its error.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    found : Finding
        The finding that most vehicles drive along lanes.
    scale : RangeScale or None
        The measured scale of range.
    """
    fitted = fit_pose(excerpt, lanes)
    if fitted is None:
        return _elsewhere(excerpt, lanes, found.evidence) or _unfitted(found)
    if not fitted.heights:
        evidence = Text(
            "{}; without heights of map and radar, height and tilt are not compared", found.evidence
        )
        found = replace(found, evidence=evidence)
    off = discrepancy(fitted)
    if not off:
        return _shown(hidden(fitted.pose, fitted.seen, fitted.centre), found)
    told = _told(off, found.evidence)
    if scale is None or not any(each.least == OFF_M for each in off):
        return told
    other = _scale_instead(excerpt, lanes, fitted, scale)
    if other is None:
        return told
    both = told, lengthened(replace(scale, factor=other))
    cause, advice = either((each.cause, each.advice) for each in both)
    return replace(told, cause=cause, advice=advice)


def _scale_instead(
    excerpt: Excerpt, lanes: LaneMap, fitted: FittedPose, measured: RangeScale
) -> float | None:
    """Return a scale of range within its error with which the given pose fits, if any."""
    few = few_samples(fitted.scene)

    def cost(scale: float) -> float:
        shorter = replace(few.samples, points=few.samples.points / scale)
        return cost_at(few.of(shorter), fitted.centre, scale_m=LOOK_SCALE_M)

    scales: list[float] = (measured.factor + measured.sigma * OPEN).tolist()
    best = min(scales, key=cost)
    if abs(best - 1.0) <= LEAST_WRONG or not fits_if(excerpt, lanes, Rival(scale=best)):
        return None
    return best


def _unfitted(found: Finding) -> Finding:
    """Return the finding for a pose around which no fit converges: doubt stays, else unknown."""
    if found.cause:
        return found
    evidence = Text("{}, but no pose is fitted to them", found.evidence)
    return replace(found, verdict=UNKNOWN, evidence=evidence, advice=RECORD_MORE)


def _shown(open_by: list[Text], found: Finding) -> Finding:
    """Return that a pose fits, or unknown where the traffic would not show an error."""
    if found.cause or not open_by:
        return found
    evidence = Text(
        "{}, but they would do so as well with the sensor off by up to {}",
        found.evidence, Text(", ").join(open_by),
    )  # fmt: skip
    crossing = Text("record more traffic, on crossing lanes, too")
    return replace(found, verdict=UNKNOWN, evidence=evidence, advice=crossing)


def _told(off: list[Off], evidence: str) -> Finding:
    """Return the finding that the pose is off."""
    by, right = (Text(", ").join(getattr(each, part) for each in off) for part in ("text", "right"))
    put = Text("{}; they do so best with the sensor {}", evidence, by)
    advice = Text("set {} in its pose, or find it with gis-radar localize", right)
    if not any(each.too_far for each in off):
        return Finding(sensor="", verdict=FITS, evidence=put, cause=MAY_BE_OFF, advice=advice)
    return wrong(put, POSE_OFF, advice)


def _elsewhere(excerpt: Excerpt, lanes: LaneMap, evidence: str) -> Finding | None:
    """Return the finding that a search finds another pose where no fit near it converges."""
    pose, tried = excerpt.usual, scored(excerpt, lanes, found_poses(excerpt, lanes))
    best = likeliest(excerpt, score(excerpt, lanes), tried, FOUND_SHARE)[:1]
    for rival, each in best:
        off_m, turn = rival.off(pose)
        if off_m > TOO_FAR * OFF_M or abs(turn) > TOO_FAR * OFF_DEG[0]:
            if_so = Text("{}, {:.0%} after this correction", evidence, each.share)
            if rival.twofold(pose):
                return wrong(if_so, UNKNOWN_CAUSE, ONE_PLACE)
            return wrong(if_so, rival.cause, rival.advice)
    return None
