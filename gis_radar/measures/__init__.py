"""What is measured on tiles: which were hit in which 50 ms steps, and which could have been."""

from gis_radar.measures.settings import Filters, HitSettings

__all__ = ["Filters", "HitSettings"]
