"""The road from the air: airborne laser scans, masked by a map, as points of the road."""

from gis_radar.aerial.mask import RoadMask, mask_road, require_road_name
from gis_radar.aerial.road import read_road, road_crs
from gis_radar.aerial.roads import Roads, read_roads

__all__ = [
    "RoadMask",
    "Roads",
    "mask_road",
    "read_road",
    "read_roads",
    "require_road_name",
    "road_crs",
]
