"""Whole lives of vehicles: what moves and what stands, joined from arrival to departure.

A vehicle that stops is the one that leaves from there later, unless another one drove over the
place in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.bodies import usual_rcs
from gis_radar.vehicles.columns import NONE
from gis_radar.vehicles.detectability import Detectability, Occluders
from gis_radar.vehicles.doubles import distinct_stands, join_tall
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.links import Part, chains
from gis_radar.vehicles.motion import Motion, fit_motion
from gis_radar.vehicles.paths import Path
from gis_radar.vehicles.resting import with_rest
from gis_radar.vehicles.settings import VehicleSettings
from gis_radar.vehicles.standing import Stand, find_stands, not_built
from gis_radar.vehicles.strips import Strips
from gis_radar.vehicles.sweeps import Sweeps


def with_standing(
    echoes: Echoes, graph: LaneGraph, motions: Sequence[Motion], states: Floats, free: Booleans,
    settings: VehicleSettings,
) -> list[Motion]:  # fmt: skip
    """Return the motions of all vehicles, with the time in which they stand.

    Parameters
    ----------
    echoes : Echoes
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
    sweeps = Sweeps.of(motions, echoes, strips, settings.standing)
    free = not_built(echoes, free, sweeps, settings.standing)
    seen = Detectability.learned(echoes, motions, settings.detectability)
    motions = [
        part for each in motions
        for part in _at_drives(each, echoes, states, free, sweeps, settings)
    ]  # fmt: skip
    seen = replace(seen, occluders=Occluders.of(motions))  # numbered as the parts now
    motions = [
        with_rest(number, each, echoes, free, states, sweeps, seen, settings)
        for number, each in enumerate(motions)
    ]  # fmt: skip
    seen = replace(seen, occluders=Occluders.of(motions))
    motions = [
        part for number, each in enumerate(motions)
        for part in _at_silences(number, each, echoes, states, free, seen, settings)
    ]  # fmt: skip
    stands = find_stands(echoes, free, motions, sweeps, settings.standing)
    stands = join_tall(stands, echoes, settings.tall)
    stands = _as_strong(stands, echoes, motions, settings)
    places = [strips.place(each.strip, 0.5 * (each.rear_m + each.front_m)) for each in stands]
    alone = distinct_stands(stands, places, motions, settings.lives)
    stands, places = [stands[k] for k in alone], [places[k] for k in alone]
    hides = [Occluders.of(motions)]
    for number, (each, (place, heading)) in enumerate(zip(stands, places, strict=True)):
        states[each.rows, :2], states[each.rows, 2], states[each.rows, 3] = place, heading, 0.0
        body = (*place, heading, each.front_m - each.rear_m)
        hides.append(Occluders.standing(len(motions) + number, (each.begin, each.end), *body))
    seen = replace(seen, occluders=Occluders.join(hides))
    parts = [*map(Part.of_motion, motions), *map(Part.of_stand, stands, places)]
    lives = (
        _life(chain, motions, stands, places, echoes, states, settings)
        for chain in chains(parts, sweeps, seen, settings)
    )
    return [each for each in lives if each is not None]


def _life(
    chain: Sequence[int], motions: Sequence[Motion], stands: Sequence[Stand],
    places: Sequence[tuple[Floats, float]], echoes: Echoes, states: Floats,
    settings: VehicleSettings,
) -> Motion | None:  # fmt: skip
    """Return the motion over a chain of motions and stands, if it is more than false returns."""
    moving = [motions[k] for k in chain if k < len(motions)]
    standing = [k - len(motions) for k in chain if k >= len(motions)]
    if not moving:
        each = max(standing, key=lambda k: len(stands[k].rows))
        rows = np.sort(np.concatenate([stands[k].rows for k in standing]))
        return _standing_only(stands[each], places[each], rows, echoes, settings)
    one = moving[0]
    if len(chain) > 1:
        parts = [each.rows for each in moving] + [stands[k].rows for k in standing]
        one = fit_motion(echoes, np.concatenate(parts), states, settings.motion)
    known = standing or _drove(one, echoes, settings) or _stood(one, echoes, settings)
    return one if known else None


def _drove(motion: Motion, echoes: Echoes, settings: VehicleSettings) -> bool:
    """Tell whether a motion has way and moving detections enough to be more than false returns."""
    moving = np.abs(echoes.range_rate[motion.rows]) > settings.echoes.moving_mps
    way = float(motion.s_m[-1] - motion.s_m[0])
    return int(moving.sum()) >= settings.lives.least_moving and way > settings.lives.least_way_m


def _stood(motion: Motion, echoes: Echoes, settings: VehicleSettings) -> bool:
    """Tell whether a motion has still detections enough, for long enough, to be a vehicle."""
    still = motion.rows[np.abs(echoes.range_rate[motion.rows]) <= settings.echoes.moving_mps]
    enough = len(still) >= settings.lives.alone_rows
    return enough and float(np.ptp(echoes.time[still])) >= settings.lives.alone_s


def _at_silences(
    number: int, motion: Motion, echoes: Echoes, states: Floats, free: Booleans,
    seen: Detectability, settings: VehicleSettings,
) -> list[Motion]:  # fmt: skip
    """Return a motion, cut where it is silent although it would be in plain view."""
    limits, time = settings.detectability, echoes.time[motion.rows]
    cuts = []
    for k in np.flatnonzero(np.diff(time) > limits.silent_s).tolist():
        s_m, _ = motion.at(time[k : k + 2])
        places, _ = motion.path.at(s_m)
        span = (float(time[k]), float(time[k + 1]))
        ways = (places, places[[0, 0]], places[[1, 1]])
        due = min(seen.due_between(each, span, (number, NONE)) for each in ways)
        if due > limits.most_due:
            cuts.append(k + 1)
    return _parts(motion, cuts, echoes, states, free, settings)


def _at_drives(
    motion: Motion, echoes: Echoes, states: Floats, free: Booleans, sweeps: Sweeps,
    settings: VehicleSettings,
) -> list[Motion]:  # fmt: skip
    """Return a motion, cut where it was silent and others drove over its place.

    So is one that was silent for long and is elsewhere then: links join it, if it is one.
    """
    time = echoes.time[motion.rows]
    cuts = []
    for k in np.flatnonzero(np.diff(time) > settings.detectability.silent_s).tolist():
        s_m, _ = motion.at(time[k : k + 2])
        places, _ = motion.path.at(s_m)
        stayed = np.ptp(s_m) < settings.lives.away_m
        if stayed:
            lost = sweeps.after(places[0], float(time[k])) < time[k + 1] - settings.lives.apart_s
        else:
            lost = time[k + 1] - time[k] > settings.standing.silence_s
        if lost:
            cuts.append(k + 1)
    return _parts(motion, cuts, echoes, states, free, settings)


def _parts(
    motion: Motion, cuts: list[int], echoes: Echoes, states: Floats, free: Booleans,
    settings: VehicleSettings,
) -> list[Motion]:  # fmt: skip
    """Return a motion cut in parts; still detections of those that are too small become free."""
    if not cuts:
        return [motion]
    parts = []
    for rows in np.split(motion.rows, cuts):
        if len(rows) >= settings.bodies.least_rows:
            parts.append(fit_motion(echoes, rows, states, settings.motion))
        else:
            free[rows] = np.abs(echoes.range_rate[rows]) < settings.echoes.moving_mps
    return parts


def _as_strong(
    stands: Sequence[Stand], echoes: Echoes, motions: Sequence[Motion], settings: VehicleSettings
) -> list[Stand]:
    """Return the stands whose strong returns are not far below what vehicles that drive return.

    Where nobody drives, what stands returns about as much.
    """
    driven = [
        usual_rcs(echoes.rcs[each.rows]) for each in motions
        if np.median(each.speed) > settings.bodies.driven_mps
    ]  # fmt: skip
    still = np.abs(echoes.range_rate) < settings.echoes.moving_mps
    usual = usual_rcs(np.array(driven)) if driven else usual_rcs(echoes.rcs[still])
    least = usual - settings.lives.weaker_db
    return [
        each for each in stands
        if not usual_rcs(echoes.rcs[each.rows], 0.9) < least  # nor where either is unknown
    ]  # fmt: skip


def _standing_only(
    stand: Stand, place: tuple[Floats, float], rows: Integers, echoes: Echoes,
    settings: VehicleSettings,
) -> Motion | None:  # fmt: skip
    """Return the motion of a vehicle that never moves, if it is seen for long enough."""
    limits, silence_s = settings.lives, settings.standing.silence_s
    begin, end = (float(echoes.time[rows[k]]) for k in (0, -1))
    if end - begin < limits.alone_s or len(rows) < limits.alone_rows:
        return None
    first, last = float(echoes.time[0]), float(echoes.time[-1])
    begin = first if begin - first < silence_s else begin
    end = last if last - end < silence_s else end
    middle, heading = place
    way = np.array([np.cos(heading), np.sin(heading)])
    path = Path(middle + np.arange(-20.0, 21.0)[:, None] * way)
    step = int(np.floor(begin * STEPS_PER_SECOND))
    count = int(np.ceil(end * STEPS_PER_SECOND)) - step + 1
    along, left = path.project(echoes.points[rows], np.full(len(rows), 20.0), 25.0)
    length = stand.front_m - stand.rear_m
    heavy = length > 7.0
    return Motion(
        rows=rows, path=path, first_step=step, s_m=np.full(count, 20.0), speed=np.zeros(count),
        var_s=np.full(count, limits.place_m**2), length_m=length,
        width_m=2.5 if heavy else 1.85, length_sigma_m=0.6, p_heavy=float(heavy),
        along_m=along - 20.0, left_m=left,
    )  # fmt: skip
