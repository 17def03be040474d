"""Heat maps: occupancy of every tile, and its hit share."""

from gis_radar.heatmap.heatmap import HeatMap, make_heatmap, read_heatmap
from gis_radar.heatmap.intervals import MapLabels

__all__ = ["HeatMap", "MapLabels", "make_heatmap", "read_heatmap"]
