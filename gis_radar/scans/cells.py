"""Reduce points on the road surface to half-metre cells: their centres and heights.

DBSCAN runs here on the cells of the cropped road, never on the raw cloud. On a regular grid its
neighbourhoods are sums over a disc, and its clusters the connected patches of core cells.

This step is the same whoever read, cropped and classified the points.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import ndimage

from gis_radar.arrays import Booleans, Floats, Integers, compiled
from gis_radar.progress import QUIET, Reporter
from gis_radar.scans.point_store import BLOCK_CELLS, BLOCK_M, CELL_M, PointStore
from gis_radar.scans.roads import RoadLevel
from gis_radar.scans.surface import SURFACE_M, fit_ground

# A cell is a core with so many cells within the radius, itself among them.
RADIUS_CELLS = 2
CORE_CELLS = 5
LEAST_CELLS = 20  # 5 m2: less than a car's outline


def large_clusters(filled: Booleans) -> Booleans:
    """Return the cells of clusters of at least `LEAST_CELLS`.

    Parameters
    ----------
    filled : (rows, columns) bool array
        Cells with a point.
    """
    reach = np.arange(-RADIUS_CELLS, RADIUS_CELLS + 1)
    disc = np.hypot(*np.meshgrid(reach, reach)) <= RADIUS_CELLS
    around = ndimage.convolve(filled.astype(np.uint8), disc.astype(np.uint8), mode="constant")
    core = filled & (around >= CORE_CELLS)
    # Cores a radius apart touch when each is grown by one cell.
    patch, _ = ndimage.label(grown(core), np.ones((3, 3)))
    member = np.where(filled, patch, 0)
    sizes = np.bincount(member.ravel())
    sizes[0] = 0
    return np.asarray(sizes[member] >= LEAST_CELLS)


def grown(cells: Booleans) -> Booleans:
    """Return cells and the eight around each."""
    wide = cells.copy()
    wide[:, 1:] |= cells[:, :-1]
    wide[:, :-1] |= cells[:, 1:]
    tall = wide.copy()
    tall[1:] |= wide[:-1]
    tall[:-1] |= wide[1:]
    return tall


@compiled
def medians(  # pragma: no cover - compiled
    cell: Integers, value: Floats, width: int
) -> tuple[Integers, Floats]:
    """Return the cells that have points and the medians of the values in and around each.

    Parameters
    ----------
    cell : (n,) int64 array
        The cell of each point in a square grid, row by row; ascending.
    value : (n,) array
        What to take the median of.
    width : int
        Cells a row.
    """
    begin = np.zeros(width * width + 1, np.int64)
    for i in range(len(cell)):
        begin[cell[i] + 1] += 1
    most = begin.max()
    count = 0
    for k in range(width * width):
        count += begin[k + 1] > 0
        begin[k + 1] += begin[k]
    cells, median = np.empty(count, np.int64), np.empty(count)
    some = np.empty(9 * most)
    at = 0
    for k in range(width * width):
        if begin[k + 1] == begin[k]:
            continue
        row, column = k // width, k % width
        total = 0
        for r in range(max(row - 1, 0), min(row + 2, width)):
            first = r * width + max(column - 1, 0)
            last = r * width + min(column + 2, width)
            for i in range(begin[first], begin[last]):
                some[total] = value[i]
                total += 1
        upper = _nth(some, total, total // 2)
        if total % 2 == 0:
            lower = some[0]
            for i in range(1, total // 2):
                lower = max(lower, some[i])
            upper = (lower + upper) / 2.0
        cells[at], median[at] = k, upper
        at += 1
    return cells, median


@compiled
def _nth(some: Floats, total: int, nth: int) -> float:  # pragma: no cover - compiled
    """Return the nth smallest of the first values (Hoare), and move smaller ones before it."""
    low, high = 0, total - 1
    while low < high:
        pivot = some[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while some[i] < pivot:
                i += 1
            while some[j] > pivot:
                j -= 1
            if i <= j:
                some[i], some[j] = some[j], some[i]
                i += 1
                j -= 1
        if nth <= j:
            high = j
        elif nth >= i:
            low = i
        else:
            break
    return some[nth]  # type: ignore[no-any-return]


BIN_M = 0.25
MOST_M = 500.0
ENOUGH = 20_000  # points of a block say it; more only take time


def scan_over_map(store: PointStore) -> float:
    """Return the most frequent height of points over the map's roads, NaN where it knows none.

    Roads lie at one offset to within centimetres, while trees, roofs and other levels spread over
    many; so the mode finds them without knowing which points are road.
    """
    levels = [level for level in store.blocks.roads.levels if level.has_heights]
    if not levels:
        return float("nan")
    bins = np.zeros(int(2 * MOST_M / BIN_M) + 1, np.int64)
    for block in range(len(store.blocks.shapes)):
        xyz, _ = store.points(block)
        xyz = xyz[:: max(1, len(xyz) // ENOUGH)]
        xy = xyz[:, :2] + store.blocks.corner(block)
        for level in levels:
            place = np.rint((xyz[:, 2] - level.height_near(xy) + MOST_M) / BIN_M)
            kept = (place >= 0) & (place < len(bins))
            bins += np.bincount(place[kept].astype(np.int64), minlength=len(bins))
    return float(np.argmax(bins) * BIN_M - MOST_M) if bins.any() else float("nan")


MARGIN_M = 32.0
MARGIN_CELLS = int(MARGIN_M / CELL_M)
SIZE = BLOCK_CELLS + 2 * MARGIN_CELLS
SAME_LEVEL_M = 2.0
CLEARANCE_M = 4.0  # less than what passes under a bridge
SQUARE_M = 16.0


@dataclass(frozen=True, kw_only=True)
class RoadCells:
    """Cells of the road.

    Parameters
    ----------
    points : (n, 3) array
        Centre of each cell and the road's height there, metres; ascending by northing, easting,
        height. Where one road passes over another, a cell may be there once a level.
    used : int
        How many points lie on the road's surface.
    area_cells : int
        How many cells have their centre on a road, each level counted.
    missing : (k, 2) array
        Centres of those among them for which there is no point.
    seen : (k, 2) array
        South-west corners of the squares of `SQUARE_M` that hold points on roads.
    removed : int
        How many cells were left out as small clusters.
    offset_m : float
        How much higher the scan lies than the map's own heights; NaN where it has none.
    """

    points: Floats = field(repr=False)
    used: int
    area_cells: int
    missing: Floats = field(repr=False)
    seen: Floats = field(repr=False)
    removed: int
    offset_m: float


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Cells of one level in one block, as in :class:`RoadCells`."""

    points: Floats
    used: int
    missing: Floats
    removed: int


def make_cells(store: PointStore, *, reporter: Reporter = QUIET) -> RoadCells:
    """Make the cells of all points on the roads, block by block.

    Parameters
    ----------
    store : PointStore
        The points.
    reporter : Reporter
        Hears how far the work is.
    """
    blocks = store.blocks
    offset_m = scan_over_map(store)
    parts: list[_Part] = []
    seen = [np.empty((0, 2))]
    for block in range(len(blocks.shapes)):
        xyz, ground = store.points(block, MARGIN_M)
        corner = np.array(blocks.corner(block))
        seen.append(_squares(xyz) * SQUARE_M + corner)
        for level, masks in zip(blocks.roads.levels, blocks.level_masks, strict=True):
            if masks[block].any():
                area = blocks.window(masks, block, MARGIN_CELLS)
                parts.append(_part(level, xyz, ground, area, corner, offset_m))
        reporter.progress("making cells", block + 1, len(blocks.shapes))
    found = np.concatenate([part.points for part in parts])
    return RoadCells(
        points=found[np.lexsort((found[:, 2], found[:, 0], found[:, 1]))],
        used=sum(part.used for part in parts),
        area_cells=sum(int(masks.sum()) for masks in blocks.level_masks),
        missing=np.concatenate([part.missing for part in parts]),
        seen=np.concatenate(seen),
        removed=sum(part.removed for part in parts),
        offset_m=offset_m,
    )


def _part(
    level: RoadLevel, xyz: Floats, ground: Booleans, area: Booleans, corner: Floats, offset_m: float
) -> _Part:
    """Make the cells of one level in one block; `area` and the points have a margin around it."""
    cell = _cell(xyz)
    kept = grown(area).ravel()[cell]
    xyz, ground, cell = xyz[kept], ground[kept], cell[kept]
    kept = _candidates(level, xyz, ground, cell, corner, offset_m)
    xyz, cell = xyz[kept], cell[kept]
    inner = np.flatnonzero(_inner(area))
    if len(xyz) == 0:
        return _Part(points=np.empty((0, 3)), used=0, missing=_centres(inner) + corner, removed=0)
    surface = fit_ground(xyz)
    over = xyz[:, 2] - surface.height(xyz[:, 0], xyz[:, 1])
    kept = np.abs(over) <= SURFACE_M
    over, cell = over[kept], cell[kept]
    order = np.argsort(cell, kind="stable")
    cells, median = medians(cell[order], over[order], SIZE)
    filled = np.zeros((SIZE, SIZE), bool)
    filled.ravel()[cells] = area.ravel()[cells]
    large = large_clusters(filled)
    height = np.zeros((SIZE, SIZE))
    height.ravel()[cells] = median
    found = np.flatnonzero(_inner(large))
    centre = _centres(found)
    up = surface.height(centre[:, 0], centre[:, 1]) + _inner(height).ravel()[found]
    return _Part(
        points=np.column_stack([centre + corner, up]),
        used=int(np.count_nonzero(_inside_of(large)[cell])),
        missing=_centres(np.setdiff1d(inner, found, assume_unique=True)) + corner,
        removed=int((_inner(filled) & ~_inner(large)).sum()),
    )


def _candidates(
    level: RoadLevel, xyz: Floats, ground: Booleans, cell: Integers, corner: Floats, offset_m: float
) -> Booleans:
    """Choose the points that may be this level's road.

    Where the map knows the height, points at another height belong to another level. A cell
    without ground at the right height - a bridge that was classified as a building, a ramp that
    the map draws too straight - offers what comes next.
    """
    if not level.has_heights or np.isnan(offset_m):
        return ground
    off = np.abs(xyz[:, 2] - level.height_near(xyz[:, :2] + corner) - offset_m)
    chosen = np.zeros(len(xyz), bool)
    open_cells = np.ones(SIZE * SIZE, bool)
    for offers in (ground & (off <= SAME_LEVEL_M), off <= SAME_LEVEL_M, off <= CLEARANCE_M):
        chosen |= offers & open_cells[cell]
        open_cells[cell[chosen]] = False
    return chosen


def _cell(xyz: Floats) -> Integers:
    """Return the cell of each point in the grid of a block with its margin, row by row."""
    place = np.floor((xyz[:, :2] + MARGIN_M) / CELL_M).astype(np.int64)
    return np.asarray(place[:, 1] * SIZE + place[:, 0])


def _inner(grid: Any) -> Any:
    return grid[MARGIN_CELLS:-MARGIN_CELLS, MARGIN_CELLS:-MARGIN_CELLS]


def _inside_of(grid: Booleans) -> Booleans:
    """Return the grid, row by row, without its margin's cells."""
    whole = np.zeros_like(grid)
    _inner(whole)[:] = _inner(grid)
    return whole.ravel()


def _centres(cell: Integers) -> Floats:
    """Return the centres of cells of a block, metres from its corner."""
    row, column = np.divmod(cell, BLOCK_CELLS)
    return np.column_stack([column + 0.5, row + 0.5]) * CELL_M


def _squares(xyz: Floats) -> Floats:
    """Return which squares of a block hold points, by column and row."""
    place = np.floor(xyz[:, :2] / SQUARE_M).astype(np.int64)
    side = int(BLOCK_M / SQUARE_M)
    place = place[((place >= 0) & (place < side)).all(axis=1)]
    held = np.unique(place[:, 1] * side + place[:, 0])
    return np.column_stack([held % side, held // side]).astype(np.float64)
