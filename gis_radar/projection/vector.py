"""Points as vector files: GeoPackage and GeoParquet."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.crs import name_of
from gis_radar.projection.columns import GEOMETRY
from gis_radar.projection.points import Points
from gis_radar.streams import write_stream

LAYER = "hits"
VERSION = "1.2"  # the GDAL of QGIS 3.40 warns of later ones
NOT_IN_GEOPACKAGE = (pa.types.is_duration, pa.types.is_interval, pa.types.is_decimal256)


def write_geopackage(points: Points, path: Path) -> None:
    """Write the layer `hits` of a GeoPackage."""
    kept = [
        field.name
        for field in points.schema
        if not any(is_kind(field.type) for is_kind in NOT_IN_GEOPACKAGE)
    ]
    if left := [name for name in points.schema.names if name not in kept]:
        said = f"{path.name}: a GeoPackage cannot hold {', '.join(left)}: left out"
        points.reporter.log(said, "warning")
    write_stream(
        (batch.select(kept) for batch in points),
        pa.schema([points.schema.field(name) for name in kept]),
        path,
        layer=LAYER,
        driver="GPKG",
        geometry_name=GEOMETRY,
        geometry_type="Point Z",
        crs=name_of(points.pose.crs),
        dataset_options={"VERSION": VERSION},
    )


def write_geoparquet(points: Points, path: Path) -> None:
    """Write a GeoParquet file."""
    crs = points.pose.crs.to_json_dict()
    column = {"encoding": "WKB", "geometry_types": ["Point Z"], "crs": crs}
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
    schema = points.schema.with_metadata({"geo": json.dumps(geo)})
    with pq.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True) as writer:
        for batch in points:
            writer.write_batch(batch.replace_schema_metadata(schema.metadata))
