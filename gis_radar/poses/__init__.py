"""Poses: where a sensor stands and looks, its files, and its layers on a map."""

from gis_radar.poses.files import PoseTrack, read_pose, read_track, write_pose, write_track
from gis_radar.poses.pose import Pose, View

__all__ = ["Pose", "PoseTrack", "View", "read_pose", "read_track", "write_pose", "write_track"]
