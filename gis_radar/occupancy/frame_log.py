"""Deliveries: one row a frame of a sensor, what it brought: the evidence of data quality.

A set of rows, like all tables of an occupancy: it merges exactly, in any order and split between
frames, and repetition changes nothing. Of two rows for one frame the greater one stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Floats, Integers
from gis_radar.errors import InputError
from gis_radar.occupancy.hits import Rows, merge_ascending

FILE = "deliveries.parquet"
MOVING_MPS = 0.5
WILD_MPS = 70.0
COLUMNS = (
    "time_us", "sensor", "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum",
    "shift_us",
)  # fmt: skip
SCHEMA = pa.schema([(name, pa.string() if name == "sensor" else pa.int64()) for name in COLUMNS])
ROWS_AT_ONCE = 1 << 16
ROWS_IN_GROUP = 1 << 16


def position_sums(points: Floats, begins: Integers) -> Integers:
    """Return a 16-bit sum over the positions of each frame: alike for frames that repeat.

    Parameters
    ----------
    points : (n, 3) array
        Sensor frame, metres.
    begins : (f,) int64 array
        The first row of each frame.
    """
    ahead, left = (points[:, i].astype(np.float32).view(np.uint32) for i in (0, 1))
    bits = ahead.astype(np.int64) + left
    return np.add.reduceat(bits, begins) % 65521 if len(begins) else begins


def merge_deliveries(streams: Sequence[Iterator[Rows]]) -> Iterator[Rows]:
    """Merge streams of rows into one that holds each frame of each sensor once.

    Parameters
    ----------
    streams : sequence of iterators of rows
        Arrays in the order of `COLUMNS`, the sensor as a number; ascending by time.
    """
    for rows in merge_ascending(streams, len(COLUMNS)):
        time, sensor = rows[:2]
        order = np.lexsort((sensor, time))
        if np.any((np.diff(time[order]) == 0) & (np.diff(sensor[order]) == 0)):
            order = np.lexsort((*rows[:1:-1], sensor, time))
        time, sensor = time[order], sensor[order]
        last = np.ones(len(order), np.bool_)
        last[:-1] = (np.diff(time) != 0) | (np.diff(sensor) != 0)
        yield tuple(column[order[last]] for column in rows)


class DeliveryWriter:
    """Writes the table as rows come; equal rows give equal files.

    Parameters
    ----------
    path : Path
        The file.
    sensors : sequence of str
        The names behind the numbers of the column `sensor`.
    fingerprint : str
        Of the tiles.
    """

    def __init__(self, path: Path, sensors: Sequence[str], fingerprint: str) -> None:
        self.path = path
        self._names = np.array(sensors, dtype=object)
        self._schema = SCHEMA.with_metadata({"fingerprint": fingerprint})
        self._waiting: list[pa.RecordBatch] = []

    def __enter__(self) -> Self:
        self._writer = pq.ParquetWriter(
            self.path,
            self._schema,
            compression="zstd",
            use_dictionary=["sensor"],
            column_encoding={n: "DELTA_BINARY_PACKED" for n in COLUMNS if n != "sensor"},
            write_page_checksum=True,
        )
        return self

    def add(self, *columns: Integers) -> None:
        """Add rows: arrays in the order of `COLUMNS`, the sensor as a number."""
        arrays = [pa.array(column, pa.int64()) for column in columns]
        arrays[1] = pa.array(self._names[columns[1]], pa.string())
        self._waiting.append(pa.record_batch(arrays, schema=SCHEMA))
        # Row groups of one size, whatever the pieces: the file tells nothing of them.
        while sum(map(len, self._waiting)) >= ROWS_IN_GROUP:
            table = pa.Table.from_batches(self._waiting)
            self._writer.write_table(table.slice(0, ROWS_IN_GROUP), row_group_size=ROWS_IN_GROUP)
            self._waiting = table.slice(ROWS_IN_GROUP).to_batches()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            rest = pa.Table.from_batches(self._waiting, SCHEMA)
            self._writer.write_table(rest, row_group_size=ROWS_IN_GROUP)
        self._writer.close()


def write_deliveries(
    rows: Iterator[Rows], path: Path, sensors: Sequence[str], fingerprint: str
) -> None:
    """Write the table from a stream of rows."""
    with DeliveryWriter(path, sensors, fingerprint) as writer:
        for piece in rows:
            writer.add(*piece)


def read_deliveries(path: Path, sensors: Sequence[str]) -> Iterator[Rows]:
    """Read the table piece by piece; nothing where there is no such file.

    Parameters
    ----------
    path : Path
        The table.
    sensors : sequence of str
        All sensors, which give the numbers.

    Raises
    ------
    InputError
        If the file is damaged, lacks a column, or its times do not ascend.
    """
    if not path.is_file():
        return
    numbers = {name: number for number, name in enumerate(sensors)}
    last = -np.inf
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            if lacking := [name for name in COLUMNS if name not in file.schema_arrow.names]:
                raise InputError(f"{path}: lacks the column {lacking[0]}")
            for batch in file.iter_batches(ROWS_AT_ONCE, columns=list(COLUMNS), use_threads=False):
                rows = _numbered(batch, numbers, path)
                if np.any(np.diff(rows[0], prepend=last) < 0):
                    raise InputError(f"{path}: times do not ascend")
                last = rows[0][-1] if len(batch) else last
                yield rows
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: damaged: {str(error).splitlines()[0]}") from error


def _numbered(batch: pa.RecordBatch, numbers: dict[str, int], path: Path) -> Rows:
    coded = batch.column("sensor").dictionary_encode()
    names = coded.dictionary.to_pylist()
    if unknown := [name for name in names if name not in numbers]:
        raise InputError(f"{path}: names the sensor {unknown[0]}, which has no frames")
    code = np.array([numbers[name] for name in names], np.int64)
    rows = [
        np.asarray(batch.column(name).to_numpy(zero_copy_only=False), np.int64)
        for name in COLUMNS
        if name != "sensor"
    ]
    return rows[0], code[coded.indices.to_numpy()], *rows[1:]
