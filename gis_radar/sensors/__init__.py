"""Sensors as layers of a map: where they stand, what they see, how well that is known."""

from gis_radar.sensors.layers import SENSORS, UNCERTAINTY, VIEWS, write_sensors

__all__ = ["SENSORS", "UNCERTAINTY", "VIEWS", "write_sensors"]
