"""Write a recording frame by frame, as Parquet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.base import ROWS_IN_GROUP, InputError, output_errors
from gis_radar.recordings.frames import Column, Frame
from gis_radar.recordings.recording import SENSOR_KEY, constant_value
from gis_radar.recordings.units import refuse_positions_in_other_units, refuse_whole_seconds

_CORE = ("x", "y", "z", "range_rate", "rcs")
# Detections at z = 0 m, and none elsewhere, that show: elevation is not measured
_LEAST_LEVEL = 100
_NOWHERE = np.full((1, 3), np.nan, dtype=np.float32)
_UNKNOWN = np.full(1, np.nan, dtype=np.float32)


class RecordingFile:
    """A recording that grows frame by frame; its columns are those of the first row group.

    Parameters
    ----------
    path : Path
        The unfinished file.
    place : Path
        Its final path, for messages.
    counts : Counter
        Numbers of what was left out, by kind.
    sensor : str
        Its name, which the file's metadata keep.

    Attributes
    ----------
    elevation : bool or None
        Whether the sensor measures elevation, by the first row group: some z is a number other than
        0. None without detections.
    left_out : set of str
        Further columns that came only after the first row group.
    """

    def __init__(self, path: Path, place: Path, counts: Counter[str], *, sensor: str) -> None:
        self.path, self._sensor = path, sensor
        self.elevation: bool | None = None
        self._place, self._counts = place, counts
        self.frames = self.empty_frames = self.detections = 0
        self.begin = self.end = float("nan")
        self.left_out: set[str] = set()
        self._waiting: list[tuple[float, Frame]] = []
        self._rows = 0
        self._writer: pq.ParquetWriter | None = None

    def add(self, time: float, frame: Frame) -> None:
        """Append a frame; its time is not before the last one's."""
        self.begin = time if self.frames == 0 else self.begin
        self.end = time
        self.frames += 1
        self._waiting.append((time, frame))
        self._rows += max(len(frame), 1)
        if self._rows >= ROWS_IN_GROUP:
            self._write()

    def close(self) -> None:
        """Write what is left and finish the file."""
        if self._waiting:
            self._write()
        writer, self._writer = self._writer, None
        if writer is not None:
            with output_errors(self._place):
                writer.close()

    def abandon(self) -> None:
        """Remove an unfinished file; a finished one is kept."""
        if self._writer is not None:
            with suppress(OSError):
                self._writer.close()

    def _write(self) -> None:
        """Write the waiting frames as row groups; the first decides columns and elevation."""
        points = np.concatenate([frame.points for _, frame in self._waiting])
        refuse_positions_in_other_units(points, str(self._place))
        rows = [max(len(frame), 1) for _, frame in self._waiting]
        refuse_whole_seconds(np.repeat([time for time, _ in self._waiting], rows), str(self._place))
        if self.elevation is None:
            self.elevation = _measures_elevation([frame for _, frame in self._waiting])
        self._waiting = [(time, self._with_uniform_heights(frame)) for time, frame in self._waiting]
        self.empty_frames += sum(len(frame) == 0 for _, frame in self._waiting)
        self.detections += sum(len(frame) for _, frame in self._waiting)
        table = self._table()
        self._waiting, self._rows = [], 0
        with output_errors(self._place):
            if self._writer is None:
                options = parquet_options(table.schema.names)
                schema = table.schema.with_metadata({SENSOR_KEY: self._sensor})
                self._writer = pq.ParquetWriter(self.path, schema, **options)
            self._writer.write_table(table, row_group_size=ROWS_IN_GROUP)

    def _with_uniform_heights(self, frame: Frame) -> Frame:
        """Return a frame whose detections all have a height, or none has, by `elevation`."""
        given = np.isfinite(frame.points[:, 2])
        if self.elevation and not given.all():
            self._counts["invalid_detections"] += int((~given).sum())
            return frame.rows(given)
        if self.elevation is False and given.any():
            points = frame.points.copy()
            points[:, 2] = np.nan
            return replace(frame, points=points)
        return frame

    def _table(self) -> pa.Table:
        """Return the waiting frames as a table; note columns that the file does not have."""
        schema = None
        if self._writer is not None:
            schema = self._writer.schema
            for _, frame in self._waiting:
                self.left_out |= frame.further.keys() - set(schema.names)
        try:
            return _table(self._waiting, schema)
        except pa.ArrowException as error:
            raise InputError(
                "{}: a further column changes its type on the way: {}",
                self._place,
                error,
                hint="convert the inputs one by one",
            ) from error


def parquet_options(names: Sequence[str]) -> dict[str, Any]:
    """Return pyarrow's options for writing these columns: small, and fast to read."""
    # Times and the sensor's marks repeat, coordinates hardly do: all but their first byte is noise,
    # of which LZ4 leaves 4 % more than zstd, and is read twice as fast.
    return {
        "compression": {name: "lz4" if name in _CORE else "zstd" for name in names},
        "compression_level": {name: 1 for name in names if name not in _CORE} or None,
        "use_dictionary": [name for name in names if name not in _CORE],
        "column_encoding": dict.fromkeys(_CORE, "BYTE_STREAM_SPLIT"),
        "write_page_checksum": True,
    }


def _measures_elevation(frames: list[Frame]) -> bool | None:
    """Return whether detections have heights; None without detections."""
    heights = np.concatenate([frame.points[:, 2] for frame in frames])
    given = heights[np.isfinite(heights)]
    if len(given) == 0:
        return None if len(heights) == 0 else False
    return constant_value(given, _LEAST_LEVEL) != 0.0


def _table(timed: list[tuple[float, Frame]], schema: pa.Schema | None) -> pa.Table:
    """Return frames as rows; one without detections is a row of NaN."""
    frames = [frame for _, frame in timed]
    rows = [max(len(frame), 1) for frame in frames]
    points = np.concatenate([frame.points if len(frame) else _NOWHERE for frame in frames])
    columns: dict[str, pa.Array] = {
        "time": pa.array(np.repeat([time for time, _ in timed], rows)),
        **{axis: pa.array(points[:, number]) for number, axis in enumerate("xyz")},
    }
    for name in _CORE[3:]:
        parts = [getattr(frame, name) if len(frame) else _UNKNOWN for frame in frames]
        columns[name] = pa.array(np.concatenate(parts).astype(np.float32, copy=False))
    kinds = _kinds(frames) if schema is None else {f.name: f.type for f in schema}
    for name, kind in kinds.items():
        if name not in columns:
            parts = [frame.further.get(name) if len(frame) else None for frame in frames]
            columns[name] = _further(parts, rows, kind)
    return pa.table(columns)


def _kinds(frames: list[Frame]) -> dict[str, pa.DataType]:
    """Return the type of each further column, from the first frame that has it."""
    kinds: dict[str, pa.DataType] = {}
    for frame in frames:
        for name, values in frame.further.items():
            if name not in kinds:
                kinds[name] = pa.string() if values.dtype == object else pa.array(values[:0]).type
    return kinds


def _further(parts: list[Column | None], rows: list[int], kind: pa.DataType) -> pa.ChunkedArray:
    """Return a further column of frames; NaN or null for the rows of a frame without it."""
    if pa.types.is_floating(kind):
        dtype = kind.to_pandas_dtype()
        filled = [
            np.full(count, np.nan, dtype) if part is None else part.astype(dtype, copy=False)
            for part, count in zip(parts, rows, strict=True)
        ]
        return pa.chunked_array([pa.array(np.concatenate(filled))])
    return pa.chunked_array(
        [
            pa.nulls(count, kind) if part is None else pa.array(part).cast(kind)
            for part, count in zip(parts, rows, strict=True)
        ]
    )
