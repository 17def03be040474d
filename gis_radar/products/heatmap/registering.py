"""Register tables and views made by SQL in a GeoPackage, so that its readers see them."""

from __future__ import annotations

import sqlite3

_REGISTER = """
INSERT INTO gpkg_contents (
    table_name, data_type, identifier, description, last_change, min_x, min_y, max_x, max_y, srs_id
)
SELECT :table, :kind, :table, '', last_change, min_x, min_y, max_x, max_y,
    CASE WHEN :kind = 'features' THEN srs_id END
FROM gpkg_contents WHERE table_name = :like
"""
_REGISTER_GEOMETRY = """
INSERT INTO gpkg_geometry_columns (table_name, column_name, geometry_type_name, srs_id, z, m)
SELECT :table, column_name, geometry_type_name, srs_id, z, m
FROM gpkg_geometry_columns WHERE table_name = :like
"""
_REGISTER_METADATA = """
INSERT INTO gpkg_metadata_reference (
    reference_scope, table_name, column_name, row_id_value, timestamp, md_file_id, md_parent_id
)
SELECT reference_scope, :table, column_name, row_id_value, timestamp, md_file_id, md_parent_id
FROM gpkg_metadata_reference WHERE table_name = :like
"""


def register_table(
    database: sqlite3.Connection, table: str, kind: str, *, like: str, rows: int
) -> None:
    """Register a table or view made by SQL, so that readers of the GeoPackage see it.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    table : str
        Name of the table or view.
    kind : str
        `features`, with geometry, extent and metadata of `like`, or `attributes`.
    like : str
        A layer of the same extent.
    rows : int
        Number of rows, which QGIS would else count each time that it opens a view.
    """
    names = {"table": table, "kind": kind, "like": like, "rows": rows}
    database.execute(_REGISTER, names)
    database.execute("INSERT INTO gpkg_ogr_contents VALUES (:table, :rows)", names)
    if kind == "features":
        database.execute(_REGISTER_GEOMETRY, names)
        database.execute(_REGISTER_METADATA, names)


def list_last(database: sqlite3.Connection, layer: str) -> None:
    """Move a layer behind all others: programs open the first one by default."""
    for catalogue in ("gpkg_contents", "gpkg_geometry_columns"):
        last = f"(SELECT max(rowid) + 1 FROM {catalogue})"  # noqa: S608 - our own names
        database.execute(f"UPDATE {catalogue} SET rowid = {last} WHERE table_name = ?", (layer,))  # noqa: S608
