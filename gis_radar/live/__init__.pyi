from .edge import Edge, run_edge
from .fusion import Fusion, run_fusion
from .health import SensorHealth, prometheus_text
from .hours.quarters import QuarterMeasures
from .hours.recent import RecentCounts
from .hours.recordings import (
    HOUR_OFFSET_US,
    HOUR_US,
    join_parts,
    make_parts,
    recording_path,
    waiting_hours,
)
from .hours.spool import Spool, SpooledFrames, SpoolFile, spool_files
from .intake import Intake
from .now.map_of_now import MapOfNow, Windows
from .served.page import make_app
from .served.snapshot import Place, Snapshot
from .web_server import WebServer
from .wire.broker import BrokerAddress, Link, Received, SensorTopics
from .wire.broker_files import write_broker_files
from .wire.buffer import DiskBuffer
from .wire.detections import DetectionSelector, FrameDetections, pack_detections, unpack_detections
from .wire.outbox import Outbox
from .wire.payload import (
    Acknowledgement,
    Envelope,
    PoseContent,
    check_of,
    key_of_pose,
    pack_message,
    unpack_message,
)
from .wire.settings import edge_template, read_edge_file, read_live_site
from .wire.sources import Radar, frames_of_recording

__all__ = [
    "HOUR_OFFSET_US",
    "HOUR_US",
    "Acknowledgement",
    "BrokerAddress",
    "DetectionSelector",
    "DiskBuffer",
    "Edge",
    "Envelope",
    "FrameDetections",
    "Fusion",
    "Intake",
    "Link",
    "MapOfNow",
    "Outbox",
    "Place",
    "PoseContent",
    "QuarterMeasures",
    "Radar",
    "Received",
    "RecentCounts",
    "SensorHealth",
    "SensorTopics",
    "Snapshot",
    "Spool",
    "SpoolFile",
    "SpooledFrames",
    "WebServer",
    "Windows",
    "check_of",
    "edge_template",
    "frames_of_recording",
    "join_parts",
    "key_of_pose",
    "make_app",
    "make_parts",
    "pack_detections",
    "pack_message",
    "prometheus_text",
    "read_edge_file",
    "read_live_site",
    "recording_path",
    "run_edge",
    "run_fusion",
    "spool_files",
    "unpack_detections",
    "unpack_message",
    "waiting_hours",
    "write_broker_files",
]
