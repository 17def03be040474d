"""Covariances of poses: what they state, and how the rest of a pose follows its place and yaw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.calibration.certainty import PLANE as IN_POSE
from gis_radar.calibration.certainty import is_fixed
from gis_radar.calibration.settings import AnswerSettings
from gis_radar.errors import NoAnswerError
from gis_radar.poses.pose import COMPONENTS, Pose

Names = tuple[str, str]


def plane_covariance(pose: Pose) -> Floats:
    """Return the covariance of easting, northing (m) and yaw (radians), (3, 3)."""
    return stated_covariance(pose)[np.ix_(IN_POSE, IN_POSE)]


def stated_covariance(pose: Pose) -> Floats:
    """Return the (6, 6) covariance that a pose states.

    Raises
    ------
    NoAnswerError
        If it states none.
    """
    covariance = pose.parsed_evidence().covariance
    if covariance is None:
        raise NoAnswerError(
            f"{pose.sensor}: its pose states no covariance", hint="localize it with --method lane"
        )
    return covariance


def longest_m(covariance: Floats) -> float:
    """Return the standard deviation along the direction that is known worst."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


def moved(pose: Pose, step: Floats) -> Pose:
    """Return a pose after a step of easting, northing, yaw; the rest follows its covariance."""
    covariance = stated_covariance(pose)
    known = covariance[np.ix_(IN_POSE, IN_POSE)]
    whole = covariance[:, IN_POSE] @ np.linalg.solve(known, step)
    whole[IN_POSE] = step
    east, north, up, roll, pitch, yaw = (float(v) for v in whole)
    turned = pose.yaw + math.degrees(yaw)
    return replace(
        pose,
        easting=pose.easting + east,
        northing=pose.northing + north,
        height=pose.height + up,
        roll=pose.roll + math.degrees(roll),
        pitch=pose.pitch + math.degrees(pitch),
        yaw=(turned + 180.0) % 360.0 - 180.0,
    )


def with_gain(
    pose: Pose, plane: Floats, name: str, pairs: Mapping[Names, int], settings: AnswerSettings
) -> Pose:
    """Return a pose with its new covariance, and what it gained by whom."""
    before = stated_covariance(pose)
    known = before[np.ix_(IN_POSE, IN_POSE)]
    share = before[:, IN_POSE] @ np.linalg.inv(known)
    after = before + share @ (plane - known) @ share.T
    after = (after + after.T) / 2.0
    units = np.array([1.0] * 3 + [math.degrees(1.0)] * 3)
    old, new = (np.sqrt(np.diag(each)) * units for each in (before, after))
    others = sorted({each for pair in pairs for each in pair} - {name})
    gained = {COMPONENTS[i]: {"before": float(old[i]), "after": float(new[i])} for i in IN_POSE}
    evidence = {
        **pose.evidence,
        "sigma": {each: float(value) for each, value in zip(COMPONENTS, new, strict=True)},
        "covariance": after.tolist(),
        "observable": is_fixed(after, settings),
        "together": {"sensors": others, "pairs": sum(pairs.values()), "gained": gained},
    }
    return replace(pose, evidence=evidence)
