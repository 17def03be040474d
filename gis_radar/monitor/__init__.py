"""Tracking: a sensor's pose followed through a recording by the paper's Kalman filter."""

from gis_radar.monitor.follow import track
from gis_radar.monitor.track import Event, Track

__all__ = ["Event", "Track", "track"]
