"""Interim."""

from __future__ import annotations

from gis_radar.arrays import Floats, Integers
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.motion import Motion
from gis_radar.vehicles.settings import VehicleSettings


def with_standing(
    echoes: Echoes, graph: LaneGraph, motions: list[Motion], states: Floats, free: Integers,  # noqa: ARG001
    settings: VehicleSettings,  # noqa: ARG001
) -> list[Motion]:  # fmt: skip
    """Return motions."""
    return motions
