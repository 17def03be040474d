from . import columns
from .batches import warn_of_poses
from .bodies import are_persons, usual_rcs
from .detections import MapDetections, map_detections, still_rate
from .footprints import Footprints, PathBook, footprints_of
from .forward import ForwardFilter
from .hour_vehicles import HourVehicles, vehicles_of_hour
from .map_check import map_of_tiles
from .occupancy_settings import OCCUPANCY_DEFAULTS, OccupancySettings
from .passages import HEAVY
from .settings import VEHICLE_DEFAULTS, DetectionSettings, VehicleSettings

__all__ = [
    "HEAVY",
    "OCCUPANCY_DEFAULTS",
    "VEHICLE_DEFAULTS",
    "DetectionSettings",
    "Footprints",
    "ForwardFilter",
    "HourVehicles",
    "MapDetections",
    "OccupancySettings",
    "PathBook",
    "VehicleSettings",
    "are_persons",
    "columns",
    "footprints_of",
    "map_detections",
    "map_of_tiles",
    "still_rate",
    "usual_rcs",
    "vehicles_of_hour",
    "warn_of_poses",
]
