"""From ways to the points of one bound: ways joined, lost nodes dropped, height gaps closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.lanelets.bounds import CannotMendError, at_fractions, without_repeats
from gis_radar.lanelets.osm import OsmMap
from gis_radar.lanelets.ribbons import arc_lengths


@dataclass(frozen=True, kw_only=True)
class Chain:
    """One bound as drawn.

    Parameters
    ----------
    nodes : tuple of int
        Node ids in the order of `points`; only nodes with a position.
    points : (n, 3) array
        Positions in metres; heights may be NaN.
    repairs : tuple of str
        What had to be dropped.
    """

    nodes: tuple[int, ...]
    points: Floats
    repairs: tuple[str, ...]

    def reversed(self) -> Chain:
        """Return the same bound the other way round."""
        return Chain(nodes=self.nodes[::-1], points=self.points[::-1], repairs=self.repairs)


def chain_of(osm: OsmMap, ways: tuple[int, ...], xyz: Floats, side: str) -> Chain:
    """Join the ways of a bound, and look up where their nodes are.

    Parameters
    ----------
    osm : OsmMap
        The map as read.
    ways : tuple of int
        Ids of the ways with the role of this bound, in any order and direction.
    xyz : (n, 3) array
        Positions of the map's nodes, NaN where unusable.
    side : str
        `left` or `right`, for messages.

    Returns
    -------
    Chain
        Nodes and points of the bound, in the direction of the first way.

    Raises
    ------
    CannotMendError
        If the bound is missing, its ways form no chain, or under two usable points are left.
    """
    if not ways:
        raise CannotMendError(f"the {side} bound is missing")
    absent = [way for way in ways if way not in osm.ways]
    if absent:
        raise CannotMendError(f"the {side} bound is missing: way {absent[0]} is not in the file")
    nodes = joined([osm.ways[way].nodes for way in dict.fromkeys(ways)])
    if nodes is None:
        raise CannotMendError(f"the ways of the {side} bound do not form a chain")
    rows = np.array([osm.node_index.get(node, -1) for node in nodes], dtype=np.int64)
    usable = rows >= 0
    usable[usable] = np.isfinite(xyz[rows[usable], :2]).all(axis=1)
    points = xyz[rows[usable]]
    lost = len(nodes) - int(usable.sum())
    if len(points) < 2 or len(without_repeats(points)) < 2:
        why = (
            f"{lost} of its {len(nodes)} nodes are missing"
            if lost
            else "it has not two distinct points"
        )
        raise CannotMendError(f"the {side} bound has no length: {why}")
    lost_nodes = f"{lost} of {len(nodes)} nodes of the {side} bound are missing or have no position"
    kept = tuple(node for node, here in zip(nodes, usable, strict=True) if here)
    return Chain(nodes=kept, points=points, repairs=(lost_nodes,) if lost else ())


def joined(ways: list[tuple[int, ...]]) -> tuple[int, ...] | None:
    """Join ways at common end nodes into one line; None if they are not one chain."""
    chain, *rest = [list(way) for way in ways if way] or [[]]
    while rest:
        for i, way in enumerate(rest):
            longer = _attached(chain, way)
            if longer is not None:
                chain = longer
                del rest[i]
                break
        else:
            return None
    return tuple(chain)


def _attached(chain: list[int], way: list[int]) -> list[int] | None:
    """Return the chain with a way at its end or its start, turned as needed."""
    if chain[-1] in {way[0], way[-1]}:
        return chain + (way if way[0] == chain[-1] else way[::-1])[1:]
    if chain[0] in {way[0], way[-1]}:
        return (way if way[-1] == chain[0] else way[::-1])[:-1] + chain
    return None


def heights_filled(left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Close gaps in the heights of two parallel bounds.

    A gap is interpolated along its bound; a bound without any height takes the other one's. Where
    neither has one, both are returned without heights.
    """
    known = [bool(np.isfinite(bound[:, 2]).any()) for bound in (left, right)]
    if not any(known):
        return left[:, :2], right[:, :2]
    left, right = (_interpolated(b) if k else b for b, k in zip((left, right), known, strict=True))
    if not known[0]:
        left = _lifted(left, right)
    if not known[1]:
        right = _lifted(right, left)
    return left, right


def _interpolated(bound: Floats) -> Floats:
    given = np.isfinite(bound[:, 2])
    if given.all():
        return bound
    along = arc_lengths(bound)
    heights = np.interp(along, along[given], bound[given, 2])
    return np.column_stack([bound[:, :2], heights])


def _lifted(bound: Floats, other: Floats) -> Floats:
    along = arc_lengths(bound)
    heights = at_fractions(other, along / along[-1])[:, 2]
    return np.column_stack([bound[:, :2], heights])
