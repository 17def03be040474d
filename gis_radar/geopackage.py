"""Write layers of a GeoPackage in batches, with styles that QGIS loads by itself."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyogrio

GPKG_VERSION = "1.2"
"""The version of the GeoPackages that we write: the GDAL of QGIS 3.40 warns of later ones."""

# As QGIS itself makes it; GDAL and QGIS look for it by this name.
_TABLE = """
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
_CONTENTS = """
INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change)
VALUES ('layer_styles', 'attributes', 'layer_styles', '', strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
"""
_STYLE = """
INSERT INTO layer_styles (
    f_table_catalog, f_table_schema, f_table_name, f_geometry_column,
    styleName, styleQML, styleSLD, useAsDefault, description, owner
)
SELECT '', '', table_name, column_name, ?, ?, ?, 1, ?, ''
FROM gpkg_geometry_columns WHERE table_name = ?
"""


def add_styles(
    database: sqlite3.Connection,
    styles: Mapping[str, tuple[str, str]],
    *,
    name: str,
    about: str,
) -> None:
    """Give layers of a GeoPackage that has no styles yet their default style.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    styles : mapping
        QML and SLD (or an empty text) by layer.
    name, about : str
        Of the styles, in a few words.
    """
    database.execute(_TABLE)
    database.execute(_CONTENTS)
    for layer, (qml, sld) in styles.items():
        database.execute(_STYLE, (name, qml, sld, about, layer))


def read_styles(path: Path) -> dict[str, str]:
    """Return the default styles of a GeoPackage, QML by layer."""
    query = "SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
        return dict(database.execute(query).fetchall())


def write_stream(
    batches: Iterable[pa.RecordBatch], schema: pa.Schema, path: Path, **options: Any
) -> None:
    """Write batches as they come; what stops them is raised as it is.

    Parameters
    ----------
    batches : iterable of pyarrow.RecordBatch
        All of `schema`, the geometry as WKB.
    schema : pyarrow.Schema
        The columns.
    path : Path
        The file.
    **options
        As for :func:`pyogrio.write_arrow`.
    """
    stopped: list[BaseException] = []
    reader = pa.RecordBatchReader.from_batches(schema, _remembering(batches, stopped))
    try:
        pyogrio.write_arrow(reader, path, **options)
    except Exception:
        if not stopped:
            raise
    if stopped:
        raise stopped[0]


def _remembering(
    batches: Iterable[pa.RecordBatch], stopped: list[BaseException]
) -> Iterator[pa.RecordBatch]:
    """Pass batches on, and keep what stops them: Arrow's stream would hide a Ctrl-C."""
    try:
        yield from batches
    except (Exception, KeyboardInterrupt) as error:
        stopped.append(error)
        raise
