"""Hits: streams of (step, tile) pairs, each pair once, ascending, in pieces of bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Integers
from gis_radar.errors import InputError

ROWS_AT_ONCE = 1 << 18
ROWS_IN_GROUP = 1 << 20
SCHEMA = pa.schema([("step", pa.int64()), ("tile_id", pa.int64())])

Hits = tuple[Integers, Integers]


def unique_hits(step: Integers, tile: Integers) -> Hits:
    """Return each pair once, ascending by step, then by tile."""
    order = np.lexsort((tile, step))
    step, tile = step[order], tile[order]
    fresh = np.ones(len(step), dtype=np.bool_)
    fresh[1:] = (np.diff(step) != 0) | (np.diff(tile) != 0)
    return step[fresh], tile[fresh]


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
    heads = [_Head(stream) for stream in streams]
    while heads := [head for head in heads if head.more()]:
        # Up to here every stream is known; what lies later waits.
        bound = min(head.known_until for head in heads)
        taken = [head.take(bound) for head in heads]
        step, tile = (np.concatenate(column) for column in zip(*taken, strict=True))
        if len(step):
            yield unique_hits(step, tile)


class _Head:
    """What has been read of one stream and not yet been taken."""

    def __init__(self, stream: Iterator[Hits]) -> None:
        self._stream = stream
        self._step = self._tile = np.empty(0, np.int64)
        self._ended = False

    def more(self) -> bool:
        """Read on until something is surely complete; tell whether anything is left."""
        while not self._ended and (len(self._step) == 0 or self._step[0] > self.known_until):
            step, tile = next(self._stream, (None, None))
            if step is None or tile is None:
                self._ended = True
            else:
                self._step = np.concatenate([self._step, step])
                self._tile = np.concatenate([self._tile, tile])
        return len(self._step) > 0

    @property
    def known_until(self) -> int:
        """The last step of which nothing more can come."""
        return int(self._step[-1]) - (0 if self._ended else 1)

    def take(self, bound: int) -> Hits:
        """Take away all up to and with the step `bound`."""
        cut = int(np.searchsorted(self._step, bound, side="right"))
        taken = self._step[:cut], self._tile[:cut]
        self._step, self._tile = self._step[cut:], self._tile[cut:]
        return taken


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
