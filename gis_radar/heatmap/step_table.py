"""The table of steps of a heat map, and the view that shows it as a layer.

A row of the table is a tile in an interval: whole steps, no polygon, so that a day of quarter hours
takes a tenth of the room. The view of the name `occupancy_by_interval` joins the polygons of the
layer `heatmap` and the times; QGIS and GDAL open it like any other layer.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Any

import numpy as np

from gis_radar.heatmap.counting import Tally
from gis_radar.progress import Reporter
from gis_radar.steps import STEPS_PER_SECOND, step_begin

WIDE = "heatmap"
LONG = "occupancy_by_interval"
STEPS, TIMES = "steps_by_interval", "intervals"
BEGIN, END = "begin", "end"
ERROR = "coverage_se"
OCCUPANCY_COLUMNS = ("occupied", "observed")
COVERAGE_COLUMNS = ("covered", "visible", ERROR)

# Seconds and shares are computed on reading: columns with types of their own, unlike expressions of
# a view, whose types older SQLite does not know.
_SHARES = """
    "{part}_s" REAL GENERATED ALWAYS AS ("{part}" * 1.0 / {rate}) VIRTUAL,
    "{whole}_s" REAL GENERATED ALWAYS AS ("{whole}" * 1.0 / {rate}) VIRTUAL,
    "{share}" REAL GENERATED ALWAYS AS ("{part}" * 1.0 / nullif("{whole}", 0)) VIRTUAL
"""
_TIMES = f"""
CREATE TABLE "{TIMES}" (
    "interval" INTEGER PRIMARY KEY NOT NULL,
    "{BEGIN}" DATETIME NOT NULL,
    "{END}" DATETIME NOT NULL,
    "first_row" INTEGER NOT NULL,
    "last_row" INTEGER NOT NULL
)
"""
_CONTENTS = """
INSERT INTO gpkg_contents (
    table_name, data_type, identifier, description, last_change, min_x, min_y, max_x, max_y, srs_id
)
SELECT ?, ?, ?, '', last_change, min_x, min_y, max_x, max_y, CASE WHEN ? THEN srs_id END
FROM gpkg_contents WHERE table_name = ?
"""
_GEOMETRY = """
INSERT INTO gpkg_geometry_columns (table_name, column_name, geometry_type_name, srs_id, z, m)
SELECT ?, column_name, geometry_type_name, srs_id, z, m
FROM gpkg_geometry_columns WHERE table_name = ?
"""
_METADATA = """
INSERT INTO gpkg_metadata_reference (
    reference_scope, table_name, column_name, row_id_value, timestamp, md_file_id, md_parent_id
)
SELECT reference_scope, ?, column_name, row_id_value, timestamp, md_file_id, md_parent_id
FROM gpkg_metadata_reference WHERE table_name = ?
"""


def write_steps(database: sqlite3.Connection, tally: Tally, reporter: Reporter) -> None:
    """Write times, steps and the view beside the layer `heatmap` of a GeoPackage.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    tally : Tally
        What was counted.
    reporter : Reporter
        Where progress goes.
    """
    columns = [*OCCUPANCY_COLUMNS, *(() if tally.coverage is None else COVERAGE_COLUMNS)]
    database.execute(_TIMES)
    database.execute(_steps_table(columns))
    times = f'INSERT INTO "{TIMES}" VALUES (?, ?, ?, ?, ?)'  # noqa: S608 - our own names
    database.executemany(times, _times(tally))
    names = ", ".join(f'"{name}"' for name in ("fid", "interval", "tile_id", *columns))
    marks = ", ".join("?" * (3 + len(columns)))
    insert = f'INSERT INTO "{STEPS}" ({names}) VALUES ({marks})'  # noqa: S608 - our own names
    total = len(tally.timeline) * len(tally.tiles)
    for interval in range(len(tally.timeline)):
        database.executemany(insert, _rows(tally, interval))
        done = (interval + 1) * len(tally.tiles)
        reporter.progress("writing occupancy by interval", done, total)
    _add_view(database, columns)


def _steps_table(columns: list[str]) -> str:
    """Return the statement that makes the table of steps."""
    kinds = ", ".join(f'"{name}" {"REAL" if name == ERROR else "INTEGER"}' for name in columns)
    measures = [("occupied", "observed", "occupancy")]
    if ERROR in columns:
        measures.append(("covered", "visible", "coverage"))
    shares = ", ".join(
        _SHARES.format(part=part, whole=whole, share=share, rate=STEPS_PER_SECOND)
        for part, whole, share in measures
    )
    return (
        f'CREATE TABLE "{STEPS}" ("fid" INTEGER PRIMARY KEY NOT NULL, "interval" INTEGER NOT NULL, '
        f'"tile_id" INTEGER NOT NULL, {kinds}, {shares})'
    )


def _times(tally: Tally) -> Iterator[tuple[int, str, str, int, int]]:
    """Yield number, begin, end, first and last row of each interval."""
    count = len(tally.tiles)
    for number in range(len(tally.timeline)):
        steps = int(tally.timeline.begin[number]), int(tally.timeline.end[number])
        begin, end = (
            step_begin(step).isoformat(timespec="milliseconds").replace("+00:00", "Z")
            for step in steps
        )
        yield number, begin, end, number * count + 1, (number + 1) * count


def _rows(tally: Tally, interval: int) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of an interval: null where a tile was not observed, or not visible."""
    count = len(tally.tiles)
    occupied, observed = (np.zeros(count, np.int64) for _ in range(2))
    occupied[tally.seen], observed[tally.seen] = tally.steps(interval)
    columns = [_known(occupied, observed), observed.tolist()]
    if tally.coverage is not None:
        covered, visible = (np.zeros(count, np.int64) for _ in range(2))
        error = np.zeros(count)
        covered[tally.seen] = tally.coverage.covered[interval]
        visible[tally.seen] = tally.coverage.visible[interval]
        error[tally.seen] = tally.coverage.error[interval]
        columns += [_known(covered, visible), visible.tolist(), _known(error, visible)]
    first = interval * count + 1
    numbers = range(first, first + count)
    ids = tally.tiles["tile_id"].tolist()
    return zip(numbers, [interval] * count, ids, *columns, strict=True)


def _known(values: Any, whole: Any) -> list[Any]:
    """Return values as a list, None where there is no time that they are a part of."""
    found = values.astype(object)
    found[whole == 0] = None
    return list(found)


def _add_view(database: sqlite3.Connection, columns: list[str]) -> None:
    """Make the view and tell GeoPackage readers of it and of the tables."""
    geometry = database.execute(
        "SELECT column_name FROM gpkg_geometry_columns WHERE table_name = ?", (WIDE,)
    ).fetchone()[0]
    shown = ["occupied_s", "observed_s", "occupancy"]
    if ERROR in columns:
        shown += ["visible_s", "covered_s", "coverage", ERROR]
    values = ", ".join(f's."{name}" AS "{name}"' for name in shown)
    database.execute(f'CREATE UNIQUE INDEX "{WIDE}_tile_id" ON "{WIDE}" ("tile_id")')
    # CROSS JOIN keeps the order: from the times to the rows of each, which follow each other.
    database.execute(f"""
        CREATE VIEW "{LONG}" AS
        SELECT s."fid" AS "OGC_FID", h."{geometry}" AS "{geometry}", s."tile_id" AS "tile_id",
            h."lanelet_id" AS "lanelet_id", i."{BEGIN}" AS "{BEGIN}", i."{END}" AS "{END}", {values}
        FROM "{TIMES}" i
        CROSS JOIN "{STEPS}" s ON s."fid" BETWEEN i."first_row" AND i."last_row"
        CROSS JOIN "{WIDE}" h ON h."tile_id" = s."tile_id"
    """)  # noqa: S608 - our own names
    for table, kind in ((TIMES, "attributes"), (STEPS, "attributes"), (LONG, "features")):
        database.execute(_CONTENTS, (table, kind, table, kind == "features", WIDE))
    database.execute(_GEOMETRY, (LONG, WIDE))
    database.execute(_METADATA, (LONG, WIDE))


def read_times(database: sqlite3.Connection) -> list[tuple[str, str]]:
    """Return begin and end of each interval, in order."""
    query = f'SELECT "{BEGIN}", "{END}" FROM "{TIMES}" ORDER BY "interval"'  # noqa: S608
    return database.execute(query).fetchall()


def step_columns(database: sqlite3.Connection) -> list[str]:
    """Return the columns of the table of steps that hold what was counted."""
    known = {row[1] for row in database.execute(f'PRAGMA table_info("{STEPS}")')}
    return [name for name in (*OCCUPANCY_COLUMNS, *COVERAGE_COLUMNS) if name in known]
