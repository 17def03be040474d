"""The layer `heatmap` of the GeoPackage: a view of tiles, the whole time, and steps an interval.

A second takes eight bytes as a number of 50 ms steps takes two. So the tables hold steps, and the
view has the seconds; QGIS and GDAL open it like any other layer.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gis_radar.heatmap.counting import Tally
from gis_radar.heatmap.registering import register_table
from gis_radar.steps import STEPS_PER_SECOND, step_begin

TILES, WIDE = "tiles", "heatmap"
WHOLE = "whole_time"
CHUNK_TILES = 4096  # 500 intervals of them take 16 MB


class _Kind(NamedTuple):
    """What is counted by interval: the prefix of its columns, and the table that holds it."""

    prefix: str
    table: str


_OCCUPIED, _COVERED = _Kind("occ", "occupied_steps"), _Kind("cov", "covered_steps")


def interval_columns(tally: Tally) -> list[str]:
    """Return the begins of the intervals that become columns, as the columns' names end."""
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
    """Return the columns of the whole time, those of coverage where vehicles are known."""
    known = tally.coverage_shares()
    return tally.shares()._asdict() | ({} if known is None else known._asdict())


def write_wide(database: sqlite3.Connection, tally: Tally) -> None:
    """Write what was counted beside the layer `tiles` of a GeoPackage, and the view of both.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    tally : Tally
        What was counted.
    """
    stamps = interval_columns(tally)
    kinds = [_OCCUPIED, *(() if tally.coverage is None else (_COVERED,))] if stamps else []
    whole = whole_columns(tally)
    _write_whole(database, whole)
    for kind in kinds:
        _write_kind(database, tally, kind, stamps)
    own = [row[1:3] for row in database.execute(f'PRAGMA table_info("{TILES}")')][1:]
    shown = ['t."fid" AS "OGC_FID"', *(f't."{name}" AS "{name}"' for name, _ in own)]
    shown += [f'w."{name}" AS "{name}"' for name in whole]
    shown += [f'{k.prefix}."{name}" AS "{name}"' for k in kinds for name in _names(k, stamps)]
    joined = [(WHOLE, "w"), *((kind.table, kind.prefix) for kind in kinds)]
    # LEFT: SQLite does not look at tables of which no column is asked for.
    joins = " ".join(f'LEFT JOIN "{table}" {a} ON {a}."fid" = t."fid"' for table, a in joined)
    database.execute(
        f'CREATE VIEW "{WIDE}" AS SELECT {", ".join(shown)} FROM "{TILES}" t {joins}'  # noqa: S608
    )
    database.execute(f'CREATE UNIQUE INDEX "{TILES}_tile_id" ON "{TILES}" ("tile_id")')
    register_table(database, WIDE, "features", like=TILES, rows=len(tally.tiles))


def _names(kind: _Kind, stamps: list[str]) -> list[str]:
    return [f"{kind.prefix}_{stamp}" for stamp in stamps]


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


def _write_kind(database: sqlite3.Connection, tally: Tally, kind: _Kind, stamps: list[str]) -> None:
    """Write a row a tile with the steps of each interval, from which SQLite computes seconds."""
    columns = ", ".join(
        f'"{stamp}" INTEGER, "{name}" REAL GENERATED ALWAYS AS '
        f'("{stamp}" * 1.0 / {STEPS_PER_SECOND}) VIRTUAL'
        for stamp, name in zip(stamps, _names(kind, stamps), strict=True)
    )
    database.execute(f'CREATE TABLE "{kind.table}" ("fid" INTEGER PRIMARY KEY NOT NULL, {columns})')
    listed = ", ".join(f'"{name}"' for name in ("fid", *stamps))
    marks = ", ".join("?" * (1 + len(stamps)))
    insert = f'INSERT INTO "{kind.table}" ({listed}) VALUES ({marks})'  # noqa: S608 - our own names
    database.executemany(insert, _steps_by_tile(tally, kind))


def _steps_by_tile(tally: Tally, kind: _Kind) -> Iterator[list[Any]]:
    """Yield a row a tile: its number from 1, and the steps of each interval, null where unknown."""
    columns = slice(tally.columns.start, tally.columns.stop)
    for begin in range(0, len(tally.tiles), CHUNK_TILES):
        end = min(begin + CHUNK_TILES, len(tally.tiles))
        low, high = np.searchsorted(tally.seen, [begin, end])
        if kind is _OCCUPIED:
            counted = tally.occupied[columns, low:high]
            known = tally.observed[columns][:, tally.group[low:high]] > 0
        else:
            assert tally.coverage is not None  # noqa: S101 - for mypy: asked for above
            counted = tally.coverage.covered[columns, low:high]
            known = tally.coverage.visible[columns, low:high] > 0
        found = np.full((end - begin, len(counted)), None, object)
        steps = counted.astype(object)
        steps[~known] = None
        found[tally.seen[low:high] - begin] = steps.T
        for number, row in enumerate(found.tolist(), start=begin + 1):
            yield [number, *row]
