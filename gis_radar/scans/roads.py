"""Roads from the lanelets of a map or from a polygon layer, as one area and by level."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import scipy
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError as ProjError

from gis_radar.base import (
    QUIET,
    CrsError,
    Floats,
    Grid,
    InputError,
    Integers,
    Reporter,
    Text,
    first_line,
    metric_crs,
    name_of,
    read_vector,
    utm_zone,
)
from gis_radar.hdmap import ON_FOOT_OR_BICYCLE, LaneletMap, at_fractions, bound_length, read_map

_SAMPLE_M = 2.0  # spacing of samples of the map's heights, and side of the squares that share one
# Lanelets closer than _NEAR_M are one surface, unless their heights differ by more than _STEP_M and
# a slope of 30 %, which no road has.
_NEAR_M, _STEP_M, _STEEPEST = 6.0, 1.0, 0.3
_SAME_AREA = 1e-3  # share by which mending a polygon may change its area
_MOST_EXTENT_M = 200_000.0  # a wider map has a node in the wrong place


@dataclass(frozen=True, kw_only=True)
class RoadLevel:
    """Roads that make one surface in the plane: at no place does one pass over another.

    Parameters
    ----------
    shapes : array of Polygon
        Their outlines, which may overlap.
    heights : (n, 3) array
        Easting, northing and height of points on them; empty where the map has no heights.
    """

    shapes: Any = field(repr=False)
    heights: Floats = field(default_factory=lambda: np.empty((0, 3)), repr=False)

    @property
    def has_heights(self) -> bool:
        """Whether the map has heights of these roads."""
        return len(self.heights) > 0

    def height_near(self, xy: Floats) -> Floats:
        """Return the map's height (m) nearest to the square of `_SAMPLE_M` of each place, (n,)."""
        if len(xy) == 0:
            return np.empty(0)
        x, y = xy.T
        grid = Grid.around(x, y, _SAMPLE_M)
        squares, which = np.unique(grid.keys(x, y), return_inverse=True)
        _, nearest = self._samples.query(grid.centres(squares))
        return np.asarray(self.heights[nearest, 2][which])

    @cached_property
    def _samples(self) -> scipy.spatial.cKDTree:
        return scipy.spatial.cKDTree(self.heights[:, :2])


def _levels_of(outlines: Any, lefts: Iterable[Any], rights: Iterable[Any]) -> tuple[RoadLevel, ...]:
    """Sort lanelets into levels by the heights of their bounds, where the map has them."""
    outlines = np.asarray(outlines)
    samples = [_sampled(left, right) for left, right in zip(lefts, rights, strict=True)]
    owner = np.repeat(np.arange(len(samples)), [len(sample) for sample in samples])
    points = np.concatenate(samples)
    known = np.isfinite(points[:, 2])
    if not known.any():
        return (RoadLevel(shapes=outlines),)
    points, owner = points[known], owner[known]
    number = _level_numbers(_conflicts(points, owner), points, owner, len(outlines))
    return tuple(
        RoadLevel(shapes=outlines[number == level], heights=points[number[owner] == level])
        for level in range(int(number.max()) + 1)
    )


def _sampled(left: shapely.LineString, right: shapely.LineString) -> Floats:
    """Return points on both bounds and half-way between them, (n, 3) metres."""
    bounds = [shapely.get_coordinates(line, include_z=True) for line in (left, right)]
    count = max(2, round(max(bound_length(bound) for bound in bounds) / _SAMPLE_M) + 1)
    fractions = np.linspace(0.0, 1.0, count)
    on_left, on_right = (at_fractions(bound, fractions) for bound in bounds)
    return np.concatenate([on_left, (on_left + on_right) / 2.0, on_right])


def _level_numbers(conflicts: Integers, points: Floats, owner: Integers, count: int) -> Integers:
    """Return the level of each lanelet, by mean height: the lowest free of conflicts with it."""
    number = np.zeros(count, np.int64)
    mean = np.bincount(owner, points[:, 2], count) / np.maximum(np.bincount(owner, None, count), 1)
    conflicting: defaultdict[int, set[int]] = defaultdict(set)
    for a, b in conflicts.tolist():
        conflicting[a].add(b)
        conflicting[b].add(a)
    numbered: set[int] = set()
    for lanelet in sorted(conflicting, key=lambda ref: (mean[ref], ref)):
        taken = {int(number[other]) for other in conflicting[lanelet] & numbered}
        number[lanelet] = next(level for level in range(count) if level not in taken)
        numbered.add(lanelet)
    return number


def _conflicts(points: Floats, owner: Integers) -> Integers:
    """Return pairs of lanelets that cannot be one surface, as (n, 2) numbers."""
    if np.ptp(points[:, 2]) <= _STEP_M:
        return np.empty((0, 2), np.int64)
    pairs = scipy.spatial.cKDTree(points[:, :2]).query_pairs(_NEAR_M, output_type="ndarray")
    a, b = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]].T
    step = np.abs(points[a, 2] - points[b, 2])
    near = np.hypot(*(points[a, :2] - points[b, :2]).T)
    steep = step > _STEP_M + _STEEPEST * near
    return np.unique(np.column_stack([owner[a[steep]], owner[b[steep]]]), axis=0)


_BEYOND_M = 1e9  # no coordinate of a projected system is as far from its origin
_POLYGONAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


def _read_polygons(path: Path, crs: Any, layer: str | None, reporter: Reporter) -> gpd.GeoDataFrame:
    """Read the polygons of a layer of a vector file, or of a CSV.

    A polygon that touches itself or repeats points is mended. One that crosses itself is refused:
    its area is ambiguous.
    """
    if not path.is_file():
        raise InputError("{}: no such file", path)
    if path.suffix.lower() in {".csv", ".txt"}:
        table = _read_csv(path)
    else:
        table = read_vector(path, what="map", choose=layer or _only_layer, reporter=reporter)
    shapes = shapely.force_2d(table.geometry.array)
    kept = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    if not np.isin(shapely.get_type_id(shapes[kept]), _POLYGONAL).all() or not kept.any():
        kinds = ", ".join(sorted(set(table.geom_type[kept]))) or "nothing"
        raise InputError("{}: holds {}, polygons of the roads are needed", path, kinds)
    mended = _mended(shapes[kept], path, reporter)
    known = _given_crs(crs, path) if table.crs is None else table.crs
    return gpd.GeoDataFrame(geometry=mended, crs=known)


def _given_crs(crs: Any, path: Path) -> CRS:
    """Return the CRS that the user states for a layer without one."""
    if crs is None:
        raise CrsError(
            "{}: has no coordinate system", path, hint=Text("state it: {} EPSG:25832", "--map-crs")
        )
    try:
        return CRS.from_user_input(crs)
    except ProjError as error:
        raise CrsError("{}: {} is not a known coordinate system", "--map-crs", repr(crs)) from error


def _only_layer(layers: Mapping[str, str], path: Path) -> str:
    """Return the layer of polygons; refuse several, of which the user must choose one."""
    areas = [name for name, kind in layers.items() if "Polygon" in kind]
    if len(areas) > 1:
        raise InputError(
            "{}: has {} layers with polygons: {}",
            path,
            len(areas),
            ", ".join(areas),
            hint="choose one: --layer NAME",
        )
    return areas[0] if areas else next(iter(layers))


def _read_csv(path: Path) -> gpd.GeoDataFrame:
    """Read a table; the column of polygons is found by its content."""
    try:
        table = pd.read_csv(path, dtype=str, sep=None, engine="python")
    except (ValueError, csv.Error, pd.errors.ParserError, UnicodeDecodeError, OSError) as error:
        raise InputError("{}: not a readable CSV: {}", path, first_line(error)) from error
    for name in table.columns:
        texts = table[name].dropna().str.strip()
        if texts.empty or not texts.iloc[0].upper().startswith(("POLYGON", "MULTIPOLYGON", "[[")):
            continue
        try:
            shapes = [_polygon(text) for text in texts]
        except (ValueError, TypeError, shapely.errors.GEOSException) as error:
            raise InputError(
                "{}: column {} has a broken polygon: {}", path, repr(name), error
            ) from error
        return gpd.GeoDataFrame(geometry=shapes)
    raise InputError(
        "{}: has no column of polygons", path, hint="as WKT, or as rings [[x, y], ...]"
    )


@np.errstate(over="ignore", invalid="ignore")  # coordinates that are not finite are refused later
def _polygon(text: str) -> Any:
    return shapely.Polygon(json.loads(text)) if text.startswith("[") else shapely.from_wkt(text)


def _mended(shapes: Any, path: Path, reporter: Reporter) -> Any:
    """Return polygons mended; refuse one whose area would change by more than `_SAME_AREA`."""
    # Each corner is checked: a bounding box would leave out NaN.
    corners, of_shape = shapely.get_coordinates(shapes, return_index=True)
    odd = of_shape[~(np.abs(corners) < _BEYOND_M).all(axis=1)]
    if len(odd):
        raise InputError(
            "{}: polygon {} has coordinates that are no numbers, or beyond any map", path, odd[0]
        )
    invalid = ~shapely.is_valid(shapes)
    if not invalid.any():
        return shapes
    mended = shapes.copy()
    mended[invalid] = shapely.make_valid(shapes[invalid])
    # The signed area of a ring that crosses itself is less than the area it encloses.
    off = np.abs(shapely.area(mended) - shapely.area(shapes))
    unclear = invalid & (off > _SAME_AREA * shapely.area(mended) + 1e-9)
    unclear |= invalid & ~(shapely.area(mended) > 0.0)
    if unclear.any():
        reason = shapely.is_valid_reason(shapes[unclear][0]).replace("\n", " ")
        raise InputError(
            "{}: polygon {} (from 0) is invalid: {}",
            path,
            int(np.flatnonzero(unclear)[0]),
            reason,
            hint="mend the layer, e.g. in QGIS with Fix geometries",
        )
    reporter.warn("{}: {} polygons mended, their areas kept", path.name, int(invalid.sum()))
    return mended


@dataclass(frozen=True, kw_only=True)
class Roads:
    """The roads of a site.

    Parameters
    ----------
    crs : CRS
        Projected, metric coordinate system, also of the road mask.
    area : MultiPolygon
        Union of all roads.
    levels : tuple of RoadLevel
        The roads by level: roads that pass over each other are on different levels.
    source : str
        Their file.
    """

    crs: CRS
    area: shapely.MultiPolygon = field(repr=False)
    levels: tuple[RoadLevel, ...] = field(repr=False)
    source: str

    @property
    def has_heights(self) -> bool:
        """Whether the map has heights of its roads."""
        return any(level.has_heights for level in self.levels)

    def __repr__(self) -> str:
        return f"Roads({self.source}: {self.area.area:.0f} m2, {name_of(self.crs)})"


def read_roads(
    path: str | Path,
    *,
    crs: Any = None,
    map_crs: Any = None,
    origin: tuple[float, float] | None = None,
    layer: str | None = None,
    reporter: Reporter = QUIET,
) -> Roads:
    """Read the roads of a Lanelet2 map or of a polygon layer.

    Parameters
    ----------
    path : str or Path
        Lanelet2 in OSM XML (`.osm`); else polygons as GeoPackage, GeoJSON, shapefile,
        FlatGeobuf, or CSV with a column of WKT or of rings `[[x, y], ...]`.
    crs : CRS, str or int, optional
        A projected system in metres for the result; without it that of the layer, or the site's
        UTM zone where the file is in degrees.
    map_crs : CRS, str or int, optional
        The system of a polygon layer without one.
    origin : (float, float), optional
        Position of the map's local (0, 0), see :func:`read_map`.
    layer : str, optional
        Which layer, where a file has several with polygons.
    reporter : Reporter
        Receives progress and remarks.

    Raises
    ------
    InputError
        If there are no usable polygons; CrsError if the coordinate system is missing.
    """
    if Path(path).suffix.lower() in {".osm", ".xml"}:
        roads = read_map(path, crs=crs, origin=origin, reporter=reporter)
        return roads_of_map(roads, source=str(path))
    table = _projected(_read_polygons(Path(path), map_crs, layer, reporter), crs, path)
    area = _area(table.geometry.array, str(path))
    levels = (RoadLevel(shapes=shapely.get_parts(area)),)
    metric = metric_crs(table.crs, what=str(path))
    return Roads(crs=metric, area=area, levels=levels, source=str(path))


def roads_of_map(roads: LaneletMap, *, source: str = "the map") -> Roads:
    """Return the roads of the lanelets for vehicles, the same as `make_tiles` cuts into tiles."""
    lanelets = roads.lanelets[~roads.lanelets["subtype"].isin(ON_FOOT_OR_BICYCLE)]
    if lanelets.empty:
        raise InputError("{}: has no lanelet for vehicles", source)
    # The outline of a mended lanelet may still touch itself.
    outlines = shapely.make_valid(lanelets.geometry.array)
    area = _area(outlines, source)
    levels = _levels_of(outlines, lanelets["left"], lanelets["right"])
    return Roads(crs=roads.crs, area=area, levels=levels, source=source)


def _projected(table: gpd.GeoDataFrame, crs: Any, path: str | Path) -> gpd.GeoDataFrame:
    """Return a table in `crs`, else in the site's UTM zone if it is in degrees."""
    if crs is None and table.crs.is_geographic:
        west, south, east, north = table.to_crs(4326).total_bounds
        crs = utm_zone((west + east) / 2.0, (south + north) / 2.0)
    if crs is None:
        return table.set_crs(metric_crs(table.crs, what=str(path)), allow_override=True)
    projected = table.to_crs(metric_crs(crs, what="--crs"))
    if not np.isfinite(projected.total_bounds).all():
        raise CrsError("{}: lies outside the area of {}", path, crs)
    return projected


def _area(shapes: Any, source: str) -> shapely.MultiPolygon:
    """Return the union of polygons; refuse one without area or wider than `_MOST_EXTENT_M`."""
    parts = shapely.get_parts(shapely.union_all(shapes))
    parts = parts[shapely.area(parts) > 0.0]
    if len(parts) == 0:
        raise InputError("{}: its polygons have no area", source)
    area = shapely.MultiPolygon(list(parts))
    west, south, east, north = area.bounds
    extent_m = max(east - west, north - south)
    if extent_m > _MOST_EXTENT_M:
        far_km = extent_m / 1000.0
        raise InputError("{}: spans {:.0f} km, which is no site", source, far_km, hint="cut it out")
    return area
