"""What hides: solid bodies, ground and decks over each cell, from a scan and the tiles' heights."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, Grid, Integers
from gis_radar.scans.columns import Heights, ScanColumns, ground_under, nearest_known
from gis_radar.scans.sight.settings import SIGHT_DEFAULTS, SightSettings


@dataclass(frozen=True, kw_only=True)
class Obstacles:
    """What hides over the cells of a window; arrays are (columns, rows), metres.

    A ray at height z is blocked over a cell where `z < floor`, `z < solid` or
    `slab_low < z < slab_high`.

    Parameters
    ----------
    grid : Grid
        The cells, in the map.
    floor : array
        The ground, less the tolerance; -inf where the scan covers nothing.
    solid : array
        Top of what stands on the ground; -inf where nothing does.
    slab_low, slab_high : array
        Lower and upper side of a deck or of what spans a road; inf and -inf where none is.
    known : (n, m) bool array
        Which cells the scan covers.
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
        Of the tiles that touch a cell, metres.
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
        Vertices of the tiles.
    height : (n,) array
        Of the road, metres; tiles with NaN do not count.
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
    there = np.isfinite(low)
    lowest, highest = (np.where(there, side, np.nan).reshape(shape) for side in (low, high))
    return RoadHeights(lowest=lowest, highest=highest)


def find_obstacles(
    columns: ScanColumns,
    roads: RoadHeights,
    *,
    classified: bool,
    settings: SightSettings = SIGHT_DEFAULTS,
) -> Obstacles:
    """Find what hides over the cells of a window.

    Solid is what the lowest returns show over a square of `crown_m`: an opening of the lowest
    surface, which crowns do not survive, as pulses reach the ground under them, nor poles, hedges
    and cars. The road itself is free up to `clear_m`, whatever stood on it when the scan was
    flown. Over a lower level's tiles, and some metres beside them, an upper level is a slab.

    Parameters
    ----------
    columns : ScanColumns
        Highest and lowest points of the scan.
    roads : RoadHeights
        Heights of the tiles.
    classified : bool
        Whether the classes distinguish the ground.
    settings : SightSettings
        Choices of the algorithm.
    """
    away, index = nearest_known(np.isfinite(columns.low))
    known = away * settings.cell_m <= settings.gap_m
    low, top = (
        np.where(known, side[index].astype(np.float64), np.nan)
        for side in (columns.low, columns.top)
    )
    surface = _opened(low, settings.crown_m / settings.cell_m)
    ask = partial(
        ground_under,
        cell_m=settings.cell_m,
        coarse_cells=settings.ground_cells,
        widest_roof_m=settings.widest_roof_m,
    )
    wide = ask(columns.ground if classified else columns.low, classified=classified)
    wide = np.fmin(wide, surface)
    ground = _opened(low, settings.ground_m / settings.cell_m)
    stands = surface - wide > settings.tall_m
    by_class = np.isfinite(columns.deck)
    # banks and the decks between them may bear the class of ground: bare of them, levels differ
    bare = np.fmin(wide, ask(columns.low, classified=False)) if classified else wide
    level, deck, below = _decks(
        top, np.where(by_class, columns.deck, np.nan), roads, bare, settings
    )
    slab_low, slab_high = _slabs(level, deck, roads, surface, settings)
    under = np.isfinite(slab_low)
    stands &= ~under & ~roads.road
    base = np.where(under, np.fmin(np.fmin(bare, below), roads.lowest), ground)
    base = np.where(roads.road & ~under, roads.lowest, base)
    floor = np.where(known, base - settings.sunk_m, -np.inf)
    return Obstacles(
        grid=columns.grid,
        floor=np.nan_to_num(floor, nan=-np.inf, neginf=-np.inf).astype(np.float32),
        solid=np.where(stands, surface, -np.inf).astype(np.float32),
        slab_low=slab_low.astype(np.float32),
        slab_high=slab_high.astype(np.float32),
        known=known,
        ground=np.where(known, base, np.nan),
    )


def _opened(low: Floats, cells: float) -> Floats:
    """Return the surface without what is narrower than some cells; NaN where not known."""
    size = max(1, 2 * round((cells - 1) / 2) + 1)
    known = np.isfinite(low)
    eroded = scipy.ndimage.minimum_filter(np.where(known, low, np.inf), size)
    eroded[~np.isfinite(eroded)] = -np.inf
    opened = np.asarray(scipy.ndimage.maximum_filter(eroded, size))
    return np.where(known & np.isfinite(opened), opened, np.nan)


def _slabs(
    level: Floats, deck: Booleans, roads: RoadHeights, surface: Floats, settings: SightSettings
) -> tuple[Floats, Floats]:
    """Return lower and upper side of decks, and of what spans a road; inf and -inf elsewhere."""
    low, high = np.full(surface.shape, np.inf), np.full(surface.shape, -np.inf)
    spans = roads.road & (surface - roads.lowest > settings.clear_m)
    low[spans] = roads.lowest[spans] + settings.clear_m
    high[spans] = surface[spans]
    low[deck] = level[deck] - settings.deck_m
    high[deck] = np.fmax(high, level)[deck]
    return low, high


def _decks(
    highest: Floats, by_class: Floats, roads: RoadHeights, wide: Floats, settings: SightSettings
) -> tuple[Floats, Booleans, Floats]:
    """Return the nearest upper road's height, the cells of decks free below, and the road there.

    A deck is free below where a lower level's tiles are under it and some metres beside them, and
    where the scan has the class of decks; an upper road is an embankment elsewhere.
    """
    crossing = roads.highest - roads.lowest > settings.levels_apart_m
    known = np.isfinite(by_class)
    upper = roads.highest - np.fmin(wide, roads.lowest) > settings.tall_m
    top = np.where(upper, roads.highest, by_class)
    away, index = nearest_known(np.isfinite(top))
    level = np.where(away * settings.cell_m <= settings.shoulder_m, top[index], np.nan)
    near = np.abs(highest - level) < settings.tall_m
    deck = (near & (level - wide > settings.tall_m) & ~(roads.road & ~upper)) | crossing
    cells = round(settings.opening_m / settings.cell_m)
    opened = scipy.ndimage.binary_dilation(crossing, iterations=cells, mask=deck)
    away, index = nearest_known(crossing)
    below = np.where(away <= 2 * cells, roads.lowest[index], np.nan)
    return level, (opened | known) & deck, below


def cells_of(grid: Grid, places: Floats) -> tuple[Integers, Integers]:
    """Return column and row of (n, 2) places of the map, the outermost for those outside."""
    return grid.nearest(places[:, 0], places[:, 1])
