"""Lanelet2 maps: read, placed in metres, mended where they can be."""

from gis_radar.lanelets.lanes import lanes, stop_lines
from gis_radar.lanelets.reader import LaneletMap, read_map

__all__ = ["LaneletMap", "lanes", "read_map", "stop_lines"]
