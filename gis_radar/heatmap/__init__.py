"""Heat maps: for every tile the share of the observed time in which it was occupied."""

from gis_radar.heatmap.heatmap import HeatMap, make_heatmap, read_heatmap, to_xarray

__all__ = ["HeatMap", "make_heatmap", "read_heatmap", "to_xarray"]
