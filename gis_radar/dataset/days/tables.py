"""Tables of a date, which follow from its hours: make, update and read them.

A file of a date holds for each hour a *key*, the digests of what its rows were made from. Rows of
hours not made again since are carried over, so that they stay when exact tables are deleted.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from gis_radar.base import STEPS_PER_HOUR, InputError
from gis_radar.dataset.files.parts import (
    HOURS_PER_DAY,
    days_of,
    hour_text,
    opened_part,
    part_path,
    rename_whole,
    unfinished,
    whole_metadata,
    write_part,
)
from gis_radar.dataset.files.reading import Span
from gis_radar.dataset.files.records import HourRecord, read_hours
from gis_radar.dataset.files.schema import TableSchema

QUARTERS = 4  # of an hour
STEPS_PER_QUARTER = STEPS_PER_HOUR // QUARTERS
_HOURS = "hours"  # entry of the metadata with the key of each hour

Keys: TypeAlias = Mapping[int, list[str | int]]
"""What each hour, since 1970, is now."""
Maker: TypeAlias = Callable[[int], Sequence[pa.Table]]
"""Makes the rows of an hour, a table for each."""


@dataclass(frozen=True, kw_only=True)
class Day:
    """A date of a dataset.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    fingerprint : str
        Fingerprint of its tiles.
    first_hour : int
        First hour of the date, since 1970.
    """

    folder: Path
    fingerprint: str
    first_hour: int

    @classmethod
    def of(cls, folder: Path, fingerprint: str, hour: int) -> Self:
        """Return the date of an hour."""
        return cls(folder=folder, fingerprint=fingerprint, first_hour=days_of([hour])[0])

    @property
    def last_hour(self) -> int:
        """Last hour of the date, since 1970."""
        return self.first_hour + HOURS_PER_DAY - 1

    def records(self, known: Mapping[int, HourRecord] | None = None) -> dict[int, HourRecord]:
        """Return the records of its complete hours, from `known` or else read."""
        if known is None:
            return read_hours(self.folder, self.first_hour, self.last_hour)
        hours = range(self.first_hour, self.last_hour + 1)
        return {hour: known[hour] for hour in hours if hour in known}

    def path(self, table: TableSchema) -> Path:
        """Return the path of a table."""
        return part_path(self.folder, table, self.first_hour)

    def opened(self, table: TableSchema) -> AbstractContextManager[pq.ParquetFile]:
        """Open a table, and check it.

        Raises
        ------
        InputError
            If it is missing or damaged.
        """
        return opened_part(table, self.path(table), self._metadata(table))

    def made(self, table: TableSchema) -> Keys:
        """Read the keys of the hours from which a table was made; none if it is damaged."""
        with suppress(InputError, ValueError, KeyError), self.opened(table) as file:
            return _keys_in(file)
        return {}

    def is_made(self, tables: Sequence[TableSchema], keys: Keys) -> bool:
        """Return whether tables have all columns and were made from exactly these keys."""
        return all(self._is_made(table, keys) for table in tables)

    def _is_made(self, table: TableSchema, keys: Keys) -> bool:
        with suppress(InputError, ValueError, KeyError), self.opened(table) as file:
            has_all = {*table.names} <= {*file.schema_arrow.names}
            return has_all and _keys_in(file) == keys
        return False

    def update(self, tables: Sequence[TableSchema], keys: Keys, make: Maker) -> None:
        """Bring tables up to date; the caller is the only writer of the date.

        Parameters
        ----------
        tables : sequence of TableSchema
            Tables whose rows are made together.
        keys : mapping
            Keys of all hours of the date; without any, the tables are removed.
        make : callable
            Makes the rows of an hour for each of the tables.
        """
        if not keys:
            for table in tables:
                self.path(table).unlink(missing_ok=True)
            return
        if self.is_made(tables, keys):
            return
        for table, rows in zip(tables, self.rows(tables, keys, make), strict=True):
            stated = {_HOURS: json.dumps({hour: keys[hour] for hour in sorted(keys)})}
            write_part(table, self.path(table), rows, self._metadata(table) | stated)
            rename_whole(unfinished(self.path(table)), self.path(table))

    def rows(
        self, tables: Sequence[TableSchema], keys: Keys, make: Maker, *,
        only: TableSchema | None = None, columns: Sequence[str] | None = None,
    ) -> list[pa.Table]:  # fmt: skip
        """Return the rows of hours, as written if they are up to date, else made now.

        Parameters
        ----------
        tables, keys, make
            As for :meth:`update`.
        only : TableSchema, optional
            The one of the tables to read; the others come without rows.
        columns : sequence of str, optional
            Its columns; by default all.
        """
        known = [self.made(table) for table in tables]
        kept = {hour for hour, key in keys.items() if all(of.get(hour) == key for of in known)}
        made = [make(hour) for hour in sorted(keys.keys() - kept)]
        return [
            self._joined(table, kept, len(known[k]), [each[k] for each in made], columns)
            if only in (None, table)
            else table.empty()
            for k, table in enumerate(tables)
        ]

    def _joined(
        self, table: TableSchema, kept: set[int], written: int, made: list[pa.Table],
        columns: Sequence[str] | None,
    ) -> pa.Table:  # fmt: skip
        """Join the rows of hours that are kept with those that were made."""
        needed = {*(columns or table.names), *table.order}
        names = [name for name in table.names if name in needed]
        parts = [each.select(names) for each in (table.empty(), *made)]
        if kept:
            with self.opened(table) as file:
                rows = file.read(columns=names)
            if len(kept) == written and not made:
                return pa.concat_tables([*parts, rows], promote_options="default")
            hours = pa.array(sorted(each - self.first_hour for each in kept), pa.int32())
            hour = pc.divide(rows["interval"], pa.scalar(QUARTERS, pa.int32()))
            parts.append(rows.filter(pc.is_in(hour, hours)))
        whole = pa.concat_tables(parts, promote_options="default")  # newer columns are null
        return whole.sort_by([(name, "ascending") for name in table.order])

    def timed(self, rows: pa.Table, span: Span | None, columns: Sequence[str] | None) -> pa.Table:
        """Add a column `first_step` to rows, the step in which their interval begins.

        Parameters
        ----------
        rows : pyarrow.Table
            Rows with a column `interval`.
        span : (int, int), optional
            First and last step in which the intervals begin.
        columns : sequence of str, optional
            Names of the columns; by default all.
        """
        first = rows["interval"].to_numpy().astype(np.int64) * STEPS_PER_QUARTER
        begin = pa.array(first + self.first_hour * STEPS_PER_HOUR)
        rows = rows.append_column("first_step", begin)
        if span is not None:
            inside = pc.and_(pc.greater_equal(begin, span[0]), pc.less_equal(begin, span[1]))
            rows = rows.filter(inside)
        return rows.select(list(columns)) if columns is not None else rows

    def _metadata(self, table: TableSchema) -> dict[str, str]:
        return whole_metadata(table, self.fingerprint) | {"hour": hour_text(self.first_hour)}


def _keys_in(file: pq.ParquetFile) -> Keys:
    known = json.loads(file.metadata.metadata[_HOURS.encode()])
    return {int(hour): key for hour, key in known.items()}


def days_with(
    folder: Path, fingerprint: str, hours: Sequence[int]
) -> Iterator[tuple[Day, set[int]]]:
    """Yield the dates of some hours, each with its hours among them."""
    for first in days_of(hours):
        day = Day(folder=folder, fingerprint=fingerprint, first_hour=first)
        yield day, {hour for hour in hours if first <= hour <= day.last_hour}
