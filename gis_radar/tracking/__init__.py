"""Tracking: a sensor's pose followed through a recording by the paper's Kalman filter."""

from gis_radar.tracking.follow import track
from gis_radar.tracking.track import Event, Track

__all__ = ["Event", "Track", "track"]
