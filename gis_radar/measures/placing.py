"""Place the detections of a sensor in the map, in compiled code."""

from __future__ import annotations

import math
from typing import NamedTuple

from gis_radar.base import compiled
from gis_radar.poses import Pose, View


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


@compiled
def place_in_map(  # pragma: no cover - compiled
    x: float, y: float, z: float, to: PoseNumbers
) -> tuple[float, float, float]:
    """Return easting, northing and slant range (m) of a detection, as :meth:`Pose.to_map` does."""
    if not math.isnan(z):
        east = ((x * to.xx + z * to.xz) + y * to.xy) + to.easting
        north = ((x * to.yx + z * to.yz) + y * to.yy) + to.northing
        return east, north, math.sqrt(x * x + y * y + z * z)
    # without elevation it is on the plane of the road
    range_m = math.sqrt(x * x + y * y)
    east, north = x * to.xx + y * to.xy, x * to.yx + y * to.yy
    length, slant_m = math.hypot(east, north), math.hypot(x, y)
    flat_m = math.sqrt(max(slant_m * slant_m - to.drop_m2, 0.0))
    share = flat_m / length if length > 0.0 else 0.0
    return east * share + to.easting, north * share + to.northing, range_m


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
