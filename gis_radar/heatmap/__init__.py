"""Heat maps: for every tile the share of the observed time in which it was occupied."""

from gis_radar.heatmap.product import HeatMap, make_heatmap
from gis_radar.heatmap.reading import read_heatmap
from gis_radar.heatmap.series import to_xarray
from gis_radar.heatmap.tally import Tally

__all__ = ["HeatMap", "Tally", "make_heatmap", "read_heatmap", "to_xarray"]
