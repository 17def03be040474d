"""Localization: the pose of a radar from what it saw, with its evidence."""

from gis_radar.localization.answer import Localization
from gis_radar.localization.picture import draw_localization
from gis_radar.localization.product import localize

__all__ = ["Localization", "draw_localization", "localize"]
