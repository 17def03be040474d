"""Grids of square cells in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gis_radar.base.arrays import Booleans, Floats, Integers

if TYPE_CHECKING:
    from affine import Affine

CELL_M = 0.5
"""Side of cells of a road mask and of obstacles, and of pixels of a heat map (the contract)."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Square cells, half-open: a point on a common edge is in the cell to the north or east.

    Cells begin at multiples of their side, so that the cells of two grids of one side coincide.
    They are numbered along the rows, from the south-west: the key of a cell.

    Parameters
    ----------
    cell_m : float
        Side of a cell, metres.
    west, south : int
        Place of the south-west cell, in cells from the origin of the coordinates.
    columns, rows : int
        Number of cells to the east and to the north.
    """

    cell_m: float
    west: int
    south: int
    columns: int
    rows: int

    @classmethod
    def around(cls, x: Any, y: Any, cell_m: float) -> Grid:
        """Return the smallest grid, of cells with a side of `cell_m`, that holds points (m)."""
        (west, east), (south, north) = (
            (int(np.floor_divide(np.min(side), cell_m)), int(np.floor_divide(np.max(side), cell_m)))
            for side in (x, y)
        )
        return cls(
            cell_m=cell_m, west=west, south=south, columns=east - west + 1, rows=north - south + 1
        )

    @property
    def corner(self) -> tuple[float, float]:
        """South-west corner, metres."""
        return self.west * self.cell_m, self.south * self.cell_m

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north, metres."""
        east, north = self.west + self.columns, self.south + self.rows
        return *self.corner, east * self.cell_m, north * self.cell_m

    @property
    def transform(self) -> Affine:
        """Transform from (column, row) to a cell's south-west corner, metres; rows go north."""
        from affine import Affine  # noqa: PLC0415 - most commands need none

        west_m, south_m = self.corner
        return Affine(self.cell_m, 0.0, west_m, 0.0, self.cell_m, south_m)

    def cells(self, x: Floats, y: Floats) -> tuple[Integers, Integers]:
        """Return column and row of each point's cell, which may lie outside the grid."""
        # a quotient may round up to an edge, or underflow to it; the slow floor_divide never does
        exact = self.cell_m <= 1.0 and math.frexp(self.cell_m)[0] == 0.5  # 1, 0.5, 0.25 m ...
        floored = (
            np.floor(side / self.cell_m) if exact else np.floor_divide(side, self.cell_m)
            for side in (x, y)
        )  # fmt: skip
        column, row = (side.astype(np.int64) for side in floored)
        return column - self.west, row - self.south

    def holds(self, column: Integers, row: Integers) -> Booleans:
        """Return whether cells are in the grid."""
        return (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)

    def nearest(self, x: Floats, y: Floats) -> tuple[Integers, Integers]:
        """Return column and row of each point's cell, the outermost one for points outside."""
        column, row = self.cells(x, y)
        return np.clip(column, 0, self.columns - 1), np.clip(row, 0, self.rows - 1)

    def keys(self, x: Floats, y: Floats) -> Integers:
        """Return the key of the cell of each point, all of which are in the grid."""
        column, row = self.cells(x, y)
        return np.asarray(row * self.columns + column)

    def corners(self, key: Integers) -> Floats:
        """Return the south-west corners of cells, (n, 2), metres."""
        row, column = np.divmod(key, self.columns)
        return np.column_stack([column + self.west, row + self.south]) * self.cell_m

    def centres(self, key: Integers) -> Floats:
        """Return the centres of cells, (n, 2), metres."""
        row, column = np.divmod(key, self.columns)
        return np.column_stack([column + self.west + 0.5, row + self.south + 0.5]) * self.cell_m
