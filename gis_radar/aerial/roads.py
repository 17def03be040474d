"""Where the roads are: the lanelets of a map or any polygon layer, as one area on its levels."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from pyproj import CRS

from gis_radar.aerial.levels import Level, levels_of
from gis_radar.aerial.polygons import read_polygons
from gis_radar.crs import metric_crs, name_of, utm_zone
from gis_radar.errors import CrsError, InputError
from gis_radar.lanelets import LaneletMap, read_map
from gis_radar.lanelets.tagging import ON_FOOT_OR_BICYCLE
from gis_radar.progress import QUIET, Reporter

MOST_EXTENT_M = 200_000.0  # wider is a node in the wrong place, not a site


@dataclass(frozen=True, kw_only=True)
class Roads:
    """The roads of a site.

    Parameters
    ----------
    crs : CRS
        Projected, metric; that of the result, too.
    area : MultiPolygon
        All that is road, in one.
    levels : tuple of Level
        The same by level: roads that pass over each other lie on different ones.
    source : str
        The file it came from.
    """

    crs: CRS
    area: shapely.MultiPolygon = field(repr=False)
    levels: tuple[Level, ...] = field(repr=False)
    source: str

    @property
    def has_heights(self) -> bool:
        """Whether the map knows how high its roads lie."""
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
        Lanelet2 in OSM XML (`.osm`); else polygons in any format that GDAL reads, or CSV with
        a column of WKT or of rings `[[x, y], ...]`.
    crs : CRS, str or int, optional
        A projected system in metres for the result; without it that of the layer, or the site's
        UTM zone where the file is in degrees.
    map_crs : CRS, str or int, optional
        The system of a polygon layer that does not say its own.
    origin : (float, float), optional
        Of the map's local coordinates, see :func:`read_map`.
    layer : str, optional
        Which layer, where a file has several with polygons.
    reporter : Reporter
        Told the progress and the remarks.

    Raises
    ------
    InputError
        If there are no usable polygons; CrsError if the coordinate system is missing.
    """
    if Path(path).suffix.lower() in {".osm", ".xml"}:
        return roads_of_map(
            read_map(path, crs=crs, origin=origin, reporter=reporter), source=str(path)
        )
    table = read_polygons(path, crs=map_crs, layer=layer, reporter=reporter)
    return roads_of_polygons(_projected(table, crs, path), source=str(path))


def roads_of_map(roads: LaneletMap, *, source: str = "the map") -> Roads:
    """Return the roads that the lanelets for vehicles make, as `make_tiles` takes them."""
    lanelets = roads.lanelets[~roads.lanelets["subtype"].isin(ON_FOOT_OR_BICYCLE)]
    if lanelets.empty:
        raise InputError(f"{source}: has no lanelet for vehicles")
    # The outline of a mended lanelet may still touch itself.
    outlines = shapely.make_valid(lanelets.geometry.array)
    return Roads(
        crs=roads.crs,
        area=_area(outlines, source),
        levels=levels_of(outlines, lanelets["left"], lanelets["right"]),
        source=source,
    )


def roads_of_polygons(table: gpd.GeoDataFrame, *, source: str = "the road layer") -> Roads:
    """Return the roads that valid polygons in a projected, metric system make."""
    crs = metric_crs(table.crs, what=source)
    area = _area(table.geometry.array, source)
    return Roads(crs=crs, area=area, levels=(Level(shapes=shapely.get_parts(area)),), source=source)


def _projected(table: gpd.GeoDataFrame, crs: Any, path: str | Path) -> gpd.GeoDataFrame:
    if crs is None and table.crs.is_geographic:
        west, south, east, north = table.to_crs(4326).total_bounds
        crs = utm_zone((west + east) / 2.0, (south + north) / 2.0)
    if crs is None:
        return table.set_crs(metric_crs(table.crs, what=str(path)), allow_override=True)
    moved = table.to_crs(metric_crs(crs, what="--crs"))
    if not np.isfinite(moved.total_bounds).all():
        raise CrsError(f"{path}: lies outside the area of {crs}")
    return moved


def _area(shapes: Any, source: str) -> shapely.MultiPolygon:
    parts = shapely.get_parts(shapely.union_all(shapes))
    parts = parts[shapely.area(parts) > 0.0]
    if len(parts) == 0:
        raise InputError(f"{source}: its polygons have no area")
    area = shapely.MultiPolygon(list(parts))
    west, south, east, north = area.bounds
    if max(east - west, north - south) > MOST_EXTENT_M:
        far_km = max(east - west, north - south) / 1000.0
        raise InputError(f"{source}: spans {far_km:.0f} km, which is no site", hint="cut it out")
    return area
