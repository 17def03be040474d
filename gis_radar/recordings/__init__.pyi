from .conversion import Conversion, convert
from .formats import as_recording, as_recordings, format_of, is_recording, open_recording
from .frame_clock import AGREEING_S
from .frames import DamagedError, Frame, ReaderContext
from .overlaps import detection_keys, keys_in_common, time_warnings
from .raw_rows import RawRows, read_raw
from .recording import Detections, RangeCounts, Recording, constant_value, has_height
from .units import FARTHEST_RADAR_M
from .window import RollingWindow

__all__ = [
    "AGREEING_S",
    "FARTHEST_RADAR_M",
    "Conversion",
    "DamagedError",
    "Detections",
    "Frame",
    "RangeCounts",
    "RawRows",
    "ReaderContext",
    "Recording",
    "RollingWindow",
    "as_recording",
    "as_recordings",
    "constant_value",
    "convert",
    "detection_keys",
    "format_of",
    "has_height",
    "is_recording",
    "keys_in_common",
    "open_recording",
    "read_raw",
    "time_warnings",
]
