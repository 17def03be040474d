"""Longer tracks: along the lanes as far as detections support them, then while none is due."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Floats, Integers, compiled
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.paths import Path
from gis_radar.tracking.posterior.background import DRIVES_MPS
from gis_radar.tracking.posterior.cuts import END_MOST
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import BEND_M, WINDOW_S
from gis_radar.tracking.posterior.likelihood import (
    STANDS_MPS,
    Rates,
    Seen,
    densities,
    gain_of,
    kind_and_cell,
)

AHEAD_M, MOST_WAYS, LANES = 120.0, 6, 2  # of ways on: how far, how many, from how many lanes
MOST_TURN = 0.6  # between a vehicle and its lane, radians
METRES_A_RADIAN = 3.0  # a lane so far beside is as unlikely as one turned by a radian
MOST_WINDOWS, BEAM = 40, 6  # half seconds, and hypotheses that are kept
ACCELERATIONS = np.array([-4.0, -2.0, -1.0, 0.0, 1.0, 2.0])  # m/s2
USUAL_MPS2 = 2.0  # acceleration of one standard deviation; it costs half a second each
GIVE_UP, LEAST_GAIN = 12.0, 3.0  # of the log-probability
UNSEEN = 8  # half seconds without a gain, after which nobody is looked for any longer
SAME_M, SAME_MPS = 0.4, 0.9  # hypotheses nearer to each other are one
SPREAD_M2, MOST_SPREAD_M2 = 0.05, 1.0  # variance of the place, a second
UNDETECTED_WINDOWS = 20  # half seconds, after which a place is not visible any longer
TURN_POINTS = 40  # metres ahead, in which a fork shows


def lengthen(posterior: Posterior, graph: LaneGraph) -> list[Motion]:
    """Return the vehicles made longer at both ends; the best supported ones go on first.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; what they gain joins what is there.
    graph : LaneGraph
        The lanes.
    """
    graphs = {1: graph, -1: graph.reversed()}
    found = list(posterior.motions)
    for k in np.argsort([-len(each.rows) for each in found], kind="stable").tolist():
        for way in (1, -1):
            longer = _go_on(posterior, found[k], graphs[way], way)
            if longer is not found[k]:
                begin, end = ((found[k].first_step - 0.5) * STEP_S,
                              (found[k].last_step + 0.5) * STEP_S)  # fmt: skip
                new = (end, math.inf) if way > 0 else (-math.inf, begin)
                posterior.gain(longer, add=True, within=new)
                found[k] = longer
    return found


def with_undetected_ends(
    posterior: Posterior, motions: Sequence[Motion], graph: LaneGraph
) -> list[Motion]:
    """Return the vehicles extended at both ends, while silence there and their speed allow.

    Vehicles do not vanish: far away, behind another one, or where the radar is blind, one is there
    undetected. How many detections are due in a place is learned from all others that are in it or
    would be, if they drove on along their lanes at the speed they had, or stood on.

    Parameters
    ----------
    posterior : Posterior
        What is expected; the longer vehicles are placed in it.
    motions : sequence of Motion
        The vehicles.
    graph : LaneGraph
        The lanes.

    Returns
    -------
    list of Motion
        In the same order; their detections are as before.
    """
    graphs = {1: graph, -1: graph.reversed()}
    longest = [_driven_on(_driven_on(each, graphs[1], 1), graphs[-1], -1) for each in motions]
    posterior.place(longest)
    covered = posterior.covered([(each.first_step, each.last_step) for each in motions])
    time, cost = posterior.silence_by_others()
    step, found = time * STEPS_PER_SECOND, []
    cost[covered] = math.inf
    for k, motion in enumerate(motions):
        rows, mine = posterior.states.rows(k), posterior.given.time[motion.rows] * STEPS_PER_SECOND
        speed = motion.speed[[0, -1]]
        known = 0.5 * speed / USUAL_MPS2 * STEPS_PER_SECOND
        known[speed <= STANDS_MPS] = math.inf
        before, after = (
            _undetected_steps(past, cost[rows], most)
            for past, most in zip(
                (mine.min() - step[rows], step[rows] - mine.max()), known.tolist(), strict=True
            )
        )
        first, last = float(mine.min()) - before, float(mine.max()) + after
        whole = longest[k].between(
            min(motion.first_step, math.floor(first)), max(motion.last_step, math.ceil(last)),
            posterior.given.time,
        )  # fmt: skip
        found.append(whole or motion)
    posterior.place(found)
    return found


def _undetected_steps(past: Floats, cost: Floats, known: float) -> float:
    """Return how many steps past a detection a vehicle is there.

    All the way on where that costs less than an end in plain view; else as far as it does, while
    its place is known: at `USUAL_MPS2` its speed changes by half. Who stands keeps its place.
    """
    order = np.argsort(past, kind="stable")
    order = order[past[order] > 0.0]
    past, total = past[order], np.cumsum(cost[order])
    if len(past) == 0 or total[-1] <= END_MOST:
        return float(past[-1]) if len(past) else 0.0
    undetected = past[(total <= END_MOST) & (past <= known)]
    return float(undetected[-1]) if len(undetected) else 0.0


def _driven_on(motion: Motion, graph: LaneGraph, way: int) -> Motion:
    """Return a motion that goes on at its end (way 1) or its begin (-1), along the lanes there.

    At the speed it has, up to where lanes end; of lanes that fork the straightest is taken. Who
    stands there, but drives before or after, stays.
    """
    middle, heading = motion.places
    at = -1 if way > 0 else 0
    speed = float(motion.speed[at])
    if speed <= STANDS_MPS:
        return _stood_on(motion, way) if motion.speed.max() > DRIVES_MPS else motion
    lines = _ways(graph, middle[at], float(heading[at]) + (0.0 if way > 0 else math.pi))
    lines = [line for line in lines if len(line) > 2]
    if not lines:
        return motion
    line = min(lines, key=_turned)
    far = speed * WINDOW_S * np.arange(UNDETECTED_WINDOWS + 1)
    far = far[far <= Path(line).s_m[-1]]
    if len(far) < 2:
        return motion
    return _longer(motion, line, np.column_stack([far, np.full(len(far), speed)]), way)


def _stood_on(motion: Motion, way: int) -> Motion:
    """Return a motion that stays in its place after its end (way 1) or before its begin (-1)."""
    count = round(UNDETECTED_WINDOWS * WINDOW_S * STEPS_PER_SECOND)
    sides = (0, count) if way > 0 else (count, 0)
    place, spread = (np.pad(each, sides, mode="edge") for each in (motion.s_m, motion.var_s))
    return replace(
        motion, first_step=motion.first_step - sides[0], s_m=place, var_s=spread,
        speed=np.pad(motion.speed, sides),
    )  # fmt: skip


def _turned(line: Floats) -> float:
    """Return by how much a line turns within the way of a few seconds."""
    ahead = np.diff(line[:TURN_POINTS], axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return float(np.abs(heading[-1] - heading[0]))


def _go_on(posterior: Posterior, motion: Motion, graph: LaneGraph, way: int) -> Motion:
    """Return a motion made longer at its end (way 1) or its begin (-1)."""
    middle, heading = motion.places
    at, step = (-1, motion.last_step) if way > 0 else (0, motion.first_step)
    best, longer = LEAST_GAIN, motion
    for line in _ways(graph, middle[at], float(heading[at]) + (0.0 if way > 0 else math.pi)):
        path = Path(line)
        turn = np.append(path.heading, path.heading[-1])
        states = np.zeros((MOST_WINDOWS + 1, 2))
        gain, count = _search(
            line, path.s_m, turn, way, (step + 0.5 * way) * STEP_S, float(motion.speed[at]),
            motion.length_m, motion.width_m, posterior.frames.begin, posterior.frames.time,
            posterior.rates, posterior.seen, posterior.alpha, ACCELERATIONS, states,
        )  # fmt: skip
        if gain > best and count > 0:
            best, longer = gain, _longer(motion, line, states[: count + 1], way)
    return longer


def _ways(graph: LaneGraph, place: Floats, heading: float) -> list[Floats]:
    """Return lines (n, 2) from a place on, along the lanes there and those that follow."""
    lanes = graph.field.lane_rows(place[None])[:, 1:5]  # position, s, d, heading
    turn = np.abs(np.angle(np.exp(1j * (lanes[:, 3] - heading))))
    rank = np.abs(lanes[:, 2]) + METRES_A_RADIAN * turn
    good = np.flatnonzero(turn < MOST_TURN)
    found: list[Floats] = []
    for lane, s_m, d_m, _ in lanes[good[np.argsort(rank[good], kind="stable")][:LANES]].tolist():
        found += [
            _line(graph, chain, s_m, d_m, place)
            for chain in _chains(graph, int(lane), AHEAD_M + s_m)
        ]
    return [line for line in found[:MOST_WAYS] if len(line) > 1]


def _chains(graph: LaneGraph, lane: int, reach_m: float) -> list[list[int]]:
    """Return the chains of lanes from one on that are so long, or end."""
    done: list[list[int]] = []
    waiting = [([lane], float(graph.length_m[lane]))]
    while waiting and len(done) < MOST_WAYS:
        chain, length = waiting.pop(0)
        after = [each for each in graph.successors[chain[-1]].tolist() if each not in chain]
        if length >= reach_m or not after:
            done.append(chain)
        else:
            waiting += [([*chain, each], length + float(graph.length_m[each])) for each in after]
    return done


def _line(graph: LaneGraph, chain: list[int], s_m: float, d_m: float, place: Floats) -> Floats:
    """Return a line along lanes, as far left of their middle as its begin is."""
    parts, begin = [place[None]], s_m + 1.0
    for lane in chain:
        points, heading = graph.place(lane, np.arange(begin, float(graph.length_m[lane]), 1.0))
        parts.append(points + d_m * np.column_stack([-np.sin(heading), np.cos(heading)]))
        begin = max(begin - float(graph.length_m[lane]), 0.5)
    return np.vstack(parts)


@compiled
def _search(  # noqa: PLR0917 - numba takes plain arrays
    line: Floats, s_line: Floats, turn: Floats, way: int, time: float, speed: float,
    length: float, width: float, begin: Integers, frame_time: Floats, rates: Rates, seen: Seen,
    alpha: Floats, accelerations: Floats, states: Floats,
) -> tuple[float, int]:  # fmt: skip
    """Search how a vehicle goes on along a line; return the gain and for how many half seconds.

    Hypotheses are a place on the line and a speed; the best are kept (beam search). `states`
    (windows + 1, 2) is filled with those of the best one.
    """
    beam = np.zeros((MOST_WINDOWS + 1, BEAM, 4))  # place, speed, gain, from which it comes
    trial = np.empty((BEAM * len(accelerations), 4))
    room, row = np.empty((2048, 2)), np.empty(2048, np.int64)
    beam[0, 0, 1] = speed
    held, best, best_k = 1, 0.0, 0
    for k in range(MOST_WINDOWS):
        tried, start = 0, time + way * k * WINDOW_S
        spans = _spans(begin, frame_time, min(start, start + way * WINDOW_S))
        for b in range(held):
            if beam[k, b, 2] < best - GIVE_UP:
                continue
            for pull in accelerations:
                after = max(beam[k, b, 1] + pull * WINDOW_S, 0.0)
                reached = beam[k, b, 0] + 0.5 * (beam[k, b, 1] + after) * WINDOW_S
                if reached > s_line[-1]:
                    continue
                gain = _window_gain(
                    line, s_line, turn, way, start, beam[k, b, 0], beam[k, b, 1], after, length,
                    width, spans, frame_time, rates, seen, alpha, room, row,
                )  # fmt: skip
                trial[tried, 0], trial[tried, 1] = reached, after
                trial[tried, 2], trial[tried, 3] = beam[k, b, 2] + gain, b
                tried += 1
        held = _best(trial[:tried], beam[k + 1])
        if held == 0 or beam[k + 1, 0, 2] < best - GIVE_UP or k - best_k >= UNSEEN:
            break
        if beam[k + 1, 0, 2] > best:
            best, best_k = beam[k + 1, 0, 2], k + 1
    b = 0
    for k in range(best_k, -1, -1):
        states[k, 0], states[k, 1] = beam[k, b, 0], beam[k, b, 1]
        b = int(beam[k, b, 3])
    return best, best_k


@compiled
def _spans(begin: Integers, time: Floats, start: float) -> Integers:
    """Return (sensors, 2) the frames of each sensor in half a second."""
    found = np.empty((len(begin) - 1, 2), np.int64)
    for k in range(len(begin) - 1):
        mine = time[begin[k] : begin[k + 1]]
        found[k, 0] = begin[k] + np.searchsorted(mine, start)
        found[k, 1] = begin[k] + np.searchsorted(mine, start + WINDOW_S)
    return found


@compiled
def _window_gain(  # noqa: PLR0917 - numba takes plain arrays
    line: Floats, s_line: Floats, turn: Floats, way: int, start: float, u: float, speed: float,
    after: float, length: float, width: float, spans: Integers, frame_time: Floats, rates: Rates,
    seen: Seen, alpha: Floats, room: Floats, row: Integers,
) -> float:  # fmt: skip
    """Return the gain of half a second from a place on a line with a speed, to another speed."""
    pull = (after - speed) / WINDOW_S
    gain = -0.25 * min((pull / USUAL_MPS2) ** 2, 9.0)
    kind_of = 1 if speed < STANDS_MPS and after < STANDS_MPS else 0
    shape = np.zeros(9)
    shape[5], shape[6] = length, width
    for sensor in range(len(spans)):
        n, due = 0, 0.0
        for f in range(spans[sensor, 0], spans[sensor, 1]):
            lapse = abs(frame_time[f] - start)
            here = max(u + speed * lapse + 0.5 * pull * lapse * lapse, 0.0)
            i = min(max(np.searchsorted(s_line, here, side="right") - 1, 0), len(line) - 2)
            c, s = math.cos(turn[i]), math.sin(turn[i])
            shape[0] = line[i, 0] + (here - s_line[i]) * c
            shape[1] = line[i, 1] + (here - s_line[i]) * s
            shape[2], shape[3], shape[4] = way * c, way * s, max(speed + pull * lapse, 0.0)
            shape[7], shape[8] = _bends(s_line, turn, i, way)
            kind, cell = kind_and_cell(shape, sensor, rates)
            mu = rates[1][kind] * rates[2][cell]
            before, n = n, densities(shape, f, seen, room, row, n)
            for q in range(before, n):
                room[q, 0], room[q, 1] = room[q, 0] * mu, seen[6][row[q]]
            due += mu
        if due > 0.0:
            gain += gain_of(room, n, due, alpha[kind_of])[0]
    return gain


@compiled
def _bends(s_line: Floats, turn: Floats, i: int, way: int) -> tuple[float, float]:
    """Return the curvature behind a vehicle on a segment and ahead of it, within the line."""
    before = np.searchsorted(s_line, s_line[i] - BEND_M)
    after = min(np.searchsorted(s_line, s_line[i] + BEND_M), len(turn) - 1)
    early = (turn[i] - turn[before]) / BEND_M
    late = (turn[after] - turn[i]) / BEND_M
    return (early, late) if way > 0 else (-late, -early)


@compiled
def _best(trial: Floats, kept: Floats) -> int:
    """Fill in the best hypotheses that differ from each other; return how many."""
    held = 0
    for q in np.argsort(-trial[:, 2], kind="mergesort"):
        same = False
        for b in range(held):
            place, speed = abs(kept[b, 0] - trial[q, 0]), abs(kept[b, 1] - trial[q, 1])
            same = same or (place < SAME_M and speed < SAME_MPS)
        if same or held == len(kept):
            continue
        kept[held] = trial[q]
        held += 1
    return held


def _longer(motion: Motion, line: Floats, states: Floats, way: int) -> Motion:
    """Return a motion with states along a line added at its end or its begin."""
    count = round((len(states) - 1) * WINDOW_S * STEPS_PER_SECOND)
    lapse, knots = np.arange(1, count + 1) * STEP_S, np.arange(len(states)) * WINDOW_S
    far, speed = (np.interp(lapse, knots, states[:, k]) for k in (0, 1))
    at = -1 if way > 0 else 0
    spread = motion.var_s[at] + np.minimum(SPREAD_M2 * lapse, MOST_SPREAD_M2)
    ended, known = float(motion.s_m[at]), motion.path
    kept = known.points[way * (known.s_m - ended) < -0.5]
    if way > 0:
        path = Path(np.vstack([kept, line]))
        joint = float(path.s_m[len(kept)])
        return replace(
            motion, path=path, s_m=np.append(motion.s_m - ended + joint, joint + far),
            speed=np.append(motion.speed, speed), var_s=np.append(motion.var_s, spread),
        )  # fmt: skip
    path = Path(np.vstack([line[::-1], kept]))
    joint = float(path.s_m[len(line) - 1])
    return replace(
        motion, path=path, first_step=motion.first_step - count,
        s_m=np.append((joint - far)[::-1], motion.s_m - ended + joint),
        speed=np.append(speed[::-1], motion.speed), var_s=np.append(spread[::-1], motion.var_s),
    )  # fmt: skip
