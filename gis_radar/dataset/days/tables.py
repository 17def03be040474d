"""Tables of a date, which follow from its hours: make, update and read them.

A file of a date holds for each hour a *key*, the digests of what its rows were made from. Rows of
hours not made again since are carried over, so that they stay when exact tables are deleted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset.files.parts import (
    HOURS_PER_DAY,
    Keys,
    TableFile,
    days_of,
    hour_text,
    part_path,
    whole_metadata,
)
from gis_radar.dataset.files.records import HourRecord, Span, read_hours
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.source import Source
from gis_radar.dataset.files.tables import DAY_TABLES

QUARTERS = 4  # of an hour
STEPS_PER_QUARTER = STEPS_PER_HOUR // QUARTERS

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

    def file(self, table: TableSchema) -> TableFile:
        """Return the file of a table."""
        path = part_path(self.folder, table, self.first_hour)
        metadata = whole_metadata(table, self.fingerprint) | {"hour": hour_text(self.first_hour)}
        return TableFile(table=table, path=path, metadata=metadata, keyed="hours")

    def is_made(self, tables: Sequence[TableSchema], keys: Keys) -> bool:
        """Return whether tables have all columns and were made from exactly these keys."""
        return all(self.file(each).is_made_of(keys) for each in tables)

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
                self.file(table).path.unlink(missing_ok=True)
            return
        if self.is_made(tables, keys):
            return
        for table, rows in zip(tables, self.rows(tables, keys, make), strict=True):
            self.file(table).write(rows, keys)

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
        known = [self.file(table).keys() for table in tables]
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
            rows = self.file(table).read(names)
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


def days_with(
    folder: Path, fingerprint: str, hours: Sequence[int]
) -> Iterator[tuple[Day, set[int]]]:
    """Yield the dates of some hours, each with its hours among them."""
    for first in days_of(hours):
        day = Day(folder=folder, fingerprint=fingerprint, first_hour=first)
        yield day, {hour for hour in hours if first <= hour <= day.last_hour}


@dataclass(frozen=True, kw_only=True, eq=False)
class DayTables:
    """Maker and reader of tables of dates that are made together.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    fingerprint : str
        Fingerprint of its tiles.
    """

    tables: ClassVar[Sequence[TableSchema]]
    folder: Path
    fingerprint: str

    @classmethod
    def of(cls, dataset: Source) -> Self:
        """Return the maker and reader of a dataset."""
        return cls(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint)

    def keys(self, day: Day, records: Mapping[int, HourRecord]) -> Keys:
        """Return the keys of hours of a date: what the rows of each follow from."""
        raise NotImplementedError

    def make(self, record: HourRecord) -> Sequence[pa.Table]:
        """Make the rows of an hour, a table for each of `tables`."""
        raise NotImplementedError

    def note(self, records: Mapping[int, HourRecord]) -> None:
        """Keep records that were read, where the rows of other hours follow from them."""

    def update(self, hour: int, known: Mapping[int, HourRecord] | None = None) -> None:
        """Bring the tables of the date of an hour up to date; the caller is its only writer.

        Rows of hours that were not made again are carried over.

        Parameters
        ----------
        hour : int
            Any hour of the date, since 1970.
        known : mapping, optional
            The records of all complete hours; by default they are read.

        Raises
        ------
        InputError
            If a part of an hour is not the one of its record.
        OutputError
            If a table cannot be written.
        """
        day = Day.of(self.folder, self.fingerprint, hour)
        records, before = day.records(known), day.first_hour - 1
        self.note(
            records if known is None or before not in known else records | {before: known[before]}
        )
        keys = self.keys(day, records)
        day.update(self.tables, keys, lambda each: self.make(records[each]))

    def read(
        self, table: TableSchema, records: Mapping[int, HourRecord], span: Span | None = None,
        columns: Sequence[str] | None = None,
    ) -> Iterator[pa.Table]:  # fmt: skip
        """Read a table day by day; rows that are missing, or older than their hour, are made now.

        Parameters
        ----------
        table : TableSchema
            One of `tables`.
        records : mapping
            Records of the complete hours, ascending.
        span : (int, int), optional
            First and last step in which intervals may begin.
        columns : sequence of str, optional
            Names of the columns; by default all.

        Yields
        ------
        pyarrow.Table
            Rows of a date in their order, with a further column `first_step`, in which the interval
            begins.
        """
        self.note(records)
        for day, hours in days_with(self.folder, self.fingerprint, list(records)):
            keys = self.keys(day, {hour: records[hour] for hour in sorted(hours)})
            rows = day.rows(
                self.tables, keys, lambda hour: self.make(records[hour]), only=table,
                columns=columns,
            )  # fmt: skip
            yield day.timed(rows[self.tables.index(table)], span, columns)


def check_days(folder: Path, fingerprint: str, hours: Iterable[int]) -> None:
    """Read the tables of the dates of some hours, where they are written, to check them.

    Raises
    ------
    InputError
        If they are damaged.
    """
    for day, _ in days_with(folder, fingerprint, list(hours)):
        for table in DAY_TABLES:
            if day.file(table).path.is_file():
                day.file(table).read()
