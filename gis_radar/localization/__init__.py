"""Localization: the pose of a radar from what it saw, with its evidence."""

from gis_radar.localization.localize import localize, localize_files
from gis_radar.localization.result import AmbiguousError, Localization
from gis_radar.localization.together import Together, localize_together

__all__ = [
    "AmbiguousError",
    "Localization",
    "Together",
    "localize",
    "localize_files",
    "localize_together",
]
