"""Evidence of a pose: how well it is known, how and when it was found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import InputError

COMPONENTS = ("easting", "northing", "height", "roll", "pitch", "yaw")  # order of a covariance
LEAST_EIGENVALUE = -1e-6  # of a covariance scaled to a unit diagonal; files round decimals


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What a pose file states of a pose beside the pose itself, parsed and checked.

    Parameters
    ----------
    sigma : mapping of str to float
        One standard deviation by component, metres and degrees; only those that are stated.
    covariance : (6, 6) array or None
        In the order of `COMPONENTS`, metres and radians.
    method : str
        How the pose was found: `lane`, `icp`, `track`; empty where not stated.
    time : str
        Time of the last frame it was found from, ISO 8601; empty where not stated.
    """

    sigma: Mapping[str, float]
    covariance: Floats | None
    method: str
    time: str

    def plane_covariance(self) -> Floats | None:
        """Return the covariance of easting and northing, (2, 2) m^2, or None where not stated."""
        if self.covariance is not None:
            plane = self.covariance[:2, :2]
            return np.asarray((plane + plane.T) / 2)
        if not {"easting", "northing"} <= self.sigma.keys():
            return None
        return np.diag([self.sigma["easting"] ** 2, self.sigma["northing"] ** 2])


def parse_evidence(record: Mapping[str, Any], *, what: str) -> Evidence:
    """Parse and check the evidence in a pose file.

    Parameters
    ----------
    record : mapping
        The contract's fields.
    what : str
        Where the record comes from; begins error messages.

    Raises
    ------
    InputError
        If the covariance is not 6 x 6 finite numbers, symmetric and positive, or a sigma is not a
        number from 0.
    """
    return Evidence(
        sigma=_parse_sigma(record.get("sigma"), what),
        covariance=_parse_covariance(record.get("covariance"), what),
        method=str(record.get("method") or ""),
        time=str(record.get("time") or ""),
    )


def _parse_sigma(stated: Any, what: str) -> dict[str, float]:
    if stated is None:
        return {}
    if not isinstance(stated, Mapping):
        raise InputError(f"{what}: sigma is {stated!r}, expected a number by component")
    known = {name: stated[name] for name in COMPONENTS if stated.get(name) is not None}
    for name, value in known.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not 0.0 <= value < math.inf:
            raise InputError(f"{what}: sigma of {name} is {value!r}, expected a number from 0")
    return {name: float(value) for name, value in known.items()}


def _parse_covariance(stated: Any, what: str) -> Floats | None:
    if stated is None:
        return None
    try:
        covariance = np.asarray(stated, dtype=np.float64)
    except (TypeError, ValueError):
        covariance = np.empty(0)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise InputError(f"{what}: covariance is not 6 x 6 finite numbers")
    scale = np.sqrt(np.abs(np.diag(covariance))) + 1e-12
    lowest = np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0]
    if not np.allclose(covariance, covariance.T) or lowest < LEAST_EIGENVALUE:
        raise InputError(f"{what}: covariance is not symmetric and positive")
    return covariance
