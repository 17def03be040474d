"""Roll-ups: sums of the tables of dates by month, weekday and hour, by the clocks of the site.

A file of a month holds for each UTC date a *key*, the digest of what its sums were made from. Dates
are added in their order, so that equal inputs give equal bytes whether a month is summed at once or
date by date. The last date of a dataset is left out of the files, as it still grows; readers add
it, and all that is not up to date.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.base import Booleans, Floats, InputError, Integers, UsageError, zone_of
from gis_radar.dataset.day_tables import QUARTERS, Day
from gis_radar.dataset.lane_measures import LaneTraffic
from gis_radar.dataset.parts import (
    HOURS_PER_DAY,
    days_of,
    opened_part,
    rename_whole,
    unfinished,
    whole_metadata,
    write_part,
)
from gis_radar.dataset.records import HourRecord
from gis_radar.dataset.table_schema import TableSchema
from gis_radar.dataset.tables import LANE_MEASURES, MONTH_TABLES, TILE_MONTHS
from gis_radar.dataset.tile_counts import count_keys, read_counts
from gis_radar.measures import SPEED_CLASSES

DAYS_PER_WEEK = 7
QUARTER_S = 900.0
_DATES = "dates"  # entry of the metadata with the key of each date
_HIGHEST = "queue_max_m"  # the one column that is no sum
_LANE_COLUMNS = (
    "lane", "interval", "visible_share", "counted", "volume", "volume_se", "heavy", "speed_counts",
    "occupancy", "occupancy_se", "density", "flow", "delay_s", "queue_max_m", "queue_mean_m",
    "stops", "visible_km_h",
)  # fmt: skip


class Sums:
    """Sums of a roll-up by lane (or tile), weekday and hour; memory is that of one month.

    Parameters
    ----------
    table : TableSchema
        The roll-up.
    """

    def __init__(self, table: TableSchema) -> None:
        self.table = table
        self._id, *cells = table.order
        self._cells = HOURS_PER_DAY * (DAYS_PER_WEEK if len(cells) > 1 else 1)
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
        known = np.union1d(self._ids, ids)
        if len(known) > len(self._ids):
            self._grow(known)
        at = np.searchsorted(self._ids, ids) * self._cells + cell
        for name, values in columns:
            shape = (len(self._ids) * self._cells, *values.shape[1:])
            if name not in self._values:
                self._values[name] = np.full(shape, np.nan if name == _HIGHEST else 0.0)
            mine = self._values[name]
            if name == _HIGHEST:
                np.fmax.at(mine, at, values)
            elif values.ndim > 1:
                np.add.at(mine, at, values)
            else:
                mine += np.bincount(at, values, len(mine))

    def _grow(self, known: Integers) -> None:
        place = np.searchsorted(known, self._ids)
        for name, values in self._values.items():
            shape = (len(known), self._cells, *values.shape[1:])
            grown = np.full(shape, np.nan if name == _HIGHEST else 0.0)
            grown[place] = values.reshape(-1, *shape[1:])
            self._values[name] = grown.reshape(-1, *shape[2:])
        self._ids = known

    def add_written(self, rows: pa.Table) -> None:
        """Add rows of a file."""
        cell = rows["hour"].to_numpy().astype(np.int64)
        if "weekday" in rows.column_names:
            cell += HOURS_PER_DAY * rows["weekday"].to_numpy().astype(np.int64)
        keys = self.table.order
        names = [name for name in self.table.names if name not in keys]
        self.add(rows[self._id].to_numpy(), cell, ((name, _numbers(rows, name)) for name in names))

    def rows(self) -> pa.Table:
        """Return the sums as rows of the roll-up: those of which something is known."""
        if not len(self._ids):
            return self.table.empty()
        weights = [name for name in self._values if name in _WEIGHTS]
        row = np.flatnonzero(np.any([self._values[name] > 0.0 for name in weights], axis=0))
        place, cell = np.divmod(row, self._cells)
        found: dict[str, Any] = {
            self._id: self._ids[place],
            "weekday": cell // HOURS_PER_DAY, "hour": cell % HOURS_PER_DAY,
        }  # fmt: skip
        for column in self.table.columns:
            if column.name in self._values:
                found[column.name] = _typed(self._values[column.name][row], column.type)
        return self.table.to_arrow(found)


_WEIGHTS = {"quarters", "visible_s", "visible_km_h", "observed_steps"}


def _typed(values: Floats, kind: pa.DataType) -> Any:
    if pa.types.is_list(kind):
        whole = pa.array(values.astype(np.int64).ravel())
        return pa.FixedSizeListArray.from_arrays(whole, values.shape[1])
    return values.astype(np.int64) if pa.types.is_integer(kind) else values


def _numbers(rows: pa.Table, name: str) -> Any:
    """Return a column as numbers; missing ones are NaN, missing lists of classes zeros."""
    column = rows[name].combine_chunks()
    if not pa.types.is_list(column.type):
        return column.to_numpy(zero_copy_only=False)
    found = np.zeros((len(rows), SPEED_CLASSES), np.int64)
    lists = column.drop_null().flatten().to_numpy(zero_copy_only=False)
    found[column.is_valid().to_numpy(zero_copy_only=False)] = lists.reshape(-1, SPEED_CLASSES)
    return found


def _lane_values(rows: pa.Table) -> dict[str, Floats]:
    """Return what is summed of rows of `lane_measures`."""
    of = {name: _numbers(rows, name) for name in _LANE_COLUMNS[2:]}
    share, area = of["visible_share"], of["visible_km_h"]
    found = {
        "quarters": np.isfinite(of["volume"]).astype(np.float64),
        "visible_s": share * QUARTER_S,
        "counted": of["counted"],
        "volume": of["volume"],
        "volume_variance": of["volume_se"] ** 2,
        "heavy": of["heavy"],
        "speed_counts": of["speed_counts"],
        "visible_km_h": np.where(np.isfinite(of["occupancy"]), area, 0.0),
        "occupied_km_h": of["occupancy"] * area,
        "occupied_variance": (of["occupancy_se"] * area) ** 2,
        "vehicle_km": of["flow"] * area,
        "vehicle_h": of["density"] * area,
        "delay_h": of["delay_s"] * of["volume"] / 3600.0,
        "queue_m_s": of["queue_mean_m"] * share * QUARTER_S,
        "stops": of["stops"],
    }
    return {name: np.nan_to_num(each) for name, each in found.items()} | {
        "queue_max_m": of["queue_max_m"]
    }


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
    """

    folder: Path
    fingerprint: str
    timezone: str
    _clocks: dict[int, pd.DatetimeIndex] = field(default_factory=dict, repr=False)

    @cached_property
    def traffic(self) -> LaneTraffic:
        """The lane measures."""
        return LaneTraffic(folder=self.folder, fingerprint=self.fingerprint)

    def update(self, hours: Iterable[int], known: Mapping[int, HourRecord]) -> None:
        """Bring the roll-ups of the months of some hours up to date; the caller is the only writer.

        Parameters
        ----------
        hours : iterable of int
            Hours since 1970 that were made or removed.
        known : mapping
            The records of all complete hours.
        """
        last = max(days_of(known), default=0)
        for month in self.months(hours):
            for table in MONTH_TABLES:
                keys = self._keys(table, month, known)
                keys = {day: key for day, key in keys.items() if day < last}
                path = self.path(table, month)
                if not keys:
                    path.unlink(missing_ok=True)
                elif self._made(table, month) != keys:
                    stated = {_DATES: json.dumps(keys)}
                    rows = self._sums(table, month, keys, known).rows()
                    write_part(table, path, rows, self._metadata(table, month) | stated)
                    rename_whole(unfinished(path), path)

    def read(self, table: TableSchema, month: str, known: Mapping[int, HourRecord]) -> pa.Table:
        """Read the roll-up of a month; what is missing or not up to date is summed now.

        Parameters
        ----------
        table : TableSchema
            `LANE_MONTHS` or `TILE_MONTHS`.
        month : str
            Such as `2026-10`.
        known : mapping
            The records of complete hours, those of the month among them.
        """
        keys = self._keys(table, month, known)
        if keys and self._made(table, month) == keys:
            return self._written(table, month)
        return self._sums(table, month, keys, known).rows()

    def whole_path(
        self, table: TableSchema, month: str, known: Mapping[int, HourRecord]
    ) -> Path | None:
        """Return the file of a month if it holds all of it."""
        keys = self._keys(table, month, known)
        return self.path(table, month) if keys and self._made(table, month) == keys else None

    def summed(
        self, table: TableSchema, known: Mapping[int, HourRecord], wanted: Mapping[int, Booleans]
    ) -> pa.Table:
        """Sum some quarters of hours from the tables of dates, as a roll-up of them alone.

        Parameters
        ----------
        table : TableSchema
            `LANE_MONTHS` or `TILE_MONTHS`.
        known : mapping
            The records of complete hours.
        wanted : mapping
            By the first hour of a UTC date, which of its 96 quarters are summed.
        """
        sums = Sums(table)
        for day, quarters in sorted(wanted.items()):
            self._add_day(sums, day, known, quarters)
        return sums.rows()

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
        first, after = (each.tz_convert("UTC").timestamp() for each in self.edges(month))
        return days_of(range(int(first // 3600), int(-(-after // 3600))))

    def edges(self, month: str) -> tuple[pd.Timestamp, pd.Timestamp]:
        """Return the begin of a month and that of the next, by the clocks of the site."""
        if not re.fullmatch(r"\d{4}-(0[1-9]|1[0-2])", month):
            raise UsageError("{} is no month", repr(month), hint="such as 2026-10")
        begin = pd.Timestamp(f"{month}-01")
        zone, after = zone_of(self.timezone), begin + pd.DateOffset(months=1)
        return begin.tz_localize(zone), after.tz_localize(zone)

    def clock(self, day: int) -> pd.DatetimeIndex:
        """Return the begins of the quarters of a UTC date, by the clocks of the site."""
        if day not in self._clocks:
            begin = pd.Timestamp(day * 3600, unit="s", tz="UTC")
            quarters = pd.date_range(begin, periods=HOURS_PER_DAY * QUARTERS, freq="15min")
            self._clocks[day] = quarters.tz_convert(zone_of(self.timezone))
        return self._clocks[day]

    def path(self, table: TableSchema, month: str) -> Path:
        """Return the path of a roll-up."""
        return self.folder / table.name / f"month={month}" / "month.parquet"

    def check(self) -> None:
        """Read all files, to check them.

        Raises
        ------
        InputError
            If one is damaged.
        """
        for table in MONTH_TABLES:
            for path in sorted((self.folder / table.name).glob("month=*/month.parquet")):
                self._written(table, path.parent.name.removeprefix("month="))

    def _in_month(self, day: int, month: str) -> Booleans:
        clock = self.clock(day)
        year, number = map(int, month.split("-"))
        return np.asarray((clock.year == year) & (clock.month == number))

    def _keys(
        self, table: TableSchema, month: str, known: Mapping[int, HourRecord]
    ) -> dict[int, str]:
        """Return the digest of what the sums of each date follow from, by its first hour."""
        found = {}
        for day in self.days(month):
            hours = self._hours(day, self._in_month(day, month), known)
            if table is TILE_MONTHS:
                keys = count_keys(hours)
            else:
                date = Day(folder=self.folder, fingerprint=self.fingerprint, first_hour=day)
                keys = self.traffic.keys(date, hours)
            if keys:
                text = json.dumps({hour: keys[hour] for hour in sorted(keys)})
                found[day] = hashlib.sha256(text.encode()).hexdigest()
        return found

    def _hours(
        self, day: int, wanted: Booleans, known: Mapping[int, HourRecord]
    ) -> dict[int, HourRecord]:
        """Return the records of the hours of a UTC date of which some quarters are wanted."""
        hours = day + np.flatnonzero(wanted.reshape(-1, QUARTERS).any(axis=1))
        return {hour: known[hour] for hour in hours.tolist() if hour in known}

    def _sums(
        self, table: TableSchema, month: str, keys: Mapping[int, str],
        known: Mapping[int, HourRecord],
    ) -> Sums:  # fmt: skip
        """Sum a month; the file is taken if its dates are the first ones, with the same keys."""
        sums, written = Sums(table), self._made(table, month)
        begun = list(written.items()) == list(keys.items())[: len(written)]
        if begun and written:
            sums.add_written(self._written(table, month))
        for day in keys:
            if not (begun and day in written):
                self._add_day(sums, day, known, self._in_month(day, month))
        return sums

    def _add_day(
        self, sums: Sums, day: int, known: Mapping[int, HourRecord], wanted: Booleans
    ) -> None:
        """Add the wanted quarters of a UTC date."""
        hours, clock = self._hours(day, wanted, known), self.clock(day)
        if not hours:
            return
        if sums.table is TILE_MONTHS:
            columns = [name for name in TILE_MONTHS.names if name != "hour"]
            (rows,) = read_counts(
                self.folder, self.fingerprint, hours, None, [*columns, "interval"]
            )
            cells = np.asarray(clock.hour, np.int64)
        else:
            (rows,) = self.traffic.read(LANE_MEASURES, hours, None, _LANE_COLUMNS)
            cells = np.asarray(clock.day_of_week * HOURS_PER_DAY + clock.hour, np.int64)
        quarter = rows["interval"].to_numpy()
        if not wanted.all():
            rows, quarter = rows.filter(pa.array(wanted[quarter])), quarter[wanted[quarter]]
        ids = rows[sums.table.order[0]].to_numpy()
        tile_values = ((name, _numbers(rows, name)) for name in TILE_MONTHS.names[2:])
        values = tile_values if sums.table is TILE_MONTHS else _lane_values(rows).items()
        sums.add(ids, cells[quarter], values)

    def _made(self, table: TableSchema, month: str) -> dict[int, str]:
        """Read the keys of the dates in a file; none if it is damaged."""
        with suppress(InputError, ValueError, KeyError), self._opened(table, month) as file:
            stated = json.loads(file.metadata.metadata[_DATES.encode()])
            return {int(day): key for day, key in stated.items()}
        return {}

    def _written(self, table: TableSchema, month: str) -> pa.Table:
        with self._opened(table, month) as file:
            return file.read(columns=table.names)

    def _opened(self, table: TableSchema, month: str) -> AbstractContextManager[pq.ParquetFile]:
        return opened_part(table, self.path(table, month), self._metadata(table, month))

    def _metadata(self, table: TableSchema, month: str) -> dict[str, str]:
        clocks = {"month": month, "timezone": self.timezone}
        return whole_metadata(table, self.fingerprint) | clocks
