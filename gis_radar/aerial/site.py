"""The site in square blocks: which half-metre cells and which points are road."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize

from gis_radar.aerial.levels import Level
from gis_radar.aerial.roads import Roads
from gis_radar.arrays import Booleans, Floats, Integers

CELL_M = 0.5
BLOCK_CELLS = 512
BLOCK_M = CELL_M * BLOCK_CELLS
OUTSIDE, INSIDE, EDGE = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class Site:
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


def site_of(roads: Roads) -> Site:
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
    return Site(roads=roads, columns=columns, rows=rows, shapes=shapes)


def centres_in(shapes: Any, west: float, south: float) -> Booleans:
    """Return which cells of a block have their centre in any shape; rows run from the south."""
    some = [shape for shape in np.atleast_1d(shapes) if not shapely.is_empty(shape)]
    size = (BLOCK_CELLS, BLOCK_CELLS)
    if not some:
        return np.zeros(size, bool)
    grid = Affine(CELL_M, 0.0, west, 0.0, CELL_M, south)
    return np.asarray(rasterize(some, size, transform=grid, dtype="uint8")).astype(bool)


def _near(level: Level, column: int, row: int) -> Any:
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
