"""Read layers of other programs: GeoPackage, GeoJSON, shapefile, FlatGeobuf, and no other format.

GDAL chooses its driver by the content of a file, and some drivers open what the content names:
other files and addresses. So the content is looked at before GDAL sees it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd
import pyogrio
import shapely

from gis_radar.base.errors import CrsError, InputError
from gis_radar.base.geopackage import SQLITE, library_errors, opened_package, plain_place
from gis_radar.base.progress import QUIET, Reporter
from gis_radar.base.texts import Text

_SHAPEFILE, _FLATGEOBUF = b"\0\0\x27\x0a", b"fgb\x03fgb"  # their first bytes
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
# Names of a coordinate system; anything else could be an address or a file.
_CRS_NAME = re.compile(r"(urn:(ogc|x-ogc):def:crs:|EPSG:|OGC:)[\w:.+]+", re.IGNORECASE | re.ASCII)


def read_vector(
    path: str | Path,
    *,
    what: str,
    choose: str | Callable[[Mapping[str, str], Path], str] | None = None,
    columns: Sequence[str] | None = (),
    reporter: Reporter = QUIET,
) -> gpd.GeoDataFrame:
    """Read a layer with geometry.

    Parameters
    ----------
    path : str or Path
        The file, on this machine.
    what : str
        Expected content, for messages: `map`.
    choose : str or callable, optional
        The layer; or a function that chooses it, given the kind of geometry of each layer, and
        the path. By default the first.
    columns : sequence of str, optional
        Columns to read beside the geometry; None for all.
    reporter : Reporter
        Receives what the libraries warn of.

    Returns
    -------
    GeoDataFrame
        With its coordinate system, where the file states one.

    Raises
    ------
    InputError
        If the file is missing, damaged, in another format, or has no such layer or no geometry;
        CrsError if a GeoJSON states its coordinate system by something else than a known name.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("{}: no such file", path)
    with library_errors(path, what=Text("a readable {}", what), reporter=reporter):
        with path.open("rb") as file:
            head = file.read(512)
        if head.startswith(SQLITE):
            with opened_package(path, what=Text("a readable {}", what)):
                return _read_by_gdal(path, choose, columns)
        # GDAL looks for its drivers' signatures up to the first zero byte: it must come early.
        flat = head.startswith(_FLATGEOBUF) and 0 in head[:12]
        if flat or (head.startswith(_SHAPEFILE) and path.suffix.lower() == ".shp"):
            return _read_by_gdal(path, choose, columns)
        if head.removeprefix(_BYTE_ORDER_MARK).lstrip().startswith(b"{"):
            table = _read_geojson(path)
            return table if columns is None else table[[*columns, "geometry"]]
    wrong = Text("{}: not a readable {}: the format is not known", path, what)
    raise InputError(
        wrong,
        hint=Text(
            "use GeoPackage, GeoJSON, shapefile or FlatGeobuf, or for a Lanelet2 map a name "
            "that ends in .osm"
        ),
    )


def _read_by_gdal(path: Path, choose: Any, columns: Sequence[str] | None) -> gpd.GeoDataFrame:
    """Read a layer: by its name, as a function chooses, or by default the first."""
    place = plain_place(path)
    if choose is not None:
        layers = {str(name): str(kind or "") for name, kind in pyogrio.list_layers(place)}
        if not layers:
            raise InputError("{}: has no layer", path)
        choose = choose(layers, path) if callable(choose) else choose
        if choose not in layers:
            known = Text("it has {}", ", ".join(layers))
            raise InputError("{}: has no layer {}", path, repr(choose), hint=known)
    table = pyogrio.read_dataframe(place, layer=choose, columns=columns)
    if not isinstance(table, gpd.GeoDataFrame):
        raise InputError("{}: has no geometry", path)
    return table


def _read_geojson(path: Path) -> gpd.GeoDataFrame:
    """Read GeoJSON; GDAL's reader would follow a coordinate system that is given as a link."""
    document = json.loads(path.read_text(encoding="utf-8-sig"))
    crs = "OGC:CRS84"
    if (stated := document.get("crs")) is not None:
        crs = stated["properties"]["name"] if stated["type"] == "name" else ""
        if not _CRS_NAME.fullmatch(crs):
            raise CrsError("{}: its coordinate system is a link, or no known name", path)
    bare = {"type": "Feature", "properties": {}, "geometry": document}
    features = document.get("features", [document if document["type"] == "Feature" else bare])
    features = [each for each in features if each["geometry"] is not None]
    shapes = shapely.from_geojson([json.dumps(each["geometry"]) for each in features])
    table = pd.DataFrame.from_records([each.get("properties") or {} for each in features])
    return gpd.GeoDataFrame(table, geometry=shapes, crs=crs)
