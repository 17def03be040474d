"""The compiled loop from detections to the tiles that each frame hits.

In one pass over the rows of a recording, detections are placed in the map
(:mod:`gis_radar.measures.placing`), tested against the tiles of the cell that they are in, and
filtered. Each tile keeps the number of the frame that hit it last, so that it counts once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gis_radar.base import Floats, Integers, compiled
from gis_radar.hdmap import Numbers, TileCells, cell_at, is_inside
from gis_radar.measures.placing import PoseNumbers, height_of, in_view, place_in_map
from gis_radar.scans import CAR_REFLECTION_M, MOVEMENT_LEVEL_M, MOVEMENT_MPS

# Columns of the table of frames.
TIME_US, SHIFT_US, DETECTIONS, MOVING, WILD, TILES_HIT, FRAME_POSE = range(7)
FRAME_COLUMNS = 7
# Indices into `Accumulator.counts`: frames begun so far; frames and hits in the buffers.
_BEGUN_FRAMES, FILLED_FRAMES, FILLED_HITS = range(3)
COUNTS = 3
# For the frame log only: least absolute range rate of a moving detection, over the Doppler noise of
# a radar (0.1 to 0.3 m/s) and of leaves; and speed over which no vehicle drives (250 km/h).
_LOGGED_MOVING_MPS, _WILD_MPS = 0.5, 70.0


class RowColumns(NamedTuple):
    """Rows of a recording for compiled code: columns of one length.

    Parameters
    ----------
    time, shift_us : arrays
        UNIX seconds, corrected, float64; microseconds that the correction added, int64, empty
        without one.
    x, y, z, range_rate, rcs : arrays
        As in :class:`Detections`.
    """

    time: Floats
    shift_us: Integers
    x: Floats
    y: Floats
    z: Floats
    range_rate: Floats
    rcs: Floats


class Limits(NamedTuple):
    """Limits for detections that count, and for the tiles that they count on; NaN: no limit.

    Parameters
    ----------
    min_speed, min_rcs : float
        Least absolute range rate, m/s, and radar cross section, dBm2.
    lowest_m, highest_m, widening, level_m : float
        The clearance profile, metres over the road; metres that it widens for each metre of range;
        height difference under which tiles are on one level, metres.
    """

    min_speed: float
    min_rcs: float
    lowest_m: float
    highest_m: float
    widening: float
    level_m: float


class TileIndex(NamedTuple):
    """The tiles for compiled code: heights of their roads (m), and the grid of cells."""

    road_m: Floats
    cells: TileCells


class Accumulator(NamedTuple):
    """The open frame, to which more rows may belong, and sums over all rows.

    Parameters
    ----------
    counts, time, frame : arrays
        Counts at the indices `_BEGUN_FRAMES` and following; time of the open frame, (1,) UNIX
        seconds, NaN if none is open; its columns so far.
    of_frame, moved : (n,) int64 arrays
        By tile, the number of the last frame that hit it, and of the last one with movement on it.
    inside : (m,) int64 array
        Working memory: tiles around one detection.
    ranges : (r,) int64 array
        Number of detections by range in whole metres; the last entry counts all beyond.
    movement : (n,) int64 array
        Number of frames with movement on each tile; empty if it is not counted.
    """

    counts: Integers
    time: Floats
    frame: Integers
    of_frame: Integers
    moved: Integers
    inside: Integers
    ranges: Integers
    movement: Integers


class CountBuffer(NamedTuple):
    """Buffers for complete frames and the tiles that each hits.

    Parameters
    ----------
    frames : (f, 7) int64 array
        Rows of complete frames.
    tile : (k,) int32 array
        Positions of the tiles hit, `TILES_HIT` for each frame, each once in it. At least one entry
        more than there are tiles.
    """

    frames: Integers
    tile: Numbers


@compiled
def count_rows(  # pragma: no cover - compiled
    rows: RowColumns,
    begin: int,
    end: int,
    pose: PoseNumbers,
    limits: Limits,
    index: TileIndex,
    sums: Accumulator,
    buffer: CountBuffer,
) -> int:
    """Count rows recorded from one pose, until `end` or until the buffers are full.

    Returns
    -------
    int
        The first row that is not yet counted.
    """
    counts, time, row = sums.counts, rows.time, begin
    room = len(buffer.tile) - len(sums.of_frame) - 1
    while row < end:
        if time[row] != sums.time[0]:
            end_frame(sums, buffer)
            if counts[FILLED_FRAMES] == len(buffer.frames) or counts[FILLED_HITS] > room:
                return row
            counts[_BEGUN_FRAMES] += 1
            sums.time[0] = time[row]
            sums.frame[TIME_US] = int(np.rint(time[row] * 1e6))
            sums.frame[SHIFT_US] = rows.shift_us[row] if len(rows.shift_us) else 0
            sums.frame[FRAME_POSE] = pose.number
        begin, row, now = row, row + 1, time[row]
        while row < end and time[row] == now:
            row += 1
        _count_speeds(rows.range_rate, begin, row, sums.frame)
        _count_frame(rows, begin, row, pose, limits, index, sums, buffer)
    return end


@compiled
def end_frame(sums: Accumulator, buffer: CountBuffer) -> None:  # pragma: no cover - compiled
    """Move the open frame, if any, to the buffer."""
    if not math.isnan(sums.time[0]):
        buffer.frames[sums.counts[FILLED_FRAMES]] = sums.frame
        sums.counts[FILLED_FRAMES] += 1
        sums.counts[FILLED_HITS] += sums.frame[TILES_HIT]
        sums.frame[:] = 0
        sums.time[0] = math.nan


@compiled
def _count_speeds(  # pragma: no cover - compiled
    rates: Floats, begin: int, end: int, frame: Integers
) -> None:
    """Count, in the open frame, moving rows and rows too fast for any vehicle."""
    moving = wild = 0
    for row in range(begin, end):
        moving += int(abs(rates[row]) >= _LOGGED_MOVING_MPS)
        wild += int(abs(rates[row]) > _WILD_MPS)
    frame[MOVING] += moving
    frame[WILD] += wild


@compiled
def _count_frame(  # pragma: no cover - compiled
    rows: RowColumns,
    begin: int,
    end: int,
    pose: PoseNumbers,
    limits: Limits,
    index: TileIndex,
    sums: Accumulator,
    buffer: CountBuffer,
) -> None:
    """Count rows of the open frame, and on the tiles that they hit and it has not hit before."""
    # Taken out of their tuples before the loop: in it, counting references would take longer than
    # the tests of tiles.
    cells, per_m, road_m = index.cells, 1.0 / index.cells.cell_m, index.road_m
    xs, ys, zs, rates, strengths = rows.x, rows.y, rows.z, rows.range_rate, rows.rcs
    first, tiles, edges = cells.first, cells.tiles, cells.edges
    inside, moved, movement, of_frame = sums.inside, sums.moved, sums.movement, sums.of_frame
    number, ranges, last_m = sums.counts[_BEGUN_FRAMES], sums.ranges, len(sums.ranges) - 1.0
    hit = buffer.tile[sums.counts[FILLED_HITS] :]
    present, count = 0, sums.frame[TILES_HIT]
    for row in range(begin, end):
        x, y, z = xs[row], ys[row], zs[row]
        if math.isnan(x) or math.isnan(y):
            continue
        east, north, range_m = place_in_map(x, y, z, pose)
        present += 1
        ranges[int(min(last_m, range_m))] += 1
        east, north = east - cells.west, north - cells.south
        cell = cell_at(east, north, cells.width, cells.height, per_m, cells.columns)
        around = _fill_tiles_under(tiles, edges, first[cell], first[cell + 1], east, north, inside)
        if around == 0:
            continue
        height = height_of(x, y, z, pose)
        if len(movement) > 0 and abs(rates[row]) >= MOVEMENT_MPS:
            _count_movement(inside, around, height, road_m, moved, number, movement)
        # Without elevation, a detection nearer than the road is not on it.
        on_road = not math.isnan(z) or range_m > pose.drop_m
        if not (on_road and in_view(x, y, z, range_m, pose)):
            continue
        if not _passes(rates[row], strengths[row], limits):
            continue
        if not math.isnan(limits.lowest_m):
            around = _keep_fitting_height(inside, around, height, range_m, limits, road_m)
        for nth in range(around):
            if of_frame[inside[nth]] != number:
                of_frame[inside[nth]], hit[count] = number, inside[nth]
                count += 1
    sums.frame[DETECTIONS] += present
    sums.frame[TILES_HIT] = count


@compiled
def _passes(  # pragma: no cover - compiled
    rate: float, strength: float, limits: Limits
) -> bool:
    """Return whether a detection is fast and strong enough; NaN is not."""
    fast = math.isnan(limits.min_speed) or abs(rate) >= limits.min_speed
    return fast and (math.isnan(limits.min_rcs) or strength >= limits.min_rcs)


@compiled
def _fill_tiles_under(  # pragma: no cover - compiled
    tiles: Numbers, edges: Floats, begin: int, end: int, x: float, y: float,
    inside: Integers,
) -> int:  # fmt: skip
    """Fill `inside` with the tiles of a cell that a point is in; return their number."""
    count = 0
    for k in range(begin, end):
        inside[count] = tiles[k]
        count += is_inside(edges, tiles[k], x, y)
    return count


@compiled
def _keep_fitting_height(  # pragma: no cover - compiled
    inside: Integers, around: int, height: float, range_m: float, limits: Limits, road_m: Floats
) -> int:
    """Keep the tiles that a detection fits in height, at the begin of `inside`; return how many.

    Where tiles are above each other (a bridge), it counts on the level that it fits best; among
    equal ones, on that with the middle of its clearance nearest. No detection counts on a tile of
    unknown height.
    """
    widened_m = range_m * limits.widening
    middle_m = (limits.lowest_m + limits.highest_m) / 2
    least, level_m = np.inf, np.nan
    for k in range(around):
        over_m = height - road_m[inside[k]]
        outside_m = max(limits.lowest_m - over_m, over_m - limits.highest_m, 0.0)
        misfit = outside_m + 1e-3 * abs(over_m - middle_m)
        if outside_m <= widened_m and misfit <= least:
            least, level_m = misfit, road_m[inside[k]]
    count = 0
    for k in range(around):
        over_m = height - road_m[inside[k]]
        outside_m = max(limits.lowest_m - over_m, over_m - limits.highest_m, 0.0)
        inside[count] = inside[k]
        count += outside_m <= widened_m and abs(road_m[inside[k]] - level_m) < limits.level_m
    return count


@compiled
def _count_movement(  # pragma: no cover - compiled
    inside: Integers, around: int, height: float, road_m: Floats,
    moved: Integers, number: int, movement: Integers,
) -> None:  # fmt: skip
    """Count movement on the tiles around a detection, once a frame, also at unknown heights."""
    for k in range(around):
        tile = inside[k]
        over_m = height - road_m[tile] - CAR_REFLECTION_M
        if abs(over_m) > MOVEMENT_LEVEL_M or moved[tile] == number:
            continue
        moved[tile] = number
        movement[tile] += 1
