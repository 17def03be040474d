"""Judge a pose that nearly fits: whether it is off, and whether the traffic would show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gis_radar.base import Text
from gis_radar.calibration.check.evidence import LaneMap, score
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.explanations import FOUND_SHARE, best_mistakes, explained
from gis_radar.calibration.check.fitted_pose import (
    OFF_DEG,
    OFF_M,
    TOO_FAR,
    FittedPose,
    Off,
    discrepancy,
    fit_pose,
    fits_if,
    hidden,
)
from gis_radar.calibration.check.mistakes import Mistake, search_poses
from gis_radar.calibration.findings import (
    FITS,
    RECORD_MORE,
    UNKNOWN,
    WRONG,
    Cause,
    Finding,
    judged,
)
from gis_radar.calibration.registration.hypotheses import LOOK_SCALE_M, few_samples
from gis_radar.calibration.registration.solver import cost_at
from gis_radar.calibration.unit_mistakes import LEAST_WRONG, RangeScale

# Tried scales of range, in standard errors of the measure
_TRIED_SIGMAS = np.linspace(-2.0, 2.0, 9)


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
        return _unfitted(excerpt, lanes, finding)
    if not fitted.heights:
        evidence = Text(
            "{}; without heights of map and radar, height and tilt are not compared",
            finding.evidence,
        )
        finding = replace(finding, evidence=evidence)
    offs = discrepancy(fitted)
    if offs:
        evidence, verdict, cause = _stated(offs, finding.evidence)
        by_ranges = scale is not None and any(each.least == OFF_M for each in offs)
        lengths = _fitting_scale(excerpt, lanes, fitted, scale) if scale and by_ranges else ()
        return judged(verdict, evidence, cause, *lengths)
    open_errors = hidden(fitted.pose, fitted.seen, fitted.centre)
    if finding.cause or not open_errors:
        return finding
    evidence = Text(
        "{}, but they would do so as well with the sensor off by up to {}",
        finding.evidence, Text(", ").join(open_errors),
    )  # fmt: skip
    return judged(UNKNOWN, evidence, Cause("", Text("record more traffic, on crossing lanes, too")))


def _fitting_scale(
    excerpt: Excerpt, lanes: LaneMap, fitted: FittedPose, measured: RangeScale
) -> tuple[Cause, ...]:
    """Return as causes the scale of range, within its error, with which the given pose fits."""
    few = few_samples(fitted.scene)

    def cost(factor: float) -> float:
        scaled = replace(few.samples, points=few.samples.points / factor)
        return cost_at(few.of(scaled), fitted.centre, scale_m=LOOK_SCALE_M)

    factors: list[float] = (measured.factor + measured.sigma * _TRIED_SIGMAS).tolist()
    best = min(factors, key=cost)
    if abs(best - 1.0) <= LEAST_WRONG or not fits_if(excerpt, lanes, Mistake(scale=best)):
        return ()
    return replace(measured, factor=best).causes


def _stated(offs: list[Off], evidence: str) -> tuple[Text, str, Cause]:
    """Return evidence, verdict and cause of a pose that is off, or may be where nothing is far."""
    texts, corrections = (
        Text(", ").join(getattr(each, part) for each in offs) for part in ("text", "right")
    )
    far = any(each.too_far for each in offs)
    cause = Cause(
        Text("its pose is off") if far else Text("its pose may be off"),
        Text("set {} in its pose, or find it with gis-radar localize", corrections),
    )
    stated = Text("{}; they do so best with the sensor {}", evidence, texts)
    return stated, WRONG if far else FITS, cause


def _unfitted(excerpt: Excerpt, lanes: LaneMap, finding: Finding) -> Finding:
    """Return the finding where no fit converges: another pose that a search finds far off, or none.

    Then it is the given one if it has a cause, else unknown.
    """
    given, poses = score(excerpt, lanes), search_poses(excerpt, lanes)
    found = best_mistakes(excerpt, lanes, given, poses, FOUND_SHARE)[:1]
    for mistake, _ in found:
        off_m, turn = mistake.off(excerpt.usual)
        if off_m > TOO_FAR * OFF_M or abs(turn) > TOO_FAR * OFF_DEG[0]:
            return explained(excerpt, finding.evidence, found)
    if finding.cause:
        return finding
    evidence = Text("{}, but no pose is fitted to them", finding.evidence)
    return judged(UNKNOWN, evidence, Cause("", RECORD_MORE))
