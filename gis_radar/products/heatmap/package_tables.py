"""Tables of counts in the GeoPackage of a heat map, and the views that show them as layers.

A row of the table of steps is a tile in an interval: whole steps, no polygon, so that a day of
quarter hours takes a tenth of the room. Stored are counts that are mostly zero, the steps in which
a tile was not observed and those in which it was observed but hidden; observed and visible steps
are computed. The view `by_interval` joins the polygons of the layer `tiles` and the times. The view
`heatmap` joins the tiles and the table of the whole time, and looks the columns of the intervals up
in the table of steps, so that each value is stored once. QGIS and GDAL open both like any other
layer.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Any

import numpy as np

from gis_radar.base import STEPS_PER_SECOND, Floats, Reporter, step_begin
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.occupancy import ERROR_UNIT, error_roots

TILES_TABLE, WIDE = "tiles", "heatmap"
WHOLE = "whole_time"
STEPS = "steps_by_interval"


# A layer has geometry, extent and metadata of the layer of tiles.
_REGISTER = """
INSERT INTO gpkg_contents (
    table_name, data_type, identifier, description, last_change, min_x, min_y, max_x, max_y, srs_id
)
SELECT ?1, ?2, ?1, '', last_change, min_x, min_y, max_x, max_y,
    CASE ?2 WHEN 'features' THEN srs_id END
FROM gpkg_contents WHERE table_name = 'tiles'
"""
_REGISTER_GEOMETRY = """
INSERT INTO gpkg_geometry_columns (table_name, column_name, geometry_type_name, srs_id, z, m)
SELECT ?, column_name, geometry_type_name, srs_id, z, m
FROM gpkg_geometry_columns WHERE table_name = 'tiles'
"""
_REGISTER_METADATA = """
INSERT INTO gpkg_metadata_reference (
    reference_scope, table_name, column_name, row_id_value, timestamp, md_file_id, md_parent_id
)
SELECT reference_scope, ?, column_name, row_id_value, timestamp, md_file_id, md_parent_id
FROM gpkg_metadata_reference WHERE table_name = 'tiles'
"""


def _register(database: sqlite3.Connection, table: str, kind: str, rows: int) -> None:
    """Register a table (`attributes`) or a view (`features`), so that readers see it.

    They would else count its rows each time that they open it.
    """
    database.execute(_REGISTER, (table, kind))
    database.execute("INSERT INTO gpkg_ogr_contents VALUES (?, ?)", (table, rows))
    if kind == "features":
        database.execute(_REGISTER_GEOMETRY, (table,))
        database.execute(_REGISTER_METADATA, (table,))


def list_tiles_last(database: sqlite3.Connection) -> None:
    """Move the layer of tiles behind all others: programs open the first one by default."""
    for catalogue in ("gpkg_contents", "gpkg_geometry_columns"):
        last = f"(SELECT max(rowid) + 1 FROM {catalogue})"  # noqa: S608 - our own names
        is_tiles = f"table_name = '{TILES_TABLE}'"
        database.execute(f"UPDATE {catalogue} SET rowid = {last} WHERE {is_tiles}")  # noqa: S608


def interval_columns(tally: Tally) -> list[str]:
    """Return the endings of the columns' names: the begins of the intervals."""
    timeline = tally.timeline
    return [_stamp(int(timeline.begin[i]), int(timeline.end[i])) for i in tally.columns]


def _stamp(begin_step: int, end_step: int) -> str:
    """Return an interval's begin in UTC, as fine as intervals of that length need."""
    begin, length_steps = step_begin(begin_step), end_step - begin_step
    name = f"{begin:%Y%m%dT%H%M}"
    if length_steps < 60 * STEPS_PER_SECOND:
        name += f"{begin:%S}"
    if length_steps < STEPS_PER_SECOND:
        name += f"{begin.microsecond // 1000:03d}"
    return name


def measure_columns(tally: Tally, interval: int | None = None) -> dict[str, Floats]:
    """Return the measures of all tiles by name, those of occupancy where vehicles are known."""
    known = tally.occupancy_shares(interval)
    return tally.shares(interval)._asdict() | ({} if known is None else known._asdict())


def write_wide(database: sqlite3.Connection, tally: Tally) -> None:
    """Write the counts beside the layer `tiles` of a GeoPackage, and the view of both.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    tally : Tally
        The counts of the heat map.
    """
    whole = measure_columns(tally)
    _write_whole(database, whole)
    own = [row[1:3] for row in database.execute(f'PRAGMA table_info("{TILES_TABLE}")')][1:]
    shown = ['t."fid" AS "OGC_FID"', *(f't."{name}" AS "{name}"' for name, _ in own)]
    shown += [f'w."{name}" AS "{name}"' for name in whole]
    shown += [
        _looked_up(tally, seconds, number, f"{prefix}_{stamp}")
        for prefix, seconds in (("hit", "hit_s"), ("occ", "occupied_s"))
        if seconds in whole
        for number, stamp in zip(tally.columns, interval_columns(tally), strict=True)
    ]
    # LEFT, so that SQLite skips a table of which no column is selected.
    joined = f'LEFT JOIN "{WHOLE}" w ON w."fid" = t."fid"'
    database.execute(
        f'CREATE VIEW "{WIDE}" AS SELECT {", ".join(shown)} FROM "{TILES_TABLE}" t {joined}'  # noqa: S608
    )
    database.execute(f'CREATE UNIQUE INDEX "{TILES_TABLE}_tile_id" ON "{TILES_TABLE}" ("tile_id")')
    _register(database, WIDE, "features", len(tally.tiles))


def _looked_up(tally: Tally, seconds: str, interval: int, name: str) -> str:
    """Return the SQL of a column of the view: seconds of each tile in an interval."""
    row = f't."fid" + {interval * len(tally.tiles)}'
    return f'(SELECT s."{seconds}" FROM "{STEPS}" s WHERE s."fid" = {row}) AS "{name}"'  # noqa: S608


def _write_whole(database: sqlite3.Connection, columns: dict[str, Floats]) -> None:
    """Write the table of the whole time, a row a tile in their order."""
    kinds = ", ".join(f'"{name}" REAL' for name in columns)
    database.execute(f'CREATE TABLE "{WHOLE}" ("fid" INTEGER PRIMARY KEY NOT NULL, {kinds})')
    lists = [
        [None if np.isnan(value) else value for value in column.tolist()]
        for column in columns.values()
    ]
    marks = ", ".join("?" * (1 + len(lists)))
    rows = zip(range(1, 1 + len(lists[0])), *lists, strict=True)
    database.executemany(f'INSERT INTO "{WHOLE}" VALUES ({marks})', rows)  # noqa: S608 - our own


LONG = "by_interval"
_TIMES_TABLE = "intervals"
BEGIN, END = "begin", "end"
ERROR = "occupancy_se"
ROOT = "occupancy_se_root"  # root of the standard error as a whole number of 2 bytes, not 8
_UNOBSERVED, _HIDDEN = "unobserved", "hidden"
_HIT_COLUMNS = ("hit", "observed")
_OCCUPANCY_COLUMNS = ("occupied", "visible", ERROR)
_STORED = {"observed": _UNOBSERVED, "visible": _HIDDEN, ERROR: ROOT}  # in place of what is computed

# Seconds and shares are computed on reading: columns with types of their own, unlike expressions of
# a view, whose types older SQLite does not know.
_SHARES = """
    "{part}_s" REAL GENERATED ALWAYS AS ("{part}" * 1.0 / {rate}) VIRTUAL,
    "{whole}_s" REAL GENERATED ALWAYS AS ("{whole}" * 1.0 / {rate}) VIRTUAL,
    "{share}" REAL GENERATED ALWAYS AS ("{part}" * 1.0 / nullif("{whole}", 0)) VIRTUAL
"""
_TIMES = f"""
CREATE TABLE "{_TIMES_TABLE}" (
    "interval" INTEGER PRIMARY KEY NOT NULL,
    "{BEGIN}" DATETIME NOT NULL,
    "{END}" DATETIME NOT NULL,
    "first_row" INTEGER NOT NULL,
    "last_row" INTEGER NOT NULL
)
"""


def write_steps(database: sqlite3.Connection, tally: Tally, reporter: Reporter) -> None:
    """Write times, steps and the view beside the layer `tiles` of a GeoPackage.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    tally : Tally
        The counts of the heat map.
    reporter : Reporter
        Receives progress.
    """
    columns = [*_HIT_COLUMNS, *(() if tally.occupancy is None else _OCCUPANCY_COLUMNS)]
    database.execute(_TIMES)
    database.execute(_steps_table(columns, tally))
    times = f'INSERT INTO "{_TIMES_TABLE}" VALUES (?, ?, ?, ?, ?)'  # noqa: S608 - our own names
    database.executemany(times, interval_times(tally))
    stored = ["fid", *(("tile_id",) if not _counts_up(tally.tiles["tile_id"]) else ())]
    stored += [_STORED.get(name, name) for name in columns]
    names = ", ".join(f'"{name}"' for name in stored)
    marks = ", ".join("?" * len(stored))
    insert = f'INSERT INTO "{STEPS}" ({names}) VALUES ({marks})'  # noqa: S608 - our own names
    total = len(tally.timeline) * len(tally.tiles)
    for interval in range(len(tally.timeline)):
        database.executemany(insert, _rows(tally, interval))
        done = (interval + 1) * len(tally.tiles)
        reporter.progress("writing measures by interval", done, total)
    _add_view(database, tally, columns)


def _counts_up(tile_ids: Any) -> bool:
    """Return whether tile ids count up from 0 without gaps, so that rows give the tile."""
    return bool(np.array_equal(tile_ids, np.arange(len(tile_ids))))


def _steps_table(columns: list[str], tally: Tally) -> str:
    """Return the SQL statement that makes the table of steps, with its computed columns."""
    tile_ids = tally.tiles["tile_id"]
    count, computed = len(tile_ids), "INTEGER NOT NULL GENERATED ALWAYS AS"
    interval = f'{computed} (("fid" - 1) / {count}) VIRTUAL'
    tile = (
        f'{computed} (("fid" - 1) % {count}) VIRTUAL'
        if _counts_up(tile_ids)
        else "INTEGER NOT NULL"
    )
    formulas = {
        "observed": f'INTEGER GENERATED ALWAYS AS (ifnull({_longest(tally)} - "{_UNOBSERVED}", 0))',
        "visible": f'INTEGER GENERATED ALWAYS AS (ifnull("observed" - "{_HIDDEN}", 0))',
        ERROR: f'REAL GENERATED ALWAYS AS ("{ROOT}" * "{ROOT}" * {ERROR_UNIT!r})',
    }
    kinds = ", ".join(
        f'"{_STORED[name]}" INTEGER, "{name}" {formulas[name]} VIRTUAL'
        if name in formulas
        else f'"{name}" INTEGER'
        for name in columns
    )
    measures = [("hit", "observed", "hit_share")]
    if ERROR in columns:
        measures.append(("occupied", "visible", "occupancy"))
    shares = ", ".join(
        _SHARES.format(part=part, whole=whole, share=share, rate=STEPS_PER_SECOND)
        for part, whole, share in measures
    )
    return (
        f'CREATE TABLE "{STEPS}" ("fid" INTEGER PRIMARY KEY NOT NULL, "interval" {interval}, '
        f'"tile_id" {tile}, {kinds}, {shares})'
    )


def _longest(tally: Tally) -> int:
    """Return the number of steps of the longest interval."""
    return int((tally.timeline.end - tally.timeline.begin).max())


def interval_times(tally: Tally) -> Iterator[tuple[int, str, str, int, int]]:
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
    hit, observed = (np.zeros(count, np.int64) for _ in range(2))
    hit[tally.seen], observed[tally.seen] = tally.steps(interval)
    columns = [_known(hit, observed), _known(_longest(tally) - observed, observed)]
    if tally.occupancy is not None:
        occupied, visible = (np.zeros(count, np.int64) for _ in range(2))
        error = np.zeros(count)
        occupied[tally.seen] = tally.occupancy.occupied[interval]
        visible[tally.seen] = tally.occupancy.visible[interval]
        error[tally.seen] = tally.occupancy.error[interval]
        roots = error_roots(np.nan_to_num(error))
        columns += [_known(values, visible) for values in (occupied, observed - visible, roots)]
    first = interval * count + 1
    numbers = range(first, first + count)
    if _counts_up(tally.tiles["tile_id"]):
        return zip(numbers, *columns, strict=True)
    return zip(numbers, tally.tiles["tile_id"].tolist(), *columns, strict=True)


def _known(values: Any, whole: Any) -> list[Any]:
    """Return values as a list, None where the whole is 0."""
    found = values.astype(object)
    found[whole == 0] = None
    return list(found)


def _add_view(database: sqlite3.Connection, tally: Tally, columns: list[str]) -> None:
    """Make the view, and register it and the tables for readers of the GeoPackage."""
    geometry = database.execute(
        "SELECT column_name FROM gpkg_geometry_columns WHERE table_name = ?", (TILES_TABLE,)
    ).fetchone()[0]
    shown = ["hit_s", "observed_s", "hit_share"]
    if ERROR in columns:
        shown += ["visible_s", "occupied_s", "occupancy", ERROR]
    values = ", ".join(f's."{name}" AS "{name}"' for name in shown)
    # CROSS JOIN keeps the order: from the times to the rows of each, which follow each other.
    database.execute(f"""
        CREATE VIEW "{LONG}" AS
        SELECT s."fid" AS "OGC_FID", t."{geometry}" AS "{geometry}", s."tile_id" AS "tile_id",
            t."lanelet_id" AS "lanelet_id", i."{BEGIN}" AS "{BEGIN}", i."{END}" AS "{END}", {values}
        FROM "{_TIMES_TABLE}" i
        CROSS JOIN "{STEPS}" s ON s."fid" BETWEEN i."first_row" AND i."last_row"
        CROSS JOIN "{TILES_TABLE}" t ON t."tile_id" = s."tile_id"
    """)  # noqa: S608 - our own names
    every, times = len(tally.timeline) * len(tally.tiles), len(tally.timeline)
    _register(database, LONG, "features", every)
    _register(database, _TIMES_TABLE, "attributes", times)
    _register(database, STEPS, "attributes", every)


def read_times(database: sqlite3.Connection) -> list[tuple[str, str]]:
    """Return begin and end of each interval, in order."""
    query = f'SELECT "{BEGIN}", "{END}" FROM "{_TIMES_TABLE}" ORDER BY "interval"'  # noqa: S608
    return database.execute(query).fetchall()


def step_columns(database: sqlite3.Connection) -> list[str]:
    """Return the columns of the table of steps that hold counts."""
    known = {row[1] for row in database.execute(f'PRAGMA table_xinfo("{STEPS}")')}
    return [name for name in (*_HIT_COLUMNS, *_OCCUPANCY_COLUMNS) if name in known]
