"""Find the tiles that points fall in.

A point is in a tile by the number of edges that a ray to the west crosses. Each edge is stored in
one direction, the same for both tiles that it bounds: the arithmetic is the same, so a point on it
is in exactly one of them.

The inner loop is compiled by numba, which is worth its 190 MB: the same look-up in NumPy alone is
ten times slower (`make bench-assignment`) and barely three times faster than a spatial join. A
compiled extension of our own would need a compiler on each user's machine. The look-up in NumPy and
the paper's R-tree are oracles of the tests (`bench/tile_oracles.py`).
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import Floats, Integers, compiled

Numbers: TypeAlias = NDArray[np.int32]
_SLACK_M = 1e-6  # added around tiles: rounding may move a point to the next cell


def _fill_cells(quads: Floats, columns: int, rows: int, cell_m: float) -> tuple[Numbers, Numbers]:
    """Return `first` and `tiles` of :class:`TileCells` for a grid from (0, 0)."""
    counts = np.zeros(columns * rows + 1, np.int64)
    nothing = np.empty(0, np.int32)
    _count_or_store(quads, columns, rows, cell_m, counts, nothing)
    first = np.concatenate([[0], np.cumsum(counts)])
    tiles = np.empty(first[-1], np.int32)
    _count_or_store(quads, columns, rows, cell_m, first[:-1].copy(), tiles)
    return first.astype(np.int32), tiles


@compiled
def _count_or_store(  # pragma: no cover - compiled
    quads: Floats,
    columns: int,
    rows: int,
    cell_m: float,
    cursor: Integers,
    tiles: Numbers,
) -> None:
    """Count the tiles that touch each cell, or store them at its cursor unless `tiles` is empty."""
    for tile in range(len(quads)):
        quad = quads[tile]
        low_column = max(int((quad[:, 0].min() - _SLACK_M) / cell_m), 0)
        low_row = max(int((quad[:, 1].min() - _SLACK_M) / cell_m), 0)
        high_column = min(int((quad[:, 0].max() + _SLACK_M) / cell_m), columns - 1)
        high_row = min(int((quad[:, 1].max() + _SLACK_M) / cell_m), rows - 1)
        for row in range(low_row, high_row + 1):
            for column in range(low_column, high_column + 1):
                x, y = (column + 0.5) * cell_m, (row + 0.5) * cell_m
                if not _is_separated(quad, x, y, 0.5 * cell_m + _SLACK_M):
                    cell = row * columns + column + 1
                    if len(tiles) > 0:
                        tiles[cursor[cell]] = tile
                    cursor[cell] += 1


@compiled
def _is_separated(
    quad: Floats, x: float, y: float, half_m: float
) -> bool:  # pragma: no cover - compiled
    """Return whether one of a tile's edges separates it from the square around (x, y), metres."""
    for k in range(4):
        normal_x = quad[(k + 1) % 4, 1] - quad[k, 1]
        normal_y = quad[k, 0] - quad[(k + 1) % 4, 0]
        reach = half_m * (abs(normal_x) + abs(normal_y))
        low, high = np.inf, -np.inf
        for vertex in range(4):
            along = normal_x * (quad[vertex, 0] - x) + normal_y * (quad[vertex, 1] - y)
            low, high = min(low, along), max(high, along)
        if low > reach or high < -reach:
            return True
    return False


_LEAST_CELL_M = 0.5  # as long as a tile
_MOST_CELLS = 16_000_000  # of a grid, 64 MB; larger maps get larger cells
Pairs = tuple[Integers, Integers]


class TileCells(NamedTuple):
    """A grid of cells for compiled code; edges are in metres from its south-west corner.

    Parameters
    ----------
    west, south, width, height : float
        Corner (map frame) and size of the rectangle around all tiles, metres.
    cell_m : float
        Side of a cell, metres.
    columns : int
        Cells from west to east.
    first : (m + 2,) int32 array
        Index in `tiles` of the first tile of each cell. Cells are numbered from 1, along the rows
        from the south-west; cell 0 stands for all places outside, and has no tiles.
    tiles : (k,) int32 array
        The tiles that touch each cell, ascending.
    edges : (n, 4, 4) array
        By tile: low end y, high end y, low end x, slope dx/dy of each of four edges.
    """

    west: float
    south: float
    width: float
    height: float
    cell_m: float
    columns: int
    first: Numbers
    tiles: Numbers
    edges: Floats


class TileGrid:
    """Cells of half a metre, each with the tiles that touch it; exact test in compiled code.

    Parameters
    ----------
    quads : (n, 4, 2) array
        Vertices of the tiles in order around them; map frame, metres.

    Examples
    --------
    >>> import gis_radar as gr
    >>> from gis_radar.hdmap import TileGrid, quads
    >>> tiles = gr.make_tiles(gr.read_map(gr.sample_folder() / "junction.osm"))
    >>> point, tile = TileGrid(quads(tiles)).assign([690400.0], [5336200.0])
    >>> point.tolist(), tiles["tile_id"].iloc[tile].tolist()
    ([0], [4894])
    """

    def __init__(self, quads: Floats) -> None:
        origin = _origin(quads)
        local = np.ascontiguousarray(quads - origin)  # one layout, one compiled form
        span = local.reshape(-1, 2).max(axis=0) if len(quads) else np.ones(2)
        cell_m = max(_LEAST_CELL_M, math.sqrt(float(span.prod()) / _MOST_CELLS))
        columns, rows = (int(side * (1.0 / cell_m)) + 1 for side in span)  # rounded as in cell_at
        first, tiles = _fill_cells(local, columns, rows, cell_m)
        (west, south), (width, height) = origin.tolist(), span.tolist()
        self.cells = TileCells(
            west, south, width, height, cell_m, columns, first, tiles, _edges(local)
        )

    @property
    def most_in_a_cell(self) -> int:
        """Greatest number of tiles that touch a cell."""
        return int(np.diff(self.cells.first).max(initial=0))

    def assign(self, easting: Floats, northing: Floats) -> Pairs:
        """Return the pairs (point, tile) of points inside tiles.

        Parameters
        ----------
        easting, northing : (n,) arrays
            Map frame, metres. NaN falls in no tile.

        Returns
        -------
        point, tile : (k,) int64 arrays
            Indices into the inputs and into the quads, ascending by point, then by tile.
        """
        x, y = (np.ascontiguousarray(each, np.float64) for each in (easting, northing))
        room = len(x) + len(x) // 4 + 1024
        point, tile = np.empty(room, np.int64), np.empty(room, np.int64)
        done = found = 0
        while True:
            done, found = _assign(x, y, self.cells, point, tile, done, found)
            if done == len(x):
                return point[:found], tile[:found]
            point, tile = (np.concatenate([kept, np.empty_like(kept)]) for kept in (point, tile))


def _origin(quads: Floats) -> Floats:
    """Return the south-west corner of all tiles, metres: coordinates from it lose no digits."""
    return np.floor(quads.reshape(-1, 2).min(axis=0)) if len(quads) else np.zeros(2)


def _edges(quads: Floats) -> Floats:
    """Return (n, 4, 4): low end y, high end y, low end x, slope dx/dy, each of four edges."""
    start, end = quads, np.roll(quads, -1, axis=1)
    upward = (start[..., 1] < end[..., 1]) | (
        (start[..., 1] == end[..., 1]) & (start[..., 0] <= end[..., 0])
    )
    low = np.where(upward[..., None], start, end)
    high = np.where(upward[..., None], end, start)
    rise = high[..., 1] - low[..., 1]
    slope = np.divide(high[..., 0] - low[..., 0], rise, out=np.zeros_like(rise), where=rise > 0.0)
    return np.stack([low[..., 1], high[..., 1], low[..., 0], slope], axis=1)


@compiled
def cell_at(  # pragma: no cover - compiled
    x: float, y: float, width: float, height: float, per_m: float, columns: int
) -> int:
    """Return the number of the cell of a point (m from the grid's corner); 0 outside or for NaN."""
    # NaN compares false. Without branches and in 32 bits, processors do several points at a time.
    inside = (x >= 0.0) & (x <= width) & (y >= 0.0) & (y <= height)
    row, column = np.int32(y * per_m if inside else 0.0), np.int32(x * per_m if inside else 0.0)
    return int(row * np.int32(columns) + column + 1 if inside else 0)


@compiled
def is_inside(  # pragma: no cover - compiled
    edges: Floats, tile: int, x: float, y: float
) -> int:
    """Return 1 if a point is in a tile, else 0; edges and origin as in :class:`TileCells`."""
    crossings = 0.0
    for e in range(4):
        low, high, x_low, slope = (
            edges[tile, 0, e], edges[tile, 1, e], edges[tile, 2, e], edges[tile, 3, e],
        )  # fmt: skip
        # Numbers in place of truth values let processors do several edges at a time.
        over, right = y - low, x - (x_low + (y - low) * slope)
        crossed = 1.0 if min(over, right) >= 0.0 else 0.0
        crossings += crossed if y < high else 0.0
    return int(crossings) & 1


@compiled
def _assign(  # pragma: no cover - compiled
    x: Floats,
    y: Floats,
    cells: TileCells,
    point_out: Integers,
    tile_out: Integers,
    done: int,
    found: int,
) -> tuple[int, int]:
    """Add pairs from point `done` on until the outputs are full; return both counts."""
    first, tiles, edges = cells.first, cells.tiles, cells.edges
    per_m = 1.0 / cells.cell_m
    for i in range(done, len(x)):
        px, py = x[i] - cells.west, y[i] - cells.south
        cell = cell_at(px, py, cells.width, cells.height, per_m, cells.columns)
        if found + first[cell + 1] - first[cell] > len(point_out):
            return i, found
        for k in range(first[cell], first[cell + 1]):
            point_out[found] = i
            tile_out[found] = tiles[k]
            found += is_inside(edges, tiles[k], px, py)
    return len(x), found
