"""Columns of a scan: highest and lowest points over each cell, of all points and by class."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray
from pyproj import CRS

from gis_radar.base import QUIET, Booleans, Box, Floats, Grid, Integers, Reporter
from gis_radar.scans.scan import Scan

# Arrays of highest points, and all arrays, with their classes (ASPRS LAS 1.4, table 17).
_HIGHEST = {"top": (), "plants": (3, 4, 5), "building": (6,)}
_CLASSES = {**_HIGHEST, "low": (), "ground": (2, 8, 11), "deck": (17,)}
LEAST_GROUND = 0.01  # a scan with a smaller share of points in classes of ground is not classified
_UNFIT = (7, 9, 13, 14, 15, 16, 18)  # noise, water, wires and pylons
Heights: TypeAlias = NDArray[np.float32]  # exact to 0.03 mm at 400 m, in half the memory


@dataclass(kw_only=True)
class ScanColumns:
    """Heights over the cells of a grid, gathered from batches of a scan.

    Arrays are (columns, rows): the first index counts along x. A cell without such a point has
    -inf as highest and inf as lowest.

    Parameters
    ----------
    grid : Grid
        The cells.
    from_map : callable
        Moves (n, 3) points of the map into the grid's frame; by default that is the map.
    top, low : array
        Heights of the highest and the lowest point, metres.
    plants, building : array
        Heights of the highest point of these classes, metres.
    ground, deck : array
        Heights of the lowest point of ground or road surface, and of bridge decks, metres.
    names : sequence of str
        Names of the arrays that are made.
    points : int
        Number of points so far.
    """

    grid: Grid
    from_map: Callable[[Floats], Floats] = field(default=lambda xyz: xyz, repr=False)
    top: Heights = field(init=False, repr=False)
    low: Heights = field(init=False, repr=False)
    plants: Heights = field(init=False, repr=False)
    building: Heights = field(init=False, repr=False)
    ground: Heights = field(init=False, repr=False)
    deck: Heights = field(init=False, repr=False)
    names: Sequence[str] = tuple(_CLASSES)
    points: int = 0

    def __post_init__(self) -> None:
        size = (self.grid.columns, self.grid.rows)
        for name in self.names:
            none = -np.inf if name in _HIGHEST else np.inf
            setattr(self, name, np.full(size, none, np.float32))

    def add(self, xyz: Floats, category: Any) -> None:
        """Add (n, 3) points of the map with their ASPRS classes; skip those outside the grid."""
        xyz = self.from_map(xyz)
        column, row = self.grid.cells(xyz[:, 0], xyz[:, 1])
        kept = self.grid.holds(column, row) & ~np.isin(category, _UNFIT)
        cell = column[kept] * self.grid.rows + row[kept]
        height, category = xyz[kept, 2].astype(np.float32), category[kept]
        self.points += len(cell)
        for name in self.names:
            chosen = np.isin(category, _CLASSES[name]) if _CLASSES[name] else slice(None)
            extreme = np.maximum if name in _HIGHEST else np.minimum
            extreme.at(getattr(self, name).reshape(-1), cell[chosen], height[chosen])


def read_columns(
    scans: Sequence[Scan],
    windows: Sequence[ScanColumns],
    box: Box,
    crs: CRS,
    *,
    reporter: Reporter = QUIET,
) -> float:
    """Read scans once, in batches, into one or more windows.

    Parameters
    ----------
    scans : sequence of Scan
        Airborne scans; those that do not touch the box are not read.
    windows : sequence of ScanColumns
        Receive the points.
    box : (float, float, float, float)
        West, south, east, north of all windows in the map, metres.
    crs : CRS
        The map's.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    float
        Share of the points read that bear a class of ground or road, 0 to 1.
    """
    total, done, grounds = sum(scan.points for scan in scans), 0, 0
    for scan in scans:
        if not scan.touches(box, crs):
            continue
        for batch in scan.batches(box, crs, reporter=reporter):
            xyz = np.column_stack([batch.x, batch.y, batch.z])
            for window in windows:
                window.add(xyz, batch.category)
            done, grounds = done + batch.read, grounds + batch.ground
            reporter.progress("reading the scan", done, total)
    return grounds / max(done, 1)


def nearest_known(known: Booleans) -> tuple[Floats, tuple[Integers, Integers]]:
    """Return the distance to the nearest known cell, in cells, and its indices; inf if none is."""
    if not known.any():
        nowhere = np.zeros(known.shape, np.int64)
        return np.full(known.shape, np.inf), (nowhere, nowhere)
    distance, index = scipy.ndimage.distance_transform_edt(~known, return_indices=True)
    return np.asarray(distance), (index[0], index[1])


def ground_under(
    low: Any, *, cell_m: float, coarse_cells: int, widest_roof_m: float, classified: bool
) -> Floats:
    """Return the ground from the lowest points; without classes, an opening removes roofs.

    Parameters
    ----------
    low : (n, m) array
        Heights of the lowest points of cells, metres, of ground's classes where there are classes;
        inf where a cell has none.
    cell_m : float
        Side of a cell, metres.
    coarse_cells : int
        Side, in cells, of the squares in which the ground is found.
    widest_roof_m : float
        Roofs up to this width are removed where there are no classes.
    classified : bool
        Whether `low` is of ground's classes.

    Returns
    -------
    (n, m) float64 array
        Height of the ground, metres; NaN far from any point.
    """
    (columns, rows), side = low.shape, coarse_cells
    coarse = np.pad(low, ((0, -columns % side), (0, -rows % side)), constant_values=np.inf)
    coarse = coarse.reshape(len(coarse) // side, side, -1, side).min(axis=(1, 3))
    known = np.isfinite(coarse)
    if not known.any():
        return np.full(low.shape, np.nan)
    distance, index = nearest_known(known)
    coarse = scipy.ndimage.median_filter(coarse[index], 3)
    if not classified:
        window = int(widest_roof_m / cell_m / side)
        coarse = scipy.ndimage.grey_opening(coarse, (window, window))
    near = distance * side * cell_m < widest_roof_m
    fine = np.where(near, coarse, np.nan).repeat(side, axis=0).repeat(side, axis=1)
    return np.asarray(fine[:columns, :rows], np.float64)
