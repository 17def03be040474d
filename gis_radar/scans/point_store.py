"""Keep points on the road by block of half-metre cells, in memory or in a folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.scans.roads import RoadLevel, Roads
from gis_radar.scans.scan import is_road_class, never_road

CELL_M = 0.5
BLOCK_CELLS = 512
BLOCK_M = CELL_M * BLOCK_CELLS
OUTSIDE, INSIDE, EDGE = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class RoadBlocks:
    """Blocks of cells that hold roads; cells begin at multiples of `CELL_M`, blocks of `BLOCK_M`.

    Parameters
    ----------
    roads : Roads
        What is road.
    columns, rows : (n,) int64 arrays
        Place of each block, in blocks from the origin of the coordinate system.
    shapes : list of geometry
        The roads in each block, prepared for asking whether they hold a point.
    """

    roads: Roads
    columns: Integers = field(repr=False)
    rows: Integers = field(repr=False)
    shapes: list[Any] = field(repr=False)

    @cached_property
    def states(self) -> NDArray[np.uint8]:
        """For each block whether its cells lie outside the roads, inside, or on their edge."""
        return np.stack([_states(shape, *place) for place, shape in self._blocks()])

    @cached_property
    def level_masks(self) -> list[Booleans]:
        """For each level, block, row and column, whether the cell's centre is on a road."""
        if len(self.roads.levels) == 1:
            shapes = [self.shapes]
        else:
            shapes = [[_near(level, *place) for place, _ in self._blocks()]
                      for level in self.roads.levels]  # fmt: skip
        places = [place for place, _ in self._blocks()]
        return [
            np.stack([centres_in(shape, column * BLOCK_M, row * BLOCK_M)
                      for (column, row), shape in zip(places, some, strict=True)])
            for some in shapes
        ]  # fmt: skip

    def window(self, masks: Booleans, block: int, margin: int) -> Booleans:
        """Return the cells of a block with a margin of so many cells from the blocks around it."""
        size = BLOCK_CELLS + 2 * margin
        whole = np.zeros((size, size), bool)
        for number in self.neighbours(block).tolist():
            up, across = (
                int(side[number] - side[block]) * BLOCK_CELLS + margin
                for side in (self.rows, self.columns)
            )
            to_rows, from_rows = _overlap(up, size)
            to_columns, from_columns = _overlap(across, size)
            whole[to_rows, to_columns] = masks[number][from_rows, from_columns]
        return whole

    @cached_property
    def _lookup(self) -> NDArray[np.int32]:
        """Number of each block by place, -1 where there is none."""
        size = (int(np.ptp(self.columns)) + 1, int(np.ptp(self.rows)) + 1)
        lookup = np.full(size, -1, np.int32)
        lookup[self.columns - self.columns.min(), self.rows - self.rows.min()] = np.arange(
            len(self.columns)
        )
        return lookup

    def _blocks(self) -> Iterator[tuple[tuple[int, int], Any]]:
        return zip(
            zip(self.columns.tolist(), self.rows.tolist(), strict=True), self.shapes, strict=True
        )

    def on_road(self, x: Floats, y: Floats) -> tuple[Integers, Integers]:
        """Find the points that lie on a road, exactly.

        Returns
        -------
        point, block : (k,) int64 arrays
            Positions in the inputs, ascending, and the number of the block.
        """
        column = np.floor(x / CELL_M).astype(np.int64)
        row = np.floor(y / CELL_M).astype(np.int64)
        block = self._block_of(column // BLOCK_CELLS, row // BLOCK_CELLS)
        point = np.flatnonzero(block >= 0)
        block = block[point]
        state = self.states[block, row[point] % BLOCK_CELLS, column[point] % BLOCK_CELLS]
        kept = state != OUTSIDE
        point, block, state = point[kept], block[kept], state[kept]
        inside = state == INSIDE
        edge = np.flatnonzero(state == EDGE)
        for number in np.unique(block[edge]):
            some = edge[block[edge] == number]
            there = point[some]
            inside[some] = shapely.intersects_xy(self.shapes[number], x[there], y[there])
        return point[inside], block[inside].astype(np.int64)

    def _block_of(self, across: Integers, up: Integers) -> NDArray[np.int32]:
        lookup = self._lookup
        across, up = across - self.columns.min(), up - self.rows.min()
        known = (across >= 0) & (up >= 0) & (across < lookup.shape[0]) & (up < lookup.shape[1])
        return np.where(known, lookup[np.where(known, across, 0), np.where(known, up, 0)], -1)

    def neighbours(self, block: int) -> Integers:
        """Return a block and those around it, as far as they hold roads."""
        across, up = (side.ravel() for side in np.mgrid[-1:2, -1:2])
        found = self._block_of(self.columns[block] + across, self.rows[block] + up)
        return found[found >= 0].astype(np.int64)

    def corner(self, block: int) -> tuple[float, float]:
        """Return the south-west corner of a block, metres."""
        return float(self.columns[block] * BLOCK_M), float(self.rows[block] * BLOCK_M)


def blocks_of(roads: Roads) -> RoadBlocks:
    """Cut the roads into blocks."""
    parts = np.asarray(shapely.get_parts(roads.area))
    tree = shapely.STRtree(parts)
    west, south, east, north = (int(np.floor(side / BLOCK_M)) for side in roads.area.bounds)
    places, shapes = [], []
    for column in range(west, east + 1):
        strip = (column * BLOCK_M, south * BLOCK_M, (column + 1) * BLOCK_M, (north + 1) * BLOCK_M)
        near = shapely.clip_by_rect(parts[tree.query(shapely.box(*strip))], *strip)
        for row in range(south, north + 1):
            box = (strip[0], row * BLOCK_M, strip[2], (row + 1) * BLOCK_M)
            inside = shapely.union_all(shapely.clip_by_rect(near, *box))
            if shapely.area(inside) > 0.0:
                places.append((column, row))
                shapes.append(inside)
    shapely.prepare(shapes)
    columns, rows = np.array(places, dtype=np.int64).T
    return RoadBlocks(roads=roads, columns=columns, rows=rows, shapes=shapes)


def centres_in(shapes: Any, west: float, south: float) -> Booleans:
    """Return which cells of a block have their centre in any shape; rows run from the south."""
    some = [shape for shape in np.atleast_1d(shapes) if not shapely.is_empty(shape)]
    size = (BLOCK_CELLS, BLOCK_CELLS)
    if not some:
        return np.zeros(size, bool)
    grid = Affine(CELL_M, 0.0, west, 0.0, CELL_M, south)
    return np.asarray(rasterize(some, size, transform=grid, dtype="uint8")).astype(bool)


def _near(level: RoadLevel, column: int, row: int) -> Any:
    """Return the part of a level in a block."""
    box = column * BLOCK_M, row * BLOCK_M, (column + 1) * BLOCK_M, (row + 1) * BLOCK_M
    shapes = np.asarray(level.shapes)[level.tree.query(shapely.box(*box))]
    return shapely.union_all(shapely.clip_by_rect(shapes, *box))


def _overlap(begin: int, size: int) -> tuple[slice, slice]:
    """Return where a block that begins at a cell of a window lies in it, and which part of it."""
    low, high = max(begin, 0), min(begin + BLOCK_CELLS, size)
    return slice(low, high), slice(low - begin, high - begin)


def _states(shape: Any, column: int, row: int) -> NDArray[np.uint8]:
    west, south = column * BLOCK_M, row * BLOCK_M
    inside = centres_in(shape, west, south)
    grid = Affine(CELL_M, 0.0, west, 0.0, CELL_M, south)
    touched = rasterize(
        [shapely.boundary(shape)], (BLOCK_CELLS, BLOCK_CELLS), transform=grid, all_touched=True,
        dtype="uint8",
    )  # fmt: skip
    edge = np.asarray(touched).astype(bool)
    # A cell whose neighbour lies on the other side is on the edge, however the line was rounded.
    for axis in (0, 1):
        change = np.diff(inside.astype(np.int8), axis=axis) != 0
        ahead, behind = [slice(None)] * 2, [slice(None)] * 2
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        edge[tuple(ahead)] |= change
        edge[tuple(behind)] |= change
    return np.where(edge, EDGE, np.where(inside, INSIDE, OUTSIDE)).astype(np.uint8)


MOST_KEPT = 1_000_000
_MM = 1000.0
# Equal points are found by sorting one number each: 20 bits north, 20 east, 22 up, 1 for ground.
_SHIFT, _MOST_TALL = 100_000, 2**22 - 1
# Millimetres from the block's corner: a third of a float64, and equal points are equal.
RECORD = np.dtype(
    [("x", np.int32), ("y", np.int32), ("z", np.int32), ("category", np.uint8), ("scan", np.uint16)]
)


class PointStore:
    """Points on the roads of a site.

    What comes out depends on the points alone, not on the order or the pieces in which they came.
    `counts` has for each scan the number of points of each class.

    Parameters
    ----------
    blocks : RoadBlocks
        The blocks.
    folder : Path
        Where points go when they become many; must exist.
    """

    def __init__(self, blocks: RoadBlocks, folder: Path) -> None:
        self.blocks = blocks
        self.counts: dict[int, Integers] = defaultdict(lambda: np.zeros(256, np.int64))
        self._folder = folder
        self._kept: dict[int, list[Any]] = {}
        self._in_memory = 0
        self._ground = np.zeros(2**16, bool)

    @property
    def total(self) -> int:
        """How many points were added."""
        return sum(int(count.sum()) for count in self.counts.values())

    def classified(self, scan: int, *, ground: bool) -> None:
        """Say whether a scan's classes tell ground from the rest."""
        self._ground[scan] = ground

    def add(self, xyz: Floats, category: Any, block: Integers, scan: int) -> None:
        """Add points that lie in blocks.

        Parameters
        ----------
        xyz : (n, 3) array
            Metres, in the map.
        category : (n,) uint8 array
            ASPRS classes.
        block : (n,) int64 array
            Number of the block of each.
        scan : int
            Which scan they come from.
        """
        if len(block) == 0:
            return
        order = np.argsort(block, kind="stable")
        numbers, begins = np.unique(block[order], return_index=True)
        for number, rows in zip(numbers.tolist(), np.split(order, begins[1:]), strict=True):
            west, south = self.blocks.corner(number)
            records = np.empty(len(rows), RECORD)
            for name, column, origin in (("x", 0, west), ("y", 1, south), ("z", 2, 0.0)):
                records[name] = np.rint((xyz[rows, column] - origin) * _MM)
            records["category"], records["scan"] = category[rows], scan
            self._kept.setdefault(number, []).append(records)
        self.counts[scan] += np.bincount(category, minlength=256)
        self._in_memory += len(block)
        if self._in_memory > MOST_KEPT:
            self._flush()

    def _flush(self) -> None:
        for number, parts in self._kept.items():
            with (self._folder / f"{number}.points").open("ab") as file:
                for part in parts:
                    part.tofile(file)
        self._kept, self._in_memory = {}, 0

    def points(self, block: int, margin_m: float = 0.0) -> tuple[Floats, Booleans]:
        """Return the points of a block and of a margin around it, each once, in a fixed order.

        Parameters
        ----------
        block : int
            Number of the block.
        margin_m : float
            Up to how far around it, metres; at most a block, and less than 100 m.

        Returns
        -------
        xyz : (n, 3) array
            Metres from the block's south-west corner; heights as they are.
        ground : (n,) bool array
            Whether a point is road by its class, or by lack of any.
        """
        west, south = self.blocks.corner(block)
        low, high = -margin_m * _MM, (BLOCK_M + margin_m) * _MM
        parts = []
        for number in self.blocks.neighbours(block).tolist() if margin_m else [block]:
            records = self._records(number)
            for name, shift in zip("xy", self.blocks.corner(number), strict=True):
                records[name] += np.int32((shift - (west if name == "x" else south)) * _MM)
            if number != block:
                x, y = records["x"], records["y"]
                records = records[(x >= low) & (x < high) & (y >= low) & (y < high)]
            parts.append(records)
        records = np.concatenate(parts)
        records = records[~never_road(records["category"])]
        by_class = self._ground[records["scan"]]
        return _each_once(records, ~by_class | is_road_class(records["category"]))

    def _records(self, block: int) -> Any:
        parts = list(self._kept.get(block, []))
        file = self._folder / f"{block}.points"
        if file.exists():
            parts.append(np.fromfile(file, RECORD))
        return np.concatenate(parts) if parts else np.empty(0, RECORD)


def _each_once(records: Any, ground: Booleans) -> tuple[Floats, Booleans]:
    """Sort points; of equal ones, as tiles that overlap give them, keep one, rather as ground."""
    if len(records) == 0:
        return np.empty((0, 3)), np.empty(0, bool)
    bottom = int(records["z"].min())
    tall = np.minimum(records["z"].astype(np.int64) - bottom, _MOST_TALL)
    key = (records["y"].astype(np.int64) + _SHIFT) << 20
    key = ((key | (records["x"].astype(np.int64) + _SHIFT)) << 22 | tall) << 1 | ~ground
    key.sort()
    new = np.ones(len(key), bool)
    new[1:] = np.diff(key >> 1) != 0
    key = key[new]
    place = key >> 1
    columns = [
        (place >> 22 & 0xFFFFF) - _SHIFT, (place >> 42) - _SHIFT, (place & _MOST_TALL) + bottom
    ]  # fmt: skip
    return np.column_stack(columns) / _MM, (key & 1) == 0
