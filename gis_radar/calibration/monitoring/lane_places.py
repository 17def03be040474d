"""Lateral offset and height of vehicles in their lanes, averaged by cells along the lanes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.calibration.registration.lanes import Lanes
from gis_radar.calibration.registration.matches import match_along
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import NONE, Moving, link_tracks, straight_line

# Length of a cell, over which a vehicle's offset is averaged, and of a stretch, on which obstacles
# (a parked van, a cyclist) change the offsets of all drivers.
CELL_M = 12.0
STRETCH_M = 48.0
# Lane samples are left out where another lane of the same direction is between SAME_LINE_M and
# APART_M away: a vehicle may be on either. Nearer ones are the same line.
APART_M = 2.2
SAME_LINE_M = 0.3
SAME_DIRECTION = 0.9  # least cosine between lanes of one direction, 25 degrees
WITHIN_M = 1.75  # half a lane: largest distance of a vehicle from the middle of its lane
OVER_M = (-2.0, 5.0)  # lowest and highest reflections of vehicles over the road
HALF_WIDTH_M = 0.9  # half width of a vehicle, as in the localization
LEAST_MPS = 2.7  # slower objects may be walkers
SMOOTH_S = 1.0  # tracks are smoothed by straight lines over this time before and after a detection
WHOLE_S = 1e6  # longer than any window: tracks are not cut, so that each vehicle is one cluster
LEAST_HITS = 3  # least number of detections of a vehicle in a cell


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Sections of lanes of `CELL_M`, over which the offsets of a vehicle are averaged.

    Parameters
    ----------
    lanes : Lanes
        The samples of centre lines from which the cells are made.
    of_sample : (m,) array
        The cell of each lane sample; -1 where lanes of one direction overlap.
    centre, left : (c, 2) arrays
        Middle of each cell, local coordinates, metres, and unit vector to the left of travel.
    stretch : (c,) array
        Number of the stretch of each cell, from 0.
    """

    lanes: Lanes
    of_sample: Integers
    centre: Floats
    left: Floats
    stretch: Integers

    def __len__(self) -> int:
        return len(self.stretch)


def cells_along(lanes: Lanes) -> Cells:
    """Cut lanes into cells and stretches.

    Parameters
    ----------
    lanes : Lanes
        The lanes around a sensor.
    """
    separate = ~_near_other_lane(lanes)
    sections = [(lanes.s_m // size).astype(np.int64) for size in (CELL_M, STRETCH_M)]
    cell, stretch = (
        np.unique(np.column_stack([lanes.lane, piece]), axis=0, return_inverse=True)[1].ravel()
        for piece in sections
    )
    numbers, number_of = np.unique(cell[separate], return_inverse=True)
    of_sample = np.full(len(separate), NONE, dtype=np.int64)
    of_sample[separate] = number_of
    count = np.maximum(np.bincount(number_of, minlength=len(numbers)), 1)
    means = [
        np.bincount(number_of, values[separate], minlength=len(numbers)) / count
        for values in (*lanes.points[:, :2].T, *lanes.along.T)
    ]
    along = np.column_stack(means[2:])
    along /= np.hypot(*along.T)[:, None]
    first = np.unique(number_of, return_index=True)[1]
    _, stretch_number = np.unique(stretch[separate][first], return_inverse=True)
    return Cells(
        lanes=lanes,
        of_sample=of_sample,
        centre=np.column_stack(means[:2]),
        left=np.column_stack([-along[:, 1], along[:, 0]]),
        stretch=stretch_number,
    )


def _near_other_lane(lanes: Lanes) -> Booleans:
    """Return which samples have a lane of their direction between `SAME_LINE_M` and `APART_M`."""
    pairs = cKDTree(lanes.points[:, :2]).query_pairs(APART_M, output_type="ndarray")
    overlapped = np.zeros(len(lanes.points), dtype=bool)
    offset = lanes.points[pairs[:, 1], :2] - lanes.points[pairs[:, 0], :2]
    direction = lanes.along[pairs[:, 0]]
    parallel = np.sum(direction * lanes.along[pairs[:, 1]], axis=1) > SAME_DIRECTION
    across = np.abs(offset[:, 1] * direction[:, 0] - offset[:, 0] * direction[:, 1])
    overlapped[pairs[parallel & (across > SAME_LINE_M)].ravel()] = True
    return overlapped


@dataclass(frozen=True, kw_only=True)
class LanePlaces:
    """Offsets of vehicles in their lanes: a row for each vehicle and cell.

    Parameters
    ----------
    vehicle : (n,) array
        Number of the vehicle, ascending from 0.
    cell : (n,) array
        Index of the cell in :class:`Cells`.
    across_m : (n,) array
        Mean distance of the detections to the left of the lane's middle.
    over_m : (n,) array
        Mean height of the detections over the road; NaN where the road's height is not known.
    count : (n,) array
        Number of detections.
    """

    vehicle: Integers
    cell: Integers
    across_m: Floats
    over_m: Floats
    count: Integers

    def __len__(self) -> int:
        return len(self.cell)

    @property
    def vehicles(self) -> int:
        """Number of vehicles."""
        return int(self.vehicle.max(initial=NONE)) + 1


def lane_places(
    moving: Moving,
    cells: Cells,
    state: State,
    *,
    since: float,
    until: float,
) -> LanePlaces:
    """Return the offsets of the vehicles whose last detection is within a span of time.

    Parameters
    ----------
    moving : Moving
        A window that holds this span and the time before.
    cells : Cells
        The lanes.
    state : State
        The pose with which detections are placed.
    since, until : float
        Begin and end of the span, UNIX seconds; the end is exclusive.
    """
    track = link_tracks(moving, segment_s=WHOLE_S)
    last = np.full(int(track.max(initial=NONE)) + 1, -np.inf)
    np.maximum.at(last, track[track != NONE], moving.time[track != NONE])
    ended = (last >= since) & (last < until)
    rows = np.flatnonzero((track != NONE) & ended[track])
    rows = rows[np.argsort(track[rows], kind="stable")]
    track_of = track[rows]
    points = state.to_map(moving.points[rows])
    smooth, velocity = _smooth_tracks(track_of, moving.time[rows], points, moving.range_rate[rows])
    middle = _vehicle_middles(smooth, velocity, state.position)
    sample, across_m, over_m = _match_lanes(cells.lanes, middle, velocity, state.position)
    cell = np.where(sample == NONE, NONE, cells.of_sample[sample])
    on_lane = cell != NONE
    vehicle = track_of
    keys = np.column_stack([vehicle[on_lane], cell[on_lane]])
    pairs, of_pair, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    of_pair = of_pair.ravel()
    across_m, over_m = (
        np.bincount(of_pair, values[on_lane], minlength=len(pairs)) / np.maximum(count, 1)
        for values in (across_m, over_m)
    )
    enough = count >= LEAST_HITS
    return LanePlaces(
        vehicle=np.unique(pairs[enough, 0], return_inverse=True)[1],
        cell=pairs[enough, 1],
        across_m=across_m[enough],
        over_m=over_m[enough],
        count=count[enough],
    )


@compiled
def _smooth_tracks(  # pragma: no cover - compiled
    track: Integers, time: Floats, points: Floats, rate: Floats
) -> tuple[Floats, Floats]:
    """Return positions (n, 3) and velocities (n, 2) by straight lines through neighbours in time.

    Detections scatter over the width of a vehicle. Without smoothing, those that a move of the
    sensor shifts over the lane's edge would be left out, which would hide half of the move.
    """
    place, velocity = points.copy(), np.zeros((len(track), 2))
    low = high = 0
    for i in range(len(track)):
        while track[low] != track[i] or time[low] < time[i] - SMOOTH_S:
            low += 1
        high = max(high, i)
        while high < len(track) and track[high] == track[i] and time[high] <= time[i] + SMOOTH_S:
            high += 1
        known, middle, x, y, east, north, _ = straight_line(
            time, points, rate, low, high, time[low], time[i] + SMOOTH_S
        )
        if known > 3.0:
            velocity[i, 0], velocity[i, 1] = east, north
            place[i, 0] = x + east * (time[i] - middle)
            place[i, 1] = y + north * (time[i] - middle)
    return place, velocity


def _vehicle_middles(points: Floats, velocity: Floats, sensor: Floats) -> Floats:
    """Return detections shifted from the visible side of their vehicle to its middle, (n, 3).

    The shift is half of the width for vehicles seen from the side, and 0 from the front or rear.
    """
    offset = points[:, :2] - sensor[:2]
    along = velocity / np.maximum(np.hypot(*velocity.T), 1e-9)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    aside, ahead = (np.sum(offset * way, axis=1) for way in (left, along))
    share = aside / np.maximum(np.abs(aside) + np.abs(ahead), 1e-9)
    middles = points.copy()
    middles[:, :2] += HALF_WIDTH_M * share[:, None] * left
    return middles


def _match_lanes(
    lanes: Lanes, points: Floats, velocity: Floats, sensor: Floats
) -> tuple[Integers, Floats, Floats]:
    """Return each detection's lane sample (`NONE` off lanes), and its offset left and above, m."""
    speed = np.hypot(*velocity.T)
    direction = velocity / np.maximum(speed, 1e-9)[:, None]
    reach = np.linalg.norm(points - sensor, axis=1)
    matches = match_along(lanes, points, direction, speed, reach, least_cosine=SAME_DIRECTION)
    _, across, over = lanes.beside(matches.lane, points)
    low, high = OVER_M
    on_lane = matches.found & (speed > LEAST_MPS)
    on_lane &= (np.abs(across) < WITHIN_M) & ~((over < low) | (over > high))
    return np.where(on_lane, matches.lane, NONE), across, over
