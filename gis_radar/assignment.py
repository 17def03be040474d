"""Which tiles a point falls in: two exact engines that give the same pairs.

A point belongs to a tile by the crossing number of a ray towards the west. Every edge is
stored once in one direction, whichever tile it bounds, so that a point on an edge shared by two
tiles of a lanelet falls in exactly one of them: the test for that edge is the same arithmetic.

:class:`TileGrid` is the default. Its inner loop is compiled by numba, which is worth its 190 MB:
the same look-up in NumPy alone (:class:`TileGridNumpy`, kept as oracle and as yardstick) is ten
times slower (`make bench-assignment`) and barely three times faster than a spatial join. A
compiled extension of our own would need a compiler on each user's machine. :class:`TileTree` is
the paper's R-tree ("Local Sensor Data Processing").
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from rtree import index as rtree_index

from gis_radar.arrays import Floats, Integers
from gis_radar.cells import fill_cells
from gis_radar.compiled import compiled

CELL_M = 0.5
MOST_CELLS = 16_000_000
Pairs = tuple[Integers, Integers]


class TileEngine(Protocol):
    """Finds the tiles that points fall in."""

    def assign(self, easting: Floats, northing: Floats) -> Pairs:
        """Return the pairs (point, tile) of points inside tiles.

        Parameters
        ----------
        easting, northing : (n,) arrays
            Map frame, metres. NaN falls in no tile.

        Returns
        -------
        point, tile : (k,) int64 arrays
            Positions in the inputs and in the quads, ascending by point, then by tile.
        """
        ...


class TileGrid:
    """Cells of half a metre, each with the tiles that touch it; exact test in compiled code.

    Parameters
    ----------
    quads : (n, 4, 2) array
        Vertices of the tiles in order around them; map frame, metres.

    Examples
    --------
    >>> import gis_radar as gr
    >>> tiles = gr.make_tiles(gr.read_map(gr.sample_folder() / "junction.osm"))
    >>> point, tile = gr.TileGrid(gr.quads(tiles)).assign([690400.0], [5336200.0])
    >>> point.tolist(), tiles["tile_id"].iloc[tile].tolist()
    ([0], [4894])
    """

    def __init__(self, quads: Floats) -> None:
        self._origin = _origin(quads)
        local = quads - self._origin
        self._edges = _edges(local)
        span = local.reshape(-1, 2).max(axis=0) if len(quads) else np.ones(2)
        self._span = span
        self._cell_m = max(CELL_M, math.sqrt(float(span.prod()) / MOST_CELLS))
        self._columns, rows = (int(side / self._cell_m) + 1 for side in span)
        self._first, self._tiles = fill_cells(local, self._columns, rows, self._cell_m)

    def assign(self, easting: Floats, northing: Floats) -> Pairs:
        """Return the pairs (point, tile); see :class:`TileEngine`."""
        x, y = np.asarray(easting, np.float64), np.asarray(northing, np.float64)
        room = len(x) + len(x) // 4 + 1024
        point, tile = np.empty(room, np.int64), np.empty(room, np.int64)
        done = found = 0
        while True:
            done, found = _assign(
                x, y, self._origin, self._span, self._cell_m, self._columns,
                self._first, self._tiles, self._edges, point, tile, done, found,
            )  # fmt: skip
            if done == len(x):
                return point[:found], tile[:found]
            point, tile = (np.concatenate([kept, np.empty_like(kept)]) for kept in (point, tile))


class TileGridNumpy(TileGrid):
    """The same cells and the same test without compiled code: all candidates at once."""

    def assign(self, easting: Floats, northing: Floats) -> Pairs:
        """Return the pairs (point, tile); see :class:`TileEngine`."""
        points = np.column_stack([easting, northing]) - self._origin
        within = np.flatnonzero(((points >= 0.0) & (points <= self._span)).all(axis=1))
        column, row = (points[within] * (1.0 / self._cell_m)).astype(np.int64).T
        cell = row * self._columns + column
        counts = self._first[cell + 1] - self._first[cell]
        begins = np.cumsum(counts) - counts
        point = np.repeat(within, counts)
        nth = np.arange(len(point)) - np.repeat(begins, counts)
        tile = self._tiles[np.repeat(self._first[cell], counts) + nth].astype(np.int64)
        inside = _inside(self._edges[tile], points[point])
        return point[inside], tile[inside]


class TileTree:
    """The paper's R-tree over the tiles' bounding boxes, then the exact test.

    Parameters
    ----------
    quads : (n, 4, 2) array
        Vertices of the tiles in order around them; map frame, metres.
    """

    def __init__(self, quads: Floats) -> None:
        self._origin = _origin(quads)
        local = quads - self._origin
        self._edges = _edges(local)
        boxes = np.hstack([local.min(axis=1), local.max(axis=1)])
        entries = ((i, tuple(box), None) for i, box in enumerate(boxes.tolist()))
        self._tree = rtree_index.Index(entries) if len(boxes) else rtree_index.Index()

    def assign(self, easting: Floats, northing: Floats) -> Pairs:
        """Return the pairs (point, tile); see :class:`TileEngine`."""
        points = np.column_stack([easting, northing]) - self._origin
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        tiles, counts = self._tree.intersection_v(  # type: ignore[no-untyped-call]
            points[finite], points[finite]
        )
        point = np.repeat(finite, counts.astype(np.int64))
        tile = np.asarray(tiles, dtype=np.int64)
        inside = _inside(self._edges[tile], points[point])
        order = np.lexsort((tile[inside], point[inside]))
        return point[inside][order], tile[inside][order]


def _origin(quads: Floats) -> Floats:
    """South-west corner of all tiles: sums near it keep their digits."""
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


def _inside(edges: Floats, points: Floats) -> NDArray[np.bool_]:
    """Tell for each row whether the point lies in the tile with these (n, 4, 4) edges."""
    x, y = points[:, None, 0], points[:, None, 1]
    low, high, x_low, slope = np.moveaxis(edges, 1, 0)
    crossed = (low <= y) & (y < high) & (x >= x_low + (y - low) * slope)
    return np.asarray(np.bitwise_xor.reduce(crossed, axis=1))


@compiled
def _assign(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    x: Floats,
    y: Floats,
    origin: Floats,
    span: Floats,
    cell_m: float,
    columns: int,
    first: Integers,
    tiles: NDArray[np.int32],
    edges: Floats,
    point_out: Integers,
    tile_out: Integers,
    done: int,
    found: int,
) -> tuple[int, int]:
    """Go on at point `done` until the end or until the pairs found fill the room."""
    per_m = 1.0 / cell_m
    (west, south), (width, height) = origin, span
    for i in range(done, len(x)):
        px, py = x[i] - west, y[i] - south
        # Not a number compares false, and what lies outside must never become a cell.
        if not (0.0 <= px <= width and 0.0 <= py <= height):
            continue
        cell = int(py * per_m) * columns + int(px * per_m)
        begin, end = first[cell], first[cell + 1]
        if found + end - begin > len(point_out):
            return i, found
        for k in range(begin, end):
            low, high, x_low, slope = edges[tiles[k]]
            crossings = 0
            for e in range(4):
                crossings += (
                    (low[e] <= py) & (py < high[e]) & (px >= x_low[e] + (py - low[e]) * slope[e])
                )
            point_out[found] = i
            tile_out[found] = tiles[k]
            found += crossings & 1
    return len(x), found
