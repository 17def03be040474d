"""Keep points on the road by block of half-metre cells, in memory or in a folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from gis_radar.base import CELL_M, Booleans, Box, Floats, Grid, InputError, Integers
from gis_radar.scans.roads import Roads
from gis_radar.scans.scan import NEVER_CLASSES, ROAD_CLASSES

BLOCK_CELLS = 512
BLOCK_M = CELL_M * BLOCK_CELLS
OUTSIDE, INSIDE, EDGE = 0, 1, 2
# Roads in more squares are no site: these are a city of 16 by 16 km, without a gap. Each takes
# 10 ms and more with points.
MOST_BLOCKS = 4_000
MOST_STATES = 512  # blocks whose cells are kept: 128 MiB


@dataclass(frozen=True, kw_only=True)
class RoadBlocks:
    """Blocks of cells that hold roads.

    Parameters
    ----------
    roads : Roads
        What is road.
    grid : Grid
        Blocks around all roads.
    columns, rows : (n,) int64 arrays
        Which of them hold roads.
    shapes : list of geometry
        The roads in each block, prepared for asking whether they hold a point.
    """

    roads: Roads
    grid: Grid = field(repr=False)
    columns: Integers = field(repr=False)
    rows: Integers = field(repr=False)
    shapes: list[Any] = field(repr=False)

    def cells(self, block: int, margin: int = 0) -> Grid:
        """Return the cells of a block, with a margin of so many."""
        return Grid(
            cell_m=CELL_M,
            west=(self.grid.west + int(self.columns[block])) * BLOCK_CELLS - margin,
            south=(self.grid.south + int(self.rows[block])) * BLOCK_CELLS - margin,
            columns=BLOCK_CELLS + 2 * margin,
            rows=BLOCK_CELLS + 2 * margin,
        )

    @cached_property
    def _states_of(self) -> Callable[[int], NDArray[np.uint8]]:
        """For a block whether its cells are outside the roads, inside, or on their edge."""
        return lru_cache(MOST_STATES)(lambda block: _states(self.shapes[block], self.cells(block)))

    @cached_property
    def level_shapes(self) -> list[list[Any]]:
        """For each level, its part in each block."""
        if len(self.roads.levels) == 1:
            return [self.shapes]
        boxes = [self.cells(block).bounds for block in range(len(self.shapes))]
        return [_pieces(np.asarray(level.shapes), boxes) for level in self.roads.levels]

    def area(self, level: int, block: int, margin: int) -> Booleans:
        """Return which cells of a block and of a margin have their centre on a level's roads."""
        shapes = self.level_shapes[level]
        near = [shapes[number] for number in self.neighbours(block).tolist()]
        return centres_in(near, self.cells(block, margin))

    @cached_property
    def _lookup(self) -> NDArray[np.int32]:
        """Number of each block by place, -1 where there is none."""
        lookup = np.full((self.grid.columns, self.grid.rows), -1, np.int32)
        lookup[self.columns, self.rows] = np.arange(len(self.columns))
        return lookup

    def on_road(self, x: Floats, y: Floats) -> tuple[Integers, Integers]:
        """Find the points that are on a road, exactly.

        Returns
        -------
        point, block : (k,) int64 arrays
            Positions in the inputs, ascending, and the number of the block.
        """
        block = self._block_of(*self.grid.cells(x, y))
        point = np.flatnonzero(block >= 0)
        block = block[point]
        column, row = (
            np.floor_divide(side[point], CELL_M).astype(np.int64) % BLOCK_CELLS for side in (x, y)
        )
        state = np.empty(len(block), np.uint8)
        for number, rows in _by_block(block):
            state[rows] = self._states_of(number)[row[rows], column[rows]]
        kept = state != OUTSIDE
        point, block, state = point[kept], block[kept], state[kept]
        inside = state == INSIDE
        edge = np.flatnonzero(state == EDGE)
        for number in np.unique(block[edge]):
            some = edge[block[edge] == number]
            there = point[some]
            inside[some] = shapely.intersects_xy(self.shapes[number], x[there], y[there])
        return point[inside], block[inside].astype(np.int64)

    def _block_of(self, column: Integers, row: Integers) -> NDArray[np.int32]:
        known = self.grid.holds(column, row)
        found = self._lookup[np.where(known, column, 0), np.where(known, row, 0)]
        return np.where(known, found, -1)

    def neighbours(self, block: int) -> Integers:
        """Return a block and those around it, as far as they hold roads."""
        across, up = (side.ravel() for side in np.mgrid[-1:2, -1:2])
        found = self._block_of(self.columns[block] + across, self.rows[block] + up)
        return found[found >= 0].astype(np.int64)


def cut_into_blocks(roads: Roads) -> RoadBlocks:
    """Cut the roads into blocks.

    Raises
    ------
    InputError
        If they fill more blocks than a site has.
    """
    parts = np.asarray(shapely.get_parts(roads.area))
    tree = shapely.STRtree(parts)
    west, south, east, north = roads.area.bounds
    grid = Grid.around((west, east), (south, north), BLOCK_M)
    places, shapes = [], []
    for column in range(grid.columns):
        strip = replace(grid, west=grid.west + column, columns=1)
        near = parts[tree.query(shapely.box(*strip.bounds))]
        near = shapely.clip_by_rect(near, *strip.bounds)
        if len(near) == 0:
            continue
        for row in range(grid.rows):
            box = replace(strip, south=grid.south + row, rows=1).bounds
            inside = shapely.union_all(shapely.clip_by_rect(near, *box))
            if shapely.area(inside) > 0.0:
                places.append((column, row))
                shapes.append(inside)
        if len(places) > MOST_BLOCKS:
            raise InputError(
                "{}: its roads fill over {:,} squares of {:.0f} m, which is no site",
                roads.source,
                MOST_BLOCKS,
                BLOCK_M,
                hint="cut out the roads around the scans",
            )
    shapely.prepare(shapes)
    columns, rows = np.array(places, dtype=np.int64).T
    return RoadBlocks(roads=roads, grid=grid, columns=columns, rows=rows, shapes=shapes)


def _by_block(block: NDArray[Any]) -> Iterator[tuple[int, Integers]]:
    """Yield each block and the places at which it stands, in their order."""
    order = np.argsort(block, kind="stable")
    numbers, begins = np.unique(block[order], return_index=True)
    yield from zip(numbers.tolist(), np.split(order, begins)[1:], strict=True)


def centres_in(shapes: Any, cells: Grid) -> Booleans:
    """Return which cells have their centre in any shape; rows run from the south."""
    some = [shape for shape in np.atleast_1d(shapes) if not shapely.is_empty(shape)]
    return _burnt(some, cells) if some else np.zeros((cells.rows, cells.columns), bool)


def _burnt(shapes: list[Any], cells: Grid, *, touched: bool = False) -> Booleans:
    """Return which cells have their centre in any shape, or are touched by one."""
    from rasterio.features import rasterize  # noqa: PLC0415 - most commands need none

    size = (cells.rows, cells.columns)
    burnt = rasterize(shapes, size, transform=cells.transform, all_touched=touched, dtype="uint8")
    return np.asarray(burnt).astype(bool)


def _pieces(shapes: Any, boxes: list[Box]) -> list[Any]:
    """Return the part of shapes in each box."""
    tree = shapely.STRtree(shapes)
    near = [shapes[tree.query(shapely.box(*box))] for box in boxes]
    pairs = zip(near, boxes, strict=True)
    return [shapely.union_all(shapely.clip_by_rect(some, *box)) for some, box in pairs]


def _states(shape: Any, cells: Grid) -> NDArray[np.uint8]:
    inside = centres_in(shape, cells)
    edge = _burnt([shapely.boundary(shape)], cells, touched=True)
    # A cell whose neighbour is on the other side is on the edge, however the line was rounded.
    cross = ndimage.generate_binary_structure(2, 1)
    edge |= ndimage.morphological_gradient(inside.astype(np.uint8), footprint=cross) > 0
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
        """Set whether a scan's classes distinguish ground."""
        self._ground[scan] = ground

    def add(self, xyz: Floats, category: Any, block: Integers, scan: int) -> None:
        """Add points of blocks.

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
        for number, rows in _by_block(block):
            west, south = self.blocks.cells(number).corner
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
        west, south = self.blocks.cells(block).corner
        low, high = -margin_m * _MM, (BLOCK_M + margin_m) * _MM
        parts = []
        for number in self.blocks.neighbours(block).tolist() if margin_m else [block]:
            records = self._records(number)
            for name, shift in zip("xy", self.blocks.cells(number).corner, strict=True):
                records[name] += np.int32((shift - (west if name == "x" else south)) * _MM)
            if number != block:
                x, y = records["x"], records["y"]
                records = records[(x >= low) & (x < high) & (y >= low) & (y < high)]
            parts.append(records)
        records = np.concatenate(parts)
        records = records[~np.isin(records["category"], NEVER_CLASSES)]
        by_class = self._ground[records["scan"]]
        return _each_once(records, ~by_class | np.isin(records["category"], ROAD_CLASSES))

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
