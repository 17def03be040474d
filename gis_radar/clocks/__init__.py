"""Clocks of several sensors, compared by the traffic that they see in common."""

from gis_radar.clocks.clocks import Clocks, SensorClock, measure_clocks, read_clocks
from gis_radar.clocks.settings import ClockSettings

__all__ = ["ClockSettings", "Clocks", "SensorClock", "measure_clocks", "read_clocks"]
