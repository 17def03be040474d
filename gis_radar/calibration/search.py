"""Search where a recording could lie: traces over lanes of fitting direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gis_radar.arrays import Booleans, Floats, compiled
from gis_radar.calibration.lanes import LANE_CELL_M, Lanes
from gis_radar.calibration.matching import Scene

BEYOND_GUESS_M = 2.0  # searched beyond how far a guess may be off
TILT = math.radians(6.0)  # 1 sigma of how far masts and roads lean, radians
# 1 sigma of reflections about the levelled plane: vehicles, and elevation noise (radians).
LEVEL_SPREAD_M = 0.5
LEVEL_ELEVATION = math.radians(0.6)
SCORED = 900  # traces scored; cost in proportion
SIGHTS = 64  # bins of the direction of sight, 5.6 degrees
# Bell across a lane, grid of places, grid of headings (radians). Steps are at most one spread, or
# 50 m off half of one.
SPREAD_M = 2.0
STEP_M = 2.0
YAW_STEP = math.radians(2.0)
# Cosine by which a lane's direction may disagree with the Doppler's sign (15 degrees).
BESIDE = 0.25
# Closer peaks are one.
NEAR_M = 3.0
NEAR_RAD = math.radians(5.0)


@dataclass(frozen=True, kw_only=True)
class Levelling:
    """The road plane as the sensor sees it.

    Parameters
    ----------
    R_level_sensor : (3, 3) array
        Turns the sensor frame so that the road's plane is level and below; the heading of the
        x axis stays.
    depth_m : float
        From the sensor down to the plane of the reflections.
    """

    R_level_sensor: Floats
    depth_m: float


def level(scene: Scene) -> Levelling:
    """Fit a plane to the traces, robustly; a sensor over which the road lies hangs upside down.

    Parameters
    ----------
    scene : Scene
        The traces.
    """
    samples, settings = scene.samples, scene.settings.search
    x, y, z = samples.points.T
    rows = np.column_stack([x, y, np.ones(len(x))])
    reach = np.linalg.norm(samples.points, axis=1)
    sigma = np.hypot(LEVEL_SPREAD_M, LEVEL_ELEVATION * reach)
    prior = np.diag([TILT**-2, TILT**-2, 0.0])
    weight = sigma**-2
    plane = np.array([0.0, 0.0, float(np.median(z))])
    for _ in range(settings.level_rounds):
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
    lanes, samples, settings = scene.lanes, scene.samples, scene.settings.search
    chosen = np.random.default_rng(0).permutation(len(samples))[:SCORED]
    points, away = levelled[chosen, :2].copy(), samples.range_rate[chosen] > 0.0
    cell_m = LANE_CELL_M

    def score(close: NDArray[np.uint8], places: Floats, yaws: Floats) -> Floats:
        return np.asarray(_score(close, lanes.corner, cell_m, points, away, places, yaws))

    places = _places(settings.guess_m + BEYOND_GUESS_M, STEP_M)
    yaws = _yaws(heading, YAW_STEP)
    scores = score(closeness(lanes), places, yaws)
    return _peaks(scores, places, yaws, most)


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
    """Return for each direction of sight how close a cell is to lanes that lead away along it.

    Parameters
    ----------
    lanes : Lanes
        The map.

    Returns
    -------
    (sights, rows, columns) uint8 array
        255 on a centre line. What comes towards the sensor is what leads away along the
        opposite sight.
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
            np.hypot(*(place - other.place)) < NEAR_M and abs(_wrapped(yaw - other.yaw)) < NEAR_RAD
            for other in kept
        )
        if not twin:
            kept.append(Candidate(place=place, yaw=yaw, score=float(scores[i, j])))
            if len(kept) == most:
                break
    return kept


def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


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
    total = np.zeros((len(places), len(yaws)))
    for j in range(len(yaws)):
        cos, sin = np.cos(yaws[j]), np.sin(yaws[j])
        for k in range(len(points)):
            x = cos * points[k, 0] - sin * points[k, 1]
            y = sin * points[k, 0] + cos * points[k, 1]
            turn = np.arctan2(y, x) / (2.0 * np.pi) + (0.0 if away[k] else 0.5)
            sight = int(np.rint(turn * sights)) % sights
            for i in range(len(places)):
                column = int((x + places[i, 0] - corner[0]) / cell_m)
                row = int((y + places[i, 1] - corner[1]) / cell_m)
                if 0 <= column < columns and 0 <= row < rows:
                    total[i, j] += close[sight, row, column]
    return total / (255.0 * max(len(points), 1))
