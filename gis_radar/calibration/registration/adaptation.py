"""Adapt prior and model to a recording's radar and vehicles, given a fit near the optimum."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.special import gammaincinv, ndtr

from gis_radar.base import Floats, Integers
from gis_radar.calibration.registration.lanes import Placed, Scene, place
from gis_radar.calibration.registration.model import Model
from gis_radar.calibration.registration.residuals import (
    LaneComparison,
    assemble,
    height,
    height_over_road,
    lateral,
)
from gis_radar.calibration.registration.solver import Fit, Prior
from gis_radar.calibration.registration.state import REFLECTION
from gis_radar.calibration.registration.traces import SPELL_S, Samples

# Lower edge of reflections over the road and 1 sigma of it: ground clearance is 0.12 to 0.3 m.
_EDGE_M = 0.2
_EDGE_SIGMA_M = 0.07
# Nodes of the quadrature over the gamma distribution of heights above the edge.
_NODES = gammaincinv(2.0, (np.arange(16) + 0.5) / 16)
# Share of reflections that come from bodies, and their lowest and highest height above the edge.
_TALL_SHARE = 0.2
_TALL_M = (0.2, 2.8)
# Share of outliers, and the interval of heights over which they are uniform.
_STRAY_HEIGHTS = 0.05
_STRAY_M = 8.0
_NEAR_M = 80.0  # farther samples are left out: 0.6 degrees are 0.8 m there
_MOST_SAMPLES = 1500  # more do not improve the estimate
NOISE_M = 0.05  # 1 sigma of the heights of scan and map
# Edge (m), scale (m) and elevation noise (radians): start of the fit, and its bounds.
START = (0.2, 0.2, math.radians(0.5))
_LOWER_BOUND = (-1.5, 0.05, math.radians(0.1))
_UPPER_BOUND = (2.0, 0.6, math.radians(2.0))
LEAST_SAMPLES = 200  # least number of samples within _NEAR_M to estimate heights
# Number of tried factors on the side strength, from 1 / MOST_FACTOR to MOST_FACTOR.
_FACTORS = 17
MOST_FACTOR = 4.0
_FACTOR_SIGMA = math.log(2.0)  # 1 sigma of the logarithm of such a factor in the prior
_DERIVATIVE_STEP = 1e-4  # of numerical derivatives
# Tried shares of the elevation's variance that are correlated; iterations of the random effects.
_BENT_SHARES: tuple[float, ...] = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
_EFFECT_ROUNDS = 4


@dataclass(frozen=True, kw_only=True)
class Heights:
    """Distribution of the heights of reflections.

    Parameters
    ----------
    mean_m, sigma_m : float
        Mean height of reflections from bumpers, sills and wheels over the road, and its 1 sigma.
    elevation : float
        One standard deviation of the radar's elevation angles, radians.
    """

    mean_m: float
    sigma_m: float
    elevation: float


def adapted(scene: Scene, fit: Fit, prior: Prior, model: Model) -> tuple[Prior, Model]:
    """Return prior and model adapted to the radar and the vehicles of a recording.

    The model gets the estimated strength of sides and errors of elevation, the prior the estimated
    mean height of reflections.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    fit : Fit
        A fit near the optimum.
    prior, model : Prior, Model
        Those of that fit.
    """
    model = replace(model, side_strength=side_strength(scene, fit, model))
    found = heights(scene, fit)
    if found is None:
        return prior, model
    model = split_elevation_noise(scene, fit, replace(model, elevation=found.elevation))
    found = heights(scene, fit, weight=_independent_weights(scene.samples, model)) or found
    information, known = prior.information.copy(), prior.information[REFLECTION, REFLECTION]
    information[REFLECTION, REFLECTION] = known + found.sigma_m**-2
    weighted = known * prior.mean.reflection + found.mean_m * found.sigma_m**-2
    mean = replace(prior.mean, reflection=float(weighted / information[REFLECTION, REFLECTION]))
    prior = Prior(mean=mean, information=information)
    return prior, model


def split_elevation_noise(scene: Scene, fit: Fit, model: Model) -> Model:
    """Split a model's elevation noise into an independent part and one correlated over seconds.

    The split of highest likelihood is taken, with the random effects of the vehicles integrated out
    (Laplace's method).

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    fit : Fit
        A fit near the optimum.
    model : Model
        Its `elevation` is the total noise of the elevation angles.
    """
    placed = place(scene.samples, fit.state)
    models = [
        replace(
            model,
            elevation=model.elevation * float(np.sqrt(1.0 - share)),
            bent=model.elevation * float(np.sqrt(share)),
        )
        for share in _BENT_SHARES
    ]

    def cost(tried: Model) -> float:
        compared = _comparison(scene, fit, placed, tried)
        effect = np.zeros_like(fit.effects[1])
        for _ in range(_EFFECT_ROUNDS):
            rows = height(compared, effect)
            normal = assemble([rows], [effect])
            ((gradient, _, covariance),) = normal.shared
            effect = effect - np.einsum("kij,kj->ki", covariance, gradient)
        rows = height(compared, effect)
        _, _, covariance = assemble([rows], [effect], curved=True).shared[0]
        own = np.einsum("ki,kij,kj", effect, rows.stiffness, effect)
        spread = np.linalg.slogdet(rows.stiffness)[1] + np.linalg.slogdet(covariance)[1]
        return float(rows.loss.sum() + 0.5 * own - 0.5 * spread.sum())

    return min(models, key=cost)


def _comparison(scene: Scene, fit: Fit, placed: Placed, model: Model) -> LaneComparison:
    """Return placed samples with their lanes, to compute the residuals of a model."""
    return LaneComparison(lanes=scene.lanes, placed=placed, matches=fit.matches, model=model)


def side_strength(scene: Scene, fit: Fit, model: Model) -> float:
    """Estimate the model's `side_strength` from where samples lie across their lanes.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    fit : Fit
        A fit near the optimum.
    model : Model
        Its side strength is the prior's mean, with 1 sigma of a factor of two.
    """
    placed = place(scene.samples, fit.state)

    def cost(factor: float) -> float:
        tried = replace(model, side_strength=model.side_strength * factor)
        compared = _comparison(scene, fit, placed, tried)
        prior = (np.log(factor) / _FACTOR_SIGMA) ** 2
        rows = lateral(compared, fit.effects[0])
        return float(rows.weight @ rows.loss + 0.5 * prior)

    factors = np.geomspace(1.0 / MOST_FACTOR, MOST_FACTOR, _FACTORS)
    return float(model.side_strength * min(factors, key=cost))


def _independent_weights(samples: Samples, model: Model) -> Floats:
    """Return each sample's weight, lower where samples of a vehicle share an error of elevation."""
    longest, correlated = samples.spell_reach.shape[1], round(model.lasting / SPELL_S)
    block = samples.spells % longest // max(correlated, 1)
    key = samples.track * longest + block
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    lasting = np.square(model.bent * samples.reach)
    own = np.square(model.elevation * samples.reach) + model.low**2
    return np.asarray(1.0 / (1.0 + (count[group] - 1) * lasting / (lasting + own)))


def heights(scene: Scene, fit: Fit, *, weight: Floats | None = None) -> Heights | None:
    """Estimate the distribution of the heights of reflections from their heights in a fit.

    A higher sensor and higher reflections give the same heights, but the lower edge of reflections
    is known: vehicles end `_EDGE_M` over the road. Their scale above the edge, and the noise of
    elevations that blurs it, follow by maximum likelihood of a mixture: a gamma distribution of
    shape 2 above the edge, reflections from bodies, and outliers.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    fit : Fit
        A fit near the optimum.
    weight : (n,) array, optional
        Weight of each sample; by default 1.

    Returns
    -------
    Heights or None
        None where fewer than `LEAST_SAMPLES` are within `_NEAR_M`.
    """
    samples, reach = scene.samples, scene.samples.reach
    over = height_over_road(scene.lanes, place(samples, fit.state), fit.matches)
    on_path = fit.on_lane & (fit.matches.path_cost == 0.0)
    usable = np.flatnonzero(on_path & np.isfinite(over) & (reach < _NEAR_M))
    if len(usable) < LEAST_SAMPLES:
        return None
    usable = np.random.default_rng(0).permutation(usable)[:_MOST_SAMPLES]
    over, reach = over[usable], reach[usable]
    weights = np.ones(len(over)) if weight is None else weight[usable]

    def cost(parameters: Floats) -> float:
        return -float(weights @ _log_density(parameters, over, reach))

    start, low, high = (
        np.array([edge, np.log(scale), np.log(noise)])
        for edge, scale, noise in (START, _LOWER_BOUND, _UPPER_BOUND)
    )
    fitted = minimize(cost, start, method="L-BFGS-B", bounds=Bounds(low, high))
    parameters: Floats = np.asarray(fitted.x)
    clusters = samples.vehicles[samples.track[usable]]
    error = _clustered_error(parameters, over, reach, clusters, weights)
    shift = parameters[0] - _EDGE_M
    return Heights(
        mean_m=float(fit.state.reflection - shift),
        sigma_m=float(np.hypot(_EDGE_SIGMA_M, error)),
        elevation=float(np.exp(parameters[2])),
    )


def _log_density(parameters: Floats, over: Floats, reach: Floats) -> Floats:
    """Return the log density of heights, given edge, log scale and log noise of elevations."""
    edge, scale = parameters[0], np.exp(parameters[1])
    sigma = np.hypot(NOISE_M, np.exp(parameters[2]) * reach)
    away = (over[:, None] - edge - scale * _NODES) / sigma[:, None]
    low = np.exp(-0.5 * away**2).mean(axis=1) / (sigma * np.sqrt(2.0 * np.pi))
    begin, end = _TALL_M
    tall = ndtr((over - edge - begin) / sigma) - ndtr((over - edge - end) / sigma)
    share, stray = _TALL_SHARE, _STRAY_HEIGHTS
    vehicle = (1.0 - share) * low + share * tall / (end - begin)
    return np.asarray(np.log((1.0 - stray) * vehicle + stray / _STRAY_M))


def _clustered_error(
    parameters: Floats,
    over: Floats,
    reach: Floats,
    track: Integers,
    weight: Floats,
) -> float:
    """Return the cluster-robust standard error of the edge, metres, with vehicles as clusters."""

    def density(shift: Floats) -> Floats:
        return _log_density(parameters + shift, over, reach)

    shifts = _DERIVATIVE_STEP * np.eye(len(parameters))
    scores = np.column_stack(
        [(density(d) - density(-d)) / (2.0 * _DERIVATIVE_STEP) for d in shifts]
    )
    weighted = weight[:, None] * scores
    bread = np.linalg.inv(scores.T @ weighted + 1e-9 * np.eye(len(parameters)))
    _, number = np.unique(track, return_inverse=True)
    clusters = np.column_stack([np.bincount(number, weights=column) for column in weighted.T])
    return float(np.sqrt((bread @ (clusters.T @ clusters) @ bread)[0, 0]))
