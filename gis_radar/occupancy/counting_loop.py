"""The compiled loop from detections to the tiles that each frame hits.

One pass over the rows of a recording: each detection is filtered, moved to the map and tested
against the tiles of its cell; a tile is stamped with the frame and the step that hit it, so that it
counts once in each. What :mod:`gis_radar.occupancy.plain_pass` finds in NumPy, bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gis_radar.arrays import Floats, Integers, compiled
from gis_radar.poses.pose import Pose
from gis_radar.steps import STEP_US
from gis_radar.tiles.lookup import TileCells, cell_at, is_inside

# Columns of the frames: what is found of each.
TIME_US, SHIFT_US, DETECTIONS, MOVING, WILD, TILES_HIT, CHECKSUM, POSE = range(8)
FRAME_COLUMNS = 8
# Places in `Open.counts`: frames and steps begun so far, the step, tiles that wait for its end.
FRAMES, STEPS, STEP, WAITING = range(4)
NO_STEP = int(np.iinfo(np.int64).min)
PRIME = 65521  # the largest under 2**16
Bits = NDArray[np.uint32]


class RowColumns(NamedTuple):
    """RowColumns of a recording as compiled code takes them: its columns, all of one length.

    Parameters
    ----------
    time, shift_us : arrays
        UNIX seconds, corrected, float64; microseconds added by the correction, int64, empty where
        there is none.
    x, y, z, range_rate, rcs : arrays
        Of the detections, float64; `rcs` may be empty where no filter asks for it.
    x_bits, y_bits : uint32 arrays
        The float32 of x and y as whole numbers.
    """

    time: Floats
    shift_us: Integers
    x: Floats
    y: Floats
    z: Floats
    range_rate: Floats
    rcs: Floats
    x_bits: Bits
    y_bits: Bits


class PoseNumbers(NamedTuple):
    """A pose as compiled code takes it.

    Parameters
    ----------
    xx, xy, xz, yx, yy, yz, zx, zy, zz : float
        Rotation from the sensor frame to the map frame, by rows.
    easting, northing, height : float
        Position of the sensor, metres.
    drop_m, drop_m2 : float
        How far the road lies under the sensor, metres, and its square: where detections without
        elevation are placed; 0 where not known.
    number : int
        Of the pose; frames carry it.
    """

    xx: float
    xy: float
    xz: float
    yx: float
    yy: float
    yz: float
    zx: float
    zy: float
    zz: float
    easting: float
    northing: float
    height: float
    drop_m: float
    drop_m2: float
    number: int

    @classmethod
    def of(cls, pose: Pose, *, road_m: float = math.nan, number: int = 0) -> PoseNumbers:
        """Return a pose over a road of some height (metres in the map; NaN where not known)."""
        drop_m = 0.0 if math.isnan(road_m) else pose.height - road_m
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = pose.R_map_sensor.tolist()
        return cls(
            xx, xy, xz, yx, yy, yz, zx, zy, zz, float(pose.easting), float(pose.northing),
            float(pose.height), float(drop_m), float(drop_m**2), number,
        )  # fmt: skip


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
    step_us : int
        Length of a step, microseconds; 1 makes each frame a step of its own.
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
    step_us: int = STEP_US


class Ground(NamedTuple):
    """The tiles as compiled code takes them: their ids, the heights of their roads, their cells."""

    tile_id: Integers
    road_m: Floats
    cells: TileCells


class Open(NamedTuple):
    """The frame and the step that more rows may belong to, and sums over all rows.

    Parameters
    ----------
    counts, time, frame : arrays
        Frames and steps begun, step, tiles waiting; the frame's time, NaN where none is open; its
        columns so far.
    of_frame, of_step, moved : (n,) int64 arrays
        By tile the number of the last frame and of the last step that hit it, and of the last frame
        with movement on it.
    waiting : (n,) int64 array
        Ids of the tiles hit in the step so far.
    inside : (m,) int64 array
        Room for the tiles around one detection.
    ranges : (r,) int64 array
        Detections by their range in whole metres, the last place for all beyond.
    movement : (n,) int64 array
        Frames with movement on each tile; empty where it is not counted.
    """

    counts: Integers
    time: Floats
    frame: Integers
    of_frame: Integers
    of_step: Integers
    moved: Integers
    waiting: Integers
    inside: Integers
    ranges: Integers
    movement: Integers


class Found(NamedTuple):
    """Room for what is found: whole frames, and the hits of whole steps.

    Parameters
    ----------
    frames : (f, 8) int64 array
        Rows of frames.
    step, tile : (k,) int64 arrays
        Hits: ascending by step, then by tile. Room for all tiles at least.
    """

    frames: Integers
    step: Integers
    tile: Integers


@compiled
def count_rows(  # pragma: no cover - compiled
    rows: RowColumns, begin: int, end: int, pose: PoseNumbers, limits: Limits, ground: Ground,
    opened: Open, found: Found,
) -> tuple[int, int, int]:  # fmt: skip
    """Count some rows, all seen from one pose, as far as there is room for what is found.

    Returns
    -------
    row, frames, hits : int
        The first row that is not counted; how many frames and hits were filled in.
    """
    frames = hits = 0
    row = begin
    while row < end:
        if rows.time[row] != opened.time[0]:
            if frames == len(found.frames) or hits + opened.counts[WAITING] > len(found.tile):
                return row, frames, hits
            frames = end_frame(opened, found, frames)
            time_us = int(np.rint(rows.time[row] * 1e6))
            if opened.counts[STEP] != time_us // limits.step_us:
                hits = end_step(opened, found, hits)
                opened.counts[STEPS] += 1
                opened.counts[STEP] = time_us // limits.step_us
            opened.counts[FRAMES] += 1
            opened.time[0] = rows.time[row]
            opened.frame[TIME_US] = time_us
            opened.frame[SHIFT_US] = rows.shift_us[row] if len(rows.shift_us) else 0
            opened.frame[POSE] = pose.number
        begin, row = row, row + 1
        while row < end and rows.time[row] == opened.time[0]:
            row += 1
        _tally(rows.x_bits, rows.y_bits, rows.range_rate, begin, row, limits, opened.frame)
        _count_frame(rows, begin, row, pose, limits, ground, opened)
    return end, frames, hits


@compiled
def end_frame(opened: Open, found: Found, frames: int) -> int:  # pragma: no cover - compiled
    """Fill in the open frame and close it; return how many frames are filled in."""
    if np.isnan(opened.time[0]):
        return frames
    found.frames[frames] = opened.frame
    found.frames[frames, CHECKSUM] %= PRIME
    opened.frame[:] = 0
    opened.time[0] = np.nan
    return frames + 1


@compiled
def end_step(opened: Open, found: Found, hits: int) -> int:  # pragma: no cover - compiled
    """Fill in the hits of the open step and close it; return how many hits are filled in."""
    count = opened.counts[WAITING]
    tiles = opened.waiting[:count]
    tiles.sort()
    found.tile[hits : hits + count] = tiles
    found.step[hits : hits + count] = opened.counts[STEP]
    opened.counts[WAITING], opened.counts[STEP] = 0, NO_STEP
    return int(hits + count)


@compiled
def _tally(  # pragma: no cover - compiled
    x_bits: Bits, y_bits: Bits, rates: Floats, begin: int, end: int, limits: Limits,
    frame: Integers,
) -> None:  # fmt: skip
    """Add what rows of the open frame are, wherever they are."""
    moving = wild = bits = 0
    for row in range(begin, end):
        bits += int(np.int64(x_bits[row]) + np.int64(y_bits[row]))
        moving += int(abs(rates[row]) >= limits.moving_mps)
        wild += int(abs(rates[row]) > limits.wild_mps)
    frame[MOVING] += moving
    frame[WILD] += wild
    frame[CHECKSUM] += bits


@compiled
def _count_frame(  # pragma: no cover - compiled
    rows: RowColumns, begin: int, end: int, pose: PoseNumbers, limits: Limits, ground: Ground,
    opened: Open,
) -> None:  # fmt: skip
    """Count rows of the open frame on the tiles under them."""
    xs, ys, zs = rows.x[begin:end], rows.y[begin:end], rows.z[begin:end]
    rates, strengths = rows.range_rate[begin:end], rows.rcs[begin:end]
    cells, road_m, inside, ranges = ground.cells, ground.road_m, opened.inside, opened.ranges
    first, tiles, edges, per_m = cells.first, cells.tiles, cells.edges, 1.0 / cells.cell_m
    of_frame, of_step, waiting = opened.of_frame, opened.of_step, opened.waiting
    movement, counts, frame = opened.movement, opened.counts, opened.frame
    picked = not (math.isnan(limits.min_speed) and math.isnan(limits.min_rcs))
    number, tracked, asked = counts[FRAMES], len(movement) > 0, not math.isnan(limits.lowest_m)
    for row in range(len(xs)):
        x, y, z = xs[row], ys[row], zs[row]
        if math.isnan(x) or math.isnan(y):
            continue
        level = math.isnan(z)
        range_m = math.sqrt(x * x + y * y + (0.0 if level else z * z))
        ranges[int(range_m) if range_m < len(ranges) else len(ranges) - 1] += 1
        frame[DETECTIONS] += 1
        hits = not level or range_m > pose.drop_m  # nearer than the road: not on it
        hits &= not picked or _passes(rates, strengths, row, limits)
        moves = tracked and abs(rates[row]) >= limits.sight_mps
        if not (hits or moves):
            continue
        east, north, height = _on_plane(x, y, pose) if level else _in_map(x, y, z, pose)
        east, north = east - cells.west, north - cells.south
        cell = cell_at(east, north, cells.width, cells.height, per_m, cells.columns)
        if cell < 0:
            continue
        around = _inside(tiles, edges, first[cell], first[cell + 1], east, north, inside)
        if moves:
            _move(inside, around, height, limits, road_m, opened.moved, number, movement)
        if hits and asked:
            around = _fitting(inside, around, height, range_m, limits, road_m)
        for k in range(around if hits else 0):
            if of_frame[inside[k]] != number:
                of_frame[inside[k]] = number
                frame[TILES_HIT] += 1
                _hit(inside[k], of_step, counts, ground.tile_id, waiting)


@compiled
def _passes(  # pragma: no cover - compiled
    rates: Floats, strengths: Floats, row: int, limits: Limits
) -> bool:
    """Return whether a detection is fast and strong enough; an unknown value is not."""
    fast = math.isnan(limits.min_speed) or abs(rates[row]) >= limits.min_speed
    return fast and (math.isnan(limits.min_rcs) or strengths[row] >= limits.min_rcs)


@compiled
def _hit(  # pragma: no cover - compiled
    tile: int, of_step: Integers, counts: Integers, tile_id: Integers, waiting: Integers
) -> None:
    """Stamp a tile with the step, and note it at the first time."""
    if of_step[tile] != counts[STEPS]:
        of_step[tile] = counts[STEPS]
        waiting[counts[WAITING]] = tile_id[tile]
        counts[WAITING] += 1


@compiled
def _in_map(  # pragma: no cover - compiled
    x: float, y: float, z: float, to: PoseNumbers
) -> tuple[float, float, float]:
    """Return a place in the map, as :meth:`Pose.to_map` does."""
    return (
        ((x * to.xx + z * to.xz) + y * to.xy) + to.easting,
        ((x * to.yx + z * to.yz) + y * to.yy) + to.northing,
        ((x * to.zx + z * to.zz) + y * to.zy) + to.height,
    )


@compiled
def _on_plane(  # pragma: no cover - compiled
    x: float, y: float, to: PoseNumbers
) -> tuple[float, float, float]:
    """Return the place of a detection without elevation, as :meth:`Pose.to_map` does."""
    east, north = x * to.xx + y * to.xy, x * to.yx + y * to.yy
    range_m, length = math.hypot(x, y), math.hypot(east, north)
    flat_m = math.sqrt(max(range_m * range_m - to.drop_m2, 0.0))
    share = flat_m / length if length > 0.0 else 0.0
    return east * share + to.easting, north * share + to.northing, to.height - to.drop_m


@compiled
def _inside(  # pragma: no cover - compiled
    tiles: NDArray[np.int32], edges: Floats, begin: int, end: int, x: float, y: float,
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
    """Keep the tiles that a detection fits in height, as :meth:`Filters.keep_pairs` does."""
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
