"""Adaptation: what a recording tells about its own radar and vehicles, near a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.special import gammaincinv, ndtr

from gis_radar.arrays import Floats, Integers
from gis_radar.localization.lanes import Lanes
from gis_radar.localization.matching import place
from gis_radar.localization.model import Model
from gis_radar.localization.residuals import Comparison, height_over_road, lateral
from gis_radar.localization.solver import Fit, Prior
from gis_radar.localization.state import REFLECTION
from gis_radar.localization.traces import Samples

EDGE_M, EDGE_SIGMA_M = 0.2, 0.07  # bumpers, sills and wheels end that far over the road
NODES = gammaincinv(2.0, (np.arange(16) + 0.5) / 16)
TALL_SHARE, TALL_M = 0.2, (0.2, 2.8)  # of bodies, from where to where above the edge
STRAY_SHARE, STRAY_M = 0.05, 8.0
NEAR_M, LEAST, MOST = 80.0, 200, 1500
START = np.array([EDGE_M, np.log(0.2), np.log(np.radians(0.5))])
NOISE_M = 0.05
LEAST_PARAMETERS = np.array([-1.5, np.log(0.05), np.log(np.radians(0.1))])
MOST_PARAMETERS = np.array([2.0, np.log(0.6), np.log(np.radians(2.0))])
FACTORS = np.geomspace(0.25, 4.0, 17)
BELIEVED = np.log(2.0)  # 1 sigma of what is believed beforehand, either way
STEP = 1e-4


@dataclass(frozen=True, kw_only=True)
class Heights:
    """At which heights vehicles reflect.

    Parameters
    ----------
    mean_m, sigma_m : float
        Mean height of reflections from bumpers, sills and wheels over the road, and its error.
    elevation : float
        One standard deviation of the radar's elevation angles, radians.
    """

    mean_m: float
    sigma_m: float
    elevation: float


def adapted(
    lanes: Lanes, samples: Samples, fit: Fit, prior: Prior, model: Model
) -> tuple[Prior, Model]:
    """Return prior and model with what samples tell about the radar and the vehicles.

    Parameters
    ----------
    lanes, samples : Lanes, Samples
        The map and the traces.
    fit : Fit
        Near the answer.
    prior, model : Prior, Model
        What was believed of reflections before.
    """
    model = replace(model, side_strength=side_strength(lanes, samples, fit, model))
    told = heights(lanes, samples, fit)
    if told is None:
        return prior, model
    information = prior.information.copy()
    information[REFLECTION, REFLECTION] = told.sigma_m**-2
    mean = replace(prior.mean, reflection=told.mean_m)
    prior = Prior(mean=mean, information=information)
    return prior, replace(model, elevation=told.elevation)


def side_strength(lanes: Lanes, samples: Samples, fit: Fit, model: Model) -> float:
    """Return how strongly sides reflect against fronts: the likeliest, by where samples lie.

    Parameters
    ----------
    lanes, samples : Lanes, Samples
        The map and the traces.
    fit : Fit
        Near the answer.
    model : Model
        Its strength is believed within a factor of two.
    """
    placed = place(samples, fit.state)

    def cost(factor: float) -> float:
        tried = replace(model, side_strength=model.side_strength * factor)
        compared = Comparison(
            lanes=lanes, placed=placed, matches=fit.matches, model=tried, scale_m=0.0
        )
        belief = (np.log(factor) / BELIEVED) ** 2
        rows = lateral(compared, fit.own[0])
        return float(rows.say @ rows.loss + 0.5 * belief)

    return float(model.side_strength * min(FACTORS, key=cost))


def heights(lanes: Lanes, samples: Samples, fit: Fit) -> Heights | None:
    """Estimate at which heights vehicles reflect, from the shape of what a fit shows.

    The height of a sensor and that of the reflections look alike but for one thing: no vehicle
    reflects from below its bumpers, sills and wheels, and those end `EDGE_M` over the road whatever
    the radar. The lower edge of the reflections is therefore known; their spread over it, and the
    noise that blurs it with the range, follow by maximum likelihood: a gamma distribution of
    shape 2 over the edge, bodies above, strays.

    Parameters
    ----------
    lanes, samples : Lanes, Samples
        The map and the traces.
    fit : Fit
        Near the answer.

    Returns
    -------
    Heights or None
        None where too few samples are near enough to tell.
    """
    over, reach = height_over_road(lanes, place(samples, fit.state), fit.matches), samples.reach
    usable = np.flatnonzero(fit.on_lane & np.isfinite(over) & (reach < NEAR_M))
    if len(usable) < LEAST:
        return None
    usable = np.random.default_rng(0).permutation(usable)[:MOST]
    over, reach = over[usable], reach[usable]

    def cost(parameters: Floats) -> float:
        return -float(_log_density(parameters, over, reach).sum())

    bounds = Bounds(LEAST_PARAMETERS, MOST_PARAMETERS)
    found: Floats = np.asarray(minimize(cost, START, method="L-BFGS-B", bounds=bounds).x)
    error = _sandwich(found, over, reach, samples.track[usable])
    shift = found[0] - EDGE_M
    return Heights(
        mean_m=float(fit.state.reflection - shift),
        sigma_m=float(np.hypot(EDGE_SIGMA_M, error)),
        elevation=float(np.exp(found[2])),
    )


def _log_density(parameters: Floats, over: Floats, reach: Floats) -> Floats:
    """Return the log density of heights, given edge, log scale and log noise of elevations."""
    edge, scale = parameters[0], np.exp(parameters[1])
    sigma = np.hypot(NOISE_M, np.exp(parameters[2]) * reach)
    away = (over[:, None] - edge - scale * NODES) / sigma[:, None]
    low = np.exp(-0.5 * away**2).mean(axis=1) / (sigma * np.sqrt(2.0 * np.pi))
    begin, end = TALL_M
    tall = ndtr((over - edge - begin) / sigma) - ndtr((over - edge - end) / sigma)
    vehicle = (1.0 - TALL_SHARE) * low + TALL_SHARE * tall / (end - begin)
    return np.asarray(np.log((1.0 - STRAY_SHARE) * vehicle + STRAY_SHARE / STRAY_M))


def _sandwich(parameters: Floats, over: Floats, reach: Floats, track: Integers) -> float:
    """Return the standard error of the edge, with the vehicles as clusters."""
    scores = np.column_stack(
        [
            (_log_density(parameters + d, over, reach) - _log_density(parameters - d, over, reach))
            / (2.0 * STEP)
            for d in STEP * np.eye(len(parameters))
        ]
    )
    bread = np.linalg.inv(scores.T @ scores + 1e-9 * np.eye(len(parameters)))
    _, number = np.unique(track, return_inverse=True)
    voices = np.column_stack([np.bincount(number, weights=column) for column in scores.T])
    return float(np.sqrt((bread @ (voices.T @ voices) @ bread)[0, 0]))
