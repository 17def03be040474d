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


class StandingStates(NamedTuple):
    """States in which vehicles stand or stop.

    Parameters
    ----------
    stands : (n,) bool array
        Whether the vehicle stands in the state: it has been slow for 1 s.
    stops : (n,) bool array
        Whether it begins to stand in the state; a vehicle that is slow from its first state on does
        not stop.
    """

    stands: Booleans
    stops: Booleans


def standing_states(states: FrontStates) -> StandingStates:
    """Return the states in which vehicles stand, and those in which they stop."""
    slow = states.speed < SLOW_MPS
    new = np.ones(len(slow), np.bool_)
    new[1:] = np.diff(states.vehicle) != 0
    begins = new.copy()
    begins[1:] |= slow[1:] != slow[:-1]
    run = np.maximum.accumulate(np.where(begins, np.arange(len(slow)), 0))
    stands = slow & (states.step - states.step[run] >= SLOW_STEPS)
    stops = stands & ~new[run]
    stops[1:] &= ~stands[:-1] | new[1:]
    return StandingStates(stands, stops)


class QueueBacks(NamedTuple):
    """Lengths of queues from the stop line to the back, by cells of lane and interval.

    Parameters
    ----------
    most_m : (cells,) array
        Greatest length, m; 0 without a queue.
    sum_m : (cells,) array
        Sum of the lengths, m, over all steps divisible by `LOOK_STEPS` with a visible stop line.
    """

    most_m: Floats
    sum_m: Floats


def queues(
    states: FrontStates, stands: Booleans, length_m: Floats, network: LaneNetwork,
    visible: VisibleRuns, grid: StepGrid,
) -> QueueBacks:  # fmt: skip
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
    """
    size = len(network.lane) * grid.count
    strips = network.queue_strips()
    looked = stands & (states.lane >= 0) & (states.step % LOOK_STEPS == 0)
    row = np.flatnonzero(looked & (states.step >= grid.begin) & (states.step < grid.end))
    low = np.searchsorted(strips.lane, states.lane[row])
    count = np.searchsorted(strips.lane, states.lane[row], side="right") - low
    at, row = ranges(low, count), np.repeat(row, count)
    stop, step = strips.stop_lane[at], states.step[row]
    front = strips.to_line_m[at] - states.along_m[row]
    order = np.lexsort((front, step, stop))
    order = order[front[order] >= -OVER_LINE_M]
    stop, step, front = stop[order], step[order], front[order]
    rear = front + length_m[row[order]]
    new = np.ones(len(stop), np.bool_)
    new[1:] = (np.diff(stop) != 0) | (np.diff(step) != 0)
    reach = _farthest(rear, new)  # a lorry may reach farther back than a car whose front is behind
    ahead = np.where(new, 0.0, np.concatenate([[0.0], reach])[: len(reach)])
    gap = front - ahead
    wide = np.flatnonzero(gap > JOINED_M)
    gap[wide] = _visible_m(stop[wide], step[wide], ahead[wide], front[wide], network, visible)
    joined = _unbroken(gap <= JOINED_M, new)
    line = network.tile_id[network.tile_at(stop, network.line_m[stop])]
    joined &= visible.at(line, step)
    stop, step, rear = stop[joined], step[joined], rear[joined]
    first = np.flatnonzero(new[joined])
    back = np.maximum.reduceat(rear, first) if len(first) else rear  # it takes no empty array
    cell = stop[first] * grid.count + grid.of(step[first])
    most = np.zeros(size)
    np.maximum.at(most, cell, back)
    return QueueBacks(most, np.bincount(cell, back, size).astype(np.float64))


def _visible_m(
    stop: Integers, step: Integers, near_m: Floats, far_m: Floats, network: LaneNetwork,
    visible: VisibleRuns,
) -> Floats:  # fmt: skip
    """Return the visible metres before stop lines, between two distances in a step."""
    strips = network.queue_strips()
    order = np.lexsort((strips.to_line_m, strips.stop_lane))
    lane, line, to_line = strips.lane[order], strips.stop_lane[order], strips.to_line_m[order]
    count = np.ceil(far_m - near_m).astype(np.int64)
    row = np.repeat(np.arange(len(stop)), count)
    metre = near_m[row] + ranges(np.zeros(len(stop), np.int64), count) + 0.5
    metre = np.minimum(metre, far_m[row])  # beyond it the lanes may end
    span = float(to_line.max(initial=0.0)) + 1.0
    # the lane that begins nearest upstream of the place
    at = np.searchsorted(line * span + to_line, stop[row] * span + metre)
    at = np.minimum(at, len(lane) - 1)
    tile = network.tile_id[network.tile_at(lane[at], to_line[at] - metre)]
    seen = visible.at(tile, step[row])
    return np.bincount(row, seen, len(stop)).astype(np.float64)


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
    backs = queues(states, standing_states(states).stands, length_m, network, visible, grid)
    begin = grid.begin + np.arange(grid.count) * grid.steps
    line = network.tile_id[network.tile_at(np.array([stop]), network.line_m[[stop]])]
    known = visible.at(np.repeat(line, grid.count), begin)
    back = backs.most_m.reshape(-1, grid.count)[stop]
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
    strips, to_line = network.queue_strips(), np.full(len(network.lane), np.nan)
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
