"""Hits: streams of (step, tile) pairs, each pair once, ascending, in pieces of bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Booleans, Integers
from gis_radar.errors import InputError

Rows = tuple[Integers, ...]


def merge_ascending(streams: Sequence[Iterator[Rows]], columns: int) -> Iterator[Rows]:
    """Bring the rows of all streams together, piece by piece, up to a common bound.

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
        # Up to here every stream is known; what lies later waits.
        bound = min(head.known_until for head in heads)
        taken = [head.take(bound) for head in heads]
        joined = tuple(np.concatenate(column) for column in zip(*taken, strict=True))
        if len(joined[0]):
            yield joined


class _Head:
    """What has been read of one stream and not yet been taken."""

    def __init__(self, stream: Iterator[Rows], columns: int) -> None:
        self._stream = stream
        self._rows: Rows = tuple(np.empty(0, np.int64) for _ in range(columns))
        self._ended = False

    def more(self) -> bool:
        """Read on until something is surely complete; tell whether anything is left."""
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
        """Take away all up to and with the value `bound`."""
        cut = int(np.searchsorted(self._rows[0], bound, side="right"))
        taken = tuple(column[:cut] for column in self._rows)
        self._rows = tuple(column[cut:] for column in self._rows)
        return taken


ROWS_AT_ONCE = 1 << 18
ROWS_IN_GROUP = 1 << 20
MOST_KEYS = 1 << 62
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
        step, tile = np.divmod(keys[_fresh(keys)], tiles)
        return step + low, tile
    order = np.lexsort((tile, step))
    step, tile = step[order], tile[order]
    fresh = _fresh(step) | _fresh(tile)
    return step[fresh], tile[fresh]


def _fresh(ordered: Integers) -> Booleans:
    """Tell which values differ from the one before."""
    fresh = np.ones(len(ordered), dtype=np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=fresh[1:])
    return fresh


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
        If the file is damaged or its steps do not ascend.
    """
    last = -np.inf
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            for batch in file.iter_batches(ROWS_AT_ONCE, columns=SCHEMA.names, use_threads=False):
                step, tile = (column.to_numpy(zero_copy_only=False) for column in batch.columns)
                if np.any(np.diff(step, prepend=last) < 0):
                    raise InputError(f"{path}: steps do not ascend")
                last = step[-1] if len(step) else last
                yield step, tile
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: damaged: {str(error).splitlines()[0]}") from error


def write_hits(hits: Iterator[Hits], path: Path, *, fingerprint: str) -> None:
    """Write the table `hits.parquet`, with the tiles' fingerprint; equal hits give equal files."""
    waiting: list[pa.RecordBatch] = []
    with pq.ParquetWriter(
        path,
        SCHEMA.with_metadata({"fingerprint": fingerprint}),
        compression="zstd",
        use_dictionary=False,
        column_encoding=dict.fromkeys(SCHEMA.names, "DELTA_BINARY_PACKED"),
        write_page_checksum=True,
    ) as writer:
        for step, tile in hits:
            waiting.append(pa.record_batch([step, tile], schema=SCHEMA))
            # Row groups of one size, whatever the pieces: the file tells nothing of them.
            while sum(map(len, waiting)) >= ROWS_IN_GROUP:
                table = pa.Table.from_batches(waiting)
                writer.write_table(table.slice(0, ROWS_IN_GROUP), row_group_size=ROWS_IN_GROUP)
                waiting = table.slice(ROWS_IN_GROUP).to_batches()
        writer.write_table(pa.Table.from_batches(waiting, SCHEMA), row_group_size=ROWS_IN_GROUP)
