"""The start: what a pose file says about where the sensor stands, and how well it knows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import InputError
from gis_radar.localization.result import SIGMA
from gis_radar.poses.pose import Pose
from gis_radar.steps import STEP_S, seconds_from_iso
from gis_radar.tracking.filter import Estimate, Measurement, covariance_from_angles

# of a pose without sigma, as people measure it: metres and degrees in the order of SIGMA
BY_HAND = (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)
NOISE_SHARE = 0.3  # of the variance of a pose that a window gave; the rest is in every window
LEAST = np.array([1e-3, 1e-3, 1e-3, *np.radians([1e-3, 1e-3, 1e-3])])
SAME_MAP = ("lane", "track")  # methods that share the map's errors with ours


def start_estimate(pose: Pose, time: float) -> Estimate:
    """Return a pose as an estimate; its easting and northing are the local (0, 0).

    A pose that was found from the very data that follow knows nothing beyond them: it is where to
    begin, and its uncertainty that of a pose measured by hand.

    Parameters
    ----------
    pose : Pose
        With `covariance` or `sigma` in its evidence, or neither.
    time : float
        UNIX seconds of the first frame.

    Raises
    ------
    InputError
        If covariance or sigma are none.
    """
    evidence = pose.evidence
    found_here = evidence.get("method") in SAME_MAP
    covariance = _covariance(pose)
    if covariance is None or (found_here and _sees(evidence, time, pose.sensor)):
        found_here = False
        sigma = np.array([*BY_HAND[:3], *np.radians(BY_HAND[3:])])
        covariance = np.diag(sigma**2)
    turned = covariance_from_angles(pose.quaternion, covariance) + np.diag(LEAST**2)
    position = np.array([0.0, 0.0, pose.height])
    common = np.zeros((6, 6))
    if found_here:
        measured = Measurement(
            position=position,
            quaternion=pose.quaternion,
            covariance=turned,
            noise=NOISE_SHARE * turned,
        )
        common = -measured.common
    return Estimate(
        time=time,
        position=position,
        quaternion=pose.quaternion,
        covariance=turned,
        common=common,
    )


def _sees(evidence: Any, time: float, sensor: str) -> bool:
    """Tell whether a pose was found from data after a time."""
    if "time" not in evidence:
        return True
    found = seconds_from_iso(str(evidence["time"]), what=f"pose of {sensor}: time")
    return found > time + STEP_S


def _covariance(pose: Pose) -> Floats | None:
    """Return the (6, 6) covariance that a pose states; None where it states none."""
    what = f"pose of {pose.sensor}"
    stated = pose.evidence.get("covariance")
    if stated is not None:
        try:
            covariance = np.asarray(stated, dtype=np.float64)
        except (TypeError, ValueError):
            covariance = np.empty(0)
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise InputError(f"{what}: covariance is not 6 x 6 numbers")
        scaled = np.sqrt(np.abs(np.diag(covariance))) + 1e-12
        lowest = np.linalg.eigvalsh(covariance / np.outer(scaled, scaled))[0]
        if not np.allclose(covariance, covariance.T) or lowest < -1e-6:
            raise InputError(f"{what}: covariance is not symmetric and positive")
        return covariance
    sigma = pose.evidence.get("sigma")
    if not isinstance(sigma, dict) or not sigma:
        return None
    said = [
        _sigma(sigma.get(name, default), f"{what}: sigma of {name}")
        for name, default in zip(SIGMA, BY_HAND, strict=True)
    ]
    return np.diag(np.array([*said[:3], *np.radians(said[3:])]) ** 2)


def _sigma(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
        raise InputError(f"{what} is {value!r}, expected a number from 0")
    return float(value)
