"""Clocks of several sensors, compared by the traffic that they see in common."""

from gis_radar.clocks.clocks import Clocks, measure_clocks

__all__ = ["Clocks", "measure_clocks"]
