"""Coordinate systems: which are fit for metres, which fits a site, how to change between them."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from pyproj import CRS, Geod, Proj, Transformer
from pyproj.exceptions import ProjError

from gis_radar.base.arrays import Floats
from gis_radar.base.errors import CrsError, UsageError
from gis_radar.base.texts import Text
from gis_radar.base.words import WINDS

_SCALE_TOLERANCE = 0.002  # UTM stays within 0.001 in its zone; web Mercator is off by 0.5 at 48 N
_OUTSIDE_DEG = 10.0  # outside the area of use: sites at its edge pass, other continents do not
_EXACT_M = 1.0  # UTM on WGS84 and on ETRS89, by PROJ; a lane is three times as wide
# Datums within a metre of each other, where EPSG states an error of 3 m, or none at all.
_LIKE_WGS84 = {
    "World Geodetic System 1984", "World Geodetic System 1984 ensemble",
    "Geocentric Datum of Australia 2020", "China 2000",
}  # fmt: skip
_SHORT_M = 100.0  # a scale is measured along it: rounding is far smaller, the scale constant
_FITTING_CRS_HINT = Text("use the UTM zone or the national grid of the site")

Box: TypeAlias = tuple[float, float, float, float]
"""West, south, east, north."""


def metric_crs(crs: Any, *, what: str) -> CRS:
    """Return a projected coordinate system in metres, or refuse by name.

    Parameters
    ----------
    crs : CRS, str, int or None
        Anything pyproj understands; of a compound system the horizontal part counts.
    what : str
        Whose coordinate system it is (a file, an option); begins the error message.

    Returns
    -------
    CRS
        The horizontal, projected, metric coordinate system.

    Raises
    ------
    CrsError
        If it is missing, unknown, geographic, not in metres, or its axes do not point east and
        north; in which order they are listed does not matter.
    """
    if crs is None or (isinstance(crs, str) and not crs):
        raise CrsError("{}: has no coordinate system", what, hint="state it, e.g. EPSG:25832")
    try:
        parsed = CRS.from_user_input(crs)
    except (ProjError, TypeError, ValueError) as error:
        raise CrsError(
            "{}: {} is not a known coordinate system", what, repr(crs), hint="e.g. EPSG:25832"
        ) from error
    flat = horizontal(parsed)
    if not flat.is_projected:
        kind = "geographic" if flat.is_geographic else flat.type_name.lower()
        raise CrsError(
            "{}: {} ({}) is {}, a projected one in metres is needed",
            what,
            flat.name,
            name_of(flat),
            kind,
            hint="use the site's UTM zone, e.g. EPSG:25832",
        )
    if any(axis.unit_conversion_factor != 1.0 for axis in flat.axis_info):
        raise CrsError(
            "{}: {} is in {}, metres are needed",
            what,
            flat.name,
            flat.axis_info[0].unit_name,
            hint="use the site's UTM zone, e.g. EPSG:25832",
        )
    axes = [axis.direction for axis in flat.axis_info]
    if sorted(axes) != ["east", "north"]:
        raise CrsError(
            "{}: {} has axes that point {}, not east and north",
            what,
            _label(flat),
            " and ".join(axes),
            hint="use the site's UTM zone, e.g. EPSG:25832",
        )
    return flat


def require_true_scale(crs: CRS, easting: float, northing: float, *, what: str) -> None:
    """Refuse a coordinate system in which a metre at a place is not a metre on the ground.

    Parameters
    ----------
    crs : CRS
        As from :func:`metric_crs`.
    easting, northing : float
        The place, in metres of this system.
    what : str
        Whose coordinate system it is; begins the error message.

    Raises
    ------
    CrsError
        If the place is far outside the area for which the system is made, or its scale there
        differs by more than 0.2 % from 1 in any direction.
    """
    name = _label(crs)
    longitude, latitude = Proj(crs)(
        easting + _SHORT_M * np.array([0.0, 1.0, 0.0]),
        northing + _SHORT_M * np.array([0.0, 0.0, 1.0]),
        inverse=True,
    )
    # Some projections are true to scale once more, on the far side of the globe.
    if not _in_area_of_use(crs, longitude[0], latitude[0]):
        raise CrsError(
            "{}: the site lies far outside the area of {}", what, name, hint=_FITTING_CRS_HINT
        )
    scales = _scales(crs, longitude, latitude)
    worst = scales[np.argmax(np.abs(scales - 1.0))]
    if abs(worst - 1.0) > _SCALE_TOLERANCE:
        raise CrsError(
            "{}: {} is not true to scale at the site: {:.3f} m for each metre",
            what,
            name,
            worst,
            hint=_FITTING_CRS_HINT,
        )


def require_on_earth(crs: CRS, easting: float, northing: float, *, what: str) -> None:
    """Refuse coordinates that are no place on the earth.

    Parameters
    ----------
    crs : CRS
        As from :func:`metric_crs`.
    easting, northing : float
        Metres of this system.
    what : str
        Whose coordinates they are; begins the error message.

    Raises
    ------
    CrsError
        If the projection cannot be undone there: the way back ends elsewhere.
    """
    project = Proj(crs)
    again = project(*project(easting, northing, inverse=True))
    if not math.dist(again, (easting, northing)) < 1.0:
        raise CrsError(
            "{}: easting {:g}, northing {:g} is no place in {}",
            what,
            easting,
            northing,
            _label(crs),
        )


def _scales(crs: CRS, longitude: Floats, latitude: Floats) -> Floats:
    """Return the greatest and the least scale (Tissot) at the first of three points, degrees.

    The others lie `_SHORT_M` to its grid east and grid north. The scale is measured: PROJ's factors
    take the earth for a sphere where the projection does so (web Mercator).
    """
    azimuth, _, distance = (crs.get_geod() or Geod(ellps="WGS84")).inv(
        longitude[[0, 0]], latitude[[0, 0]], longitude[1:], latitude[1:]
    )
    steps = (
        distance / _SHORT_M * np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
    )
    scales: Floats = 1.0 / np.linalg.svd(steps, compute_uv=False)
    return scales


def _in_area_of_use(crs: CRS, longitude: float, latitude: float) -> bool:
    """Return whether a place is in or near the area of use; without a known area any place is."""
    if not (math.isfinite(longitude) and math.isfinite(latitude)):
        return False
    area = crs.area_of_use
    if area is None:
        return True
    width = (area.east - area.west) % 360.0 or 360.0
    inside = (longitude - area.west) % 360.0
    off_sideways = min(inside - width, 360.0 - inside)
    off_along = max(area.south - latitude, latitude - area.north)
    return max(off_sideways, off_along) <= _OUTSIDE_DEG


def horizontal(crs: CRS) -> CRS:
    """Return the horizontal part of a coordinate system, without heights and datum shifts."""
    if crs.is_bound and crs.source_crs is not None:
        return horizontal(crs.source_crs)
    if crs.is_compound:
        return horizontal(crs.sub_crs_list[0])
    # a flat system is returned as it is: thousands of poses share one object
    return crs if len(crs.axis_info) == 2 else crs.to_2d()


def name_of(crs: CRS) -> str:
    """Return the short name of a coordinate system: `EPSG:25832`, or its WKT where it has none."""
    authority = crs.to_authority(min_confidence=70)
    return ":".join(authority) if authority else crs.to_wkt()


def _label(crs: CRS) -> str:
    """Return a coordinate system as messages name it: its name, with its code if it has one."""
    authority = crs.to_authority(min_confidence=70)
    return f"{crs.name} ({':'.join(authority)})" if authority else crs.name


def require_same(crs: CRS, other: CRS, *, what: str, other_what: str) -> None:
    """Refuse two tables whose coordinates do not mean the same.

    Raises
    ------
    CrsError
        If the two systems differ; nearly equal ones such as EPSG:25832 and EPSG:32632 differ too.
    """
    if not same_coordinates(crs, other):
        raise CrsError(
            "{} is in {}, but {} in {}",
            what,
            name_of(crs),
            other_what,
            name_of(other),
            hint="bring both into one coordinate system",
        )


def utm_zone(longitude_deg: float, latitude_deg: float) -> CRS:
    """Return the UTM zone of a place: on ETRS89 in Europe, on WGS84 elsewhere.

    Parameters
    ----------
    longitude_deg, latitude_deg : float
        The place, in WGS84 or ETRS89.

    Returns
    -------
    CRS
        EPSG:258zz in Europe, EPSG:326zz north and EPSG:327zz south of the equator.
    """
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude_deg < 12.0:
        zone = 32  # south-western Norway, the exception in the UTM definition
    if _on_eurasian_plate(longitude_deg, latitude_deg):
        return CRS.from_epsg(25800 + zone)
    return CRS.from_epsg((32600 if latitude_deg >= 0.0 else 32700) + zone)


def _on_eurasian_plate(longitude_deg: float, latitude_deg: float) -> bool:
    """Return whether ETRS89 is the official datum here: Europe west of Russia, with its islands."""
    if not (-16.1 <= longitude_deg < 32.0 and 34.5 <= latitude_deg <= 84.8):
        return False
    north_africa = latitude_deg < 37.6 and -9.0 < longitude_deg < 11.6
    iberia = latitude_deg > 35.95 and longitude_deg < 0.0
    iceland = latitude_deg > 62.0 and longitude_deg < -12.0
    anatolia = latitude_deg < 41.0 and longitude_deg > 28.3
    return not (iceland or anatolia or (north_africa and not iberia))


def transformer(source: CRS, target: CRS) -> Transformer:
    """Return a transformer that takes and gives x before y (east before north)."""
    return Transformer.from_crs(source, target, always_xy=True)


def inexact_change(source: CRS, target: CRS, easting: float, northing: float) -> Text | None:
    """Return a remark where PROJ changes between two systems by over a metre's error, else None.

    Between datums it may lack the surveyors' grid of shifts, and take one shift for a country.

    Parameters
    ----------
    source, target : CRS
        Two systems.
    easting, northing : float
        A place, in coordinates of `source`.
    """
    if same_coordinates(source, target) or {_datum(source), _datum(target)} <= _LIKE_WGS84:
        return None
    change = transformer(source, target)
    if not np.isfinite(change.transform(easting, northing)).all():
        return None  # elsewhere, which others refuse
    try:
        error_m = change.get_last_used_operation().accuracy
    except ProjError:  # PROJ does not know it for all pairs
        error_m = -1.0
    if 0.0 <= error_m <= _EXACT_M:
        return None
    size = Text("unknown size") if error_m < 0.0 else Text("{:g} m", error_m)
    return Text("positions change from {} to {} with an error of {}", _label(source),
                _label(target), size)  # fmt: skip


def _datum(crs: CRS) -> str:
    """Return the name of a system's datum, empty if it has none."""
    geodetic = horizontal(crs).geodetic_crs
    return geodetic.datum.name if geodetic is not None and geodetic.datum is not None else ""


def reprojected_position(
    position: tuple[float, ...], source: Any, target: CRS
) -> tuple[float, ...]:
    """Return a position (easting, northing, ...) in another CRS; further values stay the same.

    Raises
    ------
    CrsError
        If `source` is no projected, metric coordinate system, or `target` does not cover the place.
    """
    metric = metric_crs(source, what=Text("CRS of the guess"))
    east, north = transformer(metric, target).transform(position[0], position[1])
    if not np.isfinite([east, north]).all():
        raise CrsError("{} does not reach into the area of {}", metric.name, target.name)
    return (float(east), float(north), *position[2:])


def same_coordinates(crs: CRS, other: CRS) -> bool:
    """Return whether the coordinates of both systems are the same numbers."""
    return crs == other or name_of(crs) == name_of(other)


def reprojected_box(box: Box, source: CRS, target: CRS) -> Box:
    """Return the bounds in `target` of a box in `source`; an infinite box stays as it is.

    Raises
    ------
    CrsError
        If the box lies outside the area of `target`.
    """
    if same_coordinates(source, target) or not np.isfinite(box).all():
        return box
    # Straight edges become curves: look at many points of them.
    west, south, east, north = transformer(source, target).transform_bounds(*box, densify_pts=21)
    if not np.isfinite([west, south, east, north]).all():
        raise CrsError("{} does not reach into the area of {}", source.name, target.name)
    return west, south, east, north


def looks_like_degrees(easting: float, northing: float) -> bool:
    """Return whether a position may be longitude and latitude, in either order, not metres."""
    low, high = sorted((abs(easting), abs(northing)))
    return low <= 90.0 and high <= 180.0


def bearing_of(value: Any) -> float:
    """Return the bearing (degrees clockwise from true north) of a number or a word of `WINDS`.

    Raises
    ------
    ValueError
        If it is neither.
    """
    text = str(value).strip().lower()
    if text in WINDS:
        return 45.0 * WINDS.index(text)
    bearing = float(text)
    if not math.isfinite(bearing):
        raise ValueError(text)
    return bearing


def yaw_from_compass(bearing_deg: float | str, crs: Any, easting: float, northing: float) -> float:
    """Return the yaw of a compass bearing: degrees from grid east to the left, in (-180, 180].

    Parameters
    ----------
    bearing_deg : float or str
        Clockwise from true north; or a word such as `north-east`.
    crs : CRS, str or int
        The projected system whose grid the yaw counts from.
    easting, northing : float
        The place, metres of this system; grid north and true north differ from place to place.

    Raises
    ------
    UsageError
        If the bearing is neither number nor word; CrsError if the place is none in this system.

    Examples
    --------
    >>> import gis_radar as gr
    >>> pose = gr.read_pose(gr.sample_folder() / "R1.json")
    >>> round(gr.yaw_from_compass(45.0, pose.crs, pose.easting, pose.northing), 2)
    46.91
    """
    try:
        bearing = bearing_of(bearing_deg)
    except ValueError as error:
        winds = ", ".join(WINDS)
        raise UsageError("{} is neither degrees nor one of {}", bearing_deg, winds) from error
    grid = metric_crs(crs, what="crs")
    require_true_scale(grid, easting, northing, what="easting, northing")
    projection = Proj(grid)
    longitude, latitude = projection(easting, northing, inverse=True)
    convergence_deg = projection.get_factors(longitude, latitude).meridian_convergence
    yaw = 90.0 - (bearing - convergence_deg)
    return 180.0 - (180.0 - yaw) % 360.0
