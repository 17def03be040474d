"""The residuals of a registration, by name, and their normal equations.

A sample may lie on one of several faces of a vehicle, or on none: its residual is the mean over
these, by their chances, which makes the cost a negative logarithm of likelihood (expectation
maximisation). Every family is a table of rows `r = r(state) - b_k`, where `b_k` is the random
effect of a vehicle on all its rows: its place in the lane, the height at which it reflects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers, compiled
from gis_radar.localization.lanes import Lanes
from gis_radar.localization.matching import Matches, Placed
from gis_radar.localization.model import Model
from gis_radar.localization.settings import SolverSettings
from gis_radar.localization.state import REFLECTION, SIZE, TURN


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """One family of residuals.

    Parameters
    ----------
    name : str
        What it compares.
    value : (n,) array
        Metres.
    jacobian : (n, 7) array
        By the state, in the order of `gis_radar.localization.state.NAMES`.
    shared : float
        Standard deviation of what a vehicle adds to all its rows, metres.
    precision : (n,) array
        Inverse variances, as if the faces were known.
    curvature : (n,) array
        Second derivatives of the loss, which not knowing the faces makes smaller (Louis 1982).
    loss : (n,) array
        Cost of each row, a negative logarithm of likelihood.
    weight : (n,) array
        Of each row, below one where rows share more than `b_k`.
    """

    name: str
    value: Floats
    jacobian: Floats
    shared: float
    precision: Floats
    curvature: Floats
    loss: Floats
    weight: Floats


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Samples matched to lanes, and the model that compares them.

    Parameters
    ----------
    lanes, placed, matches
        The map, the traces in it, and the lane of each.
    model : Model
        How vehicles drive and reflect.
    scale_m : float
        Added to all spreads (root of squares), to widen the basin at first.
    settings : SolverSettings
        What is robust about it.
    """

    lanes: Lanes
    placed: Placed
    matches: Matches
    model: Model
    scale_m: float
    settings: SolverSettings


def lateral(compared: Comparison, effect: Floats) -> Residuals:
    """Compare samples with the centre line of their lane, across it.

    A radar sees the faces of a vehicle that are turned to it: its side, sharp and `half_width`
    nearer than the centre line, its front or rear, evenly about the centre line; or what it sees
    is no vehicle at all. Each sample has a row for the side and one for each third of the front,
    weighted by its chance (expectation maximisation).

    Parameters
    ----------
    compared : Comparison
        What to compare.
    effect : (tracks,) array
        Random effect: how far each vehicle drives to the left of where drivers do, metres.
    """
    lanes, placed, matches = compared.lanes, compared.placed, compared.matches
    samples, model, settings = placed.samples, compared.model, compared.settings
    east, north = lanes.along[matches.lane].T
    away = placed.points[:, :2] - lanes.points[matches.lane, :2]
    off = away[:, 1] * east - away[:, 0] * north - effect[samples.track] - model.habit
    x, y = placed.sight.T
    left, ahead = x * north - y * east, np.abs(x * east + y * north)
    faces = np.vstack([np.sign(left), *(np.full(len(off), at) for at in settings.front)])
    noise = np.hypot(model.bearing * placed.flat * ahead, compared.scale_m)
    value = off - faces * model.half_width
    sigma = np.broadcast_to(np.hypot(model.face, noise), value.shape)
    bell = (
        (1.0 - settings.stray_share) * matches.found * np.exp(-0.5 * (value / sigma) ** 2) / sigma
    )
    side = _side_share(compared, bell, np.abs(left), ahead)
    density = bell * np.stack([side, *([(1.0 - side) / len(settings.front)] * len(settings.front))])
    jacobian = np.zeros((len(off), SIZE))
    jacobian[:, 0], jacobian[:, 1] = -north, east
    jacobian[:, TURN] = _turning(placed.arms, jacobian[:, :3])
    stray = np.exp(-settings.no_vehicle)
    rows = _mixed("lateral", value, sigma, density, stray, jacobian, model.driver)
    # many samples of a vehicle on a few metres share its swaying there: v / (v + n wander^2)
    own_m = model.half_width / 2.0
    weight: Floats = np.asarray(1.0 / (1.0 + samples.crowd * (model.wander / own_m) ** 2))
    return replace(rows, weight=weight)


def _mixed(
    name: str,
    value: Floats,
    sigma: Floats,
    density: Floats,
    stray: float,
    jacobian: Floats,
    shared: float,
) -> Residuals:
    """Sum (alternatives, n) values up to a row a sample; `stray` is the density of none of them."""
    whole = density.sum(axis=0) + stray
    chance = density / whole
    pull = value / sigma**2
    precision = (chance / sigma**2).sum(axis=0)
    mean = (chance * pull).sum(axis=0)
    spread = (chance * pull**2).sum(axis=0) - mean**2
    return Residuals(
        name=name,
        value=np.divide(mean, precision, out=np.zeros_like(mean), where=precision > 0.0),
        jacobian=jacobian,
        shared=shared,
        precision=precision,
        curvature=precision - spread,
        loss=-np.log(whole),
        weight=np.ones_like(whole),
    )


def _side_share(compared: Comparison, bell: Floats, left: Floats, ahead: Floats) -> Floats:
    """Return the share of side faces at each sample.

    In a queue the fronts and rears are hidden by the next vehicle: whether a vehicle's ends are
    visible is estimated from its samples (expectation over both).
    """
    model, samples = compared.model, compared.placed.samples
    track = samples.track
    strengths = np.array([model.side_strength, model.hidden_strength])[:, None] * left
    share = strengths / (strengths + ahead)
    whole = share * bell[0] + (1.0 - share) * bell[1:].mean(axis=0)
    whole += np.exp(-compared.settings.no_vehicle)
    odds = np.bincount(track, weights=np.log(whole[1] / whole[0]), minlength=samples.tracks)
    odds += np.log(model.hidden_share / (1.0 - model.hidden_share))
    hidden = 1.0 / (1.0 + np.exp(-np.clip(odds, -50.0, 50.0)))[track]
    return np.asarray(share[0] + hidden * (share[1] - share[0]))


def height(compared: Comparison, effect: Floats) -> Residuals:
    """Compare samples with the scanned road below them plus the height of reflections.

    Parameters
    ----------
    compared : Comparison
        What to compare.
    effect : (tracks,) array
        Random effect: how much higher than others each vehicle reflects, metres.
    """
    lanes, placed, matches = compared.lanes, compared.placed, compared.matches
    samples, model, settings = placed.samples, compared.model, compared.settings
    over = height_over_road(lanes, placed, matches, settings.view_edge)
    value = over - placed.state.reflection - effect[samples.track]
    jacobian = np.zeros((len(samples), SIZE))
    jacobian[:, :2] = -lanes.slope[matches.lane, None] * lanes.along[matches.lane]
    jacobian[:, 2] = 1.0
    jacobian[:, TURN] = _turning(placed.arms, jacobian[:, :3])
    jacobian[:, REFLECTION] = -1.0
    valid = np.isfinite(over)
    value = np.nan_to_num(value) - np.array([[0.0], [model.body_over]])
    noise = np.hypot(model.elevation * samples.reach, compared.scale_m)
    sigma = np.hypot([[model.low], [model.body]], noise)
    share = np.array([[1.0 - model.body_share], [model.body_share]]) * (1.0 - settings.stray_share)
    density = valid * share * np.exp(-0.5 * (value / sigma) ** 2) / sigma
    stray = settings.stray_share * np.sqrt(2.0 * np.pi) / settings.stray_height_m
    rows = _mixed("height", value, sigma, density, stray, jacobian, model.vehicle)
    return replace(rows, loss=np.where(valid, rows.loss, 0.0))


def height_over_road(lanes: Lanes, placed: Placed, matches: Matches, view_edge: float) -> Floats:
    """Return the height of samples over the scanned road below them, metres.

    NaN where there is no lane below, where its height is unknown, and where the road itself is
    out of view: there only the tall are seen.
    """
    off = placed.points - lanes.points[matches.lane]
    ahead = np.einsum("ij,ij->i", off[:, :2], lanes.along[matches.lane])
    over = off[:, 2] - lanes.slope[matches.lane] * ahead
    return np.where(matches.found & _in_view(placed, off[:, 2], view_edge), over, np.nan)


def _in_view(placed: Placed, over_m: Floats, view_edge: float) -> Booleans:
    """Return where the road itself would be in view; beyond, only tall vehicles are seen."""
    up, flat, upward = placed.arms[:, 2], placed.flat, placed.samples.upward
    lower = np.arctan2(up - np.nan_to_num(over_m), flat) - np.arctan2(up, flat)
    angle = np.abs(upward + np.sign(upward) * np.abs(lower))
    return np.asarray(angle < placed.samples.elevation - view_edge)


def _turning(arms: Floats, pull: Floats) -> Floats:
    """Return how a turn about each axis of the map moves samples along a pull: arms x pull."""
    (x, y, z), (u, v, w) = arms.T, pull.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


@dataclass(frozen=True, kw_only=True)
class Normal:
    """Normal equations with the random effects of the vehicles eliminated (Schur complement).

    Parameters
    ----------
    information : (7, 7) array
        Of the state.
    gradient : (7,) array
        Of the cost by the state.
    scores : (tracks, 7) array
        Each vehicle's part of the gradient.
    shared : list of (gradient, coupling, variance)
        For each family, to recover the random effects.
    """

    information: Floats
    gradient: Floats
    scores: Floats
    shared: list[tuple[Floats, Floats, Floats]]


def assemble(
    families: list[Residuals], effects: Floats, track: Integers, *, curved: bool = False
) -> Normal:
    """Sum up the families of residuals; `curved` by curvatures, not by precisions.

    For rows with weights p and a term b_k ~ N(0, tau^2) of vehicle k the information is
    `sum p J J' - sum_k g_k g_k' / (1 / tau^2 + sum_k p)` with `g_k = -sum_k p J`.
    """
    tracks = effects.shape[1]
    information, scores = np.zeros((SIZE, SIZE)), np.zeros((tracks, SIZE))
    shared = []
    for family, b in zip(families, effects, strict=True):
        p = family.weight * (_curvature(family, track, tracks) if curved else family.precision)
        pj, force = p[:, None] * family.jacobian, family.weight * family.precision * family.value
        columns = sums(track, np.column_stack([pj, p, force]), tracks)
        g, mass, pull = -columns[:, :SIZE], columns[:, SIZE], columns[:, SIZE + 1]
        variance = 1.0 / (family.shared**-2 + mass)
        gradient = b * family.shared**-2 - pull
        information += family.jacobian.T @ pj - g.T @ (variance[:, None] * g)
        scores += sums(track, force[:, None] * family.jacobian, tracks)
        scores -= g * (variance * gradient)[:, None]
        shared.append((gradient, g, variance))
    return Normal(
        information=information, gradient=scores.sum(axis=0), scores=scores, shared=shared
    )


def _curvature(family: Residuals, track: Integers, tracks: int) -> Floats:
    """Return the curvatures of a family; drop vehicles of non-positive total curvature."""
    mass = np.bincount(track, weights=family.weight * family.curvature, minlength=tracks)
    return np.where(mass[track] > 0.0, family.curvature, 0.0)


def sums(track: Integers, rows: Floats, tracks: int) -> Floats:
    """Return the sum of the rows of each track, (tracks, columns)."""
    total = np.zeros((tracks, rows.shape[1]))
    _add(total, track, rows)
    return total


@compiled
def _add(total: Floats, track: Integers, rows: Floats) -> None:  # pragma: no cover - compiled
    for i in range(len(rows)):
        for j in range(rows.shape[1]):
            total[track[i], j] += rows[i, j]


def at_least(information: Floats, floor: Floats) -> Floats:
    """Return an information that in no direction is below a positive definite floor."""
    root = np.linalg.cholesky((floor + floor.T) / 2.0)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ (information + information.T) @ inverse.T / 2.0)
    wide = root @ vectors
    return np.asarray((wide * np.maximum(values, 1.0)) @ wide.T)
