"""The roads of a site as a layer, for PDAL and for a look in QGIS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import geopandas as gpd
import pyogrio
import shapely

from gis_radar.aerial.pipeline import COLUMN, LAYER
from gis_radar.aerial.roads import Roads

OUTSIDE = "outside"


def write_layer(roads: Roads, path: Path, *, outside: Any = None) -> None:
    """Write the layer `roads`, and `outside` with the part of them that the scans miss.

    Parameters
    ----------
    roads : Roads
        The site.
    path : Path
        The GeoPackage.
    outside : MultiPolygon, optional
        What lies outside the scans.
    """
    parts = list(shapely.get_parts(roads.area))
    layers = {LAYER: gpd.GeoDataFrame({COLUMN: [1] * len(parts)}, geometry=parts, crs=roads.crs)}
    if outside is not None:
        shapes = list(shapely.get_parts(outside))
        layers[OUTSIDE] = gpd.GeoDataFrame(
            {"area_m2": shapely.area(shapes)}, geometry=shapes, crs=roads.crs
        )
    for name, table in layers.items():
        pyogrio.write_dataframe(
            table, path, layer=name, driver="GPKG", geometry_type="Polygon",
            append=path.exists(), dataset_options={"VERSION": "1.2"},
        )  # fmt: skip
