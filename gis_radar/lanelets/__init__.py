"""Lanelet2 maps: read, placed in metres, mended where they can be."""

from gis_radar.lanelets.reader import LaneletMap, read_map

__all__ = ["LaneletMap", "read_map"]
