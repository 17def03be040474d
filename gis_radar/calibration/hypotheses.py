"""Hypotheses: starts from the search, fitted one by one, compared vehicle by vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.ndimage import minimum_filter
from scipy.spatial.transform import Rotation

from gis_radar.arrays import Floats
from gis_radar.calibration.adaptation import adapted
from gis_radar.calibration.certainty import LOOK_GAIN, advantage, along_valley
from gis_radar.calibration.lanes import LANE_CELL_M
from gis_radar.calibration.matching import Scene
from gis_radar.calibration.model import MODEL, Model
from gis_radar.calibration.search import TILT, Candidate, Levelling, level, search
from gis_radar.calibration.settings import LEVER_M, LOCALIZATION, LocalizationSettings
from gis_radar.calibration.solver import Fit, Prior, cost_at, solve
from gis_radar.calibration.state import POSE, REFLECTION, SIZE, State
from gis_radar.calibration.traces import Samples

# Prior of the mean height of reflections: between wheel hubs and belt lines.
REFLECTION_M = 0.6
REFLECTION_SIGMA_M = 0.25
ROUGH_SAMPLES = 1000  # enough to rank hypotheses; cost in proportion
GONE = 5.0  # standard deviations behind the first, beyond which none is a finalist
# Closer fits are one: easting, northing, height; turns about the axes.
TWIN_M = (0.3, 0.3, 0.5)
TWIN_RAD = (math.radians(0.5), math.radians(0.5), math.radians(0.3))
# Grid around an optimum on which better ones are looked for: half a vehicle's width apart, and so
# many steps to all sides and turns, which count at LEVER_M.
LOOK_M = 0.5
LOOK_STEPS = (3, 2)
# Widening of the spreads there (drivers differ by as much), samples that are looked at, and how
# many of the lowest places are fitted.
LOOK_SCALE_M = 0.3
LOOK_SAMPLES = 400
LOOK_PLACES = 4

# Peaks that are fitted, without and with a heading; cost in proportion.
CANDIDATES = 10
KNOWN_CANDIDATES = 4

PLANE = [0, 1, 5]  # of the state: easting, northing, turn about the vertical


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One way to lay the recording on the map.

    Parameters
    ----------
    fit : Fit
        The local optimum.
    prior : Prior
        With which it was found.
    score : float
        How well the search alone laid the samples on the lanes there, 0 to 1.
    model : Model
        How vehicles drive and reflect.
    rival : State or None
        Another optimum, so near that both are one answer.
    """

    fit: Fit
    prior: Prior
    score: float = 0.0
    model: Model = MODEL
    rival: State | None = None

    @property
    def loss(self) -> float:
        """Mean loss of the samples."""
        return float(self.fit.loss.mean())


def find_hypotheses(scene: Scene, *, heading: tuple[float, float] | None) -> list[Hypothesis]:
    """Return hypotheses that differ, the best first, fitted to a part of the samples.

    Parameters
    ----------
    scene : Scene
        The map around the guess, and the traces.
    heading : (yaw, tolerance) or None
        Radians; without it all headings are tried.
    """
    levelling, part = level(scene), rough(scene)
    most = CANDIDATES if heading is None else KNOWN_CANDIDATES
    found = _searched(scene, levelling, heading, most)
    tried = [_rough_fit(part, _start(part, levelling, c), c.score) for c in found]
    return _ranked(tried)


def search_score(scene: Scene, *, heading: tuple[float, float] | None) -> float:
    """Return how well the search alone can lay samples on the lanes, 0 to 1.

    Parameters
    ----------
    scene, heading
        As for :func:`find_hypotheses`.
    """
    return _searched(scene, level(scene), heading, 1)[0].score


def _searched(
    scene: Scene, levelling: Levelling, heading: tuple[float, float] | None, most: int
) -> list[Candidate]:
    levelled = scene.samples.points @ levelling.R_level_sensor.T
    return search(scene, levelled, heading=heading, most=most)


def rough(scene: Scene) -> Scene:
    """Return the scene with an even part of the samples, enough to rank hypotheses."""
    return _part(scene, ROUGH_SAMPLES)


def _part(scene: Scene, most: int) -> Scene:
    samples = scene.samples
    chosen = np.random.default_rng(1).permutation(len(samples))[:most]
    return scene.of(samples.where(np.isin(np.arange(len(samples)), chosen)))


def _settled(scene: Scene, hypothesis: Hypothesis, start: State) -> Hypothesis:
    schedule = scene.settings.hypotheses.settle
    fit = solve(scene, start, hypothesis.prior, schedule=schedule)
    return replace(hypothesis, fit=fit)


def refine(scene: Scene, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Fit the first hypotheses to all samples, and return them the best first.

    The best one is looked at in full, and so is each that could still overtake it.
    """
    part, best, settings = rough(scene), hypotheses[0], scene.settings.hypotheses
    near = [h for h in hypotheses if advantage(best.fit, h.fit, part.samples) < GONE]
    finalists = near[: settings.finalists]
    settled = _ranked([_settled(part, h, h.fit.state) for h in finalists])
    fine = _ranked([_fine(scene, h) for h in settled])
    looked = _with_rivals(fine, scene, partial(look_around, scene))
    return _with_rivals(looked, scene, partial(_adapted, scene))


def _with_rivals(
    ranked: Sequence[Hypothesis], scene: Scene, better: Callable[[Hypothesis], Hypothesis]
) -> list[Hypothesis]:
    """Improve the best hypothesis and its rivals, and return all, the best first."""
    first, rival = ranked[0], scene.settings.hypotheses.rival
    near = [advantage(first.fit, h.fit, scene.samples) < rival for h in ranked]
    improved = [better(h) if close else h for h, close in zip(ranked, near, strict=True)]
    return _ranked(improved)


def look_around(scene: Scene, best: Hypothesis) -> Hypothesis:
    """Look for better optima around one: by the likelihood on a grid, and from its best places.

    Which face of which vehicle a trace shows, and to which lane it belongs, make the cost bumpy in
    the small where drivers keep off the middle of their lanes.
    """
    settings = scene.settings.hypotheses
    aside, turned = (np.arange(-n, n + 1) * LOOK_M for n in LOOK_STEPS)
    few = _part(scene, LOOK_SAMPLES)
    grid = np.stack(np.meshgrid(aside, aside, turned / LEVER_M, indexing="ij"), axis=-1)
    steps = np.zeros((grid.size // 3, SIZE))
    steps[:, PLANE] = grid.reshape(-1, 3)
    for _ in range(settings.looks):
        starts = [best.fit.state.moved(step) for step in steps]
        costs = np.array([cost_at(few, start, scale_m=LOOK_SCALE_M) for start in starts])
        costs = costs.reshape(grid.shape[:3])
        lowest = np.argwhere(costs == minimum_filter(costs, size=3))
        order = np.argsort(costs[tuple(lowest.T)])[:LOOK_PLACES]
        chosen = np.ravel_multi_index(tuple(lowest[order].T), costs.shape)
        others = [_settled(scene, best, starts[k]) for k in chosen]
        better = min(others, key=lambda h: h.fit.cost)
        if better.fit.cost > best.fit.cost - LOOK_GAIN:
            break
        best = better
    return best


def _fine(scene: Scene, hypothesis: Hypothesis) -> Hypothesis:
    h, schedule = hypothesis, scene.settings.hypotheses.fine
    return replace(h, fit=solve(scene, h.fit.state, h.prior, schedule=schedule, model=h.model))


def _adapted(scene: Scene, fine: Hypothesis) -> Hypothesis:
    """Fit to all samples, with prior and model adapted to them."""
    prior, model = adapted(scene, fine.fit, fine.prior, fine.model)
    return _fine(scene, replace(fine, model=model, prior=prior))


def widen_by_profile(scene: Scene, hypothesis: Hypothesis) -> Hypothesis:
    """Widen sigma along the least-known direction by profile likelihood."""
    h = hypothesis
    return replace(h, fit=along_valley(scene, h.fit, h.prior, h.model))


def _start(scene: Scene, levelling: Levelling, candidate: Candidate) -> State:
    """Return the state at a candidate, at the height that puts the traces over the road."""
    lanes = scene.lanes
    turn = Rotation.from_euler("Z", candidate.yaw).as_matrix()
    state = State(
        position=np.array([*candidate.place, 0.0]),
        R_map_sensor=turn @ levelling.R_level_sensor,
        reflection=REFLECTION_M,
    )
    points = state.to_map(scene.samples.points)
    cell = np.floor((points[:, :2] - lanes.corner) / LANE_CELL_M).astype(np.int64)
    _, rows, columns = lanes.distance.shape
    inside = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1)
    column, row = cell[inside].T
    nearest = np.argmin(lanes.distance[:, row, column], axis=0)
    lane = lanes.nearest[nearest, row, column]
    over = lanes.points[lane, 2] + REFLECTION_M - points[inside, 2]
    over = over[(lane >= 0) & np.isfinite(over)]
    known = lanes.points[:, 2][np.isfinite(lanes.points[:, 2])]
    height = np.median(over) if len(over) else np.median(known) + levelling.depth_m
    return replace(state, position=np.array([*candidate.place, float(height)]))


def prior_at(state: State, settings: LocalizationSettings = LOCALIZATION) -> Prior:
    """Return what is known before looking: about where the guess is, a mast that hardly leans.

    Parameters
    ----------
    state : State
        A start; its tilt is the levelled one, the guess is the local (0, 0).
    settings : LocalizationSettings
        The standard deviations.
    """
    guess_m, tilt = settings.search.guess_m, TILT
    information = np.zeros((SIZE, SIZE))
    sigma = np.array([guess_m / 2, guess_m / 2, guess_m, tilt, tilt, np.pi])
    information[POSE, POSE] = np.diag(sigma**-2)
    information[REFLECTION, REFLECTION] = REFLECTION_SIGMA_M**-2
    mean = replace(state, position=np.array([0.0, 0.0, state.position[2]]))
    return Prior(mean=mean, information=information)


def _rough_fit(scene: Scene, start: State, score: float) -> Hypothesis:
    prior = prior_at(start, scene.settings)
    fit = solve(scene, start, prior, schedule=scene.settings.hypotheses.rough)
    return Hypothesis(fit=fit, prior=prior, score=score)


def _ranked(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses the best first, without what another, better one has found as well."""
    twin = np.array([*TWIN_M, *TWIN_RAD])
    kept: list[Hypothesis] = []
    for h in sorted(hypotheses, key=lambda h: h.loss):
        gaps = [np.abs(h.fit.state.difference(k.fit.state)[POSE]) / twin for k in kept]
        if not any((gap < 1.0).all() for gap in gaps):
            kept.append(h)
    return kept


def mirrored(samples: Samples) -> Samples:
    """Return the samples of a sensor whose y axis points to the other side."""
    points: Floats = samples.points * [1.0, -1.0, 1.0]
    return replace(samples, points=points)
