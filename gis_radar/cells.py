"""Sorting tiles into square cells: for each cell, the tiles that touch it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gis_radar.arrays import Floats, Integers
from gis_radar.compiled import compiled

SLACK_M = 1e-6  # a point may be rounded into the cell beside its own


def fill_cells(
    quads: Floats, columns: int, rows: int, cell_m: float
) -> tuple[Integers, NDArray[np.int32]]:
    """Sort tiles into the cells of a grid that begins at (0, 0).

    Parameters
    ----------
    quads : (n, 4, 2) array
        Vertices of the tiles relative to the grid's corner, metres, none negative.
    columns, rows : int
        Size of the grid.
    cell_m : float
        Side of a cell.

    Returns
    -------
    first : (columns * rows + 1,) int64 array
        Where each cell's tiles begin in `tiles`; cells run along the rows.
    tiles : (k,) int32 array
        Positions of the tiles that touch each cell, ascending within a cell.
    """
    counts = np.zeros(columns * rows + 1, np.int64)
    nothing = np.empty(0, np.int32)
    _visit(quads, columns, rows, cell_m, counts, nothing)
    first = np.concatenate([[0], np.cumsum(counts[:-1])])
    tiles = np.empty(first[-1], np.int32)
    _visit(quads, columns, rows, cell_m, first[:-1].copy(), tiles)
    return first, tiles


@compiled
def _visit(  # pragma: no cover - compiled
    quads: Floats,
    columns: int,
    rows: int,
    cell_m: float,
    cursor: Integers,
    tiles: NDArray[np.int32],
) -> None:
    """Move each touched cell's cursor by one; note the tile there unless `tiles` is empty."""
    for tile in range(len(quads)):
        quad = quads[tile]
        low_column = max(int((quad[:, 0].min() - SLACK_M) / cell_m), 0)
        low_row = max(int((quad[:, 1].min() - SLACK_M) / cell_m), 0)
        high_column = min(int((quad[:, 0].max() + SLACK_M) / cell_m), columns - 1)
        high_row = min(int((quad[:, 1].max() + SLACK_M) / cell_m), rows - 1)
        for row in range(low_row, high_row + 1):
            for column in range(low_column, high_column + 1):
                x, y = (column + 0.5) * cell_m, (row + 0.5) * cell_m
                if not _apart(quad, x, y, 0.5 * cell_m + SLACK_M):
                    cell = row * columns + column
                    if len(tiles) > 0:
                        tiles[cursor[cell]] = tile
                    cursor[cell] += 1


@compiled
def _apart(quad: Floats, x: float, y: float, half_m: float) -> bool:  # pragma: no cover - compiled
    """Tell whether the normal of an edge separates a tile from the square around (x, y)."""
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
