"""Elevation of tiles: the height of the road under each, from points of its surface."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gis_radar.arrays import Floats
from gis_radar.errors import InputError
from gis_radar.tiles.lookup import TileGrid
from gis_radar.tiles.tiles import quads

SAME_LEVEL_M = 2.0  # of the contract; bridges are over 4 m above
NEAR_M = 1.5  # half a lane: the nearest point is still of the same road


def with_road_heights(tiles: gpd.GeoDataFrame, road: Floats) -> gpd.GeoDataFrame:
    """Return tiles whose `height_m` is that of the scanned road.

    A tile takes the median of the points in it; one without points the nearest point within
    `NEAR_M` of its centre; else it keeps the height it had. Where the map has a height, it
    chooses the level: points more than `SAME_LEVEL_M` off it belong to another road.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.tiles.make_tiles`.
    road : (n, 3) array
        Points of the road's surface in the tiles' CRS, metres.

    Raises
    ------
    InputError
        If no tile gets a height: scan and map do not overlap.
    """
    known = tiles["height_m"].to_numpy(np.float64)
    point, tile = TileGrid(quads(tiles)).assign(road[:, 0], road[:, 1])
    level = ~(np.abs(road[point, 2] - known[tile]) > SAME_LEVEL_M)
    inside = pd.Series(road[point[level], 2]).groupby(tile[level]).median()
    found = inside.reindex(np.arange(len(tiles))).to_numpy(copy=True)
    bare = np.flatnonzero(np.isnan(found))
    centres = tiles.geometry.centroid
    distance, nearest = cKDTree(road[:, :2]).query(
        np.column_stack([centres.x, centres.y])[bare], distance_upper_bound=NEAR_M
    )
    near = np.isfinite(distance)
    height = road[np.asarray(nearest)[near], 2]
    fits = ~(np.abs(height - known[bare[near]]) > SAME_LEVEL_M)
    found[bare[near][fits]] = height[fits]
    if np.isnan(found).all():
        raise InputError("the road's points and the map do not overlap")
    return tiles.assign(height_m=np.where(np.isnan(found), known, found))
