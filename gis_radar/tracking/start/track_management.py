"""Complete tracks of vehicles: moving and stationary parts joined from arrival to departure.

A vehicle that stops at a place and one that leaves it later are one, unless another one drove over
the place in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.detections import MOVING_MPS, MapDetections
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.paths import Path
from gis_radar.tracking.size import LONG_M, width_of
from gis_radar.tracking.start.bodies import LEAST_ROWS
from gis_radar.tracking.start.detectability import SILENT_S, Detectability, Occluders
from gis_radar.tracking.start.links import Part, chains
from gis_radar.tracking.start.passes import Passes
from gis_radar.tracking.start.resting import AWAY_M, with_rest
from gis_radar.tracking.start.stationary import (
    SILENCE_S,
    StationaryTarget,
    find_stationary,
    without_fixed,
)
from gis_radar.tracking.start.strips import Strips

_APART_S = 1.0  # least time between two vehicles at one place
# Least number of moving detections and least distance of a vehicle; with less, a track is false.
_LEAST_MOVING, _LEAST_WAY_M = 6, 4.0
_ALONE_S, _ALONE_ROWS = 3.0, 10  # least duration and detections of a vehicle that only stands
_PLACE_M = 0.5  # sigma of the place of a stationary vehicle


def complete_tracks(
    detections: MapDetections,
    graph: LaneGraph,
    motions: Sequence[Motion],
    states: Floats,
    free: Booleans,
) -> list[Motion]:
    """Return the motions of all vehicles, including the time at rest.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    graph : LaneGraph
        The lanes.
    motions : sequence of Motion
        Motions of vehicles while they move.
    states : (n, 6) array
        State of the filter at each detection of a vehicle.
    free : (n,) bool array
        Which detections are still, and of no moving vehicle.
    """
    states = states.copy()
    strips = Strips.of(graph)
    passes = Passes.of(motions, detections, strips)
    free = without_fixed(detections, free, passes)
    detectability = Detectability.learned(detections, motions)
    motions = [
        part for each in motions
        for part in split_at_drives(each, detections, states, free, passes)
    ]  # fmt: skip
    # the owners of occluders are numbers of the parts now
    detectability = replace(detectability, occluders=Occluders.of(motions))
    motions = [
        with_rest(number, each, detections, free, states, passes, detectability)
        for number, each in enumerate(motions)
    ]  # fmt: skip
    targets = find_stationary(detections, free, motions, passes)
    places = [strips.place(each.strip, 0.5 * (each.rear_m + each.front_m)) for each in targets]
    occluders = [Occluders.of(motions)]
    for number, (each, (place, heading)) in enumerate(zip(targets, places, strict=True)):
        states[each.rows, :2], states[each.rows, 2], states[each.rows, 3] = place, heading, 0.0
        body = (*place, heading, each.front_m - each.rear_m)
        occluders.append(Occluders.stationary(len(motions) + number, (each.begin, each.end), *body))
    detectability = replace(detectability, occluders=Occluders.join(occluders))
    parts = [*map(Part.of_motion, motions), *map(Part.of_target, targets, places)]
    tracks = (
        _track(chain, motions, targets, places, detections, states)
        for chain in chains(parts, passes, detectability)
    )
    return [each for each in tracks if each is not None]


def _track(
    chain: Sequence[int], motions: Sequence[Motion], targets: Sequence[StationaryTarget],
    places: Sequence[tuple[Floats, float]], detections: MapDetections, states: Floats,
) -> Motion | None:  # fmt: skip
    """Return the motion of a chain of motions and targets, None if it is a false track."""
    moving = [motions[k] for k in chain if k < len(motions)]
    stationary = [k - len(motions) for k in chain if k >= len(motions)]
    if not moving:
        each = max(stationary, key=lambda k: len(targets[k].rows))
        rows = np.sort(np.concatenate([targets[k].rows for k in stationary]))
        return _stationary_only(targets[each], places[each], rows, detections)
    one = moving[0]
    if len(chain) > 1:
        parts = [each.rows for each in moving] + [targets[k].rows for k in stationary]
        one = fit_motion(detections, np.concatenate(parts), states)
    known = stationary or _drove(one, detections) or _stood(one, detections)
    return one if known else None


def _drove(motion: Motion, detections: MapDetections) -> bool:
    """Return whether a motion has enough moving detections and distance to be of a vehicle."""
    moving = np.abs(detections.range_rate[motion.rows]) > MOVING_MPS
    way = float(motion.s_m[-1] - motion.s_m[0])
    return int(moving.sum()) >= _LEAST_MOVING and way > _LEAST_WAY_M


def _stood(motion: Motion, detections: MapDetections) -> bool:
    """Return whether a motion has enough still detections, for long enough, to be of a vehicle."""
    still = motion.rows[np.abs(detections.range_rate[motion.rows]) <= MOVING_MPS]
    enough = len(still) >= _ALONE_ROWS
    return enough and float(np.ptp(detections.time[still])) >= _ALONE_S


def split_at_drives(
    motion: Motion, detections: MapDetections, states: Floats, free: Booleans, passes: Passes
) -> list[Motion]:
    """Split a motion at gaps between detections in which another vehicle drove over its place.

    A motion that is elsewhere after a long gap is split, too: links may join its parts again.

    Parameters
    ----------
    motion : Motion
        A motion with the rows of its detections, by time.
    detections : MapDetections
        Detections of all sensors.
    states : (n, k) array
        States of the filter, a row for each detection.
    free : (n,) array of bool
        Which detections are of no vehicle.
    passes : Passes
        Times at which vehicles drove over places.

    Returns
    -------
    list of Motion
        The parts by time; the motion alone if nothing splits it.
    """
    time = detections.time[motion.rows]
    cuts = []
    for k in np.flatnonzero(np.diff(time) > SILENT_S).tolist():
        s_m, _ = motion.at(time[k : k + 2])
        places, _ = motion.path.at(s_m)
        stayed = np.ptp(s_m) < AWAY_M
        if stayed:
            lost = passes.after(places[0], float(time[k])) < time[k + 1] - _APART_S
        else:
            lost = time[k + 1] - time[k] > SILENCE_S
        if lost:
            cuts.append(k + 1)
    return _parts(motion, cuts, detections, states, free)


def _parts(
    motion: Motion, cuts: list[int], detections: MapDetections, states: Floats, free: Booleans
) -> list[Motion]:
    """Split a motion before some rows; still detections of too small parts become unassigned."""
    if not cuts:
        return [motion]
    parts = []
    for rows in np.split(motion.rows, cuts):
        if len(rows) >= LEAST_ROWS:
            parts.append(fit_motion(detections, rows, states))
        else:
            free[rows] = np.abs(detections.range_rate[rows]) < MOVING_MPS
    return parts


def _stationary_only(
    target: StationaryTarget,
    place: tuple[Floats, float],
    rows: Integers,
    detections: MapDetections,
) -> Motion | None:
    """Return the motion of a vehicle that only stands, None if it is detected too briefly."""
    begin, end = (float(detections.time[rows[k]]) for k in (0, -1))
    if end - begin < _ALONE_S or len(rows) < _ALONE_ROWS:
        return None
    first, last = float(detections.time[0]), float(detections.time[-1])
    begin = first if begin - first < SILENCE_S else begin
    end = last if last - end < SILENCE_S else end
    middle, heading = place
    way = np.array([np.cos(heading), np.sin(heading)])
    path = Path(middle + np.arange(-20.0, 21.0)[:, None] * way)
    step = int(np.floor(begin * STEPS_PER_SECOND))
    count = int(np.ceil(end * STEPS_PER_SECOND)) - step + 1
    along, left = path.project(detections.points[rows], np.full(len(rows), 20.0), 25.0)
    length = target.front_m - target.rear_m
    heavy = length > LONG_M
    return Motion(
        rows=rows, path=path, first_step=step, s_m=np.full(count, 20.0), speed=np.zeros(count),
        var_s=np.full(count, _PLACE_M**2), length_m=length,
        width_m=width_of(length), length_sigma_m=0.6, p_heavy=float(heavy),
        along_m=along - 20.0, left_m=left,
    )  # fmt: skip
