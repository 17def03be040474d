"""Localization: the pose of a radar from what it saw, with its evidence."""

from gis_radar.localization.answer import Localization
from gis_radar.localization.product import localize

__all__ = ["Localization", "localize"]
