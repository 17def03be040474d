from .files import PoseTrack, as_track, read_pose, read_track, write_pose, write_track
from .pose import COMPONENTS, Pose, View, ellipse, pose_from_dict

__all__ = [
    "COMPONENTS",
    "Pose",
    "PoseTrack",
    "View",
    "as_track",
    "ellipse",
    "pose_from_dict",
    "read_pose",
    "read_track",
    "write_pose",
    "write_track",
]
