"""The tiles that sensors may see, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import geopandas as gpd
import numpy as np
import shapely
from pyproj import CRS

from gis_radar.base import Floats, Integers, metric_crs
from gis_radar.hdmap import fingerprint, quads, require_tiles


@dataclass(frozen=True, kw_only=True)
class SightTiles:
    """Tiles as arrays, for sight.

    Parameters
    ----------
    tile_id, lanelet_id : (n,) int64 array
        Ids of the tiles and of their lanelets.
    quads : (n, 4, 2) array
        Their vertices in the map, metres.
    height : (n,) array
        Height of the road, metres; NaN where unknown.
    crs : CRS
        Coordinate system of the map.
    fingerprint : str
        Fingerprint of the tile layer.
    """

    tile_id: Integers = field(repr=False)
    lanelet_id: Integers = field(repr=False)
    quads: Floats = field(repr=False)
    height: Floats = field(repr=False)
    crs: CRS
    fingerprint: str

    @classmethod
    def of(cls, tiles: gpd.GeoDataFrame) -> SightTiles:
        """Return the tiles of a table from :func:`gis_radar.read_tiles`."""
        require_tiles(tiles, what="tiles")
        return cls(
            tile_id=tiles["tile_id"].to_numpy(np.int64),
            lanelet_id=tiles["lanelet_id"].to_numpy(np.int64),
            quads=quads(tiles),
            height=tiles["height_m"].to_numpy(np.float64),
            crs=metric_crs(tiles.crs, what="tiles"),
            fingerprint=fingerprint(tiles),
        )

    @cached_property
    def centres(self) -> Floats:
        """Centres in the map at the height of the road, (n, 3) metres."""
        middle = shapely.get_coordinates(shapely.centroid(shapely.polygons(self.quads)))
        return np.column_stack([middle, self.height])
