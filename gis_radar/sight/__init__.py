"""Sight: which tiles a sensor sees from one pose, and what hides the others."""

from gis_radar.sight.gaps import Gap, find_gaps, gap_warning
from gis_radar.sight.layers import SightFile, open_sight, write_sights
from gis_radar.sight.recorded import (
    Contradiction,
    MovementCounter,
    MovingHits,
    find_contradictions,
    report_contradictions,
)
from gis_radar.sight.settings import SightSettings
from gis_radar.sight.sight import (
    HIDDEN,
    IN_SIGHT,
    OUT_OF_VIEW,
    VIEW_ONLY,
    Sight,
    SightScan,
    SightSource,
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
    "Contradiction",
    "Gap",
    "MovementCounter",
    "MovingHits",
    "Sight",
    "SightFile",
    "SightScan",
    "SightSettings",
    "SightSource",
    "SightTiles",
    "describe_sight",
    "find_contradictions",
    "find_gaps",
    "find_sight",
    "gap_warning",
    "open_sight",
    "report_contradictions",
    "report_uncovered",
    "write_sights",
]
