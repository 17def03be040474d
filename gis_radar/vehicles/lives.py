"""Whole lives of vehicles: what moves and what stands, joined from arrival to departure.

A vehicle that stops is the one that leaves from there later, unless another one drove over the
place in between. Ends and begins are matched together, at least cost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.bodies import usual_rcs
from gis_radar.vehicles.detectability import Bodies, Detectability
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.motion import Motion, Path, fit_motion
from gis_radar.vehicles.settings import DetectabilitySettings, LifeSettings, VehicleSettings
from gis_radar.vehicles.standing import Stand, find_stands, not_built
from gis_radar.vehicles.strips import NONE, Strips
from gis_radar.vehicles.sweeps import Sweeps
from gis_radar.vehicles.tall import join_tall

END_STEPS = 10  # half a second tells the speed at an end
BESIDE_M = 1.5  # less than the width of two cars: middles are not so near


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
    free, limits = free.copy(), settings.lives
    strips = Strips.of(graph)
    sweeps = Sweeps.of(motions, echoes, strips, settings.standing)
    free = not_built(echoes, free, sweeps, settings.standing)
    seen = Detectability.learned(echoes, motions, settings.detectability)
    motions = [
        _with_still(number, each, echoes, free, states, sweeps, seen, settings)
        for number, each in enumerate(motions)
    ]  # fmt: skip
    seen = replace(seen, bodies=Bodies.of(motions))
    motions = [
        part for number, each in enumerate(motions)
        for part in _at_silences(number, each, echoes, states, seen, settings)
    ]  # fmt: skip
    seen = replace(seen, bodies=Bodies.of(motions))
    stands = find_stands(echoes, free, motions, sweeps, settings.standing)
    stands = join_tall(stands, echoes, settings.tall)
    stands = _as_strong(stands, echoes, motions, limits)
    places = [strips.place(each.strip, 0.5 * (each.rear_m + each.front_m)) for each in stands]
    alone = _distinct(stands, places, motions, limits)
    stands, places = [stands[k] for k in alone], [places[k] for k in alone]
    for each, (place, heading) in zip(stands, places, strict=True):
        states[each.rows, :2], states[each.rows, 2], states[each.rows, 3] = place, heading, 0.0
    parts = [*map(_part_of_motion, motions), *map(_part_of_stand, stands, places)]
    seen = replace(seen, bodies=Bodies.join([seen.bodies, *(
        Bodies.standing(
            len(motions) + number, (each.begin, each.end), *place, each.front_m - each.rear_m
        )
        for number, (each, place) in enumerate(zip(stands, places, strict=True))
    )]))  # fmt: skip
    following = _following(parts, sweeps, seen, settings)
    found = []
    for chain in _chains(following):
        moving = [motions[k] for k in chain if k < len(motions)]
        standing = [k - len(motions) for k in chain if k >= len(motions)]
        if moving:
            rows = [each.rows for each in moving] + [stands[k].rows for k in standing]
            one = moving[0] if len(rows) == 1 else fit_motion(
                echoes, np.concatenate(rows), states, settings.motion
            )  # fmt: skip
            if standing or _drove(one, echoes, limits) or _stood(one, echoes, limits):
                found.append(one)
        elif made := _standing_only(
            [stands[k] for k in standing], places, standing, echoes, limits
        ):
            found.append(made)
    return found


def _drove(motion: Motion, echoes: Echoes, settings: LifeSettings) -> bool:
    """Tell whether a motion has way and moving detections enough to be more than false returns."""
    moving = np.abs(echoes.range_rate[motion.rows]) > settings.moving_mps
    way = float(motion.s_m[-1] - motion.s_m[0])
    return int(moving.sum()) >= settings.least_moving and way > settings.least_way_m


def _stood(motion: Motion, echoes: Echoes, settings: LifeSettings) -> bool:
    """Tell whether a motion has still detections enough, for long enough, to be a vehicle."""
    still = motion.rows[np.abs(echoes.range_rate[motion.rows]) <= settings.moving_mps]
    enough = len(still) >= settings.alone_rows
    return enough and float(np.ptp(echoes.time[still])) >= settings.alone_s


def _with_still(
    number: int, motion: Motion, echoes: Echoes, free: Booleans, states: Floats, sweeps: Sweeps,
    seen: Detectability, settings: VehicleSettings,
) -> Motion:  # fmt: skip
    """Return a motion with the free still detections on it while it stands, which it takes.

    One that comes to rest stands on until it is silent or another drives over its place, and one
    that sets off stood there before.
    """
    limits = settings.lives
    slow = np.flatnonzero(motion.speed < limits.slow_mps)
    place, heading = motion.places
    time = echoes.time[motion.rows]
    s_m, speed = motion.at(time)
    states[motion.rows, :2], states[motion.rows, 2] = motion.path.at(s_m)
    states[motion.rows, 3] = speed
    if len(slow) == 0:
        return motion
    ends = (motion.first_step + slow[[0, -1]]) / STEPS_PER_SECOND
    last = len(motion.speed) - 1
    if slow[0] == 0:
        ends[0] = sweeps.before(place[0], float(ends[0]))
    if slow[-1] == last:
        ends[1] = sweeps.after(place[-1], float(ends[1]))
    low, high = np.searchsorted(echoes.time, ends)
    rows = low + np.flatnonzero(free[low:high])
    half = 0.5 * max(motion.length_m, 4.0) + 0.5
    reach = 3.0 * half + np.ptp(place[slow], axis=0)
    rows = rows[(np.abs(echoes.points[rows] - place[slow].mean(axis=0)) < reach).all(axis=1)]
    step = np.round(echoes.time[rows] * STEPS_PER_SECOND).astype(np.int64) - motion.first_step
    step = np.clip(step, 0, last)
    at_rest = motion.speed[step] < limits.slow_mps
    rows, step = rows[at_rest], step[at_rest]
    if len(rows):
        along, left = motion.path.project(echoes.points[rows], motion.s_m[step], 25.0)
        beside = limits.left_m + settings.motion.azimuth_rad * echoes.range_m[rows]
        on = (np.abs(along - motion.s_m[step]) < half) & (np.abs(left) < beside)
        rows, step = rows[on], step[on]
    span = (float(time[0]), float(time[-1]))
    kept = _unbroken(echoes.time[rows], span, limits.silence_s)
    rows, step = rows[kept], step[kept]
    for at in (0, -1):
        side = echoes.time[rows] > span[1] if at else echoes.time[rows] < span[0]
        if side.any():
            ends = np.sort([span[at], float(echoes.time[rows[side][at]])])
            due = seen.due_between(place[[at, at]], (ends[0], ends[1]), (number, NONE))
            if side.sum() < settings.standing.rate_share * due:
                rows, step = rows[~side], step[~side]
    if len(rows) == 0:
        return motion
    free[rows] = False
    states[rows, :2], states[rows, 2], states[rows, 3] = place[step], heading[step], 0.0
    return fit_motion(echoes, np.concatenate([motion.rows, rows]), states, settings.motion)


def _unbroken(time: Floats, span: tuple[float, float], silence_s: float) -> slice:
    """Return which of ascending times go on from a span, both ways, without a longer silence."""
    early = np.append(time[time < span[0]], span[0])
    late = np.insert(time[time > span[1]], 0, span[1])
    breaks = np.flatnonzero(np.diff(early) > silence_s)
    first = int(breaks[-1]) + 1 if len(breaks) else 0
    breaks = np.flatnonzero(np.diff(late) > silence_s)
    missing = len(late) - 1 - int(breaks[0]) if len(breaks) else 0
    return slice(first, len(time) - missing)


def _at_silences(
    number: int, motion: Motion, echoes: Echoes, states: Floats, seen: Detectability,
    settings: VehicleSettings,
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
    if not cuts:
        return [motion]
    parts = np.split(motion.rows, cuts)
    return [
        fit_motion(echoes, rows, states, settings.motion)
        for rows in parts if len(rows) >= settings.bodies.least_rows
    ]  # fmt: skip


def _as_strong(
    stands: Sequence[Stand], echoes: Echoes, motions: Sequence[Motion], settings: LifeSettings
) -> list[Stand]:
    """Return the stands whose strong returns are not far below what vehicles that drive return."""
    driven = [
        usual_rcs(echoes.rcs[each.rows]) for each in motions
        if np.median(each.speed) > settings.driven_mps
    ]  # fmt: skip
    least = usual_rcs(np.array(driven)) - settings.weaker_db
    return [
        each for each in stands
        if not usual_rcs(echoes.rcs[each.rows], 0.9) < least  # nor where either is unknown
    ]  # fmt: skip


def _inside(
    place: Floats, heading: float, half: float, other: Floats, turned: float, reach: float
) -> float:
    """Return which share of the middle line of one body lies within another, widened."""
    way = np.array([np.cos(heading), np.sin(heading)])
    apart = place + np.linspace(-1.0, 1.0, 9)[:, None] * max(half - 0.3, 0.1) * way - other
    c, s = np.cos(turned), np.sin(turned)
    along, left = apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s
    return float(((np.abs(along) < reach) & (np.abs(left) < 1.2)).mean())


def _distinct(
    stands: Sequence[Stand], places: Sequence[tuple[Floats, float]], motions: Sequence[Motion],
    settings: LifeSettings,
) -> list[int]:  # fmt: skip
    """Return the stands that no better supported one, nor a motion that stands, lies on."""
    begin, end = np.array([x.begin for x in stands]), np.array([x.end for x in stands])
    place = np.array([each for each, _ in places]).reshape(-1, 2)
    half = np.array([0.5 * (x.front_m - x.rear_m) for x in stands])
    weight = np.array([len(x.rows) for x in stands])
    alive = np.ones(len(stands), np.bool_)
    for motion in motions:
        slow = np.flatnonzero(motion.speed < settings.slow_mps)
        if len(slow) < STEPS_PER_SECOND:
            continue
        middle, heading = motion.places
        when = (motion.first_step + slow) / STEPS_PER_SECOND
        for k in np.flatnonzero((begin < when[-1]) & (end > when[0]) & alive).tolist():
            both = slow[(when >= begin[k]) & (when <= end[k])]
            if len(both) < 0.5 * (end[k] - begin[k]) * STEPS_PER_SECOND or len(both) == 0:
                continue
            j, reach = both[len(both) // 2], 0.5 * motion.length_m
            if np.hypot(*(place[k] - middle[j])) > settings.near_m:
                continue
            share = _inside(place[k], places[k][1], half[k], middle[j], heading[j], reach)
            alive[k] = share <= settings.same_share
    for k in np.argsort(-weight, kind="stable").tolist():
        if not alive[k]:
            continue
        near = alive & (np.hypot(*(place - place[k]).T) < settings.near_m) & (weight <= weight[k])
        near &= np.minimum(end, end[k]) - np.maximum(begin, begin[k]) > 0.5 * (end - begin)
        near[k] = False
        for j in np.flatnonzero(near).tolist():
            share = _inside(place[j], places[j][1], half[j], place[k], places[k][1], half[k])
            alive[j] = share <= settings.same_share
    return np.flatnonzero(alive).tolist()


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A part of a life: time, place, heading and speed at its begin and end."""

    time: Floats
    place: Floats
    heading: Floats
    speed: Floats
    stands: bool


def _part_of_motion(motion: Motion) -> _Part:
    place, heading = motion.places
    speeds = [np.median(motion.speed[:END_STEPS]), np.median(motion.speed[-END_STEPS:])]
    steps = np.array([motion.first_step, motion.last_step])
    return _Part(
        time=steps / STEPS_PER_SECOND, place=place[[0, -1]], heading=heading[[0, -1]],
        speed=np.array(speeds), stands=False,
    )  # fmt: skip


def _part_of_stand(stand: Stand, place: tuple[Floats, float]) -> _Part:
    return _Part(
        time=np.array([stand.begin, stand.end]), place=np.stack([place[0]] * 2),
        heading=np.full(2, place[1]), speed=np.zeros(2), stands=True,
    )  # fmt: skip


def _chains(following: Integers) -> list[list[int]]:
    """Return the parts of each life in their order."""
    heads = np.setdiff1d(np.arange(len(following)), following)
    chains = []
    for head in heads.tolist():
        chain = [head]
        while following[chain[-1]] != NONE:
            chain.append(int(following[chain[-1]]))
        chains.append(chain)
    return chains


def _standing_only(
    stands: Sequence[Stand], places: Sequence[tuple[Floats, float]], which: Sequence[int],
    echoes: Echoes, settings: LifeSettings,
) -> Motion | None:  # fmt: skip
    """Return the motion of a vehicle that never moves, if it is seen for long enough."""
    rows = np.sort(np.concatenate([each.rows for each in stands]))
    begin, end = (float(echoes.time[rows[k]]) for k in (0, -1))
    if end - begin < settings.alone_s or len(rows) < settings.alone_rows:
        return None
    first, last = float(echoes.time[0]), float(echoes.time[-1])
    begin = first if begin - first < settings.silence_s else begin
    end = last if last - end < settings.silence_s else end
    best = max(range(len(stands)), key=lambda k: len(stands[k].rows))
    place, heading = places[which[best]]
    way = np.array([np.cos(heading), np.sin(heading)])
    path = Path(place + np.arange(-20.0, 21.0)[:, None] * way)
    step = int(np.floor(begin * STEPS_PER_SECOND))
    count = int(np.ceil(end * STEPS_PER_SECOND)) - step + 1
    along, left = path.project(echoes.points[rows], np.full(len(rows), 20.0), 25.0)
    length = stands[best].front_m - stands[best].rear_m
    heavy = length > 7.0
    return Motion(
        rows=rows, path=path, first_step=step, s_m=np.full(count, 20.0), speed=np.zeros(count),
        var_s=np.full(count, settings.place_m**2), length_m=length,
        width_m=2.5 if heavy else 1.85, length_sigma_m=0.6, p_heavy=float(heavy),
        along_m=along - 20.0, left_m=left,
    )  # fmt: skip


def _following(
    parts: Sequence[_Part], sweeps: Sweeps, seen: Detectability, every: VehicleSettings
) -> Integers:
    """Return the part that follows each, or `NONE`: the assignment of least cost."""
    following, settings = np.full(len(parts), NONE, np.int64), every.lives
    costs = [
        each for a in range(len(parts)) for each in _costs(a, parts, sweeps, settings)
        if not _is_missed(parts, each[0], each[1], seen, every.detectability)
    ]  # fmt: skip
    if not costs:
        return following
    a, b = np.array([each[:2] for each in costs], np.int64).T
    befores, row = np.unique(a, return_inverse=True)
    afters, column = np.unique(b, return_inverse=True)
    matrix = np.full((len(befores), len(afters) + len(befores)), 1e6)
    matrix[row, column] = [each[2] for each in costs]
    own = np.arange(len(befores))
    matrix[own, len(afters) + own] = settings.end_cost
    for i, k in zip(*linear_sum_assignment(matrix), strict=True):
        if k < len(afters) and matrix[i, k] < settings.end_cost:
            following[befores[i]] = afters[k]
    return following


def _is_missed(
    parts: Sequence[_Part], a: int, b: int, seen: Detectability, settings: DetectabilitySettings
) -> bool:
    """Tell whether one that was both parts would have been seen in between."""
    span = (float(parts[a].time[1]), float(parts[b].time[0]))
    if span[1] - span[0] < settings.silent_s:
        return False
    places = np.stack([parts[a].place[1], parts[b].place[0]])
    return seen.due_between(places, span, (a, b)) > settings.most_due


@dataclass(frozen=True, kw_only=True)
class _Ends:
    """Begins of all parts, as seen from the end of one: lapse, along, left, way, turn, speed."""

    lapse: Floats
    along: Floats
    left: Floats
    apart: Floats
    turn: Floats
    speed: Floats
    later: Booleans
    stands: Booleans

    @classmethod
    def of(cls, a: int, parts: Sequence[_Part]) -> _Ends:
        """Take the begins as seen from the end of part `a`."""
        mine = parts[a]
        begin, end = (np.array([each.time[k] for each in parts]) for k in (0, 1))
        gap = np.array([each.place[0] for each in parts]) - mine.place[1]
        heading = float(mine.heading[1])
        c, s = np.cos(heading), np.sin(heading)
        turned = np.array([each.heading[0] for each in parts]) - heading
        later = (begin > mine.time[0]) & (end > mine.time[1]) & (np.arange(len(parts)) != a)
        return cls(
            lapse=begin - mine.time[1], along=gap @ np.array([c, s]),
            left=np.abs(gap @ np.array([-s, c])), apart=np.hypot(*gap.T),
            turn=np.abs(np.angle(np.exp(1j * turned))),
            speed=np.array([each.speed[0] for each in parts]), later=later,
            stands=np.array([each.stands for each in parts]),
        )  # fmt: skip


def _costs(
    a: int, parts: Sequence[_Part], sweeps: Sweeps, settings: LifeSettings
) -> Iterator[tuple[int, int, float]]:
    """Yield (a, b, cost) of the parts b that may follow part a."""
    mine, to = parts[a], _Ends.of(a, parts)
    speed = float(mine.speed[1])
    waits = to.later & (to.lapse > -1.5) & (speed < 5.0) & (to.speed < 5.0)
    waits &= (to.apart < 9.0) & (to.turn < 0.6) & (to.left < 2.0)
    drives = to.later & ~waits & ~to.stands & (to.lapse > -2.0) & (to.lapse < settings.unseen_s)
    gain = to.along - 0.5 * (speed + to.speed) * to.lapse
    drives &= (gain > -3.0) & (to.turn < 1.9) & ((to.lapse >= 0.0) | (gain < 3.0))
    bend = 0.5 * np.maximum(to.along, 0.0) * np.sin(np.minimum(to.turn, 1.5))
    drives &= to.left < 1.2 + bend + 0.12 * np.abs(to.along) + 0.2 * to.apart * (to.turn > 0.5)
    if mine.stands:
        drives[:] = False
    free_until = sweeps.after(mine.place[1], float(mine.time[1])) if waits.any() else np.inf
    for b in np.flatnonzero(waits | drives).tolist():
        cost = np.inf
        if drives[b]:
            cost = _cost_of_driving(speed, to, b)
        if waits[b] and mine.time[1] + to.lapse[b] < free_until + 0.5:
            creep = (speed**2 + to.speed[b] ** 2) / 6.0  # braking and starting at 3 m/s2
            off = max(abs(to.along[b] - creep) - 1.0, 0.0) / 1.5
            cost = min(cost, off**2 + 0.5 + settings.wait_cost * max(to.lapse[b], 0.05))
        cost += (to.left[b] / (1.0 + 0.1 * to.apart[b])) ** 2 + 0.5 * (to.turn[b] / 0.6) ** 2
        if cost < settings.end_cost:
            yield a, b, float(cost)


def _cost_of_driving(speed: float, to: _Ends, b: int) -> float:
    """Return what it costs to be one that drove on unseen: by its mean speed between two others."""
    lapse = max(float(to.lapse[b]), 0.05)
    mean, middle = to.apart[b] * np.sign(to.along[b]) / lapse, 0.5 * (speed + to.speed[b])
    slowest = max(min(speed, to.speed[b]) - 1.2 * lapse, 0.0) if lapse < 3.0 else 0.0
    low = min(slowest, max(middle - 0.6 * lapse, 0.0))
    high = max(speed, to.speed[b]) + 0.5 * lapse
    miss = max(low - mean, mean - high, 0.0) / (0.5 + 1.0 / lapse)
    if miss >= 3.0:
        return np.inf
    likely = 0.5 * ((mean - middle) / (0.7 * lapse + 1.0 + 1.0 / lapse)) ** 2
    return float(miss**2 + likely + 0.15 * np.sqrt(lapse) + 0.03 * to.apart[b])


def without_doubles(motions: Sequence[Motion], settings: LifeSettings) -> list[Motion]:
    """Return the motions but those that lie on a better supported one for most of their lives.

    Two vehicles are never in one place; one that two sensors see, or whose ends are seen apart, may
    be followed twice.
    """
    order = sorted(range(len(motions)), key=lambda k: -len(motions[k].rows))
    samples = [_samples(each) for each in motions]
    steps = [set(each[0].tolist()) for each in samples]
    boxes = [np.stack([each[1].min(axis=0), each[1].max(axis=0)]) for each in samples]
    kept: list[int] = []
    for k in order:
        lies = 0.0
        for other in kept:
            apart = np.maximum(boxes[k][0] - boxes[other][1], boxes[other][0] - boxes[k][1])
            if (apart > settings.near_m).any() or steps[k].isdisjoint(steps[other]):
                continue
            lies += _share_on(motions[k], samples[k], motions[other], samples[other])
        if lies < settings.double_share:
            kept.append(k)
    return [motions[k] for k in sorted(kept)]


def _samples(motion: Motion) -> tuple[Integers, Floats, Floats]:
    """Return (half second, place, heading) of a motion, twice a second."""
    place, heading = motion.places
    half = STEPS_PER_SECOND // 2
    every = np.arange(-motion.first_step % half, len(heading), half)
    if len(every) == 0:
        every = np.zeros(1, np.int64)
    return (motion.first_step + every) // half, place[every], heading[every]


def _share_on(
    motion: Motion, mine: tuple[Integers, Floats, Floats],
    other: Motion, others: tuple[Integers, Floats, Floats],
) -> float:  # fmt: skip
    """Return for which share of its life the middle of a vehicle lies on another one."""
    _, own, theirs = np.intersect1d(mine[0], others[0], return_indices=True)
    apart = mine[1][own] - others[1][theirs]
    c, s = np.cos(others[2][theirs]), np.sin(others[2][theirs])
    along, left = apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s
    reach = 0.5 * other.length_m + 0.25 * motion.length_m
    on = (np.abs(along) < reach) & (np.abs(left) < BESIDE_M)
    return float(on.sum() / len(mine[0]))
