"""Heat maps: for every tile the share of the observed time in which it was hit."""

from gis_radar.heatmap.heatmap import HeatMap, make_heatmap, read_heatmap
from gis_radar.heatmap.intervals import MapLabels

__all__ = ["HeatMap", "MapLabels", "make_heatmap", "read_heatmap"]
