"""Complete tracks of vehicles: what moves and what stands, joined from arrival to departure.

A vehicle that stops is taken for the one that leaves later, unless another one drove over the
place in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.detectability import Detectability, Occluders
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.links import Part, chains
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.passes import Passes
from gis_radar.tracking.paths import Path
from gis_radar.tracking.resting import with_rest
from gis_radar.tracking.settings import VehicleSettings
from gis_radar.tracking.size import LONG_M, width_of
from gis_radar.tracking.stationary import StationaryTarget, find_stationary, not_built
from gis_radar.tracking.strips import Strips


def complete_tracks(
    detections: MapDetections,
    graph: LaneGraph,
    motions: Sequence[Motion],
    states: Floats,
    free: Booleans,
    settings: VehicleSettings,
) -> list[Motion]:
    """Return the motions of all vehicles, including the time at rest.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    graph : LaneGraph
        The lanes.
    motions : sequence of Motion
        Vehicles while they move.
    states : (n, 6) array
        Of the vehicle, for every detection of one.
    free : (n,) bool array
        Which detections are still, and of no moving vehicle.
    settings : VehicleSettings
        Of all stages.
    """
    states = states.copy()
    strips = Strips.of(graph)
    passes = Passes.of(motions, detections, strips, settings.stationary)
    free = not_built(detections, free, passes, settings.stationary)
    seen = Detectability.learned(detections, motions, settings.detectability)
    motions = [
        part for each in motions
        for part in split_at_drives(each, detections, states, free, passes, settings)
    ]  # fmt: skip
    seen = replace(seen, occluders=Occluders.of(motions))  # numbered as the parts now
    motions = [
        with_rest(number, each, detections, free, states, passes, seen, settings)
        for number, each in enumerate(motions)
    ]  # fmt: skip
    targets = find_stationary(detections, free, motions, passes, settings.stationary)
    places = [strips.place(each.strip, 0.5 * (each.rear_m + each.front_m)) for each in targets]
    hides = [Occluders.of(motions)]
    for number, (each, (place, heading)) in enumerate(zip(targets, places, strict=True)):
        states[each.rows, :2], states[each.rows, 2], states[each.rows, 3] = place, heading, 0.0
        body = (*place, heading, each.front_m - each.rear_m)
        hides.append(Occluders.stationary(len(motions) + number, (each.begin, each.end), *body))
    seen = replace(seen, occluders=Occluders.join(hides))
    parts = [*map(Part.of_motion, motions), *map(Part.of_target, targets, places)]
    tracks = (
        _track(chain, motions, targets, places, detections, states, settings)
        for chain in chains(parts, passes, seen, settings)
    )
    return [each for each in tracks if each is not None]


def _track(
    chain: Sequence[int], motions: Sequence[Motion], targets: Sequence[StationaryTarget],
    places: Sequence[tuple[Floats, float]], detections: MapDetections, states: Floats,
    settings: VehicleSettings,
) -> Motion | None:  # fmt: skip
    """Return the motion over a chain of motions and targets, None where it is false detections."""
    moving = [motions[k] for k in chain if k < len(motions)]
    stationary = [k - len(motions) for k in chain if k >= len(motions)]
    if not moving:
        each = max(stationary, key=lambda k: len(targets[k].rows))
        rows = np.sort(np.concatenate([targets[k].rows for k in stationary]))
        return _stationary_only(targets[each], places[each], rows, detections, settings)
    one = moving[0]
    if len(chain) > 1:
        parts = [each.rows for each in moving] + [targets[k].rows for k in stationary]
        one = fit_motion(detections, np.concatenate(parts), states, settings.motion)
    known = stationary or _drove(one, detections, settings) or _stood(one, detections, settings)
    return one if known else None


def _drove(motion: Motion, detections: MapDetections, settings: VehicleSettings) -> bool:
    """Return whether a motion has enough distance and moving detections not to be false."""
    moving = np.abs(detections.range_rate[motion.rows]) > settings.detections.moving_mps
    way = float(motion.s_m[-1] - motion.s_m[0])
    return (
        int(moving.sum()) >= settings.management.least_moving
        and way > settings.management.least_way_m
    )


def _stood(motion: Motion, detections: MapDetections, settings: VehicleSettings) -> bool:
    """Return whether a motion has enough still detections, for long enough, to be a vehicle."""
    still = motion.rows[
        np.abs(detections.range_rate[motion.rows]) <= settings.detections.moving_mps
    ]
    enough = len(still) >= settings.management.alone_rows
    return enough and float(np.ptp(detections.time[still])) >= settings.management.alone_s


def split_at_drives(
    motion: Motion, detections: MapDetections, states: Floats, free: Booleans, passes: Passes,
    settings: VehicleSettings,
) -> list[Motion]:  # fmt: skip
    """Split a motion at gaps in which others drove over its place.

    A motion that is elsewhere after a long gap is split, too: links may join it again.

    Parameters
    ----------
    motion : Motion
        With the rows of its detections, by time.
    detections : MapDetections
        Of all sensors.
    states : (n, k) array
        Of the filter, a row per detection.
    free : (n,) array of bool
        Which detections no vehicle has.
    passes : Passes
        When others drove over a place.
    settings : VehicleSettings
        From which gaps on.

    Returns
    -------
    list of Motion
        The parts by time; the motion alone where nothing splits it.
    """
    time = detections.time[motion.rows]
    cuts = []
    for k in np.flatnonzero(np.diff(time) > settings.detectability.silent_s).tolist():
        s_m, _ = motion.at(time[k : k + 2])
        places, _ = motion.path.at(s_m)
        stayed = np.ptp(s_m) < settings.management.away_m
        if stayed:
            lost = (
                passes.after(places[0], float(time[k])) < time[k + 1] - settings.management.apart_s
            )
        else:
            lost = time[k + 1] - time[k] > settings.stationary.silence_s
        if lost:
            cuts.append(k + 1)
    return _parts(motion, cuts, detections, states, free, settings)


def _parts(
    motion: Motion, cuts: list[int], detections: MapDetections, states: Floats, free: Booleans,
    settings: VehicleSettings,
) -> list[Motion]:  # fmt: skip
    """Split a motion; still detections of parts that are too small become unassigned."""
    if not cuts:
        return [motion]
    parts = []
    for rows in np.split(motion.rows, cuts):
        if len(rows) >= settings.bodies.least_rows:
            parts.append(fit_motion(detections, rows, states, settings.motion))
        else:
            free[rows] = np.abs(detections.range_rate[rows]) < settings.detections.moving_mps
    return parts


def _stationary_only(
    target: StationaryTarget,
    place: tuple[Floats, float],
    rows: Integers,
    detections: MapDetections,
    settings: VehicleSettings,
) -> Motion | None:
    """Return the motion of a vehicle that never moves, None if it is detected too briefly."""
    limits, silence_s = settings.management, settings.stationary.silence_s
    begin, end = (float(detections.time[rows[k]]) for k in (0, -1))
    if end - begin < limits.alone_s or len(rows) < limits.alone_rows:
        return None
    first, last = float(detections.time[0]), float(detections.time[-1])
    begin = first if begin - first < silence_s else begin
    end = last if last - end < silence_s else end
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
        var_s=np.full(count, limits.place_m**2), length_m=length,
        width_m=width_of(length), length_sigma_m=0.6, p_heavy=float(heavy),
        along_m=along - 20.0, left_m=left,
    )  # fmt: skip
