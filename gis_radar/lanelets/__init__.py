"""Lanelet2 maps: read, placed in metres, mended where they can be."""

from gis_radar.lanelets.bounds import (
    CannotMendError,
    at_fractions,
    length,
    rungs,
    slices,
    sound,
    sound_rungs,
)
from gis_radar.lanelets.graph import LaneGraph, lane_graph
from gis_radar.lanelets.lanes import chain_lanelets, lanes, stop_lines
from gis_radar.lanelets.mending import outline
from gis_radar.lanelets.osm import read_osm
from gis_radar.lanelets.reader import LaneletMap, read_map

__all__ = [
    "CannotMendError",
    "LaneGraph",
    "LaneletMap",
    "at_fractions",
    "chain_lanelets",
    "lane_graph",
    "lanes",
    "length",
    "outline",
    "read_map",
    "read_osm",
    "rungs",
    "slices",
    "sound",
    "sound_rungs",
    "stop_lines",
]
