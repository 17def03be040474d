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
Values = NDArray[np.float32] | Floats


class RowColumns(NamedTuple):
    """RowColumns of a recording as compiled code takes them: its columns, all of one length.

    Parameters
    ----------
    time, shift_us : arrays
        UNIX seconds, corrected, float64; microseconds added by the correction, int64, empty where
        there is none.
    x, y, z, range_rate, rcs : arrays
        As the recording has them, all float32 or all float64; `rcs` may be empty where no filter
        asks for it.
    x_bits, y_bits : uint32 arrays
        The float32 of x and y as whole numbers.
    """

    time: Floats
    shift_us: Integers
    x: Values
    y: Values
    z: Values
    range_rate: Values
    rcs: Values
    x_bits: NDArray[np.uint32]
    y_bits: NDArray[np.uint32]


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
        The number of the last frame and of the last step that hit each tile, and of the last frame
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
        RowColumns of frames.
    step, tile : (k,) int64 arrays
        Hits: ascending by step, then by tile. Room for all tiles at least.
    """

    frames: Integers
    step: Integers
    tile: Integers


@compiled
def count_rows(
    rows: RowColumns, begin: int, end: int, placing: PoseNumbers, limits: Limits, ground: Ground,
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
            opened.frame[POSE] = placing.number
        begin = row
        while row < end and rows.time[row] == opened.time[0]:
            row += 1
        _count_frame(rows, begin, row, placing, limits, ground, opened)
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
def _count_frame(
    rows: RowColumns, begin: int, end: int, placing: PoseNumbers, limits: Limits, ground: Ground,
    opened: Open,
) -> None:  # fmt: skip
    """Count rows of the open frame."""
    xs, ys, zs, rates, strengths = rows.x, rows.y, rows.z, rows.range_rate, rows.rcs
    x_bits, y_bits, ranges = rows.x_bits, rows.y_bits, opened.ranges
    detections = moving = wild = bits = 0
    cells, tracked = ground.cells, len(opened.movement) > 0
    first, per_m = cells.first, 1.0 / cells.cell_m
    for row in range(begin, end):
        bits += int(np.int64(x_bits[row]) + np.int64(y_bits[row]))
        speed = abs(_double(rates[row]))
        moving += int(speed >= limits.moving_mps)
        wild += int(speed > limits.wild_mps)
        x, y, z = _double(xs[row]), _double(ys[row]), _double(zs[row])
        if math.isnan(x) or math.isnan(y):
            continue
        detections += 1
        level = math.isnan(z)
        range_m = math.sqrt(x * x + y * y + (0.0 if level else z * z))
        ranges[int(range_m) if range_m < len(ranges) else len(ranges) - 1] += 1
        counts = not level or range_m > placing.drop_m  # nearer than the road: not on it
        if not math.isnan(limits.min_speed):
            counts &= speed >= limits.min_speed
        if not math.isnan(limits.min_rcs):
            counts &= _double(strengths[row]) >= limits.min_rcs
        moves = tracked and speed >= limits.sight_mps
        if not (counts or moves):
            continue
        if level:
            easting, northing, height = _on_plane(x, y, placing)
        else:
            easting, northing, height = _in_map(x, y, z, placing)
        east, north = easting - cells.west, northing - cells.south
        cell = cell_at(east, north, cells.width, cells.height, per_m, cells.columns)
        if cell < 0 or first[cell] == first[cell + 1]:
            continue
        around = _inside(cells.tiles, cells.edges, first[cell], first[cell + 1], east, north,
                         opened.inside)  # fmt: skip
        if counts and around > 0:
            _hit(around, height, range_m, limits, ground.tile_id, ground.road_m, opened)
        if moves and around > 0:
            _move(around, height, limits, ground.road_m, opened)
    opened.frame[DETECTIONS] += detections
    opened.frame[MOVING] += moving
    opened.frame[WILD] += wild
    opened.frame[CHECKSUM] += bits


@compiled
def _double(value: float) -> float:  # pragma: no cover - compiled
    """Return a number as float64; numba's `float` leaves float32 as it is."""
    return np.float64(value)


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
def _inside(
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
def _hit(
    around: int, height: float, range_m: float, limits: Limits, tile_id: Integers, road_m: Floats,
    opened: Open,
) -> None:  # fmt: skip
    """Stamp the tiles around a detection that it fits on in height."""
    inside, of_frame, of_step = opened.inside, opened.of_frame, opened.of_step
    frame, step = opened.counts[FRAMES], opened.counts[STEPS]
    asked = not math.isnan(limits.lowest_m)
    level = _level(around, height, range_m, limits, road_m, inside) if asked else 0.0
    for k in range(around):
        tile = inside[k]
        if asked and not (
            _outside(height - road_m[tile], limits) <= range_m * limits.widening
            and abs(road_m[tile] - level) < limits.level_m
        ):
            continue
        if of_frame[tile] != frame:
            of_frame[tile] = frame
            opened.frame[TILES_HIT] += 1
            if of_step[tile] != step:
                of_step[tile] = step
                opened.waiting[opened.counts[WAITING]] = tile_id[tile]
                opened.counts[WAITING] += 1


@compiled
def _outside(over_m: float, limits: Limits) -> float:  # pragma: no cover - compiled
    """Return how far a height over the road is outside of the clearance profile, metres."""
    if math.isnan(over_m):
        return over_m
    return max(limits.lowest_m - over_m, over_m - limits.highest_m, 0.0)


@compiled
def _level(
    around: int, height: float, range_m: float, limits: Limits, road_m: Floats, inside: Integers
) -> float:
    """Return the road height that a detection fits best, as :meth:`Filters.keep_pairs` does."""
    least, level = np.inf, np.nan
    for k in range(around):
        over_m = height - road_m[inside[k]]
        outside = _outside(over_m, limits)
        if outside <= range_m * limits.widening:
            middle = (limits.lowest_m + limits.highest_m) / 2
            misfit = outside + 1e-3 * abs(over_m - middle)
            if misfit <= least:
                least, level = misfit, road_m[inside[k]]
    return level


@compiled
def _move(  # pragma: no cover - compiled
    around: int, height: float, limits: Limits, road_m: Floats, opened: Open
) -> None:
    """Count movement on the tiles around a detection, once a frame; unknown heights count."""
    for k in range(around):
        tile = opened.inside[k]
        over_m = height - road_m[tile] - limits.sight_over_m
        if abs(over_m) > limits.sight_level_m or opened.moved[tile] == opened.counts[FRAMES]:
            continue
        opened.moved[tile] = opened.counts[FRAMES]
        opened.movement[tile] += 1
