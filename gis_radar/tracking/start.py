"""The start: what a pose file says about where the sensor stands, and how well it knows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.poses.evidence import COMPONENTS, Evidence
from gis_radar.poses.pose import Pose
from gis_radar.steps import STEP_S, seconds_from_iso
from gis_radar.tracking.filter import Estimate, Measurement, covariance_from_angles

# of a pose without sigma, as people measure it: metres and degrees in the order of COMPONENTS
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
    evidence = pose.parsed_evidence()
    found_here = evidence.method in SAME_MAP
    covariance = _stated_covariance(evidence)
    if covariance is None or (found_here and _sees(evidence, time, pose.sensor)):
        found_here = False
        covariance = _diagonal(BY_HAND)
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


def _sees(evidence: Evidence, time: float, sensor: str) -> bool:
    """Tell whether a pose was found from data after a time."""
    if not evidence.time:
        return True
    found = seconds_from_iso(evidence.time, what=f"pose of {sensor}: time")
    return found > time + STEP_S


def _stated_covariance(evidence: Evidence) -> Floats | None:
    """Return the (6, 6) covariance of a pose, where sigma lacks a component by hand's; or None."""
    if evidence.covariance is not None or not evidence.sigma:
        return evidence.covariance
    return _diagonal([evidence.sigma.get(n, s) for n, s in zip(COMPONENTS, BY_HAND, strict=True)])


def _diagonal(sigma: Sequence[float]) -> Floats:
    """Return the covariance, m and rad, of standard deviations in m and degrees."""
    return np.diag(np.array([*sigma[:3], *np.radians(sigma[3:])]) ** 2)
