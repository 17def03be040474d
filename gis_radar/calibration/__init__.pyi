from .check.evidence import LaneMap
from .check.plausibility import RecordedSensor, check_plausibility, check_recordings
from .findings import (
    FITS,
    HEADS,
    SENSOR_STATES,
    UNKNOWN,
    WRONG,
    Finding,
    ImplausibleError,
    concerns_clocks,
    is_record,
    refuse_implausible,
)
from .monitoring.kalman_filter import CYCLE_S, DRIFT
from .monitoring.monitor import LOST_S, Follower, start_estimate, track
from .monitoring.pose_track import MOVED, Track, track_of
from .monitoring.windows import WindowFitter
from .range_scale import measure_range_scale
from .scan.scan_check import check_against_scan, require_scans_near
from .scan.scan_check_result import ScanCheck
from .several.joint import JointCalibration, adjust_poses, gain_line, localize_together
from .several.network import CLASH_HINT, Solved
from .several.swapped_guesses import swapped_guesses
from .single.localization import localize, localize_one
from .single.result import AmbiguousError, Localization, Problem
from .timing.clocks import Clocks, SensorClock, measure_clocks, read_clocks
from .timing.lane_detections import lanelets_of
from .unit_mistakes import RangeScale

__all__ = [
    "CLASH_HINT",
    "CYCLE_S",
    "DRIFT",
    "FITS",
    "HEADS",
    "LOST_S",
    "MOVED",
    "SENSOR_STATES",
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
    "concerns_clocks",
    "gain_line",
    "is_record",
    "lanelets_of",
    "localize",
    "localize_one",
    "localize_together",
    "measure_clocks",
    "measure_range_scale",
    "read_clocks",
    "refuse_implausible",
    "require_scans_near",
    "start_estimate",
    "swapped_guesses",
    "track",
    "track_of",
]
