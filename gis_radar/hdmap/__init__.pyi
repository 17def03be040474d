from .bounds import CannotMendError, at_fractions, length, rungs, slices, sound, sound_rungs
from .graph import MARGIN_M, FieldArrays, LaneGraph, lane_graph, lanes_at
from .lanes import EXIT_M, LANES, STOP_LINES, chain_lanelets, lane_style, lanes, stop_lines
from .mending import outline
from .osm import read_osm
from .reader import LaneletMap, read_map
from .tagging import ON_FOOT_OR_BICYCLE
from .tile_lanes import Lane, lanes_of
from .tile_lookup import (
    Numbers,
    TileCells,
    TileEngine,
    TileGrid,
    TileTree,
    cell_at,
    is_inside,
    with_road_heights,
)
from .tiles import (
    COLUMNS,
    FIELDS,
    LANE,
    LAYER,
    fingerprint,
    make_tiles,
    own_columns,
    polygons,
    quads,
    read_tiles,
    write_tiles,
)

__all__ = [
    "COLUMNS",
    "EXIT_M",
    "FIELDS",
    "LANE",
    "LANES",
    "LAYER",
    "MARGIN_M",
    "ON_FOOT_OR_BICYCLE",
    "STOP_LINES",
    "CannotMendError",
    "FieldArrays",
    "Lane",
    "LaneGraph",
    "LaneletMap",
    "Numbers",
    "TileCells",
    "TileEngine",
    "TileGrid",
    "TileTree",
    "at_fractions",
    "cell_at",
    "chain_lanelets",
    "fingerprint",
    "is_inside",
    "lane_graph",
    "lane_style",
    "lanes",
    "lanes_at",
    "lanes_of",
    "length",
    "make_tiles",
    "outline",
    "own_columns",
    "polygons",
    "quads",
    "read_map",
    "read_osm",
    "read_tiles",
    "rungs",
    "slices",
    "sound",
    "sound_rungs",
    "stop_lines",
    "with_road_heights",
    "write_tiles",
]
