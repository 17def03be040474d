"""Place the detections of a frame in the map: the part of the counting loop without branches.

Mispredicted branches take most of a processor's time. So a first loop, without any, places all
detections, several at a time as vectors, and lists those over cells with tiles. Only these few are
left for the second loop.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np

from gis_radar.base import Floats, compiled
from gis_radar.hdmap import Numbers, TileCells, cell_at
from gis_radar.poses import Pose, View

PLACED_AT_ONCE = 1024  # detections: 36 KiB, which fit in the processor's cache


class PoseNumbers(NamedTuple):
    """A pose as numbers for compiled code.

    Parameters
    ----------
    xx, xy, xz, yx, yy, yz, zx, zy, zz : float
        Rotation from the sensor frame to the map frame, by rows.
    easting, northing, height : float
        Position of the sensor, metres.
    drop_m, drop_m2 : float
        Height of the sensor over the road, on which detections without elevation are placed,
        metres, and its square; 0 where unknown.
    near_m, far_m, cos_azimuth, tan_elevation : float
        The view: least and greatest slant range, metres; cosine of half the azimuth, tangent of
        half the elevation.
    number : int
        Number of the pose, which frames keep.
    """

    xx: float
    xy: float
    xz: float
    yx: float
    yy: float
    yz: float
    zx: float
    zy: float
    zz: float
    easting: float
    northing: float
    height: float
    drop_m: float
    drop_m2: float
    near_m: float
    far_m: float
    cos_azimuth: float
    tan_elevation: float
    number: int

    @classmethod
    def of(cls, pose: Pose, *, road_m: float = math.nan, number: int = 0) -> PoseNumbers:
        """Return the numbers of a pose over a road at `road_m` (map frame; NaN where unknown)."""
        drop_m = 0.0 if math.isnan(road_m) else pose.height - road_m
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = pose.R_map_sensor.tolist()
        view = pose.view or View()
        return cls(
            xx, xy, xz, yx, yy, yz, zx, zy, zz, float(pose.easting), float(pose.northing),
            float(pose.height), float(drop_m), float(drop_m**2), float(view.min_range_m),
            float(view.max_range_m), math.cos(math.radians(view.azimuth_deg / 2.0)),
            math.tan(math.radians(view.elevation_deg / 2.0)), number,
        )  # fmt: skip


class Places(NamedTuple):
    """Buffers for the places of some detections.

    Parameters
    ----------
    east, north, range_m : (m,) float64 arrays
        Position from the corner of the cells, and range from the sensor, metres.
    cell, metres : (m,) int32 arrays
        Cell of :class:`TileCells`; index of the range in a histogram, -1 without a position.
    over : (m,) int32 array
        Indices of the detections over a cell with tiles.
    """

    east: Floats
    north: Floats
    range_m: Floats
    cell: Numbers
    metres: Numbers
    over: Numbers

    @classmethod
    def empty(cls) -> Self:
        """Return buffers for `PLACED_AT_ONCE` detections."""
        east, north, range_m = np.empty((3, PLACED_AT_ONCE))
        cell, metres, over = np.empty((3, PLACED_AT_ONCE), np.int32)
        return cls(east, north, range_m, cell, metres, over)


@compiled
def fill_places(  # pragma: no cover - compiled
    xs: Floats, ys: Floats, zs: Floats, pose: PoseNumbers, cells: TileCells, last_m: float,
    places: Places,
) -> int:  # fmt: skip
    """Fill in the places of detections (m; float64 or float32); return how many are over tiles.

    Ranges over `last_m` metres count as `last_m`.
    """
    east, north, range_m, metres = places.east, places.north, places.range_m, places.metres
    cell, per_m, has_nan = places.cell, 1.0 / cells.cell_m, False
    for k in range(len(xs)):
        x, y, z = np.float64(xs[k]), np.float64(ys[k]), np.float64(zs[k])
        east[k] = ((x * pose.xx + z * pose.xz) + y * pose.xy) + pose.easting - cells.west
        north[k] = ((x * pose.yx + z * pose.yz) + y * pose.yy) + pose.northing - cells.south
        range_m[k] = math.sqrt(x * x + y * y + z * z)
        metres[k] = np.int32(min(last_m, range_m[k]))
        cell[k] = cell_at(east[k], north[k], cells.width, cells.height, per_m, cells.columns)
        has_nan |= math.isnan(range_m[k])
    if has_nan:
        _place_without_elevation(xs, ys, zs, pose, cells, last_m, places)
    over, first, count = places.over, cells.first, 0
    for k in range(len(xs)):
        over[count] = k
        count += first[cell[k] + 1] > first[cell[k]]
    return count


@compiled
def _place_without_elevation(  # pragma: no cover - compiled
    xs: Floats, ys: Floats, zs: Floats, pose: PoseNumbers, cells: TileCells, last_m: float,
    places: Places,
) -> None:  # fmt: skip
    """Fill in the places of detections without elevation, and of rows without a detection."""
    for k in range(len(xs)):
        x, y = np.float64(xs[k]), np.float64(ys[k])
        if math.isnan(x) or math.isnan(y):
            places.metres[k] = -1
        elif math.isnan(zs[k]):
            range_m = math.sqrt(x * x + y * y)
            east, north = _on_plane(x, y, pose)
            east, north = east - cells.west, north - cells.south
            places.range_m[k], places.east[k], places.north[k] = range_m, east, north
            places.metres[k] = np.int32(min(last_m, range_m))
            places.cell[k] = cell_at(
                east, north, cells.width, cells.height, 1.0 / cells.cell_m, cells.columns
            )


@compiled
def in_view(  # pragma: no cover - compiled
    x: float, y: float, z: float, range_m: float, pose: PoseNumbers
) -> bool:
    """Return whether a detection is within a pose's view, as :meth:`View.sees` does."""
    flat_m = math.sqrt(x * x + y * y)
    in_elevation = math.isnan(z) or abs(z) <= flat_m * pose.tan_elevation
    return in_elevation and x >= flat_m * pose.cos_azimuth and pose.near_m <= range_m <= pose.far_m


@compiled
def height_of(  # pragma: no cover - compiled
    x: float, y: float, z: float, to: PoseNumbers
) -> float:
    """Return the height (m) of a detection in the map, as :meth:`Pose.to_map` does."""
    if math.isnan(z):
        return to.height - to.drop_m
    return ((x * to.zx + z * to.zz) + y * to.zy) + to.height


@compiled
def _on_plane(  # pragma: no cover - compiled
    x: float, y: float, to: PoseNumbers
) -> tuple[float, float]:
    """Return easting and northing of a detection without elevation, as :meth:`Pose.to_map` does."""
    east, north = x * to.xx + y * to.xy, x * to.yx + y * to.yy
    range_m, length = math.hypot(x, y), math.hypot(east, north)
    flat_m = math.sqrt(max(range_m * range_m - to.drop_m2, 0.0))
    share = flat_m / length if length > 0.0 else 0.0
    return east * share + to.easting, north * share + to.northing
