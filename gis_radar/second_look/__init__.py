"""Compare what stands around a sensor with an airborne scan: a second look at a pose."""

from gis_radar.second_look.second_look import SecondLook, require_scans_near, second_look
from gis_radar.second_look.settings import SecondLookSettings

__all__ = ["SecondLook", "SecondLookSettings", "require_scans_near", "second_look"]
