from .evidence import COMPONENTS, Evidence
from .files import DECIMALS, PoseTrack, as_pose, as_track, as_tracks, read_pose, read_track
from .layers import SENSORS, UNCERTAINTY, VIEWS, read_style, write_sensors
from .pose import ANGLES, POSITION, Pose, View, draw_sensor, ellipse, pose_from_dict

__all__ = [
    "ANGLES",
    "COMPONENTS",
    "DECIMALS",
    "POSITION",
    "SENSORS",
    "UNCERTAINTY",
    "VIEWS",
    "Evidence",
    "Pose",
    "PoseTrack",
    "View",
    "as_pose",
    "as_track",
    "as_tracks",
    "draw_sensor",
    "ellipse",
    "pose_from_dict",
    "read_pose",
    "read_style",
    "read_track",
    "write_sensors",
]
