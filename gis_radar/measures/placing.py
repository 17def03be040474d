"""Where the detections of a frame are: the half of the counting loop without branches.

Of processors' time most goes to branches guessed wrong. So a first loop places all detections, a
few at a time as vectors, and lists those over cells with tiles; few are left for the second.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np

from gis_radar.base import Floats, compiled
from gis_radar.hdmap import Numbers, TileCells, cell_at
from gis_radar.poses import Pose

PLACED_AT_ONCE = 1024  # detections: 36 KiB, near the processor


class PoseNumbers(NamedTuple):
    """A pose as compiled code takes it.

    Parameters
    ----------
    xx, xy, xz, yx, yy, yz, zx, zy, zz : float
        Rotation from the sensor frame to the map frame, by rows.
    easting, northing, height : float
        Position of the sensor, metres.
    drop_m, drop_m2 : float
        How far the road lies under the sensor, metres, and its square: where detections without
        elevation are placed; 0 where not known.
    number : int
        Of the pose; frames carry it.
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
    number: int

    @classmethod
    def of(cls, pose: Pose, *, road_m: float = math.nan, number: int = 0) -> PoseNumbers:
        """Return a pose over a road of some height (metres in the map; NaN where not known)."""
        drop_m = 0.0 if math.isnan(road_m) else pose.height - road_m
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = pose.R_map_sensor.tolist()
        return cls(
            xx, xy, xz, yx, yy, yz, zx, zy, zz, float(pose.easting), float(pose.northing),
            float(pose.height), float(drop_m), float(drop_m**2), number,
        )  # fmt: skip


class Places(NamedTuple):
    """Room for the places of some detections.

    Parameters
    ----------
    east, north, range_m : (m,) float64 arrays
        From the corner of the cells, and from the sensor, metres.
    cell, metres : (m,) int32 arrays
        Cell of :class:`TileCells`; the range as a place in a histogram, -1 without a position.
    over : (m,) int32 array
        Which of them are over a cell with tiles.
    """

    east: Floats
    north: Floats
    range_m: Floats
    cell: Numbers
    metres: Numbers
    over: Numbers

    @classmethod
    def empty(cls) -> Self:
        """Return the room."""
        east, north, range_m = np.empty((3, PLACED_AT_ONCE))
        cell, metres, over = np.empty((3, PLACED_AT_ONCE), np.int32)
        return cls(east, north, range_m, cell, metres, over)


@compiled
def fill_places(  # pragma: no cover - compiled
    xs: Floats, ys: Floats, zs: Floats, pose: PoseNumbers, cells: TileCells, last_m: float,
    places: Places,
) -> int:  # fmt: skip
    """Fill in the places of detections, of float64 or float32; return how many are over tiles.

    Ranges from `last_m` metres on count as that.
    """
    east, north, range_m, metres = places.east, places.north, places.range_m, places.metres
    cell, per_m, odd = places.cell, 1.0 / cells.cell_m, False
    for k in range(len(xs)):
        x, y, z = np.float64(xs[k]), np.float64(ys[k]), np.float64(zs[k])
        east[k] = ((x * pose.xx + z * pose.xz) + y * pose.xy) + pose.easting - cells.west
        north[k] = ((x * pose.yx + z * pose.yz) + y * pose.yy) + pose.northing - cells.south
        range_m[k] = math.sqrt(x * x + y * y + z * z)
        metres[k] = np.int32(min(last_m, range_m[k]))
        cell[k] = cell_at(east[k], north[k], cells.width, cells.height, per_m, cells.columns)
        odd |= math.isnan(range_m[k])
    if odd:
        _place_level(xs, ys, zs, pose, cells, last_m, places)
    over, first, count = places.over, cells.first, 0
    for k in range(len(xs)):
        over[count] = k
        count += first[cell[k] + 1] > first[cell[k]]
    return count


@compiled
def _place_level(  # pragma: no cover - compiled
    xs: Floats, ys: Floats, zs: Floats, pose: PoseNumbers, cells: TileCells, last_m: float,
    places: Places,
) -> None:  # fmt: skip
    """Fill in the places of detections without elevation, and of rows that are none."""
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
def height_of(  # pragma: no cover - compiled
    x: float, y: float, z: float, to: PoseNumbers
) -> float:
    """Return the height of a detection in the map, as :meth:`Pose.to_map` does."""
    if math.isnan(z):
        return to.height - to.drop_m
    return ((x * to.zx + z * to.zz) + y * to.zy) + to.height


@compiled
def _on_plane(  # pragma: no cover - compiled
    x: float, y: float, to: PoseNumbers
) -> tuple[float, float]:
    """Return where a detection without elevation is, as :meth:`Pose.to_map` does."""
    east, north = x * to.xx + y * to.xy, x * to.yx + y * to.yy
    range_m, length = math.hypot(x, y), math.hypot(east, north)
    flat_m = math.sqrt(max(range_m * range_m - to.drop_m2, 0.0))
    share = flat_m / length if length > 0.0 else 0.0
    return east * share + to.easting, north * share + to.northing
