"""Sorted tables at large: streams of rows in pieces of bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Integers
from gis_radar.errors import InputError, first_line
from gis_radar.measures.rows import Rows, distinct

CHECKED = {"page_checksum_verification": True}
SETS_LEVEL = 3  # of zstd: at 9 sets of tiles are 0.3 % smaller and take three times as long


@contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Raise what cannot be read of a Parquet file as an InputError."""
    try:
        yield
    except (pa.ArrowException, OSError, KeyError) as error:  # a column that is a list is not found
        raise InputError(f"{path}: damaged: {first_line(error)}") from error


def merge_streams(streams: Sequence[Iterator[Rows]], columns: int) -> Iterator[Rows]:
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
class StreamTable:
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
        """Write a stream of rows; arguments as of :class:`StreamTableWriter`."""
        with StreamTableWriter(self, path, fingerprint, sensors) as writer:
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
            damage_named(path),
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


class StreamTableWriter:
    """A sorted table that is written as rows come.

    Parameters
    ----------
    table : StreamTable
        Its kind.
    path : Path
        The file.
    fingerprint : str
        Of the tiles, for the file's metadata.
    sensors : sequence of str
        The names behind the numbers of a column of names.
    """

    def __init__(
        self, table: StreamTable, path: Path, fingerprint: str, sensors: Sequence[str] = ()
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


def merge_distinct(streams: Sequence[Iterator[Rows]], columns: int) -> Iterator[Rows]:
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
    for rows in merge_streams(streams, columns):
        yield distinct(*rows)
