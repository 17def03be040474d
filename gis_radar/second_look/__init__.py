"""Surroundings: what stands around a sensor, against an airborne scan; a second look at a pose."""

from gis_radar.second_look.second_look import SecondLook, require_scans_near, second_look

__all__ = ["SecondLook", "require_scans_near", "second_look"]
