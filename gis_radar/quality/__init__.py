"""Quality: what the numbers of an occupancy rest on, by sensor and hour."""

from gis_radar.quality.quality import Quality, measure_quality

__all__ = ["Quality", "measure_quality"]
