"""Read from an airborne scan what a radar sees: crowns of trees, and where walls rise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from gis_radar.arrays import Booleans, Floats
from gis_radar.crs import Box
from gis_radar.grid import CELL_M
from gis_radar.progress import QUIET, Reporter
from gis_radar.scans import open_scan
from gis_radar.scans.scan import ROAD_CLASSES
from gis_radar.second_look.settings import DEFAULTS, SecondLookSettings
from gis_radar.second_look.standing import LevelFrame

PLANTS, BUILDING = (3, 4, 5), (6,)  # ASPRS LAS 1.4, table 17
UNFIT = (7, 9, 13, 14, 15, 16, 18)  # noise, water, wires and pylons
STAGE = "reading the scan"


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Grids of cells in the level frame of a pose, rows ahead and columns left.

    Parameters
    ----------
    top : (n, n) array
        Height of the highest point, NaN where the scan has none.
    ground : (n, n) array
        Height of the ground, also under roofs and crowns; NaN far from any point.
    canopy, roof : (n, n) bool array
        Plants of more than `tall_m` and buildings, by their classes; nowhere without these.
    edge : (n, n) bool array
        Where something rises by more than `tall_m`: walls, rims of crowns.
    classified : bool
        Whether the classes distinguish plants or buildings.
    """

    top: Floats = field(repr=False)
    ground: Floats = field(repr=False)
    canopy: Booleans = field(repr=False)
    roof: Booleans = field(repr=False)
    edge: Booleans = field(repr=False)
    classified: bool

    @property
    def visible(self) -> Booleans:
        """Cells in which a radar may see something that stands."""
        return self.edge | self.canopy


class _Tops:
    """Highest and lowest points by cell, gathered from pieces."""

    def __init__(self, size: int) -> None:
        self.any, self.plants, self.building = (np.full((size, size), -np.inf) for _ in range(3))
        self.ground, self.low = (np.full((size, size), np.inf) for _ in range(2))
        self.points = 0

    def add(self, xyz: Floats, category: Any) -> None:
        size = len(self.any)
        half = size // 2 * CELL_M
        kept = (np.abs(xyz[:, :2]) < half).all(axis=1) & ~np.isin(category, UNFIT)
        xyz, category = xyz[kept], category[kept]
        rows, columns = LevelFrame.cells(xyz, size)
        self.points += len(xyz)
        for grid, which in ((self.plants, PLANTS), (self.building, BUILDING)):
            of = np.isin(category, which)
            np.maximum.at(grid, (rows[of], columns[of]), xyz[of, 2])
        of = np.isin(category, ROAD_CLASSES)
        np.minimum.at(self.ground, (rows[of], columns[of]), xyz[of, 2])
        np.minimum.at(self.low, (rows, columns), xyz[:, 2])
        np.maximum.at(self.any, (rows, columns), xyz[:, 2])


def read_structure(
    scans: Sequence[str | Path],
    level: LevelFrame,
    *,
    reach_m: float,
    scan_crs: Any = None,
    settings: SecondLookSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> Structure | None:
    """Read what stands around a sensor from airborne scans, piece by piece.

    Parameters
    ----------
    scans : sequence of paths
        LAS, LAZ or COPC.
    level : LevelFrame
        The level frame of the sensor's pose.
    reach_m : float
        Up to how far from the sensor.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    settings : SecondLookSettings
        What is tall, and how gaps are filled.
    reporter : Reporter
        Where progress goes.

    Returns
    -------
    Structure, or None where no scan has a point there.

    Raises
    ------
    InputError
        If a scan is damaged; CrsError if it has no projected, metric coordinate system.
    """
    opened = [open_scan(scan, crs=scan_crs) for scan in scans]
    tops = _Tops(2 * int(np.ceil(reach_m / CELL_M)))
    east, north, _ = level.pose.position
    box = box_around(east, north, reach_m * np.sqrt(2.0))
    total, done, grounds, seen = sum(scan.points for scan in opened), 0, 0, 0
    for scan in opened:
        if not scan.touches(box, level.pose.crs):
            continue
        for piece in scan.pieces(box, level.pose.crs):
            xyz = np.column_stack([piece.x, piece.y, piece.z])
            tops.add(level.from_map(xyz), piece.category)
            done += piece.read
            grounds, seen = grounds + piece.ground, seen + piece.read
            reporter.progress(STAGE, done, total)
    if tops.points == 0:
        return None
    classified = grounds >= settings.least_ground * max(seen, 1)
    return _structure(tops, settings, classified=classified)


def box_around(east: float, north: float, reach_m: float) -> Box:
    """Return the square that reaches so far in each of the four directions."""
    return east - reach_m, north - reach_m, east + reach_m, north + reach_m


def _structure(tops: _Tops, settings: SecondLookSettings, *, classified: bool) -> Structure:
    tall_m, jump = settings.tall_m, settings.jump_cells
    top, plants, building = _without_gaps(tops, settings.gap_cells)
    ground = _ground(tops.ground if classified else tops.low, settings, classified=classified)
    below = ndimage.maximum_filter(np.where(np.isnan(top), -np.inf, top), jump)
    low = ndimage.minimum_filter(np.where(np.isnan(top), np.inf, top), jump)
    high = _solid(np.nan_to_num(top - low, nan=0.0) > tall_m)
    # the wall itself runs between the last high cell and the first low one
    edge = high | (ndimage.binary_dilation(high) & (np.nan_to_num(below - top, nan=0.0) > tall_m))
    canopy = _solid(np.nan_to_num(plants - ground, nan=-1.0) > tall_m)
    roof = _solid(np.isfinite(building))
    # a tree over a roof's edge is seen, one over the middle of a roof is taken for a roof
    return Structure(
        top=top, ground=ground, canopy=canopy & ~(roof & ~edge), roof=roof, edge=edge,
        classified=classified and bool((canopy | roof).any()),
    )  # fmt: skip


def _solid(cells: Booleans) -> Booleans:
    """Return cells that are no strays: three or more of nine around."""
    around = ndimage.convolve(cells.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant")
    return np.asarray(cells & (around >= 3))


def _without_gaps(tops: _Tops, gap_cells: int) -> tuple[Floats, Floats, Floats]:
    """Return highest points of any kind, of plants and of buildings; small gaps are filled."""
    empty = np.isinf(tops.any)
    away, index = ndimage.distance_transform_edt(empty, return_indices=True)
    top, plants, building = (
        np.where(away <= gap_cells, grid[tuple(index)], np.nan)
        for grid in (tops.any, tops.plants, tops.building)
    )
    return top, plants, building


def _filled(grid: Floats) -> Floats:
    """Fill gaps with the nearest value."""
    index = ndimage.distance_transform_edt(
        np.isnan(grid), return_distances=False, return_indices=True
    )
    return np.asarray(grid[tuple(index)])


def _ground(low: Floats, settings: SecondLookSettings, *, classified: bool) -> Floats:
    """Return the ground from lowest points: of its class, or under what an opening removes."""
    size, wide = len(low), settings.ground_cells
    pad = -size % wide
    coarse = np.pad(low, (0, pad), constant_values=np.inf)
    coarse = coarse.reshape(len(coarse) // wide, wide, -1, wide).min(axis=(1, 3))
    known = np.isfinite(coarse)
    if not known.any():
        return np.full_like(low, np.nan)
    coarse = _filled(np.where(known, coarse, np.nan))
    coarse = ndimage.median_filter(coarse, 3)
    if not classified:
        window = int(settings.widest_roof_m / CELL_M / wide)
        coarse = ndimage.grey_opening(coarse, (window, window))
    near = ndimage.distance_transform_edt(~known) * wide * CELL_M < settings.widest_roof_m
    fine = np.where(near, coarse, np.nan).repeat(wide, axis=0).repeat(wide, axis=1)
    return np.asarray(fine[:size, :size])
