from .frame_hash import HashedFrames
from .frames import NO_FURTHER, FrameIndex, rows_of, whole_frames
from .hit_counter import FrameCounter
from .hour import LONGEST_VALID_STEPS, MARGIN_STEPS, HourWindow
from .hour_hits import ValidFrames, frame_columns, observed_runs, sorted_hits, valid_runs
from .placing import PoseNumbers
from .pose_sights import (
    PlacedRecording,
    PoseSight,
    SightBook,
    places_of,
    pose_names,
    road_near,
    sight_of_tiles,
    standing_for,
)
from .sensor_reading import HitTarget, RecordingCounts, SensorHour, read_sensor
from .settings import HIT_DEFAULTS, Filters, HitSettings
from .validity import FrameTimes, Runs, union_of_runs, valid_steps, validity_of

__all__ = [
    "HIT_DEFAULTS",
    "LONGEST_VALID_STEPS",
    "MARGIN_STEPS",
    "NO_FURTHER",
    "Filters",
    "FrameCounter",
    "FrameIndex",
    "FrameTimes",
    "HashedFrames",
    "HitSettings",
    "HitTarget",
    "HourWindow",
    "PlacedRecording",
    "PoseNumbers",
    "PoseSight",
    "RecordingCounts",
    "Runs",
    "SensorHour",
    "SightBook",
    "ValidFrames",
    "frame_columns",
    "observed_runs",
    "places_of",
    "pose_names",
    "read_sensor",
    "road_near",
    "rows_of",
    "sight_of_tiles",
    "sorted_hits",
    "standing_for",
    "union_of_runs",
    "valid_runs",
    "valid_steps",
    "validity_of",
    "whole_frames",
]
