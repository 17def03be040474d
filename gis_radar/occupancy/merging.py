"""Merging of streams whose first column ascends, in pieces of bounded size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gis_radar.arrays import Integers

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
