"""Traces: what moved in a recording, as points, tracks and voxels in the sensor frame."""

from gis_radar.traces.clusters import cluster
from gis_radar.traces.tracks import Samples, thin, track
from gis_radar.traces.window import FRAMES, MIN_SPEED, Moving, RollingWindow, read_moving, voxels

__all__ = [
    "FRAMES",
    "MIN_SPEED",
    "Moving",
    "RollingWindow",
    "Samples",
    "cluster",
    "read_moving",
    "thin",
    "track",
    "voxels",
]
