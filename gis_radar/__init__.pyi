from .clocks import Clocks, SensorClock, measure_clocks, read_clocks
from .crs import yaw_from_compass
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
from .localization import Localization, localize, localize_files
from .localization.result import draw_localization
from .network import Together, localize_together
from .occupancy import (
    Filters,
    Occupancy,
    measure_occupancy,
    merge_occupancies,
    read_occupancy,
)
from .poses import Pose, PoseTrack, View, read_pose, read_track, write_pose, write_track
from .poses.layers import write_sensors
from .projection import project, write_projection
from .qgis import write_qgis_project, write_site_project
from .quality import Quality, measure_quality
from .recordings import Conversion, convert
from .recordings.recording import open_recording
from .report import Report, write_report
from .sample import sample_folder
from .scans.mask import RoadMask, mask_road
from .scans.roads import Roads, read_roads
from .scans.scan import read_road
from .second_look import SecondLook, second_look
from .second_look.picture import draw_second_look
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
from .tracking import Track, track
from .tracking.track import draw_track
from .vehicles import Vehicles, find_vehicles, merge_vehicles, read_vehicles
from .vehicles.layer import write_footprints
from .vehicles.trajectories import to_trajectories, track_points, write_trajectories

__all__ = [
    "Clocks",
    "Conversion",
    "CrsError",
    "Edge",
    "Filters",
    "Fusion",
    "GisRadarError",
    "HeatMap",
    "InputError",
    "LaneletMap",
    "Localization",
    "MapLabels",
    "NoAnswerError",
    "Occupancy",
    "OutputError",
    "Pose",
    "PoseTrack",
    "Quality",
    "Report",
    "RoadMask",
    "Roads",
    "SecondLook",
    "SensorClock",
    "Sight",
    "SightScan",
    "SightTiles",
    "Site",
    "SiteCheck",
    "SiteRun",
    "TileGrid",
    "TileTree",
    "Together",
    "Track",
    "UsageError",
    "Vehicles",
    "View",
    "check_site",
    "convert",
    "draw_localization",
    "draw_second_look",
    "draw_track",
    "find_sight",
    "find_vehicles",
    "fingerprint",
    "lanes",
    "localize",
    "localize_files",
    "localize_together",
    "make_heatmap",
    "make_tiles",
    "mask_road",
    "measure_clocks",
    "measure_occupancy",
    "measure_quality",
    "merge_occupancies",
    "merge_vehicles",
    "open_recording",
    "project",
    "quads",
    "read_clocks",
    "read_heatmap",
    "read_map",
    "read_occupancy",
    "read_pose",
    "read_road",
    "read_roads",
    "read_site",
    "read_tiles",
    "read_track",
    "read_vehicles",
    "run_demo",
    "run_edge",
    "run_fusion",
    "run_site",
    "sample_folder",
    "second_look",
    "site_template",
    "stop_lines",
    "to_trajectories",
    "track",
    "track_points",
    "with_road_heights",
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
