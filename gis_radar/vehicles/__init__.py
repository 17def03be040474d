"""Vehicles: their tracks, and which tiles they cover in which steps."""

from gis_radar.vehicles.folder import Vehicles, read_vehicles

__all__ = ["Vehicles", "read_vehicles"]
