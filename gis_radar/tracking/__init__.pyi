from . import columns
from .batches import warn_of_poses
from .detections import (
    HEIGHT_RAD,
    HIGH_M,
    LOW_M,
    MOVING_MPS,
    NOISE_S,
    SLOW_MPS,
    MapDetections,
    map_detections,
    still_rate,
)
from .footprints import Footprints, PathBook, footprints_of
from .hour_blocks import BLOCK_MARGIN_STEPS
from .hour_vehicles import HourVehicles, vehicles_of_hour
from .map_check import map_of_tiles
from .passages import HEAVY
from .start.bodies import are_persons, usual_rcs
from .start.forward import STAND_S, ForwardFilter

__all__ = [
    "BLOCK_MARGIN_STEPS",
    "HEAVY",
    "HEIGHT_RAD",
    "HIGH_M",
    "LOW_M",
    "MOVING_MPS",
    "NOISE_S",
    "SLOW_MPS",
    "STAND_S",
    "Footprints",
    "ForwardFilter",
    "HourVehicles",
    "MapDetections",
    "PathBook",
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
