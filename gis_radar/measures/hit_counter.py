"""Count hits batch by batch: of a whole recording, or of single frames in the live system."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats, InputError, Integers, contiguous
from gis_radar.hdmap import Numbers, TileGrid
from gis_radar.measures.counting_loop import (
    COUNTS,
    DETECTIONS,
    FILLED_FRAMES,
    FILLED_HITS,
    FRAME_COLUMNS,
    MOVING,
    TILES_HIT,
    TIME_US,
    WILD,
    Accumulator,
    CountBuffer,
    Limits,
    RowColumns,
    TileIndex,
    count_rows,
    end_frame,
)
from gis_radar.measures.filters import Filters
from gis_radar.measures.placing import PoseNumbers
from gis_radar.poses import Pose
from gis_radar.recordings import Detections, RangeCounts
from gis_radar.scans import SightTiles

_ROOM_FRAMES, _ROOM_HITS = 1 << 12, 1 << 18  # sizes of the buffers: 224 KiB, 1 MiB
NO_TILES: Integers = np.empty(0, np.int64)


@dataclass(frozen=True, kw_only=True)
class Counted:
    """Complete frames, and the tiles that they hit.

    Parameters
    ----------
    frames : (f, 7) int64 array
        A row a frame, with the columns of :mod:`gis_radar.measures.counting_loop`.
    tile : (k,) int32 array
        Positions of the tiles hit, `TILES_HIT` for each frame, each once in it.
    """

    frames: Integers
    tile: Numbers


class HitCounter:
    """Counter of the tiles that the frames of one sensor hit, batch by batch.

    Parameters
    ----------
    tiles : SightTiles
        All tiles.
    grid : TileGrid
        Grid of the same tiles.
    filters : Filters
        Filters for the detections that count.
    ranges : RangeCounts, optional
        Receives the ranges of all detections.
    """

    def __init__(
        self,
        tiles: SightTiles,
        grid: TileGrid,
        *,
        filters: Filters | None = None,
        ranges: RangeCounts | None = None,
    ) -> None:
        count = len(tiles.tile_id)
        self._index = TileIndex(np.ascontiguousarray(tiles.height), grid.cells)
        self._limits = limits_of(filters or Filters())
        self._sums = Accumulator(
            counts=np.zeros(COUNTS, np.int64),
            time=np.array([math.nan]),
            frame=np.zeros(FRAME_COLUMNS, np.int64),
            of_frame=np.zeros(count, np.int64),
            moved=np.zeros(count, np.int64),
            inside=np.empty(grid.most_in_a_cell + 1, np.int64),
            ranges=(ranges or RangeCounts()).counts,
            movement=NO_TILES,
        )
        self._buffer = CountBuffer(
            frames=np.empty((_ROOM_FRAMES, FRAME_COLUMNS), np.int64),
            tile=np.empty(_ROOM_HITS + count + 1, np.int32),
        )

    def add(
        self,
        rows: RowColumns,
        begin: int,
        end: int,
        placing: PoseNumbers,
        *,
        movement: Integers = NO_TILES,
    ) -> Iterator[Counted]:
        """Count rows that follow those so far, from one pose; times are finite and ascend.

        Parameters
        ----------
        rows : RowColumns
            Columns of a recording.
        begin, end : int
            Range of the rows to count.
        placing : PoseNumbers
            The pose.
        movement : (n,) int64 array, optional
            Changed in place: a tile's number grows by one for each frame with movement on it.

        Yields
        ------
        Counted
            Complete frames, each time the buffers are full.
        """
        sums = self._sums._replace(movement=movement)
        while True:
            begin = count_rows(
                rows, begin, end, placing, self._limits, self._index, sums, self._buffer
            )
            if begin == end:
                return
            yield self._emptied_buffers()

    def end(self) -> Counted:
        """Close the open frame; return the frames that :meth:`add` has not yielded."""
        end_frame(self._sums, self._buffer)
        return self._emptied_buffers()

    def _emptied_buffers(self) -> Counted:
        """Return a copy of the frames in the buffers, and empty the buffers."""
        frames, hits = self._sums.counts[[FILLED_FRAMES, FILLED_HITS]].tolist()
        self._sums.counts[[FILLED_FRAMES, FILLED_HITS]] = 0
        return Counted(
            frames=self._buffer.frames[:frames].copy(), tile=self._buffer.tile[:hits].copy()
        )


@dataclass(frozen=True, kw_only=True)
class CountedFrame:
    """One frame, and the tiles that it hits.

    Parameters
    ----------
    time_us : int
        Time, microseconds since the UNIX epoch.
    detections, moving, wild : int
        Numbers of detections, as in the table `frames`.
    tiles : (k,) int64 array
        Positions of the tiles that it hits, ascending.
    """

    time_us: int
    detections: int
    moving: int
    wild: int
    tiles: Integers


class FrameCounter:
    """Counter of the tiles that single frames hit, for a sensor's program in the live system.

    Parameters
    ----------
    tiles : SightTiles
        All tiles; :meth:`SightTiles.of` makes them from a table of tiles.
    grid : TileGrid, optional
        Grid of the same tiles, if it is made already.
    filters : Filters, optional
        Filters for the detections that count; without it, all do.
    """

    def __init__(
        self,
        tiles: SightTiles,
        *,
        grid: TileGrid | None = None,
        filters: Filters | None = None,
    ) -> None:
        grid = TileGrid(tiles.quads) if grid is None else grid
        self._counter = HitCounter(tiles, grid, filters=filters)

    def count(self, detections: Detections, pose: Pose | PoseNumbers) -> list[CountedFrame]:
        """Return frames with the tiles that they hit.

        Parameters
        ----------
        detections : Detections
            One or a few whole frames; a frame without detections is a row of NaN.
        pose : Pose or PoseNumbers
            Pose of the sensor; for many frames, make its numbers once.

        Raises
        ------
        InputError
            If a time is no number, or times go back.
        """
        time = np.asarray(detections.time, np.float64)
        if not (np.isfinite(time).all() and (time[1:] >= time[:-1]).all()):
            raise InputError("times of frames are not finite, or go back")
        rows = rows_of_detections(detections, time)
        numbers = PoseNumbers.of(pose) if isinstance(pose, Pose) else pose
        frames: list[CountedFrame] = []
        for counted in (*self._counter.add(rows, 0, len(time), numbers), self._counter.end()):
            begin = 0
            for frame in counted.frames.tolist():
                end = begin + frame[TILES_HIT]
                frames.append(
                    CountedFrame(
                        time_us=frame[TIME_US], detections=frame[DETECTIONS], moving=frame[MOVING],
                        wild=frame[WILD], tiles=np.sort(counted.tile[begin:end].astype(np.int64)),
                    )
                )  # fmt: skip
                begin = end
        return frames


def limits_of(filters: Filters) -> Limits:
    """Return the limits of the counting loop for some filters."""
    lowest_m, highest_m = filters.clearance or (math.nan, math.nan)
    return Limits(
        min_speed=_or_nan(filters.min_speed),
        min_rcs=_or_nan(filters.min_rcs),
        lowest_m=float(lowest_m),
        highest_m=float(highest_m),
        widening=filters.widening,
        level_m=float(filters.levels_apart_m),
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)


def rows_of_detections(
    detections: Detections, time: Floats, shift_us: Integers = NO_TILES
) -> RowColumns:
    """Return detections as rows for the counting loop, with corrected times and the corrections."""
    columns = *detections.points.T, detections.range_rate, detections.rcs
    numbers = (np.asarray(each, np.float64) for each in columns)
    return RowColumns(*map(contiguous, (time, shift_us, *numbers)))
