from .base import (
    CrsError,
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    UsageError,
    yaw_from_compass,
)
from .calibration import check_against_scan, localize, measure_clocks, read_clocks, track
from .city import City, CityRun, fleet_health, open_city, run_city, write_month_page
from .dataset import Dataset, match_lanes, measure, open_dataset
from .demo import run_demo
from .hdmap import LaneletMap, make_tiles, read_map, read_tiles, write_tiles
from .live import run_edge, run_fusion
from .measures import Filters
from .poses import Pose, PoseTrack, View, read_pose, read_track
from .products import (
    MapLabels,
    compare,
    make_heatmap,
    make_traffic,
    measure_quality,
    project,
    publish,
    publish_city,
    read_heatmap,
    write_qgis_project,
    write_report,
)
from .recordings import convert, open_recording
from .sample import sample_folder
from .scans import find_sight, mask_road, read_road
from .site import Site, check_site, read_site, run_site

__all__ = [
    "City",
    "CityRun",
    "CrsError",
    "Dataset",
    "Filters",
    "GisRadarError",
    "InputError",
    "LaneletMap",
    "MapLabels",
    "NoAnswerError",
    "OutputError",
    "Pose",
    "PoseTrack",
    "Site",
    "UsageError",
    "View",
    "check_against_scan",
    "check_site",
    "compare",
    "convert",
    "find_sight",
    "fleet_health",
    "localize",
    "make_heatmap",
    "make_tiles",
    "make_traffic",
    "mask_road",
    "match_lanes",
    "measure",
    "measure_clocks",
    "measure_quality",
    "open_city",
    "open_dataset",
    "open_recording",
    "project",
    "publish",
    "publish_city",
    "read_clocks",
    "read_heatmap",
    "read_map",
    "read_pose",
    "read_road",
    "read_site",
    "read_tiles",
    "read_track",
    "run_city",
    "run_demo",
    "run_edge",
    "run_fusion",
    "run_site",
    "sample_folder",
    "track",
    "write_month_page",
    "write_qgis_project",
    "write_report",
    "write_tiles",
    "yaw_from_compass",
]
