"""Footprints of vehicles, and the tiles whose middle cross-line they overlap at a step's begin.

A vehicle is a rectangle; a longer one the strip of its width along the path its front took: a
rectangle for each stretch of the path, with a disc at each joint between two. The overlap is the
length of the cross-line inside their union.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gis_radar.base import Booleans, Floats, Integers, compiled, ranges
from gis_radar.hdmap import SAME_LEVEL_M, quads

# Least overlap of a footprint with the middle cross-line of a tile that it occupies; or half of the
# cross-line or of the vehicle's width where that is less (the contract).
OVERLAP_M = 0.5
# Largest difference of road heights on one level (the contract): above a crossfall, below the
# clearance of a bridge.
# A longer vehicle is the strip of its width along the path its front took (the contract): the
# longest single vehicle without a joint.
_STRIP_M = 12.0
# Distance of the points of such a path: on a curve of 10 m radius its chord is 1 cm off the arc.
PATH_STEP_M = 1.0
_LOOKUP_CELL_M = 2.0  # side of a cell of the look-up; twice or half of it is as fast
_MOST_CELLS = 16_000_000  # most cells; in a larger map they are wider
_ROUNDING_M = 1e-9  # tolerance, so that rounding does not decide about an overlap on the limit
MOST_PARTS = 256  # most parts of a strip, two for each point of its path: road trains have 60


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossLines:
    """Middle cross-lines of tiles, with a look-up by place.

    Parameters
    ----------
    lines : (n, 4) array
        x, y of the right and of the left end, metres from `origin`.
    height_m : (n,) array
        Height of the road, NaN where it is not known.
    origin : (2,) array
        Origin of the coordinates, map frame, metres.
    cells : (first, tiles)
        Index of each cell's first tile in `tiles`, and the tiles by cell.
    columns, rows : int
        Numbers of cells along both axes; the first cell begins at the origin.
    cell_m : float
        Side of a cell.
    """

    lines: Floats
    height_m: Floats
    origin: Floats
    cells: tuple[Integers, NDArray[np.int32]]
    columns: int
    rows: int
    cell_m: float

    @classmethod
    def of(cls, tiles: gpd.GeoDataFrame) -> CrossLines:
        """Return the cross-lines of tiles: between the middles of their right and left sides."""
        corners = quads(tiles)
        origin = np.floor(corners.min(axis=(0, 1)))
        local = corners - origin
        right, left = local[:, :2].mean(axis=1), local[:, 2:].mean(axis=1)
        span = local.max(axis=(0, 1))
        cell_m = max(_LOOKUP_CELL_M, math.sqrt(float(span.prod()) / _MOST_CELLS))
        columns, rows = (int(side / cell_m) + 1 for side in span)
        lines = np.hstack([right, left])
        return cls(
            lines=lines, height_m=tiles["height_m"].to_numpy(np.float64), origin=origin,
            cells=_by_cell(lines, columns, rows, cell_m), columns=columns, rows=rows, cell_m=cell_m,
        )  # fmt: skip


def _by_cell(
    lines: Floats, columns: int, rows: int, cell_m: float
) -> tuple[Integers, NDArray[np.int32]]:
    """Return the index of each cell's first line, and the lines by cell whose boxes meet it."""
    low = (np.minimum(lines[:, :2], lines[:, 2:]) / cell_m).astype(np.int64)
    high = (np.maximum(lines[:, :2], lines[:, 2:]) / cell_m).astype(np.int64)
    wide, tall = (high - low + 1).T
    line = np.repeat(np.arange(len(lines)), wide * tall)
    place = ranges(np.zeros(len(lines), np.int64), wide * tall)
    column = np.minimum(low[line, 0] + place % wide[line], columns - 1)
    row = np.minimum(low[line, 1] + place // wide[line], rows - 1)
    cell = row * columns + column
    first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=columns * rows))])
    return first, line[np.argsort(cell, kind="stable")].astype(np.int32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """Footprints of states, in order of step.

    Parameters
    ----------
    step : (n,) int64 array
        The step at whose begin each footprint is.
    boxes : (n, 6) array
        x and y of the middle, cosine and sine of the heading, half the length and half the width,
        metres from the origin of the cross-lines.
    level_m : (n,) array
        Height of the road under them, NaN where it is not known.
    seen : (n,) bool array
        Whether the state was measured.
    path : (n,) int64 array
        For a strip the last point of its path behind the front; -1 for a rectangle.
    points : (m, 2) array
        The points of all paths, from the back; `begins` marks the first of each.
    begins : (m,) bool array
    """

    step: Integers
    boxes: Floats
    level_m: Floats
    seen: Booleans
    path: Integers
    points: Floats
    begins: Booleans


@dataclass(kw_only=True)
class PathBook:
    """Paths of the fronts of long vehicles, kept from batch to batch.

    Parameters
    ----------
    paths : dict
        By vehicle the (k, 2) points of its path, from the back.
    """

    paths: dict[int, Floats] = field(default_factory=dict)

    def extend(
        self, vehicle: Integers, boxes: Floats, long: Booleans
    ) -> tuple[Integers, Floats, Booleans]:
        """Extend the paths of long vehicles; return `path`, `points`, `begins` of Footprints.

        Vehicles without a state now are dropped, as states have no gaps.
        """
        path = np.full(len(vehicle), -1)
        fronts = boxes[:, :2] + boxes[:, 2:4] * boxes[:, 4:5]
        points: list[Floats] = []
        kept: dict[int, Floats] = {}
        done = 0
        for number in np.unique(vehicle[long]).tolist():
            rows = np.flatnonzero((vehicle == number) & long)
            length = 2.0 * boxes[rows[0], 4]
            start = self.paths.get(number)
            if start is None:
                start = fronts[rows[:1]] - length * boxes[rows[:1], 2:4]
            line, last = _extended(start, fronts[rows], PATH_STEP_M)
            path[rows] = done + last
            points.append(line)
            done += len(line)
            kept[number] = line[-int(length / PATH_STEP_M) - 3 :]
        self.paths = kept
        begins = np.zeros(done, np.bool_)
        if points:
            sizes = np.array([len(line) for line in points])
            begins[np.cumsum(sizes) - sizes] = True
        return path, np.concatenate([np.empty((0, 2)), *points]), begins


@compiled
def _extended(
    start: Floats, fronts: Floats, step_m: float
) -> tuple[Floats, Integers]:  # pragma: no cover - compiled
    """Extend a line by fronts a step apart; return it, and its last index at each front."""
    line = np.empty((len(start) + len(fronts), 2))
    line[: len(start)] = start
    count = len(start)
    last = np.empty(len(fronts), np.int64)
    for i in range(len(fronts)):
        last[i] = count - 1
        x, y = fronts[i, 0] - line[count - 1, 0], fronts[i, 1] - line[count - 1, 1]
        if x * x + y * y >= step_m * step_m:
            line[count] = fronts[i]
            count += 1
    return line[:count].copy(), last


def footprints_of(
    states: pd.DataFrame, vehicles: pd.DataFrame, level_m: Floats, origin: Floats, book: PathBook
) -> Footprints:
    """Return the footprints of states of vehicles whose levels are known.

    Parameters
    ----------
    states : DataFrame
        Rows of `tracks`, by step.
    vehicles : DataFrame
        The vehicles of these states.
    level_m : (n,) array
        Height of the road under each state, NaN where it is not known.
    origin : (2,) array
        Origin of the cross-lines.
    book : PathBook
        Paths of long vehicles up to now.
    """
    number = states["vehicle"].to_numpy(np.int64)
    row = np.searchsorted(vehicles["vehicle"].to_numpy(np.int64), number)
    length, width = (vehicles[name].to_numpy(float)[row] for name in ("length_m", "width_m"))
    heading = np.radians(states["heading"].to_numpy(float))
    middle = states[["easting", "northing"]].to_numpy(float) - origin
    boxes = np.column_stack([middle, np.cos(heading), np.sin(heading), length / 2, width / 2])
    boxes = np.ascontiguousarray(boxes)  # another layout would be compiled anew
    path, points, begins = book.extend(number, boxes, length > _STRIP_M)
    return Footprints(
        step=states["step"].to_numpy(np.int64), boxes=boxes, level_m=level_m,
        seen=states["seen"].to_numpy(np.bool_), path=path, points=points, begins=begins,
    )  # fmt: skip


@compiled
def clip_box(  # noqa: PLR0917 - numba takes plain numbers
    x0: float, y0: float, x1: float, y1: float,
    x: float, y: float, ahead_x: float, ahead_y: float, half_length: float, half_width: float,
) -> tuple[float, float]:  # pragma: no cover - compiled  # fmt: skip
    """Return begin and end, as shares, of a segment's part in a rectangle; empty if outside."""
    low, high = 0.0, 1.0
    for side in range(2):
        if side == 0:
            begin = (x0 - x) * ahead_x + (y0 - y) * ahead_y
            slope = (x1 - x0) * ahead_x + (y1 - y0) * ahead_y
            half = half_length
        else:
            begin = (y0 - y) * ahead_x - (x0 - x) * ahead_y
            slope = (y1 - y0) * ahead_x - (x1 - x0) * ahead_y
            half = half_width
        if slope == 0.0:
            if abs(begin) > half:
                return 1.0, 0.0
            continue
        near, far = (-half - begin) / slope, (half - begin) / slope
        if near > far:
            near, far = far, near
        low, high = max(low, near), min(high, far)
    return low, high


@compiled
def _clip_wedge(
    line: Floats, x: float, y: float, radius: float,
    from_x: float, from_y: float, to_x: float, to_y: float,
) -> tuple[float, float]:  # pragma: no cover - compiled  # fmt: skip
    """Return begin and end, as shares, of a segment's part in the wedge of a disc at a joint.

    The wedge is behind the end of the stretch in direction `from` and before the begin of that in
    direction `to`, both backwards along the path.
    """
    dx, dy, fx, fy = line[2] - line[0], line[3] - line[1], line[0] - x, line[1] - y
    square, half = dx * dx + dy * dy, fx * dx + fy * dy
    root = half * half - square * (fx * fx + fy * fy - radius * radius)
    if square == 0.0 or root <= 0.0:
        return 1.0, 0.0
    reach = math.sqrt(root)
    low, high = max(0.0, (-half - reach) / square), min(1.0, (-half + reach) / square)
    for normal_x, normal_y in ((from_x, from_y), (-to_x, -to_y)):
        begin, slope = fx * normal_x + fy * normal_y, dx * normal_x + dy * normal_y
        if slope > 0.0:
            low = max(low, -begin / slope)
        elif slope < 0.0:
            high = min(high, -begin / slope)
        elif begin < 0.0:
            return 1.0, 0.0
    return low, high


@compiled
def _union_length(shares: Floats, count: int) -> float:  # pragma: no cover - compiled
    """Return the length of the union of intervals; sorts them in place."""
    for i in range(1, count):  # few, and nearly in order
        low, high = shares[i, 0], shares[i, 1]
        k = i - 1
        while k >= 0 and shares[k, 0] > low:
            shares[k + 1, 0], shares[k + 1, 1] = shares[k, 0], shares[k, 1]
            k -= 1
        shares[k + 1, 0], shares[k + 1, 1] = low, high
    total, reached = 0.0, -1.0
    for i in range(count):
        begin = max(shares[i, 0], reached)
        if shares[i, 1] > begin:
            total += shares[i, 1] - begin
            reached = shares[i, 1]
    return total


@compiled
def overlapped_m(
    line: Floats, box: Floats, path: int, points: Floats, begins: Booleans, shares: Floats
) -> float:  # pragma: no cover - compiled
    """Return the length of a cross-line that a footprint overlaps, metres.

    Parameters
    ----------
    line : (4,) array
        Both ends.
    box, path, points, begins
        As in :class:`Footprints`, of one state.
    shares : (2 * MOST_PARTS, 2) array
        Working memory.
    """
    x0, y0, x1, y1 = line
    length = math.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
    x, y, ahead_x, ahead_y, half_length, half_width = box
    if path < 0:
        low, high = clip_box(x0, y0, x1, y1, x, y, ahead_x, ahead_y, half_length, half_width)
        return max(0.0, high - low) * length
    count, left = 0, 2.0 * half_length
    from_x, from_y = x + half_length * ahead_x, y + half_length * ahead_y
    before_x, before_y = 0.0, 0.0  # direction of the stretch before, none yet
    while left > 0.0 and count < len(shares) - 1:
        back_x, back_y = points[path, 0] - from_x, points[path, 1] - from_y
        whole = math.sqrt(back_x * back_x + back_y * back_y)
        part = left if begins[path] else min(whole, left)
        if whole > 0.0:
            back_x, back_y = back_x / whole, back_y / whole
        else:
            back_x, back_y = -ahead_x, -ahead_y
        low, high = clip_box(
            x0, y0, x1, y1, from_x + 0.5 * part * back_x, from_y + 0.5 * part * back_y,
            back_x, back_y, 0.5 * part, half_width,
        )  # fmt: skip
        if high > low:
            shares[count, 0], shares[count, 1] = low, high
            count += 1
        if part > 0.0 and (before_x != 0.0 or before_y != 0.0):
            low, high = _clip_wedge(
                line, from_x, from_y, half_width, before_x, before_y, back_x, back_y
            )
            if high > low:
                shares[count, 0], shares[count, 1] = low, high
                count += 1
        left -= part
        if begins[path]:
            break
        if part > 0.0:
            before_x, before_y = back_x, back_y
        from_x, from_y = points[path, 0], points[path, 1]
        path -= 1
    return _union_length(shares, count) * length


@compiled
def is_occupied(
    line: Floats, box: Floats, path: int, points: Floats, begins: Booleans, shares: Floats
) -> bool:  # pragma: no cover - compiled
    """Return whether a footprint overlaps a cross-line by enough to occupy its tile."""
    length = math.sqrt((line[2] - line[0]) ** 2 + (line[3] - line[1]) ** 2)
    needed = min(OVERLAP_M, 0.5 * length, box[5])
    return bool(overlapped_m(line, box, path, points, begins, shares) >= needed - _ROUNDING_M)


@compiled
def _is_apart(line: Floats, box: Floats) -> bool:  # pragma: no cover - compiled
    """Return whether a line lies ahead of a rectangle, behind, or to one side of it."""
    x0, y0, x1, y1 = line[0] - box[0], line[1] - box[1], line[2] - box[0], line[3] - box[1]
    one, other = x0 * box[2] + y0 * box[3], x1 * box[2] + y1 * box[3]
    if min(one, other) > box[4] or max(one, other) < -box[4]:
        return True
    one, other = y0 * box[2] - x0 * box[3], y1 * box[2] - x1 * box[3]
    return bool(min(one, other) > box[5] or max(one, other) < -box[5])


@compiled
def _tiles_under(  # noqa: PLR0917
    box: Floats, level_m: float, path: int, points: Floats, begins: Booleans, lines: Floats,
    height_m: Floats, first: Integers, tiles: NDArray[np.int32], columns: int, rows: int,
    cell_m: float, stamp: Integers, mark: int, shares: Floats, found: Integers,
) -> int:  # pragma: no cover - compiled  # fmt: skip
    """Write the tiles that a footprint occupies to `found`; return their number."""
    x, y, ahead_x, ahead_y, half_length, half_width = box
    reach_x = abs(ahead_x) * half_length + abs(ahead_y) * half_width
    reach_y = abs(ahead_y) * half_length + abs(ahead_x) * half_width
    if path >= 0:  # cells around its path, too
        reach_x = reach_y = 2.0 * half_length + half_width
    low_column = max(int((x - reach_x) / cell_m), 0) if x > reach_x else 0
    low_row = max(int((y - reach_y) / cell_m), 0) if y > reach_y else 0
    high_column = min(int((x + reach_x) / cell_m), columns - 1) if x > -reach_x else -1
    high_row = min(int((y + reach_y) / cell_m), rows - 1) if y > -reach_y else -1
    count = 0
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            cell = row * columns + column
            for k in range(first[cell], first[cell + 1]):
                tile = tiles[k]
                if stamp[tile] == mark:
                    continue
                stamp[tile] = mark
                if abs(height_m[tile] - level_m) > SAME_LEVEL_M:  # not a number compares false
                    continue
                if path < 0 and _is_apart(lines[tile], box):
                    continue
                if is_occupied(lines[tile], box, path, points, begins, shares):
                    found[count] = tile
                    count += 1
    return count


@compiled
def occupied_runs(  # noqa: PLR0917
    step: Integers, boxes: Floats, level_m: Floats, seen: Booleans, path: Integers,
    points: Floats, begins: Booleans, lines: Floats, height_m: Floats, first: Integers,
    tiles: NDArray[np.int32], columns: int, rows: int, cell_m: float,
    open_runs: Integers, stamps: Integers,
) -> Integers:  # pragma: no cover - compiled  # fmt: skip
    """Update the runs of occupied tiles; return those that ended: tile, first, last, seen.

    A tile that two vehicles occupy in one step is seen where one of them is.

    Parameters
    ----------
    step, boxes, level_m, seen, path, points, begins
        As of :class:`Footprints`.
    lines, height_m, first, tiles, columns, rows, cell_m
        As of :class:`CrossLines`.
    open_runs : (t, 3) int64 array
        First step, last step and `seen` of the latest run of each tile; a first step of -1 is none.
    stamps : (t, 3) int64 array
        Working memory: the last state that came near, the last step in which the tile was occupied,
        whether it was seen then; -1 at first.
    """
    out = np.empty((1024, 4), np.int64)
    done = 0
    shares = np.empty((2 * MOST_PARTS, 2))
    found = np.empty(len(lines), np.int64)
    touched = np.empty(len(lines), np.int64)
    near = stamps[:, 0]
    near[:] = -1
    state = 0
    while state < len(step):
        now, count = step[state], 0
        while state < len(step) and step[state] == now:
            under = _tiles_under(
                boxes[state], level_m[state], path[state], points, begins, lines, height_m, first,
                tiles, columns, rows, cell_m, near, state, shares, found,
            )  # fmt: skip
            for k in range(under):
                tile = found[k]
                if stamps[tile, 1] == now:
                    stamps[tile, 2] |= seen[state]
                else:
                    stamps[tile, 1], stamps[tile, 2] = now, seen[state]
                    touched[count] = tile
                    count += 1
            state += 1
        while done + count > len(out):
            wider = np.empty((2 * len(out), 4), np.int64)
            wider[:done] = out[:done]
            out = wider
        for k in range(count):
            tile = touched[k]
            run = open_runs[tile]
            if run[0] >= 0 and run[1] == now - 1 and run[2] == stamps[tile, 2]:
                run[1] = now
                continue
            if run[0] >= 0:
                out[done, 0] = tile
                out[done, 1:] = run
                done += 1
            run[0], run[1], run[2] = now, now, stamps[tile, 2]
    return out[:done].copy()  # its end is empty
