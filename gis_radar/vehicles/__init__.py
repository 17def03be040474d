"""Vehicles: their tracks, and which tiles they cover in which steps."""

from gis_radar.vehicles.find import find_vehicles
from gis_radar.vehicles.folder import Vehicles, read_vehicles
from gis_radar.vehicles.merging import merge_vehicles

__all__ = ["Vehicles", "find_vehicles", "merge_vehicles", "read_vehicles"]
