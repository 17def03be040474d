"""The residuals of a registration, by name, and their normal equations.

A sample may lie on one of several faces of a vehicle, or on none: its residual is the mean over
these, weighted by their probabilities, which makes the cost a negative log likelihood (expectation
maximisation). Every family is a table of rows `r = r(state) - b_k`, where `b_k` is the random
effect of a vehicle on all its rows: its place in the lane, or the height at which it reflects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.calibration.registration.lanes import Lanes, Placed
from gis_radar.calibration.registration.matches import Matches
from gis_radar.calibration.registration.model import Model
from gis_radar.calibration.registration.state import SIZE
from gis_radar.calibration.registration.traces import SPELL_S, Samples

STRAY_SHARE = 0.1  # share of detections that are on no vehicle: ghosts and multipath
# Width and height over which these spread evenly.
_STRAY_WIDTH_M = 8.0
STRAY_HEIGHT_M = 8.0
# Loss of a sample on no vehicle.
NO_VEHICLE = float(-np.log(STRAY_SHARE * np.sqrt(2.0 * np.pi) / _STRAY_WIDTH_M))
# Places where a front or rear reflects, in half widths: the middles of its thirds.
FRONT_PLACES: tuple[float, ...] = (-2.0 / 3.0, 0.0, 2.0 / 3.0)
# Margin inside the edge of the view in which no height counts: there only the tall are seen.
VIEW_EDGE = math.radians(1.0)

_SPELL_M = 0.02  # 1 sigma of each spell by itself, which keeps covariances regular


@dataclass(frozen=True)
class Residuals:
    """One family of residuals.

    Parameters
    ----------
    value : (n,) array
        Residuals, metres.
    precision : (n,) array
        Inverse variances, as if the faces were known, 1/m^2.
    curvature : (n,) array
        Second derivatives of the loss, smaller as the faces are not known (Louis 1982), 1/m^2.
    loss : (n,) array
        Cost of each row, a negative log likelihood.
    jacobian : (n, 7) array
        Derivatives by the state, in the order of `gis_radar.calibration.registration.state.NAMES`.
    group : (n,) array
        Number of the random effect of each row, vehicle by vehicle.
    stiffness : (tracks, k, k) array
        Inverse covariance of the k random effects of each vehicle, 1/m^2.
    weight : (n,) array
        Weight of each row, below 1 where rows share more than `b_k`.
    """

    value: Floats
    precision: Floats
    curvature: Floats
    loss: Floats
    jacobian: Floats
    group: Integers
    stiffness: Floats
    weight: Floats


@dataclass(frozen=True, kw_only=True)
class LaneComparison:
    """Samples matched to lanes, and the model that compares them.

    Parameters
    ----------
    lanes, placed, matches
        The map, the traces in it, and the lane of each.
    model : Model
        How vehicles drive and reflect.
    scale_m : float
        Widening of all spreads (added in squares), for the first stages of a fit, metres.
    """

    lanes: Lanes
    placed: Placed
    matches: Matches
    model: Model
    scale_m: float = 0.0


def lateral(compared: LaneComparison, effect: Floats) -> Residuals:
    """Compare samples with the centre line of their lane, across it.

    A radar sees the faces of a vehicle that are turned to it: its side, sharp and `half_width`
    nearer than the centre line, or its front or rear, evenly about it; or the sample is on
    no vehicle at all. The residual of a sample is the mean over the side and each third of the
    front, weighted by their probabilities (expectation maximisation).

    Parameters
    ----------
    compared : LaneComparison
        The samples and their lanes.
    effect : (tracks, 1) array
        Random effect: how far each vehicle drives to the left of drivers' mean place, metres.
    """
    lanes, placed, matches = compared.lanes, compared.placed, compared.matches
    samples, model = placed.samples, compared.model
    rows, jacobian = _lateral(
        lateral_constants(model, compared.scale_m), np.array(FRONT_PLACES), matches.lane,
        matches.found, lanes.points, lanes.along, placed.points, placed.arms, placed.flat,
        placed.sight, samples.track, effect[:, 0],
    )  # fmt: skip
    weight = weights(samples, model)
    stiffness = np.full((samples.tracks, 1, 1), model.driver**-2)
    value, precision, curvature, loss = rows
    return Residuals(value, precision, curvature, loss, jacobian, samples.track, stiffness, weight)


def lateral_constants(model: Model, scale_m: float) -> Floats:
    """Return what :func:`faces` and the comparison across a lane take from the model."""
    return np.array([
        model.habit, model.half_width, model.face, model.bearing, scale_m, model.side_strength,
        model.hidden_strength, model.hidden_share, STRAY_SHARE, NO_VEHICLE,
    ])  # fmt: skip


def weights(samples: Samples, model: Model) -> Floats:
    """Return the weight of each sample across its lane.

    Samples of a vehicle within a few metres share its swaying: the weight is v / (v + n wander^2).
    """
    own_m = model.half_width / 2.0
    return np.asarray(1.0 / (1.0 + samples.crowd * (model.wander / own_m) ** 2))


@compiled
def faces(  # pragma: no cover - compiled
    constants: Floats, i: int, k: int, lane_points: Floats, along: Floats, points: Floats,
    flat: Floats, sight: Floats,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Return how sample i lies to lane sample k, and which faces of a vehicle there are seen.

    These are metres to the left of the lane's middle, the direction of sight to its left, the
    variance of a face across the lane, and the share of the side, of a vehicle that is free and of
    one in a queue.
    """
    east, north = along[k, 0], along[k, 1]
    x, y = points[i, 0] - lane_points[k, 0], points[i, 1] - lane_points[k, 1]
    left = sight[i, 0] * north - sight[i, 1] * east
    ahead = abs(sight[i, 0] * east + sight[i, 1] * north)
    square = constants[2] ** 2 + (constants[3] * flat[i] * ahead) ** 2 + constants[4] ** 2
    shown, queued = constants[5] * abs(left), constants[6] * abs(left)
    return y * east - x * north, left, square, shown / (shown + ahead), queued / (queued + ahead)


@compiled
def _lateral(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    constants: Floats,
    front: Floats,
    lane: Integers,
    found: Booleans,
    lane_points: Floats,
    along: Floats,
    points: Floats,
    arms: Floats,
    flat: Floats,
    sight: Floats,
    track: Integers,
    effect: Floats,
) -> tuple[Floats, Floats]:
    """Return value, precision, curvature and loss of each sample, (4, n), and the jacobian."""
    habit, half_width, queues = constants[0], constants[1], constants[7]
    stray_share, no_vehicle = constants[8], constants[9]
    stray, count = np.exp(-no_vehicle), len(lane)
    value, bell = np.zeros((count, len(front) + 1)), np.zeros((count, len(front) + 1))
    square, side, odds = np.zeros(count), np.zeros((count, 2)), np.zeros(len(effect))
    jacobian = np.zeros((count, SIZE))
    for i in range(count):
        east, north = along[lane[i], 0], along[lane[i], 1]
        aside, left, square[i], side[i, 0], side[i, 1] = faces(
            constants, i, lane[i], lane_points, along, points, flat, sight
        )
        off = aside - effect[track[i]] - habit
        peak, ends = found[i] * (1.0 - stray_share) / np.sqrt(square[i]), 0.0
        for j in range(len(front) + 1):
            value[i, j] = off - half_width * (np.sign(left) if j == 0 else front[j - 1])
            bell[i, j] = peak * np.exp(-0.5 / square[i] * value[i, j] ** 2)
            ends += bell[i, j] / len(front) if j else 0.0
        # odds, by all samples of a track, that as in a queue the next vehicle hides front and rear
        visible = side[i, 0] * bell[i, 0] + (1.0 - side[i, 0]) * ends + stray
        hidden = side[i, 1] * bell[i, 0] + (1.0 - side[i, 1]) * ends + stray
        odds[track[i]] += np.log(hidden / visible)
        jacobian[i, 0], jacobian[i, 1] = -north, east
        jacobian[i, 3], jacobian[i, 4] = -arms[i, 2] * east, -arms[i, 2] * north
        jacobian[i, 5] = arms[i, 0] * east + arms[i, 1] * north
    odds += np.log(queues / (1.0 - queues))
    rows, squares = np.zeros((4, count)), np.zeros(len(front) + 1)
    for i in range(count):
        hides = 1.0 / (1.0 + np.exp(-min(max(odds[track[i]], -50.0), 50.0)))
        share = side[i, 0] + hides * (side[i, 1] - side[i, 0])
        for j in range(len(front) + 1):
            bell[i, j] *= (1.0 - share) / len(front) if j else share
            squares[j] = square[i]
        rows[0, i], rows[1, i], rows[2, i], rows[3, i] = _mixed(value[i], bell[i], squares, stray)
    return rows, jacobian


@compiled
def _mixed(  # pragma: no cover - compiled
    value: Floats, density: Floats, square: Floats, stray: float
) -> tuple[float, float, float, float]:
    """Combine the alternatives of a sample to value, precision, curvature and loss.

    `square` are their variances, `stray` is the density of a sample on no vehicle.
    """
    whole, precision, mean, spread = stray, 0.0, 0.0, 0.0
    for j in range(len(value)):
        whole += density[j]
    for j in range(len(value)):
        chance, gradient = density[j] / whole, value[j] / square[j]
        precision += chance / square[j]
        mean += chance * gradient
        spread += chance * gradient**2
    centre = mean / precision if precision > 0.0 else 0.0
    return centre, precision, precision - (spread - mean**2), -np.log(whole)


def height(compared: LaneComparison, effect: Floats) -> Residuals:
    """Compare samples with the scanned road below them plus the height of reflections.

    Parameters
    ----------
    compared : LaneComparison
        The samples and their lanes.
    effect : (tracks, spells) array
        Random effect: how much higher than others each vehicle appears in each spell, metres.
    """
    lanes, placed, matches = compared.lanes, compared.placed, compared.matches
    samples, model = placed.samples, compared.model
    constants = (
        model.elevation, compared.scale_m, model.low, model.body, model.body_share, model.body_over,
        STRAY_SHARE, STRAY_SHARE * np.sqrt(2.0 * np.pi) / STRAY_HEIGHT_M, placed.state.reflection,
    )  # fmt: skip
    rows, jacobian = _height(
        np.array(constants),
        height_over_road(lanes, placed, matches), effect.ravel(), samples.spells,
        matches.lane, lanes.slope, lanes.along, placed.arms, samples.reach,
    )  # fmt: skip
    differ = model.vehicle, model.bent, model.lasting
    if differ not in samples.kept:
        samples.kept[differ] = np.asarray(np.linalg.inv(height_covariance(samples, model)))
    stiffness = samples.kept[differ]
    value, precision, curvature, loss = rows
    ones = np.ones(len(samples))
    return Residuals(value, precision, curvature, loss, jacobian, samples.spells, stiffness, ones)


def height_covariance(samples: Samples, model: Model) -> Floats:
    """Return the covariance of each vehicle's height above the mean, spell by spell.

    A vehicle reflects from higher or lower than others all the time, and all its detections are
    bent up or down by an angle that changes over seconds.

    Parameters
    ----------
    samples : Samples
        The samples, with their vehicles, times and ranges.
    model : Model
        The spreads among vehicles and of angles.

    Returns
    -------
    (tracks, spells, spells) array
        Square metres; spells without samples have variance 1 and no covariance with others.
    """
    reach = samples.spell_reach
    number = np.arange(reach.shape[1])
    apart = np.sqrt(3.0) * np.abs(number[:, None] - number) * SPELL_S / model.lasting
    alike = (1.0 + apart) * np.exp(-apart)
    angle = model.bent * reach
    covariance = model.vehicle**2 + angle[:, :, None] * angle[:, None, :] * alike
    seen = reach > 0.0
    own = np.where(seen, _SPELL_M**2, 1.0)
    return np.asarray(
        np.where(seen[:, :, None] & seen[:, None, :], covariance, 0.0)
        + own[:, :, None] * np.eye(len(number))
    )


@compiled
def _height(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    constants: Floats,
    over: Floats,
    effect: Floats,
    spell: Integers,
    lane: Integers,
    slope: Floats,
    along: Floats,
    arms: Floats,
    reach: Floats,
) -> tuple[Floats, Floats]:
    """Return value, precision, curvature and loss of each sample, (4, n), and the jacobian."""
    elevation, scale_m, low, body, body_share, body_over, stray_share, stray, reflection = constants
    rows, jacobian = np.zeros((4, len(over))), np.zeros((len(over), SIZE))
    value, density, square = np.zeros(2), np.zeros(2), np.zeros(2)
    for i in range(len(over)):
        u, v = -slope[lane[i]] * along[lane[i], 0], -slope[lane[i]] * along[lane[i], 1]
        x, y, z = arms[i, 0], arms[i, 1], arms[i, 2]
        jacobian[i, 0], jacobian[i, 1], jacobian[i, 2], jacobian[i, 6] = u, v, 1.0, -1.0
        jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = y - z * v, z * u - x, x * v - y * u
        if not np.isfinite(over[i]):
            continue
        noise = (elevation * reach[i]) ** 2 + scale_m**2
        square[0], square[1] = low**2 + noise, body**2 + noise
        value[0] = over[i] - (reflection + effect[spell[i]])
        value[1] = value[0] - body_over
        for j in range(2):
            share = (body_share if j else 1.0 - body_share) * (1.0 - stray_share)
            density[j] = share * np.exp(-0.5 * value[j] ** 2 / square[j]) / np.sqrt(square[j])
        rows[0, i], rows[1, i], rows[2, i], rows[3, i] = _mixed(value, density, square, stray)
    return rows, jacobian


def height_over_road(lanes: Lanes, placed: Placed, matches: Matches) -> Floats:
    """Return the height of samples over the scanned road below them, metres.

    The height is NaN where there is no lane below, where the road's height is unknown, and where
    the road itself is out of view, as there only the tall are seen.
    """
    samples = placed.samples
    return _over_road(
        samples.elevation - VIEW_EDGE, samples.upward, placed.points, placed.arms, placed.flat,
        matches.lane, matches.found, lanes.points, lanes.along, lanes.slope,
    )  # fmt: skip


@compiled
def _over_road(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    widest: float,
    upward: Floats,
    points: Floats,
    arms: Floats,
    flat: Floats,
    lane: Integers,
    found: Booleans,
    lane_points: Floats,
    along: Floats,
    slope: Floats,
) -> Floats:
    """Return the heights over the road (m); NaN where the road's elevation exceeds `widest`."""
    over = np.full(len(lane), np.nan)
    for i in range(len(lane)):
        k, up = lane[i], arms[i, 2]
        z = points[i, 2] - lane_points[k, 2]
        if not found[i] or np.isnan(z):
            continue
        x, y = points[i, 0] - lane_points[k, 0], points[i, 1] - lane_points[k, 1]
        drop = np.arctan2(z * flat[i], flat[i] ** 2 + up * (up - z))  # to the road below
        if abs(upward[i] + np.sign(upward[i]) * abs(drop)) < widest:
            over[i] = z - slope[k] * (x * along[k, 0] + y * along[k, 1])
    return over


@dataclass(frozen=True, kw_only=True)
class Normal:
    """Normal equations with the random effects of the vehicles eliminated (Schur complement).

    Parameters
    ----------
    information : (7, 7) array
        Information about the state.
    gradient : (7,) array
        Gradient of the cost by the state.
    scores : (tracks, 7) array
        Each vehicle's part of the gradient.
    shared : list of (gradient, coupling, covariance)
        For each family, the terms from which the random effects are recovered.
    offsets : list of (tracks, 7) arrays
        For each family, the change of the gradient by a metre more on all rows of a vehicle, less
        the part that its random effects absorb.
    """

    information: Floats
    gradient: Floats
    scores: Floats
    shared: list[tuple[Floats, Floats, Floats]]
    offsets: list[Floats]


def assemble(families: list[Residuals], effects: list[Floats], *, curved: bool = False) -> Normal:
    """Sum up the families of residuals, weighted by precisions or, if `curved`, by curvatures.

    For rows with weights p and terms b_k ~ N(0, Q_k^-1) of vehicle k the information is
    `sum p J J' - sum_k G_k' (Q_k + P_k)^-1 G_k`, with the sums `G_k = -sum p J` and `P_k = sum p`
    of the rows that take each term.
    """
    tracks = len(effects[0])
    information, scores = np.zeros((SIZE, SIZE)), np.zeros((tracks, SIZE))
    shared, offsets = [], []
    for family, b in zip(families, effects, strict=True):
        p = family.weight * (_curvature(family, b.size) if curved else family.precision)
        force = family.weight * family.precision * family.value
        squares, coupled, mass, forces, gradients = _summed(
            p, force, family.jacobian, family.group, b.size
        )
        g = -coupled.reshape(*b.shape, SIZE)
        mass, forces = mass.reshape(b.shape), forces.reshape(b.shape)
        covariance = _inverse(family.stiffness, mass)
        gradient = _times(family.stiffness, b) - forces
        taken = covariance @ g
        across, flat = taken.transpose(0, 2, 1), taken.reshape(-1, SIZE)
        information += squares - g.reshape(-1, SIZE).T @ flat
        scores += gradients.reshape(*b.shape, SIZE).sum(axis=1) - _times(across, gradient)
        shared.append((gradient, g, covariance))
        offsets.append(g.sum(axis=1) - _times(across, mass))
    return Normal(
        information=information,
        gradient=scores.sum(axis=0),
        scores=scores,
        shared=shared,
        offsets=offsets,
    )


@compiled
def _inverse(stiffness: Floats, mass: Floats) -> Floats:  # pragma: no cover - compiled
    """Return the inverses of stiffnesses with masses >= 0 added on their diagonals.

    Gauss-Jordan elimination in place needs no pivots for positive definite matrices.
    """
    inverses = stiffness.copy()
    size = mass.shape[1]
    for track in range(len(inverses)):
        a = inverses[track]
        for k in range(size):
            a[k, k] += mass[track, k]
        for k in range(size):
            over = 1.0 / a[k, k]
            a[k, k] = 1.0
            for j in range(size):
                a[k, j] *= over
            for i in range(size):
                share = a[i, k]
                if i != k and share != 0.0:  # spells without samples have no part in others
                    a[i, k] = 0.0
                    for j in range(size):
                        a[i, j] -= share * a[k, j]
    return inverses


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """Return the product of each matrix and its vector."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _curvature(family: Residuals, groups: int) -> Floats:
    """Return the curvatures of a family; drop groups of non-positive total curvature."""
    curvature = family.weight * family.curvature
    mass = np.bincount(family.group, weights=curvature, minlength=groups)
    return np.where(mass[family.group] > 0.0, family.curvature, 0.0)


@compiled
def _summed(  # pragma: no cover - compiled
    p: Floats, force: Floats, jacobian: Floats, track: Integers, tracks: int
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return `sum p J J'`, and for each track the sums of `p J`, `p`, `force` and `force J`."""
    squares, mass, forces = np.zeros((SIZE, SIZE)), np.zeros(tracks), np.zeros(tracks)
    coupled, gradients = np.zeros((tracks, SIZE)), np.zeros((tracks, SIZE))
    for i in range(len(p)):
        k = track[i]
        mass[k] += p[i]
        forces[k] += force[i]
        for a in range(SIZE):
            pj = p[i] * jacobian[i, a]
            coupled[k, a] += pj
            gradients[k, a] += force[i] * jacobian[i, a]
            for b in range(a + 1):
                squares[a, b] += pj * jacobian[i, b]
    for a in range(SIZE):
        for b in range(a):
            squares[b, a] = squares[a, b]
    return squares, coupled, mass, forces, gradients


def sums(track: Integers, rows: Floats, tracks: int) -> Floats:
    """Return the sum of the rows of each track, (tracks, columns)."""
    total = np.zeros((tracks, rows.shape[1]))
    np.add.at(total, track, rows)
    return total
