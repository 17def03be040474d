"""Longer tracks: along the lanes, as far as detections or the lack of expected ones allow."""

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
from gis_radar.tracking.posterior.cuts import MOST_END_COST
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.frames import BEND_M, WINDOW_S
from gis_radar.tracking.posterior.likelihood import (
    STANDS_MPS,
    DetectionArrays,
    RateModel,
    class_and_cell,
    fill_densities,
    log_likelihood_ratio,
)

# Lines along lanes on which a track may continue: length, most lines, most lanes to begin with.
_LINE_M, MOST_LINES, _MOST_LANES = 120.0, 6, 2
_MOST_TURN = 0.6  # largest angle between a vehicle and its lane, radians
_METRES_PER_RAD = 3.0  # distance beside a lane that is as unlikely as a radian of turn
_MOST_WINDOWS, _BEAM = 40, 6  # half seconds of the beam search, and hypotheses that it keeps
_ACCELERATIONS = np.array([-4.0, -2.0, -1.0, 0.0, 1.0, 2.0])  # that are tried, m/s2
_ACCELERATION_MPS2 = 2.0  # sigma of the acceleration, whose prior counts half in a half second
# A hypothesis so much worse than the best is dropped; least gain of a longer track; both nats.
_PRUNED, _LEAST_GAIN = 12.0, 3.0
_MOST_GAINLESS = 8  # half seconds in a row without a gain after which the search ends
_SAME_M, _SAME_MPS = 0.4, 0.9  # hypotheses that differ by less are one
# Growth of the variance of a place per second; its limit
_VARIANCE_M2, _MOST_VARIANCE_M2 = 0.05, 1.0
# Half seconds of an extension: then a hidden place is not visible any more
_UNDETECTED_WINDOWS = 20
_FORK_POINTS = 40  # points of a line, a metre apart, whose turn decides at forks


def lengthen(posterior: Posterior, graph: LaneGraph) -> list[Motion]:
    """Return the vehicles lengthened at both ends, as far as detections raise the posterior.

    Vehicles are lengthened in descending order of their number of detections.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; rates of the new states are added to its total rates.
    graph : LaneGraph
        The lanes.
    """
    graphs = {1: graph, -1: graph.reversed}
    found = list(posterior.motions)
    for k in np.argsort([-len(each.rows) for each in found], kind="stable").tolist():
        for direction in (1, -1):
            longer = _lengthened(posterior, found[k], graphs[direction], direction)
            if longer is not found[k]:
                begin, end = ((found[k].first_step - 0.5) * STEP_S,
                              (found[k].last_step + 0.5) * STEP_S)  # fmt: skip
                new = (end, math.inf) if direction > 0 else (-math.inf, begin)
                posterior.gain(longer, add=True, within=new)
                found[k] = longer
    return found


def with_undetected_ends(
    posterior: Posterior, motions: Sequence[Motion], graph: LaneGraph
) -> list[Motion]:
    """Return the vehicles extended at both ends through times in which they are not detected.

    Vehicles do not vanish: far away, behind another one, or where the radar is blind, one is there
    undetected. It is predicted along its lane at constant speed, or in its place where it stands.
    The expected number of detections in a cell is learned from all other vehicles in it, predicted
    ones included; :func:`_undetected_steps` says how far that allows an extension.

    Parameters
    ----------
    posterior : Posterior
        Posterior with learned detection rates; the extended vehicles are set in it.
    motions : sequence of Motion
        The vehicles.
    graph : LaneGraph
        The lanes.

    Returns
    -------
    list of Motion
        In the same order, with the same detections.
    """
    graphs = {1: graph, -1: graph.reversed}
    longest = [_predicted(_predicted(each, graphs[1], 1), graphs[-1], -1) for each in motions]
    posterior.set_vehicles([])  # frees all states: those of the longest motions are twice as many
    posterior.set_vehicles(longest)
    overlapping = posterior.overlapping([(each.first_step, each.last_step) for each in motions])
    extended_motions = []
    for k, (motion, cost) in enumerate(zip(motions, posterior.costs_of_silence(), strict=True)):
        rows = posterior.states.rows(k)
        cost[overlapping[rows]] = math.inf
        step = posterior.frames.time[posterior.states.frame[rows]] * STEPS_PER_SECOND
        detected = posterior.detections.time[motion.rows] * STEPS_PER_SECOND
        speed = motion.speed[[0, -1]]
        # until the speed may have changed by half, at _ACCELERATION_MPS2, and no longer than it was
        # detected, which is how long its speed is known
        reliable = 0.5 * speed / _ACCELERATION_MPS2 * STEPS_PER_SECOND
        reliable = np.minimum(reliable, detected.max() - detected.min())
        reliable[speed <= STANDS_MPS] = math.inf
        before, after = (
            _undetected_steps(past, cost, most)
            for past, most in zip(
                (detected.min() - step, step - detected.max()),
                reliable.tolist(),
                strict=True,
            )
        )
        first, last = float(detected.min()) - before, float(detected.max()) + after
        extended = longest[k].between(
            min(motion.first_step, math.floor(first)), max(motion.last_step, math.ceil(last)),
            posterior.detections.time,
        )  # fmt: skip
        extended_motions.append(extended or motion)
    posterior.set_vehicles(extended_motions)
    return extended_motions


def _undetected_steps(past: Floats, cost: Floats, reliable: float) -> float:
    """Return for how many steps after its last detection a vehicle continues undetected.

    For all steps if they cost no more than an end in plain view, else until they cost as much, and
    only while the prediction is reliable.

    Parameters
    ----------
    past : (n,) array
        Steps after the last detection at each state; negative ones are ignored.
    cost : (n,) array
        Cost if the state is not detected, nats.
    reliable : float
        Steps for which the prediction is reliable.
    """
    order = np.argsort(past, kind="stable")
    order = order[past[order] > 0.0]
    past, total = past[order], np.cumsum(cost[order])
    if len(past) == 0 or total[-1] <= MOST_END_COST:
        return float(past[-1]) if len(past) else 0.0
    undetected = past[(total <= MOST_END_COST) & (past <= reliable)]
    return float(undetected[-1]) if len(undetected) else 0.0


def _predicted(motion: Motion, graph: LaneGraph, direction: int) -> Motion:
    """Return a motion predicted after its end (direction 1) or before its begin (-1).

    It follows the straightest lane at constant speed, up to the end of the lanes. A vehicle that
    stands there keeps its place, if it drives at another time; else it is not extended.
    """
    middle, heading = motion.places
    at = -1 if direction > 0 else 0
    speed = float(motion.speed[at])
    if speed <= STANDS_MPS:
        return _held_at_rest(motion, direction) if motion.speed.max() > DRIVES_MPS else motion
    lines = _lines_from(graph, middle[at], float(heading[at]) + (0.0 if direction > 0 else math.pi))
    lines = [line for line in lines if len(line) > 2]
    if not lines:
        return motion
    line = min(lines, key=_turn_of)
    along = speed * WINDOW_S * np.arange(_UNDETECTED_WINDOWS + 1)
    along = along[along <= Path(line).s_m[-1]]
    if len(along) < 2:
        return motion
    states = np.column_stack([along, np.full(len(along), speed)])
    return _with_states(motion, line, states, direction)


def _held_at_rest(motion: Motion, direction: int) -> Motion:
    """Return a motion that stands after its end (direction 1) or before its begin (-1)."""
    count = round(_UNDETECTED_WINDOWS * WINDOW_S * STEPS_PER_SECOND)
    sides = (0, count) if direction > 0 else (count, 0)
    place, variance = (np.pad(each, sides, mode="edge") for each in (motion.s_m, motion.var_s))
    return replace(
        motion, first_step=motion.first_step - sides[0], s_m=place, var_s=variance,
        speed=np.pad(motion.speed, sides),
    )  # fmt: skip


def _turn_of(line: Floats) -> float:
    """Return by how many radians a line turns over its first `_FORK_POINTS`."""
    ahead = np.diff(line[:_FORK_POINTS], axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return float(np.abs(heading[-1] - heading[0]))


def _lengthened(posterior: Posterior, motion: Motion, graph: LaneGraph, direction: int) -> Motion:
    """Return a motion lengthened by the beam search at its end (direction 1) or begin (-1)."""
    middle, heading = motion.places
    at, step = (-1, motion.last_step) if direction > 0 else (0, motion.first_step)
    best, longer = _LEAST_GAIN, motion
    towards = float(heading[at]) + (0.0 if direction > 0 else math.pi)
    for line in _lines_from(graph, middle[at], towards):
        path = Path(line)
        turn = np.append(path.heading, path.heading[-1])
        states = np.zeros((_MOST_WINDOWS + 1, 2))
        gain, count = _search(
            line, path.s_m, turn, direction, (step + 0.5 * direction) * STEP_S,
            float(motion.speed[at]), motion.length_m, motion.width_m, posterior.frames.begin,
            posterior.frames.time, posterior.rate_model, posterior.detection_arrays,
            posterior.alpha, _ACCELERATIONS, states,
        )  # fmt: skip
        if gain > best and count > 0:
            best, longer = gain, _with_states(motion, line, states[: count + 1], direction)
    return longer


def _lines_from(graph: LaneGraph, place: Floats, heading: float) -> list[Floats]:
    """Return lines (n, 2) from a place on, along the lanes there and their successors."""
    lanes = graph.field.lane_rows(place[None])[:, 1:5]  # position, s, d, heading
    turn = np.abs(np.angle(np.exp(1j * (lanes[:, 3] - heading))))
    rank = np.abs(lanes[:, 2]) + _METRES_PER_RAD * turn
    good = np.flatnonzero(turn < _MOST_TURN)
    found: list[Floats] = []
    likeliest = good[np.argsort(rank[good], kind="stable")][:_MOST_LANES]
    for lane, s_m, d_m, _ in lanes[likeliest].tolist():
        found += [
            _line(graph, chain, s_m, d_m, place)
            for chain in _chains(graph, int(lane), _LINE_M + s_m)
        ]
    return [line for line in found[:MOST_LINES] if len(line) > 1]


def _chains(graph: LaneGraph, lane: int, reach_m: float) -> list[list[int]]:
    """Return the chains of lanes from one on, each up to a length or to where lanes end."""
    done: list[list[int]] = []
    waiting = [([lane], float(graph.length_m[lane]))]
    while waiting and len(done) < MOST_LINES:
        chain, length = waiting.pop(0)
        after = [each for each in graph.successors[chain[-1]].tolist() if each not in chain]
        if length >= reach_m or not after:
            done.append(chain)
        else:
            waiting += [([*chain, each], length + float(graph.length_m[each])) for each in after]
    return done


def _line(graph: LaneGraph, chain: list[int], s_m: float, d_m: float, place: Floats) -> Floats:
    """Return a line from a place along lanes, at its distance `d_m` left of their middle."""
    parts, begin = [place[None]], s_m + 1.0
    for lane in chain:
        if begin == 0.5:
            points, left = graph.by_metre(lane)
        else:
            points, heading = graph.place(lane, np.arange(begin, float(graph.length_m[lane])))
            left = np.column_stack([-np.sin(heading), np.cos(heading)])
        parts.append(points + d_m * left)
        begin = max(begin - float(graph.length_m[lane]), 0.5)
    return np.vstack(parts)


@compiled
def _search(  # noqa: PLR0917 - numba takes plain arrays
    line: Floats, s_line: Floats, turn: Floats, direction: int, time: float, speed: float,
    length: float, width: float, begin: Integers, frame_time: Floats, model: RateModel,
    arrays: DetectionArrays, alpha: Floats, accelerations: Floats, states: Floats,
) -> tuple[float, int]:  # fmt: skip
    """Search how a vehicle continues along a line; return the gain and the number of half seconds.

    A beam search by half seconds: each hypothesis is a place on the line and a speed, which is
    continued with each acceleration, and the best are kept. Places and speeds of the best one are
    written to `states` (windows + 1, 2).
    """
    beam = np.zeros((_MOST_WINDOWS + 1, _BEAM, 4))  # place, speed, gain, parent
    trial = np.empty((_BEAM * len(accelerations), 4))
    work, row = np.empty((2048, 2)), np.empty(2048, np.int64)
    beam[0, 0, 1] = speed
    count, best, best_k = 1, 0.0, 0
    for k in range(_MOST_WINDOWS):
        tried, start = 0, time + direction * k * WINDOW_S
        spans = _spans(begin, frame_time, min(start, start + direction * WINDOW_S))
        for b in range(count):
            if beam[k, b, 2] < best - _PRUNED:
                continue
            for accel in accelerations:
                after = max(beam[k, b, 1] + accel * WINDOW_S, 0.0)
                reached = beam[k, b, 0] + 0.5 * (beam[k, b, 1] + after) * WINDOW_S
                if reached > s_line[-1]:
                    continue
                gain = _window_gain(
                    line, s_line, turn, direction, start, beam[k, b, 0], beam[k, b, 1], after,
                    length, width, spans, frame_time, model, arrays, alpha, work, row,
                )  # fmt: skip
                trial[tried, 0], trial[tried, 1] = reached, after
                trial[tried, 2], trial[tried, 3] = beam[k, b, 2] + gain, b
                tried += 1
        count = _best_distinct(trial[:tried], beam[k + 1])
        if count == 0 or beam[k + 1, 0, 2] < best - _PRUNED or k - best_k >= _MOST_GAINLESS:
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
    """Return begin and end (exclusive) of each sensor's frames in a half second, (sensors, 2)."""
    found = np.empty((len(begin) - 1, 2), np.int64)
    for k in range(len(begin) - 1):
        mine = time[begin[k] : begin[k + 1]]
        found[k, 0] = begin[k] + np.searchsorted(mine, start)
        found[k, 1] = begin[k] + np.searchsorted(mine, start + WINDOW_S)
    return found


@compiled
def _window_gain(  # noqa: PLR0917 - numba takes plain arrays
    line: Floats, s_line: Floats, turn: Floats, direction: int, start: float, place: float,
    speed: float, after: float, length: float, width: float, spans: Integers, frame_time: Floats,
    model: RateModel, arrays: DetectionArrays, alpha: Floats, work: Floats, row: Integers,
) -> float:  # fmt: skip
    """Return the gain of a half second from a place on a line, from one speed to another, nats."""
    accel = (after - speed) / WINDOW_S
    gain = -0.25 * min((accel / _ACCELERATION_MPS2) ** 2, 9.0)
    standing = 1 if speed < STANDS_MPS and after < STANDS_MPS else 0
    shape = np.zeros(9)
    shape[5], shape[6] = length, width
    for sensor in range(len(spans)):
        n, expected = 0, 0.0
        for f in range(spans[sensor, 0], spans[sensor, 1]):
            lapse = abs(frame_time[f] - start)
            along = max(place + speed * lapse + 0.5 * accel * lapse * lapse, 0.0)
            i = min(max(np.searchsorted(s_line, along, side="right") - 1, 0), len(line) - 2)
            c, s = math.cos(turn[i]), math.sin(turn[i])
            shape[0] = line[i, 0] + (along - s_line[i]) * c
            shape[1] = line[i, 1] + (along - s_line[i]) * s
            shape[2], shape[3] = direction * c, direction * s
            shape[4] = max(speed + accel * lapse, 0.0)
            shape[7], shape[8] = _bends(s_line, turn, i, direction)
            rate_class, cell = class_and_cell(shape, sensor, model)
            mu = model[1][rate_class] * model[2][cell]
            before, n = n, fill_densities(shape, f, arrays, work, row, n)
            for q in range(before, n):
                work[q, 0], work[q, 1] = work[q, 0] * mu, arrays[6][row[q]]
            expected += mu
        if expected > 0.0:
            gain += log_likelihood_ratio(work, n, expected, alpha[standing])[0]
    return gain


@compiled
def _bends(s_line: Floats, turn: Floats, i: int, direction: int) -> tuple[float, float]:
    """Return the curvature of a line behind a vehicle on its segment `i`, and ahead of it, 1/m."""
    before = np.searchsorted(s_line, s_line[i] - BEND_M)
    after = min(np.searchsorted(s_line, s_line[i] + BEND_M), len(turn) - 1)
    early = (turn[i] - turn[before]) / BEND_M
    late = (turn[after] - turn[i]) / BEND_M
    return (early, late) if direction > 0 else (-late, -early)


@compiled
def _best_distinct(trial: Floats, kept: Floats) -> int:
    """Write the best hypotheses that differ from each other to `kept`; return their number."""
    count = 0
    for q in np.argsort(-trial[:, 2], kind="mergesort"):
        same = False
        for b in range(count):
            place, speed = abs(kept[b, 0] - trial[q, 0]), abs(kept[b, 1] - trial[q, 1])
            same = same or (place < _SAME_M and speed < _SAME_MPS)
        if same or count == len(kept):
            continue
        kept[count] = trial[q]
        count += 1
    return count


def _with_states(motion: Motion, line: Floats, states: Floats, direction: int) -> Motion:
    """Return a motion with states (place, speed) along a line added at its end or its begin."""
    count = round((len(states) - 1) * WINDOW_S * STEPS_PER_SECOND)
    lapse, knots = np.arange(1, count + 1) * STEP_S, np.arange(len(states)) * WINDOW_S
    along, speed = (np.interp(lapse, knots, states[:, k]) for k in (0, 1))
    at = -1 if direction > 0 else 0
    variance = motion.var_s[at] + np.minimum(_VARIANCE_M2 * lapse, _MOST_VARIANCE_M2)
    end_m, path_before = float(motion.s_m[at]), motion.path
    kept = path_before.points[direction * (path_before.s_m - end_m) < -0.5]
    if direction > 0:
        path = Path(np.vstack([kept, line]))
        joint = float(path.s_m[len(kept)])
        return replace(
            motion, path=path, s_m=np.append(motion.s_m - end_m + joint, joint + along),
            speed=np.append(motion.speed, speed), var_s=np.append(motion.var_s, variance),
        )  # fmt: skip
    path = Path(np.vstack([line[::-1], kept]))
    joint = float(path.s_m[len(line) - 1])
    return replace(
        motion, path=path, first_step=motion.first_step - count,
        s_m=np.append((joint - along)[::-1], motion.s_m - end_m + joint),
        speed=np.append(speed[::-1], motion.speed), var_s=np.append(variance[::-1], motion.var_s),
    )  # fmt: skip
