"""Hits, and sorted tables at large: streams of rows in pieces of bounded size.

Hits are rows (step, tile, sensor), each once, ascending; without their sensor, pairs. On
disk a row is a step of a sensor with the set of its tiles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.errors import InputError, first_line
from gis_radar.occupancy.tile_sets import decode_sets, encode_sets

Rows = tuple[Integers, ...]
CHECKED = {"page_checksum_verification": True}
SETS_LEVEL = 3  # of zstd: at 9 sets of tiles are 0.3 % smaller and take three times as long


@contextmanager
def damaged_as_input_error(path: Path) -> Iterator[None]:
    """Raise what cannot be read of a Parquet file as an InputError."""
    try:
        yield
    except (pa.ArrowException, OSError, KeyError) as error:  # a column that is a list is not found
        raise InputError(f"{path}: damaged: {first_line(error)}") from error


def merge_ascending(streams: Sequence[Iterator[Rows]], columns: int) -> Iterator[Rows]:
    """Merge the rows of all streams, piece by piece, up to a common bound.

    Parameters
    ----------
    streams : sequence of iterators of tuples of arrays
        Each ascends by its first column, also from piece to piece; a value of it may go on in
        the next piece.
    columns : int
        How many arrays a piece has.

    Yields
    ------
    tuple of (k,) int64 arrays
        Rows in no order, but every row comes before all later values of the first column: no
        value is split between two pieces.
    """
    heads = [_Head(stream, columns) for stream in streams]
    while heads := [head for head in heads if head.more()]:
        # Up to here every stream is known; later rows wait.
        bound = min(head.known_until for head in heads)
        taken = [head.take(bound) for head in heads]
        joined = tuple(np.concatenate(column) for column in zip(*taken, strict=True))
        if len(joined[0]):
            yield joined


class _Head:
    """Rows of one stream that were read and not yet taken."""

    def __init__(self, stream: Iterator[Rows], columns: int) -> None:
        self._stream = stream
        self._rows: Rows = tuple(np.empty(0, np.int64) for _ in range(columns))
        self._ended = False

    def more(self) -> bool:
        """Read on until some value is surely complete; return whether anything is left."""
        while not self._ended and (len(self._rows[0]) == 0 or self._rows[0][0] > self.known_until):
            piece = next(self._stream, None)
            if piece is None:
                self._ended = True
            else:
                self._rows = tuple(map(np.concatenate, zip(self._rows, piece, strict=True)))
        return len(self._rows[0]) > 0

    @property
    def known_until(self) -> int:
        """The last value of which nothing more can come."""
        return int(self._rows[0][-1]) - (0 if self._ended else 1)

    def take(self, bound: int) -> Rows:
        """Remove and return all rows up to and with the value `bound`."""
        cut = int(np.searchsorted(self._rows[0], bound, side="right"))
        taken = tuple(column[:cut] for column in self._rows)
        self._rows = tuple(column[cut:] for column in self._rows)
        return taken


@dataclass(frozen=True, kw_only=True)
class SortedTable:
    """A kind of Parquet file that is read and written piece by piece; equal rows, equal files.

    Parameters
    ----------
    schema : pyarrow.Schema
        Its columns, the one that it is sorted by first: integers, and names of sensors.
    rows_at_once : int
        Rows of a piece that is read.
    rows_in_group : int
        Rows of a row group, whatever the pieces written: the file does not depend on them.
    """

    schema: pa.Schema
    rows_at_once: int
    rows_in_group: int

    def write(
        self, rows: Iterator[Rows], path: Path, fingerprint: str, sensors: Sequence[str] = ()
    ) -> None:
        """Write a stream of rows; arguments as of :class:`SortedTableWriter`."""
        with SortedTableWriter(self, path, fingerprint, sensors) as writer:
            for piece in rows:
                writer.add(piece)

    def read(self, path: Path, sensors: Sequence[str] = ()) -> Iterator[Rows]:
        """Read a file piece by piece.

        Parameters
        ----------
        path : Path
            The file.
        sensors : sequence of str
            All sensors, which give the numbers that stand for their names.

        Raises
        ------
        InputError
            If the file is damaged, its first column does not ascend, or it names another sensor.
        """
        last, names = -np.inf, self.schema.names
        texts = [field.name for field in self.schema if pa.types.is_string(field.type)]
        with (
            damaged_as_input_error(path),
            pq.ParquetFile(path, read_dictionary=texts, **CHECKED) as file,
        ):
            for batch in file.iter_batches(self.rows_at_once, columns=names, use_threads=False):
                if empty := [each for each in names if batch.column(each).null_count]:
                    raise InputError(f"{path}: damaged: a value of {empty[0]} is missing")
                rows = tuple(_values(batch.column(name), sensors, path) for name in names)
                if np.any(np.diff(rows[0], prepend=last) < 0):
                    raise InputError(f"{path}: rows do not ascend by {names[0]}")
                last = rows[0][-1] if len(rows[0]) else last
                yield rows


def _values(column: pa.Array, sensors: Sequence[str], path: Path) -> Any:
    """Return a column as an array, names as their numbers; texts of bytes as they are."""
    if pa.types.is_dictionary(column.type) or pa.types.is_string(column.type):
        return _numbers_of(column, sensors, path)
    return column if pa.types.is_binary(column.type) else column.to_numpy(zero_copy_only=False)


def _numbers_of(column: pa.Array, sensors: Sequence[str], path: Path) -> Integers:
    coded = column.dictionary_encode()
    numbers = {name: number for number, name in enumerate(sensors)}
    names = coded.dictionary.to_pylist()
    if unknown := [name for name in names if name not in numbers]:
        raise InputError(f"{path}: names the sensor {unknown[0]}, which has no frames")
    of_name = np.array([numbers[name] for name in names], np.int64)
    return np.asarray(of_name[coded.indices.to_numpy()])


class SortedTableWriter:
    """A sorted table that is written as rows come.

    Parameters
    ----------
    table : SortedTable
        Its kind.
    path : Path
        The file.
    fingerprint : str
        Of the tiles, for the file's metadata.
    sensors : sequence of str
        The names behind the numbers of a column of names.
    """

    def __init__(
        self, table: SortedTable, path: Path, fingerprint: str, sensors: Sequence[str] = ()
    ) -> None:
        self.path = path
        self._table, self._names = table, pa.array(sensors, pa.string())
        self._waiting: list[pa.RecordBatch] = []
        texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
        sets = [field.name for field in table.schema if pa.types.is_binary(field.type)]
        encoding = dict.fromkeys(table.schema.names, "DELTA_BINARY_PACKED")
        encoding |= dict.fromkeys(sets, "DELTA_LENGTH_BYTE_ARRAY")
        self._writer = pq.ParquetWriter(
            path,
            table.schema.with_metadata({"fingerprint": fingerprint}),
            compression="zstd",
            compression_level=dict.fromkeys(sets, SETS_LEVEL) or None,
            use_dictionary=texts or False,
            column_encoding={name: encoding[name] for name in encoding if name not in texts},
            write_page_checksum=True,
        )

    def __enter__(self) -> Self:
        return self

    def add(self, rows: Rows) -> None:
        """Add rows that follow those so far: an array a column, names as their numbers."""
        arrays = [
            self._names.take(pa.array(values))
            if pa.types.is_string(field.type)
            else (values if isinstance(values, pa.Array) else pa.array(values, field.type))
            for values, field in zip(rows, self._table.schema, strict=True)
        ]
        self._waiting.append(pa.record_batch(arrays, schema=self._table.schema))
        size = self._table.rows_in_group
        while sum(map(len, self._waiting)) >= size:
            waiting = pa.Table.from_batches(self._waiting)
            self._writer.write_table(waiting.slice(0, size), row_group_size=size)
            self._waiting = waiting.slice(size).to_batches()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            rest = pa.Table.from_batches(self._waiting, self._table.schema)
            self._writer.write_table(rest, row_group_size=self._table.rows_in_group)
        self._writer.close()


PAIRS = SortedTable(
    schema=pa.schema([("step", pa.int64()), ("tile_id", pa.int64())]),
    rows_at_once=1 << 18,  # 4 MiB
    rows_in_group=1 << 20,
)
SETS = SortedTable(
    schema=pa.schema([("step", pa.int64()), ("sensor", pa.string()), ("tiles", pa.binary())]),
    rows_at_once=1 << 12,
    rows_in_group=1 << 14,
)
OLDER = replace(PAIRS, schema=PAIRS.schema.append(pa.field("sensor", pa.string())))
MOST_BYTES_AT_ONCE = 1 << 18  # of sets: a tile takes a byte at least
MOST_BYTES_OF_SET = 1 << 24  # sixteen million tiles: over any map's


class HitTable:
    """The hits on disk: a row a step and sensor, with its tiles as of `tile_sets`."""

    def columns(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the columns that a file needs that has some: it may be an older one."""
        return tuple((OLDER if "tile_id" in names else SETS).schema.names)

    def write(
        self, rows: Iterator[Rows], path: Path, fingerprint: str, sensors: Sequence[str]
    ) -> None:
        """Write a stream of rows (step, tile, sensor); arguments as of :class:`SortedTableWriter`.

        Rows ascend by step; within a step they come in any order, also repeated.
        """
        with SortedTableWriter(SETS, path, fingerprint, sensors) as writer:
            for step, tile, sensor in merge_ascending([rows], 3):
                writer.add(_as_sets(step, sensor, tile))

    def read(self, path: Path, sensors: Sequence[str]) -> Iterator[Rows]:
        """Read the rows (step, tile, sensor) of a file piece by piece, also of an older one.

        Parameters
        ----------
        path : Path
            The file.
        sensors : sequence of str
            All sensors, which give the numbers that stand for their names.

        Raises
        ------
        InputError
            If the file is damaged, its steps do not ascend, or it names another sensor.
        """
        with damaged_as_input_error(path):
            older = "tile_id" in pq.read_schema(path).names
        if older:
            yield from OLDER.read(path, sensors)
            return
        hits = (
            rows
            for step, sensor, sets in SETS.read(path, sensors)
            for rows in _out_of_sets(step, sensor, sets, path)
        )
        # A step's sets come by sensor, rows by tile.
        yield from merge_rows([hits], 3) if len(sensors) > 1 else hits


def _as_sets(step: Integers, sensor: Integers, tile: Integers) -> tuple[Any, ...]:
    """Return hits of whole steps as a row a step and sensor."""
    more = np.diff(step), np.diff(sensor), np.diff(tile)
    ascends = (more[0] > 0) | (more[0] == 0) & ((more[1] > 0) | (more[1] == 0) & (more[2] > 0))
    if not ascends.all():
        step, sensor, tile = distinct(step, sensor, tile)
    first = np.flatnonzero(fresh(step) | fresh(sensor))
    data, begins = encode_sets(tile, np.append(first, len(tile)))
    buffers = [None, pa.py_buffer(begins.astype(np.int32)), pa.py_buffer(data)]
    sets = pa.Array.from_buffers(pa.binary(), len(first), buffers)
    return step[first], sensor[first], sets


def _out_of_sets(
    step: Integers, sensor: Integers, sets: pa.BinaryArray, path: Path
) -> Iterator[Rows]:
    """Yield the hits of rows of sets, in pieces of bounded size."""
    _, offsets, data = sets.buffers()
    bounds = np.frombuffer(offsets, np.int32)[sets.offset : sets.offset + len(sets) + 1]
    begins = bounds.astype(np.int64)
    values = np.frombuffer(data or b"", np.uint8)
    if (longest := int(np.diff(begins).max(initial=0))) > MOST_BYTES_OF_SET:
        raise InputError(f"{path}: damaged: a set of tiles takes {longest:,} bytes")
    low = 0
    while low < len(sets):
        high = int(np.searchsorted(begins, begins[low] + MOST_BYTES_AT_ONCE, side="right")) - 1
        high = min(max(high, low + 1), len(sets))
        tile, at = decode_sets(values, begins[low : high + 1], what=str(path))
        count = np.diff(at)
        yield np.repeat(step[low:high], count), tile, np.repeat(sensor[low:high], count)
        low = high


HITS = HitTable()
MOST_KEYS = 1 << 62  # a row as one int64


def distinct(*columns: Integers) -> Rows:
    """Return each row of some columns once, ascending by the first, then by the second, ..."""
    if len(columns[0]) == 0:
        return columns
    lowest = [int(column.min()) for column in columns]
    sizes = [int(column.max()) - low + 1 for column, low in zip(columns, lowest, strict=True)]
    if math.prod(sizes) >= MOST_KEYS:
        order = np.lexsort(columns[::-1])
        columns = tuple(column[order] for column in columns)
        new = np.logical_or.reduce([fresh(column) for column in columns])
        return tuple(column[new] for column in columns)
    # One number a row sorts several times faster than columns.
    keys = columns[0] - lowest[0]
    for column, low, size in zip(columns[1:], lowest[1:], sizes[1:], strict=True):
        keys = keys * size + (column - low)
    keys.sort()
    keys = keys[fresh(keys)]
    found = []
    for low, size in zip(lowest[:0:-1], sizes[:0:-1], strict=True):
        keys, column = np.divmod(keys, size)
        found.append(column + low)
    return (keys + lowest[0], *reversed(found))


def fresh(values: Integers | Floats) -> Booleans:
    """Return which values differ from the one before; the first one does."""
    differs = np.ones(len(values), dtype=np.bool_)
    np.not_equal(values[1:], values[:-1], out=differs[1:])
    return differs


def merge_rows(streams: Sequence[Iterator[Rows]], columns: int) -> Iterator[Rows]:
    """Merge streams into one that holds each of their rows once, ascending.

    Parameters
    ----------
    streams : sequence of iterators of tuples of arrays
        Each ascending by its first column, a step; a step may go on in the next piece.
    columns : int
        How many arrays a piece has.

    Yields
    ------
    tuple of (k,) int64 arrays
        No step is split between two pieces.
    """
    for rows in merge_ascending(streams, columns):
        yield distinct(*rows)
