"""Localization: the pose of a radar from what it saw, with its evidence."""

from gis_radar.localization.localize import localize, localize_files
from gis_radar.localization.result import AmbiguousError, Localization

__all__ = ["AmbiguousError", "Localization", "localize", "localize_files"]
