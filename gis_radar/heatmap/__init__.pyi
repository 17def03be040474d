from .heatmap import HeatMap, make_heatmap, read_heatmap
from .intervals import MapLabels

__all__ = ["HeatMap", "MapLabels", "make_heatmap", "read_heatmap"]
