"""Solver: robust least squares over all residuals, with random effects of each vehicle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from gis_radar.base import Booleans, Floats
from gis_radar.calibration.registration.lane_paths import match_paths
from gis_radar.calibration.registration.lanes import Placed, Scene, place
from gis_radar.calibration.registration.matches import Matches, match
from gis_radar.calibration.registration.model import MODEL, Model
from gis_radar.calibration.registration.residuals import (
    NO_VEHICLE,
    LaneComparison,
    Residuals,
    assemble,
    height,
    lateral,
    sums,
)
from gis_radar.calibration.registration.shared_offsets import Groups, biases_of, habits_of
from gis_radar.calibration.registration.state import LEVER_M, SIZE, State
from gis_radar.calibration.registration.traces import Samples


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Schedule of one call of the solver: how far spreads are widened, and how many steps.

    Parameters
    ----------
    scales_m : tuple of float
        Widening of all spreads (added in squares), stage by stage. A fit converges from about twice
        the first scale; only with 0 last is it an optimum of the model itself.
    rounds : int
        Most Gauss-Newton steps in a stage.
    """

    scales_m: tuple[float, ...]
    rounds: int


FAR = Schedule(scales_m=(1.5, 0.75, 0.3, 0.0), rounds=6)  # for starts up to a lane off
# A step shorter than either ends a stage: far below the noise.
_SETTLED_M = 5e-3
_SETTLED_SIGMAS = 0.02
# Where no shortened step lowers the cost, one shorter than either is convergence, too: the expected
# gain was one at most, and changing faces make bumps of that size.
_AT_REST_M = 0.1
_AT_REST_SIGMAS = 1.5
# A step that does not lower the cost is divided by _SHRINK, down to this share.
_SHRINK = 3.0
_LEAST_SHARE = 0.05
# Share of the weights' information that is used where the curvature is not positive definite.
_LEAST_CURVATURE = 0.05
FLOOR = 1e-6  # least information in any direction, 1/m^2: a kilometre

_FAMILIES = (lateral, height)
# Constants of the model; the others are of the lateral family.
_OF_HEIGHT = {
    "elevation", "low", "vehicle", "bent", "lasting", "body_share", "body_over", "body",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Prior:
    """A Gaussian prior of the state.

    Parameters
    ----------
    mean : State
        The likeliest state.
    information : (7, 7) array
        Information about the state; inverse variances.
    """

    mean: State
    information: Floats


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A local optimum.

    Parameters
    ----------
    state : State
        The optimum.
    information : (7, 7) array
        Information about the state, the prior included.
    data_information : (7, 7) array
        Information of the samples alone, without the prior.
    scores : (tracks, 7) array
        Gradient of each vehicle's rows, for the cluster-robust covariance; zeros beyond the last.
    habits : float
        Variance of the loss by an offset in the lane that all drivers of a street share.
    by_offset : (tracks,) array
        Derivative of each vehicle's cost by a common offset of drivers across their lane, 1/m.
    groups : Groups
        Vehicles whose offsets are shared, by street section and by lane, as for `shared_variance`.
    biases : (biases, 7) array
        Change of the gradient by one standard deviation of each bias that vehicles share: of map
        and scan on a street section in one direction, of all drivers on a lane.
    cost : float
        Negative log likelihood of data and prior, up to a constant.
    loss : (n,) array
        Lateral loss of each sample, a weighted negative log likelihood, and cost of its path.
    aside : (tracks,) array
        Negative log likelihood of each vehicle's own place in its lane.
    costs : (tracks,) array
        Negative log likelihood of all rows and random effects of each vehicle, as `scores`.
    on_lane : (n,) bool array
        Samples more likely on a vehicle in their nearest lane than not, whatever their paths.
    matches : Matches
        The lane of each sample.
    converged : bool
        Whether the last steps were small.
    effects : list of (tracks, k) arrays
        Random effects of each vehicle on the residuals of each family, metres.
    considered : callable
        Returns a (constants, 7) array: the change of the gradient by one standard deviation of each
        constant of the model.
    """

    state: State
    information: Floats
    data_information: Floats
    scores: Floats
    habits: float
    by_offset: Floats
    groups: Groups
    biases: Floats
    cost: float
    loss: Floats
    aside: Floats
    costs: Floats
    on_lane: Booleans
    matches: Matches
    converged: bool
    effects: list[Floats]
    considered: Callable[[], Floats]

    @property
    def fitness(self) -> float:
        """Share of samples that lie on a vehicle in a lane that their Doppler allows."""
        return float(self.on_lane.mean())


def solve(
    scene: Scene,
    start: State | Rest,
    prior: Prior,
    *,
    schedule: Schedule = FAR,
    model: Model = MODEL,
    hold: Floats | None = None,
) -> Fit:
    """Find the pose near a start at which the traces lie on the lanes and on the road.

    Takes Gauss-Newton steps on the expectation over the faces that samples may lie on; all spreads
    are widened at first, then less and less, so that the optimum is found from afar.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    start : State or Rest
        The start; from where another fit stopped with the vehicles' random effects found there.
    prior : Prior
        Prior of the state.
    schedule : Schedule
        Widening of all spreads, stage by stage; by default for starts up to a lane off.
    model : Model
        How vehicles drive and reflect.
    hold : (7,) array, optional
        Weights of a linear combination of the state's components that is kept as at the start.
    """
    return _described(*_descended(scene, start, prior, schedule, model, hold))


def solve_likeliest(
    scene: Scene, starts: Sequence[State], prior: Prior, *, schedule: Schedule
) -> Fit:
    """Find the pose as :func:`solve` does from each start, and return the fit of least cost."""
    found = [_descended(scene, start, prior, schedule, MODEL, None) for start in starts]
    return _described(*min(found, key=lambda each: each[1].total))


@dataclass(frozen=True, kw_only=True)
class Rest:
    """State and cost at which a fit stopped.

    Parameters
    ----------
    state : State
        A local optimum.
    cost : float
        The cost, as in :class:`Fit`.
    costs : (tracks,) array
        Cost of each vehicle, as in :class:`Fit`; the rest is that of the prior.
    by_offset : (tracks,) array
        As in :class:`Fit`.
    effects : list of (tracks, k) arrays
        Random effects, as in :class:`Fit`.
    """

    state: State
    cost: float
    costs: Floats
    by_offset: Floats
    effects: list[Floats]


def settle(
    scene: Scene, start: State, prior: Prior, *, schedule: Schedule, model: Model, hold: Floats
) -> Rest:
    """Find a pose as :func:`solve` does, but return only where it stopped.

    Parameters
    ----------
    scene, start, prior, schedule, model
        As for :func:`solve`.
    hold : (7,) array
        Weights of a linear combination of the state's components that is kept as at the start.
    """
    _, here, _ = _descended(scene, start, prior, schedule, model, hold)
    return Rest(
        state=here.point.state,
        cost=here.total,
        costs=_costs(scene.samples, here),
        by_offset=_by_offset(here),
        effects=here.point.effects,
    )


def _descended(
    scene: Scene,
    start: State | Rest,
    prior: Prior,
    schedule: Schedule,
    model: Model,
    hold: Floats | None,
) -> tuple[_Cost, _Here, bool]:
    """Return the cost function of the last stage, the point reached, and whether it converged."""
    if isinstance(start, State):
        point = _at_rest(scene, start)
    else:
        point = _Point(start.state, start.effects)
    converged, lever_m = False, np.repeat([1.0, LEVER_M], 3)
    for scale_m in schedule.scales_m:
        cost = _Cost(scene, prior, model, scale_m, hold)
        here = cost.at(point)
        for _ in range(schedule.rounds):
            step, effects, sigmas = cost.step(here)
            there, share = None, 1.0
            while share > _LEAST_SHARE and (there is None or there.total > here.total):
                moved = _Point(
                    here.point.state.moved(share * step),
                    [b + share * more for b, more in zip(here.point.effects, effects, strict=True)],
                )
                there, share = cost.at(moved), share / _SHRINK
            length_m = float(np.abs(step[:6] * lever_m).max())
            if there is None or there.total > here.total:
                converged = length_m < _AT_REST_M or sigmas < _AT_REST_SIGMAS
                break
            here = there
            converged = length_m < _SETTLED_M or sigmas < _SETTLED_SIGMAS
            if converged:
                break
        point = here.point
    return cost, here, converged


def cost_at(scene: Scene, state: State, *, model: Model = MODEL, scale_m: float = 0.0) -> float:
    """Return the cost of the traces at a state, without a prior: a negative log likelihood.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    state : State
        Pose of the sensor, and height of the reflections.
    model : Model
        How vehicles drive and reflect.
    scale_m : float
        Widening of all spreads (added in squares).
    """
    flat = Prior(mean=state, information=np.zeros((SIZE, SIZE)))
    point = _at_rest(scene, state)
    return _Cost(scene, flat, model, scale_m, None).at(point).total


@dataclass(frozen=True)
class _Point:
    state: State
    effects: list[Floats]


def _at_rest(scene: Scene, state: State) -> _Point:
    """Return the point of a state with all random effects, of vehicles and spells, at 0."""
    samples = scene.samples
    return _Point(state, [np.zeros((samples.tracks, 1)), np.zeros_like(samples.spell_reach)])


@dataclass(frozen=True, kw_only=True)
class _Here:
    point: _Point
    placed: Placed
    matches: Matches
    families: list[Residuals]
    total: float


@dataclass(frozen=True)
class _Cost:
    """The negative logarithm of the likelihood, and the steps that lower it."""

    scene: Scene
    prior: Prior
    model: Model
    scale_m: float
    hold: Floats | None

    def at(self, point: _Point) -> _Here:
        """Return residuals and cost at a point."""
        placed = place(self.scene.samples, point.state)
        matches = self.matches(placed, point.effects[0][:, 0])
        families = self.families(placed, matches, point.effects)
        away = point.state.difference(self.prior.mean)
        of_paths = float(matches.path_cost.sum())
        own = (  # most starts are compared without random effects
            np.einsum("ki,kij,kj", effect, f.stiffness, effect) if effect.any() else 0.0
            for f, effect in zip(families, point.effects, strict=True)
        )
        total = sum(
            float(f.weight @ f.loss + 0.5 * each) for f, each in zip(families, own, strict=True)
        )
        return _Here(
            point=point,
            placed=placed,
            matches=matches,
            families=families,
            total=total + of_paths + 0.5 * float(away @ self.prior.information @ away),
        )

    def matches(self, placed: Placed, aside: Floats) -> Matches:
        """Return the lane of each sample."""
        if not self.scene.keeps_lanes:
            return match(self.scene.lanes, placed)
        return match_paths(self.scene.lanes, placed, aside, model=self.model, scale_m=self.scale_m)

    def families(self, placed: Placed, matches: Matches, effects: list[Floats]) -> list[Residuals]:
        """Return all residuals of samples that lie on their lanes."""
        compared = self.compared(placed, matches)
        return [family(compared, effect) for family, effect in zip(_FAMILIES, effects, strict=True)]

    def compared(self, placed: Placed, matches: Matches) -> LaneComparison:
        """Return samples and lanes as the residuals compare them."""
        return LaneComparison(
            lanes=self.scene.lanes,
            placed=placed,
            matches=matches,
            model=self.model,
            scale_m=self.scale_m,
        )

    def step(self, here: _Here) -> tuple[Floats, list[Floats], float]:
        """Return the steps of state and random effects, and the state's step in sigmas."""
        normal = assemble(here.families, here.point.effects)
        information = normal.information + self.prior.information
        away = here.point.state.difference(self.prior.mean)
        gradient = normal.gradient + self.prior.information @ away
        step: Floats = np.asarray(-np.linalg.solve(information, gradient), dtype=np.float64)
        if self.hold is not None:
            way = np.linalg.solve(information, self.hold)
            step -= way * (self.hold @ step) / (self.hold @ way)
        effects = [-np.einsum("kij,kj->ki", a, r + g @ step) for r, g, a in normal.shared]
        return step, effects, float(np.sqrt(step @ information @ step))


def _described(cost: _Cost, here: _Here, converged: bool) -> Fit:  # noqa: FBT001
    """Return the fit at a point, with its information and evidence."""
    across = here.families[0]
    effects = here.point.effects
    normal = assemble(here.families, effects, curved=True)
    # a small share of the information with known faces, where the curvature is no minimum's
    known = assemble(here.families, effects).information + cost.prior.information
    information = at_least(
        normal.information + cost.prior.information,
        _LEAST_CURVATURE * known + FLOOR * np.eye(len(known)),
    )
    by_offset = _by_offset(here)
    groups, biases = biases_of(cost.scene, here.matches, normal.offsets)
    return Fit(
        state=here.point.state,
        information=information,
        data_information=information - cost.prior.information,
        scores=sums(cost.scene.samples.vehicles, normal.scores, cost.scene.samples.tracks),
        habits=habits_of(
            by_offset, across.stiffness[:, 0, 0], normal.shared[0][2][:, 0, 0], groups[0][0]
        ),
        by_offset=by_offset,
        groups=groups,
        biases=biases,
        cost=here.total,
        loss=across.weight * across.loss + here.matches.path_cost,
        aside=0.5 * np.square(effects[0][:, 0]) * across.stiffness[:, 0, 0],
        costs=_costs(cost.scene.samples, here),
        on_lane=_on_lane(cost, here),
        matches=here.matches,
        converged=converged,
        effects=here.point.effects,
        considered=cache(partial(_considered, cost, here)),
    )


def _on_lane(cost: _Cost, here: _Here) -> Booleans:
    """Return the samples that are more likely on a vehicle in their nearest lane than not."""
    across = here.families[0]
    if cost.scene.keeps_lanes:
        nearest = match(cost.scene.lanes, here.placed)
        across = lateral(cost.compared(here.placed, nearest), here.point.effects[0])
    return np.asarray(across.loss < NO_VEHICLE - np.log(2.0))


def _costs(samples: Samples, here: _Here) -> Floats:
    """Return the cost of rows and random effects of each vehicle; zeros beyond the last."""
    costs = np.bincount(samples.track, here.matches.path_cost, minlength=samples.tracks)
    for rows, effect in zip(here.families, here.point.effects, strict=True):
        costs += np.bincount(samples.track, rows.weight * rows.loss, minlength=samples.tracks)
        costs += 0.5 * np.einsum("ki,kij,kj->k", effect, rows.stiffness, effect)
    joined = np.bincount(samples.vehicles, costs, minlength=samples.tracks)
    return np.asarray(joined, dtype=np.float64)


def _by_offset(here: _Here) -> Floats:
    """Return the derivative of each vehicle's cost by a common offset across the lane, 1/m."""
    return np.asarray(here.point.effects[0][:, 0] * here.families[0].stiffness[:, 0, 0])


def _considered(cost: _Cost, here: _Here) -> Floats:
    """Return the change of the gradient by one standard deviation of each constant of the model.

    The gradient is the sum over the families, and each constant belongs to one of them.
    """
    effects = here.point.effects

    def gradient(model: Model, which: int) -> Floats:
        compared = replace(cost, model=model).compared(here.placed, here.matches)
        family = _FAMILIES[which](compared, effects[which])
        return assemble([family], [effects[which]], curved=True).gradient

    changes = []
    for name, less, more in cost.model.variations():
        which = _FAMILIES.index(height if name in _OF_HEIGHT else lateral)
        changes.append((gradient(more, which) - gradient(less, which)) / 2.0)
    return np.array(changes)


def at_least(information: Floats, floor: Floats) -> Floats:
    """Raise an information so that in no direction it is below a positive definite floor."""
    return _whitened(information, floor, np.maximum)


def at_most(covariance: Floats, most: Floats) -> Floats:
    """Limit a covariance so that in no direction it is above another one."""
    return _whitened(covariance, most, np.minimum)


def _whitened(matrix: Floats, bound: Floats, limit: np.ufunc) -> Floats:
    root: Floats = np.asarray(np.linalg.cholesky((bound + bound.T) / 2.0), dtype=np.float64)
    inverse = np.linalg.inv(root)
    return limited(root, inverse @ (matrix + matrix.T) @ inverse.T / 2.0, limit)


def limited(root: Floats, white: Floats, limit: np.ufunc) -> Floats:
    """Return `root white root'` with the eigenvalues of `white` limited by one."""
    values, vectors = np.linalg.eigh((white + white.T) / 2.0)
    wide = root @ vectors
    return np.asarray((wide * limit(values, 1.0)) @ wide.T)
