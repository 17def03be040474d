from .lanes import lanes_of
from .lookup import TileEngine, TileGrid, TileTree, with_road_heights
from .tiles import LANE, fingerprint, make_tiles, polygons, quads, read_tiles, write_tiles

__all__ = [
    "LANE",
    "TileEngine",
    "TileGrid",
    "TileTree",
    "fingerprint",
    "lanes_of",
    "make_tiles",
    "polygons",
    "quads",
    "read_tiles",
    "with_road_heights",
    "write_tiles",
]
