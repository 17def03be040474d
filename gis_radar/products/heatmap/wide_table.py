"""The layer `heatmap` of the GeoPackage: a view of tiles, the whole time, and each interval.

The intervals' columns look their values up in the table of steps, which are stored once; QGIS and
GDAL open the view like any other layer.
"""

from __future__ import annotations

import sqlite3

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import STEPS_PER_SECOND, step_begin
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.registering import register_table

TILES, WIDE = "tiles", "heatmap"
WHOLE = "whole_time"
STEPS = "steps_by_interval"


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


def whole_columns(tally: Tally) -> dict[str, NDArray[np.float64]]:
    """Return the columns of the whole time, those of occupancy where vehicles are known."""
    known = tally.occupancy_shares()
    return tally.shares()._asdict() | ({} if known is None else known._asdict())


def write_wide(database: sqlite3.Connection, tally: Tally) -> None:
    """Write the counts beside the layer `tiles` of a GeoPackage, and the view of both.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    tally : Tally
        The counts of the heat map.
    """
    whole = whole_columns(tally)
    _write_whole(database, whole)
    own = [row[1:3] for row in database.execute(f'PRAGMA table_info("{TILES}")')][1:]
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
        f'CREATE VIEW "{WIDE}" AS SELECT {", ".join(shown)} FROM "{TILES}" t {joined}'  # noqa: S608
    )
    database.execute(f'CREATE UNIQUE INDEX "{TILES}_tile_id" ON "{TILES}" ("tile_id")')
    register_table(database, WIDE, "features", like=TILES, rows=len(tally.tiles))


def _looked_up(tally: Tally, seconds: str, interval: int, name: str) -> str:
    """Return the SQL of a column of the view: seconds of each tile in an interval."""
    row = f't."fid" + {interval * len(tally.tiles)}'
    return f'(SELECT s."{seconds}" FROM "{STEPS}" s WHERE s."fid" = {row}) AS "{name}"'  # noqa: S608


def _write_whole(database: sqlite3.Connection, columns: dict[str, NDArray[np.float64]]) -> None:
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
