"""Count hits as rows of detections come: of a whole recording, or of a frame at a sensor."""

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
from gis_radar.measures.placing import Places, PoseNumbers
from gis_radar.poses import Pose
from gis_radar.recordings import Detections, RangeCounts
from gis_radar.scans import MOVEMENT_LEVEL_M, MOVEMENT_MPS, REFLECTION_M, SightTiles

ROOM_FRAMES, ROOM_HITS = 1 << 12, 1 << 18  # filled in at once; 224 KiB, 1 MiB
NO_TILES: Integers = np.empty(0, np.int64)
# For the frame log only: a detection moves from this absolute range rate on, over the Doppler noise
# of a radar (0.1 to 0.3 m/s) and of leaves; no vehicle is faster than 250 km/h.
MOVING_MPS, WILD_MPS = 0.5, 70.0


@dataclass(frozen=True, kw_only=True)
class Counted:
    """Frames that are complete, and the tiles that they hit.

    Parameters
    ----------
    frames : (f, 7) int64 array
        A row a frame; columns as of :mod:`gis_radar.measures.counting_loop`.
    tile : (k,) int32 array
        Positions of the tiles that each hits, `TILES_HIT` of a frame, each once.
    """

    frames: Integers
    tile: Numbers


class HitCounter:
    """Finds which tiles the frames of one sensor hit, as its rows come.

    Parameters
    ----------
    tiles : SightTiles
        All tiles.
    grid : TileGrid
        Of the same tiles.
    filters : Filters
        Which detections count.
    ranges : RangeCounts, optional
        Takes the ranges of all detections.
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
            places=Places.empty(),
            ranges=(ranges or RangeCounts()).counts,
            movement=NO_TILES,
        )
        self._buffer = CountBuffer(
            frames=np.empty((ROOM_FRAMES, FRAME_COLUMNS), np.int64),
            tile=np.empty(ROOM_HITS + count + 1, np.int32),
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
        """Count rows that follow those so far, seen from one pose; times are finite and ascend.

        Parameters
        ----------
        rows : RowColumns
            Columns of a recording.
        begin, end : int
            Which rows of them.
        placing : PoseNumbers
            The pose.
        movement : (n,) int64 array, optional
            Grows by one a frame for tiles on which something moves.

        Yields
        ------
        Counted
            What is complete, as often as there is no room for more.
        """
        sums = self._sums._replace(movement=movement)
        while True:
            begin = count_rows(
                rows, begin, end, placing, self._limits, self._index, sums, self._buffer
            )
            if begin == end:
                return
            yield self._taken()

    def end(self) -> Counted:
        """Close the open frame; return what :meth:`add` has not."""
        end_frame(self._sums, self._buffer)
        return self._taken()

    def _taken(self) -> Counted:
        """Return what was counted so far, and reset the buffers."""
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
        Microseconds since the UNIX epoch.
    detections, moving, wild : int
        As in the frame log.
    tiles : (k,) int64 array
        Positions of the tiles that it hits, ascending, as :func:`encode_tiles` takes them.
    """

    time_us: int
    detections: int
    moving: int
    wild: int
    tiles: Integers


class FrameCounter:
    """Finds the tiles that each frame hits, right when it comes: the edge's side.

    Parameters
    ----------
    tiles : SightTiles
        All tiles; :meth:`SightTiles.of` makes them from a table of tiles.
    grid : TileGrid, optional
        Of the same tiles, where there is one already.
    filters : Filters, optional
        Which detections count; without it, all.
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
            Where the sensor stands; of many frames its numbers are made once.

        Raises
        ------
        InputError
            If a time is no number, or times go back.
        """
        time = np.asarray(detections.time, np.float64)
        if not (np.isfinite(time).all() and (np.diff(time) >= 0.0).all()):
            raise InputError("times of frames are not finite, or go back")
        rows = rows_of_detections(detections)
        numbers = PoseNumbers.of(pose) if isinstance(pose, Pose) else pose
        counted = [*self._counter.add(rows, 0, len(time), numbers), self._counter.end()]
        frames = np.concatenate([each.frames for each in counted])
        tiles = np.concatenate([each.tile for each in counted]).astype(np.int64)
        begins = np.cumsum(frames[:, TILES_HIT])[:-1]
        return [
            CountedFrame(
                time_us=frame[TIME_US], detections=frame[DETECTIONS], moving=frame[MOVING],
                wild=frame[WILD], tiles=np.sort(hit),
            )
            for frame, hit in zip(frames.tolist(), np.split(tiles, begins), strict=True)
        ]  # fmt: skip


def limits_of(filters: Filters) -> Limits:
    """Return what the counting loop asks of a detection."""
    lowest_m, highest_m = filters.clearance or (math.nan, math.nan)
    return Limits(
        min_speed=_or_nan(filters.min_speed),
        min_rcs=_or_nan(filters.min_rcs),
        lowest_m=float(lowest_m),
        highest_m=float(highest_m),
        widening=filters.widening,
        level_m=float(filters.levels_apart_m),
        moving_mps=MOVING_MPS,
        wild_mps=WILD_MPS,
        sight_mps=MOVEMENT_MPS,
        sight_over_m=REFLECTION_M,
        sight_level_m=MOVEMENT_LEVEL_M,
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)


def rows_of_detections(detections: Detections) -> RowColumns:
    """Return detections as the counting loop takes them."""
    x, y, z = np.asarray(detections.points, np.float64).T
    return rows_of_columns(
        detections.time, x, y, z, np.asarray(detections.range_rate, np.float64),
        np.asarray(detections.rcs, np.float64),
    )  # fmt: skip


def rows_of_columns(
    time: Floats, x: Floats, y: Floats, z: Floats, range_rate: Floats, rcs: Floats,
    shift_us: Integers = NO_TILES,
) -> RowColumns:  # fmt: skip
    """Return columns as the counting loop takes them: arguments as of :class:`RowColumns`."""
    return RowColumns(*map(contiguous, (time, shift_us, x, y, z, range_rate, rcs)))
