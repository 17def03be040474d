"""Hypotheses of a pose, found by a search over places and headings, fitted and compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial.transform import Rotation

from gis_radar.base import Booleans, Floats, compiled
from gis_radar.calibration.registration.adaptation import adapted
from gis_radar.calibration.registration.certainty import (
    FINE,
    LOOK_GAIN,
    LOOKS,
    PLANE,
    advantage,
    along_valley,
)
from gis_radar.calibration.registration.lanes import LANE_CELL_M, Lanes, Scene, place
from gis_radar.calibration.registration.matches import match
from gis_radar.calibration.registration.model import MODEL, Model
from gis_radar.calibration.registration.solver import Fit, Prior, Schedule, cost_at, solve
from gis_radar.calibration.registration.state import LEVER_M, POSE, REFLECTION, SIZE, State
from gis_radar.calibration.registration.traces import Samples

GUESS_M = 15.0  # how far a guess may be off (contract)
HEADING_TOLERANCE = math.radians(30.0)  # to either side of a heading: 25 degrees (contract) + slack
# Schedules of the first fit of every candidate, and of each finalist, to a part of the samples.
ROUGH = Schedule(scales_m=(1.5, 0.75, 0.3), rounds=4)
SETTLE = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=4)
FINALISTS = 4  # hypotheses that are fitted to the end, at most
# Hypotheses within so many standard deviations of the best are fitted in full, which improves them
# by about half of one; more than the z score of a clear answer.
RIVAL = 3.5
BEYOND_GUESS_M = 2.0  # margin of the search beyond the largest error of a guess
TILT = math.radians(6.0)  # 1 sigma of the tilt of masts and roads
# 1 sigma of reflections about the levelled plane: vehicles, and elevation noise (radians).
LEVEL_SPREAD_M = 0.5
LEVEL_ELEVATION = math.radians(0.6)
LEVEL_ROUNDS = 12  # reweighted fits of the plane; it settles in five to eight
SCORED = 900  # samples scored; cost in proportion
SIGHTS = 64  # bins of the direction of sight, 5.6 degrees
# Spread (1 sigma) across a lane; steps of the grids of places, and of headings (1.7 m at 50 m).
SPREAD_M = 2.0
STEP_M = 2.0
YAW_STEP = math.radians(2.0)
# Cosine by which a lane's direction may disagree with the Doppler's sign (15 degrees).
BESIDE = 0.25
# Peaks closer than this are one.
NEAR_M = 3.0
NEAR_RAD = math.radians(5.0)
# Prior of the mean height of reflections: between wheel hubs and belt lines. (The check of a
# given pose takes 0.7: with it the sample's height is right to 0.05 m, with 0.6 to 0.1 m.)
REFLECTION_M = 0.6
REFLECTION_SIGMA_M = 0.25
ROUGH_SAMPLES = 1000  # enough to rank hypotheses; cost in proportion
GONE = 5.0  # hypotheses farther behind the best (standard deviations) are no finalists
# Fits closer than this are one: easting, northing, height; turns about the axes.
TWIN_M = (0.3, 0.3, 0.5)
TWIN_RAD = (math.radians(0.5), math.radians(0.5), math.radians(0.3))
# Grid around an optimum on which better ones are looked for: its step, half a vehicle's width, and
# the number of steps to every side and of turns to either side (a turn in metres at LEVER_M).
LOOK_M = 0.5
LOOK_STEPS = (3, 2)
# Widening of the spreads on this grid (drivers differ by as much), number of samples scored, and
# number of the lowest places that are fitted.
LOOK_SCALE_M = 0.3
LOOK_SAMPLES = 400
LOOK_PLACES = 4
# Peaks that are fitted, without and with a heading; cost in proportion.
CANDIDATES = 10
KNOWN_CANDIDATES = 4


@dataclass(frozen=True, kw_only=True)
class Levelling:
    """The road plane as the sensor sees it.

    Parameters
    ----------
    R_level_sensor : (3, 3) array
        Rotation from the sensor frame to one in which the road's plane is level and below; the
        heading of the x axis stays.
    depth_m : float
        Height of the sensor over the plane of the reflections.
    """

    R_level_sensor: Floats
    depth_m: float


def level(scene: Scene) -> Levelling:
    """Fit a plane to the traces, robustly; where it lies above the sensor, that is upside down.

    Parameters
    ----------
    scene : Scene
        The traces.
    """
    samples = scene.samples
    x, y, z = samples.points.T
    rows = np.column_stack([x, y, np.ones(len(x))])
    reach = np.linalg.norm(samples.points, axis=1)
    sigma = np.hypot(LEVEL_SPREAD_M, LEVEL_ELEVATION * reach)
    prior = np.diag([TILT**-2, TILT**-2, 0.0])
    weight = sigma**-2
    plane = np.array([0.0, 0.0, float(np.median(z))])
    for _ in range(LEVEL_ROUNDS):
        weight = sigma**-2 / (1.0 + ((z - rows @ plane) / (2.0 * sigma)) ** 2) ** 2
        plane = np.linalg.solve(rows.T @ (weight[:, None] * rows) + prior, rows.T @ (weight * z))
    up = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1.0 + plane[0] ** 2 + plane[1] ** 2)
    depth = -plane[2] * up[2]
    if depth < 0.0:
        up, depth = -up, -depth
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    return Levelling(
        R_level_sensor=np.vstack([ahead, np.cross(up, ahead), up]), depth_m=float(depth)
    )


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A place and a heading that the search found.

    Parameters
    ----------
    place : (2,) array
        Local easting and northing, metres.
    yaw : float
        Radians.
    score : float
        Mean closeness of the traces to lanes, 0 to 1.
    """

    place: Floats
    yaw: float
    score: float


def search(
    scene: Scene, levelled: Floats, *, heading: tuple[float, float] | None, most: int
) -> list[Candidate]:
    """Score every place and heading on a grid, and return the best that differ.

    Parameters
    ----------
    scene : Scene
        The lanes around the guess, which is the local (0, 0), and the traces.
    levelled : (n, 3) array
        The traces' points in a levelled sensor frame: z up, yaw unknown.
    heading : (yaw, tolerance) or None
        Radians; without it all headings are tried.
    most : int
        Candidates to return, the best first.
    """
    lanes, samples = scene.lanes, scene.samples
    chosen = np.random.default_rng(0).permutation(len(samples))[:SCORED]
    points, away = levelled[chosen, :2].copy(), samples.range_rate[chosen] > 0.0
    places, yaws = _places(GUESS_M + BEYOND_GUESS_M, STEP_M), _yaws(heading, YAW_STEP)
    scores = _score(closeness(lanes), lanes.corner, LANE_CELL_M, points, away, places, yaws)
    return _peaks(np.asarray(scores), places, yaws, most)


def _yaws(heading: tuple[float, float] | None, step: float) -> Floats:
    centre, tolerance = heading or (0.0, np.pi)
    count = int(np.ceil(tolerance / step))
    steps = np.arange(-count, count + 1) * tolerance / count
    return np.asarray(centre + (steps[:-1] if heading is None else steps))


def _places(radius_m: float, step_m: float) -> Floats:
    count = np.ceil(radius_m / step_m)
    steps = np.arange(-count, count + 1) * step_m
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(grid[np.hypot(*grid.T) <= radius_m])


def closeness(lanes: Lanes) -> NDArray[np.uint8]:
    """Return for each direction of sight how close each cell is to lanes that lead away along it.

    Parameters
    ----------
    lanes : Lanes
        The map.

    Returns
    -------
    (sights, rows, columns) uint8 array
        255 on a centre line. For approaching traffic the layer of the opposite direction of sight
        is looked up.
    """
    near = np.exp(-0.5 * (lanes.distance / SPREAD_M) ** 2)
    sights, bins = SIGHTS, len(near)
    ways = np.arange(bins) * (2.0 * np.pi / bins)
    out = np.zeros((sights, *near.shape[1:]), dtype=np.uint8)
    bytes_near = np.rint(near * 255.0).astype(np.uint8)
    for sight in range(sights):
        agree = np.cos(ways - sight * (2.0 * np.pi / sights)) > -BESIDE
        out[sight] = bytes_near[agree].max(axis=0)
    return out


def _peaks(scores: Floats, places: Floats, yaws: Floats, most: int) -> list[Candidate]:
    """Return the best candidates, no two of them close to each other."""
    order = np.argsort(-scores, axis=None)[: 400 * most]
    kept: list[Candidate] = []
    for flat in order:
        i, j = divmod(int(flat), scores.shape[1])
        place, yaw = places[i], float(yaws[j])
        twin = any(
            np.hypot(*(place - other.place)) < NEAR_M
            and abs(math.remainder(yaw - other.yaw, math.tau)) < NEAR_RAD
            for other in kept
        )
        if not twin:
            kept.append(Candidate(place=place, yaw=yaw, score=float(scores[i, j])))
            if len(kept) == most:
                break
    return kept


@compiled
def _score(
    close: NDArray[np.uint8],
    corner: Floats,
    cell_m: float,
    points: Floats,
    away: Booleans,
    places: Floats,
    yaws: Floats,
) -> Floats:
    """Return the mean closeness for each place (rows) and yaw (columns)."""
    sights, rows, columns = close.shape
    cells, per_m = close.reshape(sights, rows * columns), 1.0 / cell_m
    total = np.zeros((len(places), len(yaws)))
    east, north = places[:, 0].copy(), places[:, 1].copy()
    # Cells first, what lies in them then: so the first loop takes several places at a time.
    column, row = np.empty(len(places), np.int32), np.empty(len(places), np.int32)
    sums = np.empty(len(places), np.int32)
    for j in range(len(yaws)):
        cos, sin = np.cos(yaws[j]), np.sin(yaws[j])
        sums[:] = 0
        for k in range(len(points)):
            x = cos * points[k, 0] - sin * points[k, 1]
            y = sin * points[k, 0] + cos * points[k, 1]
            turn = np.arctan2(y, x) / (2.0 * np.pi) + (0.0 if away[k] else 0.5)
            seen = cells[int(np.rint(turn * sights)) % sights]
            for i in range(len(places)):
                column[i] = np.int32((x + east[i] - corner[0]) * per_m)
                row[i] = np.int32((y + north[i] - corner[1]) * per_m)
            for i in range(len(places)):
                if 0 <= column[i] < columns and 0 <= row[i] < rows:
                    sums[i] += seen[row[i] * columns + column[i]]
        total[:, j] = sums
    return total / (255.0 * max(len(points), 1))


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One way to place the recording on the map.

    Parameters
    ----------
    fit : Fit
        The local optimum.
    prior : Prior
        The prior with which it was found.
    score : float
        Score of the search at its candidate, 0 to 1.
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
    """Find hypotheses that differ, the best first, fitted to a part of the samples.

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
    """Return the best score of the search over places and headings, 0 to 1.

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


def few_samples(scene: Scene) -> Scene:
    """Return the scene with as few samples as a grid of starts is compared by."""
    return _part(scene, LOOK_SAMPLES)


def _part(scene: Scene, most: int) -> Scene:
    samples = scene.samples
    chosen = np.random.default_rng(1).permutation(len(samples))[:most]
    return scene.of(samples.where(np.isin(np.arange(len(samples)), chosen)))


def _settled(scene: Scene, hypothesis: Hypothesis, start: State) -> Hypothesis:
    return replace(hypothesis, fit=solve(scene, start, hypothesis.prior, schedule=SETTLE))


def refine(scene: Scene, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Fit the first hypotheses to all samples, and return them the best first.

    The best one, and each that could still overtake it, is improved by :func:`look_around` and
    fitted with prior and model adapted to the recording.
    """
    part, best = rough(scene), hypotheses[0]
    near = [h for h in hypotheses if advantage(best.fit, h.fit, part.samples) < GONE]
    settled = _ranked([_settled(part, h, h.fit.state) for h in near[:FINALISTS]])
    fine = _ranked([_fine(scene, h) for h in settled])
    looked = _with_rivals(fine, scene, partial(look_around, scene))
    return _with_rivals(looked, scene, partial(_adapted, scene))


def _with_rivals(
    ranked: Sequence[Hypothesis], scene: Scene, better: Callable[[Hypothesis], Hypothesis]
) -> list[Hypothesis]:
    """Improve the best hypothesis and its rivals, and return all, the best first."""
    near = [advantage(ranked[0].fit, h.fit, scene.samples) < RIVAL for h in ranked]
    improved = [better(h) if close else h for h, close in zip(ranked, near, strict=True)]
    return _ranked(improved)


def look_around(scene: Scene, best: Hypothesis) -> Hypothesis:
    """Look for better optima around one: score a grid of places, and fit from its best ones.

    The choice of face and lane for each sample gives the cost many local optima within a metre,
    where drivers keep off the middle of their lanes.
    """
    aside, turned = (np.arange(-n, n + 1) * LOOK_M for n in LOOK_STEPS)
    few = few_samples(scene)
    grid = np.stack(np.meshgrid(aside, aside, turned / LEVER_M, indexing="ij"), axis=-1)
    steps = np.zeros((grid.size // 3, SIZE))
    steps[:, PLANE] = grid.reshape(-1, 3)
    for _ in range(LOOKS):
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
    h = hypothesis
    return replace(h, fit=solve(scene, h.fit.state, h.prior, schedule=FINE, model=h.model))


def _adapted(scene: Scene, fine: Hypothesis) -> Hypothesis:
    """Fit to all samples, with prior and model adapted to them."""
    prior, model = adapted(scene, fine.fit, fine.prior, fine.model)
    return _fine(scene, replace(fine, model=model, prior=prior))


def widen_by_profile(scene: Scene, hypothesis: Hypothesis) -> Hypothesis:
    """Widen sigma along the least-known direction by profile likelihood."""
    h = hypothesis
    return replace(h, fit=along_valley(scene, h.fit, h.prior, h.model))


def _start(scene: Scene, levelling: Levelling, candidate: Candidate) -> State:
    """Return the state at a candidate, at the height at which the traces lie over the road."""
    lanes = scene.lanes
    turn = Rotation.from_euler("Z", candidate.yaw).as_matrix()
    state = State(
        position=np.array([*candidate.place, 0.0]),
        R_map_sensor=turn @ levelling.R_level_sensor,
        reflection=REFLECTION_M,
    )
    placed = place(scene.samples, state)
    flat = placed.points * [1.0, 1.0, np.nan]
    matches = match(lanes, replace(placed, points=flat))
    over = lanes.points[matches.lane, 2] + REFLECTION_M - placed.points[:, 2]
    over = over[matches.found & np.isfinite(over)]
    known = lanes.points[:, 2][np.isfinite(lanes.points[:, 2])]
    height = np.median(over) if len(over) else np.median(known) + levelling.depth_m
    return replace(state, position=np.array([*candidate.place, float(height)]))


def prior_at(state: State) -> Prior:
    """Return the prior of a start: a place near the guess, and a mast that hardly leans.

    Parameters
    ----------
    state : State
        A start, with the tilt of the levelling; the guess is the local (0, 0).
    """
    information = np.zeros((SIZE, SIZE))
    sigma = np.array([GUESS_M / 2, GUESS_M / 2, GUESS_M, TILT, TILT, np.pi])
    information[POSE, POSE] = np.diag(sigma**-2)
    information[REFLECTION, REFLECTION] = REFLECTION_SIGMA_M**-2
    mean = replace(state, position=np.array([0.0, 0.0, state.position[2]]))
    return Prior(mean=mean, information=information)


def _rough_fit(scene: Scene, start: State, score: float) -> Hypothesis:
    prior = prior_at(start)
    fit = solve(scene, start, prior, schedule=ROUGH)
    return Hypothesis(fit=fit, prior=prior, score=score)


def _ranked(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses the best first, without those that are near a better one."""
    twin = np.array([*TWIN_M, *TWIN_RAD])
    kept: list[Hypothesis] = []
    for h in sorted(hypotheses, key=lambda h: h.loss):
        gaps = [np.abs(h.fit.state.difference(k.fit.state)[POSE]) / twin for k in kept]
        if not any((gap < 1.0).all() for gap in gaps):
            kept.append(h)
    return kept


def mirrored(samples: Samples) -> Samples:
    """Return the samples with the sign of y changed, as if left and right were swapped."""
    points: Floats = samples.points * [1.0, -1.0, 1.0]
    return replace(samples, points=points)
