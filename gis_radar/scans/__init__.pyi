from .mask import RoadMask, mask_road, require_road_name
from .roads import Roads, read_roads
from .scan import Points, Scan, open_scan, read_road, road_crs
from .settings import MaskSettings, RoadSettings

__all__ = [
    "MaskSettings",
    "Points",
    "RoadMask",
    "RoadSettings",
    "Roads",
    "Scan",
    "mask_road",
    "open_scan",
    "read_road",
    "read_roads",
    "require_road_name",
    "road_crs",
]
