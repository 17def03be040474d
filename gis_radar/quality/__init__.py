"""Data quality of a dataset, by sensor and hour."""

from gis_radar.quality.quality import Quality, QualitySettings, measure_quality

__all__ = ["Quality", "QualitySettings", "measure_quality"]
