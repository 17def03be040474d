"""Evidence: how certain an answer is, and in which directions the scene fixes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.registration.solver import Fit
from gis_radar.registration.state import POSE, angles_from_turn
from gis_radar.traces import Samples

STREET_SIGMA_M = (0.25, 0.2)  # of lanes as drawn and driven, and of the scan, from street to street
UNFIXED = np.array([1.0, 1.0, 0.5, *np.radians([2.0, 2.0, 1.0])])


@dataclass(frozen=True, kw_only=True)
class Certainty:
    """How certain a pose is.

    Parameters
    ----------
    covariance : (6, 6) array
        Order easting, northing, height, roll, pitch, yaw; metres and radians.
    noise : (6, 6) array
        The part of it that other vehicles would draw anew; the rest, from map and model, stays.
    sigma : (6,) array
        Its standard deviations.
    eigenvalues : (6,) array
        Of the data's information about the pose, a turn counted as metres at 50 m, ascending.
        Small ones are directions that the scene does not fix.
    observable : bool
        Whether the data fix all six.
    """

    covariance: Floats
    noise: Floats
    sigma: Floats
    eigenvalues: Floats
    observable: bool


def certainty(fit: Fit) -> Certainty:
    """Return how certain a fit is.

    The inverse information, widened where the vehicles disagree more than the model says (a
    cluster-robust covariance with the vehicles as clusters), and by what is not estimated: the
    constants of the model, and the accuracy of map and scan from street to street.

    Parameters
    ----------
    fit : Fit
        A local optimum.
    """
    inverse: Floats = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    noise = _widened(inverse, fit)
    streets = [sigma_m * pull for pull, sigma_m in zip(fit.streets, STREET_SIGMA_M, strict=True)]
    effects = np.vstack([fit.considered(), *streets]) @ inverse
    covariance = noise + effects.T @ effects
    yaw, pitch, _ = fit.state.yaw_pitch_roll
    to_angles = np.eye(6)
    to_angles[3:, 3:] = angles_from_turn(float(yaw), float(pitch))
    pose = to_angles @ covariance[POSE, POSE] @ to_angles.T
    sigma = np.sqrt(np.diag(pose))
    drawn = to_angles @ noise[POSE, POSE] @ to_angles.T
    lever = np.diag([1.0, 1.0, 1.0, 1 / 50.0, 1 / 50.0, 1 / 50.0])
    eigenvalues: Floats = np.asarray(
        np.linalg.eigvalsh(lever @ fit.data_information[POSE, POSE] @ lever), dtype=np.float64
    )
    longest = np.sqrt(np.linalg.eigvalsh(pose[:2, :2])[-1])
    observable = bool((sigma < UNFIXED).all() and longest < UNFIXED[0])
    return Certainty(
        covariance=pose, noise=drawn, sigma=sigma, eigenvalues=eigenvalues, observable=observable
    )


def _widened(inverse: Floats, fit: Fit) -> Floats:
    """Return the covariance that the vehicles' disagreement asks for, never below the model's."""
    root = np.linalg.cholesky((inverse + inverse.T) / 2.0)
    voices = fit.scores[np.abs(fit.scores).sum(axis=1) > 0.0]
    few = len(voices) / max(len(voices) - inverse.shape[0], 1)
    prior = fit.information - fit.data_information
    spread = root.T @ (few * voices.T @ voices + prior) @ root
    values, vectors = np.linalg.eigh((spread + spread.T) / 2.0)
    wide = root @ vectors
    return np.asarray((wide * np.maximum(values, 1.0)) @ wide.T)


def advantage(fit: Fit, other: Fit, samples: Samples) -> float:
    """Return by how many standard deviations the vehicles prefer one fit to another.

    Each vehicle has one voice, the difference of its losses; how the voices scatter about their
    mean tells what the mean is worth (Vuong 1989).

    Parameters
    ----------
    fit, other : Fit
        To the same samples.
    samples : Samples
        Those.
    """
    voices = np.bincount(samples.track, weights=other.loss - fit.loss, minlength=samples.tracks)
    voices = voices[np.unique(samples.track)]
    mean, spread = float(voices.mean()), float(voices.std(ddof=1)) if len(voices) > 1 else 0.0
    if spread <= 0.0:
        return float(np.inf * np.sign(mean)) if mean else 0.0
    return mean * float(np.sqrt(len(voices))) / spread
