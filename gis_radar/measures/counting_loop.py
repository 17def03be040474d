"""The compiled loop from detections to the tiles that each frame hits.

One pass over the rows of a recording: the detections of a frame are placed in the map
(:mod:`gis_radar.measures.placing`), and those over cells with tiles are filtered and tested
against these. A tile is stamped with the frame that hit it, so that it counts once in it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gis_radar.base import Floats, Integers, compiled
from gis_radar.hdmap import Numbers, TileCells, is_inside
from gis_radar.measures.placing import Places, PoseNumbers, fill_places, height_of

# Columns of the frames: what is found of each.
TIME_US, SHIFT_US, DETECTIONS, MOVING, WILD, TILES_HIT, POSE = range(7)
FRAME_COLUMNS = 7
# Places in `Accumulator.counts`: frames begun so far; frames and hits that are filled in.
FRAMES, FILLED_FRAMES, FILLED_HITS = range(3)
COUNTS = 3


class RowColumns(NamedTuple):
    """Rows of a recording as compiled code takes them: its columns, all of one length.

    Parameters
    ----------
    time, shift_us : arrays
        UNIX seconds, corrected, float64; microseconds added by the correction, int64, empty where
        there is none.
    x, y, z, range_rate, rcs : arrays
        Of the detections, all float64 or all float32; `rcs` may be empty where no filter asks for
        it.
    """

    time: Floats
    shift_us: Integers
    x: Floats
    y: Floats
    z: Floats
    range_rate: Floats
    rcs: Floats


class Limits(NamedTuple):
    """Which detections count, and on which tiles; NaN where nothing is asked.

    Parameters
    ----------
    min_speed, min_rcs : float
        Least absolute range rate, m/s, and radar cross section, dBm2.
    lowest_m, highest_m, widening, level_m : float
        The clearance profile, metres over the road; by how much it widens a metre of range; within
        which heights tiles are on one level.
    moving_mps, wild_mps : float
        From which speed on a detection of the frame log moves; over which no vehicle drives.
    sight_mps, sight_over_m, sight_level_m : float
        From which speed on a detection counts as movement for sight; how high over a tile's road it
        is then, metres, and within which heights of that it is on the tile's level.
    """

    min_speed: float
    min_rcs: float
    lowest_m: float
    highest_m: float
    widening: float
    level_m: float
    moving_mps: float
    wild_mps: float
    sight_mps: float
    sight_over_m: float
    sight_level_m: float


class TileIndex(NamedTuple):
    """The tiles as compiled code takes them: the heights of their roads, their cells."""

    road_m: Floats
    cells: TileCells


class Accumulator(NamedTuple):
    """The frame that more rows may belong to, and sums over all rows.

    Parameters
    ----------
    counts, time, frame : arrays
        As of `FRAMES` and the following; the frame's time, NaN where none is open; its columns so
        far.
    of_frame, moved : (n,) int64 arrays
        By tile the number of the last frame that hit it, and of the last one with movement on it.
    inside, places : (m,) int64 array, Places
        Room for the tiles around one detection, and for the places of some.
    ranges : (r,) int64 array
        Detections by their range in whole metres, the last place for all beyond.
    movement : (n,) int64 array
        Frames with movement on each tile; empty where it is not counted.
    """

    counts: Integers
    time: Floats
    frame: Integers
    of_frame: Integers
    moved: Integers
    inside: Integers
    places: Places
    ranges: Integers
    movement: Integers


class CountBuffer(NamedTuple):
    """Buffers for complete frames and the tiles that each hits.

    Parameters
    ----------
    frames : (f, 7) int64 array
        Rows of frames.
    tile : (k,) int32 array
        Positions of the tiles that a frame hits, `TILES_HIT` of each, each once. Room for one more
        than there are tiles at least.
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
    """Count some rows, all seen from one pose, as far as there is room for what is found.

    Returns
    -------
    int
        The first row that is not counted.
    """
    counts, time, row = sums.counts, rows.time, begin
    room = len(buffer.tile) - len(sums.of_frame) - 1
    while row < end:
        if time[row] != sums.time[0]:
            end_frame(sums, buffer)
            if counts[FILLED_FRAMES] == len(buffer.frames) or counts[FILLED_HITS] > room:
                return row
            counts[FRAMES] += 1
            sums.time[0] = time[row]
            sums.frame[TIME_US] = int(np.rint(time[row] * 1e6))
            sums.frame[SHIFT_US] = rows.shift_us[row] if len(rows.shift_us) else 0
            sums.frame[POSE] = pose.number
        begin, row, now = row, row + 1, time[row]
        while row < end and time[row] == now:
            row += 1
        _count_speeds(rows.range_rate, begin, row, limits, sums.frame)
        _count_frame(rows, begin, row, pose, limits, index, sums, buffer)
    return end


@compiled
def end_frame(sums: Accumulator, buffer: CountBuffer) -> None:  # pragma: no cover - compiled
    """Fill in the open frame, if any, and close it."""
    if not math.isnan(sums.time[0]):
        buffer.frames[sums.counts[FILLED_FRAMES]] = sums.frame
        sums.counts[FILLED_FRAMES] += 1
        sums.counts[FILLED_HITS] += sums.frame[TILES_HIT]
        sums.frame[:] = 0
        sums.time[0] = math.nan


@compiled
def _count_speeds(  # pragma: no cover - compiled
    rates: Floats, begin: int, end: int, limits: Limits, frame: Integers
) -> None:
    """Count the rows of the open frame that move, and those too fast for any vehicle."""
    moving = wild = 0
    moving_mps, wild_mps = limits.moving_mps, limits.wild_mps
    for row in range(begin, end):
        moving += int(abs(rates[row]) >= moving_mps)
        wild += int(abs(rates[row]) > wild_mps)
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
    """Count rows of the open frame on the tiles under them."""
    places, ranges, last_m = sums.places, sums.ranges, len(sums.ranges) - 1.0
    for low in range(begin, end, len(places.cell)):
        high = min(low + len(places.cell), end)
        over = fill_places(
            rows.x[low:high],
            rows.y[low:high],
            rows.z[low:high],
            pose,
            index.cells,
            last_m,
            places,
        )
        present = 0
        for k in range(high - low):
            if places.metres[k] >= 0:
                ranges[places.metres[k]] += 1
                present += 1
        sums.frame[DETECTIONS] += present
        hit = buffer.tile[sums.counts[FILLED_HITS] + sums.frame[TILES_HIT] :]
        sums.frame[TILES_HIT] += _hit_by(rows, low, over, pose, limits, index, sums, hit)


@compiled
def _hit_by(  # pragma: no cover - compiled
    rows: RowColumns,
    low: int,
    over: int,
    pose: PoseNumbers,
    limits: Limits,
    index: TileIndex,
    sums: Accumulator,
    hit: Numbers,
) -> int:
    """List in `hit` the tiles that detections over cells with tiles hit first in the frame.

    `low` is the row of the first detection placed. Returns how many tiles it lists.
    """
    # An array taken from its tuple is a count of references, slower than the test: not in the loop.
    xs, ys, zs, rates, strengths = rows.x, rows.y, rows.z, rows.range_rate, rows.rcs
    first, tiles, edges = index.cells.first, index.cells.tiles, index.cells.edges
    east, north, range_m, cell, _, nth_over = sums.places
    road_m, inside, moved, movement = index.road_m, sums.inside, sums.moved, sums.movement
    of_frame, number, count = sums.of_frame, sums.counts[FRAMES], 0
    picked = not (math.isnan(limits.min_speed) and math.isnan(limits.min_rcs))
    tracked, asked = len(movement) > 0, not math.isnan(limits.lowest_m)
    for nth in range(over):
        k = nth_over[nth]
        row, begin, end = low + k, first[cell[k]], first[cell[k] + 1]
        # Without elevation and nearer than the road: not on it.
        hits = not math.isnan(zs[row]) or range_m[k] > pose.drop_m
        hits &= not picked or _passes(rates, strengths, row, limits)
        moves = tracked and abs(rates[row]) >= limits.sight_mps
        if not moves and not asked:
            for at in range(begin, end if hits else begin):
                tile = tiles[at]
                stamp, is_hit = of_frame[tile], is_inside(edges, tile, east[k], north[k])
                hit[count] = tile
                count += is_hit * (stamp != number)
                of_frame[tile] = number if is_hit else stamp
            continue
        around = _inside(tiles, edges, begin, end, east[k], north[k], inside)
        height = height_of(xs[row], ys[row], zs[row], pose)
        if moves:
            _move(inside, around, height, limits, road_m, moved, number, movement)
        if hits and asked:
            around = _fitting(inside, around, height, range_m[k], limits, road_m)
        for at in range(around if hits else 0):
            count = _list(inside[at], number, of_frame, hit, count)
    return count


@compiled
def _list(  # pragma: no cover - compiled
    tile: int, number: int, of_frame: Integers, hit: Numbers, count: int
) -> int:
    """List a tile once a frame; return the number of listed tiles."""
    hit[count] = tile
    count += of_frame[tile] != number
    of_frame[tile] = number
    return count


@compiled
def _passes(  # pragma: no cover - compiled
    rates: Floats, strengths: Floats, row: int, limits: Limits
) -> bool:
    """Return whether a detection is fast and strong enough; an unknown value is not."""
    fast = math.isnan(limits.min_speed) or abs(rates[row]) >= limits.min_speed
    return fast and (math.isnan(limits.min_rcs) or strengths[row] >= limits.min_rcs)


@compiled
def _inside(  # pragma: no cover - compiled
    tiles: Numbers, edges: Floats, begin: int, end: int, x: float, y: float,
    inside: Integers,
) -> int:  # fmt: skip
    """Fill in the tiles of a cell that a point is in; return how many."""
    count = 0
    for k in range(begin, end):
        inside[count] = tiles[k]
        count += is_inside(edges, tiles[k], x, y)
    return count


@compiled
def _fitting(  # pragma: no cover - compiled
    inside: Integers, around: int, height: float, range_m: float, limits: Limits, road_m: Floats
) -> int:
    """Keep the tiles that a detection fits in height.

    Where tiles are above each other (a bridge), it counts on the level that it fits best, and
    among levels that fit alike on the one nearer to the middle of the clearance. A tile of unknown
    height takes no detection.
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
    kept = 0
    for k in range(around):
        over_m = height - road_m[inside[k]]
        outside_m = max(limits.lowest_m - over_m, over_m - limits.highest_m, 0.0)
        inside[kept] = inside[k]
        kept += outside_m <= widened_m and abs(road_m[inside[k]] - level_m) < limits.level_m
    return kept


@compiled
def _move(  # pragma: no cover - compiled
    inside: Integers, around: int, height: float, limits: Limits, road_m: Floats,
    moved: Integers, number: int, movement: Integers,
) -> None:  # fmt: skip
    """Count movement on the tiles around a detection, once a frame; unknown heights count."""
    for k in range(around):
        tile = inside[k]
        over_m = height - road_m[tile] - limits.sight_over_m
        if abs(over_m) > limits.sight_level_m or moved[tile] == number:
            continue
        moved[tile] = number
        movement[tile] += 1
