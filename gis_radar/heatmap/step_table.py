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

from gis_radar.arrays import Integers
from gis_radar.heatmap.counting import Tally
from gis_radar.heatmap.covering import ERROR_UNIT
from gis_radar.progress import Reporter
from gis_radar.steps import STEPS_PER_SECOND, step_begin

WIDE = "heatmap"
LONG = "occupancy_by_interval"
STEPS, TIMES = "steps_by_interval", "intervals"
BEGIN, END = "begin", "end"
ERROR = "coverage_se"
PPM = "coverage_se_ppm"  # a whole number takes 3 bytes, a real one 8
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
    database.execute(_steps_table(columns, tally.tiles["tile_id"].to_numpy(np.int64)))
    times = f'INSERT INTO "{TIMES}" VALUES (?, ?, ?, ?, ?)'  # noqa: S608 - our own names
    database.executemany(times, _times(tally))
    stored = ["fid", *(("tile_id",) if not _counts_up(tally.tiles["tile_id"]) else ())]
    stored += [PPM if name == ERROR else name for name in columns]
    names = ", ".join(f'"{name}"' for name in stored)
    marks = ", ".join("?" * len(stored))
    insert = f'INSERT INTO "{STEPS}" ({names}) VALUES ({marks})'  # noqa: S608 - our own names
    total = len(tally.timeline) * len(tally.tiles)
    for interval in range(len(tally.timeline)):
        database.executemany(insert, _rows(tally, interval))
        done = (interval + 1) * len(tally.tiles)
        reporter.progress("writing occupancy by interval", done, total)
    _add_view(database, columns)


def _counts_up(tile_ids: Any) -> bool:
    """Tell whether tiles are numbered from 0 without a gap, so that the row gives the tile."""
    return bool(np.array_equal(tile_ids, np.arange(len(tile_ids))))


def _steps_table(columns: list[str], tile_ids: Integers) -> str:
    """Return the statement that makes the table of steps: what follows from the row is computed."""
    count, computed = len(tile_ids), "INTEGER NOT NULL GENERATED ALWAYS AS"
    interval = f'{computed} (("fid" - 1) / {count}) VIRTUAL'
    tile = (
        f'{computed} (("fid" - 1) % {count}) VIRTUAL'
        if _counts_up(tile_ids)
        else "INTEGER NOT NULL"
    )
    error = f'"{PPM}" INTEGER, "{ERROR}" REAL GENERATED ALWAYS AS ("{PPM}" * {ERROR_UNIT}) VIRTUAL'
    kinds = ", ".join(error if name == ERROR else f'"{name}" INTEGER' for name in columns)
    measures = [("occupied", "observed", "occupancy")]
    if ERROR in columns:
        measures.append(("covered", "visible", "coverage"))
    shares = ", ".join(
        _SHARES.format(part=part, whole=whole, share=share, rate=STEPS_PER_SECOND)
        for part, whole, share in measures
    )
    return (
        f'CREATE TABLE "{STEPS}" ("fid" INTEGER PRIMARY KEY NOT NULL, "interval" {interval}, '
        f'"tile_id" {tile}, {kinds}, {shares})'
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
        parts = np.rint(np.nan_to_num(error) / ERROR_UNIT).astype(np.int64)
        columns += [_known(covered, visible), visible.tolist(), _known(parts, visible)]
    first = interval * count + 1
    numbers = range(first, first + count)
    if _counts_up(tally.tiles["tile_id"]):
        return zip(numbers, *columns, strict=True)
    return zip(numbers, tally.tiles["tile_id"].tolist(), *columns, strict=True)


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
    known = {row[1] for row in database.execute(f'PRAGMA table_xinfo("{STEPS}")')}
    return [name for name in (*OCCUPANCY_COLUMNS, *COVERAGE_COLUMNS) if name in known]
