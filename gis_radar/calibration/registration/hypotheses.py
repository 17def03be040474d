"""Find hypotheses of a pose by a search over places and headings, fit and compare them."""

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
from gis_radar.calibration.registration.solver import (
    Fit,
    Prior,
    Schedule,
    cost_at,
    solve,
    solve_likeliest,
)
from gis_radar.calibration.registration.state import LEVER_M, POSE_PART, REFLECTION, SIZE, State
from gis_radar.calibration.registration.traces import Samples

GUESS_M = 15.0  # largest error of a guess (docs/limits.md)
HEADING_TOLERANCE = math.radians(30.0)  # to either side of a heading: documented 25 degrees + slack
# Schedules of the first fit of every candidate, and of each finalist, to a part of the samples.
_ROUGH = Schedule(scales_m=(1.5, 0.75, 0.3), rounds=4)
_SETTLE = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=4)
_FINALISTS = 4  # most hypotheses that are fitted to all samples
# Hypotheses within this z score of the best are improved, which gains about 0.5; it exceeds the z
# score of a clear answer.
_CLOSE_Z = 3.5
_BEYOND_GUESS_M = 2.0  # margin of the search beyond the largest error of a guess
_TILT = math.radians(6.0)  # 1 sigma of the tilt of masts and roads
# 1 sigma of reflections about the road plane: vehicles, and elevation noise (radians).
_LEVEL_SPREAD_M = 0.5
_LEVEL_ELEVATION = math.radians(0.6)
_LEVEL_ROUNDS = 12  # reweighted fits of the plane; it converges in five to eight
_SCORED_SAMPLES = 900  # samples that the search scores; cost in proportion
_SIGHTS = 64  # bins of the direction of sight, 5.6 degrees
# 1 sigma across a lane in the search; steps of its grid of places, and of headings (1.7 m at 50 m).
SPREAD_M = 2.0
_STEP_M = 2.0
_YAW_STEP = math.radians(2.0)
# A lane disagrees with the Doppler's sign if the cosine between lane and sight is below minus this
# (15 degrees).
_OPPOSITE_COSINE = 0.25
# Peaks of the search that are closer are one.
_NEAR_M = 3.0
_NEAR_RAD = math.radians(5.0)
# Prior of the mean height of reflections: between wheel hubs and belt lines. The check of a given
# pose takes 0.7, with which the sample's height is right to 0.05 m, with 0.6 to 0.1 m.
PRIOR_REFLECTION_M = 0.6
_REFLECTION_SIGMA_M = 0.25
_ROUGH_SAMPLES = 1000  # enough to rank hypotheses; cost in proportion
_MOST_BEHIND = 5.0  # hypotheses whose z score is farther behind the best are no finalists
# Fits that are closer are one: easting, northing, height; rotations about the axes.
_SAME_M = (0.3, 0.3, 0.5)
_SAME_RAD = (math.radians(0.5), math.radians(0.5), math.radians(0.3))
# Grid of starts around an optimum: step, half a vehicle's width, and number of steps to each side
# in place and in yaw (its steps in metres at LEVER_M).
_LOOK_M = 0.5
_LOOK_STEPS = (3, 2)
# On this grid: standard deviation added to that of the model, as large as that of drivers; number
# of samples; number of local minima from which fits start.
LOOK_SCALE_M = 0.3
_LOOK_SAMPLES = 400
_LOOK_PLACES = 4
# Number of peaks that are fitted, without and with a heading; cost in proportion.
_CANDIDATES = 10
_KNOWN_CANDIDATES = 4


@dataclass(frozen=True, kw_only=True)
class Levelling:
    """Road plane in the sensor frame.

    Parameters
    ----------
    R_level_sensor : (3, 3) array
        Rotation from the sensor frame to a level one, with the road plane horizontal and below the
        sensor, and the heading of the x axis unchanged.
    depth_m : float
        Height of the sensor over the plane of the reflections, metres.
    """

    R_level_sensor: Floats
    depth_m: float


def level(scene: Scene) -> Levelling:
    """Fit the road plane to the traces, robustly (iteratively reweighted least squares).

    A plane above the sensor means that the sensor is mounted upside down.

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    """
    samples = scene.samples
    x, y, z = samples.points.T
    rows = np.column_stack([x, y, np.ones(len(x))])
    reach = np.linalg.norm(samples.points, axis=1)
    sigma = np.hypot(_LEVEL_SPREAD_M, _LEVEL_ELEVATION * reach)
    prior = np.diag([_TILT**-2, _TILT**-2, 0.0])
    weight = sigma**-2
    plane = np.array([0.0, 0.0, float(np.median(z))])
    for _ in range(_LEVEL_ROUNDS):
        weight = sigma**-2 / (1.0 + ((z - rows @ plane) / (2.0 * sigma)) ** 2) ** 2
        plane = np.linalg.solve(rows.T @ (weight[:, None] * rows) + prior, rows.T @ (weight * z))
    up = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1.0 + plane[0] ** 2 + plane[1] ** 2)
    depth = -plane[2] * up[2]
    if depth < 0.0:
        up, depth = -up, -depth
    x_axis = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x_axis /= np.linalg.norm(x_axis)
    return Levelling(
        R_level_sensor=np.vstack([x_axis, np.cross(up, x_axis), up]), depth_m=float(depth)
    )


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Place and heading that the search found.

    Parameters
    ----------
    place : (2,) array
        Local easting and northing, metres.
    yaw : float
        Radians.
    score : float
        Mean over the samples of their closeness to lanes (:func:`closeness`), 0 to 1.
    """

    place: Floats
    yaw: float
    score: float


def search(
    scene: Scene, levelled: Floats, *, heading: tuple[float, float] | None, most: int
) -> list[Candidate]:
    """Score every place and heading on a grid, and return the best local maxima, the best first.

    Parameters
    ----------
    scene : Scene
        The lanes around the guess, which is the local (0, 0), and the traces.
    levelled : (n, 3) array
        The traces' points in the level sensor frame, metres.
    heading : (yaw, tolerance) or None
        Radians; without it all headings are tried.
    most : int
        Largest number of candidates.
    """
    lanes, samples = scene.lanes, scene.samples
    chosen = np.random.default_rng(0).permutation(len(samples))[:_SCORED_SAMPLES]
    points, away = levelled[chosen, :2].copy(), samples.range_rate[chosen] > 0.0
    places, yaws = _places(GUESS_M + _BEYOND_GUESS_M, _STEP_M), _yaws(heading, _YAW_STEP)
    layers = closeness(lanes)
    scores = _mean_closeness(layers, lanes.corner, LANE_CELL_M, points, away, places, yaws)
    return _peaks(np.asarray(scores), places, yaws, most)


def _yaws(heading: tuple[float, float] | None, step: float) -> Floats:
    """Return yaws about `step` apart (radians) within the tolerance of a heading, or all around."""
    centre, tolerance = heading or (0.0, np.pi)
    count = int(np.ceil(tolerance / step))
    steps = np.arange(-count, count + 1) * tolerance / count
    return np.asarray(centre + (steps[:-1] if heading is None else steps))


def _places(radius_m: float, step_m: float) -> Floats:
    """Return (n, 2) places on a square grid within a radius of the local origin, metres."""
    count = np.ceil(radius_m / step_m)
    steps = np.arange(-count, count + 1) * step_m
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(grid[np.hypot(*grid.T) <= radius_m])


def closeness(lanes: Lanes) -> NDArray[np.uint8]:
    """Return for each direction of sight and cell the closeness to lanes on which vehicles recede.

    Closeness is a Gaussian of the distance to the centre line. Vehicles on a lane recede if it
    does not lead against the direction of sight, by more than 15 degrees across.

    Parameters
    ----------
    lanes : Lanes
        The map.

    Returns
    -------
    (sights, rows, columns) uint8 array
        255 on a centre line. For approaching traffic take the layer of the opposite direction.
    """
    near = np.exp(-0.5 * (lanes.distance / SPREAD_M) ** 2)
    sights, bins = _SIGHTS, len(near)
    directions = np.arange(bins) * (2.0 * np.pi / bins)
    layers = np.zeros((sights, *near.shape[1:]), dtype=np.uint8)
    near_bytes = np.rint(near * 255.0).astype(np.uint8)
    for sight in range(sights):
        agree = np.cos(directions - sight * (2.0 * np.pi / sights)) > -_OPPOSITE_COSINE
        layers[sight] = near_bytes[agree].max(axis=0)
    return layers


def _peaks(scores: Floats, places: Floats, yaws: Floats, most: int) -> list[Candidate]:
    """Return the best candidates, at least `_NEAR_M` or `_NEAR_RAD` from each other."""
    order = np.argsort(-scores, axis=None)[: 400 * most]
    peaks: list[Candidate] = []
    for index in order:
        i, j = divmod(int(index), scores.shape[1])
        place, yaw = places[i], float(yaws[j])
        close = any(
            np.hypot(*(place - other.place)) < _NEAR_M
            and abs(math.remainder(yaw - other.yaw, math.tau)) < _NEAR_RAD
            for other in peaks
        )
        if not close:
            peaks.append(Candidate(place=place, yaw=yaw, score=float(scores[i, j])))
            if len(peaks) == most:
                break
    return peaks


@compiled
def _mean_closeness(
    closeness_layers: NDArray[np.uint8],
    corner: Floats,
    cell_m: float,
    points: Floats,
    receding: Booleans,
    places: Floats,
    yaws: Floats,
) -> Floats:
    """Return the mean closeness of the points for each place (rows) and yaw (columns)."""
    sights, rows, columns = closeness_layers.shape
    cells, per_m = closeness_layers.reshape(sights, rows * columns), 1.0 / cell_m
    total = np.zeros((len(places), len(yaws)))
    # places are whole cells apart: a point that moves with them stays at its place within a cell
    east, north = (np.rint(places[:, 0] * per_m), np.rint(places[:, 1] * per_m))
    offset, reach = (north * columns + east).astype(np.int64), int(np.abs(places).max() * per_m) + 1
    sums = np.empty(len(places), np.int32)
    for j in range(len(yaws)):
        cos, sin = np.cos(yaws[j]), np.sin(yaws[j])
        sums[:] = 0
        for k in range(len(points)):
            x = cos * points[k, 0] - sin * points[k, 1]
            y = sin * points[k, 0] + cos * points[k, 1]
            turn = np.arctan2(y, x) / (2.0 * np.pi) + (0.0 if receding[k] else 0.5)
            layer = cells[int(np.rint(turn * sights)) % sights]
            column, row = np.floor((x - corner[0]) * per_m), np.floor((y - corner[1]) * per_m)
            if min(column, row, columns - 1 - column, rows - 1 - row) >= reach:
                here = int(row) * columns + int(column)
                for i in range(len(places)):
                    sums[i] += layer[here + offset[i]]
                continue
            for i in range(len(places)):
                at_row, at_column = int(row + north[i]), int(column + east[i])
                if 0 <= at_column < columns and 0 <= at_row < rows:
                    sums[i] += layer[at_row * columns + at_column]
        total[:, j] = sums
    return total / (255.0 * max(len(points), 1))


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """Hypothesis of a pose: a local optimum of the registration.

    Parameters
    ----------
    fit : Fit
        The local optimum.
    prior : Prior
        The prior of that fit.
    score : float
        Score of the search at the candidate from which the fit began, 0 to 1.
    model : Model
        How vehicles drive and reflect.
    rival : State or None
        Another optimum, too near to be another answer; it widens the covariance.
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
    """Find hypotheses by search and fit to a part of the samples, without twins, the best first.

    Parameters
    ----------
    scene : Scene
        The map around the guess, and the traces.
    heading : (yaw, tolerance) or None
        Radians; without it all headings are tried.
    """
    levelling, part = level(scene), rough(scene)
    most = _CANDIDATES if heading is None else _KNOWN_CANDIDATES
    candidates = _search_levelled(scene, levelling, heading, most)
    hypotheses = [_rough_fit(part, _start(part, levelling, c), c.score) for c in candidates]
    return _ranked(hypotheses)


def search_score(scene: Scene, *, heading: tuple[float, float] | None) -> float:
    """Return the best score of the search over places and headings, 0 to 1.

    Parameters
    ----------
    scene, heading
        As for :func:`find_hypotheses`.
    """
    return _search_levelled(scene, level(scene), heading, 1)[0].score


def _search_levelled(
    scene: Scene, levelling: Levelling, heading: tuple[float, float] | None, most: int
) -> list[Candidate]:
    """Return the candidates of the search, with the traces rotated to the level frame."""
    levelled = scene.samples.points @ levelling.R_level_sensor.T
    return search(scene, levelled, heading=heading, most=most)


def rough(scene: Scene) -> Scene:
    """Return the scene with random `_ROUGH_SAMPLES`, enough to rank hypotheses."""
    return _draw_samples(scene, _ROUGH_SAMPLES)


def few_samples(scene: Scene) -> Scene:
    """Return the scene with random `_LOOK_SAMPLES`, enough to compare a grid of starts."""
    return _draw_samples(scene, _LOOK_SAMPLES)


def _draw_samples(scene: Scene, most: int) -> Scene:
    """Return the scene with at most so many random samples."""
    samples = scene.samples
    chosen = np.random.default_rng(1).permutation(len(samples))[:most]
    return scene.of(samples.where(np.isin(np.arange(len(samples)), chosen)))


def refine(scene: Scene, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Fit the first hypotheses to all samples, and return them the best first.

    Those within `_CLOSE_Z` of the best are improved by :func:`look_around` and fitted with prior
    and model adapted to the recording.
    """
    part, best = rough(scene), hypotheses[0]
    contenders = [h for h in hypotheses if advantage(best.fit, h.fit, part.samples) < _MOST_BEHIND]
    settled = _ranked([
        replace(h, fit=solve(part, h.fit.state, h.prior, schedule=_SETTLE))
        for h in contenders[:_FINALISTS]
    ])  # fmt: skip
    fine = _ranked([_fit_fine(scene, h) for h in settled])
    looked_around = _improve_near_best(fine, scene, partial(look_around, scene))
    return _improve_near_best(looked_around, scene, partial(_fit_adapted, scene))


def _improve_near_best(
    ranked: Sequence[Hypothesis], scene: Scene, better: Callable[[Hypothesis], Hypothesis]
) -> list[Hypothesis]:
    """Improve the hypotheses within `_CLOSE_Z` of the best, and return all, the best first."""
    near = [advantage(ranked[0].fit, h.fit, scene.samples) < _CLOSE_Z for h in ranked]
    improved = [better(h) if close else h for h, close in zip(ranked, near, strict=True)]
    return _ranked(improved)


def look_around(scene: Scene, best: Hypothesis) -> Hypothesis:
    """Search a better optimum near one: fit from the local minima of the cost on a grid of starts.

    The cost has many local optima within a metre, by the choice of face and lane of each sample.
    """
    offsets_m, turns_m = (np.arange(-n, n + 1) * _LOOK_M for n in _LOOK_STEPS)
    few = few_samples(scene)
    grid = np.stack(np.meshgrid(offsets_m, offsets_m, turns_m / LEVER_M, indexing="ij"), axis=-1)
    steps = np.zeros((grid.size // 3, SIZE))
    steps[:, PLANE] = grid.reshape(-1, 3)
    for _ in range(LOOKS):
        starts = [best.fit.state.moved(step) for step in steps]
        costs = np.array([cost_at(few, start, scale_m=LOOK_SCALE_M) for start in starts])
        costs = costs.reshape(grid.shape[:3])
        lowest = np.argwhere(costs == minimum_filter(costs, size=3))
        order = np.argsort(costs[tuple(lowest.T)])[:_LOOK_PLACES]
        chosen = np.ravel_multi_index(tuple(lowest[order].T), costs.shape)
        chosen_starts = [starts[k] for k in chosen]
        better = solve_likeliest(scene, chosen_starts, best.prior, schedule=_SETTLE)
        if better.cost > best.fit.cost - LOOK_GAIN:
            break
        best = replace(best, fit=better)
    return best


def _fit_fine(scene: Scene, hypothesis: Hypothesis) -> Hypothesis:
    """Return the hypothesis fitted to all samples, with the schedule `FINE`."""
    h = hypothesis
    return replace(h, fit=solve(scene, h.fit.state, h.prior, schedule=FINE, model=h.model))


def _fit_adapted(scene: Scene, fine: Hypothesis) -> Hypothesis:
    """Fit to all samples, with prior and model adapted to them."""
    prior, model = adapted(scene, fine.fit, fine.prior, fine.model)
    return _fit_fine(scene, replace(fine, model=model, prior=prior))


def widen_by_profile(scene: Scene, hypothesis: Hypothesis) -> Hypothesis:
    """Widen sigma along the least-known direction by its profile likelihood."""
    h = hypothesis
    return replace(h, fit=along_valley(scene, h.fit, h.prior, h.model))


def _start(scene: Scene, levelling: Levelling, candidate: Candidate) -> State:
    """Return the state at a candidate, with the height at which traces lie on the road."""
    lanes = scene.lanes
    turn = Rotation.from_euler("Z", candidate.yaw).as_matrix()
    state = State(
        position=np.array([*candidate.place, 0.0]),
        R_map_sensor=turn @ levelling.R_level_sensor,
        reflection=PRIOR_REFLECTION_M,
    )
    placed = place(scene.samples, state)
    without_height = placed.points * [1.0, 1.0, np.nan]
    matches = match(lanes, replace(placed, points=without_height))
    heights = lanes.points[matches.lane, 2] + PRIOR_REFLECTION_M - placed.points[:, 2]
    heights = heights[matches.found & np.isfinite(heights)]
    known = lanes.points[:, 2][np.isfinite(lanes.points[:, 2])]
    height = np.median(heights) if len(heights) else np.median(known) + levelling.depth_m
    return replace(state, position=np.array([*candidate.place, float(height)]))


def prior_at(state: State) -> Prior:
    """Return the prior of a start: 1 sigma of place about the guess, and of tilt about the start's.

    Parameters
    ----------
    state : State
        The start, with the tilt of the levelling; the guess is the local (0, 0).
    """
    information = np.zeros((SIZE, SIZE))
    sigma = np.array([GUESS_M / 2, GUESS_M / 2, GUESS_M, _TILT, _TILT, np.pi])
    information[POSE_PART, POSE_PART] = np.diag(sigma**-2)
    information[REFLECTION, REFLECTION] = _REFLECTION_SIGMA_M**-2
    mean = replace(state, position=np.array([0.0, 0.0, state.position[2]]))
    return Prior(mean=mean, information=information)


def _rough_fit(scene: Scene, start: State, score: float) -> Hypothesis:
    """Return the hypothesis fitted from a start, with the schedule `_ROUGH`."""
    prior = prior_at(start)
    fit = solve(scene, start, prior, schedule=_ROUGH)
    return Hypothesis(fit=fit, prior=prior, score=score)


def _ranked(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses the best first, without those equal to a better one (`_SAME_M`, ...)."""
    same = np.array([*_SAME_M, *_SAME_RAD])
    distinct: list[Hypothesis] = []
    for h in sorted(hypotheses, key=lambda h: h.loss):
        gaps = [np.abs(h.fit.state.difference(k.fit.state)[POSE_PART]) / same for k in distinct]
        if not any((gap < 1.0).all() for gap in gaps):
            distinct.append(h)
    return distinct


def mirrored(samples: Samples) -> Samples:
    """Return the samples with the sign of y changed, left and right swapped."""
    points: Floats = samples.points * [1.0, -1.0, 1.0]
    return replace(samples, points=points)
