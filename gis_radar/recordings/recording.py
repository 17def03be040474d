"""Recordings: radar detections over time, Parquet or CSV, read in batches and checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from gis_radar.base import (
    FIRST_YEAR,
    LAST_YEAR,
    UNIX_SECONDS_HINT,
    Booleans,
    Floats,
    InputError,
    NoAnswerError,
    Text,
    first_line,
    in_known_years,
)
from gis_radar.recordings import settings
from gis_radar.recordings.csv_table import open_csv_table, refuse_many_columns
from gis_radar.recordings.parquet_table import first_group_of, parquet_batches, spans_of_groups
from gis_radar.recordings.units import refuse_positions_in_other_units, refuse_whole_seconds

COLUMNS = ("time", "x", "y", "z", "range_rate", "rcs")
SENSOR_KEY = b"gis_radar.sensor"  # key of a file's metadata
_LEAST_CONSTANT = 1000  # so many detections of one value are no chance, and no made-up example
FARTHEST_M = 1e6  # no radar sees so far, and point cloud files hold no farther coordinates


@dataclass(frozen=True, kw_only=True)
class Detections:
    """Some consecutive rows of a recording; rows of one frame share one time.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, UTC, ascending.
    points : (n, 3) array
        Sensor frame: x forward, y left, z up, metres. NaN in a frame without detections; z alone
        is NaN where the sensor measures no elevation: x and y are then at the slant range.
    range_rate : (n,) array
        m/s, positive when receding; NaN where unknown.
    rcs : (n,) array
        Radar cross section, dBm2.
    further : pyarrow.RecordBatch
        The recording's other columns, as they are; none where they were not asked for.
    """

    time: Floats
    points: Floats
    range_rate: Floats
    rcs: Floats
    further: pa.RecordBatch

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def present(self) -> Booleans:
        """Mask of the rows that are detections; other rows are frames without detections."""
        return ~np.isnan(self.points[:, 0])

    @property
    def range_m(self) -> Floats:
        """Slant range of each row, metres; NaN in a frame without detections."""
        x, y, z = self.points.T
        return np.asarray(np.sqrt(x * x + y * y + np.where(np.isnan(z), 0.0, z * z)))

    def take(self, keep: Booleans) -> Detections:
        """Return the rows for which `keep` is true."""
        return Detections(
            time=self.time[keep],
            points=self.points[keep],
            range_rate=self.range_rate[keep],
            rcs=self.rcs[keep],
            further=self.further.filter(pa.array(keep)),
        )


class RangeCounts:
    """Histogram of slant ranges, counted in batches.

    Attributes
    ----------
    counts : (4096,) int64 array
        Detections by their range in whole metres; the last entry counts all beyond.
    """

    def __init__(self) -> None:
        self.counts = np.zeros(4096, np.int64)  # bins of 1 m, farther than any radar reaches

    def add(self, rows: Detections) -> None:
        """Count the detections of a batch."""
        metres = rows.range_m[rows.present]
        bins = np.minimum(metres, len(self.counts) - 1).astype(np.int64)
        self.counts += np.bincount(bins, minlength=len(self.counts))

    def reached_m(self, share: float = 0.999) -> float:
        """Return the range (whole metres) that holds a share of the detections; 0 without any."""
        total = int(self.counts.sum())
        inside = np.cumsum(self.counts) / max(total, 1)
        return float(np.searchsorted(inside, share) + 1) if total else 0.0


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recording on disk.

    Parameters
    ----------
    path : Path
        The file.
    rows : int or None
        Number of rows, where it is known without reading the file.
    batches : callable
        Takes columns, or None for all; returns an iterator over record batches of bounded size.
    batches_from : callable, optional
        Takes a time (UNIX seconds); returns a number of earlier rows to skip, and an iterator over
        the batches after them. None where the file has no index for that.
    time_spans : callable, optional
        Returns first and last time (UNIX seconds) of consecutive parts of the file, without reading
        them; None where the file does not state them.
    sensor : str
        Name of the sensor, as `convert` wrote it into the file; empty if missing.
    selected : bool
        Whether it has a column `pose`, as those of the live system, whose sensors send only
        detections near the road.
    """

    path: Path
    rows: int | None
    batches: Callable[[Sequence[str] | None], Iterator[pa.RecordBatch]]
    batches_from: Callable[[float], tuple[int, Iterator[pa.RecordBatch]]] | None = None
    time_spans: Callable[[], list[tuple[float, float]] | None] | None = None
    sensor: str = ""
    selected: bool = False

    def __repr__(self) -> str:
        rows = "" if self.rows is None else f", {self.rows} rows"
        return f"Recording({str(self.path)!r}{rows}{', ' * bool(self.sensor)}{self.sensor})"

    def read(self, *, further: bool = False) -> Iterator[Detections]:
        """Read the recording in batches, in bounded memory.

        Parameters
        ----------
        further : bool
            Whether its further columns are read, too.

        Yields
        ------
        Detections
            Consecutive rows; a frame may go on in the next batch.

        Raises
        ------
        InputError
            If the file is damaged, a column is missing or no number, times do not ascend, a
            coordinate is infinite, absurd or half missing, positions look like another unit, some
            detections have a height and others none, or there is no row at all. Rows are counted
            from 1, without a header.
        """
        return self._checked_rows(0, self.batches(None if further else COLUMNS))

    def read_between(self, begin: float, end: float) -> Iterator[Detections]:
        """Read the batches with rows between two times (UNIX seconds), as :meth:`read` does."""
        found = self.batches_from(begin) if self.batches_from else (0, self.batches(COLUMNS))
        for rows in self._checked_rows(*found):
            if rows.time[0] > end:
                return
            if rows.time[-1] >= begin:
                yield rows

    def _checked_rows(self, before: int, batches: Iterator[pa.RecordBatch]) -> Iterator[Detections]:
        """Yield the rows of batches, of which the first follows `before` other rows."""
        checks = RowChecks(path=self.path, row=before)
        with checks.reading():
            for batch in batches:
                rows = checks.take(batch)
                if len(rows):
                    yield rows

    def measures_elevation(self) -> bool:
        """Return whether the sensor measures elevation: whether first detections have various z."""
        for rows in self.read():
            if rows.present.any():
                return has_height(rows) and constant_value(rows.points[:, 2]) is None
        return True

    def require_elevation(self, what: str) -> None:
        """Refuse a recording without elevation.

        Parameters
        ----------
        what : str
            What cannot be found from it, for the message.

        Raises
        ------
        NoAnswerError
            If the sensor measures no elevation.
        """
        if not self.measures_elevation():
            raise NoAnswerError(
                "{}: the sensor measures no elevation (z is empty, or the same throughout), so {}",
                self.path,
                what,
                hint="survey the sensor and give its pose; measure and project take it",
            )


def has_height(rows: Detections) -> bool:
    """Return whether the first detection, and so all of a recording, has a height."""
    return bool(np.isfinite(rows.points[rows.present.argmax(), 2]))


def constant_value(column: Floats, least: int = _LEAST_CONSTANT) -> float | None:
    """Return the value of a column that is the same in all of `least` detections; else None."""
    known = column[np.isfinite(column)]
    if len(known) < least or (known != known[0]).any():
        return None
    return float(known[0]) + 0.0  # no -0


def open_table(path: Path) -> Recording:
    """Open a table in the form of a recording: Parquet, or CSV with the same header."""
    return (_open_csv if path.suffix.lower() == ".csv" else _open_parquet)(path)


def _open_parquet(path: Path) -> Recording:
    """Open a Parquet file after checks of its columns and their types."""
    with pq.ParquetFile(path) as file:
        refuse_many_columns(file.metadata.num_columns, path)
        _require_columns(file.schema_arrow.names, path)
        for name in COLUMNS:
            _require_numbers(file.schema_arrow.field(name).type, name, path)
        rows = file.metadata.num_rows
        sensor = (file.schema_arrow.metadata or {}).get(SENSOR_KEY, b"").decode(errors="replace")
        selected = "pose" in file.schema_arrow.names

    def batches_from(begin: float) -> tuple[int, Iterator[pa.RecordBatch]]:
        group, before = first_group_of(path, "time", begin)
        return before, parquet_batches(path, COLUMNS, first_group=group)

    return Recording(
        path=path, rows=rows, batches=partial(parquet_batches, path), batches_from=batches_from,
        time_spans=partial(spans_of_groups, path, "time"), sensor=sensor, selected=selected,
    )  # fmt: skip


def _open_csv(path: Path) -> Recording:
    table = open_csv_table(path, numbers=COLUMNS)
    _require_columns(list(table.names), path)
    return Recording(path=path, rows=None, batches=lambda _: table.batches())


UNREADABLE = (pa.ArrowException, OSError, ValueError)
_NUMERIC = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)
_VIEWS = {pa.string_view(): pa.string(), pa.binary_view(): pa.binary()}


def _require_columns(names: list[str], path: Path) -> None:
    """Refuse a table that lacks a column of a recording, or has one twice."""
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        column = Text("{}: recording lacks the column {}", path, ", ".join(missing))
        columns = Text("{}: recording lacks the columns {}", path, ", ".join(missing))
        raise InputError(
            columns if len(missing) > 1 else column,
            hint=Text("a recording has {}", ", ".join(COLUMNS)),
        )
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            "{}: recording has {} columns {}",
            path,
            names.count(twice),
            repr(twice),
            hint="give every column a name of its own",
        )


@dataclass(kw_only=True)
class RowChecks:
    """Checks of the rows of a recording, batch by batch.

    Parameters
    ----------
    path : Path
        The file.
    row : int
        Number of rows checked so far.
    last : float
        Time of the last of them, UNIX seconds.
    without_height : bool, optional
        Whether detections have no height; None before the first one.
    rows_of_last : int
        Number of rows of the time `last` so far.
    """

    path: Path
    row: int = 0
    last: float = -np.inf
    rows_of_last: int = 0
    without_height: bool | None = None

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Turn errors of reading in the block into an InputError; refuse a file without rows."""
        try:
            yield
        except UNREADABLE as error:
            raise InputError(
                "{}: damaged after row {}: {}", self.path, self.row, first_line(error)
            ) from error
        if self.row == 0:
            raise InputError("{}: recording without rows", self.path)

    def take(self, batch: pa.RecordBatch) -> Detections:
        """Return the next rows as detections, or refuse them."""
        rows = _checked(batch, path=self.path, row=self.row, last=self.last)
        without_height = _refuse_mixed_heights(
            rows, self.path, self.row, without_height=self.without_height
        )
        present = rows.present
        points = rows.points if present.all() else rows.points[present]
        refuse_positions_in_other_units(points, str(self.path))
        self.without_height = without_height
        refuse_whole_seconds(rows.time, str(self.path))
        if len(rows):
            before, time = self.rows_of_last, rows.time
            self.rows_of_last = _refuse_long_frame(time, self.path, self.last, before)
            self.row, self.last = self.row + len(rows), float(time[-1])
        return rows


def _checked(batch: pa.RecordBatch, *, path: Path, row: int, last: float) -> Detections:
    """Turn a batch whose first row is the file's `row` into detections, or refuse it."""
    values = {name: _numbers(batch, name, path) for name in COLUMNS}
    time, points = values["time"], np.column_stack([values[axis] for axis in "xyz"])
    _refuse_times(time, path, row, last)
    _refuse_positions(points, path, row)
    return Detections(
        time=time,
        points=points,
        range_rate=values["range_rate"],
        rcs=values["rcs"],
        further=_further(batch),
    )


def _further(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the further columns, without view types, of which Arrow cannot take rows."""
    others = batch.select([name for name in batch.schema.names if name not in COLUMNS])
    for place, field in enumerate(others.schema):
        if kind := _VIEWS.get(field.type):
            others = others.set_column(place, field.name, pc.cast(others.column(place), kind))
    return others


def _refuse_times(time: Floats, path: Path, row: int, last: float) -> None:
    """Refuse times that are no numbers, of impossible years, or before the row above."""
    ascending = len(time) > 0 and time[0] >= last and bool(np.all(np.diff(time) >= 0.0))
    if ascending and np.all(in_known_years(time[[0, -1]])):
        return  # most batches, in one pass
    _refuse_rows(~np.isfinite(time), Text("{}: time is not a finite number", path), row)
    years = Text("{}: time is outside the years {} to {}", path, FIRST_YEAR, LAST_YEAR)
    _refuse_rows(~in_known_years(time), years, row, hint=UNIX_SECONDS_HINT)
    _refuse_rows(
        np.diff(time, prepend=last) < 0.0,
        Text("{}: time goes back", path),
        row,
        hint=Text(
            "the sensor's clock was set back, or rows are out of order: sort them, or cut there"
        ),
    )


def _refuse_positions(points: Floats, path: Path, row: int) -> None:
    """Refuse positions that are infinite, half missing, or farther than `FARTHEST_M`."""
    if np.all(np.abs(points) <= FARTHEST_M):
        return
    gaps = np.isnan(points)
    level = ~gaps[:, 0] & ~gaps[:, 1] & gaps[:, 2]
    odd = np.isinf(points).any(axis=1) | (gaps.any(axis=1) & ~gaps.all(axis=1) & ~level)
    _refuse_rows(np.asarray(odd), Text("{}: position is not finite", path), row)
    far = np.asarray((np.abs(points) > FARTHEST_M).any(axis=1))
    reason = Text("{}: position is over {:.0f} km from the sensor", path, FARTHEST_M / 1000)
    _refuse_rows(far, reason, row, hint=Text("x, y and z are metres from the sensor"))


def _refuse_mixed_heights(
    rows: Detections, path: Path, row: int, *, without_height: bool | None
) -> bool | None:
    """Return whether detections have no height; refuse where some have one and others do not."""
    if not rows.present.any():
        return without_height
    level = np.isnan(rows.points[:, 2])
    first = bool(level[rows.present][0]) if without_height is None else without_height
    reason = Text("{}: z is {}, unlike before,", path, Text("there") if first else Text("missing"))
    _refuse_rows(
        np.asarray(rows.present & (level != first)),
        reason,
        row,
        hint=Text("a sensor measures elevation in all detections or in none: leave out such rows"),
    )
    return first


def _refuse_long_frame(time: Floats, path: Path, last: float, before: int) -> int:
    """Return the number of rows of the last time so far; refuse more than a frame can have.

    `before` is the number of rows of the time `last` before these.
    """
    rows_of_time = len(time) - int(np.searchsorted(time, time[-1], side="left"))
    if rows_of_time == len(time) and time[-1] == last:
        rows_of_time += before
    if rows_of_time > (most := settings.MOST_ROWS_OF_FRAME):
        raise InputError(
            "{}: over {:,} rows of one time, {:.6f} s: no frame of a radar",
            path,
            most,
            time[-1],
            hint="time is that of each frame",
        )
    return rows_of_time


def _require_numbers(kind: pa.DataType, name: str, path: Path) -> None:
    # A column of nulls has the type null, which NUMERIC holds; digits as text are refused.
    if not any(is_kind(kind) for is_kind in _NUMERIC):
        hint = Text("gis-radar convert makes a recording of it")
        raise InputError("{}: column {} is {}, expected numbers", path, name, kind, hint=hint)


def _numbers(batch: pa.RecordBatch, name: str, path: Path) -> Floats:
    column = batch.column(name)
    _require_numbers(column.type, name, path)
    numbers = pc.cast(column, pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(numbers, dtype=np.float64)


def _refuse_rows(bad: Booleans, message: str, row: int, *, hint: str = "") -> None:
    if bad.any():
        raise InputError("{} in row {}", message, row + int(bad.argmax()) + 1, hint=hint)
