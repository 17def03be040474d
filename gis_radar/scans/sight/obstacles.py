"""Obstacles to sight: solid bodies, ground and decks over each cell, from a scan and tiles."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, Grid, compiled
from gis_radar.scans.columns import Heights, ScanColumns, ground_under, nearest_known

OBSTACLE_CELL_M = 1.0  # of the cells in which the scan is gathered
_TALL_M = 2.5  # things up to this height over the ground do not hide: parked cars, hedges, rails
# A body is solid where no return from below it lies in a square of this side: crowns let pulses
# through, roofs do not.
_CROWN_M = 3.0
GROUND_M = 12.0  # narrower surfaces are not ground: cars, hedges
# Width of the opening that removes roofs from the ground in scans without classes, and side, in
# cells, of the squares on which it runs.
WIDEST_ROOF_M, _GROUND_CELLS = 40.0, 2
# Depth under the ground's surface down to which a ray is free: noise of scan and map. With 0.4,
# rays from below reach the far side of ramps: 13 % of two levels wrongly seen, not 4 %.
_SUNK_M = 0.1
CLEAR_M = 4.5  # height over a road up to which rays are free: the least clearance of bridges
_LEVELS_APART_M = 3.0  # tiles at one place farther apart in height are on two levels
_SHOULDER_M = 4.0  # width of kerbs, shoulders and parapets beside an upper level's tiles
_OPENING_M = 8.0  # width beside the lower level's tiles in which rays under a deck are free
_DECK_M = 1.5  # thickness of a deck
_GAP_M = 3.0  # cells without points take the heights of the nearest cell within this distance
# Length inside obstacles from which on a ray is blocked (1 or 1.5 change the shares wrongly seen by
# 0.4 %), and distance of samples along it.
_BLOCKED_M, _STEP_M = 0.5, 0.5
# Ends of a ray that are not sampled: the sensor's mast may stand at a wall or in a crown.
_SKIP_NEAR_M, _SKIP_FAR_M = 2.0, 0.5


@dataclass(frozen=True, kw_only=True)
class Obstacles:
    """Obstacles over the cells of a window; arrays are (columns, rows), heights in metres.

    A ray at height z is blocked over a cell where `z < floor`, `z < solid` or
    `slab_low < z < slab_high`.

    Parameters
    ----------
    grid : Grid
        The cells, in the map.
    floor : array
        Height of the ground, less `_SUNK_M`; -inf where the scan covers nothing.
    solid : array
        Top of the solid body that stands on the ground; -inf where none does.
    slab_low, slab_high : array
        Lower and upper side of a deck or of a body that spans a road; inf and -inf without one.
    known : (n, m) bool array
        Whether the scan covers each cell.
    ground : array
        Height of the ground or road, NaN where not known.
    """

    grid: Grid
    floor: Heights = field(repr=False)
    solid: Heights = field(repr=False)
    slab_low: Heights = field(repr=False)
    slab_high: Heights = field(repr=False)
    known: Booleans = field(repr=False)
    ground: Floats = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class RoadHeights:
    """Heights of the tiles over the cells of a window; NaN where there is none.

    Parameters
    ----------
    lowest, highest : (columns, rows) array
        Height of the lowest and of the highest tile that touches a cell, metres.
    """

    lowest: Floats = field(repr=False)
    highest: Floats = field(repr=False)

    @property
    def road(self) -> Booleans:
        """Cells that tiles with a height touch."""
        return np.isfinite(self.lowest)


def road_heights(quads: Floats, height: Floats, grid: Grid) -> RoadHeights:
    """Return the lowest and the highest tile over each cell of a grid.

    Parameters
    ----------
    quads : (n, 4, 2) array
        Vertices of the tiles in the map, metres.
    height : (n,) array
        Height of the road, metres; tiles with NaN are left out.
    grid : Grid
        The cells.
    """
    low = np.full(grid.columns * grid.rows, np.inf)
    high = np.full(grid.columns * grid.rows, -np.inf)
    west, south, east, north = grid.bounds
    middle = quads.mean(axis=1)
    near = (middle > (west, south)).all(axis=1) & (middle < (east, north)).all(axis=1)
    near &= np.isfinite(height)
    quads, height = quads[near], height[near]
    begin, end = quads[:, [0, 1]].mean(axis=1), quads[:, [2, 3]].mean(axis=1)
    widest = float(np.hypot(*(end - begin).T).max()) if len(quads) else 0.0
    for share in np.linspace(0.0, 1.0, 2 + int(2.0 * widest / grid.cell_m)):
        place = begin + share * (end - begin)
        column, row = grid.nearest(place[:, 0], place[:, 1])
        np.minimum.at(low, column * grid.rows + row, height)
        np.maximum.at(high, column * grid.rows + row, height)
    shape = (grid.columns, grid.rows)
    touched = np.isfinite(low)
    lowest, highest = (np.where(touched, side, np.nan).reshape(shape) for side in (low, high))
    return RoadHeights(lowest=lowest, highest=highest)


def find_obstacles(columns: ScanColumns, roads: RoadHeights, *, classified: bool) -> Obstacles:
    """Find the obstacles over the cells of a window.

    Solid is what remains of the lowest returns after an opening over `_CROWN_M`. It removes crowns,
    as pulses reach the ground under them, and poles, hedges and cars. Over the road, rays are free
    up to `CLEAR_M`, whatever stood on it when the scan was flown. An upper level is a slab over a
    lower level's tiles and some metres beside them.

    Parameters
    ----------
    columns : ScanColumns
        Highest and lowest points of the scan.
    roads : RoadHeights
        Heights of the tiles.
    classified : bool
        Whether the scan's classes distinguish ground.
    """
    distance, index = nearest_known(np.isfinite(columns.low))
    known = distance * OBSTACLE_CELL_M <= _GAP_M
    low, top = (
        np.where(known, side[index].astype(np.float64), np.nan)
        for side in (columns.low, columns.top)
    )
    surface = _opened(low, _CROWN_M / OBSTACLE_CELL_M)
    terrain_under = partial(
        ground_under,
        cell_m=OBSTACLE_CELL_M,
        coarse_cells=_GROUND_CELLS,
        widest_roof_m=WIDEST_ROOF_M,
    )
    terrain = terrain_under(columns.ground if classified else columns.low, classified=classified)
    terrain = np.fmin(terrain, surface)
    ground = _opened(low, GROUND_M / OBSTACLE_CELL_M)
    is_solid = surface - terrain > _TALL_M
    by_class = np.isfinite(columns.deck)
    # Banks and the decks between them may have the class of ground. For decks the ground must lie
    # below them, so it is found without classes, too.
    terrain_below = (
        np.fmin(terrain, terrain_under(columns.low, classified=False)) if classified else terrain
    )
    level, deck, below = _decks(top, np.where(by_class, columns.deck, np.nan), roads, terrain_below)
    slab_low, slab_high = _slabs(level, deck, roads, surface)
    under = np.isfinite(slab_low)
    is_solid &= ~under & ~roads.road
    base = np.where(under, np.fmin(np.fmin(terrain_below, below), roads.lowest), ground)
    base = np.where(roads.road & ~under, roads.lowest, base)
    floor = np.where(known, base - _SUNK_M, -np.inf)
    return Obstacles(
        grid=columns.grid,
        floor=np.nan_to_num(floor, nan=-np.inf, neginf=-np.inf).astype(np.float32),
        solid=np.where(is_solid, surface, -np.inf).astype(np.float32),
        slab_low=slab_low.astype(np.float32),
        slab_high=slab_high.astype(np.float32),
        known=known,
        ground=np.where(known, base, np.nan),
    )


def _opened(low: Floats, cells: float) -> Floats:
    """Return the surface without bodies narrower than some cells; NaN where unknown."""
    size = max(1, 2 * round((cells - 1) / 2) + 1)
    known = np.isfinite(low)
    eroded = scipy.ndimage.minimum_filter(np.where(known, low, np.inf), size)
    eroded[~np.isfinite(eroded)] = -np.inf
    opened = np.asarray(scipy.ndimage.maximum_filter(eroded, size))
    return np.where(known & np.isfinite(opened), opened, np.nan)


def _slabs(
    level: Floats, deck: Booleans, roads: RoadHeights, surface: Floats
) -> tuple[Floats, Floats]:
    """Return lower and upper side of decks and of bodies that span a road; else inf and -inf."""
    low, high = np.full(surface.shape, np.inf), np.full(surface.shape, -np.inf)
    spans = roads.road & (surface - roads.lowest > CLEAR_M)
    low[spans] = roads.lowest[spans] + CLEAR_M
    high[spans] = surface[spans]
    low[deck] = level[deck] - _DECK_M
    high[deck] = np.fmax(high, level)[deck]
    return low, high


def _decks(
    highest: Floats, by_class: Floats, roads: RoadHeights, terrain: Floats
) -> tuple[Floats, Booleans, Floats]:
    """Return the upper road's height (m), the cells of decks, and the height of the road below (m).

    Rays pass under a deck where a lower level's tiles are under it, some metres beside them, and
    where the scan has the class of decks; elsewhere an upper road is an embankment.
    """
    crossing = roads.highest - roads.lowest > _LEVELS_APART_M
    known = np.isfinite(by_class)
    upper = roads.highest - np.fmin(terrain, roads.lowest) > _TALL_M
    top = np.where(upper, roads.highest, by_class)
    distance, index = nearest_known(np.isfinite(top))
    level = np.where(distance * OBSTACLE_CELL_M <= _SHOULDER_M, top[index], np.nan)
    near = np.abs(highest - level) < _TALL_M
    deck = (near & (level - terrain > _TALL_M) & ~(roads.road & ~upper)) | crossing
    cells = round(_OPENING_M / OBSTACLE_CELL_M)
    opened = scipy.ndimage.binary_dilation(crossing, iterations=cells, mask=deck)
    distance, index = nearest_known(crossing)
    below = np.where(distance <= 2 * cells, roads.lowest[index], np.nan)
    return level, (opened | known) & deck, below


@compiled
def follow_rays(
    eye: Floats,
    targets: Floats,
    cell_m: float,
    floor: Any,
    solid: Any,
    slab_low: Any,
    slab_high: Any,
    known: Booleans,
) -> tuple[Floats, Any, Floats]:
    """Follow rays from `eye` to `targets`, all in metres from the corner of the cells.

    Returns, by target, distance (m, else NaN) and kind of the first block, and length over no scan.
    """
    count = len(targets)
    begin_m, unknown_m = np.full(count, np.nan), np.zeros(count)
    hider = np.zeros(count, np.uint8)
    columns, rows = floor.shape
    for i in range(count):
        dx, dy, dz = targets[i] - eye
        flat_m = np.hypot(dx, dy)
        blocked, first, by = 0.0, np.nan, 0
        for k in range(int(_SKIP_NEAR_M / _STEP_M), int((flat_m - _SKIP_FAR_M) / _STEP_M) + 1):
            share = k * _STEP_M / flat_m
            u = int(np.floor((eye[0] + share * dx) / cell_m))
            v = int(np.floor((eye[1] + share * dy) / cell_m))
            if u < 0 or v < 0 or u >= columns or v >= rows or not known[u, v]:
                unknown_m[i] += _STEP_M
                continue
            z = eye[2] + share * dz
            kind = 0
            if z < solid[u, v]:
                kind = 1
            elif z < floor[u, v]:
                kind = 2
            elif slab_low[u, v] < z < slab_high[u, v]:
                kind = 3
            if kind == 0:
                continue
            if blocked == 0.0:
                first, by = k * _STEP_M, kind
            blocked += _STEP_M
            if blocked >= _BLOCKED_M:
                begin_m[i], hider[i] = first, by
                break
    return begin_m, hider, unknown_m
