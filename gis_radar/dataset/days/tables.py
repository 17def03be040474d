"""Tables of a date, which follow from its hours: make, update and read them.

A file of a date holds for each hour a *key*, the digests of what its rows were made from. Rows of
hours not made again since are carried over, so that they stay when exact tables are deleted. A date
is named by its first hour since 1970.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset.files.parts import (
    HOURS_PER_DAY,
    Keys,
    TableFile,
    common_metadata,
    days_of,
    hour_text,
    part_path,
)
from gis_radar.dataset.files.records import HourRecord, Span, read_hours
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.source import DatasetFiles

QUARTERS = 4  # of an hour
STEPS_PER_QUARTER = STEPS_PER_HOUR // QUARTERS


def records_of(day: int, records: Mapping[int, HourRecord]) -> dict[int, HourRecord]:
    """Return the records of the hours of a date, ascending."""
    return {hour: records[hour] for hour in range(day, day + HOURS_PER_DAY) if hour in records}


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
    def of(cls, dataset: DatasetFiles) -> Self:
        """Return the maker and reader of a dataset."""
        return cls(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint)

    def keys(self, day: int, records: Mapping[int, HourRecord]) -> Keys:
        """Return the keys of hours of a date: what the rows of each follow from."""
        raise NotImplementedError

    def make(self, record: HourRecord) -> Sequence[pa.Table]:
        """Make the rows of an hour, a table for each of `tables`."""
        raise NotImplementedError

    def remember(self, records: Mapping[int, HourRecord]) -> None:
        """Keep records that were read, if rows follow from more than their own hour."""

    def file(self, table: TableSchema, day: int) -> TableFile:
        """Return the file of a table of a date."""
        path = part_path(self.folder, table, day)
        metadata = common_metadata(table, self.fingerprint) | {"hour": hour_text(day)}
        return TableFile(table=table, path=path, metadata=metadata, keyed="hours")

    def update(self, hour: int, all_records: Mapping[int, HourRecord] | None = None) -> None:
        """Bring the tables of the date of an hour up to date; the caller is its only writer.

        Rows of hours that were not made again are carried over.

        Parameters
        ----------
        hour : int
            Any hour of the date, since 1970.
        all_records : mapping, optional
            The records of all complete hours; by default they are read.

        Raises
        ------
        InputError
            If a part of an hour is not the one of its record.
        OutputError
            If a table cannot be written.
        """
        (day,) = days_of([hour])
        if all_records is None:
            all_records = read_hours(self.folder, day - 1, day + HOURS_PER_DAY - 1)
        records = records_of(day, all_records)
        self.remember(
            records
            | {before: all_records[before] for before in (day - 1,) if before in all_records}
        )
        keys = self.keys(day, records)
        files = [self.file(table, day) for table in self.tables]
        if not keys:
            for file in files:
                file.path.unlink(missing_ok=True)
        elif not all(file.is_made_of(keys) for file in files):
            for file, rows in zip(files, self._rows(day, keys, records, self.tables), strict=True):
                file.write(rows, keys)

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
        self.remember(records)
        for day in days_of(records):
            of_day = records_of(day, records)
            (rows,) = self._rows(day, self.keys(day, of_day), of_day, (table,), columns)
            first = rows["interval"].to_numpy().astype(np.int64) * STEPS_PER_QUARTER
            begin = pa.array(first + day * STEPS_PER_HOUR)
            rows = rows.append_column("first_step", begin)
            if span is not None:
                inside = pc.and_(pc.greater_equal(begin, span[0]), pc.less_equal(begin, span[1]))
                rows = rows.filter(inside)
            yield rows if columns is None else rows.select(list(columns))

    def check(self, hours: Iterable[int]) -> None:
        """Read the tables of the dates of some hours, where they are written, to check them.

        Raises
        ------
        InputError
            If they are damaged.
        """
        for day in days_of(hours):
            for file in (self.file(table, day) for table in self.tables):
                if file.path.is_file():
                    file.read()

    def _rows(
        self, day: int, keys: Keys, records: Mapping[int, HourRecord],
        wanted: Sequence[TableSchema], columns: Sequence[str] | None = None,
    ) -> list[pa.Table]:  # fmt: skip
        """Return rows of the wanted tables, as written if they are up to date, else made now."""
        written = [self.file(table, day).keys() for table in self.tables]
        current = {hour for hour, key in keys.items() if all(of.get(hour) == key for of in written)}
        new = [self.make(records[hour]) for hour in sorted(keys.keys() - current)]
        return [
            self._join_rows(
                table, day, current, len(written[k]), [each[k] for each in new], columns
            )
            for k, table in enumerate(self.tables)
            if table in wanted
        ]

    def _join_rows(
        self, table: TableSchema, day: int, current: set[int], hours_in_file: int,
        new: list[pa.Table], columns: Sequence[str] | None,
    ) -> pa.Table:  # fmt: skip
        """Join the rows of hours that are up to date in the file with those made now."""
        needed = {*(columns or table.names), *table.order}
        names = [name for name in table.names if name in needed]
        parts = [each.select(names) for each in (table.empty(), *new)]
        if current:
            rows = self.file(table, day).read(names)
            if len(current) == hours_in_file and not new:
                return pa.concat_tables([*parts, rows], promote_options="default")
            hours = pa.array(sorted(each - day for each in current), pa.int32())
            hour = pc.divide(rows["interval"], pa.scalar(QUARTERS, pa.int32()))
            parts.append(rows.filter(pc.is_in(hour, hours)))
        joined = pa.concat_tables(parts, promote_options="default")  # newer columns are null
        return joined.sort_by([(name, "ascending") for name in table.order])
