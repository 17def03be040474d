"""True occupancy: which tiles are occupied, visible and hidden in which steps.

Written apart from the package, with shapely and plain arrays: the package is judged by it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import geopandas as gpd
import numba
import numpy as np
import pandas as pd
import shapely
from true_traffic import LONG_M, TrueTraffic, rectangles, runs_at_rest, strip

import gis_radar as gr
from gis_radar.base import STEP_S, Booleans, Floats, Integers, step_of
from gis_radar.hdmap import quads

OVERLAP_M, LEVEL_M = 0.5, 2.0  # of `occupied`, as the glossary defines it
HIDDEN_STEPS = 200  # for which a hidden tile stays visible: 10 s
OVER_ROAD_M = 0.6  # of the point of a tile that must be in sight
VALIDITY_S = 0.1  # of a frame
EVERY_STEPS = 4  # in which hiding by vehicles is computed


@dataclass(frozen=True, kw_only=True)
class TrueOccupancy:
    """Truth about the tiles that a sensor has in sight.

    Parameters
    ----------
    tile_id : (n,) array
        The tiles, ascending.
    first_step : int
        The step of the first column.
    occupied, visible, blocked : (n, steps) bool arrays
        Occupied by a vehicle; visible; hidden by other vehicles from all sensors.
    """

    tile_id: Integers
    first_step: int
    occupied: Booleans = field(repr=False)
    visible: Booleans = field(repr=False)
    blocked: Booleans = field(repr=False)

    def table(self) -> pd.DataFrame:
        """Return a row a tile: ``tile_id occupied_s visible_s occupancy`` (NaN: never visible)."""
        visible = self.visible.sum(axis=1)
        occupied = (self.occupied & self.visible).sum(axis=1)
        with np.errstate(invalid="ignore"):
            share = occupied / visible
        return pd.DataFrame(
            {
                "tile_id": self.tile_id,
                "occupied_s": occupied * STEP_S,
                "visible_s": visible * STEP_S,
                "occupancy": share,
            }
        )


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A sensor with its true pose and sight.

    Parameters
    ----------
    pose : Pose
        Its true pose.
    in_sight : Booleans
        For each tile, whether it is in view and nothing that stands hides it.
    times : Floats
        Times of its frames, UNIX seconds, ascending.
    """

    pose: gr.Pose
    in_sight: Booleans = field(repr=False)
    times: Floats = field(repr=False)


def true_occupancy(
    tiles: gpd.GeoDataFrame, sensors: list[Sensor], traffic: TrueTraffic
) -> TrueOccupancy:
    """Return the truth about the tiles that a sensor has in sight.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    sensors : list of Sensor
        The sensors.
    traffic : TrueTraffic
        The true traffic.
    """
    seen = np.any([sensor.in_sight for sensor in sensors], axis=0)
    first = min(int(step_of(s.times[:1])[0]) for s in sensors)
    last = max(int(step_of(s.times[-1:])[0]) for s in sensors)
    last = min(last, int(traffic.states["step"].max()))
    traffic, count = traffic.within(first, last), last - first + 1
    tiles = tiles[seen]
    occupied = occupied_steps(tiles, traffic, first, count)
    observed = np.zeros((len(tiles), count), np.bool_)
    blocked = np.ones((len(tiles), count), np.bool_)
    for sensor in sensors:
        in_sight = sensor.in_sight[seen]
        looks = in_sight[:, None] & frames_valid(sensor.times, first, count)
        observed |= looks
        behind = np.zeros((len(tiles), count), np.bool_)
        behind[in_sight] = blocked_steps(tiles[in_sight], sensor.pose, traffic, first, count)
        blocked &= behind | ~looks
    blocked &= observed
    return TrueOccupancy(
        tile_id=tiles["tile_id"].to_numpy(np.int64),
        first_step=first,
        occupied=occupied,
        visible=observed & ~hidden_too_long(blocked),
        blocked=blocked,
    )


def hidden_too_long(blocked: Booleans) -> Booleans:
    """Return where a tile has been hidden for more than `HIDDEN_STEPS` on end."""
    count = np.zeros(len(blocked), np.int64)
    late = np.zeros_like(blocked)
    for step in range(blocked.shape[1]):
        count = np.where(blocked[:, step], count + 1, 0)
        late[:, step] = count > HIDDEN_STEPS
    return late


def frames_valid(times: Floats, first_step: int, count: int) -> Booleans:
    """Return in which steps a frame is valid: up to the next one, at most `VALIDITY_S`."""
    steps = step_of(times)
    until = np.minimum(np.append(steps[1:] - 1, np.iinfo(np.int64).max),
                       step_of(times + VALIDITY_S))  # fmt: skip
    valid = np.zeros(count, np.bool_)
    for begin, end in zip(steps - first_step, until - first_step, strict=True):
        valid[max(begin, 0) : max(end, begin, -1) + 1] = True
    return valid


def middle_lines(tiles: gpd.GeoDataFrame) -> Floats:
    """Return the (n, 2, 2) right and left ends of the lines across tiles, half-way along them."""
    right0, right1, left1, left0 = np.moveaxis(quads(tiles), 1, 0)
    return np.stack([(right0 + right1) / 2.0, (left0 + left1) / 2.0], axis=1)


def occupied_pairs(
    tiles: gpd.GeoDataFrame, traffic: TrueTraffic, first_step: int
) -> dict[str, Integers]:
    """Return tile (row), step (from the first) and vehicle wherever a footprint occupies a tile."""
    lines = middle_lines(tiles)
    tree = shapely.STRtree(np.asarray(shapely.linestrings(lines)))
    level = tiles["height_m"].to_numpy(np.float64)
    short = traffic.states["length"] <= LONG_M
    parts = []
    for chosen in (short, ~short):
        states = traffic.states[chosen].reset_index(drop=True)
        begin, runs = runs_at_rest(states)
        still = states.iloc[begin].reset_index(drop=True)
        boxes = np.asarray(shapely.polygons(rectangles(still)))
        shapes = boxes if chosen is short else strips(states, begin)
        row, tile = tree.query(shapes, predicate="intersects")
        if chosen is short:
            overlap = overlap_m(lines[tile], still.iloc[row])
        else:
            overlap = shapely.length(shapely.intersection(shapes[row], tree.geometries[tile]))
        across = np.hypot(*(lines[tile, 1] - lines[tile, 0]).T)
        half = np.minimum(across, still["width"].to_numpy()[row]) / 2.0
        apart = np.abs(level[tile] - still["height"].to_numpy()[row])
        on = (overlap >= np.minimum(OVERLAP_M, half) - 1e-9) & ~(apart > LEVEL_M)
        parts.append(_all_steps(tile[on], still.iloc[row[on]], runs[row[on]], first_step))
    names = ("tile", "step", "vehicle")
    return {
        name: np.concatenate(c) for name, c in zip(names, zip(*parts, strict=True), strict=True)
    }


def _all_steps(
    tile: Integers, still: pd.DataFrame, runs: Integers, first_step: int
) -> tuple[Integers, Integers, Integers]:
    """Return tile, step and vehicle for all steps of runs in which vehicles do not move."""
    within = np.arange(runs.sum()) - np.repeat(np.cumsum(runs) - runs, runs)
    step = np.repeat(still["step"].to_numpy() - first_step, runs) + within
    return np.repeat(tile, runs), step, np.repeat(still["vehicle"].to_numpy(), runs)


def occupied_steps(
    tiles: gpd.GeoDataFrame, traffic: TrueTraffic, first_step: int, count: int
) -> Booleans:
    """Return (tiles, steps): whether a footprint occupies a tile at the step's begin."""
    occupied = np.zeros((len(tiles), count), np.bool_)
    pairs = occupied_pairs(tiles, traffic, first_step)
    occupied[pairs["tile"], pairs["step"]] = True
    return occupied


def strips(states: pd.DataFrame, rows: Integers) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
    """Return the footprints of long vehicles in some rows of their states."""
    vehicle = states["vehicle"].to_numpy()
    begins = np.searchsorted(vehicle, vehicle)  # sorted by vehicle, then step
    front = states[["front_e", "front_n"]].to_numpy()
    size, heading = states[["length", "width"]].to_numpy(), states["heading"].to_numpy()
    made = [
        strip(front[begins[k] : k + 1], size[k, 0], size[k, 1], heading[begins[k]])
        for k in rows.tolist()
    ]
    return np.array(made, dtype=np.object_)


def overlap_m(lines: Floats, states: pd.DataFrame) -> Floats:
    """Return the length of each line (n, 2, 2) within the footprint of its row, metres."""
    middle = states[["easting", "northing"]].to_numpy()[:, None]
    heading = states["heading"].to_numpy()[:, None]
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = np.moveaxis(lines - middle, -1, 0)
    ends = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
    half = states[["length", "width"]].to_numpy() / 2.0
    way = ends[:, 1] - ends[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - ends[:, 0]) / way, (half - ends[:, 0]) / way
    parallel = np.abs(way) < 1e-12
    inside = np.abs(ends[:, 0]) <= half
    enter = np.where(parallel, np.where(inside, 0.0, np.inf), np.minimum(one, other)).max(axis=1)
    leave = np.where(parallel, np.where(inside, 1.0, -np.inf), np.maximum(one, other)).min(axis=1)
    share = np.minimum(leave, 1.0) - np.maximum(enter, 0.0)
    return np.asarray(np.maximum(share, 0.0) * np.hypot(*way.T))


def blocked_steps(
    tiles: gpd.GeoDataFrame, pose: gr.Pose, traffic: TrueTraffic, first_step: int, count: int
) -> Booleans:
    """Return (tiles, steps): whether a vehicle that is not on the tile hides it from a sensor."""
    points = sight_points(tiles, pose)
    reach = np.hypot(*(points[:, :2] - pose.position[:2]).T).max(initial=0.0)
    bodies = traffic.bodies
    away = np.hypot(bodies["easting"] - pose.easting, bodies["northing"] - pose.northing)
    bodies = bodies[(away < reach) & ((bodies["step"] - first_step) % EVERY_STEPS == 0)]
    bodies = bodies.sort_values("step", kind="stable")
    at = np.arange(first_step, first_step + count + EVERY_STEPS, EVERY_STEPS)
    begins = np.searchsorted(bodies["step"].to_numpy(), at)
    columns = ["easting", "northing", "height", "heading", "length", "width", "tall"]
    boxes = np.ascontiguousarray(bodies[columns].to_numpy(np.float64))
    boxes[:, :2] -= pose.position[:2]
    points[:, :2] -= pose.position[:2]
    lines = middle_lines(tiles) - pose.position[:2]
    hidden = _hidden(points, lines.reshape(-1, 4), boxes, begins, pose.height)
    return np.repeat(hidden, EVERY_STEPS, axis=1)[:, :count]


def sight_points(tiles: gpd.GeoDataFrame, pose: gr.Pose) -> Floats:
    """Return the (n, 3) points that must be in sight: 0.6 m over the tiles' centres."""
    centres = shapely.centroid(tiles.geometry.array)
    road = tiles["height_m"].to_numpy(np.float64)
    road = np.where(np.isnan(road), pose.height - 6.0, road)
    return np.column_stack([shapely.get_x(centres), shapely.get_y(centres), road + OVER_ROAD_M])


@numba.njit(cache=True)
def _hidden(
    points: Floats, lines: Floats, boxes: Floats, begins: Integers, eye_z: float
) -> Booleans:
    """Return (points, moments): whether a box blocks the line from (0, 0, eye_z) to a point."""
    found = np.zeros((len(points), len(begins) - 1), np.bool_)
    for moment in range(len(begins) - 1):
        for k in range(len(points)):
            for row in range(begins[moment], begins[moment + 1]):
                if _meets(points[k], boxes[row], eye_z) and not _stands_on(lines[k], boxes[row]):
                    found[k, moment] = True
                    break
    return found


@numba.njit(cache=True)
def _clip(x0: float, y0: float, x1: float, y1: float, box: Floats) -> tuple[float, float]:
    """Return begin and end, as shares of a line, of its part inside a box's rectangle."""
    cos, sin = np.cos(box[3]), np.sin(box[3])
    x0, y0, x1, y1 = x0 - box[0], y0 - box[1], x1 - box[0], y1 - box[1]
    u0, u1 = cos * x0 + sin * y0, cos * x1 + sin * y1
    v0, v1 = cos * y0 - sin * x0, cos * y1 - sin * x1
    low, high = 0.0, 1.0
    for begin, end, half in ((u0, u1, box[4] / 2.0), (v0, v1, box[5] / 2.0)):
        way = end - begin
        if abs(way) < 1e-12:
            if abs(begin) > half:
                return 1.0, 0.0
        else:
            one, other = (-half - begin) / way, (half - begin) / way
            low, high = max(low, min(one, other)), min(high, max(one, other))
    return low, high


@numba.njit(cache=True)
def _meets(point: Floats, box: Floats, eye_z: float) -> bool:
    reach2 = point[0] ** 2 + point[1] ** 2
    along = (box[0] * point[0] + box[1] * point[1]) / reach2
    near = (box[4] + box[5]) / 2.0
    if along <= 0.0 or abs(box[0] * point[1] - box[1] * point[0]) > near * np.sqrt(reach2):
        return False
    low, high = _clip(0.0, 0.0, point[0], point[1], box)
    if low >= high:
        return False
    one, other = eye_z + low * (point[2] - eye_z), eye_z + high * (point[2] - eye_z)
    return bool(min(one, other) < box[2] + box[6] and max(one, other) > box[2])


@numba.njit(cache=True)
def _stands_on(line: Floats, box: Floats) -> bool:
    low, high = _clip(line[0], line[1], line[2], line[3], box)
    across = np.hypot(line[2] - line[0], line[3] - line[1])
    return bool((high - low) * across >= min(OVERLAP_M, across / 2.0, box[5] / 2.0))
