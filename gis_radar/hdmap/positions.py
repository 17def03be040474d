"""Positions of a map's nodes: projected from latitude and longitude, or taken from local metres.

A map may have both. Where they agree, latitude and longitude count. Where they differ by more than
0.1 % in scale, or latitude and longitude are unusable, the local metres (`local_x`, `local_y`)
count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import CRS

from gis_radar.base import (
    Booleans,
    CrsError,
    Floats,
    InputError,
    Text,
    UsageError,
    inexact_change,
    metric_crs,
    name_of,
    require_true_scale,
    transformer,
    utm_zone,
)
from gis_radar.hdmap.osm import OsmMap

_WIDEST_DEG = 0.5  # of longitude, from the middle of a map; nodes farther away are misplaced
_SCALE_TOLERANCE = 0.001  # 10 cm in 100 m; UTM's scale error at the edge of its zone
# Equal heights of less than this share of the nodes come from a template, not from a survey.
_KNOWN_HEIGHTS = 0.25
_MOST_HEIGHTS = 0.5  # share of nodes with a height from which on missing ones are not reported
_EQUAL_M = 0.05  # range of heights that count as equal: survey noise is as large
_WGS84 = CRS.from_epsg(4326)


@dataclass(frozen=True, kw_only=True)
class Positions:
    """Positions of all nodes in one projected system.

    Parameters
    ----------
    xyz : (n, 3) array
        Easting, northing, height in metres. A node without a position is NaN in the first two;
        heights are NaN where unknown.
    crs : CRS
        The projected system.
    remarks : tuple of str
        Remarks for the user on the source of the positions.
    """

    xyz: Floats
    crs: CRS
    remarks: tuple[str, ...]


def place_nodes(
    osm: OsmMap, used: Booleans, *, crs: Any = None, origin: tuple[float, float] | None = None
) -> Positions:
    """Return the positions of all nodes of a map.

    Parameters
    ----------
    osm : OsmMap
        The map as read.
    used : (n,) array of bool
        The nodes that lanelets use; they decide the zone, and which coordinates count.
    crs : CRS, str or int, optional
        A projected system in metres; without it, the UTM zone of the middle of the used nodes.
    origin : (float, float), optional
        Easting and northing in metres of the local (0, 0), for maps whose local metres count.

    Returns
    -------
    Positions
        In one system, even where the map spans several zones.

    Raises
    ------
    InputError
        If no node has a position, or the map is local and its place is not given.
    CrsError
        If `crs` is no projected one in metres, or not true to scale at the place of the map.
    UsageError
        If `origin` is given for a map without local metres, or is not finite.
    """
    if origin is not None and not np.all(np.isfinite(origin)):
        raise UsageError("{} is {}, expected two numbers: easting,northing", "--origin", origin)
    target = None if crs is None else metric_crs(crs, what="--crs")
    geographic = _known(osm.geographic) & used & _holds_positions(osm.geographic[used])
    local = _known(osm.local) & used
    if not (geographic.any() or local.any()):
        raise InputError("{}: no lanelet has a node with usable coordinates", osm.path)
    if origin is not None and not local.any():
        raise UsageError(
            "{}: {} given, but the map has no local_x and local_y",
            osm.path,
            "--origin",
            hint=Text("leave {} out", "--origin"),
        )
    if not geographic.any():
        plane, target, remarks = _without_geographic(osm, target, origin)
    else:
        target = target or _utm_zone_of(osm.geographic[geographic])
        try:
            plane, remarks = _with_geographic(osm, geographic, local, target, origin)
        except CrsError as error:
            if isinstance(crs, str | int):
                raise
            wrong = error.message.without("--crs")
            hint = Text("are the latitudes and longitudes of its nodes true?")
            raise CrsError("{}: {}", osm.path, wrong, hint=hint) from error
        if crs is None:
            remarks += _border_remarks(osm.geographic[geographic], target)
        else:
            remarks += _datum_remarks(target, osm.geographic[geographic])
    if crs is not None:
        remarks += _scale_remarks(target, plane[used])
    heights, more = _heights(osm, used)
    if osm.odd_heights:
        node, text = osm.odd_heights[0]
        count = Text("heights of {} nodes are not used", len(osm.odd_heights))
        more += (
            Text(
                "{}: ele is no number of metres, such as {} of node {}",
                count,
                repr(text[:20]),
                node,
            ),
        )
    return Positions(xyz=np.column_stack([plane, heights]), crs=target, remarks=remarks + more)


def _border_remarks(geographic: Floats, chosen: CRS) -> tuple[str, ...]:
    """Return a remark on the chosen zone where a map lies in two."""
    longitude, latitude = np.median(geographic, axis=0)
    near = geographic[np.abs(geographic[:, 0] - longitude) < _WIDEST_DEG, 0]
    if not len(near):  # half of the nodes lie here, half far away
        return ()
    west_zone, east_zone = (
        name_of(utm_zone(float(end), float(latitude))) for end in (near.min(), near.max())
    )
    if west_zone == east_zone:
        return ()
    chosen_zone = name_of(chosen)
    return (
        Text(
            "lies on the border of {} and {}, all of it is in {}; {} names another",
            west_zone,
            east_zone,
            chosen_zone,
            "--crs",
        ),
    )


def _scale_remarks(target: CRS, plane: Floats) -> tuple[str, ...]:
    """Return a remark if `target` is not true to scale there; the positions stay unchanged."""
    try:
        _require_fit(target, plane)
    except CrsError as error:
        return (error.message,)
    return ()


def _datum_remarks(target: CRS, geographic: Floats) -> tuple[str, ...]:
    """Return a remark if latitudes and longitudes cannot be projected to a metre."""
    longitude, latitude = np.median(geographic, axis=0)
    remark = inexact_change(_WGS84, target, float(longitude), float(latitude))
    return () if remark is None else (remark,)


def _require_fit(target: CRS, plane: Floats) -> None:
    known = plane[_known(plane)]
    easting, northing = np.median(known, axis=0) if len(known) else (np.nan, np.nan)
    require_true_scale(target, float(easting), float(northing), what="--crs")


def _known(coordinates: Floats) -> Booleans:
    known: Booleans = np.all(np.isfinite(coordinates), axis=1)
    return known


def _holds_positions(geographic: Floats) -> bool:
    """Return whether latitudes and longitudes hold positions: all nodes at one place do not."""
    known = geographic[_known(geographic)]
    return len(known) == 1 or (len(known) > 1 and bool(np.ptp(known, axis=0).any()))


def _utm_zone_of(geographic: Floats) -> CRS:
    longitude, latitude = np.median(geographic, axis=0)
    return utm_zone(float(longitude), float(latitude))


def _without_geographic(
    osm: OsmMap, target: CRS | None, origin: tuple[float, float] | None
) -> tuple[Floats, CRS, tuple[str, ...]]:
    """Return local metres shifted by `origin`, where latitudes and longitudes are empty."""
    what = Text("{}: its latitudes and longitudes are empty", osm.path)
    if origin is None:
        raise InputError(
            "{}, so where its local_x and local_y lie is not known",
            what,
            hint=Text("say where local (0, 0) lies: {} E,N", "--origin"),
        )
    if target is None:
        raise InputError(
            "{}, so its zone is not known", what, hint=Text("give it, e.g. {} EPSG:25832", "--crs")
        )
    return osm.local + np.asarray(origin), target, ("placed by local_x, local_y and --origin",)


def _with_geographic(
    osm: OsmMap,
    geographic: Booleans,
    local: Booleans,
    target: CRS,
    origin: tuple[float, float] | None,
) -> tuple[Floats, tuple[str, ...]]:
    """Return projected positions, or local metres where their scales differ, with remarks."""
    projected = _project(osm.geographic, target)
    both = geographic & local & _known(projected)
    if both.sum() < 2:
        return _by_commoner_kind(osm, projected, geographic, local, target, origin)
    # Compared in the site's UTM zone: the scale of another --crs would count as a disagreement.
    zone = _utm_zone_of(osm.geographic[both])
    off = _scale_error(osm.local[both], _project(osm.geographic[both], zone))
    if off > _SCALE_TOLERANCE:
        reason = Text("latitudes and longitudes differ from them in scale by {:.2g} %", 100.0 * off)
        return _placed_by_local(osm.local, projected[both] - osm.local[both], origin, reason)
    _require_fit(target, projected[geographic])
    fit = _similarity(osm.local[both], projected[both])
    # The fit only fills gaps: it is rotated where the local metres are not those of a grid.
    filled = np.where(_known(projected)[:, None], projected, _transformed(fit, osm.local))
    return filled, _unused_origin_remark(
        origin, "local_x, local_y agree with latitudes and longitudes"
    )


def _by_commoner_kind(
    osm: OsmMap,
    projected: Floats,
    geographic: Booleans,
    local: Booleans,
    target: CRS,
    origin: tuple[float, float] | None,
) -> tuple[Floats, tuple[str, ...]]:
    """Return positions by the coordinates that more nodes have, where fewer than two have both."""
    if geographic.sum() >= local.sum():
        _require_fit(target, projected[geographic])
        return projected, _unused_origin_remark(
            origin, "most nodes have latitudes and longitudes only"
        )
    both = geographic & local
    if origin is None and not both.any():
        raise InputError(
            "{}: {} nodes have only local_x and local_y, and where these lie is not known",
            osm.path,
            local.sum(),
            hint=Text("say where local (0, 0) lies: {} E,N", "--origin"),
        )
    shifts = projected[both] - osm.local[both]
    return _placed_by_local(osm.local, shifts, origin, "most nodes have nothing else")


def _unused_origin_remark(origin: tuple[float, float] | None, reason: str) -> tuple[str, ...]:
    return () if origin is None else (Text("{} is not used: {}, which decide", "--origin", reason),)


def _placed_by_local(
    local: Floats, shifts: Floats, origin: tuple[float, float] | None, reason: str
) -> tuple[Floats, tuple[str, ...]]:
    """Return local metres shifted by `origin`, or by the mean of `shifts`, and remarks on that."""
    by = Text("placed by local_x, local_y ({})", reason)
    if origin is not None:
        return local + np.asarray(origin), (Text("{} and {}", by, "--origin"),)
    shift = np.mean(shifts, axis=0)
    shifted = Text("{}, moved by the best-fit shift ({:.3f}, {:.3f})", by, shift[0], shift[1])
    return local + shift, (
        Text("{}; say where local (0, 0) truly lies with {} E,N", shifted, "--origin"),
    )


def _project(geographic: Floats, target: CRS) -> Floats:
    """Return easting and northing of all nodes, metres; NaN where the projection has none."""
    east, north = transformer(_WGS84, target).transform(geographic[:, 0], geographic[:, 1])
    plane: Floats = np.column_stack([east, north])
    plane[~np.isfinite(plane).all(axis=1)] = np.nan
    return plane


def _scale_error(local: Floats, projected: Floats) -> float:
    """Return the greatest deviation from 1 of the scale from local to projected metres.

    Rotation and shift do not count; for a mirrored map it is infinite. A narrow map is compared by
    its length only, any other in all directions.
    """
    dx, dy = local - local.mean(axis=0), projected - projected.mean(axis=0)
    spread = np.linalg.svd(dx, compute_uv=False)
    if spread[-1] < 0.05 * spread[0] or len(local) < 3:
        length = float(np.linalg.norm(dx))
        return abs(float(np.linalg.norm(dy)) / length - 1.0) if length > 0.0 else np.inf
    linear = np.linalg.lstsq(dx, dy, rcond=None)[0]
    if np.linalg.det(linear) < 0.0:
        return float(np.inf)
    return float(np.max(np.abs(np.linalg.svd(linear, compute_uv=False) - 1.0)))


def _similarity(local: Floats, projected: Floats) -> tuple[complex, complex]:
    """Fit projected = a local + b, least squares in complex numbers; return a and b."""
    x, y = local @ (1.0, 1.0j), projected @ (1.0, 1.0j)
    dx = x - x.mean()
    a = complex(np.vdot(dx, y) / np.vdot(dx, dx).real)
    return a, complex(y.mean() - a * x.mean())


def _transformed(fit: tuple[complex, complex], local: Floats) -> Floats:
    z = fit[0] * (local @ (1.0, 1.0j)) + fit[1]
    return np.column_stack([z.real, z.imag])


def _heights(osm: OsmMap, used: Booleans) -> tuple[Floats, tuple[str, ...]]:
    """Return the heights of all nodes, metres, with remarks; all NaN where only a few are equal."""
    given = osm.elevation[np.isfinite(osm.elevation) & used]
    share = len(given) / used.sum()
    tagged = int(np.isfinite(osm.elevation).sum())
    if share >= _MOST_HEIGHTS or not tagged:
        return osm.elevation, ()
    if share < _KNOWN_HEIGHTS and (not len(given) or np.ptp(given) <= _EQUAL_M):
        few = Text("only {} of {} nodes have an ele tag, all equal", tagged, len(used))
        return np.full_like(osm.elevation, np.nan), (
            Text("heights are treated as unknown: {}", few),
        )
    some = Text("only {} of {} nodes have a height", len(given), used.sum())
    return osm.elevation, (
        Text("{}: interpolated along bounds, unknown where a lanelet has none", some),
    )
