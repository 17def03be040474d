"""How certain a pose is: covariance, unobservable directions, z score against another one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gis_radar.base import Floats
from gis_radar.calibration.registration.lanes import Scene
from gis_radar.calibration.registration.model import Model
from gis_radar.calibration.registration.shared_offsets import Groups, shared_variance
from gis_radar.calibration.registration.solver import (
    Fit,
    Prior,
    Rest,
    Schedule,
    limited,
    settle,
    solve,
)
from gis_radar.calibration.registration.state import LEVER_M, POSE_PART, SIZE, State
from gis_radar.calibration.registration.traces import Samples
from gis_radar.poses import COMPONENTS

# 1 sigma of the map's place, to the east and to the north: maps and tracks recorded independently
# lay 0.3 to 0.5 m off each other.
MAP_SIGMA_M = 0.15
# Sigmas of easting, northing, height (m), roll, pitch, yaw from which on a scene does not fix them:
# one metre is the paper's accuracy; with 2 degrees a far trace is a lane off.
UNFIXED = (1.0, 1.0, 0.5, math.radians(2.0), math.radians(2.0), math.radians(1.0))
# Distances along the least-known direction at which the likelihood's profile is taken.
_VALLEY_STEPS_M: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0)
# Fit at each step along the least-known direction
_VALLEY = Schedule(scales_m=(0.3, 0.0), rounds=4)
# Rise of the cost at one standard deviation, and at ten, from which on a place is excluded.
_LEAST_RISE = 0.5
_CLEAR_RISE = 50.0

FINE = Schedule(scales_m=(0.2, 0.1, 0.0), rounds=30)  # fit to all samples
# The same from a lower place of the valley: with wider spreads the fit would leave it again.
_THERE = Schedule(scales_m=(0.0,), rounds=30)
# Standard deviations by which the vehicles must prefer an answer to every other (99.4 %,
# one-sided).
CLEAR = 2.5
LOOKS = 4  # most searches for a better optimum, each around the last best one
LOOK_GAIN = 1.0  # least gain in cost of a better optimum: one sigma costs 0.5

PLACE = [0, 1]  # of the state: easting, northing
PLANE = [0, 1, 5]  # of the state: easting, northing, turn about the vertical
POSE_UNITS = np.repeat([1.0, math.degrees(1.0)], 3)  # of a pose file's sigmas: metres, degrees


@dataclass(frozen=True, kw_only=True)
class Certainty:
    """How certain a pose is.

    Parameters
    ----------
    covariance : (6, 6) array
        Order easting, northing, height, roll, pitch, yaw; metres and radians.
    noise : (6, 6) array
        The part of it that is independent in another recording; the rest is of map and model.
    sigma : (6,) array
        Standard deviations of the covariance.
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


def certainty(
    fit: Fit, *, map_sigma_m: float = MAP_SIGMA_M, rival: State | None = None
) -> Certainty:
    """Return how certain a fit is.

    The inverse information, widened where the vehicles disagree more than in the model (a
    cluster-robust covariance with the vehicles as clusters), and by what is not estimated: the
    constants of the model, where all drivers keep in a lane, the accuracy of map and scan from
    street to street, and the map's place.

    Parameters
    ----------
    fit : Fit
        A local optimum.
    map_sigma_m : float
        1 sigma of the map's place; 0 where windows of one recording are compared.
    rival : State, optional
        Another optimum, so near that both are one answer; either may be the right one.
    """
    inverse: Floats = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    noise = _widened(inverse, fit)
    effects = np.vstack([fit.considered(), fit.biases]) @ inverse
    covariance = noise + effects.T @ effects
    covariance[PLACE, PLACE] += map_sigma_m**2
    to_angles = fit.state.to_angles
    if rival is not None:
        gap = rival.difference(fit.state)
        covariance = covariance + np.outer(gap, gap) / 2.0
    pose = to_angles @ covariance[POSE_PART, POSE_PART] @ to_angles.T
    drawn = to_angles @ noise[POSE_PART, POSE_PART] @ to_angles.T
    return Certainty(
        covariance=pose,
        noise=drawn,
        sigma=np.sqrt(np.diag(pose)),
        eigenvalues=eigenvalues(fit.data_information[POSE_PART, POSE_PART]),
        observable=is_fixed(pose),
    )


def pose_covariance(information: Floats, state: State) -> Floats:
    """Return the covariance of easting, northing, height, roll, pitch, yaw from an information."""
    to_angles = state.to_angles
    return np.asarray(to_angles @ np.linalg.inv(information) @ to_angles.T)


def eigenvalues(information: Floats) -> Floats:
    """Return the eigenvalues, ascending, of a (6, 6) pose information, 1/m^2, turns at 50 m."""
    lever = np.diag([1.0] * 3 + [1.0 / LEVER_M] * 3)
    return np.asarray(np.linalg.eigvalsh(lever @ information @ lever), dtype=np.float64)


def is_fixed(covariance: Floats) -> bool:
    """Return whether a covariance (easting to yaw, radians) fixes all six components."""
    sigma = np.sqrt(np.diag(covariance))
    return bool((sigma < UNFIXED).all() and longest_m(covariance) < UNFIXED[0])


def _widened(inverse: Floats, fit: Fit) -> Floats:
    """Return the cluster-robust covariance of a fit, with the vehicles as clusters."""
    clusters = fit.scores[np.abs(fit.scores).sum(axis=1) > 0.0]
    prior = fit.information - fit.data_information
    return cluster_robust(inverse, clusters, prior, unknowns=len(inverse))


def cluster_robust(inverse: Floats, clusters: Floats, prior: Floats, *, unknowns: int) -> Floats:
    """Return the cluster-robust covariance, never below the model's.

    Parameters
    ----------
    inverse : (n, n) array
        The model's covariance.
    clusters : (k, n) array
        Gradient of the cost of each cluster.
    prior : (n, n) array
        Information of the prior, which is no cluster.
    unknowns : int
        Number of unknowns that the clusters fix, for the correction of few clusters.
    """
    root: Floats = np.asarray(np.linalg.cholesky((inverse + inverse.T) / 2.0), dtype=np.float64)
    few = len(clusters) / max(len(clusters) - unknowns, 1)
    spread = root.T @ (few * clusters.T @ clusters + prior) @ root
    return limited(root, spread, np.maximum)


def advantage(fit: Fit, other: Fit, samples: Samples) -> float:
    """Return by how many standard deviations the traffic prefers one fit to another.

    The vehicles are clusters, each with the difference of its losses as score, the loss of its own
    place in the lane included: with a wrong pose all vehicles seem to drive aside. The sum is
    compared with its standard error (Vuong 1989), to which the variance is added that the habits
    of all drivers on a street give to the loss of either fit.

    Parameters
    ----------
    fit, other : Fit
        Two fits to the same samples.
    samples : Samples
        The samples.
    """
    lost = np.bincount(samples.track, weights=other.loss - fit.loss, minlength=samples.tracks)
    gain: Floats = (lost + other.aside - fit.aside)[np.unique(samples.track)]
    return z_score(gain, shared=fit.habits + other.habits)


def z_score(gain: Floats, *, shared: float = 0.0) -> float:
    """Return by how many standard errors a sum of gains differs from zero (Vuong 1989).

    Parameters
    ----------
    gain : (n,) array
        Gain in log likelihood of each vehicle, which is a cluster.
    shared : float
        Variance of the part that all vehicles share.
    """
    drawn = len(gain) * float(gain.var(ddof=1)) if len(gain) > 1 else 0.0
    spread, total = float(np.sqrt(drawn + shared)), float(gain.sum())
    if spread <= 0.0:
        return float(np.inf * np.sign(total)) if total else 0.0
    return total / spread


def along_valley(scene: Scene, fit: Fit, prior: Prior, model: Model) -> Fit:
    """Widen sigma along the least-known direction in the plane by profile likelihood.

    Along a bend of constant curvature, or a straight road, the pose can slide with hardly a change
    of cost, over small local optima. Several metres away along this valley, on the line or circle
    on which the pose turns with the road and with all else fitted anew, the cost must have risen as
    the curvature predicts (profile likelihood); where it has not, as far as the vehicles agree,
    sigma follows from the least rise. Where it is lower there, the fit begins again from the lowest
    place: so where traffic leaves a place open, the prior decides.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    fit : Fit
        A local optimum for these samples.
    prior, model : Prior, Model
        Those with which the fit was found.
    """
    for turn in range(LOOKS + 1):  # the last turn only measures sigma
        hold, way = _weakest(fit)
        curved_m = float(np.sqrt(hold @ way))
        sides = [
            _profile(scene, fit, side * way / curved_m**2, hold, prior, model)
            for side in (-1.0, 1.0)
        ]
        places = (other for side in sides for _, other in side)
        lowest = min(places, key=partial(agreed_rise, fit, groups=fit.groups))
        if turn == LOOKS or agreed_rise(fit, lowest, fit.groups) > -LOOK_GAIN:
            break
        again = _fitted_there(scene, lowest, hold, prior, model)
        if not again.converged:
            break
        fit = again
    return widened_along(fit, hold, max(_deviation(fit, side) for side in sides))


def agreed_rise(fit: Fit | Rest, other: Rest, groups: Groups) -> float:
    """Return by how much the cost is higher at another place, as far as the vehicles agree on it.

    Vehicles' costs differ by more than the model says, and drivers share offsets in their lanes, so
    that the sum of the differences has a standard error; `z` is the sum over it (Vuong 1989). Where
    the vehicles are clear, the rise is `2 z^2`, as of independent vehicles in a right model; else
    `z^2 / 2`, the cost of a normal variable, which is less. It is never more than the sum itself.
    """
    gain, by_offset = other.costs - fit.costs, other.by_offset - fit.by_offset
    z = z_score(gain[gain != 0.0], shared=shared_variance(groups, by_offset))
    rise = 2.0 * z**2 if abs(z) >= CLEAR else 0.5 * z**2
    by_prior = other.cost - other.costs.sum() - (fit.cost - fit.costs.sum())
    return float(by_prior + np.sign(z) * min(abs(float(gain.sum())), rise))


def _fitted_there(scene: Scene, there: Rest, hold: Floats, prior: Prior, model: Model) -> Fit:
    """Return the fit at a place along a valley, fixed along it where it would leave the place."""
    free = solve(scene, there, prior, schedule=_THERE, model=model)
    if abs(hold @ free.state.difference(there.state)) < _VALLEY_STEPS_M[0] and free.converged:
        return free
    return solve(scene, there, prior, schedule=_THERE, model=model, hold=hold)


def with_information_along(fit: Fit, hold: Floats, before: float, after: float) -> Fit:
    """Change a fit's information along a linear combination of the state's components.

    The scores of vehicles are scaled by the root of the change, so that what they disagree widens
    as sigma does. Biases and the constants of the model, which all share, are scaled so that they
    move the answer as far as before.

    Parameters
    ----------
    fit : Fit
        The fit.
    hold : (n,) array
        Weight of each component of the state in the combination.
    before, after : float
        Present and new information along it, 1/m^2.

    Returns
    -------
    Fit
        With the difference added to both information matrices.
    """
    more = (after - before) * np.outer(hold, hold)
    way = np.linalg.solve(fit.information, hold)
    root = np.eye(len(hold)) + before * (math.sqrt(after / before) - 1.0) * np.outer(way, hold)
    return replace(
        fit,
        information=fit.information + more,
        data_information=fit.data_information + more,
        scores=fit.scores @ root,
        biases=fit.biases @ root @ root,
        considered=lambda: fit.considered() @ root @ root,
    )


def _along(fit: Fit, hold: Floats, covariance: Floats) -> float:
    """Return the variance, m^2, of a linear combination of a pose's components."""
    way = np.linalg.solve(fit.state.to_angles.T, hold[POSE_PART])
    return float(way @ covariance @ way)


def _weakest(fit: Fit) -> tuple[Floats, Floats]:
    """Return the weights of the least-known combination (m), and its covariance with the state."""
    covariance: Floats = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
    lever_m = np.array([1.0, 1.0, LEVER_M])
    _, vectors = np.linalg.eigh(lever_m[:, None] * covariance[np.ix_(PLANE, PLANE)] * lever_m)
    hold = np.zeros(SIZE)
    hold[PLANE] = lever_m * vectors[:, -1]
    return hold, covariance @ hold


def _profile(
    scene: Scene, fit: Fit, way: Floats, hold: Floats, prior: Prior, model: Model
) -> list[tuple[float, Rest]]:
    """Return fits at some distances along a valley, metres, all else fitted anew.

    The last one is the first whose cost has risen by _CLEAR_RISE from the nearest: what lies beyond
    is no part of the valley. The rise is not taken from the fit itself, which is the lowest of many
    local optima.
    """
    found, state, at_m = list[tuple[float, Rest]](), fit.state, 0.0
    for step_m in _VALLEY_STEPS_M:
        start = state.moved_along_arc((step_m - at_m) * state.to_heading(way, fit.state))
        here = settle(scene, start, prior, schedule=_VALLEY, model=model, hold=hold)
        state, at_m = here.state, step_m
        found.append((step_m, here))
        if here.cost - found[0][1].cost > _CLEAR_RISE:
            break
    return found


def _deviation(fit: Fit, side: list[tuple[float, Rest]]) -> float:
    """Return the standard deviation, metres, by the rise of the cost along a valley.

    It rises from the nearest place on: a fit is the lowest of many local optima within a metre,
    lower than a smooth cost would be.
    """
    (near_m, near), sigma_m = side[0], 0.0
    for step_m, other in side[1:]:
        if other.cost - fit.cost <= _CLEAR_RISE:  # else the cost excludes it, however far it is
            rise = max(agreed_rise(near, other, fit.groups), _LEAST_RISE)
            sigma_m = max(sigma_m, math.sqrt((step_m**2 - near_m**2) / (2.0 * rise)))
    return sigma_m


def widened_along(fit: Fit, hold: Floats, sigma_m: float) -> Fit:
    """Widen sigma along a linear combination of the state's components, where it is smaller.

    Parameters
    ----------
    fit : Fit
        The fit.
    hold : (n,) array
        Weight of each component of the state in the combination.
    sigma_m : float
        The standard deviation that is asked for; no more than the prior's is given.
    """
    known, way = certainty(fit), np.linalg.solve(fit.information, hold)
    noise, all_m2 = (_along(fit, hold, each) for each in (known.noise, known.covariance))
    if sigma_m**2 <= all_m2:
        return fit
    before = 1.0 / float(hold @ way)
    by_prior = before**2 * float(way @ (fit.information - fit.data_information) @ way)
    # what vehicles share stays, and the prior's information is not the traffic's to lose
    after = max(before * noise / (noise + sigma_m**2 - all_m2), min(by_prior, before))
    return with_information_along(fit, hold, before, after)


def stated(covariance: Floats) -> dict[str, Any]:
    """Return a covariance, and its sigmas in m and degrees, as entries of a pose's evidence."""
    sigma = np.sqrt(np.diag(covariance)) * POSE_UNITS
    named = {name: float(value) for name, value in zip(COMPONENTS, sigma, strict=True)}
    return {"sigma": named, "covariance": covariance.tolist()}


def longest_m(covariance: Floats) -> float:
    """Return the standard deviation, metres, along the worst-known direction in the plane."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
