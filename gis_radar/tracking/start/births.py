"""Birth of tracks: moving detections are stored until several of them agree on a vehicle."""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats, Integers, compiled, heading_difference
from gis_radar.hdmap import FieldArrays, lanes_at
from gis_radar.tracking.columns import (  # fmt: skip
    ALIVE,
    BEGUN,
    BRANCH,
    BRANCHES,
    DETECTION_COUNT,
    FOLLOWED,
    FRONT,
    HALF,
    HEADING,
    LANE,
    LAST_TIME,
    LEFT,
    MISFIT,
    NUMBER,
    PASSED,
    REAR,
    SPEED,
    TIME,
    TOWARDS,
    VAR_D,
    VAR_S,
    VAR_V,
    WAIT_HEADING,
    WAIT_ROW,
    WAIT_SPEED,
    WAIT_TIME,
    WAITS,
    X,
    Y,
)

_FASTEST_MPS = 60.0  # largest speed of a new track, 216 km/h
# Least number of detections within this time whose places and range rates agree that begin a track:
# beyond 150 m a car gives one in half a second, and clutter at most one moving detection a frame.
BIRTHS, BIRTH_S = 3, 1.5
# least cosine between line of sight and lane at which a range rate gives the speed
_LEAST_LANE_COS = 0.3
_CAR_M = 4.6  # first guess of the length of a vehicle: a car


@compiled
def begin(  # pragma: no cover - compiled
    row: int,
    detection: Floats,
    bodies: Floats,
    waiting: Floats,
    counts: Integers,
    members: Integers,
    lanes: Floats,
    field: FieldArrays,
) -> int:
    """Begin a track where stored detections agree with this one, else store it.

    Lists the detections of a new track in `members`, and returns their number; 0 without one.
    """
    kept = 0
    for k in range(counts[WAITS]):
        if detection[6] - waiting[k, WAIT_TIME] <= BIRTH_S:
            waiting[kept] = waiting[k]
            kept += 1
    counts[WAITS] = kept
    lane_count = lanes_at(detection[0], detection[1], field, lanes)
    first = counts[ALIVE]
    for k in range(lane_count):
        cos = np.cos(lanes[k, TOWARDS]) * detection[3] + np.sin(lanes[k, TOWARDS]) * detection[4]
        speed = detection[2] / cos if abs(cos) >= _LEAST_LANE_COS else -1.0
        if not 0.3 <= speed <= _FASTEST_MPS or abs(lanes[k, LEFT]) > lanes[k, HALF] + 0.5:
            continue
        matches, frames = _agreeing(detection, speed, lanes[k, TOWARDS], waiting, counts[WAITS])
        if matches >= BIRTHS and frames >= 2 and counts[ALIVE] < len(bodies):
            body = bodies[counts[ALIVE]]
            body[:] = 0.0
            body[X], body[Y], body[HEADING], body[SPEED] = (
                detection[0],
                detection[1],
                lanes[k, TOWARDS],
                speed,
            )
            body[FRONT] = body[REAR] = 0.5 * _CAR_M
            body[VAR_S], body[VAR_V], body[VAR_D] = 2.0, 1.0, 0.5
            body[LAST_TIME] = body[TIME] = detection[6]
            body[NUMBER], body[DETECTION_COUNT] = counts[BEGUN], matches
            body[FOLLOWED] = lanes[k, LANE]
            body[MISFIT] = (lanes[k, LEFT] / lanes[k, HALF]) ** 2 - matches
            body[BRANCH] = counts[BRANCHES]
            counts[BRANCHES] += 1
            counts[ALIVE] += 1
    if counts[ALIVE] > first:
        counts[BEGUN] += 1
        return _gather(row, detection, bodies[first : counts[ALIVE]], waiting, counts, members)
    for k in range(lane_count):
        cos = np.cos(lanes[k, TOWARDS]) * detection[3] + np.sin(lanes[k, TOWARDS]) * detection[4]
        speed = detection[2] / cos if abs(cos) >= _LEAST_LANE_COS else -1.0
        if 0.3 <= speed <= _FASTEST_MPS and counts[WAITS] < len(waiting):
            wait = waiting[counts[WAITS]]
            wait[X], wait[Y], wait[WAIT_SPEED] = detection[0], detection[1], speed
            wait[WAIT_HEADING], wait[WAIT_TIME] = lanes[k, TOWARDS], detection[6]
            wait[WAIT_ROW] = row + counts[PASSED]
            counts[WAITS] += 1
    return 0


@compiled
def _agreeing(
    detection: Floats, speed: float, heading: float, waiting: Floats, count: int
) -> tuple[int, int]:  # pragma: no cover - compiled
    """Return the numbers of agreeing detections and of their frames, this one included."""
    matches, frames, last_time, counted_row = 1, 1, detection[6], -1.0
    c, s = np.cos(heading), np.sin(heading)
    for j in range(count - 1, -1, -1):
        wait = waiting[j]
        away = abs(heading_difference(wait[WAIT_HEADING], heading)) > 0.5
        if away or abs(wait[WAIT_SPEED] - speed) > 1.0 + 0.08 * speed:
            continue
        dx, dy = detection[0] - wait[X], detection[1] - wait[Y]
        driven = 0.5 * (wait[WAIT_SPEED] + speed) * (detection[6] - wait[WAIT_TIME])
        if abs(dx * c + dy * s - driven) > 3.0 or abs(dy * c - dx * s) > 1.8:
            continue
        if wait[WAIT_ROW] != counted_row:  # a detection is stored once for each lane
            matches += 1
            counted_row = wait[WAIT_ROW]
        if wait[WAIT_TIME] < last_time:
            frames += 1
            last_time = wait[WAIT_TIME]
    return matches, frames


@compiled
def _gather(
    row: int, detection: Floats, new: Floats, waiting: Floats, counts: Integers, members: Integers
) -> int:
    """Move stored detections that agree with a new track to `members`; return their number."""
    members[0], taken, kept = row, 1, 0
    for j in range(counts[WAITS]):
        wait = waiting[j]
        agrees = False
        for k in range(len(new)):
            c, s = np.cos(new[k, HEADING]), np.sin(new[k, HEADING])
            way = new[k, SPEED] * (detection[6] - wait[WAIT_TIME])
            dx, dy = detection[0] - wait[X], detection[1] - wait[Y]
            agrees = agrees or (abs(dx * c + dy * s - way) <= 3.0 and abs(dy * c - dx * s) <= 1.8)
        old_row = int(wait[WAIT_ROW] - counts[PASSED])
        if agrees and old_row >= 0 and taken < len(members):
            members[taken] = old_row
            taken += 1
        elif not agrees:
            waiting[kept] = wait
            kept += 1
    counts[WAITS] = kept
    return taken
