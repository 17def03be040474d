"""Points to tiles without compiled code: oracles of the tests, and yardsticks for our look-up."""

from __future__ import annotations

import numpy as np
from rtree import index as rtree_index

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.hdmap import TileGrid


class TileGridNumpy(TileGrid):
    """The same cells and the same test in NumPy alone: all candidates at once."""

    def assign(self, easting: Floats, northing: Floats) -> tuple[Integers, Integers]:
        """Return the pairs (point, tile)."""
        cells = self.cells
        points = np.column_stack([easting, northing]) - (cells.west, cells.south)
        span = (cells.width, cells.height)
        within = np.flatnonzero(((points >= 0.0) & (points <= span)).all(axis=1))
        column, row = (points[within] * (1.0 / cells.cell_m)).astype(np.int64).T
        cell = row * cells.columns + column + 1
        counts = cells.first[cell + 1] - cells.first[cell]
        begins = np.cumsum(counts) - counts
        point = np.repeat(within, counts)
        nth = np.arange(len(point)) - np.repeat(begins, counts)
        tile = cells.tiles[np.repeat(cells.first[cell], counts) + nth].astype(np.int64)
        inside = _inside(cells.edges[tile], points[point])
        return point[inside], tile[inside]


class TileTree(TileGrid):
    """The paper's R-tree over the tiles' bounding boxes, then the exact test."""

    def __init__(self, quads: Floats) -> None:
        super().__init__(quads)
        local = quads - (self.cells.west, self.cells.south)
        boxes = np.hstack([local.min(axis=1), local.max(axis=1)])
        entries = ((i, tuple(box), None) for i, box in enumerate(boxes.tolist()))
        self._tree = rtree_index.Index(entries) if len(boxes) else rtree_index.Index()

    def assign(self, easting: Floats, northing: Floats) -> tuple[Integers, Integers]:
        """Return the pairs (point, tile)."""
        points = np.column_stack([easting, northing]) - (self.cells.west, self.cells.south)
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        tiles, counts = self._tree.intersection_v(  # type: ignore[no-untyped-call]
            points[finite], points[finite]
        )
        point = np.repeat(finite, counts.astype(np.int64))
        tile = np.asarray(tiles, dtype=np.int64)
        inside = _inside(self.cells.edges[tile], points[point])
        order = np.lexsort((tile[inside], point[inside]))
        return point[inside][order], tile[inside][order]


def _inside(edges: Floats, points: Floats) -> Booleans:
    """Return for each row whether the point is in the tile with these (n, 4, 4) edges."""
    x, y = points[:, None, 0], points[:, None, 1]
    low, high, x_low, slope = np.moveaxis(edges, 1, 0)
    crossed = (low <= y) & (y < high) & (x >= x_low + (y - low) * slope)
    return np.asarray(np.bitwise_xor.reduce(crossed, axis=1))
