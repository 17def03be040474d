"""Lanes as sampled centre lines with a grid of the nearest sample, and traces placed among them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import geopandas as gpd
import numpy as np
import scipy
import shapely
from numpy.typing import NDArray

from gis_radar.base import Booleans, Floats, Integers, NoAnswerError, compiled
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import Samples
from gis_radar.hdmap import SAME_LEVEL_M, is_driven

# Spacing of centre line samples and side of the grid's cells: error 1 cm in bends of 10 m radius.
LANE_STEP_M = 1.0
LANE_CELL_M = 1.0
LANE_BINS = 16  # bins of direction, 22.5 degrees each: the grid keeps crossing lanes apart
_LANE_REACH_M = 12.0  # largest distance from a lane of a point that matches it: three lanes
MARGIN_M = 20.0  # reach of the lanes beyond the farthest traces and the error of the guess
# A sample's height is the median of up to _SCAN_POINTS scanned points within _SCAN_NEAR_M.
_SCAN_NEAR_M = 2.0
_SCAN_POINTS = 12
_SLOPE_REACH = 3  # number of samples to either side from which a slope is computed
_MOST_SLOPE = 0.2  # steeper slopes are errors: roads rise 12 % at most (RAL), ramps 20 %
_UNLIMITED_MPS = 55.0  # top speed where the map has no limit, 200 km/h
# Top speed as a multiple of the limit, and its least value (54 km/h).
_SPEEDING = 1.5
_MIN_TOP_MPS = 15.0
BORDER_M = 1.0  # a sample nearer to its lane's middle is in no other lane: less than half a lane
NEXT_LANE_M = 5.5  # largest distance between the centre lines of neighbouring lanes
_PARALLEL = 0.87  # least cosine between their directions (30 degrees)
_NO_DIRECTION_M = 1e-9  # shorter vectors have no direction
# A lane bends if the mean of its unit vectors is shorter: that of an arc of 30 degrees.
_BENT_BELOW = 0.9886
# 1 sigma, among streets, of the error of lanes in the map, and of the scan's heights.
STREET_SIGMA_M = (0.3, 0.2)
# 1 sigma, among lanes, of the mean offset of drivers from the middle of their lane: on straight
# lanes, and in bends; from three recorded junctions.
_LANE_SIGMA_M = (0.18, 0.36)


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """Samples of the centre lines around a place, and a grid of the nearest sample.

    Parameters
    ----------
    origin : (2,) array
        Map position of the local (0, 0), metres; all else is local in easting and northing.
    points : (m, 3) array
        Samples of centre lines, about a metre apart; heights of the scanned road, else of the
        map, else NaN.
    along : (m, 2) array
        Unit vectors in the direction of travel.
    slope : (m,) array
        Rise of the road along the lane, metres a metre.
    top_speed : (m,) array
        Largest speed of vehicles, m/s.
    width_m : (m,) array
        Width of the lane, metres.
    lane : (m,) array
        Number of the lane: its row in the table of lanelets, or that plus the table's length
        where it is driven against its direction.
    s_m : (m,) array
        Distance along the lane in the direction of travel, metres.
    corner : (2,) array
        South-west corner of the grid, local, metres.
    nearest : (rows, columns, bins) int32 array
        Index of the sample nearest to a cell's centre among those of a bin of direction; -1 where
        none is within `_LANE_REACH_M`. A cell's bins are a line of the processor's cache.
    distance : (bins, rows, columns) float32 array
        Distance to that sample, metres.
    directed : bool
        Whether most of the lanes are one-way.
    scanned : float
        Share of the samples whose height is from the scanned road.
    """

    origin: Floats
    points: Floats
    along: Floats
    slope: Floats
    top_speed: Floats
    width_m: Floats
    lane: Integers
    s_m: Floats
    corner: Floats
    nearest: np.ndarray
    distance: np.ndarray
    directed: bool
    scanned: float

    @cached_property
    def bends(self) -> Booleans:
        """Whether the lane of each sample bends by more than 30 degrees."""
        _, lane = np.unique(self.lane, return_inverse=True)
        mean = [(np.bincount(lane, way) / np.bincount(lane))[lane] for way in self.along.T]
        return np.asarray(np.hypot(*mean) < _BENT_BELOW)

    @cached_property
    def next_lanes(self) -> Integers:
        """Index (m, 2) of the sample on the next lane to the left and right; -1 for none."""
        pairs = scipy.spatial.cKDTree(self.points[:, :2]).query_pairs(
            NEXT_LANE_M, output_type="ndarray"
        )
        sample, neighbour = np.concatenate([pairs, pairs[:, ::-1]]).T
        ahead, left, _ = self.beside(sample, self.points[neighbour])
        parallel = np.sum(self.along[sample] * self.along[neighbour], axis=1) > _PARALLEL
        near = parallel & (np.abs(ahead) < LANE_STEP_M) & (np.abs(left) > BORDER_M)
        beside = np.full((len(self.points), 2), -1)
        order = np.flatnonzero(near)[np.argsort(-np.abs(left[near]), kind="stable")]
        side = np.where(left[order] > 0.0, 0, 1)
        beside[sample[order], side] = neighbour[order]  # the nearest one is the last and stays
        return beside

    @property
    def raster(self) -> tuple[Floats, Floats, Floats, Floats, np.ndarray]:
        """Points, directions, top speeds, corner and nearest samples, for compiled matching."""
        return self.points, self.along, self.top_speed, self.corner, self.nearest

    def beside(self, sample: Integers, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return offsets of points from samples: ahead, to the left, and above the lane, metres."""
        offset, direction = points - self.points[sample], self.along[sample]
        ahead = np.sum(offset[:, :2] * direction, axis=1)
        left = offset[:, 1] * direction[:, 0] - offset[:, 0] * direction[:, 1]
        return ahead, left, offset[:, 2] - self.slope[sample] * ahead


def sample_lanes(
    lanelets: gpd.GeoDataFrame, road: Floats, *, place: Floats, reach_m: float
) -> Lanes:
    """Sample the lanes that vehicles use within reach of a place.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.hdmap.LaneletMap`.
    road : (n, 3) array
        Points of the road's surface in the lanelets' CRS, metres, for the heights of lanes.
    place : (2,) array
        Easting and northing around which to sample; becomes the local origin.
    reach_m : float
        Radius around the place, metres.

    Raises
    ------
    NoAnswerError
        If no lane is there.
    """
    driven = lanelets["participants"].map(is_driven).astype(bool)
    close = lanelets["centre"].distance(shapely.Point(place)) < reach_m
    driven_rows = np.flatnonzero(driven & close)
    table = lanelets.iloc[driven_rows]
    if table.empty:
        raise NoAnswerError(
            "no lane for vehicles within {:.0f} m of the guess {:.1f},{:.1f}",
            reach_m,
            place[0],
            place[1],
            hint="check the guess, its coordinate system, and that the map is the right one",
        )
    sampled = [_sample_line(line, LANE_STEP_M) for line in table["centre"]]
    count = [len(xyz) for xyz, _, _ in sampled]
    local = np.vstack([xyz for xyz, _, _ in sampled]) - [*place, 0.0]
    along = np.vstack([direction for _, direction, _ in sampled])
    s_m = np.concatenate([places for _, _, places in sampled])
    lane = np.repeat(np.arange(len(sampled)), count)
    height, scanned = _scanned_heights(local, road - [*place, 0.0])
    local[:, 2] = height
    slope = _slopes(local, along, lane)
    limit = table["speed_limit_kmh"].to_numpy(np.float64)[lane] / 3.6
    top = np.maximum(limit * _SPEEDING, _MIN_TOP_MPS)
    top = np.where(np.isnan(limit), _UNLIMITED_MPS, top)
    width = (table.geometry.area / table["centre"].length).to_numpy()[lane]
    two_way = ~table["one_way"].to_numpy(bool)[lane]
    near = np.hypot(local[:, 0], local[:, 1]) < reach_m
    rows = np.concatenate([np.flatnonzero(near), np.flatnonzero(near & two_way)])
    turn = np.where(np.arange(len(rows)) < near.sum(), 1.0, -1.0)
    backwards = np.where(turn > 0.0, 0, 1)
    corner, nearest, distance = _nearest_samples(local[rows], along[rows] * turn[:, None])
    return Lanes(
        origin=np.asarray(place, dtype=np.float64),
        points=local[rows],
        along=along[rows] * turn[:, None],
        slope=slope[rows] * turn,
        top_speed=top[rows],
        width_m=width[rows],
        lane=driven_rows[lane[rows]] + backwards * len(lanelets),
        s_m=turn * s_m[rows] + backwards * table["centre"].length.to_numpy()[lane[rows]],
        corner=corner,
        nearest=nearest,
        distance=distance,
        directed=bool(two_way.mean() < 0.5),
        scanned=float(scanned[rows].mean()) if len(rows) else 0.0,
    )


def _sample_line(line: shapely.LineString, step_m: float) -> tuple[Floats, Floats, Floats]:
    """Return points about `step_m` apart, their directions, and distances along the line (m)."""
    xyz = shapely.get_coordinates(line, include_z=True)
    step = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
    xyz, step = xyz[np.append(True, step > 1e-6)], step[step > 1e-6]
    s = np.append(0.0, np.cumsum(step))
    n = max(int(np.ceil(s[-1] / step_m)), 1)
    places = (np.arange(n) + 0.5) * s[-1] / n
    points = np.column_stack([np.interp(places, s, c) for c in xyz.T])
    reach = min(step_m, s[-1] / 2)
    ahead, behind = (
        np.column_stack([np.interp(np.clip(places + shift, 0, s[-1]), s, c) for c in xyz[:, :2].T])
        for shift in (reach, -reach)
    )
    direction = ahead - behind
    return points, direction / np.hypot(*direction.T)[:, None], places


def _scanned_heights(local: Floats, road: Floats) -> tuple[Floats, Booleans]:
    """Return heights at samples, and whether they are from the scan.

    Only scanned points within `SAME_LEVEL_M` of the map's height count, as roads cross on levels.
    """
    map_height = local[:, 2]
    if len(road) == 0:
        return map_height, np.zeros(len(map_height), dtype=bool)
    gap, index = scipy.spatial.cKDTree(road[:, :2]).query(
        local[:, :2],
        k=min(_SCAN_POINTS, len(road)),
        distance_upper_bound=_SCAN_NEAR_M,
    )
    gap, index = (np.asarray(a).reshape(len(local), -1) for a in (gap, index))
    z = np.where(np.isfinite(gap), road[np.minimum(index, len(road) - 1), 2], np.nan)
    z = np.where(np.abs(z - map_height[:, None]) > SAME_LEVEL_M, np.nan, z)
    scanned = np.asarray(np.isfinite(z).any(axis=1), np.bool_)
    height = map_height.copy()
    height[scanned] = np.nanmedian(z[scanned], axis=1)
    return height, scanned


def _slopes(points: Floats, along: Floats, lane: Integers) -> Floats:
    """Return the slope along the lane at each sample (m/m); 0 where heights are unknown."""
    last = len(points) - 1
    ahead, behind = (
        np.clip(np.arange(len(points)) + shift, 0, last) for shift in (_SLOPE_REACH, -_SLOPE_REACH)
    )
    ahead = np.where(lane[ahead] == lane, ahead, np.arange(len(points)))
    behind = np.where(lane[behind] == lane, behind, np.arange(len(points)))
    gap = points[ahead] - points[behind]
    run = np.sum(gap[:, :2] * along, axis=1)
    rise = np.divide(gap[:, 2], run, out=np.zeros(len(points)), where=run > LANE_STEP_M)
    return np.asarray(np.clip(np.nan_to_num(rise), -_MOST_SLOPE, _MOST_SLOPE))


def _nearest_samples(points: Floats, along: Floats) -> tuple[Floats, np.ndarray, np.ndarray]:
    """Return the grid's corner, and the nearest sample of each cell and bin, with its distance."""
    cell_m, reach = LANE_CELL_M, _LANE_REACH_M / LANE_CELL_M
    corner = np.floor(points[:, :2].min(axis=0)) - _LANE_REACH_M
    place = (points[:, :2] - corner) / cell_m
    columns, rows = np.floor(place.max(axis=0)).astype(np.int64) + 1 + int(reach)
    nearest = np.full((rows, columns, LANE_BINS), -1, dtype=np.int32)
    distance = np.full((LANE_BINS, rows, columns), np.float32(np.inf))
    _fill_cells(nearest, distance, direction_bin(along, LANE_BINS), place, reach)
    distance *= np.float32(cell_m)
    return corner, nearest, distance


@compiled
def _fill_cells(  # pragma: no cover - compiled
    nearest: NDArray[np.int32],
    distance: NDArray[np.float32],
    bins: Integers,
    place: Floats,
    reach: float,
) -> None:
    """Fill each cell of a bin with its nearest sample, and the distance in cells, in place."""
    _, rows, columns = distance.shape
    for k in range(len(place)):
        b, x, y = bins[k], place[k, 0] - 0.5, place[k, 1] - 0.5  # of the cells' centres
        for i in range(max(int(y - reach), 0), min(int(y + reach) + 2, rows)):
            for j in range(max(int(x - reach), 0), min(int(x + reach) + 2, columns)):
                gap = np.sqrt((i - y) ** 2 + (j - x) ** 2)
                if gap < reach and gap < distance[b, i, j]:
                    nearest[i, j, b] = k
                    distance[b, i, j] = gap


def direction_bin(along: Floats, bins: int) -> Integers:
    """Return the bin of direction of (m, 2) vectors; bin 0 is centred on east."""
    turns = np.arctan2(along[:, 1], along[:, 0]) / (2.0 * np.pi)
    return np.asarray(np.rint(turns * bins).astype(np.int64) % bins)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Scene of a registration: lanes and traces.

    Parameters
    ----------
    lanes : Lanes
        The map around the guess.
    samples : Samples
        The traces.
    lane_sigma_m : (2,) tuple
        1 sigma of the mean offset of a lane's drivers, on straight lanes and in bends; 0 where
        windows of one recording are compared, in which it is the same.
    keeps_lanes : bool
        Whether tracks are matched to paths through lanes instead of each sample to the nearest
        lane. False in windows: a choice of path for few seconds can hide half a metre of a move.
    """

    lanes: Lanes
    samples: Samples
    lane_sigma_m: tuple[float, float] = _LANE_SIGMA_M
    keeps_lanes: bool = True

    def of(self, samples: Samples) -> Scene:
        """Return the scene with other samples."""
        return replace(self, samples=samples)


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Samples placed in the map by a state of the sensor.

    Parameters
    ----------
    samples : Samples
        Traces.
    state : State
        State of the sensor.
    points : (n, 3) array
        The samples in local map coordinates, metres.
    arms : (n, 3) array
        Vectors from the sensor to the samples, in the map's axes, metres.
    flat : (n,) array
        Horizontal distances from the sensor, metres.
    sight : (n, 2) array
        Unit vectors from the sensor to the samples in the plane; east where the distance is 0.
    """

    samples: Samples
    state: State
    points: Floats
    arms: Floats
    flat: Floats
    sight: Floats


def place(samples: Samples, state: State) -> Placed:
    """Place samples in the map.

    Parameters
    ----------
    samples : Samples
        Traces.
    state : State
        Assumed state of the sensor.
    """
    ahead, left, up = samples.points.T
    rows = [row[0] * ahead + row[1] * left + row[2] * up for row in state.R_map_sensor]
    arms = np.column_stack(rows)
    flat = np.hypot(rows[0], rows[1])
    sight = np.tile([1.0, 0.0], (len(flat), 1))
    clear = (flat > _NO_DIRECTION_M)[:, None]
    np.divide(arms[:, :2], flat[:, None], out=sight, where=clear)
    return Placed(
        samples=samples, state=state, points=arms + state.position, arms=arms, flat=flat,
        sight=sight,
    )  # fmt: skip
