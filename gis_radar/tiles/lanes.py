"""Lanes: chains of lanelets, found from their tiles."""

from __future__ import annotations

from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import scipy

from gis_radar.arrays import Integers
from gis_radar.tiles.tiles import quads

TOUCH_M = 0.05  # between the ends of lanelets that follow each other


@dataclass(frozen=True, kw_only=True)
class Lane:
    """A chain of lanelets, each the only successor of the last and following nothing else.

    Parameters
    ----------
    number : int
        From 1, in the order of the smallest lanelet id: the same for the same map.
    lanelets : tuple of int
        In driving direction.
    rows : (n,) int64 array
        Positions of its tiles, in driving direction.
    """

    number: int
    lanelets: tuple[int, ...]
    rows: Integers


def lanes_of(tiles: gpd.GeoDataFrame) -> list[Lane]:
    """Chain lanelets to lanes, by where the tiles of one end and those of another begin.

    Parameters
    ----------
    tiles : GeoDataFrame
        With `lanelet_id`, `index` and the four-vertex polygons of :func:`gis_radar.make_tiles`.
    """
    ordered = tiles.reset_index(drop=True).sort_values(["lanelet_id", "index"])
    rows = {
        key: part.to_numpy(np.int64) for key, part in ordered.groupby("lanelet_id").groups.items()
    }
    ids = list(rows)
    corners = quads(tiles) - quads(tiles).min(axis=(0, 1))
    starts = np.array([corners[rows[each][0]][[0, 3]].ravel() for each in ids])
    ends = np.array([corners[rows[each][-1]][[1, 2]].ravel() for each in ids])
    following = scipy.spatial.cKDTree(ends).query_ball_tree(scipy.spatial.cKDTree(starts), TOUCH_M)
    after = {i: [k for k in found if k != i] for i, found in enumerate(following)}
    before: dict[int, list[int]] = {i: [] for i in after}
    for i, found in after.items():
        for k in found:
            before[k].append(i)
    only = {i: k[0] for i, k in after.items() if len(k) == 1 and len(before[k[0]]) == 1}
    chains = sorted(_chains(only, len(ids)), key=lambda chain: min(ids[i] for i in chain))
    return [
        Lane(
            number=number,
            lanelets=tuple(int(ids[i]) for i in chain),
            rows=np.concatenate([rows[ids[i]] for i in chain]),
        )
        for number, chain in enumerate(chains, start=1)
    ]


def _chains(only: dict[int, int], total: int) -> list[list[int]]:
    """Follow the links from where a chain begins; a ring begins at its first lanelet."""
    led_to = set(only.values())
    chains, seen = [], set[int]()
    for first in [*(i for i in range(total) if i not in led_to), *range(total)]:
        chain, at = [], first
        while at not in seen:
            seen.add(at)
            chain.append(at)
            at = only.get(at, at)
        if chain:
            chains.append(chain)
    return chains
