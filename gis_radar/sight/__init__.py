"""Sight: which tiles a sensor sees from one pose, and what hides the others."""

from gis_radar.sight.layers import write_sights
from gis_radar.sight.settings import SightSettings
from gis_radar.sight.sight import (
    HIDDEN,
    IN_SIGHT,
    OUT_OF_VIEW,
    VIEW_ONLY,
    Sight,
    SightScan,
    SightTiles,
    describe_sight,
    find_sight,
    report_uncovered,
)

__all__ = [
    "HIDDEN",
    "IN_SIGHT",
    "OUT_OF_VIEW",
    "VIEW_ONLY",
    "Sight",
    "SightScan",
    "SightSettings",
    "SightTiles",
    "describe_sight",
    "find_sight",
    "report_uncovered",
    "write_sights",
]
