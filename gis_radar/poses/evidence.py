"""Evidence of a pose: its accuracy and origin as a pose file states them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gis_radar.base import Floats, InputError

COMPONENTS = ("easting", "northing", "height", "roll", "pitch", "yaw")  # order of a covariance
# Least eigenvalue of a covariance scaled to a unit diagonal; below 0 as files hold rounded numbers.
_LEAST_EIGENVALUE = -1e-6


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Accuracy and origin of a pose as its file states them, parsed and checked.

    Parameters
    ----------
    sigma : mapping of str to float
        One standard deviation by component, metres and degrees; only those that are stated.
    covariance : (6, 6) array or None
        In the order of `COMPONENTS`, metres and radians.
    method : str
        Method that found the pose: `lane`, `icp`, `track`; empty where not stated.
    time : str
        Time of the last frame that the method used, ISO 8601; empty where not stated.
    range_scale_sigma : float
        One standard deviation of the factor on the sensor's ranges; 0 where not stated.
    """

    sigma: Mapping[str, float]
    covariance: Floats | None
    method: str
    time: str
    range_scale_sigma: float = 0.0

    def plane_covariance(self) -> Floats | None:
        """Return the covariance of easting and northing, (2, 2) m^2, or None where not stated."""
        if self.covariance is not None:
            plane = self.covariance[:2, :2]
            return np.asarray((plane + plane.T) / 2)
        if not {"easting", "northing"} <= self.sigma.keys():
            return None
        return np.diag([self.sigma["easting"] ** 2, self.sigma["northing"] ** 2])


def parse_sigma(stated: Any, what: str) -> dict[str, float]:
    """Return the stated standard deviations by component; refuse any that is not >= 0."""
    if stated is None:
        return {}
    if not isinstance(stated, Mapping):
        raise InputError("{}: sigma is {}, expected a number by component", what, repr(stated))
    known = {name: stated[name] for name in COMPONENTS if stated.get(name) is not None}
    return {name: non_negative_sigma(value, name, what) for name, value in known.items()}


def non_negative_sigma(value: Any, name: str, what: str) -> float:
    """Return a stated standard deviation as float; refuse all but finite numbers >= 0."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0.0 <= value < math.inf:
        raise InputError("{}: sigma of {} is {}, expected a number from 0", what, name, repr(value))
    return float(value)


def parse_covariance(stated: Any, what: str) -> Floats | None:
    """Return the stated covariance; refuse all but 6 x 6, symmetric, positive semidefinite."""
    if stated is None:
        return None
    try:
        covariance = np.asarray(stated, dtype=np.float64)
    except (TypeError, ValueError):
        covariance = np.empty(0)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise InputError("{}: covariance is not 6 x 6 finite numbers", what)
    scale = np.sqrt(np.abs(np.diag(covariance))) + 1e-12
    lowest = np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0]
    if not np.allclose(covariance, covariance.T) or lowest < _LEAST_EIGENVALUE:
        raise InputError("{}: covariance is not symmetric and positive", what)
    return covariance
