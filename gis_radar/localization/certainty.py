"""How certain a fit is: covariance, unobservable directions, and lead over another fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.localization.lanes import Lanes
from gis_radar.localization.model import Model
from gis_radar.localization.solver import Fit, Prior, solve
from gis_radar.localization.state import POSE, SIZE, angles_from_turn
from gis_radar.localization.traces import Samples

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


PLANE, LEVER_M = [0, 1, 5], np.array([1.0, 1.0, 50.0])  # a turn moves what is 50 m away
STEPS_M = (2.0, 4.0, 8.0, 16.0)
LEAST_RISE, CLEAR_RISE = 0.5, 50.0  # of the cost: one and ten standard deviations away
SCALES_M, ROUNDS = (0.3, 0.0), 4


def along_valley(lanes: Lanes, samples: Samples, fit: Fit, prior: Prior, model: Model) -> Fit:
    """Lower a fit's information along its weakest way in the plane to what lies far off tells.

    Along a bend of constant curvature, or a straight road, a recording slides with hardly a
    change of cost, over small dimples that each look like an answer. Several metres away along
    the valley, all else fitted anew, the cost must have risen as the curvature says (profile
    likelihood); where it has not, the deviation is as large as the least rise tells.

    Parameters
    ----------
    lanes, samples : Lanes, Samples
        The map and the traces.
    fit : Fit
        A local optimum for these samples.
    prior, model : Prior, Model
        With which it was found.
    """
    hold, way = _weakest(fit)
    curved_m = float(np.sqrt(hold @ way))
    sigma_m = max(
        _deviation(lanes, samples, fit, side * way / curved_m**2, hold, prior, model)
        for side in (-1.0, 1.0)
    )
    if sigma_m <= curved_m:
        return fit
    lost = (curved_m**-2 - sigma_m**-2) * np.outer(hold, hold)
    return replace(
        fit,
        information=fit.information - lost,
        data_information=fit.data_information - lost,
    )


def _weakest(fit: Fit) -> tuple[Floats, Floats]:
    """Return the measure, metres, that a fit knows least, and its covariance with the state."""
    covariance: Floats = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    _, vectors = np.linalg.eigh(LEVER_M[:, None] * covariance[np.ix_(PLANE, PLANE)] * LEVER_M)
    hold = np.zeros(SIZE)
    hold[PLANE] = LEVER_M * vectors[:, -1]
    return hold, covariance @ hold


def _deviation(
    lanes: Lanes, samples: Samples, fit: Fit, way: Floats, hold: Floats, prior: Prior, model: Model
) -> float:
    """Return the largest standard deviation, metres, that the cost along a valley tells."""
    sigma_m, here, at_m = 0.0, fit, 0.0
    for step_m in STEPS_M:
        start = here.state.moved((step_m - at_m) * way)
        here = solve(
            lanes,
            samples,
            start,
            prior,
            scales_m=SCALES_M,
            rounds=ROUNDS,
            model=model,
            hold=hold,
        )
        at_m = step_m
        rise = max(here.cost - fit.cost, LEAST_RISE)
        if rise > CLEAR_RISE:
            continue  # this place is out of the question, however far it is
        sigma_m = max(sigma_m, step_m / float(np.sqrt(2.0 * rise)))
    return sigma_m
