"""Occupancy: which tiles were hit in which 50 ms steps, and which could have been."""

from gis_radar.occupancy.folder import Occupancy, merge_occupancies, read_occupancy
from gis_radar.occupancy.measure import measure_occupancy
from gis_radar.occupancy.settings import Filters, OccupancySettings

__all__ = [
    "Filters",
    "Occupancy",
    "OccupancySettings",
    "measure_occupancy",
    "merge_occupancies",
    "read_occupancy",
]
