"""Cycles of signals, inferred from the traffic: vehicles that waited leave a stop line in cycles.

A *begin of green* is seen where a vehicle that stood at the line crosses it and none has crossed
for some seconds. Where most begins, and more than chance explains, lie on a line over the numbers
of their cycles, they are those of a signal of fixed time; others, as of a signal that follows
demand, are not taken for cycles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Booleans, Floats, Integers, Text
from gis_radar.measures.lane_fronts import Crossings, StepGrid, TrackedLanes
from gis_radar.measures.lane_network import JOINED_M
from gis_radar.measures.queues import (
    OVER_LINE_M,
    QueueCourse,
    joins,
    queue_course,
    to_stop_line,
)

_LEAST_RED_S = 8.0  # without a crossing before green: vehicles of a queue follow every 2 to 4 s
_CYCLE_S = (30.0, 240.0)  # lengths of cycles: those of RiLSA (30 to 120 s), and longer ones abroad
_LEAST_GREENS = 4  # begins of green from which a cycle is inferred
# Most time between a seen and a fitted begin: first drivers react in 1 to 2 s, +- 1 s
_EVEN_S = 3.0
_MOST_CHANCE = 0.05  # most probability that begins at random lie so well on cycles of any length
# Least share of the cycles with a seen begin whose first is at the fitted time; signals that follow
# demand have fewer.
_LEAST_ON = 0.6
# Trial rates per resolved one; how many are fitted; rounds of a fit.
_FINE, _TRIED, _FITS = 32, 20, 3
FEW = Text("fewer than {} begins of green seen", _LEAST_GREENS)
UNEVEN = Text("vehicles do not leave periodically")
_UNSTATED = Text("no two begins of green stated")
LINE_HIDDEN = Text("stop line not visible throughout")
CHANCE = Text("vehicles leave in the stated greens hardly more than by chance")
_AMBER_S = 3.0  # after green, in which vehicles still cross
_LEAST_LEAVING = 10  # fewest vehicles from which greens of another signal or clock are found
_MOST_AT_RED = 0.2  # share of them up to which greens are taken, whatever chance explains
_LEAST_WAITING = 0.3  # least share of them that waits for green where others turn at red


class Cycle(NamedTuple):
    """Cycle at a stop line, from a begin of green to the next; or why none can be inferred.

    Parameters
    ----------
    lane : int
        Position of the lane.
    first, after : int
        First step, and the first one of the next cycle.
    cycle_s, cycle_se_s : float
        Length of the signal's cycles, and its standard error, seconds.
    counted : int or None
        Vehicles that leave.
    queue_max_m, queue_mean_m : float
        Back of the queue from the line: farthest, and mean over the cycle.
    queue_end_m : float
        The same at the end of green, when the last vehicle leaves: of vehicles that have stood and
        not left.
    reason : str
        Why figures are missing, else empty.
    """

    lane: int
    first: int
    after: int
    cycle_s: float = np.nan
    cycle_se_s: float = np.nan
    counted: int | None = None
    queue_max_m: float = np.nan
    queue_mean_m: float = np.nan
    queue_end_m: float = np.nan
    reason: str = ""


class Greens(NamedTuple):
    """Green times of a lane that are known: steps of begins, ascending, and ends (-1: unknown)."""

    begin: Integers
    end: Integers


class Period(NamedTuple):
    """Length of cycles (s), its standard error, and the first of evenly fitted begins."""

    length_s: float
    error_s: float
    begin_s: float


def period_of(begins_s: Floats) -> Period | str:
    """Return the period of begins of green (ascending, s), or why there is none.

    The period is that on whose cycles the begins are least likely to lie by chance. A vehicle that
    starts late within a green looks like another begin: only the first of each cycle counts.
    """
    if len(begins_s) < _LEAST_GREENS:
        return FEW
    span = float(np.ptp(begins_s))
    rate = np.arange(1.0 / _CYCLE_S[1], 1.0 / _CYCLE_S[0], 1.0 / (_FINE * max(span, _CYCLE_S[1])))
    power = np.abs(np.exp(2j * np.pi * np.outer(rate, begins_s)).sum(axis=1))
    fits = [
        _fitted_cycles(begins_s, float(1.0 / each)) for each in rate[np.argsort(-power)[:_TRIED]]
    ]
    chance, share_on, period = min(fits, key=lambda each: each[0])
    # number of periods that differ by more than `_EVEN_S` in begin or length
    resolution = (period.length_s / (2.0 * _EVEN_S)) ** 2
    period_count = resolution * span * (1.0 / _CYCLE_S[0] - 1.0 / _CYCLE_S[1])
    in_range = _CYCLE_S[0] <= period.length_s <= _CYCLE_S[1]
    is_even = share_on >= _LEAST_ON and chance * period_count < _MOST_CHANCE
    return period if in_range and is_even else UNEVEN


def _fitted_cycles(begins_s: Floats, length_s: float) -> tuple[float, float, Period]:
    """Fit cycles of about a length, s, to begins of green, by least squares.

    Returns
    -------
    chance : float
        Probability that as many begins lie on them by chance.
    share_on : float
        Share of the cycles with a begin whose first lies on them.
    period : Period
        The cycles.
    """
    distance = (begins_s - begins_s[:, None] + length_s / 2.0) % length_s - length_s / 2.0
    begin = float(begins_s[(np.abs(distance) <= _EVEN_S).sum(axis=1).argmax()])
    period = Period(length_s, np.nan, begin)
    for _ in range(_FITS):
        number = np.floor((begins_s - period.begin_s + _EVEN_S) / period.length_s)
        first = np.diff(number, prepend=-np.inf) > 0
        number, first_begins = number[first], begins_s[first]
        is_on = np.abs(first_begins - period.begin_s - number * period.length_s) <= _EVEN_S
        if is_on.sum() < _LEAST_GREENS:
            return 1.0, 0.0, period
        number, fitted = number[is_on] - number[is_on][0], first_begins[is_on]
        slope, begin = np.polyfit(number, fitted, 1)
        spread = float(np.sqrt(((fitted - begin - slope * number) ** 2).sum() / (is_on.sum() - 2)))
        error = spread / float(np.std(number) * np.sqrt(is_on.sum()))
        period = Period(float(slope), error, float(begin))
    # the first of several begins in a cycle is more likely to be near the fitted one
    begins_per_cycle = len(begins_s) / len(is_on)
    share = 1.0 - max(1.0 - 2.0 * _EVEN_S / period.length_s, 0.0) ** begins_per_cycle
    chance = float(scipy.stats.binom.sf(is_on.sum() - 1, len(is_on), share))
    return chance, float(is_on.mean()), period


def cycles(lanes: TrackedLanes, known: Mapping[int, Greens] | None = None) -> list[Cycle]:
    """Return the cycles at each stop line between the first and the last begin of green of a grid.

    Parameters
    ----------
    lanes : TrackedLanes
        The lanes and all vehicles on them.
    known : mapping, optional
        Green times, by position of the lane; elsewhere cycles are inferred from the traffic.
    """
    crossed, grid, greens = lanes.crossings, lanes.grid, known or {}
    seconds = (grid.end - grid.begin) // STEPS_PER_SECOND
    second_by_second = replace(
        lanes, grid=StepGrid(begin=grid.begin, steps=STEPS_PER_SECOND, count=seconds)
    )
    filled: list[Cycle] = []
    for lane in np.flatnonzero(lanes.network.has_stop_line).tolist():
        crossings_here = crossed.take(crossed.lane == lane)
        crossings_here = crossings_here.take(
            np.asarray(np.argsort(crossings_here.step, kind="stable"), np.int64)
        )
        if (stated := greens.get(lane)) is not None:
            of_lane = _stated_cycles(lane, stated, crossings_here.step, grid)
        else:
            of_lane = _inferred_cycles(lane, _seen_begins(lane, crossings_here, lanes), grid)
        if of_lane[0].reason:
            filled += of_lane
            continue
        course, queue_states = queue_course(lane, second_by_second), _QueueStates.at(lane, lanes)
        line = lanes.line_tile_id[[lane]]
        ends = {} if stated is None else dict(zip(*(n.tolist() for n in stated), strict=True))
        for each in of_lane:
            edges = np.array([each.first]), np.array([each.after - 1])
            if lanes.visible.throughout(line, *edges)[0]:
                end = ends.get(each.first, -1)
                figures = _with_figures(each, crossings_here, course, queue_states, end, lanes)
                filled.append(figures)
            else:
                filled.append(each._replace(reason=LINE_HIDDEN))
    return filled


def _inferred_cycles(lane: int, begins: Integers, grid: StepGrid) -> list[Cycle]:
    """Return the cycles of begins of green that are seen, without figures."""
    period = period_of(np.asarray((begins - grid.begin) * STEP_S, np.float64))
    if isinstance(period, str):
        return [Cycle(lane, grid.begin, grid.end, reason=period)]
    edges = _cycle_begins(begins, period, grid).tolist()
    return [Cycle(lane, *each, period.length_s, period.error_s) for each in pairwise(edges)]


def _stated_cycles(lane: int, greens: Greens, crossed: Integers, grid: StepGrid) -> list[Cycle]:
    """Return the cycles of green times that are known, without figures."""
    inside = (greens.begin >= grid.begin) & (greens.begin < grid.end)
    stated = Greens(greens.begin[inside], greens.end[inside])
    if len(stated.begin) < 2:
        return [Cycle(lane, grid.begin, grid.end, reason=_UNSTATED)]
    if are_of_another(stated, crossed):
        return [Cycle(lane, grid.begin, grid.end, reason=CHANCE)]
    return [Cycle(lane, a, b, (b - a) * STEP_S, 0.0) for a, b in pairwise(stated.begin.tolist())]


def are_of_another(greens: Greens, crossed: Integers) -> bool:
    """Return whether greens are of another signal, or by another clock: few vehicles leave in them.

    Where turning at red is allowed, many leave at red, but some wait for green. From few vehicles
    nothing follows: then the greens are taken.

    Parameters
    ----------
    greens : Greens
        The greens of a lane.
    crossed : (n,) int64 array
        Steps in which vehicles cross its stop line, ascending.
    """
    last = np.minimum(greens.end[:-1] + round(_AMBER_S / STEP_S), greens.begin[1:])
    cycle = np.searchsorted(greens.begin, crossed, side="right") - 1
    is_known = (cycle >= 0) & (cycle < len(last))
    cycle, crossed = cycle[is_known], crossed[is_known]
    ends_known = greens.end[:-1] >= 0
    leaving = crossed[ends_known[cycle]], cycle[ends_known[cycle]]
    at_green = int((leaving[0] < last[leaving[1]]).sum())
    if len(leaving[0]) < _LEAST_LEAVING or at_green >= (1.0 - _MOST_AT_RED) * len(leaving[0]):
        return False
    share = (last - greens.begin[:-1])[ends_known].sum() / np.diff(greens.begin)[ends_known].sum()
    least = share + _LEAST_WAITING * (1.0 - share)
    return bool(scipy.stats.binom.cdf(at_green, len(leaving[0]), least) < _MOST_CHANCE)


def _seen_begins(lane: int, crossed: Crossings, lanes: TrackedLanes) -> Integers:
    """Return the steps of the begins of green that are seen, of crossings in order of time."""
    states = lanes.states
    standing = np.flatnonzero(lanes.standing[0] & (states.lane == lane))
    to_line = lanes.network.line_m[lane] - states.along_m[standing]
    standing = standing[(to_line >= -OVER_LINE_M) & (to_line <= JOINED_M)]
    before_s = np.diff(crossed.step, prepend=lanes.grid.begin) * STEP_S
    first = np.isin(crossed.vehicle, states.vehicle[standing]) & (before_s >= _LEAST_RED_S)
    return crossed.step[first]


def _cycle_begins(begins: Integers, period: Period, grid: StepGrid) -> Integers:
    """Return the begins of all cycles from the first to the last: where none is seen, fitted."""
    seen_s = (begins - grid.begin) * STEP_S
    count = round((float(seen_s[-1]) - period.begin_s) / period.length_s)
    fitted = period.begin_s + np.arange(count + 1) * period.length_s
    near = seen_s[np.abs(fitted[:, None] - seen_s).argmin(axis=1)]
    even = np.where(np.abs(near - fitted) <= period.length_s / 4.0, near, fitted)
    return np.asarray(grid.begin + np.rint(even / STEP_S), np.int64)


class _QueueStates(NamedTuple):
    """States of vehicles that may queue at a stop line, those ahead first in each step.

    Parameters
    ----------
    vehicle, step, strip : (n,) int64 arrays
        Number of the vehicle, step, and strip of the queue on which it is.
    to_line_m, length_m : (n,) arrays
        Metres from the front to the line, and length of the vehicle.
    stands : (n,) bool array
        Whether it stands.
    """

    vehicle: Integers
    step: Integers
    strip: Integers
    to_line_m: Floats
    length_m: Floats
    stands: Booleans

    @classmethod
    def at(cls, stop: int, lanes: TrackedLanes) -> _QueueStates:
        """Return those at the stop line of a lane."""
        states, network = lanes.states, lanes.network
        strips, strip_of = network.queue_strips, np.full(len(network.lane) + 1, -1)
        mine = strips.of_stop(stop)
        strip_of[strips.lane[mine]] = mine
        to_line = to_stop_line(stop, lanes)
        row = np.flatnonzero(to_line >= -OVER_LINE_M)  # NaN elsewhere
        row = row[np.lexsort((to_line[row], states.step[row]))]
        return cls(
            states.vehicle[row], states.step[row], strip_of[states.lane[row]], to_line[row],
            lanes.length_m[row], lanes.standing[0][row],
        )  # fmt: skip

    def farthest_left_over(
        self, departed: Integers, first: int, end: int, lanes: TrackedLanes
    ) -> float:
        """Return how far back, m, those reach at `end` that queued since `first` and did not leave.

        Those behind may still stand when those ahead have left: the queue keeps the length that it
        has had since `first`.
        """
        in_cycle = slice(*np.searchsorted(self.step, [first, end + 1]))
        low = int(in_cycle.start)
        reached, queued = dict[int, float](), set[int]()
        for row in (low + np.flatnonzero(self.stands[in_cycle])).tolist():
            strip, vehicle = int(self.strip[row]), int(self.vehicle[row])
            path = lanes.network.queue_strips.path_to(strip).tolist()
            reach = max(reached.get(each, 0.0) for each in path)
            place = self.step[[row]], np.array([reach]), self.to_line_m[[row]]
            if vehicle in queued or joins(strip, *place, lanes)[0]:
                queued.add(vehicle)
                reached[strip] = max(reach, float(self.to_line_m[row] + self.length_m[row]))
        staying = np.setdiff1d(np.array(sorted(queued), np.int64), departed)
        is_latest = np.isin(self.vehicle[in_cycle], staying) & (
            self.step[in_cycle] > end - STEPS_PER_SECOND
        )
        latest = (low + np.flatnonzero(is_latest))[::-1]
        latest = latest[np.unique(self.vehicle[latest], return_index=True)[1]]
        return float((self.to_line_m + self.length_m)[latest].max(initial=0.0))


def _with_figures(
    cycle: Cycle, crossed: Crossings, course: QueueCourse, queue_states: _QueueStates, end: int,
    lanes: TrackedLanes,
) -> Cycle:  # fmt: skip
    """Return a cycle with its figures; an `end` of green that is -1 is when the last one leaves."""
    leaving = crossed.step[(crossed.step >= cycle.first) & (crossed.step < cycle.after)]
    end = int(leaving.max(initial=cycle.first)) if end < 0 else end
    back_m = course.back_m[(course.back_step >= cycle.first) & (course.back_step < cycle.after)]
    departed = crossed.vehicle[crossed.step <= end]
    return cycle._replace(
        counted=len(leaving), queue_max_m=float(np.nanmax(back_m)),
        queue_mean_m=float(np.nanmean(back_m)),
        queue_end_m=queue_states.farthest_left_over(departed, cycle.first, end, lanes),
    )  # fmt: skip
