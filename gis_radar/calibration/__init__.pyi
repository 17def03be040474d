from .clocks import Clocks, SensorClock, measure_clocks, read_clocks
from .findings import (
    FITS,
    HEADS,
    UNKNOWN,
    WRONG,
    Finding,
    ImplausibleError,
    is_record,
    refuse_implausible,
)
from .joint import JointCalibration, adjust_poses, gain_line, localize_together
from .kalman_filter import CYCLE_S, DRIFT
from .lane_detections import lanelets_of
from .localization import localize
from .monitor import LOST_S, Follower, start_estimate, track
from .network import CLASH_HINT, Solved
from .plausibility import RecordedSensor, check_plausibility, check_recordings
from .pose_track import MOVED, Track, track_of
from .range_scale import measure_range_scale
from .result import AmbiguousError, Localization, Problem
from .rivals import LaneMap
from .scan_check import check_against_scan, require_scans_near
from .scan_check_result import ScanCheck
from .traces import FRAMES, MIN_SPEED_MPS
from .unit_mistakes import RangeScale
from .windows import WindowFitter

__all__ = [
    "CLASH_HINT",
    "CYCLE_S",
    "DRIFT",
    "FITS",
    "FRAMES",
    "HEADS",
    "LOST_S",
    "MIN_SPEED_MPS",
    "MOVED",
    "UNKNOWN",
    "WRONG",
    "AmbiguousError",
    "Clocks",
    "Finding",
    "Follower",
    "ImplausibleError",
    "JointCalibration",
    "LaneMap",
    "Localization",
    "Problem",
    "RangeScale",
    "RecordedSensor",
    "ScanCheck",
    "SensorClock",
    "Solved",
    "Track",
    "WindowFitter",
    "adjust_poses",
    "check_against_scan",
    "check_plausibility",
    "check_recordings",
    "gain_line",
    "is_record",
    "lanelets_of",
    "localize",
    "localize_together",
    "measure_clocks",
    "measure_range_scale",
    "read_clocks",
    "refuse_implausible",
    "require_scans_near",
    "start_estimate",
    "track",
    "track_of",
]
