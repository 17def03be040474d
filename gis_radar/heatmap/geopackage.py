"""A heat map as GeoPackage: both layers, with styles that QGIS loads by itself."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pyarrow as pa
import pyogrio

from gis_radar.heatmap import style
from gis_radar.heatmap.layers import BEGIN, END, LONG, LONG_SCHEMA, WIDE, long_batches, wide_layer
from gis_radar.heatmap.tally import DEFINITIONS, Tally
from gis_radar.progress import Reporter
from gis_radar.streams import write_stream

VERSION = "1.2"  # the GDAL of QGIS 3.40 warns of later ones


def write_geopackage(tally: Tally, path: Path, reporter: Reporter) -> None:
    """Write both layers, their styles, and an index on the times.

    Parameters
    ----------
    tally : Tally
        What to write.
    path : Path
        A file that does not exist yet.
    reporter : Reporter
        Where progress goes; the long layer is streamed in batches.
    """
    metadata = {"fingerprint": tally.fingerprint, "definitions": json.dumps(DEFINITIONS)}
    pyogrio.write_dataframe(
        wide_layer(tally), path, layer=WIDE, driver="GPKG", use_arrow=True,
        geometry_type="Polygon", layer_metadata=metadata, VERSION=VERSION,
    )  # fmt: skip
    _write_long(tally, path, metadata, reporter)
    with closing(sqlite3.connect(path)) as database, database:
        for field in (BEGIN, END):
            database.execute(f'CREATE INDEX "{LONG}_{field}" ON "{LONG}" ("{field}")')
        _add_styles(database)


def _write_long(tally: Tally, path: Path, metadata: dict[str, str], reporter: Reporter) -> None:
    write_stream(
        _reported(tally, reporter), LONG_SCHEMA, path,
        layer=LONG, driver="GPKG", crs=tally.crs.to_wkt(),
        geometry_name="geometry", geometry_type="Polygon", layer_metadata=metadata,
    )  # fmt: skip


def _reported(tally: Tally, reporter: Reporter) -> Iterator[pa.RecordBatch]:
    done, total = 0, len(tally.timeline) * len(tally.tiles)
    for batch in long_batches(tally):
        yield batch
        done += len(batch)
        reporter.progress("writing occupancy by interval", done, total)


# As QGIS itself makes it; GDAL and QGIS look for it by this name.
_STYLES_TABLE = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    f_table_catalog TEXT(256),
    f_table_schema TEXT(256),
    f_table_name TEXT(256),
    f_geometry_column TEXT(256),
    styleName TEXT(30),
    styleQML TEXT,
    styleSLD TEXT,
    useAsDefault BOOLEAN,
    description TEXT,
    owner TEXT(30),
    ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
)
"""
_STYLES_CONTENTS = """
INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change)
VALUES ('layer_styles', 'attributes', 'layer_styles', '', strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
"""
_STYLE = """
INSERT INTO layer_styles (
    f_table_catalog, f_table_schema, f_table_name, f_geometry_column,
    styleName, styleQML, styleSLD, useAsDefault, description, owner
)
SELECT '', '', table_name, column_name, 'occupancy', ?, ?, 1, ?, ''
FROM gpkg_geometry_columns WHERE table_name = ?
"""


def _add_styles(database: sqlite3.Connection) -> None:
    database.execute(_STYLES_TABLE)
    database.execute(_STYLES_CONTENTS)
    about = "fixed classes of occupancy, so that maps compare"
    for layer, qml in (
        (WIDE, style.vector_qml()),
        (LONG, style.vector_qml(begin=BEGIN, end=END)),
    ):
        database.execute(_STYLE, (qml, style.sld(layer), about, layer))
