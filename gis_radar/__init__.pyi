from .calibration import (
    Clocks,
    JointCalibration,
    Localization,
    ScanCheck,
    SensorClock,
    Track,
    check_against_scan,
    draw_localization,
    draw_scan_check,
    draw_track,
    localize,
    localize_files,
    localize_together,
    measure_clocks,
    read_clocks,
    track,
)
from .crs import yaw_from_compass
from .dataset import Dataset, open_dataset
from .dataset.hour_job import MeasureSettings
from .dataset.measure import measure
from .dataset.upkeep import relink, withdraw
from .demo import run_demo
from .errors import (
    CrsError,
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    UsageError,
)
from .heatmap import HeatMap, MapLabels, make_heatmap, read_heatmap
from .lanelets import LaneletMap, lanes, read_map, stop_lines
from .live.edge import Edge, run_edge
from .live.fusion import Fusion, run_fusion
from .measures import (
    Filters,
)
from .poses import Pose, PoseTrack, View, read_pose, read_track, write_pose, write_track
from .poses.layers import write_sensors
from .products.footprints import write_footprints
from .products.traffic import Traffic, make_traffic
from .products.trajectories import to_trajectories, track_points, write_trajectories
from .projection import project, write_projection
from .qgis import write_qgis_project, write_site_project
from .quality import Quality, measure_quality
from .recordings import Conversion, convert
from .recordings.formats import open_recording
from .report import Report, write_report
from .sample import sample_folder
from .scans.mask import RoadMask, mask_road
from .scans.roads import Roads, read_roads
from .scans.scan import read_road
from .sight import (
    Sight,
    SightScan,
    SightTiles,
    find_sight,
    write_sights,
)
from .site.check import SiteCheck, check_site
from .site.run import SiteRun, run_site
from .site.settings import Site, read_site, site_template
from .tiles import (
    TileGrid,
    TileTree,
    fingerprint,
    make_tiles,
    quads,
    read_tiles,
    with_road_heights,
    write_tiles,
)

__all__ = [
    "Clocks",
    "Conversion",
    "CrsError",
    "Dataset",
    "Edge",
    "Filters",
    "Fusion",
    "GisRadarError",
    "HeatMap",
    "InputError",
    "JointCalibration",
    "LaneletMap",
    "Localization",
    "MapLabels",
    "MeasureSettings",
    "NoAnswerError",
    "OutputError",
    "Pose",
    "PoseTrack",
    "Quality",
    "Report",
    "RoadMask",
    "Roads",
    "ScanCheck",
    "SensorClock",
    "Sight",
    "SightScan",
    "SightTiles",
    "Site",
    "SiteCheck",
    "SiteRun",
    "TileGrid",
    "TileTree",
    "Track",
    "Traffic",
    "UsageError",
    "View",
    "check_against_scan",
    "check_site",
    "convert",
    "draw_localization",
    "draw_scan_check",
    "draw_track",
    "find_sight",
    "fingerprint",
    "lanes",
    "localize",
    "localize_files",
    "localize_together",
    "make_heatmap",
    "make_tiles",
    "make_traffic",
    "mask_road",
    "measure",
    "measure_clocks",
    "measure_quality",
    "open_dataset",
    "open_recording",
    "project",
    "quads",
    "read_clocks",
    "read_heatmap",
    "read_map",
    "read_pose",
    "read_road",
    "read_roads",
    "read_site",
    "read_tiles",
    "read_track",
    "relink",
    "run_demo",
    "run_edge",
    "run_fusion",
    "run_site",
    "sample_folder",
    "site_template",
    "stop_lines",
    "to_trajectories",
    "track",
    "track_points",
    "with_road_heights",
    "withdraw",
    "write_footprints",
    "write_pose",
    "write_projection",
    "write_qgis_project",
    "write_report",
    "write_sensors",
    "write_sights",
    "write_site_project",
    "write_tiles",
    "write_track",
    "write_trajectories",
    "yaw_from_compass",
]
