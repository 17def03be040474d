"""Store points on roads by blocks of half-metre cells, in memory or in a folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from gis_radar.base import CELL_M, Booleans, Box, Floats, Grid, InputError, Integers
from gis_radar.scans.roads import Roads
from gis_radar.scans.scan import NEVER_CLASSES, ROAD_CLASSES, Points
from gis_radar.scans.shift import columns_around

BLOCK_CELLS = 512  # side of a block, cells
BLOCK_M = CELL_M * BLOCK_CELLS
# Roads in more blocks are no site: so many cover a city of 16 by 16 km. Each takes 10 ms, and more
# with points.
MOST_BLOCKS = 4_000


@dataclass(frozen=True, kw_only=True)
class RoadBlocks:
    """Blocks of cells that hold roads.

    Parameters
    ----------
    roads : Roads
        The roads.
    grid : Grid
        Grid of all blocks around them.
    columns, rows : (n,) int64 arrays
        Place in the grid of each block that holds roads.
    shapes : list of geometry
        The roads in each block, prepared for tests with points.
    """

    roads: Roads
    grid: Grid = field(repr=False)
    columns: Integers = field(repr=False)
    rows: Integers = field(repr=False)
    shapes: list[Any] = field(repr=False)

    def cells(self, block: int, margin: int = 0) -> Grid:
        """Return the grid of a block's cells, with a margin of some cells around it."""
        return Grid(
            cell_m=CELL_M,
            west=(self.grid.west + int(self.columns[block])) * BLOCK_CELLS - margin,
            south=(self.grid.south + int(self.rows[block])) * BLOCK_CELLS - margin,
            columns=BLOCK_CELLS + 2 * margin,
            rows=BLOCK_CELLS + 2 * margin,
        )

    @cached_property
    def level_shapes(self) -> list[list[Any]]:
        """For each level, its roads in each block."""
        if len(self.roads.levels) == 1:
            return [self.shapes]
        boxes = [self.cells(block).bounds for block in range(len(self.shapes))]
        return [_clipped(np.asarray(level.shapes), boxes) for level in self.roads.levels]

    def area(self, level: int, block: int, margin: int) -> Booleans:
        """Return which cells of a block and a margin have their centre on roads of a level."""
        shapes = self.level_shapes[level]
        near = [shapes[number] for number in self.neighbours(block).tolist()]
        return _centres_in(near, self.cells(block, margin))

    @cached_property
    def _lookup(self) -> NDArray[np.int16]:
        """Number of each block by its place in the grid, -1 for none; 16 bits sort faster."""
        lookup = np.full((self.grid.columns, self.grid.rows), -1, np.int16)
        lookup[self.columns, self.rows] = np.arange(len(self.columns))
        return lookup

    def on_road(self, x: Floats, y: Floats) -> Iterator[tuple[int, Integers]]:
        """Yield each block's number with the ascending indices of the points on its roads."""
        block = self._block_of(*self.grid.cells(x, y))
        point = np.flatnonzero(block >= 0)
        point = point[np.argsort(block[point], kind="stable")]
        numbers, begins = np.unique(block[point], return_index=True)
        for number, rows in zip(numbers.tolist(), np.split(point, begins)[1:], strict=True):
            yield number, rows[shapely.intersects_xy(self.shapes[number], x[rows], y[rows])]

    def _block_of(self, column: Integers, row: Integers) -> NDArray[np.int16]:
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


def _centres_in(shapes: Any, cells: Grid) -> Booleans:
    """Return which cells have their centre in any shape; rows run from the south."""
    from rasterio.features import rasterize  # noqa: PLC0415 - most commands need none

    some = [shape for shape in np.atleast_1d(shapes) if not shapely.is_empty(shape)]
    size = (cells.rows, cells.columns)
    if not some:
        return np.zeros(size, np.bool_)
    return np.asarray(rasterize(some, size, transform=cells.transform, dtype="uint8")).astype(bool)


def _clipped(shapes: Any, boxes: list[Box]) -> list[Any]:
    """Return the part of shapes in each box."""
    tree = shapely.STRtree(shapes)
    near = [shapes[tree.query(shapely.box(*box))] for box in boxes]
    pairs = zip(near, boxes, strict=True)
    return [shapely.union_all(shapely.clip_by_rect(some, *box)) for some, box in pairs]


MOST_IN_MEMORY = 1_000_000  # points in memory
_MM = 1000.0  # in a metre
# Millimetres from the block's corner: smaller than float64, and exact for equal points.
_RECORD = np.dtype(
    [("x", np.int32), ("y", np.int32), ("z", np.int32), ("category", np.uint8), ("scan", np.uint16)]
)


class PointStore:
    """Store of the points on the roads of a site.

    What it returns depends on the points alone, not on the order or the batches in which they were
    added. `counts` has, for each scan, the number of points of each class, `around` the columns of
    the roads and of what lies beside them.

    Parameters
    ----------
    blocks : RoadBlocks
        The blocks.
    folder : Path
        An existing folder, for points over `MOST_IN_MEMORY`.
    """

    def __init__(self, blocks: RoadBlocks, folder: Path) -> None:
        self.blocks, self.around = blocks, columns_around(blocks.roads.area)
        self.counts: dict[int, Integers] = defaultdict(lambda: np.zeros(256, np.int64))
        self._folder = folder
        self._by_block_number: dict[int, list[Any]] = {}
        self._in_memory = 0
        self._ground = np.zeros(2**16, bool)

    @property
    def total(self) -> int:
        """Number of points added."""
        return sum(int(count.sum()) for count in self.counts.values())

    def classified(self, scan: int, *, ground: bool) -> None:
        """Set whether a scan's classes distinguish ground."""
        self._ground[scan] = ground

    def add(self, batch: Points, scan: int) -> list[float]:
        """Add the points of a batch that are on roads.

        Parameters
        ----------
        batch : Points
            In the map.
        scan : int
            Number of their scan.

        Returns
        -------
        list of float
            Their earliest and latest GPS time in each block, where they have one.
        """
        times: list[float] = []
        for number, rows in self.blocks.on_road(batch.x, batch.y):
            records = np.empty(len(rows), _RECORD)
            corner = (*self.blocks.cells(number).corner, 0.0)
            for name, values, origin in zip("xyz", batch[:3], corner, strict=True):
                records[name] = np.rint((values[rows] - origin) * _MM)
            records["category"], records["scan"] = batch.category[rows], scan
            self._by_block_number.setdefault(number, []).append(records)
            self.counts[scan] += np.bincount(records["category"], minlength=256)
            self._in_memory += len(rows)
            if batch.gps_time is not None and len(rows):
                times += [float(batch.gps_time[rows].min()), float(batch.gps_time[rows].max())]
        if self._in_memory > MOST_IN_MEMORY:
            self._flush()
        return times

    def _flush(self) -> None:
        for number, parts in self._by_block_number.items():
            with (self._folder / f"{number}.points").open("ab") as file:
                for part in parts:
                    part.tofile(file)
        self._by_block_number, self._in_memory = {}, 0

    def points(self, block: int, margin_m: float = 0.0) -> tuple[Floats, Booleans]:
        """Return the points of a block and of a margin around it, each once, in a fixed order.

        Parameters
        ----------
        block : int
            Number of the block.
        margin_m : float
            Width of the margin, metres: at most a block, and less than 100 m.

        Returns
        -------
        xyz : (n, 3) array
            Metres from the block's south-west corner; heights unchanged.
        ground : (n,) bool array
            Whether a point may be road: by its class, or because its scan is not classified.
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
        return _unique_points(records, ~by_class | np.isin(records["category"], ROAD_CLASSES))

    def _records(self, block: int) -> Any:
        parts = list(self._by_block_number.get(block, []))
        file = self._folder / f"{block}.points"
        if file.exists():
            parts.append(np.fromfile(file, _RECORD))
        return np.concatenate(parts) if parts else np.empty(0, _RECORD)


def _unique_points(records: Any, ground: Booleans) -> tuple[Floats, Booleans]:
    """Return sorted points; of equal ones (of overlapping scans) one, as ground if any is."""
    order = np.lexsort((~ground, records["z"], records["x"], records["y"]))
    places = np.column_stack([records[axis][order] for axis in "xyz"])
    new = np.ones(len(places), np.bool_)
    new[1:] = (places[1:] != places[:-1]).any(axis=1)
    return places[new] / _MM, ground[order][new]
