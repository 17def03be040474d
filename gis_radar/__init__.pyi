from .aerial import (
    RoadMask,
    Roads,
    mask_road,
    read_road,
    read_roads,
    require_road_name,
    road_crs,
)
from .assignment import TileGrid, TileTree
from .crs import name_of, yaw_from_compass
from .demo import run_demo, sample_folder
from .detections import open_recording
from .elevation import with_road_heights
from .errors import (
    CrsError,
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    UsageError,
)
from .heatmap import HeatMap, make_heatmap
from .lanelets import LaneletMap, read_map
from .localization import Localization, draw_localization, localize
from .occupancy import (
    Filters,
    Occupancy,
    measure_occupancy,
    merge_occupancies,
    read_occupancy,
)
from .pose import Pose, View
from .pose_files import PoseTrack, read_pose, read_track, write_pose
from .projection import project, write_projection
from .tiles import fingerprint, make_tiles, quads, read_tiles, write_tiles

__all__ = [
    "CrsError",
    "Filters",
    "GisRadarError",
    "HeatMap",
    "InputError",
    "LaneletMap",
    "Localization",
    "NoAnswerError",
    "Occupancy",
    "OutputError",
    "Pose",
    "PoseTrack",
    "RoadMask",
    "Roads",
    "TileGrid",
    "TileTree",
    "UsageError",
    "View",
    "draw_localization",
    "fingerprint",
    "localize",
    "make_heatmap",
    "make_tiles",
    "mask_road",
    "measure_occupancy",
    "merge_occupancies",
    "name_of",
    "open_recording",
    "project",
    "quads",
    "read_map",
    "read_occupancy",
    "read_pose",
    "read_road",
    "read_roads",
    "read_tiles",
    "read_track",
    "require_road_name",
    "road_crs",
    "run_demo",
    "sample_folder",
    "with_road_heights",
    "write_pose",
    "write_projection",
    "write_tiles",
    "yaw_from_compass",
]
