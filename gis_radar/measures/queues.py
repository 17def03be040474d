"""Standing vehicles, and the queues that they form at stop lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers, ranges
from gis_radar.measures.lane_fronts import FrontStates, StepGrid, VisibleRuns
from gis_radar.measures.lane_network import LaneNetwork

SLOW_MPS = 5.0 / 3.6  # a vehicle stands when it is slower (HCM, ch. 31, for stops) ...
SLOW_STEPS = STEPS_PER_SECOND  # ... for this time
JOINED_M = 10.0  # most visible road to the vehicle ahead, or to the line: two cars
OVER_LINE_M = 2.0  # how far the front of a waiting vehicle may be over the line
# Queues are measured at steps divisible by this: all tracks have a state there.
LOOK_STEPS = 4


def standing_states(states: FrontStates) -> tuple[Booleans, Booleans]:
    """Return the states in which vehicles stand, and those in which they stop.

    Returns
    -------
    stands : (n,) bool array
        Whether the vehicle stands in the state: it has been slow for 1 s.
    stops : (n,) bool array
        Whether it begins to stand in the state; a vehicle that is slow from its first state on does
        not stop.
    """
    slow = states.speed < SLOW_MPS
    new = np.ones(len(slow), np.bool_)
    new[1:] = np.diff(states.vehicle) != 0
    begins = new.copy()
    begins[1:] |= slow[1:] != slow[:-1]
    run = np.maximum.accumulate(np.where(begins, np.arange(len(slow)), 0))
    stands = slow & (states.step - states.step[run] >= SLOW_STEPS)
    stops = stands & ~new[run]
    stops[1:] &= ~stands[:-1] | new[1:]
    return stands, stops


def queue_backs(
    states: FrontStates, stands: Booleans, length_m: Floats, network: LaneNetwork,
    visible: VisibleRuns, grid: StepGrid,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Find the queues at stop lines: standing vehicles, from the line back, up to a visible gap.

    Parameters
    ----------
    states : FrontStates
        All states.
    stands : (n,) bool array
        Whether the vehicle stands in each state.
    length_m : (n,) array
        Length of the vehicle of each state, m.
    network, visible, grid
        As for :func:`gis_radar.measures.lane_fronts.driven`.

    Returns
    -------
    most_m : (cells,) array
        Greatest length by lane and interval, from the stop line to the back, m; 0 without a queue.
    sum_m : (cells,) array
        Sum of the lengths, m, over all steps divisible by `LOOK_STEPS` with a visible stop line.
    """
    standing, look = StandingFronts.of(states, stands, length_m, grid), looks(grid)
    most, total = np.zeros((2, len(network.lane), grid.count))
    for stop in np.flatnonzero(network.has_stop_line).tolist():
        back = queue_back(stop, standing, network, visible, grid)
        np.maximum.at(most[stop], grid.of(look), back)
        total[stop] = np.bincount(grid.of(look), back, grid.count)
    return most.ravel(), total.ravel()


def looks(grid: StepGrid) -> Integers:
    """Return the steps of a grid at which queues are measured."""
    return np.arange(-(-grid.begin // LOOK_STEPS) * LOOK_STEPS, grid.end, LOOK_STEPS)


class StandingFronts(NamedTuple):
    """States in which vehicles stand, sorted by lane and step, those ahead first.

    Parameters
    ----------
    lane, step : (n,) int64 arrays
        Position of the lane, and step, divisible by `LOOK_STEPS`.
    along_m, length_m : (n,) arrays
        Place of the front along the lane, and length of the vehicle, m.
    """

    lane: Integers
    step: Integers
    along_m: Floats
    length_m: Floats

    @classmethod
    def of(
        cls, states: FrontStates, stands: Booleans, length_m: Floats, grid: StepGrid
    ) -> StandingFronts:
        """Return those of a grid, on lanes."""
        looked = stands & (states.lane >= 0) & (states.step % LOOK_STEPS == 0)
        row = np.flatnonzero(looked & (states.step >= grid.begin) & (states.step < grid.end))
        row = row[np.lexsort((-states.along_m[row], states.step[row], states.lane[row]))]
        return cls(states.lane[row], states.step[row], states.along_m[row], length_m[row])


def queue_back(
    stop: int, standing: StandingFronts, network: LaneNetwork, visible: VisibleRuns, grid: StepGrid
) -> Floats:
    """Return how far back from a stop line a queue reaches, m, every `LOOK_STEPS` of a grid.

    Where lanes merge before the line, each has a queue of its own beyond: who waits on one of them
    does not join those on the other. The longest counts.

    Parameters
    ----------
    stop : int
        Position of its lane.
    standing : StandingFronts
        Who stands in the grid.
    network, visible, grid
        As for :func:`queues`.
    """
    strips, look = network.queue_strips, looks(grid)
    # by strip: how far back the queue reaches, and whether no gap has ended it
    reached = {-1: (np.zeros(len(look)), np.ones(len(look), np.bool_))}
    for strip in strips.of_stop(stop):
        reach, whole = reached[strip] = reached[int(strips.ahead[strip])]
        lane = strips.lane[strip]
        mine = slice(*np.searchsorted(standing.lane, [lane, lane + 1]))
        front = strips.to_line_m[strip] - standing.along_m[mine]
        near = front >= -OVER_LINE_M
        if not near.any():
            continue
        step, front, rear = (
            each[near] for each in (standing.step[mine], front, front + standing.length_m[mine])
        )
        at, new = np.searchsorted(look, step), np.diff(step, prepend=-1) != 0
        farthest = _farthest(rear, new)  # a lorry may reach farther back than a car behind it
        ahead = np.maximum(reach[at], np.where(new, 0.0, np.append(0.0, farthest[:-1])))
        good = joins(strip, step, ahead, front, network, visible) & whole[at]
        joined = _unbroken(good, new)
        reach, whole = reached[strip] = reach.copy(), whole.copy()
        np.maximum.at(reach, at[joined], rear[joined])
        whole[at[~joined]] = False
    back = np.max([reach for reach, _ in reached.values()], axis=0)
    line = network.tile_id[network.tile_at(np.array([stop]), network.line_m[[stop]])]
    return np.where(visible.at(np.repeat(line, len(look)), look), back, 0.0)


def joins(
    strip: int, step: Integers, reach_m: Floats, front_m: Floats, network: LaneNetwork,
    visible: VisibleRuns,
) -> Booleans:  # fmt: skip
    """Return which standing vehicles join a queue: no visible gap over `JOINED_M` lies between.

    Parameters
    ----------
    strip : int
        Strip of :attr:`LaneNetwork.queue_strips` on which they stand.
    step : (n,) int64 array
        Steps.
    reach_m, front_m : (n,) arrays
        Metres to the line: how far back the queue reaches, and the front of the vehicle.
    network, visible
        As for :func:`gis_radar.measures.lane_fronts.driven`.
    """
    gap = front_m - reach_m
    wide = np.flatnonzero(gap > JOINED_M)
    if len(wide):
        near_m, far_m = reach_m[wide], front_m[wide]
        gap[wide] = _visible_m(strip, step[wide], near_m, far_m, network, visible)
    return np.asarray(gap <= JOINED_M, np.bool_)


def _visible_m(
    strip: int, step: Integers, near_m: Floats, far_m: Floats, network: LaneNetwork,
    visible: VisibleRuns,
) -> Floats:  # fmt: skip
    """Return the visible metres on the way from a strip to the line, between two distances."""
    way = network.queue_strips.way(strip)
    lane, to_line = network.queue_strips.lane[way], network.queue_strips.to_line_m[way]
    count = np.ceil(far_m - near_m).astype(np.int64)
    row = np.repeat(np.arange(len(step)), count)
    metre = near_m[row] + ranges(np.zeros(len(step), np.int64), count) + 0.5
    metre = np.minimum(metre, far_m[row])  # beyond it the lanes may end
    at = np.minimum(np.searchsorted(to_line, metre), len(lane) - 1)
    tile = network.tile_id[network.tile_at(lane[at], to_line[at] - metre)]
    seen = visible.at(tile, step[row])
    return np.bincount(row, seen, len(step)).astype(np.float64)


class QueueCourse(NamedTuple):
    """How vehicles come to a stop line, and how far back they queue.

    Parameters
    ----------
    vehicle, step, to_line_m : (n,) arrays
        States by vehicle and step: metres from the front to the line, below 0 beyond it.
    back_step, back_m : (k,) arrays
        Begins of equal intervals, and the farthest back of the queue in each; NaN where the line is
        not visible.
    seen : (r, 4) array
        Where the road is visible: steps from and to, metres to the line from and to.
    """

    vehicle: Integers
    step: Integers
    to_line_m: Floats
    back_step: Integers
    back_m: Floats
    seen: Floats


def queue_course(
    stop: int, states: FrontStates, length_m: Floats, network: LaneNetwork,
    visible: VisibleRuns, grid: StepGrid,
) -> QueueCourse:  # fmt: skip
    """Follow the queue at one stop line over the intervals of a grid.

    Parameters
    ----------
    stop : int
        Position of its lane.
    states, length_m, network, visible, grid
        As for :func:`queues`.
    """
    to_line, to_stop = _strip(stop, network), to_stop_line(stop, states, network)
    inside = (states.step >= grid.begin) & (states.step < grid.end)
    row = np.flatnonzero(inside & np.isfinite(to_stop))
    standing = StandingFronts.of(states, standing_states(states)[0], length_m, grid)
    back = np.zeros(grid.count)
    at_look = queue_back(stop, standing, network, visible, grid)
    np.maximum.at(back, grid.of(looks(grid)), at_look)
    begin = grid.begin + np.arange(grid.count) * grid.steps
    line = network.tile_id[network.tile_at(np.array([stop]), network.line_m[[stop]])]
    known = visible.at(np.repeat(line, grid.count), begin)
    place = pd.Series(np.arange(len(network.tile_id)), network.tile_id)
    tile = place.reindex(visible.tile_id).to_numpy()
    run = np.flatnonzero(np.isfinite(to_line[network.tile_lane[tile]]))
    run = run[(visible.first[run] < grid.end) & (visible.last[run] >= grid.begin)]
    far = to_line[network.tile_lane[tile[run]]] - network.tile_m[tile[run]]
    near = far - network.tile_length_m[tile[run]]
    return QueueCourse(
        states.vehicle[row], states.step[row],
        to_stop[row], begin, np.where(known, back, np.nan),
        np.column_stack([visible.first[run], visible.last[run] + 1, near, far]).astype(np.float64),
    )  # fmt: skip


def to_stop_line(stop: int, states: FrontStates, network: LaneNetwork) -> Floats:
    """Return the metres from fronts to the stop line of a lane; NaN where no queue at it stands."""
    to_line = np.append(_strip(stop, network), np.nan)  # the last for -1, off the lanes
    return np.asarray(to_line[states.lane] - states.along_m, np.float64)


def _strip(stop: int, network: LaneNetwork) -> Floats:
    """Return the metres from the begin of each lane to a stop line; NaN off its strips."""
    strips, to_line = network.queue_strips, np.full(len(network.lane), np.nan)
    mine = strips.stop_lane == stop
    to_line[strips.lane[mine]] = strips.to_line_m[mine]
    return to_line


def _farthest(values: Floats, new: Booleans) -> Floats:
    """Return, for each value, the greatest one of its group up to it; `new` begins a group."""
    group = np.cumsum(new)
    span = float(np.ptp(values)) + 1.0 if len(values) else 1.0
    return np.asarray(np.maximum.accumulate(values + group * span) - group * span, np.float64)


def _unbroken(good: Booleans, new: Booleans) -> Booleans:
    """Return which values are before the first one of their group that is not good."""
    bad: Integers = np.cumsum(~good)
    first = np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))
    return np.asarray(bad == bad[first] - (~good)[first], np.bool_)
