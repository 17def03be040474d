"""Surroundings: what stands around a sensor, against an airborne scan; a second look at a pose."""

from gis_radar.surroundings.picture import draw_second_look, draw_surroundings
from gis_radar.surroundings.product import SecondLook, require_scans_near, second_look

__all__ = [
    "SecondLook",
    "draw_second_look",
    "draw_surroundings",
    "require_scans_near",
    "second_look",
]
