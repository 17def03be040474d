"""Formats that radar users have, behind one door: :func:`convert` makes recordings of them."""

from gis_radar.formats.conversion import convert
from gis_radar.formats.tracks import Conversion, SensorRecording

__all__ = ["Conversion", "SensorRecording", "convert"]
