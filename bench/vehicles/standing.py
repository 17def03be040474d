"""True sight: which tiles walls, parked cars and buildings hide from a sensor."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from true_occupancy import sight_points

import gis_radar as gr
from gis_radar.base import Booleans, Floats
from simulation.scene import Scene
from simulation.sight import Boxes, Walls, building_walls, parked_boxes

BUILDING = 6  # ASPRS class
# Of a scan: size of cells, and how many around one give the ground; heights over it of what may
# hide, and of what shows the ground; samples of a line of sight that must be blocked.
CELL_M, GROUND_CELLS, HIGH_M, LOW_M, LEAST_SAMPLES = 1.0, 11, 2.5, 0.5, 2
WALLS, CARS = ("begin", "end", "top"), ("centre", "heading", "size")


def write_standing(scene: Scene, path: Path) -> None:
    """Write the walls and the parked cars of a simulated scene."""
    walls, cars = building_walls(scene), parked_boxes(scene)
    arrays = {name: getattr(walls, name) for name in WALLS}
    np.savez(path, **arrays, **{name: getattr(cars, name) for name in CARS})


def in_sight(tiles: gpd.GeoDataFrame, pose: gr.Pose, site: Path) -> Booleans:
    """Return which tiles a sensor would see without traffic.

    By the simulated walls and parked cars where a site has `standing.npz`, else by the buildings in
    its scan.
    """
    points = sight_points(tiles, pose)
    seen = (pose.view or gr.View()).sees(pose.to_sensor(points))
    near = points[seen]
    if (site / "standing.npz").exists():
        with np.load(site / "standing.npz") as kept:
            walls = Walls(**{name: kept[name] for name in WALLS})
            cars = Boxes(**{name: kept[name] for name in CARS})
        nobody = np.full(len(near), -1)
        hidden = walls.hide(pose.position, near) | cars.hide(pose.position, near, nobody)
    else:
        hidden = hidden_by_scan(near, pose.position, next(site.glob("*.laz")))
    seen[seen] = ~hidden
    return np.asarray(seen)


def hidden_by_scan(points: Floats, eye: Floats, scan: Path) -> Booleans:
    """Return which points a building in a scan hides from `eye`."""
    las = laspy.read(scan)
    xyz, kind = np.asarray(las.xyz), np.asarray(las.classification)
    origin = xyz[:, :2].min(axis=0) - CELL_M
    cell = np.floor((xyz[:, :2] - origin) / CELL_M).astype(np.int64)
    shape = cell.max(axis=0) + 2
    top, low = np.full(shape, -np.inf), np.full(shape, np.inf)
    np.minimum.at(low, tuple(cell.T), xyz[:, 2])
    ground = minimum_filter(low, GROUND_CELLS)
    over = xyz[:, 2] - ground[tuple(cell.T)]
    high = over > HIGH_M
    if (kind == BUILDING).any():
        high &= kind == BUILDING
        np.maximum.at(top, tuple(cell[high].T), xyz[high, 2])
    else:
        # without classes: a high cell with points at the ground beside it is a tree, not a house
        np.maximum.at(top, tuple(cell[high].T), xyz[high, 2])
        floor = np.zeros(shape)
        floor[tuple(cell[over < LOW_M].T)] = 1.0
        top[maximum_filter(floor, 3) > 0.0] = -np.inf
    return _behind(points, eye, top, origin)


def _behind(points: Floats, eye: Floats, top: Floats, origin: Floats) -> Booleans:
    """Return which points are hidden: their lines of sight run below the tops of cells."""
    hidden = np.zeros(len(points), np.bool_)
    for k, point in enumerate(points):
        reach = float(np.hypot(*(point - eye)[:2]))
        share = np.arange(1.0, reach - 1.0, CELL_M / 2.0) / max(reach, 1e-9)
        way = eye + share[:, None] * (point - eye)
        cell = np.floor((way[:, :2] - origin) / CELL_M).astype(np.int64)
        inside = ((cell >= 0) & (cell < top.shape)).all(axis=1)
        below = way[inside, 2] < top[tuple(cell[inside].T)]
        hidden[k] = below.sum() >= LEAST_SAMPLES
    return hidden
