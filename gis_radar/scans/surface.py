"""The lowest smooth surface under points: a stiff surface that things on the road cannot lift.

The surface is bilinear between nodes 4 m apart and resists bending: it minimises the squares of its
distances from the lowest point of each square metre, and of the differences between neighbouring
slopes. What lies clearly over it - a roof, a crown, a car, a bridge that the map does not know -
loses its pull in the next turn, and the surface sinks to what is left; points below it pull with
bounded force, so that a stray reflection under the ground does not tear it down. A slope costs
nothing, whatever its grade, and a road bends over tens of metres, a car's outline over one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from gis_radar.arrays import Floats, Integers

NODE_M = 4.0
LOW_M = 1.0
# How stiff at first and in the end: bends shorter than some 40 and 20 m are flattened.
STIFFNESS = (100.0, 100.0, 100.0, 100.0, 30.0, 30.0, 10.0, 10.0, 10.0)
OBJECT_M = 0.3  # higher over the surface is no road: tyres, kerbs and bonnets are
PULL_M = 0.3
SURFACE_M = 0.2
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
    """

    corner: tuple[float, float]
    nodes: Floats = field(repr=False)

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return the height at places, NaN beyond the support."""
        base, weight = _bilinear(x, y, self.corner, self.nodes.shape)
        return np.asarray((self.nodes.ravel()[base] * weight).sum(axis=1))


def fit_ground(points: Floats) -> GroundSurface:
    """Lay a surface under points.

    Parameters
    ----------
    points : (n, 3) array
        Metres; at least one.
    """
    corner = (float(points[:, 0].min()) - NODE_M, float(points[:, 1].min()) - NODE_M)
    corner = (NODE_M * np.floor(corner[0] / NODE_M), NODE_M * np.floor(corner[1] / NODE_M))
    span = points[:, :2].max(axis=0) - corner
    shape = (int(span[0] / NODE_M) + 3, int(span[1] / NODE_M) + 3)
    low = _lowest(points)
    middle = float(np.median(low[:, 2]))
    base, weight = _bilinear(low[:, 0], low[:, 1], corner, shape)
    used, local = np.unique(base.ravel(), return_inverse=True)
    rows = np.repeat(np.arange(len(low)), 4)
    look = sparse.csr_array((weight.ravel(), (rows, local.ravel())), shape=(len(low), len(used)))
    bend = _bending(used, shape)
    heights = _settled(look, bend, low[:, 2] - middle) + middle
    nodes = np.full(shape[0] * shape[1], np.nan)
    nodes[used] = heights
    surface = GroundSurface(corner=corner, nodes=nodes.reshape(shape))
    return _centred(surface, points, bend, used, middle)


def _settled(look: sparse.csr_array, bend: sparse.csr_array, z: Floats) -> Floats:
    """Solve in turns: what lies over it lets go, what lies below pulls with bounded force."""
    pull = np.ones(len(z))
    heights = np.zeros(look.shape[1])
    for stiffness in STIFFNESS:
        heights = _solved(look, bend, z, pull, stiffness)
        over = z - look @ heights
        pull = np.where(over > OBJECT_M, 0.0, np.minimum(1.0, PULL_M / np.maximum(-over, _TINY)))
    return heights


def _solved(
    look: sparse.csr_array, bend: sparse.csr_array, z: Floats, pull: Floats, stiffness: float
) -> Floats:
    weighted = look.multiply(pull[:, None]).tocsr()
    normal = look.T @ weighted + stiffness * bend
    # A shred without enough points to hold a plane lies level at the middle height.
    normal = normal + _TINY * sparse.eye_array(normal.shape[0])
    return np.asarray(splu(normal.tocsc(), permc_spec="MMD_AT_PLUS_A",
                           options={"SymmetricMode": True}).solve(weighted.T @ z))  # fmt: skip


def _centred(
    surface: GroundSurface, points: Floats, bend: sparse.csr_array, used: Integers, middle: float
) -> GroundSurface:
    """Lift a surface from the lowest points to the middle of all that lie on it."""
    over = points[:, 2] - surface.height(points[:, 0], points[:, 1])
    kept = points[np.abs(over) <= OBJECT_M]
    if len(kept) == 0:
        return surface
    base, weight = _bilinear(kept[:, 0], kept[:, 1], surface.corner, surface.nodes.shape)
    rows = np.repeat(np.arange(len(kept)), 4)
    look = sparse.csr_array(
        (weight.ravel(), (rows, np.searchsorted(used, base.ravel()))),
        shape=(len(kept), len(used)),
    )
    # As many points pull as there are square metres, whatever the density of the scan.
    pull = np.full(len(kept), min(1.0, len(used) * NODE_M**2 / LOW_M**2 / len(kept)))
    nodes = surface.nodes.ravel().copy()
    nodes[used] = _solved(look, bend, kept[:, 2] - middle, pull, STIFFNESS[-1]) + middle
    return GroundSurface(corner=surface.corner, nodes=nodes.reshape(surface.nodes.shape))


def _lowest(points: Floats) -> Floats:
    """Return the lowest point of each square metre."""
    cell = np.floor(points[:, :2] / LOW_M).astype(np.int64)
    order = np.lexsort((points[:, 2], cell[:, 0], cell[:, 1]))
    cell = cell[order]
    new = np.ones(len(cell), bool)
    new[1:] = (np.diff(cell, axis=0) != 0).any(axis=1)
    return points[order[new]]


def _bilinear(
    x: Floats, y: Floats, corner: tuple[float, float], shape: tuple[int, ...]
) -> tuple[Integers, Floats]:
    """Return the four nodes around each place, and their weights: (n, 4) each."""
    u, v = (x - corner[0]) / NODE_M, (y - corner[1]) / NODE_M
    column = np.clip(np.floor(u).astype(np.int64), 0, shape[0] - 2)
    row = np.clip(np.floor(v).astype(np.int64), 0, shape[1] - 2)
    u, v = u - column, v - row
    base = column * shape[1] + row
    nodes = np.stack([base, base + 1, base + shape[1], base + shape[1] + 1], axis=1)
    weights = np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], axis=1)
    return nodes, weights


def _bending(used: Integers, shape: tuple[int, int]) -> sparse.csr_array:
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
