"""Tracker: find the vehicles in the detections of a span of time, as smoothed motions.

First tracks come from a forward filter and track management; the posterior corrects them.
"""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats, Integers
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.detections import MOVING_MPS, MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior import improve
from gis_radar.tracking.start.births import BIRTHS
from gis_radar.tracking.start.bodies import (
    LEAST_ROWS,
    absorb,
    is_person,
    join_directions,
    merge_states,
    rows_by_number,
    without_faint_ends,
)
from gis_radar.tracking.start.forward import follow_both_ways
from gis_radar.tracking.start.track_management import complete_tracks


def vehicles_in(detections: MapDetections, graph: LaneGraph) -> list[Motion]:
    """Find the vehicles in some detections; return their motions.

    Parameters
    ----------
    detections : MapDetections
        Detections of all sensors, in the order of time.
    graph : LaneGraph
        The lanes.
    """
    if len(detections) == 0:
        return []
    improved = improve(_started(detections, graph), detections, graph)
    persons = is_person(detections, improved)
    return [each for each, person in zip(improved, persons, strict=True) if not person]


def _started(detections: MapDetections, graph: LaneGraph) -> list[Motion]:
    """Return first tracks: the filter's, completed by the time at rest."""
    joined, states = _tracks(detections, graph)
    parts = [rows for rows in rows_by_number(joined) if len(rows) >= LEAST_ROWS]
    unassigned = np.abs(detections.range_rate) < MOVING_MPS
    moving = absorb(detections, parts, states)
    motions = [each for each in moving if (~unassigned[each.rows]).sum() >= BIRTHS]
    persons = is_person(detections, motions)
    driven = [each for each, person in zip(motions, persons, strict=True) if not person]
    driven = without_faint_ends(detections, driven, states)
    if not driven:
        return []  # without driving vehicles, stationary ones look like fixed objects
    for each in motions:
        unassigned[each.rows] = False
    return complete_tracks(detections, graph, driven, states, unassigned)


def _tracks(detections: MapDetections, graph: LaneGraph) -> tuple[Integers, Floats]:
    """Return the number of each detection's track and its state, from both directions of time."""
    numbers, both = follow_both_ways(detections, graph)
    joined = join_directions(*numbers, detections.time)
    return joined, merge_states(numbers[0], both, joined)
