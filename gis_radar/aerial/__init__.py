"""The road from the air: airborne laser scans, masked by a map, as points of the road."""

from gis_radar.aerial.mask import RoadMask, mask_road, require_road_name
from gis_radar.aerial.road import read_road, road_crs
from gis_radar.aerial.roads import Roads, read_roads
from gis_radar.aerial.scans import Points, Scan, open_scan

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
