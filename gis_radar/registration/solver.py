"""The solver: robust least squares over all residuals, the vehicles' own shares taken out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.registration.lanes import Lanes, direction_bin
from gis_radar.registration.matching import Matches, match
from gis_radar.registration.residuals import NO_VEHICLE, Residuals, height, lateral
from gis_radar.registration.state import FREE, SIZE, State
from gis_radar.traces import Samples

FAMILIES = (lateral, height)
SCALES_M = (1.5, 0.75, 0.3, 0.0)
ROUNDS = 6
STREET_M = 60.0
SETTLED_M = 5e-3
SETTLED_SIGMAS, AT_REST_SIGMAS = 0.02, 0.5
AT_REST_M = 0.1  # where no shorter step helps either
LEAST_SHARE = 0.05


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What is believed beforehand.

    Parameters
    ----------
    mean : State
        The likeliest state.
    information : (9, 9) array
        About it; inverse variances.
    """

    mean: State
    information: Floats


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A local optimum.

    Parameters
    ----------
    state : State
        Where it is.
    information : (9, 9) array
        Of the state, priors included.
    data_information : (9, 9) array
        What the samples alone say.
    scores : (tracks, 9) array
        Gradient of each vehicle's rows, for a covariance that asks the vehicles.
    streets : list of (streets, 9) arrays
        For each family of residuals the pull of a bias of one metre, common to a stretch of
        street in one direction, on the state.
    cost : float
        Negative logarithm of the likelihood of everything, up to a constant.
    loss : (n,) array
        Lateral loss of each sample, a negative logarithm of likelihood.
    on_lane : (n,) bool array
        Samples more likely on a vehicle in a lane than not.
    matches : Matches
        Who lies where.
    converged : bool
        Whether the last steps were small.
    """

    state: State
    information: Floats
    data_information: Floats
    scores: Floats
    streets: list[Floats]
    cost: float
    loss: Floats
    on_lane: Booleans
    matches: Matches
    converged: bool

    @property
    def fitness(self) -> float:
        """Share of samples that lie on a vehicle in a lane that their Doppler allows."""
        return float(self.on_lane.mean())


def solve(
    lanes: Lanes,
    samples: Samples,
    start: State,
    prior: Prior,
    *,
    scales_m: tuple[float, ...] = SCALES_M,
    rounds: int = ROUNDS,
) -> Fit:
    """Find the pose near a start at which the traces lie on the lanes and on the road.

    Gauss-Newton on reweighted residuals (Geman-McClure), its scale shrinking from `scales_m[0]`.

    Parameters
    ----------
    lanes, samples : Lanes, Samples
        The map and the traces.
    start : State
        Where to begin.
    prior : Prior
        What is believed beforehand.
    scales_m : tuple of float
        Residuals far above count no more.
    rounds : int
        Most steps at each scale.
    """
    point = _Point(start, np.zeros((len(FAMILIES), samples.tracks)))
    converged = False
    for scale_m in scales_m:
        cost = _Cost(lanes, samples, prior, scale_m)
        here = cost.at(point)
        for _ in range(rounds):
            step, own, sigmas = cost.step(here)
            there, share = None, 1.0
            while share > LEAST_SHARE and (there is None or there.total > here.total):
                moved = _Point(here.point.state.moved(share * step), here.point.own + share * own)
                there, share = cost.at(moved), share / 3.0
            length_m = float(np.abs(step[:6] * _LEVER).max())
            if there is None or there.total > here.total:
                converged = length_m < AT_REST_M or sigmas < AT_REST_SIGMAS
                break
            here = there
            converged = length_m < SETTLED_M or sigmas < SETTLED_SIGMAS
            if converged:
                break
        point = here.point
    return _described(lanes, samples, here, prior, converged=converged)


@dataclass(frozen=True)
class _Point:
    state: State
    own: Floats


@dataclass(frozen=True, kw_only=True)
class _Here:
    point: _Point
    matches: Matches
    families: list[Residuals]
    total: float


@dataclass(frozen=True)
class _Cost:
    """The negative logarithm of the likelihood, and the steps that lower it."""

    lanes: Lanes
    samples: Samples
    prior: Prior
    scale_m: float

    def at(self, point: _Point) -> _Here:
        """Return residuals and cost at a point."""
        matches = match(self.lanes, self.samples, point.state)
        families = [
            family(self.lanes, self.samples, matches, point.state, own, self.scale_m)
            for family, own in zip(FAMILIES, point.own, strict=True)
        ]
        away = point.state.difference(self.prior.mean)
        total = sum(
            float(f.loss.sum() + 0.5 * np.sum((own / f.shared) ** 2))
            for f, own in zip(families, point.own, strict=True)
        )
        return _Here(
            point=point,
            matches=matches,
            families=families,
            total=total + 0.5 * float(away @ self.prior.information @ away),
        )

    def step(self, here: _Here) -> tuple[Floats, Floats, float]:
        """Return the steps of the state and of what the vehicles add, and the first in sigmas."""
        normal = assemble(here.families, here.point.own)
        information = normal.information + self.prior.information
        away = here.point.state.difference(self.prior.mean)
        gradient = normal.gradient + self.prior.information @ away
        step = np.zeros(SIZE)
        step[FREE] = -np.linalg.solve(information[FREE, FREE], gradient[FREE])
        own = np.array([-(r + g @ step) * a for r, g, a in normal.shared])
        return step, own, float(np.sqrt(step @ information @ step))


_LEVER = np.array([1.0, 1.0, 1.0, 20.0, 20.0, 50.0])  # metres that a turn moves


@dataclass(frozen=True, kw_only=True)
class Normal:
    """Normal equations with the vehicles' own terms eliminated (Schur complement).

    Parameters
    ----------
    information : (9, 9) array
        Of the state.
    gradient : (9,) array
        Of the cost by the state.
    scores : (tracks, 9) array
        Each vehicle's part of the gradient.
    shared : list of (gradient, coupling, variance)
        For each family what gives the vehicles' own terms back.
    """

    information: Floats
    gradient: Floats
    scores: Floats
    shared: list[tuple[Floats, Floats, Floats]]


def assemble(families: list[Residuals], own: Floats) -> Normal:
    """Sum up the families of residuals.

    For rows with weights p and a term b_k ~ N(0, tau^2) of vehicle k the information is
    `sum p J J' - sum_k g_k g_k' / (1 / tau^2 + sum_k p)` with `g_k = -sum_k p J`.
    """
    tracks = own.shape[1]
    information, scores = np.zeros((SIZE, SIZE)), np.zeros((tracks, SIZE))
    shared = []
    for family, b in zip(families, own, strict=True):
        p = family.weight
        pj = p[:, None] * family.jacobian
        sums = _sums(family.track, np.column_stack([pj, p, p * family.value]), tracks)
        g, mass, pull = -sums[:, :SIZE], sums[:, SIZE], sums[:, SIZE + 1]
        variance = 1.0 / (family.shared**-2 + mass)
        gradient = b * family.shared**-2 - pull
        information += family.jacobian.T @ pj - g.T @ (variance[:, None] * g)
        scores += _sums(family.track, pj * family.value[:, None], tracks)
        scores -= g * (variance * gradient)[:, None]
        shared.append((gradient, g, variance))
    return Normal(
        information=information, gradient=scores.sum(axis=0), scores=scores, shared=shared
    )


def _sums(track: Integers, rows: Floats, tracks: int) -> Floats:
    """Return the sum of the rows of each track, (tracks, columns)."""
    return np.column_stack(
        [np.bincount(track, weights=column, minlength=tracks) for column in rows.T]
    )


def _described(
    lanes: Lanes, samples: Samples, here: _Here, prior: Prior, *, converged: bool
) -> Fit:
    """Return the evidence at a point."""
    normal = assemble(here.families, here.point.own)
    street, count = _streets(lanes, samples, here.matches)
    pulls = []
    for family, (_, g, variance) in zip(here.families, normal.shared, strict=True):
        # what a vehicle may add by itself takes most of its bias up
        felt = g * (variance * family.shared**-2)[:, None]
        pulls.append(_sums(street, felt, count))
    return Fit(
        state=here.point.state,
        information=normal.information + prior.information,
        data_information=normal.information,
        scores=normal.scores,
        streets=pulls,
        cost=here.total,
        loss=here.families[0].loss,
        on_lane=here.families[0].loss < NO_VEHICLE - np.log(2.0),
        matches=here.matches,
        converged=converged,
    )


def _streets(lanes: Lanes, samples: Samples, matches: Matches) -> tuple[Integers, int]:
    """Return for each track the number of the stretch of street that it drives on most."""
    lane = matches.lane[matches.found]
    way = direction_bin(lanes.along[lane]) // 2
    cell = np.floor(lanes.points[lane, :2] / STREET_M).astype(np.int64)
    keys = np.column_stack([cell, way])
    _, number = np.unique(keys, axis=0, return_inverse=True)
    count = int(number.max(initial=-1)) + 1
    votes = np.zeros((samples.tracks, count + 1))
    np.add.at(votes, (samples.track[matches.found], number.ravel()), 1.0)
    return votes.argmax(axis=1), count + 1
