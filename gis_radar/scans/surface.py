"""Fit the lowest smooth surface under points: stiff, so that things on the road do not lift it.

The surface is bilinear between nodes and resists bending: it minimises the squares of its
distances from the lowest point of each square metre, and of the differences between neighbouring
slopes (a discrete thin-plate spline, Duchon 1977). What is clearly over it - a roof, a crown, a
car, a bridge that the map does not have - gets no weight in the next round, and the surface sinks
to what is left; points below it pull with bounded force, so that a stray reflection under the
ground does not pull it down. A slope costs nothing, whatever its grade, and a road bends over tens
of metres, a car's outline over one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from gis_radar.arrays import Floats, Integers
from gis_radar.scans.settings import DEFAULTS, MaskSettings

_TINY = 1e-6


@dataclass(frozen=True, kw_only=True)
class GroundSurface:
    """A surface over the plane.

    Parameters
    ----------
    corner : (float, float)
        Place of the first node, metres.
    nodes : (columns, rows) array
        Heights, metres; NaN where nothing supports it.
    node_m : float
        Distance of the nodes, metres.
    """

    corner: tuple[float, float]
    nodes: Floats = field(repr=False)
    node_m: float

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return the height at places, NaN beyond the support."""
        base, weight = self.weights(x, y)
        return np.asarray((self.nodes.ravel()[base] * weight).sum(axis=1))

    def weights(self, x: Floats, y: Floats) -> tuple[Integers, Floats]:
        """Return the four nodes around each place, and their bilinear weights: (n, 4) each."""
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
        Metres; at least one.
    settings : MaskSettings
        Nodes, stiffness, and what pulls how much.
    """
    node_m = settings.node_m
    corner = (float(points[:, 0].min()) - node_m, float(points[:, 1].min()) - node_m)
    corner = (node_m * np.floor(corner[0] / node_m), node_m * np.floor(corner[1] / node_m))
    span = points[:, :2].max(axis=0) - corner
    nodes = np.full((int(span[0] / node_m) + 3, int(span[1] / node_m) + 3), np.nan)
    surface = GroundSurface(corner=corner, nodes=nodes, node_m=node_m)
    low = _lowest(points, settings.low_m)
    middle = float(np.median(low[:, 2]))
    base, weight = surface.weights(low[:, 0], low[:, 1])
    used, local = np.unique(base.ravel(), return_inverse=True)
    rows = np.repeat(np.arange(len(low)), 4)
    look = sparse.csr_array((weight.ravel(), (rows, local.ravel())), shape=(len(low), len(used)))
    bend = _bending(used, nodes.shape)
    nodes.ravel()[used] = _settled(look, bend, low[:, 2] - middle, settings) + middle
    return _centred(surface, points, bend, used, middle, settings)


def _settled(
    look: sparse.csr_array, bend: sparse.csr_array, z: Floats, settings: MaskSettings
) -> Floats:
    """Solve in rounds: what is over it loses its weight, what is below pulls with bounded force."""
    pull = np.ones(len(z))
    heights = np.zeros(look.shape[1])
    for stiffness in settings.stiffness:
        heights = _solved(look, bend, z, pull, stiffness)
        over = z - look @ heights
        bounded = np.minimum(1.0, settings.pull_m / np.maximum(-over, _TINY))
        pull = np.where(over > settings.object_m, 0.0, bounded)
    return heights


def _solved(
    look: sparse.csr_array, bend: sparse.csr_array, z: Floats, pull: Floats, stiffness: float
) -> Floats:
    weighted = look.multiply(pull[:, None]).tocsr()
    normal = look.T @ weighted + stiffness * bend
    # A shred without enough points to hold a plane is level at the middle height.
    normal = normal + _TINY * sparse.eye_array(normal.shape[0])
    return np.asarray(splu(normal.tocsc(), permc_spec="MMD_AT_PLUS_A",
                           options={"SymmetricMode": True}).solve(weighted.T @ z))  # fmt: skip


def _centred(
    surface: GroundSurface, points: Floats, bend: sparse.csr_array, used: Integers, middle: float,
    settings: MaskSettings,
) -> GroundSurface:  # fmt: skip
    """Lift a surface from the lowest points to the middle of all that are on it."""
    over = points[:, 2] - surface.height(points[:, 0], points[:, 1])
    kept = points[np.abs(over) <= settings.object_m]
    if len(kept) == 0:
        return surface
    base, weight = surface.weights(kept[:, 0], kept[:, 1])
    rows = np.repeat(np.arange(len(kept)), 4)
    look = sparse.csr_array(
        (weight.ravel(), (rows, np.searchsorted(used, base.ravel()))),
        shape=(len(kept), len(used)),
    )
    # As many points pull as there are low squares, whatever the density of the scan.
    squares = len(used) * settings.node_m**2 / settings.low_m**2
    pull = np.full(len(kept), min(1.0, squares / len(kept)))
    nodes = surface.nodes.copy()
    solved = _solved(look, bend, kept[:, 2] - middle, pull, settings.stiffness[-1])
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


def _bending(used: Integers, shape: tuple[int, ...]) -> sparse.csr_array:
    """Return the matrix whose form is the sum of squared second differences of the heights."""
    place = np.full(shape[0] * shape[1], -1, np.int64)
    place[used] = np.arange(len(used))
    grid = np.pad(place.reshape(shape), 2, constant_values=-1)
    here = grid[2:-2, 2:-2]
    rules: list[tuple[tuple[Any, float], ...]] = []
    for ahead in ((1, 0), (0, 1)):
        before, after = (_shifted(grid, *(step * side for side in ahead)) for step in (-1, 1))
        rules.append(((before, 1.0), (here, -2.0), (after, 1.0)))
    root = float(np.sqrt(2.0))
    corners = (_shifted(grid, 0, 0), _shifted(grid, 1, 0), _shifted(grid, 0, 1))
    twist = zip((*corners, _shifted(grid, 1, 1)), (root, -root, -root, root), strict=True)
    rules.append(tuple(twist))
    total = sparse.csr_array((len(used), len(used)))
    for rule in rules:
        whole = np.all([nodes >= 0 for nodes, _ in rule], axis=0)
        count = int(whole.sum())
        entries = np.concatenate([np.full(count, factor) for _, factor in rule])
        where = np.concatenate([nodes[whole] for nodes, _ in rule])
        rows = np.tile(np.arange(count), len(rule))
        second = sparse.csr_array((entries, (rows, where)), shape=(count, len(used)))
        total = total + second.T @ second
    return total


def _shifted(grid: Integers, across: int, up: int) -> Integers:
    """Return an inner part of a grid padded by two, moved by some nodes."""
    wide, tall = grid.shape
    return grid[2 + across : wide - 2 + across, 2 + up : tall - 2 + up]
