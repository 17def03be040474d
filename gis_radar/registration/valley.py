"""Valleys: ways along which a recording slides far without the vehicles' objection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.registration.lanes import Lanes
from gis_radar.registration.model import Model
from gis_radar.registration.solver import Fit, Prior, solve
from gis_radar.registration.state import SIZE
from gis_radar.traces import Samples

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
