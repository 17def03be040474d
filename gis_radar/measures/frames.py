"""Frames of a recording: batches of whole frames, and the rows of each frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.recordings import Detections

_OWN_COLUMNS, NO_FURTHER = ("time", "points", "range_rate", "rcs"), pa.RecordBatch.from_pydict({})


def whole_frames(batches: Iterator[Detections]) -> Iterator[Detections]:
    """Yield batches cut at borders of frames, so that none is split; drop further columns."""
    waiting: Detections | None = None
    for batch in batches:
        joined = replace(batch, further=NO_FURTHER) if waiting is None else _joined(waiting, batch)
        cut = int(np.searchsorted(joined.time, joined.time[-1], side="left"))
        if cut:
            yield rows_of(joined, slice(0, cut))
        waiting = rows_of(joined, slice(cut, None))
    if waiting is not None and len(waiting):
        yield waiting


def _joined(first: Detections, second: Detections) -> Detections:
    columns = {n: np.concatenate([getattr(first, n), getattr(second, n)]) for n in _OWN_COLUMNS}
    return Detections(**columns, further=NO_FURTHER)


def rows_of(rows: Detections, which: slice | Booleans) -> Detections:
    """Return some of the rows, without further columns."""
    columns = {name: getattr(rows, name)[which] for name in _OWN_COLUMNS}
    return Detections(**columns, further=NO_FURTHER)


@dataclass(frozen=True, kw_only=True)
class FrameIndex:
    """The frames of a batch of a recording: their times, and the rows of each.

    Parameters
    ----------
    time : (f,) array
        UNIX seconds, corrected.
    begins : (f,) int64 array
        The first row of each frame.
    of_row : (n,) int64 array
        The frame of each row.
    """

    time: Floats
    begins: Integers
    of_row: Integers

    @classmethod
    def of(cls, time: Floats) -> FrameIndex:
        """Return the frames of rows with these times, which ascend."""
        new = np.diff(time, prepend=-np.inf) != 0.0
        begins = np.flatnonzero(new)
        return cls(time=time[begins], begins=begins, of_row=np.cumsum(new) - 1)

    @property
    def time_us(self) -> Integers:
        """Time of each frame in microseconds."""
        return np.rint(self.time * 1e6).astype(np.int64)

    def count(self, flags: Booleans) -> Integers:
        """Return, for each frame, the number of its rows with a flag set."""
        return np.add.reduceat(flags.astype(np.int64), self.begins)
