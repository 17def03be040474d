from .mask import RoadMask, mask_road, require_road_name
from .roads import Roads, read_roads
from .scan import Points, Scan, open_scan, read_road, road_crs

__all__ = [
    "Points",
    "RoadMask",
    "Roads",
    "Scan",
    "mask_road",
    "open_scan",
    "read_road",
    "read_roads",
    "require_road_name",
    "road_crs",
]
