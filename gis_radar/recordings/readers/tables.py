"""Tables of detections, CSV or Parquet: a row a detection; rows of one time make a frame."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from gis_radar.base import Floats, InputError, Text, UsageError
from gis_radar.recordings import settings
from gis_radar.recordings.columns import COLUMN_NAMES, Layout, find_layout
from gis_radar.recordings.csv_table import open_csv_table, refuse_many_columns
from gis_radar.recordings.frames import Column, Format, Frame, NothingHereError, ReaderContext
from gis_radar.recordings.parquet_table import parquet_batches
from gis_radar.recordings.recording import open_table

_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ENDINGS = (".parquet", ".csv")
_SENSOR = "table"  # of all tables: several are parts of one sensor's recording


def _accepts(source: str) -> bool:
    return Path(source).is_file() and Path(source).suffix.lower() in _ENDINGS


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    path = Path(source)
    if context.time_unit not in _UNITS_S:
        raise UsageError(
            "time unit {}", repr(context.time_unit), hint=Text("known: {}", ", ".join(_UNITS_S))
        )
    names = _names(path, context.columns)
    layout = find_layout(names, context.columns)
    missing = [name for name in ("time", "x", "y") if name not in layout.sources]
    if "time" in missing or not layout.has_positions:
        raise InputError(
            "{}: not known which columns are {}",
            path,
            ", ".join(missing),
            hint=Text(
                "state it: {} time=...,x=...,y=...; it has {}",
                "--columns",
                f"{', '.join(names):.90}",
            ),
        )
    if not context.wants(_SENSOR):
        raise NothingHereError(
            "{}: a table has no sensors", path, hint=Text("leave {} away", "--sensor")
        )
    current: Frame | None = None
    for frame in _partial_frames(path, layout, context):
        if current is not None and current.sensor_time == frame.sensor_time:
            current = _joined(current, frame)
            if len(current) > (most := settings.MOST_ROWS_OF_FRAME):
                raise InputError(
                    "{}: over {:,} rows of one time, {} s: no frame of a radar",
                    path,
                    most,
                    current.sensor_time,
                    hint=Text("time is that of each frame: {} time=...", "--columns"),
                )
            continue
        if current is not None:
            yield current
        current = frame
    if current is None:
        raise NothingHereError("{}: no rows", path, hint="it has a header only")
    yield current


def _names(path: Path, columns: Mapping[str, str]) -> tuple[str, ...]:
    """Return the columns of a table; refuse a name that is there twice."""
    expected = (*(name for known in COLUMN_NAMES.values() for name in known), *columns.values())
    try:
        if path.suffix.lower() == ".csv":
            names = open_csv_table(path, numbers=expected).names
        else:
            names = tuple(pq.read_schema(path).names)
            refuse_many_columns(len(names), path)
    except (pa.ArrowException, ValueError) as error:
        raise InputError("{}: cannot be read: {}", path, error) from error
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            "{}: has several columns {}", path, repr(twice), hint="give each its own name"
        )
    return names


def _batches(path: Path, layout: Layout) -> Iterator[pa.RecordBatch]:
    if path.suffix.lower() == ".csv":
        fields = {target: field.removeprefix("-") for target, field in layout.sources.items()}
        numbers = tuple(field for target, field in fields.items() if target != "time")
        yield from open_csv_table(path, numbers=numbers).batches()
    else:
        yield from parquet_batches(path)


def _partial_frames(path: Path, layout: Layout, context: ReaderContext) -> Iterator[Frame]:
    """Yield the frames of a table; one that goes on in the next batch comes in several parts."""
    done = 0
    try:
        for batch in _batches(path, layout):
            context.reporter.progress(Text("reading {}", path.name), done, None)
            time = batch.schema.field(layout.sources["time"]).type
            if done == 0 and len(batch) and pa.types.is_timestamp(time) and time.tz is None:
                context.reporter.warn("{}: its times name no time zone: they count as UTC", path)
            done += len(batch)
            if len(batch):
                yield from _frames_of_batch(batch, layout, path, context)
    except pa.ArrowException as error:
        raise InputError("{}: damaged after row {:,}: {}", path, done, error) from error


def _frames_of_batch(
    batch: pa.RecordBatch, layout: Layout, path: Path, context: ReaderContext
) -> Iterator[Frame]:
    """Yield a frame for each run of rows of one time in a batch."""
    time = _seconds(batch.column(layout.sources["time"]), path, context.time_unit)
    columns = {name: _numpy(batch.column(name)) for name in batch.schema.names}
    for target, field in layout.sources.items():
        if target != "time" and columns[field.removeprefix("-")].dtype == object:
            raise InputError("{}: column {} is text, expected numbers for {}", path, field, target)
    all_rows = layout.frame(columns.__getitem__, sensor=_SENSOR, stamp="time column")
    starts = np.flatnonzero(np.diff(time, prepend=np.nan) != 0)
    for begin, end in zip(starts, [*starts[1:], len(time)], strict=True):
        yield _frame_of(all_rows, slice(begin, end), float(time[begin]))


def _frame_of(all_rows: Frame, rows: slice, time: float) -> Frame:
    """Return some rows as a frame; a single row of NaN has no detections."""
    # A single row of NaN stands for a frame without detections.
    blank = rows.stop - rows.start == 1 and np.isnan(all_rows.points[rows]).all()
    if blank and np.isnan(all_rows.range_rate[rows]).all():
        rows = slice(rows.start, rows.start)
    identity = time, hash(all_rows.points[rows].tobytes())
    return replace(all_rows.rows(rows), sensor_time=time, identity=identity)


def _joined(first: Frame, second: Frame) -> Frame:
    """Return two parts of one frame as one."""
    both = {
        name: np.concatenate([first.further[name], second.further[name]]) for name in first.further
    }
    points = np.concatenate([first.points, second.points])
    return replace(
        first,
        points=points,
        range_rate=np.concatenate([first.range_rate, second.range_rate]),
        rcs=np.concatenate([first.rcs, second.rcs]),
        further=both,
        identity=(first.sensor_time, hash(points.tobytes())),
    )


def _seconds(column: pa.Array, path: Path, unit: str) -> Floats:
    """Return times as UNIX seconds; they are numbers in `unit`, or ISO 8601 text in UTC."""
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        try:
            column = pc.cast(column, pa.timestamp("ns", tz="UTC"))
        except pa.ArrowException as error:
            raise InputError(
                "{}: a time is neither a number nor ISO 8601: {}", path, error
            ) from error
    if pa.types.is_timestamp(column.type):
        # pandas writes nanoseconds, of which float64 resolves none
        column, unit = pc.cast(column, pa.timestamp("us"), safe=False), "us"
        column = pc.cast(column, pa.int64())
    time = _numpy(column).astype(np.float64) * _UNITS_S[unit]
    if not np.isfinite(time).all():
        raise InputError("{}: a row has no time", path)
    return np.asarray(time)


def _numpy(column: pa.Array) -> Column:
    """Return a column as numbers if its type is numeric, else as text."""
    if pa.types.is_boolean(column.type) or pa.types.is_decimal(column.type):
        column = pc.cast(column, pa.float64())
    values: Any = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind in "iuf":
        return np.asarray(values)
    return np.array([None if value is None else str(value) for value in values], dtype=object)


FORMAT = Format(
    name="table",
    takes=".csv or .parquet with columns of any name (--columns)",
    accepts=_accepts,
    frames=_frames,
    endings=_ENDINGS,
    rank=2,
    opens=open_table,
)
