from .pdal import find_pdal
from .scan import open_scan, read_road, road_crs

__all__ = [
    "find_pdal",
    "open_scan",
    "read_road",
    "road_crs",
]
