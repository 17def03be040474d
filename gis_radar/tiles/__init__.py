"""Tiles: slices of lanelets, half a metre along the lane and as wide as it."""

from gis_radar.tiles.lookup import TileEngine, TileGrid, TileTree, with_road_heights
from gis_radar.tiles.tiles import fingerprint, make_tiles, quads, read_tiles, write_tiles

__all__ = [
    "TileEngine",
    "TileGrid",
    "TileTree",
    "fingerprint",
    "make_tiles",
    "quads",
    "read_tiles",
    "with_road_heights",
    "write_tiles",
]
