"""Reduce points on the road surface to half-metre cells: their centres and heights.

The surface is the lowest smooth one under the points: stiff, so that objects on the road do not
lift it. It is bilinear between nodes, and minimises the sum of its squared distances from the
lowest point of each square metre and of the squared differences between neighbouring slopes (a
discrete thin-plate spline, Duchon 1977). Points clearly above it - a roof, a crown, a car, a bridge
that the map does not have - get no weight in the next round, and the surface sinks to the rest;
points below it have bounded weight, so that a stray reflection under the ground does not pull it
down. Slopes cost nothing, however steep; a road bends over tens of metres, a car's outline over
one.

DBSCAN runs here on the cells of the cropped road, never on the raw cloud. On a regular grid its
neighbourhoods are sums over a disc, and its clusters the connected patches of core cells.

This step is the same for points read by PDAL and by laspy.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from gis_radar.base import CELL_M, QUIET, Booleans, Floats, Grid, Integers, Reporter, compiled
from gis_radar.scans.point_store import BLOCK_CELLS, BLOCK_M, PointStore
from gis_radar.scans.roads import RoadLevel
from gis_radar.scans.settings import DEFAULTS, MaskSettings

SQUARE_M = 16.0  # side of the squares for which we state whether scans have points there

_TINY = 1e-6


@dataclass(frozen=True, kw_only=True)
class GroundSurface:
    """Heights of the ground at nodes of a square grid, bilinear in between.

    Parameters
    ----------
    corner : (2,) array
        Easting and northing of the first node, metres.
    nodes : (columns, rows) array
        Heights, metres; NaN where no point is near.
    node_m : float
        Distance of the nodes, metres.
    """

    corner: Floats
    nodes: Floats = field(repr=False)
    node_m: float

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return the heights at places, metres; NaN where a node around has none."""
        base, weight = self.weights(x, y)
        return np.asarray((self.nodes.ravel()[base] * weight).sum(axis=1))

    def weights(self, x: Floats, y: Floats) -> tuple[Integers, Floats]:
        """Return indices of the four nodes around each place, and bilinear weights: (n, 4) each."""
        shape = self.nodes.shape
        u, v = (x - self.corner[0]) / self.node_m, (y - self.corner[1]) / self.node_m
        column = np.clip(np.floor(u).astype(np.int64), 0, shape[0] - 2)
        row = np.clip(np.floor(v).astype(np.int64), 0, shape[1] - 2)
        u, v = u - column, v - row
        base = column * shape[1] + row
        nodes = np.stack([base, base + 1, base + shape[1], base + shape[1] + 1], axis=1)
        weights = np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], axis=1)
        return nodes, weights


def fit_ground(points: Floats, settings: MaskSettings = DEFAULTS) -> GroundSurface:
    """Fit a surface under points.

    Parameters
    ----------
    points : (n, 3) array
        Easting, northing, height, metres; at least one.
    settings : MaskSettings
        Spacing of the nodes, stiffness, and weights of points.
    """
    node_m = settings.node_m
    corner = node_m * np.floor((points[:, :2].min(axis=0) - node_m) / node_m)
    span = points[:, :2].max(axis=0) - corner
    nodes = np.full((int(span[0] / node_m) + 3, int(span[1] / node_m) + 3), np.nan)
    surface = GroundSurface(corner=corner, nodes=nodes, node_m=node_m)
    low = _lowest(points, settings.low_m)
    middle = float(np.median(low[:, 2]))
    used = np.unique(surface.weights(low[:, 0], low[:, 1])[0])
    bending = _bending(used, nodes.shape)
    at_points = _nodes_to_points(surface, low, used)
    nodes.ravel()[used] = _fitted_heights(at_points, bending, low[:, 2] - middle, settings) + middle
    return _raised_to_middle(surface, points, bending, used, middle, settings)


def _nodes_to_points(surface: GroundSurface, points: Floats, used: Integers) -> sparse.csr_array:
    """Return the matrix from the heights of the used nodes to those of the surface at points."""
    base, weight = surface.weights(points[:, 0], points[:, 1])
    rows = np.searchsorted(used, base.ravel()), np.arange(0, base.size + 1, base.shape[1])
    return sparse.csr_array((weight.ravel(), *rows), shape=(len(points), len(used)))


def _fitted_heights(
    at_points: sparse.csr_array, bending: sparse.csr_array, z: Floats, settings: MaskSettings
) -> Floats:
    """Return heights of nodes, solved in rounds with new weights for points above and below."""
    weight = np.ones(len(z))
    heights = np.zeros(at_points.shape[1])
    for stiffness in settings.stiffness:
        heights = _solve_heights(at_points, bending, z, weight, stiffness)
        over = z - at_points @ heights
        bounded = np.minimum(1.0, settings.pull_m / np.maximum(-over, _TINY))
        weight = np.where(over > settings.object_m, 0.0, bounded)
    return heights


def _solve_heights(
    at_points: sparse.csr_array,
    bending: sparse.csr_array,
    z: Floats,
    weight: Floats,
    stiffness: float,
) -> Floats:
    """Return the heights of nodes that minimise squared distances and bending."""
    weighted = at_points.multiply(weight[:, None]).tocsr()
    normal = at_points.T @ weighted + stiffness * bending
    # Keeps the matrix regular: parts with too few points for a plane are level, at middle height.
    normal = normal + _TINY * sparse.eye_array(normal.shape[0])
    return np.asarray(splu(normal.tocsc(), permc_spec="MMD_AT_PLUS_A",
                           options={"SymmetricMode": True}).solve(weighted.T @ z))  # fmt: skip


def _raised_to_middle(
    surface: GroundSurface, points: Floats, bending: sparse.csr_array, used: Integers,
    middle: float, settings: MaskSettings,
) -> GroundSurface:  # fmt: skip
    """Return the surface lifted from the lowest points to the middle of all points on it."""
    over = points[:, 2] - surface.height(points[:, 0], points[:, 1])
    kept = points[np.abs(over) <= settings.object_m]
    if len(kept) == 0:
        return surface
    at_points = _nodes_to_points(surface, kept, used)
    # The weights add up to the number of low squares, whatever the density of the scan.
    squares = len(used) * settings.node_m**2 / settings.low_m**2
    weight = np.full(len(kept), min(1.0, squares / len(kept)))
    nodes = surface.nodes.copy()
    solved = _solve_heights(at_points, bending, kept[:, 2] - middle, weight, settings.stiffness[-1])
    nodes.ravel()[used] = solved + middle
    return replace(surface, nodes=nodes)


def _lowest(points: Floats, side_m: float) -> Floats:
    """Return the lowest point of each square."""
    cell = np.floor(points[:, :2] / side_m).astype(np.int64)
    order = np.lexsort((points[:, 2], cell[:, 0], cell[:, 1]))
    cell = cell[order]
    new = np.ones(len(cell), bool)
    new[1:] = (np.diff(cell, axis=0) != 0).any(axis=1)
    return points[order[new]]


_ROOT = float(np.sqrt(2.0))
# Second differences to the east, to the north and mixed: offsets of the nodes, and their factors.
_SECOND = (
    (((-1, 0), (0, 0), (1, 0)), (1.0, -2.0, 1.0)),
    (((0, -1), (0, 0), (0, 1)), (1.0, -2.0, 1.0)),
    (((0, 0), (1, 0), (0, 1), (1, 1)), (_ROOT, -_ROOT, -_ROOT, _ROOT)),
)


def _bending(used: Integers, shape: tuple[int, ...]) -> sparse.csr_array:
    """Return the matrix B such that h' B h sums the squared second differences of heights h."""
    wide, tall = shape
    place = np.full(wide * tall, -1, np.int64)
    place[used] = np.arange(len(used))
    grid = np.pad(place.reshape(shape), 1, constant_values=-1)
    total = sparse.csr_array((len(used), len(used)))
    for offsets, factors in _SECOND:
        nodes = np.stack([grid[1 + i : 1 + i + wide, 1 + j : 1 + j + tall] for i, j in offsets])
        where = nodes[:, (nodes >= 0).all(axis=0)]
        count = where.shape[1]
        entries, rows = np.repeat(factors, count), np.tile(np.arange(count), len(factors))
        second = sparse.csr_array((entries, (rows, where.ravel())), shape=(count, len(used)))
        total = total + second.T @ second
    return total


def large_clusters(filled: Booleans, settings: MaskSettings = DEFAULTS) -> Booleans:
    """Return the cells of clusters of at least `least_cells`.

    Parameters
    ----------
    filled : (rows, columns) bool array
        Cells with a point.
    settings : MaskSettings
        Definition of a core and of a cluster.
    """
    reach = np.arange(-settings.core_radius, settings.core_radius + 1)
    disc = np.hypot(*np.meshgrid(reach, reach)) <= settings.core_radius
    around = ndimage.convolve(filled.astype(np.uint8), disc.astype(np.uint8), mode="constant")
    core = filled & (around >= settings.core_cells)
    # Cores within the radius (two cells) touch once each is grown by a cell.
    patch, _ = ndimage.label(ndimage.maximum_filter(core, 3, mode="constant"), np.ones((3, 3)))
    member = np.where(filled, patch, 0)
    sizes = np.bincount(member.ravel())
    sizes[0] = 0
    return np.asarray(sizes[member] >= settings.least_cells)


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
        The value of each point.
    width : int
        Number of cells in a row.
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
    values_around = np.empty(9 * most)
    filled = 0
    for k in range(width * width):
        if begin[k + 1] == begin[k]:
            continue
        row, column = k // width, k % width
        total = 0
        for r in range(max(row - 1, 0), min(row + 2, width)):
            first = r * width + max(column - 1, 0)
            last = r * width + min(column + 2, width)
            for i in range(begin[first], begin[last]):
                values_around[total] = value[i]
                total += 1
        cells[filled], median[filled] = k, np.median(values_around[:total])
        filled += 1
    return cells, median


def scan_over_map(store: PointStore, settings: MaskSettings) -> float:
    """Return the most frequent height of points over the map's roads, metres; NaN without heights.

    Points on roads have one offset to within centimetres, those of trees, roofs and other levels
    many: the mode is right without knowing which points are road. The histogram is centred on the
    median of the first points where that is out of its range.
    """
    blocks = store.blocks
    levels = [level for level in blocks.roads.levels if level.has_heights]
    if not levels:
        return float("nan")
    bin_m, most_m = settings.offset_bin_m, settings.offset_max_m
    bins = np.zeros(int(2 * most_m / bin_m) + 1, np.int64)
    middle_m = None
    for block in range(len(blocks.shapes)):
        xyz, _ = store.points(block)
        xyz = xyz[:: max(1, len(xyz) // settings.offset_points)]
        xy = xyz[:, :2] + blocks.cells(block).corner
        for level in levels:
            over_m = xyz[:, 2] - level.height_near(xy)
            if middle_m is None and np.isfinite(over_m).any():
                median_m = float(np.nanmedian(over_m))
                middle_m = 0.0 if abs(median_m) <= most_m else round(median_m / bin_m) * bin_m
            place = np.rint((over_m - (middle_m or 0.0) + most_m) / bin_m)
            kept = (place >= 0) & (place < len(bins))
            bins += np.bincount(place[kept].astype(np.int64), minlength=len(bins))
    found_m = np.argmax(bins) * bin_m - most_m + (middle_m or 0.0)
    return float(found_m) if bins.any() else float("nan")


@dataclass(frozen=True, kw_only=True)
class RoadCells:
    """Cells of the road.

    Parameters
    ----------
    points : (n, 3) array
        Centre of each cell and the road's height there, metres; ascending by northing, easting,
        height. Where one road passes over another, a cell may be there once a level.
    used : int
        Number of points on the road's surface.
    area_cells : int
        Number of cells whose centre is on a road, summed over levels.
    missing : (k, 3) array
        South-west corners of the squares of `SQUARE_M` with cells for which there is no point,
        metres, and the number of such cells; a square may be there several times.
    seen : (k, 2) array
        South-west corners of the squares of `SQUARE_M` that hold points on roads, metres.
    removed : int
        Number of cells left out as small clusters.
    offset_m : float
        Height of the scan over the map's own heights, metres; NaN where the map has none.
    """

    points: Floats = field(repr=False)
    used: int
    area_cells: int
    missing: Floats = field(repr=False)
    seen: Floats = field(repr=False)
    removed: int
    offset_m: float


class _LevelCells(NamedTuple):
    """Cells of one level in one block; see :class:`RoadCells`."""

    points: Floats
    used: int
    area_cells: int
    missing: Floats
    removed: int


def make_cells(
    store: PointStore, *, settings: MaskSettings = DEFAULTS, reporter: Reporter = QUIET
) -> RoadCells:
    """Make the cells of all points on the roads, block by block.

    Parameters
    ----------
    store : PointStore
        The points.
    settings : MaskSettings
        How points become cells.
    reporter : Reporter
        Receives progress.
    """
    blocks = store.blocks
    margin = round(settings.block_margin_m / CELL_M)
    offset_m = scan_over_map(store, settings)
    parts: list[_LevelCells] = []
    seen = [np.empty((0, 2))]
    for block in range(len(blocks.shapes)):
        xyz, ground = store.points(block, settings.block_margin_m)
        corner = np.array(blocks.cells(block).corner)
        seen.append(_occupied_squares(xyz, SQUARE_M) + corner)
        for number, level in enumerate(blocks.roads.levels):
            area = blocks.area(number, block, margin)
            parts.append(_cells_of_level(xyz, ground, level, area, corner, offset_m, settings))
        reporter.progress("making cells", block + 1, len(blocks.shapes))
    points, used, area_cells, missing, removed = zip(*parts, strict=True)
    found = np.concatenate(points)
    return RoadCells(
        points=found[np.lexsort((found[:, 2], found[:, 0], found[:, 1]))], used=sum(used),
        area_cells=sum(area_cells), missing=np.concatenate(missing), seen=np.concatenate(seen),
        removed=sum(removed), offset_m=offset_m,
    )  # fmt: skip


def _cells_of_level(
    xyz: Floats, ground: Booleans, level: RoadLevel, area: Booleans, corner: Floats,
    offset_m: float, settings: MaskSettings,
) -> _LevelCells:  # fmt: skip
    """Make a level's cells in a block; `xyz` and `area` also hold a margin around the block."""
    margin = (len(area) - BLOCK_CELLS) // 2
    grid = Grid(cell_m=CELL_M, west=-margin, south=-margin, columns=len(area), rows=len(area))
    block = np.zeros_like(area)
    block[margin : margin + BLOCK_CELLS, margin : margin + BLOCK_CELLS] = True
    road = area & block
    cell = grid.keys(xyz[:, 0], xyz[:, 1])
    kept = ndimage.maximum_filter(area, 3, mode="constant").ravel()[cell]
    xyz, ground, cell = xyz[kept], ground[kept], cell[kept]
    if level.has_heights and not np.isnan(offset_m):
        off_m = np.abs(xyz[:, 2] - level.height_near(xyz[:, :2] + corner) - offset_m)
        ground = _near_map_height(off_m, ground, cell, settings)
    xyz, cell = xyz[ground], cell[ground]
    if len(xyz) == 0 or not road.any():
        without_point = squares_with_cells(road, grid, corner, SQUARE_M)
        return _LevelCells(np.empty((0, 3)), 0, int(np.count_nonzero(road)), without_point, 0)
    surface = fit_ground(xyz, settings)
    over = xyz[:, 2] - surface.height(xyz[:, 0], xyz[:, 1])
    kept = np.abs(over) <= settings.surface_m
    over, cell = over[kept], cell[kept]
    order = np.argsort(cell, kind="stable")
    cells, median = medians(cell[order], over[order], grid.columns)
    filled, height = np.zeros_like(area), np.zeros(area.shape)
    filled.ravel()[cells] = area.ravel()[cells]
    height.ravel()[cells] = median
    large = large_clusters(filled, settings) & block
    chosen = np.flatnonzero(large)
    centres = grid.centres(chosen)
    height_m = surface.height(centres[:, 0], centres[:, 1]) + height.ravel()[chosen]
    return _LevelCells(
        points=np.column_stack([centres + corner, height_m]),
        used=int(np.count_nonzero(large.ravel()[cell])),
        area_cells=int(np.count_nonzero(road)),
        missing=squares_with_cells(road & ~large, grid, corner, SQUARE_M),
        removed=int(np.count_nonzero(filled & block & ~large)),
    )


def squares_with_cells(cells: Booleans, grid: Grid, corner: Floats, side_m: float) -> Floats:
    """Return the squares of a coarser grid that hold cells, and how many each holds.

    Parameters
    ----------
    cells : (rows, columns) array of bool
        True for the cells to count.
    grid : Grid
        Their grid, in metres from the corner.
    corner : (2,) array
        Easting and northing of the grid's zero, metres.
    side_m : float
        Side of a square, metres; squares begin at its multiples.

    Returns
    -------
    (k, 3) array
        Easting and northing of the south-west corner, metres, and the number of cells.
    """
    across = (grid.centres(np.arange(grid.columns))[:, 0] + corner[0]) // side_m
    up = (grid.centres(np.arange(grid.rows) * grid.columns)[:, 1] + corner[1]) // side_m
    columns, rows = (np.flatnonzero(np.diff(side, prepend=np.nan) != 0) for side in (across, up))
    count = np.add.reduceat(np.add.reduceat(cells, rows, axis=0, dtype=np.int64), columns, axis=1)
    row, column = np.nonzero(count)
    corners = np.column_stack([across[columns[column]], up[rows[row]]]) * side_m
    return np.column_stack([corners, count[row, column]])


def _near_map_height(
    off_m: Floats, ground: Booleans, cell: Integers, settings: MaskSettings
) -> Booleans:
    """Return which points may be a level's road, by their distance from the map's height.

    Points at another height belong to another level. In a cell without ground at the right height
    (a bridge classified as a building, a ramp drawn too straight in the map), points of any class
    within `same_level_m` are chosen, else those within `clearance_m`.
    """
    near, clear = off_m <= settings.same_level_m, off_m <= settings.clearance_m
    chosen = np.zeros(len(off_m), bool)
    without_point = np.ones(cell.max(initial=0) + 1, bool)
    for candidates in (ground & near, near, clear):
        chosen |= candidates & without_point[cell]
        without_point[cell[chosen]] = False
    return chosen


def _occupied_squares(xyz: Floats, side_m: float) -> Floats:
    """Return the south-west corners of the squares of a block that hold points."""
    side = int(BLOCK_M / side_m)
    grid = Grid(cell_m=side_m, west=0, south=0, columns=side, rows=side)
    column, row = grid.cells(xyz[:, 0], xyz[:, 1])
    inside = grid.holds(column, row)
    return grid.corners(np.unique(row[inside] * side + column[inside]))
