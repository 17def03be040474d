"""Hits, and sorted tables at large: streams of rows in pieces of bounded size.

Hits are pairs (step, tile), each once, ascending.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.errors import InputError

Rows = tuple[Integers, ...]


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


class SortedTableWriter:
    """A Parquet file that is written as rows come; equal rows give equal files.

    Parameters
    ----------
    path : Path
        The file.
    schema : pyarrow.Schema
        Its columns; integers are stored as differences.
    fingerprint : str
        Of the tiles, for the file's metadata.
    rows_in_group : int
        Rows of a row group, whatever the pieces: the file does not depend on them.
    names : sequence of str
        Columns of few different texts.
    """

    def __init__(
        self, path: Path, schema: pa.Schema, *, fingerprint: str, rows_in_group: int,
        names: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._schema, self._rows_in_group = schema, rows_in_group
        self._waiting: list[pa.RecordBatch] = []
        self._writer = pq.ParquetWriter(
            path,
            schema.with_metadata({"fingerprint": fingerprint}),
            compression="zstd",
            use_dictionary=list(names) or False,
            column_encoding={n: "DELTA_BINARY_PACKED" for n in schema.names if n not in names},
            write_page_checksum=True,
        )

    def __enter__(self) -> Self:
        return self

    def add(self, rows: pa.RecordBatch) -> None:
        """Add rows that follow those so far."""
        self._waiting.append(rows)
        while sum(map(len, self._waiting)) >= self._rows_in_group:
            table = pa.Table.from_batches(self._waiting)
            self._write(table.slice(0, self._rows_in_group))
            self._waiting = table.slice(self._rows_in_group).to_batches()

    def _write(self, table: pa.Table) -> None:
        self._writer.write_table(table, row_group_size=self._rows_in_group)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._write(pa.Table.from_batches(self._waiting, self._schema))
        self._writer.close()


def read_ascending(path: Path, columns: Sequence[str], rows: int) -> Iterator[pa.RecordBatch]:
    """Read a sorted table piece by piece.

    Parameters
    ----------
    path : Path
        The table.
    columns : sequence of str
        Which columns, the one that it is sorted by first.
    rows : int
        Rows of a piece.

    Raises
    ------
    InputError
        If the file is damaged, lacks a column, or its first column does not ascend.
    """
    last = -np.inf
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            if lacking := [name for name in columns if name not in file.schema_arrow.names]:
                raise InputError(f"{path}: lacks the column {lacking[0]}")
            for batch in file.iter_batches(rows, columns=list(columns), use_threads=False):
                first = batch.column(columns[0]).to_numpy(zero_copy_only=False)
                if np.any(np.diff(first, prepend=last) < 0):
                    raise InputError(f"{path}: rows do not ascend by {columns[0]}")
                last = first[-1] if len(first) else last
                yield batch
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: damaged: {str(error).splitlines()[0]}") from error


ROWS_AT_ONCE = 1 << 18  # 4 MiB
ROWS_IN_GROUP = 1 << 20
MOST_KEYS = 1 << 62  # a pair as one int64
SCHEMA = pa.schema([("step", pa.int64()), ("tile_id", pa.int64())])

Hits = tuple[Integers, Integers]


def distinct(step: Integers, tile: Integers) -> Hits:
    """Return each pair of two columns once, ascending by the first, then by the second."""
    if len(step) == 0:
        return step, tile
    low, tiles = int(step.min()), int(tile.max()) + 1
    if int(tile.min()) >= 0 and (int(step.max()) - low + 1) * tiles < MOST_KEYS:
        # One number a pair sorts several times faster than two columns.
        keys = np.sort((step - low) * tiles + tile)
        step, tile = np.divmod(keys[fresh(keys)], tiles)
        return step + low, tile
    order = np.lexsort((tile, step))
    step, tile = step[order], tile[order]
    new = fresh(step) | fresh(tile)
    return step[new], tile[new]


def fresh(values: Integers | Floats) -> Booleans:
    """Return which values differ from the one before; the first one does."""
    differs = np.ones(len(values), dtype=np.bool_)
    np.not_equal(values[1:], values[:-1], out=differs[1:])
    return differs


def merge_hits(streams: Sequence[Iterator[Hits]]) -> Iterator[Hits]:
    """Merge streams into one that holds each of their pairs once.

    Parameters
    ----------
    streams : sequence of iterators of (step, tile)
        Each ascending by step; a step may go on in the next piece.

    Yields
    ------
    step, tile : (k,) int64 arrays
        No step is split between two pieces.
    """
    for step, tile in merge_ascending(streams, 2):
        yield distinct(step, tile)


def read_hits(path: Path) -> Iterator[Hits]:
    """Read the table `hits.parquet` piece by piece.

    Raises
    ------
    InputError
        If the file is damaged, lacks a column, or its steps do not ascend.
    """
    for batch in read_ascending(path, SCHEMA.names, ROWS_AT_ONCE):
        step, tile = (batch.column(n).to_numpy(zero_copy_only=False) for n in SCHEMA.names)
        yield step, tile


def write_hits(hits: Iterator[Hits], path: Path, *, fingerprint: str) -> None:
    """Write the table `hits.parquet`, with the tiles' fingerprint; equal hits give equal files."""
    with SortedTableWriter(
        path, SCHEMA, fingerprint=fingerprint, rows_in_group=ROWS_IN_GROUP
    ) as writer:
        for step, tile in hits:
            writer.add(pa.record_batch([step, tile], schema=SCHEMA))
