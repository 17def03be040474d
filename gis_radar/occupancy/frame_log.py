"""Frames of a recording, and the frame log: one row a frame, the evidence of data quality.

A set of rows, like all tables of an occupancy: it merges exactly, in any order and split between
frames, and repetition changes nothing. Of two rows for one frame the greater one stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.occupancy.hits import Rows, SortedTable, fresh, merge_ascending
from gis_radar.occupancy.settings import OccupancySettings
from gis_radar.recordings.recording import Detections

FILE = "deliveries.parquet"
COLUMNS = (
    "time_us", "sensor", "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum",
    "shift_us",
)  # fmt: skip
FRAME_LOG = SortedTable(
    schema=pa.schema([(n, pa.string() if n == "sensor" else pa.int64()) for n in COLUMNS]),
    rows_at_once=1 << 16,
    rows_in_group=1 << 16,
)
OWN_COLUMNS, NO_FURTHER = ("time", "points", "range_rate", "rcs"), pa.RecordBatch.from_pydict({})


def whole_frames(pieces: Iterator[Detections]) -> Iterator[Detections]:
    """Cut pieces at the borders of frames, so that none is split; further columns are dropped."""
    waiting: Detections | None = None
    for piece in pieces:
        joined = replace(piece, further=NO_FURTHER) if waiting is None else _joined(waiting, piece)
        cut = int(np.searchsorted(joined.time, joined.time[-1], side="left"))
        if cut:
            yield rows_of(joined, slice(0, cut))
        waiting = rows_of(joined, slice(cut, None))
    if waiting is not None and len(waiting):
        yield waiting


def _joined(one: Detections, other: Detections) -> Detections:
    columns = {n: np.concatenate([getattr(one, n), getattr(other, n)]) for n in OWN_COLUMNS}
    return Detections(**columns, further=NO_FURTHER)


def rows_of(rows: Detections, part: slice | Booleans) -> Detections:
    """Return some of the rows, without further columns."""
    columns = {name: getattr(rows, name)[part] for name in OWN_COLUMNS}
    return Detections(**columns, further=NO_FURTHER)


@dataclass(frozen=True, kw_only=True)
class FrameIndex:
    """The frames of a piece of a recording: their times, and the rows of each.

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
        """Find the frames of rows with the given times, ascending."""
        new = fresh(time)
        begins = np.flatnonzero(new)
        return cls(time=time[begins], begins=begins, of_row=np.cumsum(new) - 1)

    @property
    def time_us(self) -> Integers:
        """Time of each frame in microseconds."""
        return np.rint(self.time * 1e6).astype(np.int64)

    def count(self, flags: Booleans) -> Integers:
        """Return for each frame how many of its rows have a flag set."""
        return np.add.reduceat(flags.astype(np.int64), self.begins)


def frame_rows(
    piece: Detections, frames: FrameIndex, tiles_hit: Integers, tiles_seen: Integers,
    shift_us: Integers, settings: OccupancySettings,
) -> Rows:  # fmt: skip
    """Return the rows of the log for the frames of a piece, in the order of `COLUMNS`.

    Parameters
    ----------
    piece, frames : Detections, FrameIndex
        Whole frames of one sensor, and where each begins.
    tiles_hit, tiles_seen : (f,) int64 arrays
        Tiles hit by each frame, and tiles that its view sees.
    shift_us : (n,) int64 array
        Microseconds added to the time of each row by the correction of the clock.
    settings : OccupancySettings
        From which speeds on a detection moves, or cannot be a vehicle.
    """
    speed = np.abs(piece.range_rate)
    return (
        frames.time_us,
        np.zeros(len(frames.time), np.int64),
        frames.count(piece.present),
        frames.count(speed >= settings.moving_mps),
        frames.count(speed > settings.wild_mps),
        tiles_hit,
        tiles_seen,
        position_sums(piece.points, frames.begins),
        shift_us[frames.begins],
    )


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


def merge_frame_logs(streams: Sequence[Iterator[Rows]]) -> Iterator[Rows]:
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
