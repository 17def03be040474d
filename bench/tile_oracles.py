"""Other ways to find the tiles of points: oracles of the tests, and peers of the compiled code.

They share the edges of `TileGrid`, so that points on an edge have one answer; the search for
candidates, and the test, are their own.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from rtree import index as rtree_index

from gis_radar.base import Floats, Integers
from gis_radar.hdmap import TileGrid


class TileGridNumpy(TileGrid):
    """Grid with the same cells and the same test as `TileGrid`, without compiled code."""

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
        inside = _in_tiles(cells.edges[tile], points[point])
        return point[inside], tile[inside]


class TileTree:
    """The paper's R-tree over the tiles' bounding boxes ("Local Sensor Data Processing").

    Parameters
    ----------
    quads : (n, 4, 2) array
        Vertices of the tiles in order around them; map frame, metres.
    """

    def __init__(self, quads: Floats) -> None:
        cells = TileGrid(quads).cells
        self._origin, self._edges = (cells.west, cells.south), cells.edges
        local = quads - self._origin
        boxes = np.hstack([local.min(axis=1), local.max(axis=1)])
        entries = ((i, tuple(box), None) for i, box in enumerate(boxes.tolist()))
        self._tree = rtree_index.Index(entries) if len(boxes) else rtree_index.Index()

    def assign(self, easting: Floats, northing: Floats) -> tuple[Integers, Integers]:
        """Return the pairs (point, tile)."""
        points = np.column_stack([easting, northing]) - self._origin
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        tiles, counts = self._tree.intersection_v(  # type: ignore[no-untyped-call]
            points[finite], points[finite]
        )
        point = np.repeat(finite, counts.astype(np.int64))
        tile = np.asarray(tiles, dtype=np.int64)
        inside = _in_tiles(self._edges[tile], points[point])
        order = np.lexsort((tile[inside], point[inside]))
        return point[inside][order], tile[inside][order]


TileEngine: TypeAlias = TileGrid | TileTree
"""A class that finds the tiles of points."""


def _in_tiles(edges: Floats, points: Floats) -> NDArray[np.bool_]:
    """Return for each row whether the point is in the tile with these (n, 4, 4) edges."""
    x, y = points[:, None, 0], points[:, None, 1]
    low, high, x_low, slope = np.moveaxis(edges, 1, 0)
    crossed = (low <= y) & (y < high) & (x >= x_low + (y - low) * slope)
    return np.asarray(np.bitwise_xor.reduce(crossed, axis=1))
