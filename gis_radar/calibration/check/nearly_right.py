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
from gis_radar.calibration.check.rivals import LaneMap, Rival, score, search_poses
from gis_radar.calibration.findings import (
    FITS,
    ONE_PLACE,
    RECORD_MORE,
    UNKNOWN,
    UNKNOWN_CAUSE,
    Finding,
    join_mistakes,
    wrong,
)
from gis_radar.calibration.registration.hypotheses import LOOK_SCALE_M, few_samples
from gis_radar.calibration.registration.solver import cost_at
from gis_radar.calibration.unit_mistakes import LEAST_WRONG, RangeScale, wrong_lengths

TRIED_SIGMAS = np.linspace(-2.0, 2.0, 9)  # tried scales of range, in standard errors of the measure

POSE_OFF, MAY_BE_OFF = Text("its pose is off"), Text("its pose may be off")


def judge_offset(
    excerpt: Excerpt, lanes: LaneMap, finding: Finding, scale: RangeScale | None
) -> Finding:
    """Judge a pose with which most vehicles drive along lanes by the pose fitted to them.

    The finding is that the pose fits, that it is off and by how much, or that the traffic is too
    little as it would not show an error. Where the pose also fits with ranges scaled within the
    error of the measured scale, the finding names both causes.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    finding : Finding
        The finding that most vehicles drive along lanes.
    scale : RangeScale or None
        The measured scale of range.
    """
    fitted = fit_pose(excerpt, lanes)
    if fitted is None:
        return _other_pose_finding(excerpt, lanes, finding.evidence) or _unfitted_finding(finding)
    if not fitted.heights:
        evidence = Text(
            "{}; without heights of map and radar, height and tilt are not compared",
            finding.evidence,
        )
        finding = replace(finding, evidence=evidence)
    offsets = discrepancy(fitted)
    if not offsets:
        return _unless_hidden(hidden(fitted.pose, fitted.seen, fitted.centre), finding)
    offset_finding = _offset_finding(offsets, finding.evidence)
    if scale is None or not any(each.least == OFF_M for each in offsets):
        return offset_finding
    scale_that_fits = _scale_that_fits(excerpt, lanes, fitted, scale)
    if scale_that_fits is None:
        return offset_finding
    findings = offset_finding, wrong_lengths(replace(scale, factor=scale_that_fits))
    cause, advice = join_mistakes((each.cause, each.advice) for each in findings)
    return replace(offset_finding, cause=cause, advice=advice)


def _scale_that_fits(
    excerpt: Excerpt, lanes: LaneMap, fitted: FittedPose, measured: RangeScale
) -> float | None:
    """Return the scale of range, within its error, with which the given pose fits; None if none."""
    few = few_samples(fitted.scene)

    def cost(scale: float) -> float:
        corrected = replace(few.samples, points=few.samples.points / scale)
        return cost_at(few.of(corrected), fitted.centre, scale_m=LOOK_SCALE_M)

    scales: list[float] = (measured.factor + measured.sigma * TRIED_SIGMAS).tolist()
    best = min(scales, key=cost)
    if abs(best - 1.0) <= LEAST_WRONG or not fits_if(excerpt, lanes, Rival(scale=best)):
        return None
    return best


def _unfitted_finding(finding: Finding) -> Finding:
    """Return the finding where no fit converges: the given one if it has a cause, else unknown."""
    if finding.cause:
        return finding
    evidence = Text("{}, but no pose is fitted to them", finding.evidence)
    return replace(finding, verdict=UNKNOWN, evidence=evidence, advice=RECORD_MORE)


def _unless_hidden(hidden_offsets: list[Text], finding: Finding) -> Finding:
    """Return the given finding, or unknown if there are errors that the traffic would not show."""
    if finding.cause or not hidden_offsets:
        return finding
    evidence = Text(
        "{}, but they would do so as well with the sensor off by up to {}",
        finding.evidence, Text(", ").join(hidden_offsets),
    )  # fmt: skip
    crossing = Text("record more traffic, on crossing lanes, too")
    return replace(finding, verdict=UNKNOWN, evidence=evidence, advice=crossing)


def _offset_finding(offsets: list[Off], evidence: str) -> Finding:
    """Return the finding that the pose is off, or may be off where no offset is too far."""
    texts, corrections = (
        Text(", ").join(getattr(each, part) for each in offsets) for part in ("text", "right")
    )
    stated = Text("{}; they do so best with the sensor {}", evidence, texts)
    advice = Text("set {} in its pose, or find it with gis-radar localize", corrections)
    if not any(each.too_far for each in offsets):
        return Finding(sensor="", verdict=FITS, evidence=stated, cause=MAY_BE_OFF, advice=advice)
    return wrong(stated, POSE_OFF, advice)


def _other_pose_finding(excerpt: Excerpt, lanes: LaneMap, evidence: str) -> Finding | None:
    """Return the finding that a search finds another pose; None where it finds none far off."""
    pose, tried = excerpt.usual, scored(excerpt, lanes, search_poses(excerpt, lanes))
    likeliest_rival = likeliest(excerpt, score(excerpt, lanes), tried, FOUND_SHARE)[:1]
    for rival, rival_score in likeliest_rival:
        off_m, turn = rival.off(pose)
        if off_m > TOO_FAR * OFF_M or abs(turn) > TOO_FAR * OFF_DEG[0]:
            if_so = Text("{}, {:.0%} after this correction", evidence, rival_score.share)
            if rival.assumes_two_mistakes(pose):
                return wrong(if_so, UNKNOWN_CAUSE, ONE_PLACE)
            return wrong(if_so, rival.cause, rival.advice)
    return None
