"""Recordings of radar detections, and their conversion from the formats of radars."""

from gis_radar.recordings.conversion import Conversion, SensorRecording, convert

__all__ = ["Conversion", "SensorRecording", "convert"]
