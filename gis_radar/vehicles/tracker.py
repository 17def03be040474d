"""Vehicles in the detections of a span of time: from detections to smoothed motions."""

from __future__ import annotations

import numpy as np

from gis_radar.lanelets.graph import LaneGraph
from gis_radar.vehicles.bodies import (
    absorb,
    is_person,
    join_directions,
    merge_states,
    rows_by_number,
    without_faint_ends,
)
from gis_radar.vehicles.doubles import without_doubles
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.forward import follow_both_ways
from gis_radar.vehicles.lives import with_standing
from gis_radar.vehicles.motion import Motion
from gis_radar.vehicles.settings import VehicleSettings


def vehicles_in(echoes: Echoes, graph: LaneGraph, settings: VehicleSettings) -> list[Motion]:
    """Return the vehicles that detections tell of, each with its motion.

    Parameters
    ----------
    echoes : Echoes
        Of all sensors, in the order of time.
    graph : LaneGraph
        The lanes.
    settings : VehicleSettings
        Of all stages.
    """
    if len(echoes) == 0:
        return []
    numbers, both = follow_both_ways(echoes, graph, settings.forward, settings.echoes.moving_mps)
    joined = join_directions(*numbers, echoes.time)
    states = merge_states(numbers[0], both, joined)
    parts = [rows for rows in rows_by_number(joined) if len(rows) >= settings.bodies.least_rows]
    free = np.abs(echoes.range_rate) < settings.echoes.moving_mps
    followed = absorb(echoes, parts, states, settings)
    motions = [each for each in followed if (~free[each.rows]).sum() >= settings.forward.births]
    persons = is_person(echoes, motions, settings)
    driven = [each for each, person in zip(motions, persons, strict=True) if not person]
    driven = without_faint_ends(echoes, driven, states, settings)
    if not driven:
        return []  # where nothing drives, nothing tells a vehicle that stands from what is built
    for each in motions:
        free[each.rows] = False
    found = with_standing(echoes, graph, driven, states, free, settings)
    return without_doubles(found, echoes, settings)
