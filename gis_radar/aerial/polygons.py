"""Polygon layers of any origin, such as a city's own road surfaces."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError as ProjError

from gis_radar.errors import CrsError, InputError
from gis_radar.progress import QUIET, Reporter

SAME_AREA = 1e-3
_POLYGONAL = (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON)


def read_polygons(
    path: str | Path, *, crs: Any = None, layer: str | None = None, reporter: Reporter = QUIET
) -> gpd.GeoDataFrame:
    """Read the polygons of a layer.

    A polygon that touches itself or repeats points is mended. One that crosses itself, so that
    nobody can tell which part of it is meant, is refused.

    Parameters
    ----------
    path : str or Path
        Any format that GDAL reads, or CSV.
    crs : CRS, str or int, optional
        The coordinate system, where the file does not say it.
    layer : str, optional
        Which layer, where there are several with polygons.
    reporter : Reporter
        Told what was mended.

    Raises
    ------
    InputError
        If the file has no usable polygons; CrsError if it does not say its coordinate system.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    table = _read_csv(path) if path.suffix.lower() in {".csv", ".txt"} else _read_layer(path, layer)
    shapes = shapely.force_2d(table.geometry.array)
    kept = ~(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    if not np.isin(shapely.get_type_id(shapes[kept]), _POLYGONAL).all() or not kept.any():
        kinds = ", ".join(sorted(set(table.geom_type[kept]))) or "nothing"
        raise InputError(f"{path}: holds {kinds}, polygons of the roads are needed")
    mended = _mended(shapes[kept], path, reporter)
    return gpd.GeoDataFrame(geometry=mended, crs=_crs(table, crs, path))


def _crs(table: gpd.GeoDataFrame, crs: Any, path: Path) -> CRS:
    if table.crs is not None:
        return CRS.from_user_input(table.crs)
    if crs is None:
        raise CrsError(f"{path}: has no coordinate system", hint="say which: --map-crs EPSG:25832")
    try:
        return CRS.from_user_input(crs)
    except ProjError as error:
        raise CrsError(f"--map-crs: {crs!r} is not a known coordinate system") from error


def _read_layer(path: Path, layer: str | None) -> gpd.GeoDataFrame:
    try:
        name = layer or _only_layer(path)
        table = pyogrio.read_dataframe(path, layer=name, columns=[])
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{path}: not a readable map: {reason}", hint="a Lanelet2 map ends in .osm"
        ) from error
    except (shapely.errors.GEOSException, ValueError) as error:
        raise InputError(f"{path}: has broken geometry: {str(error).splitlines()[0]}") from error
    if not isinstance(table, gpd.GeoDataFrame):
        raise InputError(f"{path}: has no geometry, polygons of the roads are needed")
    return table


def _only_layer(path: Path) -> str:
    layers = pyogrio.list_layers(path)
    areas = [str(name) for name, kind in layers if kind and "Polygon" in kind]
    if len(areas) > 1:
        raise InputError(
            f"{path}: has {len(areas)} layers with polygons: {', '.join(areas)}",
            hint="choose one: --layer NAME",
        )
    return areas[0] if areas else str(layers[0][0])


def _read_csv(path: Path) -> gpd.GeoDataFrame:
    """Read a table whose column of polygons is found by what stands in it."""
    try:
        table = pd.read_csv(path, dtype=str, sep=None, engine="python")
    except (ValueError, pd.errors.ParserError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path}: not a readable CSV: {str(error).splitlines()[0]}") from error
    for name in table.columns:
        texts = table[name].dropna().str.strip()
        if texts.empty or not texts.iloc[0].upper().startswith(("POLYGON", "MULTIPOLYGON", "[[")):
            continue
        try:
            shapes = [_polygon(text) for text in texts]
        except (ValueError, TypeError, shapely.errors.GEOSException) as error:
            raise InputError(f"{path}: column {name!r} has a broken polygon: {error}") from error
        return gpd.GeoDataFrame(geometry=shapes)
    raise InputError(f"{path}: has no column of polygons", hint="as WKT, or as rings [[x, y], ...]")


def _polygon(text: str) -> Any:
    return shapely.Polygon(json.loads(text)) if text.startswith("[") else shapely.from_wkt(text)


def _mended(shapes: Any, path: Path, reporter: Reporter) -> Any:
    """Mend polygons where that leaves their area as drawn."""
    if not np.isfinite(shapely.bounds(shapes)).all():
        raise InputError(f"{path}: polygon {_first(~np.isfinite(shapely.bounds(shapes)).all(1))} "
                         "has coordinates that are no numbers")  # fmt: skip
    invalid = ~shapely.is_valid(shapes)
    if not invalid.any():
        return shapes
    mended = shapes.copy()
    mended[invalid] = shapely.make_valid(shapes[invalid])
    # The signed area of a ring that crosses itself is less than what it encloses.
    off = np.abs(shapely.area(mended) - shapely.area(shapes))
    unclear = invalid & (off > SAME_AREA * shapely.area(mended) + 1e-9)
    unclear |= invalid & ~(shapely.area(mended) > 0.0)
    if unclear.any():
        reason = shapely.is_valid_reason(shapes[unclear][0]).replace("\n", " ")
        raise InputError(
            f"{path}: polygon {_first(unclear)} (from 0) is invalid: {reason}",
            hint="mend the layer, e.g. in QGIS with Fix geometries",
        )
    reporter.log(f"{path.name}: {int(invalid.sum())} polygons mended, their areas kept", "warning")
    return mended


def _first(flags: Any) -> int:
    return int(np.flatnonzero(flags)[0])
