"""Assignment of points to tiles in NumPy alone: oracle of the tests, and peer of compiled code."""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats, Integers
from gis_radar.hdmap import TileGrid
from gis_radar.hdmap.tile_lookup import inside_quads


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
        inside = inside_quads(cells.edges[tile], points[point])
        return point[inside], tile[inside]
