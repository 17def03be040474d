"""Network: the poses of several sensors, tied by the vehicles that two of them see."""

from gis_radar.network.together import Together, localize_together

__all__ = ["Together", "localize_together"]
