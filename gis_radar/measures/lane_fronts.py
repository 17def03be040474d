"""Fronts of vehicles along lanes: crossings of lines, and times and distances driven.

Tracks hold a state each 0.2 s. A vehicle is taken to drive evenly in between, so the moment at
which its front crosses a line is interpolated. For a lane of length L, seen for a time T, Edie's
definitions (L. C. Edie, Discussion of traffic stream measurements and definitions, 1963) sum over
all vehicles in it: flow q = sum of distances / (L T), density k = sum of times / (L T), space-mean
speed u = q / k = sum of distances / sum of times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Booleans, Floats, Integers
from gis_radar.measures.lane_network import LaneNetwork

# By how much the rest of a lane, or the place on the next one, may exceed the distance driven.
_FOLLOWS_M = 2.0
STOPPED_MPS = 5.0 / 3.6  # a vehicle stands when it is slower (HCM, ch. 31, for stops) ...
SLOW_STEPS = STEPS_PER_SECOND  # ... for this time


@dataclass(frozen=True, kw_only=True)
class StepGrid:
    """Equal intervals of steps, one after the other.

    Parameters
    ----------
    begin : int
        First step.
    steps : int
        Number of steps in each interval.
    count : int
        Number of intervals.
    """

    begin: int
    steps: int
    count: int

    @property
    def end(self) -> int:
        """First step after the last interval."""
        return self.begin + self.steps * self.count

    def of(self, step: Integers) -> Integers:
        """Return the number of the interval of each step; all steps lie in the grid."""
        return (step - self.begin) // self.steps


@dataclass(frozen=True, kw_only=True, eq=False)
class VisibleRuns:
    """Runs of steps in which tiles are visible.

    Parameters
    ----------
    tile_id, first, last : (n,) int64 arrays
        Disjoint runs of steps, sorted by tile and step.
    """

    tile_id: Integers
    first: Integers
    last: Integers

    @cached_property
    def _room(self) -> tuple[int, int]:
        """First step, and number of steps that a tile takes on the common axis of all tiles."""
        if not len(self.first):
            return 0, 1
        return int(self.first.min()), int(self.last.max() - self.first.min()) + 2

    @cached_property
    def _axis(self) -> tuple[Integers, Integers, Integers]:
        """Tiles, and first and last steps of runs on the common axis."""
        begin, room = self._room
        tiles, at = np.unique(self.tile_id, return_inverse=True)
        return tiles, at * room + self.first - begin, at * room + self.last - begin

    def at(self, tile_id: Integers, step: Integers) -> Booleans:
        """Return whether each tile is visible in its step."""
        return self._run(tile_id, step) >= 0

    def throughout(self, tile_id: Integers, first: Integers, last: Integers) -> Booleans:
        """Return whether each tile is visible in all steps from a first to a last one."""
        _, begins, ends = self._axis
        stretch = np.cumsum(np.append(True, begins[1:] != ends[:-1] + 1)[: len(begins)])
        first_run, last_run = self._run(tile_id, first), self._run(tile_id, last)
        known = (first_run >= 0) & (last_run >= 0)
        return np.asarray(
            known & (np.append(stretch, 0)[first_run] == np.append(stretch, 0)[last_run])
        )

    def _run(self, tile_id: Integers, step: Integers) -> Integers:
        """Return the run of each tile that holds a step; -1 where it is not visible."""
        tiles, first, last = self._axis
        if not len(first):
            return np.full(len(step), -1, np.int64)
        begin, room = self._room
        place = np.minimum(np.searchsorted(tiles, tile_id), len(tiles) - 1)
        inside = (step >= begin) & (step < begin + room - 1)
        key = place * room + np.clip(step - begin, 0, room - 2)
        run = np.maximum(np.searchsorted(first, key, side="right") - 1, 0)
        hit = (first[run] <= key) & (key <= last[run]) & inside & (tiles[place] == tile_id)
        return np.where(hit, run, -1)


@dataclass(frozen=True, kw_only=True, eq=False)
class VehicleTable:
    """Lengths and probabilities of vehicles.

    Parameters
    ----------
    vehicle : (n,) int64 array
        Numbers of vehicles, ascending; all vehicles of the states are among them.
    length_m, p_heavy, p_exists : (n,) arrays
        Length; probabilities that it is heavy, and that it exists (NaN: unknown).
    """

    vehicle: Integers
    length_m: Floats
    p_heavy: Floats
    p_exists: Floats

    def of(self, vehicle: Integers) -> Integers:
        """Return the rows of vehicles."""
        return np.asarray(np.searchsorted(self.vehicle, vehicle), np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class FrontStates:
    """States of the fronts of vehicles, by vehicle and step.

    Parameters
    ----------
    vehicle, step : (n,) int64 arrays
        Number of the vehicle, and the step at whose begin it has the state.
    lane : (n,) int64 array
        Position of the lane, -1 off the lanes.
    along_m : (n,) array
        Place of the front along the lane, metres; NaN off the lanes.
    speed : (n,) array
        Speed, m/s.
    seen : (n,) bool array
        Whether the vehicle was measured within 0.5 s; else the state is inferred.
    """

    vehicle: Integers
    step: Integers
    lane: Integers
    along_m: Floats
    speed: Floats
    seen: Booleans

    @cached_property
    def pairs(self) -> Integers:
        """Rows whose next row is the next state of the same vehicle."""
        return np.flatnonzero(self.vehicle[1:] == self.vehicle[:-1])

    def moves(self, network: LaneNetwork) -> Moves:
        """Return the moves of vehicles between consecutive states."""
        i, j = self.pairs, self.pairs + 1
        lane_before, lane_after = self.lane[i], self.lane[j]
        driven = (self.speed[i] + self.speed[j]) / 2.0 * (self.step[j] - self.step[i]) * STEP_S
        same = (lane_before == lane_after) & (lane_before >= 0)
        left = network.length_m[lane_before] - self.along_m[i]
        with np.errstate(invalid="ignore"):
            follows = (lane_before != lane_after) & (lane_before >= 0) & (lane_after >= 0)
            follows &= (left <= driven + _FOLLOWS_M) & (self.along_m[j] <= driven + _FOLLOWS_M)
        before = np.where(same, self.along_m[i], self.along_m[j] - driven)
        return Moves(same, follows, np.where(follows, -left, before), left, driven)

    def standing(self) -> tuple[Booleans, Booleans]:
        """Return the states in which vehicles stand, and those in which they stop.

        Returns
        -------
        stands : (n,) bool array
            Whether the vehicle stands in the state: it has been slow for 1 s.
        stops : (n,) bool array
            Whether it begins to stand in the state; a vehicle that is slow from its first state on
            does not stop.
        """
        slow = self.speed < STOPPED_MPS
        new = np.ones(len(slow), np.bool_)
        new[1:] = np.diff(self.vehicle) != 0
        begins = new.copy()
        begins[1:] |= slow[1:] != slow[:-1]
        run = np.maximum.accumulate(np.where(begins, np.arange(len(slow)), 0))
        stands = slow & (self.step - self.step[run] >= SLOW_STEPS)
        stops = stands & ~new[run]
        stops[1:] &= ~stands[:-1] | new[1:]
        return stands, stops


class Moves(NamedTuple):
    """Moves of vehicles between two states, a row for each of :attr:`FrontStates.pairs`.

    Parameters
    ----------
    same, follows : (k,) bool arrays
        Whether the lane stays the same, and whether it changes to one that follows it; neither for
        a change to a lane beside, and off the lanes.
    before_m : (k,) array
        Place of the first state along the lane of the second one, m; negative before it begins.
    left_m : (k,) array
        Distance from the first state to the end of its lane, m.
    driven_m : (k,) array
        Distance driven, by the speeds, m.
    """

    same: Booleans
    follows: Booleans
    before_m: Floats
    left_m: Floats
    driven_m: Floats


class Crossings(NamedTuple):
    """Crossings of lanes' lines by fronts, one for each vehicle and lane, sorted by both.

    Parameters
    ----------
    row : (k,) int64 array
        Row of the last state before the crossing.
    vehicle, lane, step : (k,) int64 arrays
        Number of the vehicle, position of the lane, and the step of the crossing.
    speed : (k,) array
        Speed, m/s.
    seen : (k,) bool array
        Whether the vehicle was measured at the state after the crossing.
    """

    row: Integers
    vehicle: Integers
    lane: Integers
    step: Integers
    speed: Floats
    seen: Booleans

    def take(self, which: Booleans | Integers | slice) -> Crossings:
        """Return the crossings that a mask, their positions or a slice choose."""
        return Crossings._make(each[which] for each in self)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedLanes:
    """Lanes, the vehicles on them, and the tiles that were visible, over a grid of intervals.

    Parameters
    ----------
    network : LaneNetwork
        The lanes.
    grid : StepGrid
        The intervals; those of one hour for a dataset.
    states : FrontStates
        States of all vehicles in the intervals; earlier states of the same vehicles may precede.
    vehicles : VehicleTable
        The vehicles.
    visible, observed : VisibleRuns
        Runs in the grid in which tiles are visible, and in which sensors observe them.
    """

    network: LaneNetwork
    grid: StepGrid
    states: FrontStates
    vehicles: VehicleTable
    visible: VisibleRuns
    observed: VisibleRuns

    @property
    def cells(self) -> int:
        """Number of pairs of a lane and an interval; sums are in this order."""
        return len(self.network.lane) * self.grid.count

    @cached_property
    def line_tile_id(self) -> Integers:
        """Ids of the tiles at the lanes' lines."""
        every = np.arange(len(self.network.lane))
        return self.network.tile_id[self.network.tile_at(every, self.network.line_m)]

    @cached_property
    def queue_tile_id(self) -> Integers:
        """Ids of the tiles at the lines of queues, where there are none at the lanes' lines."""
        line_m = self.network.queue_line_m
        line_m = np.where(np.isnan(line_m), self.network.line_m, line_m)
        return self.network.tile_id[self.network.tile_at(np.arange(len(line_m)), line_m)]

    @cached_property
    def length_m(self) -> Floats:
        """Length of the vehicle of each state, metres."""
        return self.vehicles.length_m[self.vehicles.of(self.states.vehicle)]

    @cached_property
    def in_grid(self) -> Booleans:
        """Whether each state is in the grid."""
        return (self.states.step >= self.grid.begin) & (self.states.step < self.grid.end)

    @cached_property
    def standing(self) -> tuple[Booleans, Booleans]:
        """Whether each vehicle stands in its states, and whether it stops."""
        return self.states.standing()

    @cached_property
    def moves(self) -> Moves:
        """Moves of the vehicles between their states."""
        return self.states.moves(self.network)

    @cached_property
    def crossings(self) -> Crossings:
        """Crossings of the lanes' lines within the grid, visible or not."""
        return _crossings(self)

    @property
    def visible_crossings(self) -> Crossings:
        """Those of them at which the line is visible."""
        return self.crossings.take(self._while(self.visible))

    @property
    def observed_crossings(self) -> Crossings:
        """Those of them at which the line is observed, although it may be hidden by vehicles."""
        return self.crossings.take(self._while(self.observed) | self._while(self.visible))

    def _while(self, runs: VisibleRuns) -> Booleans:
        """Return the crossings during runs of the tiles at their lines."""
        return runs.at(self.line_tile_id[self.crossings.lane], self.crossings.step)

    def cell_of(self, lane: Integers, step: Integers) -> Integers:
        """Return the cell of each pair of a lane and a step in the grid."""
        return lane * self.grid.count + self.grid.of(step)


def _crossings(lanes: TrackedLanes) -> Crossings:
    """Find the fronts that cross the line of a lane within the grid.

    A vehicle that changes lanes while it crosses counts on the lane that it reaches. Vehicles that
    have crossed by their states before the grid do not count again; a crossing between the last of
    these states and the grid's first step counts in that step.
    """
    states, moves, grid = lanes.states, lanes.moves, lanes.grid
    i, line_m = states.pairs, lanes.network.line_m
    lane_before, lane_after = states.lane[i], states.lane[i + 1]
    line_before, line_after = line_m[lane_before], line_m[lane_after]
    reached = states.along_m[i + 1]
    with np.errstate(invalid="ignore"):
        crosses_before = moves.follows & (states.along_m[i] < line_before)
        crosses_after = (lane_after >= 0) & (moves.before_m < line_after) & (line_after <= reached)
        share_before = (line_before - states.along_m[i]) / np.maximum(moves.left_m + reached, 1e-9)
        share_after = (line_after - moves.before_m) / np.maximum(reached - moves.before_m, 1e-9)
    parts = ((crosses_before, lane_before, share_before), (crosses_after, lane_after, share_after))
    k = np.concatenate([np.flatnonzero(flag) for flag, _, _ in parts])
    lane = np.concatenate([of[flag] for flag, of, _ in parts])
    between = np.concatenate([share[flag] for flag, _, share in parts])
    first, last = states.step[i[k]], states.step[i[k] + 1]
    time = first + between * (last - first)
    order = np.lexsort((time, lane, states.vehicle[i[k]]))
    k, lane, between, time, last = (each[order] for each in (k, lane, between, time, last))
    row = i[k]
    speed = states.speed[row] + between * (states.speed[row + 1] - states.speed[row])
    new = np.ones(len(k), np.bool_)
    new[1:] = (np.diff(states.vehicle[row]) != 0) | (np.diff(lane) != 0)
    step = np.clip(np.floor(time).astype(np.int64), grid.begin, np.maximum(last - 1, grid.begin))
    all_crossings = Crossings(row, states.vehicle[row], lane, step, speed, states.seen[row + 1])
    return all_crossings.take(new & (last >= grid.begin) & (step < grid.end))


def driven(lanes: TrackedLanes) -> tuple[Floats, Floats]:
    """Sum the times and distances of all vehicles, for Edie's definitions.

    The distance between two states belongs to the lane of the first; where the vehicle drives on to
    a following lane, it is split where that begins. A vehicle's last state lasts one step.

    Returns
    -------
    seconds, metres : (lanes * intervals,) arrays
        Sums over all vehicles, while their fronts are on visible tiles, by lane and interval.
    """
    states, grid, network = lanes.states, lanes.grid, lanes.network
    last = np.ones(len(states.step), np.bool_)
    last[states.pairs] = False
    last[states.pairs] |= states.step[states.pairs + 1] >= grid.end
    i, end = states.pairs, np.flatnonzero(last)
    goes_on = ~last[i]
    i, moves = i[goes_on], Moves._make(each[goes_on] for each in lanes.moves)
    share = moves.left_m / np.maximum(moves.left_m + states.along_m[i + 1], 1e-9)
    share = np.where(moves.follows, np.nan_to_num(share), 1.0)
    steps = (states.step[i + 1] - states.step[i]).astype(np.float64)
    metres = np.where(moves.same, states.along_m[i + 1] - states.along_m[i], moves.driven_m)
    metres = np.where(moves.follows, moves.left_m, metres)
    follows = moves.follows
    lane = np.concatenate([states.lane[i], states.lane[i + 1][follows], states.lane[end]])
    along = np.concatenate([states.along_m[i], np.zeros(follows.sum()), states.along_m[end]])
    step = np.concatenate([states.step[i], states.step[i + 1][follows] - 1, states.step[end]])
    duration = np.concatenate([steps * share, (steps * (1.0 - share))[follows], np.ones(len(end))])
    distance = np.concatenate([metres, states.along_m[i + 1][follows], states.speed[end] * STEP_S])
    in_grid = (lane >= 0) & (step >= grid.begin) & (step < grid.end)
    lane, along, step, duration, distance = (
        each[in_grid] for each in (lane, along, step, duration, distance)
    )
    seen = lanes.visible.at(network.tile_id[network.tile_at(lane, along)], step)
    cell, size = lanes.cell_of(lane, step)[seen], lanes.cells
    seconds = np.bincount(cell, duration[seen] * STEP_S, size).astype(np.float64)
    return seconds, np.bincount(cell, distance[seen], size).astype(np.float64)
