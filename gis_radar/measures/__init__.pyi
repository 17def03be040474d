from .frame_hash import HashedFrames
from .frames import NO_FURTHER
from .hit_counter import FrameCounter
from .hour import HourWindow
from .placing import PoseNumbers
from .pose_sights import (
    PlacedRecording,
    PoseSight,
    SightBook,
    road_near,
    sight_of_tiles,
    standing_for,
)
from .sensor_reading import SensorHour
from .settings import Filters, HitSettings
from .validity import Runs, union, valid_steps, validity_of

__all__ = [
    "NO_FURTHER",
    "Filters",
    "FrameCounter",
    "HashedFrames",
    "HitSettings",
    "HourWindow",
    "PlacedRecording",
    "PoseNumbers",
    "PoseSight",
    "Runs",
    "SensorHour",
    "SightBook",
    "road_near",
    "sight_of_tiles",
    "standing_for",
    "union",
    "valid_steps",
    "validity_of",
]
