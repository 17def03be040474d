"""Roll-ups: sums of the tables of dates by month, weekday and hour, by the clocks of the site.

A file of a month holds for each UTC date a *key*, the digest of what its sums were made from. Dates
are added in their order, so that equal inputs give equal bytes whether a month is summed at once or
date by date. The last date of a dataset is left out of the files, as it still grows; readers add
it, and all that is not up to date.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import Booleans, Floats, Integers, zone_of
from gis_radar.dataset.days.asked_time import QUARTER_S, AskedTime, month_edges
from gis_radar.dataset.days.lane_measures import LANES_METHOD, LaneTraffic
from gis_radar.dataset.days.lane_sums import SUMMANDS
from gis_radar.dataset.days.tables import QUARTERS
from gis_radar.dataset.days.tile_counts import TileCounts, count_keys
from gis_radar.dataset.files.parts import HOURS_PER_DAY, Keys, TableFile, common_metadata, days_of
from gis_radar.dataset.files.records import HourRecord, read_hours, record_path
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.tables import (
    LANE_MEASURES,
    MONTH_TABLES,
    TILE_COUNTS,
    TILE_MONTHS,
    TRACKS,
)
from gis_radar.measures import SPEED_CLASSES

_DAYS_PER_WEEK = 7
_HIGHEST = "queue_max_m"  # the only column that is a maximum, not a sum
_StaleMonth: TypeAlias = tuple[Keys, dict[int, HourRecord]]
"""Keys of the dates of a month whose file is missing or out of date, and records of its hours."""
_SETTLED_S = 2.0  # after which another write of a folder has another time stamp


class Sums:
    """Sums of a roll-up by lane (or tile), weekday and hour; memory is that of one month.

    Parameters
    ----------
    table : TableSchema
        The roll-up.
    columns : sequence of str, optional
        Its columns that are summed; by default all. The others are missing.
    """

    def __init__(self, table: TableSchema, columns: Sequence[str] | None = None) -> None:
        self.table = table
        needed = {*table.names} if columns is None else {*columns, *_WEIGHTS}
        self.names = [name for name in table.names if name in needed - {*table.order}]
        self._id, *cells = table.order
        self._cells = HOURS_PER_DAY * (_DAYS_PER_WEEK if len(cells) > 1 else 1)
        self._ids: Integers = np.empty(0, np.int64)
        self._values: dict[str, Floats] = {}

    def add(
        self, ids: Integers, cell: Integers, columns: Iterable[tuple[str, Floats | Integers]]
    ) -> None:
        """Add rows to the sums, in their order.

        Parameters
        ----------
        ids : (n,) int64 array
            Lanes or tiles.
        cell : (n,) int64 array
            Weekday x 24 + hour of lanes, hour of tiles.
        columns : iterable of (str, (n, ...) array)
            Names and values; the same names each time.
        """
        ids_now = np.union1d(self._ids, ids)
        if len(ids_now) > len(self._ids):
            self._grow(ids_now)
        place = np.searchsorted(self._ids, ids) * self._cells + cell
        for name, values in columns:
            shape = (len(self._ids) * self._cells, *values.shape[1:])
            if name not in self._values:
                self._values[name] = np.full(shape, np.nan if name == _HIGHEST else 0.0)
            total = self._values[name]
            if name == _HIGHEST:
                np.fmax.at(total, place, values)
            elif values.ndim > 1:
                cells = place[:, None] * values.shape[1] + np.arange(values.shape[1])
                added = np.bincount(cells.ravel(), values.ravel(), total.size)
                total += added.reshape(total.shape)
            else:
                total += np.bincount(place, values, len(total))

    def _grow(self, ids_now: Integers) -> None:
        place = np.searchsorted(ids_now, self._ids)
        for name, values in self._values.items():
            shape = (len(ids_now), self._cells, *values.shape[1:])
            grown = np.full(shape, np.nan if name == _HIGHEST else 0.0)
            grown[place] = values.reshape(-1, *shape[1:])
            self._values[name] = grown.reshape(-1, *shape[2:])
        self._ids = ids_now

    def add_written(self, rows: pa.Table) -> None:
        """Add rows of a file."""
        cell = rows["hour"].to_numpy().astype(np.int64)
        if "weekday" in rows.column_names:
            cell += HOURS_PER_DAY * rows["weekday"].to_numpy().astype(np.int64)
        values = ((name, _numbers(rows, name)) for name in self.names)
        self.add(rows[self._id].to_numpy(), cell, values)

    def rows(self) -> pa.Table:
        """Return the sums as rows of the roll-up: those with a weight over 0."""
        schema = pa.schema([self.table.schema.field(n) for n in (*self.table.order, *self.names)])
        if not self._values:
            return schema.empty_table()
        weights = [values for name, values in self._values.items() if name in _WEIGHTS]
        row = np.flatnonzero(np.any([each > 0.0 for each in weights], axis=0))
        place, cell = np.divmod(row, self._cells)
        columns_of_row: dict[str, Any] = {
            self._id: self._ids[place],
            "weekday": cell // HOURS_PER_DAY, "hour": cell % HOURS_PER_DAY,
        }  # fmt: skip
        columns_of_row |= {name: each[row] for name, each in self._values.items()}
        columns = [_arrow_array(columns_of_row[field.name], field.type) for field in schema]
        return pa.Table.from_arrays(columns, schema=schema)


_WEIGHTS = {"quarters", "visible_s", "visible_km_h", "observed_steps"}


def _arrow_array(values: Floats, kind: pa.DataType) -> Any:
    if pa.types.is_list(kind):
        whole = pa.array(values.astype(np.int64).ravel())
        return pa.FixedSizeListArray.from_arrays(whole, values.shape[1]).cast(kind)
    return pa.array(values, from_pandas=True).cast(kind)


def _numbers(rows: pa.Table, name: str) -> Any:
    """Return a column as numbers; missing ones are NaN, missing lists of classes zeros."""
    column = rows[name].combine_chunks()
    if not pa.types.is_list(column.type):
        return column.to_numpy(zero_copy_only=False)
    values = np.zeros((len(rows), SPEED_CLASSES), np.int64)
    lists = column.drop_null().flatten().to_numpy(zero_copy_only=False)
    values[column.is_valid().to_numpy(zero_copy_only=False)] = lists.reshape(-1, SPEED_CLASSES)
    return values


def _summands(table: TableSchema, name: str) -> tuple[Sequence[str], Callable[..., Any]]:
    """Return the columns from which the summands of a column of a roll-up are computed, and how."""
    own: tuple[Sequence[str], Callable[..., Any]] = ((name,), lambda values: values)
    return own if table is TILE_MONTHS else SUMMANDS.get(name, own)


def _values(rows: pa.Table, sums: Sums) -> Iterator[tuple[str, Any]]:
    """Yield the summands of each column from rows of a date; missing ones add nothing."""
    for name in sums.names:
        sources, summand = _summands(sums.table, name)
        of = (_numbers(rows, each) for each in sources)
        value = summand(*(each.astype(np.float64) if each.ndim == 1 else each for each in of))
        yield name, value if name == _HIGHEST else np.nan_to_num(value)


@dataclass(frozen=True, kw_only=True, eq=False)
class RollUps:
    """Maker and reader of the roll-ups of a dataset.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    fingerprint : str
        Fingerprint of its tiles.
    timezone : str
        Time zone of the site.
    checked : dict
        By table and month, when its file and the folders of its hours were last written, and the
        result of :meth:`_stale_month` then, which holds until one of them is written again.
    """

    folder: Path
    fingerprint: str
    timezone: str
    checked: dict[tuple[str, str], tuple[list[int], _StaleMonth | None]] = field(
        default_factory=dict, repr=False
    )
    _clocks: dict[int, pd.DatetimeIndex] = field(default_factory=dict, repr=False)

    @cached_property
    def traffic(self) -> LaneTraffic:
        """The lane measures."""
        return LaneTraffic(folder=self.folder, fingerprint=self.fingerprint)

    def update(self, hours: Iterable[int], records: Mapping[int, HourRecord]) -> None:
        """Bring the roll-ups of the months of some hours up to date; the caller is the only writer.

        Parameters
        ----------
        hours : iterable of int
            Hours since 1970 that were made or removed.
        records : mapping
            The records of all complete hours.
        """
        self.traffic.remember(records)
        last = max(days_of(records), default=0)
        for month in self.months(hours):
            for table in MONTH_TABLES:
                keys = self._keys(table, month, records)
                keys = {day: key for day, key in keys.items() if day < last}
                file = self.file(table, month)
                if not keys:
                    file.path.unlink(missing_ok=True)
                elif not self._is_made_of(table, month, keys):
                    file.write(self._sums(table, month, keys, records).rows(), keys)

    def read(
        self, table: TableSchema, month: str, columns: Sequence[str] | None = None
    ) -> pa.Table:
        """Read the roll-up of a month; what is missing or not up to date is summed now.

        Parameters
        ----------
        table : TableSchema
            `LANE_MONTHS` or `TILE_MONTHS`.
        month : str
            Such as `2026-10`.
        columns : sequence of str, optional
            Names of the columns; by default all.
        """
        stale = self._stale_month(table, month)
        if stale is None:
            return self.file(table, month).read(columns)
        rows = self._sums(table, month, *stale, columns).rows()
        return rows.select(list(columns or table.names))

    def is_current(self, table: TableSchema, month: str) -> bool:
        """Return whether the file of a month is up to date."""
        return self._stale_month(table, month) is None

    def _stale_month(self, table: TableSchema, month: str) -> _StaleMonth | None:
        """Return keys and records of a month if its file is missing or out of date, else None."""
        written_at = self._write_times(table, month)
        checked_at, stale = self.checked.get((table.name, month), ([], None))
        if written_at and checked_at == written_at:
            return stale
        records = self._records_of_dates(self.days(month))
        keys = self._keys(table, month, records)
        stale = None if keys and self._is_made_of(table, month, keys) else (keys, records)
        if written_at:
            self.checked[table.name, month] = written_at, stale
        return stale

    def sums_of(
        self, table: TableSchema, asked: AskedTime, columns: Sequence[str]
    ) -> Iterator[tuple[str, pa.Table]]:
        """Yield sums of the asked time month by month, with the rows and columns of a roll-up.

        Months of which only some days are asked for are summed from the tables of dates.

        Parameters
        ----------
        table : TableSchema
            `LANE_MONTHS`, or `TILE_MONTHS` where all days of the week are asked for.
        asked : AskedTime
            The time.
        columns : sequence of str
            Names of the columns.
        """
        for month, whole in asked.months():
            if whole:
                yield month, self.read(table, month, columns)
                continue
            masks, sums = asked.masks(month), Sums(table, columns)
            records = self._records_of_dates(list(masks))
            for day, quarters in masks.items():
                self._add_day(sums, day, records, quarters)
            yield month, sums.rows().select(list(columns))

    def months(self, hours: Iterable[int]) -> list[str]:
        """Return the months, such as `2026-10`, in which hours since 1970 lie, ascending."""
        begins = np.unique(np.fromiter(hours, np.int64))[:, None] * 3600 + [0, 2700]
        local = pd.to_datetime(begins.ravel(), unit="s", utc=True).tz_convert(self.timezone)
        return sorted(set(local.strftime("%Y-%m")))

    def days(self, month: str) -> list[int]:
        """Return the first hours of the UTC dates of which a month holds some.

        Raises
        ------
        UsageError
            If it is no month.
        """
        first, after = (
            each.tz_convert("UTC").timestamp() for each in month_edges(month, self.timezone)
        )
        return days_of(range(int(first // 3600), int(-(-after // 3600))))

    def clock(self, day: int) -> pd.DatetimeIndex:
        """Return the begins of the quarters of a UTC date, by the clocks of the site."""
        if day not in self._clocks:
            begin = pd.Timestamp(day * 3600, unit="s", tz="UTC")
            quarters = pd.date_range(begin, periods=HOURS_PER_DAY * QUARTERS, freq="15min")
            self._clocks[day] = quarters.tz_convert(zone_of(self.timezone))
        return self._clocks[day]

    def file(self, table: TableSchema, month: str) -> TableFile:
        """Return the file of a roll-up."""
        path = self.folder / table.name / f"month={month}" / "month.parquet"
        clocks = {"month": month, "timezone": self.timezone}
        metadata = common_metadata(table, self.fingerprint) | clocks
        return TableFile(table=table, path=path, metadata=metadata, keyed="dates")

    def check(self) -> None:
        """Read all files, to check them.

        Raises
        ------
        InputError
            If one is damaged.
        """
        for table in MONTH_TABLES:
            for path in sorted((self.folder / table.name).glob("month=*/month.parquet")):
                self.file(table, path.parent.name.removeprefix("month=")).read()

    def _in_month(self, day: int, month: str) -> Booleans:
        """Return which quarters of a UTC date lie in a month."""
        first, after = (each.timestamp() for each in month_edges(month, self.timezone))
        begins = day * 3600.0 + QUARTER_S * np.arange(HOURS_PER_DAY * QUARTERS)
        return (begins >= first) & (begins < after)

    def _records_of_dates(self, days: Sequence[int]) -> dict[int, HourRecord]:
        """Read the records of the complete hours from a UTC date to another."""
        records = read_hours(self.folder, days[0], days[-1] + HOURS_PER_DAY - 1)
        self.traffic.remember(records)
        return records

    def _write_times(self, table: TableSchema, month: str) -> list[int]:
        """Return when the file of a month and the folders of its hours were written.

        Empty if one was written less than `_SETTLED_S` ago: the next write could have the same
        time stamp.
        """
        places = [self.file(table, month).path]
        places += [record_path(self.folder, day).parent for day in self.days(month)]
        state = [_written_ns(path) for path in places]
        return state if max(state) < time.time_ns() - _SETTLED_S * 1e9 else []

    def _keys(self, table: TableSchema, month: str, records: Mapping[int, HourRecord]) -> Keys:
        """Return what the sums of each date follow from: a digest and a number of method.

        By the first hour of the date. The number is 0 where all exact tables were deleted: then the
        measures stay as the version that made them counted.
        """
        keys_by_day: dict[int, list[str | int]] = {}
        for day in self.days(month):
            hours = self._records_of_date(day, self._in_month(day, month), records)
            if table is TILE_MONTHS:
                keys, method = count_keys(hours), 0
            else:
                hours = {hour: each for hour, each in hours.items() if TRACKS.name in each.parts}
                keys = {hour: self.traffic.key(each)[1:] for hour, each in hours.items()}
                is_dropped = all(TRACKS.name in each.dropped for each in hours.values())
                method = 0 if is_dropped else LANES_METHOD
            if keys:
                text = json.dumps({hour: keys[hour] for hour in sorted(keys)})
                keys_by_day[day] = [hashlib.sha256(text.encode()).hexdigest(), method]
        return keys_by_day

    def _is_made_of(self, table: TableSchema, month: str, keys: Keys) -> bool:
        """Return whether a file was made of dates with these keys, and no others."""
        made = self.file(table, month).keys()
        return made.keys() == keys.keys() and all(map(_is_same_key, made.values(), keys.values()))

    def _records_of_date(
        self, day: int, wanted: Booleans, records: Mapping[int, HourRecord]
    ) -> dict[int, HourRecord]:
        """Return the records of the hours of a UTC date of which some quarters are wanted."""
        hours = day + np.flatnonzero(wanted.reshape(-1, QUARTERS).any(axis=1))
        return {hour: records[hour] for hour in hours.tolist() if hour in records}

    def _sums(
        self, table: TableSchema, month: str, keys: Keys,
        records: Mapping[int, HourRecord], columns: Sequence[str] | None = None,
    ) -> Sums:  # fmt: skip
        """Sum a month; the file is taken if its dates are the first ones, with the same keys."""
        self.traffic.remember(records)
        sums, written = Sums(table, columns), self.file(table, month).keys()
        first_keys = {day: keys[day] for day in list(keys)[: len(written)]}
        continues = bool(written) and self._is_made_of(table, month, first_keys)
        if continues:
            sums.add_written(self.file(table, month).read([*table.order, *sums.names]))
        for day in keys:
            if not (continues and day in written):
                self._add_day(sums, day, records, self._in_month(day, month))
        return sums

    def _add_day(
        self, sums: Sums, day: int, records: Mapping[int, HourRecord], wanted: Booleans
    ) -> None:
        """Add the wanted quarters of a UTC date."""
        hours, clock = self._records_of_date(day, wanted, records), self.clock(day)
        if not hours:
            return
        id_name = sums.table.order[0]
        sources = (each for name in sums.names for each in _summands(sums.table, name)[0])
        columns = list(dict.fromkeys([id_name, "interval", *sources]))
        if sums.table is TILE_MONTHS:
            counts = TileCounts(folder=self.folder, fingerprint=self.fingerprint)
            (rows,) = counts.read(TILE_COUNTS, hours, None, columns)
            cells = np.asarray(clock.hour, np.int64)
        else:
            (rows,) = self.traffic.read(LANE_MEASURES, hours, None, columns)
            cells = np.asarray(clock.day_of_week * HOURS_PER_DAY + clock.hour, np.int64)
        quarter = rows["interval"].to_numpy()
        if not wanted.all():
            rows, quarter = rows.filter(pa.array(wanted[quarter])), quarter[wanted[quarter]]
        sums.add(rows[id_name].to_numpy(), cells[quarter], _values(rows, sums))


def with_month(rows: pa.Table, month: str) -> pa.Table:
    """Return rows with a last column, the month."""
    return rows.append_column("month", pa.array([month] * len(rows), pa.string()))


def _written_ns(path: Path) -> int:
    """Return when a file or folder was written, 0 where there is none."""
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def _is_same_key(made: Sequence[str | int], key: Sequence[str | int]) -> bool:
    """Return whether two keys of a date are equal; a key of method 0 equals any method."""
    return made[0] == key[0] and (key[1] in (0, made[1]))
