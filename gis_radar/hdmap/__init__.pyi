from .bounds import CannotMendError, at_fractions, bound_length, rungs, slices, sound, sound_rungs
from .graph import LANE_MARGIN_M, FieldArrays, LaneGraph, lane_graph, lanes_at
from .lanelet_map import LaneletMap
from .lanes import (
    LANE_EXIT_M,
    LANES_LAYER,
    STOP_LINES_LAYER,
    chain_lanelets,
    joining,
    lane_style,
    turn_word,
)
from .mending import outline
from .osm import read_osm
from .reader import read_map
from .tagging import ON_FOOT_OR_BICYCLE, is_driven
from .tile_lanes import Lane, lanes_of
from .tile_lookup import Numbers, TileCells, TileGrid, cell_at, is_inside
from .tiles import (
    LANE_COLUMN,
    SAME_LEVEL_M,
    TILE_COLUMNS,
    TILE_FIELDS,
    TILES_LAYER,
    fingerprint,
    make_tiles,
    own_columns,
    polygons,
    quads,
    read_tiles,
    require_tiles,
    write_tiles,
)

__all__ = [
    "LANES_LAYER",
    "LANE_COLUMN",
    "LANE_EXIT_M",
    "LANE_MARGIN_M",
    "ON_FOOT_OR_BICYCLE",
    "SAME_LEVEL_M",
    "STOP_LINES_LAYER",
    "TILES_LAYER",
    "TILE_COLUMNS",
    "TILE_FIELDS",
    "CannotMendError",
    "FieldArrays",
    "Lane",
    "LaneGraph",
    "LaneletMap",
    "Numbers",
    "TileCells",
    "TileGrid",
    "at_fractions",
    "bound_length",
    "cell_at",
    "chain_lanelets",
    "fingerprint",
    "is_driven",
    "is_inside",
    "joining",
    "lane_graph",
    "lane_style",
    "lanes_at",
    "lanes_of",
    "make_tiles",
    "outline",
    "own_columns",
    "polygons",
    "quads",
    "read_map",
    "read_osm",
    "read_tiles",
    "require_tiles",
    "rungs",
    "slices",
    "sound",
    "sound_rungs",
    "turn_word",
    "write_tiles",
]
