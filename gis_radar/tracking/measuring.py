"""Measuring: what a window says of the pose, taken out of a fit that had a prior."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.arrays import Floats
from gis_radar.registration import Fit, Prior, State, certainty
from gis_radar.registration.state import POSE, SIZE
from gis_radar.tracking.filter import Measurement, covariance_from_angles

LEAST_KNOWN = 0.05  # information less than that share of the prior's is none
UNKNOWN = 1e-4  # and counts as that


def data_alone(fit: Fit, prior: Prior) -> Measurement:
    """Take the prior out of a fit again, or every window would confirm what was believed.

    In coordinates where the prior has variance one along each axis, `1 + m` is the information of
    the fit and `m` that of the data; the data's pose is farther off by `(1 + m) / m`.

    Parameters
    ----------
    fit : Fit
        A registration.
    prior : Prior
        What it began with.
    """
    known = certainty(fit)
    quaternion = _quaternion(fit.state)
    unit = np.diag(prior.information[POSE, POSE]) ** -0.5
    whole, noise = (
        covariance_from_angles(quaternion, part) / np.outer(unit, unit)
        for part in (known.covariance, known.noise)
    )
    values, vectors = np.linalg.eigh(np.linalg.inv(whole))
    data = values - 1.0
    seen = data > LEAST_KNOWN
    away = fit.state.difference(prior.mean)[POSE] / unit
    farther = np.where(seen, values / np.where(seen, data, 1.0), 0.0)
    step = np.zeros(SIZE)
    step[POSE] = unit * (vectors @ (farther * (vectors.T @ away)))
    there = prior.mean.moved(step)
    # what is common to all windows grows not where this one sees nothing
    noise_grows = np.sqrt(values / np.where(seen, data, UNKNOWN))
    common_grows = np.where(seen, noise_grows, 1.0)
    noise, common = (
        _stretched(part, vectors * grows @ vectors.T, unit)
        for part, grows in ((noise, noise_grows), (whole - noise, common_grows))
    )
    return Measurement(
        position=there.position,
        quaternion=_quaternion(there),
        covariance=noise + common,
        noise=noise,
    )


def _stretched(part: Floats, stretch: Floats, unit: Floats) -> Floats:
    wide = stretch @ part @ stretch.T * np.outer(unit, unit)
    return np.asarray((wide + wide.T) / 2.0)


def _quaternion(state: State) -> Floats:
    return np.asarray(Rotation.from_matrix(state.R_map_sensor).as_quat(canonical=True))
