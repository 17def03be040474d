"""Standing vehicles, and the queues that they form at stop lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from gis_radar.base import Booleans, Floats, Integers, ranges
from gis_radar.measures.lane_fronts import StepGrid, TrackedLanes
from gis_radar.measures.lane_network import JOINED_M, LaneNetwork

_SHORTEST_CAR_M = 3.5  # length: no car fits into less road
OVER_LINE_M = 2.0  # how far the front of a waiting vehicle may be over the line
# Queues are measured at steps divisible by this: all tracks have a state there.
QUEUE_EVERY_STEPS = 4


def queue_backs(standing: StandingFronts, lanes: TrackedLanes) -> tuple[Floats, Floats]:
    """Find the queues at stop lines: standing vehicles, from the line back, up to a gap.

    Returns
    -------
    most_m : (cells,) array
        Greatest length by lane and interval, from the stop line to the back, m; 0 without a queue.
    sum_m : (cells,) array
        Sum of the lengths, m, over the steps of :func:`queue_steps` with a visible stop line.
    """
    grid = lanes.grid
    interval = grid.of(queue_steps(grid))
    most, total = np.zeros((2, len(lanes.network.lane), grid.count))
    for stop in np.flatnonzero(np.isfinite(lanes.network.queue_line_m)).tolist():
        back_m = queue_back(stop, standing, lanes)
        np.maximum.at(most[stop], interval, back_m)
        total[stop] = np.bincount(interval, back_m, grid.count)
    return most.ravel(), total.ravel()


def blocked_shares(standing: StandingFronts, lanes: TrackedLanes) -> Floats:
    """Return the shares of intervals in which a vehicle stands at a hidden line, by cells.

    While it stands over the line, or so close before it that no car fits between, none crosses.
    """
    network, grid = lanes.network, lanes.grid
    beyond_m = standing.along_m - network.line_m[standing.lane]
    at_line = (beyond_m > -_SHORTEST_CAR_M) & (beyond_m < standing.length_m)
    pairs = np.stack([standing.lane, standing.step])[:, at_line]
    lane, step = np.unique(pairs, axis=1)
    tile = lanes.line_tile_id[lane]
    is_hidden = lanes.observed.at(tile, step) & ~lanes.visible.at(tile, step)
    count = np.bincount(lanes.cell_of(lane[is_hidden], step[is_hidden]), minlength=lanes.cells)
    return np.asarray(count * QUEUE_EVERY_STEPS / grid.steps, np.float64)


def queue_steps(grid: StepGrid) -> Integers:
    """Return the steps of a grid at which queues are measured."""
    return np.arange(
        -(-grid.begin // QUEUE_EVERY_STEPS) * QUEUE_EVERY_STEPS, grid.end, QUEUE_EVERY_STEPS
    )


class StandingFronts(NamedTuple):
    """States in which vehicles stand, sorted by lane and step, those ahead first.

    Parameters
    ----------
    lane, step : (n,) int64 arrays
        Position of the lane, and step, divisible by `QUEUE_EVERY_STEPS`.
    along_m, length_m : (n,) arrays
        Place of the front along the lane, and length of the vehicle, m.
    """

    lane: Integers
    step: Integers
    along_m: Floats
    length_m: Floats

    @classmethod
    def of(cls, lanes: TrackedLanes) -> StandingFronts:
        """Return the standing states on lanes within the grid."""
        states = lanes.states
        is_measured = (states.lane >= 0) & (states.step % QUEUE_EVERY_STEPS == 0)
        row = np.flatnonzero(lanes.standing[0] & is_measured & lanes.in_grid)
        row = row[np.lexsort((-states.along_m[row], states.step[row], states.lane[row]))]
        return cls(states.lane[row], states.step[row], states.along_m[row], lanes.length_m[row])


def queue_back(stop: int, standing: StandingFronts, lanes: TrackedLanes) -> Floats:
    """Return how far back from a stop line a queue reaches, m, at the steps of :func:`queue_steps`.

    Where lanes merge before the line, each has its own queue upstream: vehicles on one of them do
    not continue the queue on the other. The longest counts.

    Parameters
    ----------
    stop : int
        Position of its lane.
    standing : StandingFronts
        The standing vehicles of the grid.
    lanes : TrackedLanes
        All vehicles.
    """
    strips, look_steps = lanes.network.queue_strips, queue_steps(lanes.grid)
    # by strip: how far back the queue reaches, and whether no gap has ended it
    reached = {-1: (np.zeros(len(look_steps)), np.ones(len(look_steps), np.bool_))}
    for strip in strips.of_stop(stop):
        reach, is_open = reached[strip] = reached[int(strips.ahead[strip])]
        lane = strips.lane[strip]
        on_lane = slice(*np.searchsorted(standing.lane, [lane, lane + 1]))
        front = strips.to_line_m[strip] - standing.along_m[on_lane]
        is_behind = front >= -OVER_LINE_M
        if not is_behind.any():
            continue
        step, front, rear = (
            each[is_behind]
            for each in (standing.step[on_lane], front, front + standing.length_m[on_lane])
        )
        index, new = np.searchsorted(look_steps, step), np.diff(step, prepend=-1) != 0
        farthest = _running_maximum(rear, new)  # a lorry may end farther back than the car behind
        ahead = np.maximum(reach[index], np.where(new, 0.0, np.append(0.0, farthest[:-1])))
        may_join = joins(strip, step, ahead, front, lanes) & is_open[index]
        joined = _unbroken(may_join, new)
        reach, is_open = reached[strip] = reach.copy(), is_open.copy()
        np.maximum.at(reach, index[joined], rear[joined])
        is_open[index[~joined]] = False
    back = np.max([reach for reach, _ in reached.values()], axis=0)
    line = np.repeat(lanes.queue_tile_id[stop], len(look_steps))
    return np.where(lanes.visible.at(line, look_steps), back, 0.0)


def joins(
    strip: int, step: Integers, reach_m: Floats, front_m: Floats, lanes: TrackedLanes
) -> Booleans:
    """Return which standing vehicles join a queue: no gap over `JOINED_M` lies between.

    Road that vehicles hide is no gap. Road that no sensor has in sight is one: what stands there is
    not known, however many vehicles stand beyond.

    Parameters
    ----------
    strip : int
        Strip of :attr:`LaneNetwork.queue_strips` on which they stand.
    step : (n,) int64 array
        Steps.
    reach_m, front_m : (n,) arrays
        Metres to the line: how far back the queue reaches, and the front of the vehicle.
    lanes : TrackedLanes
        All vehicles.
    """
    gap = front_m - reach_m
    wide = np.flatnonzero(gap > JOINED_M)
    if len(wide):
        gap[wide] = _not_hidden_m(strip, step[wide], reach_m[wide], front_m[wide], lanes)
    return np.asarray(gap <= JOINED_M, np.bool_)


def _not_hidden_m(
    strip: int, step: Integers, near_m: Floats, far_m: Floats, lanes: TrackedLanes
) -> Floats:
    """Return the metres that no vehicle hides between two distances to the line, from a strip."""
    network = lanes.network
    path = network.queue_strips.path_to(strip)
    lane, to_line = network.queue_strips.lane[path], network.queue_strips.to_line_m[path]
    count = np.ceil(far_m - near_m).astype(np.int64)
    row = np.repeat(np.arange(len(step)), count)
    metre = near_m[row] + ranges(np.zeros(len(step), np.int64), count) + 0.5
    metre = np.minimum(metre, far_m[row])  # beyond it the lanes may end
    at = np.minimum(np.searchsorted(to_line, metre), len(lane) - 1)
    tile = network.tile_id[network.tile_at(lane[at], to_line[at] - metre)]
    is_hidden = lanes.observed.at(tile, step[row]) & ~lanes.visible.at(tile, step[row])
    return np.bincount(row, ~is_hidden, len(step)).astype(np.float64)


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


def queue_course(stop: int, lanes: TrackedLanes) -> QueueCourse:
    """Follow the queue at one stop line over the intervals of the grid.

    Parameters
    ----------
    stop : int
        Position of its lane.
    lanes : TrackedLanes
        All vehicles.
    """
    network, grid, states, visible = lanes.network, lanes.grid, lanes.states, lanes.visible
    to_line, to_stop = _lanes_to_line_m(stop, network), to_stop_line(stop, lanes)
    row = np.flatnonzero(lanes.in_grid & np.isfinite(to_stop))
    back_m = np.zeros(grid.count)
    at_steps = queue_back(stop, StandingFronts.of(lanes), lanes)
    np.maximum.at(back_m, grid.of(queue_steps(grid)), at_steps)
    begin = grid.begin + np.arange(grid.count) * grid.steps
    line_visible = visible.at(np.repeat(lanes.queue_tile_id[stop], grid.count), begin)
    place = pd.Series(np.arange(len(network.tile_id)), network.tile_id)
    tile = place.reindex(visible.tile_id).to_numpy()
    run = np.flatnonzero(np.isfinite(to_line[network.tile_lane[tile]]))
    run = run[(visible.first[run] < grid.end) & (visible.last[run] >= grid.begin)]
    far = to_line[network.tile_lane[tile[run]]] - network.tile_m[tile[run]]
    near = far - network.tile_length_m[tile[run]]
    return QueueCourse(
        states.vehicle[row], states.step[row],
        to_stop[row], begin, np.where(line_visible, back_m, np.nan),
        np.column_stack([visible.first[run], visible.last[run] + 1, near, far]).astype(np.float64),
    )  # fmt: skip


def to_stop_line(stop: int, lanes: TrackedLanes) -> Floats:
    """Return the metres from fronts to the stop line of a lane; NaN where no queue at it stands."""
    to_line = _lanes_to_line_m(stop, lanes.network)
    to_line = np.append(to_line, np.nan)  # the last for -1, off the lanes
    return np.asarray(to_line[lanes.states.lane] - lanes.states.along_m, np.float64)


def _lanes_to_line_m(stop: int, network: LaneNetwork) -> Floats:
    """Return the metres from the begin of each lane to a stop line; NaN off its strips."""
    strips, to_line = network.queue_strips, np.full(len(network.lane), np.nan)
    of_stop = strips.stop_lane == stop
    to_line[strips.lane[of_stop]] = strips.to_line_m[of_stop]
    return to_line


def _running_maximum(values: Floats, new: Booleans) -> Floats:
    """Return, for each value, the greatest one of its group up to it; `new` begins a group."""
    group = np.cumsum(new)
    span = float(np.ptp(values)) + 1.0 if len(values) else 1.0
    return np.asarray(np.maximum.accumulate(values + group * span) - group * span, np.float64)


def _unbroken(good: Booleans, new: Booleans) -> Booleans:
    """Return which values are before the first one of their group that is not good."""
    bad: Integers = np.cumsum(~good)
    first = np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))
    return np.asarray(bad == bad[first] - (~good)[first], np.bool_)
