from .columns import LEAST_GROUND, ScanColumns, ground_under, nearest_known, read_columns
from .mask import RoadMask, mask_road, require_road_name
from .pdal import find_pdal
from .roads import Roads, read_roads
from .scan import box_with_margin, open_scan, read_road, road_crs
from .shift import read_shifted
from .sight.gaps import find_gaps, gap_warning
from .sight.layers import SIGHT_LAYER, open_sight, write_sights
from .sight.obstacles import WIDEST_ROOF_M
from .sight.picture import SIGHT_COLOURS, SIGHT_NAMES, draw_sight
from .sight.recorded import (
    CAR_REFLECTION_M,
    JUDGED_FRAMES,
    MOVEMENT_LEVEL_M,
    MOVEMENT_MPS,
    MovingHits,
    find_contradictions,
    report_contradictions,
)
from .sight.sight import (
    HIDDEN,
    IN_SIGHT,
    OUT_OF_VIEW,
    TARGET_M,
    VIEW_ONLY,
    WINDOWS_KEPT,
    Sight,
    SightScan,
    find_sight,
    report_uncovered,
)
from .sight.tiles import SightTiles

__all__ = [
    "CAR_REFLECTION_M",
    "HIDDEN",
    "IN_SIGHT",
    "JUDGED_FRAMES",
    "LEAST_GROUND",
    "MOVEMENT_LEVEL_M",
    "MOVEMENT_MPS",
    "OUT_OF_VIEW",
    "SIGHT_COLOURS",
    "SIGHT_LAYER",
    "SIGHT_NAMES",
    "TARGET_M",
    "VIEW_ONLY",
    "WIDEST_ROOF_M",
    "WINDOWS_KEPT",
    "MovingHits",
    "RoadMask",
    "Roads",
    "ScanColumns",
    "Sight",
    "SightScan",
    "SightTiles",
    "box_with_margin",
    "draw_sight",
    "find_contradictions",
    "find_gaps",
    "find_pdal",
    "find_sight",
    "gap_warning",
    "ground_under",
    "mask_road",
    "nearest_known",
    "open_scan",
    "open_sight",
    "read_columns",
    "read_road",
    "read_roads",
    "read_shifted",
    "report_contradictions",
    "report_uncovered",
    "require_road_name",
    "road_crs",
    "write_sights",
]
