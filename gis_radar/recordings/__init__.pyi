from .conversion import Conversion, SensorRecording, convert
from .formats import as_recording, is_recording, open_recording
from .frames import DamagedError, Frame
from .recording import Detections, RangeCounts, Recording
from .units import compare_speeds

__all__ = [
    "Conversion",
    "DamagedError",
    "Detections",
    "Frame",
    "RangeCounts",
    "Recording",
    "SensorRecording",
    "as_recording",
    "compare_speeds",
    "convert",
    "is_recording",
    "open_recording",
]
