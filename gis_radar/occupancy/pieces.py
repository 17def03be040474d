"""Pieces of a recording that hold whole frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pyarrow as pa

from gis_radar.arrays import Booleans
from gis_radar.detections import Detections

MOST_WAITING = 1 << 21
NO_FURTHER = pa.RecordBatch.from_pydict({})


def whole_frames(pieces: Iterator[Detections]) -> Iterator[Detections]:
    """Cut pieces at the borders of frames, so that none is split; further columns go.

    A frame of over two million rows is no frame of a radar, and is passed on in parts.
    """
    waiting: Detections | None = None
    for piece in pieces:
        rows = replace(piece, further=NO_FURTHER)
        joined = rows if waiting is None else _joined(waiting, rows)
        cut = int(np.searchsorted(joined.time, joined.time[-1], side="left"))
        if cut == 0 and len(joined) > MOST_WAITING:
            cut = len(joined)
        if cut:
            yield rows_of(joined, slice(0, cut))
        waiting = rows_of(joined, slice(cut, None))
    if waiting is not None and len(waiting):
        yield waiting


def _joined(one: Detections, other: Detections) -> Detections:
    return Detections(
        time=np.concatenate([one.time, other.time]),
        points=np.concatenate([one.points, other.points]),
        range_rate=np.concatenate([one.range_rate, other.range_rate]),
        rcs=np.concatenate([one.rcs, other.rcs]),
        further=NO_FURTHER,
    )


def rows_of(rows: Detections, part: slice | Booleans) -> Detections:
    """Return some of the rows, without further columns."""
    return Detections(
        time=rows.time[part],
        points=rows.points[part],
        range_rate=rows.range_rate[part],
        rcs=rows.rcs[part],
        further=NO_FURTHER,
    )
