from .cycles import Cycle, Greens, cycles
from .differences import INTERVALS, LEVEL, compare_values, holm_corrected
from .filters import Filters
from .frame_hash import HashedFrames
from .frames import NO_FURTHER, FrameIndex, rows_of, whole_frames
from .headways import Headways, headways
from .hit_counter import FrameCounter
from .hour import HOUR_MARGIN_STEPS, LONGEST_VALID_STEPS, HourWindow
from .hour_hits import ValidFrames, frame_columns, observed_runs, sorted_hits, valid_runs
from .lane_fronts import FrontStates, StepGrid, TrackedLanes, VehicleTable, VisibleRuns
from .lane_measures import (
    LEAST_VISIBLE_SHARE,
    SPEED_CLASS_KMH,
    SPEED_CLASSES,
    Measured,
    TileSteps,
    measure_lanes,
)
from .lane_names import TURN_WORDS, bound_name, lane_directions, lane_names, place_on, turn_lines
from .lane_network import LaneNetwork
from .placing import PoseNumbers
from .pose_sights import (
    PlacedRecording,
    PoseSight,
    SightBook,
    digest_of_sights,
    pose_names,
    road_near,
    sight_of_tiles,
    sight_owners,
)
from .queues import JOINED_M, QueueCourse, queue_course
from .sensor_reading import HitTarget, RecordingCounts, SensorHour, read_sensor
from .validity import (
    CYCLES_VALID,
    VALIDITY_S,
    FrameTimes,
    Runs,
    union_of_runs,
    valid_steps,
    validity_of,
)

__all__ = [
    "CYCLES_VALID",
    "HOUR_MARGIN_STEPS",
    "INTERVALS",
    "JOINED_M",
    "LEAST_VISIBLE_SHARE",
    "LEVEL",
    "LONGEST_VALID_STEPS",
    "NO_FURTHER",
    "SPEED_CLASSES",
    "SPEED_CLASS_KMH",
    "TURN_WORDS",
    "VALIDITY_S",
    "Cycle",
    "Filters",
    "FrameCounter",
    "FrameIndex",
    "FrameTimes",
    "FrontStates",
    "Greens",
    "HashedFrames",
    "Headways",
    "HitTarget",
    "HourWindow",
    "LaneNetwork",
    "Measured",
    "PlacedRecording",
    "PoseNumbers",
    "PoseSight",
    "QueueCourse",
    "RecordingCounts",
    "Runs",
    "SensorHour",
    "SightBook",
    "StepGrid",
    "TileSteps",
    "TrackedLanes",
    "ValidFrames",
    "VehicleTable",
    "VisibleRuns",
    "bound_name",
    "compare_values",
    "cycles",
    "digest_of_sights",
    "frame_columns",
    "headways",
    "holm_corrected",
    "lane_directions",
    "lane_names",
    "measure_lanes",
    "observed_runs",
    "place_on",
    "pose_names",
    "queue_course",
    "read_sensor",
    "road_near",
    "rows_of",
    "sight_of_tiles",
    "sight_owners",
    "sorted_hits",
    "turn_lines",
    "union_of_runs",
    "valid_runs",
    "valid_steps",
    "validity_of",
    "whole_frames",
]
