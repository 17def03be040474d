"""Tracking: a sensor's pose followed through a recording by the paper's Kalman filter."""

from gis_radar.tracking.answer import Event, Track
from gis_radar.tracking.product import track

__all__ = ["Event", "Track", "track"]
