"""Formats that radar users have, behind one door: :func:`convert` makes recordings of them."""

from gis_radar.recordings.conversion import Conversion, SensorRecording, convert

__all__ = ["Conversion", "SensorRecording", "convert"]
