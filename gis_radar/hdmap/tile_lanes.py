"""Lanes of tiles: the tiles of each lane, in driving order."""

from __future__ import annotations

from dataclasses import dataclass

import geopandas as gpd
import numpy as np

from gis_radar.base import Integers
from gis_radar.hdmap.lanes import chain_lanelets
from gis_radar.hdmap.tiles import LANE_COLUMN, quads


@dataclass(frozen=True, kw_only=True)
class Lane:
    """A chain of lanelets, each the only successor of its only predecessor.

    Parameters
    ----------
    number : int
        Its smallest lanelet id: the same for the same map.
    lanelets : tuple of int
        Ids of its lanelets with tiles, in driving direction.
    rows : (n,) int64 array
        Positions of its tiles in the table, in driving direction.
    """

    number: int
    lanelets: tuple[int, ...]
    rows: Integers


def lanes_of(tiles: gpd.GeoDataFrame) -> list[Lane]:
    """Return the lanes of tiles, by number.

    Tiles with the column `lane` of :func:`gis_radar.make_tiles` are grouped by it; for others,
    lanelets are chained by the begin and the end of their tiles.

    Parameters
    ----------
    tiles : GeoDataFrame
        With `lanelet_id`, `index` and the four-vertex polygons of :func:`gis_radar.make_tiles`.
    """
    ordered = tiles.reset_index(drop=True).sort_values(["lanelet_id", "index"])
    rows = {
        int(key): part.to_numpy(np.int64)
        for key, part in ordered.groupby("lanelet_id").groups.items()
    }
    ids = np.fromiter(rows, np.int64, len(rows))
    corners = quads(tiles) - quads(tiles).min(axis=(0, 1))
    starts = np.array([corners[part[0]][[3, 0]].ravel() for part in rows.values()])
    ends = np.array([corners[part[-1]][[2, 1]].ravel() for part in rows.values()])
    if LANE_COLUMN not in tiles:
        chains = {min(chain): chain for chain in chain_lanelets(ids, starts, ends)}
    else:
        numbers = ordered.groupby("lanelet_id")[LANE_COLUMN].first().to_numpy(np.int64)
        chains = {}
        for number in np.unique(numbers).tolist():
            mine = np.flatnonzero(numbers == number)
            parts = chain_lanelets(ids[mine], starts[mine], ends[mine])
            chains[number] = tuple(ref for part in parts for ref in part)
    return [
        Lane(number=number, lanelets=chain, rows=np.concatenate([rows[ref] for ref in chain]))
        for number, chain in sorted(chains.items())
    ]
