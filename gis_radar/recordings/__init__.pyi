from .conversion import Conversion, SensorRecording, convert
from .frames import DamagedError, Frame
from .recording import Detections, RangeCounts, Recording, as_recording, open_recording
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
    "open_recording",
]
