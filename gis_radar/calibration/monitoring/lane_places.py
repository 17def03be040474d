"""Places of vehicles in their lanes, cell by cell along the lanes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.calibration.registration.lanes import Lanes
from gis_radar.calibration.registration.matches import match_along
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import NONE, Moving, link_tracks, straight_line

# Length of a cell, in which a vehicle's place is one number, and of a stretch, whose cells share
# what makes drivers change their habit (a parked van, a cyclist).
CELL_M = 12.0
STRETCH_M = 48.0
# Samples are left out where another lane of the same direction is between these distances: nearer
# than a lane's width, a vehicle may be on either; nearest, it is the same line.
APART_M = 2.2
SAME_LINE_M = 0.3
SAME_WAY = 0.9  # cosine of the largest angle between lanes of one direction, 25 degrees
WITHIN_M = 1.75  # half a lane: vehicles farther from its middle drive elsewhere
OVER_M = (-2.0, 5.0)  # heights over the road between which vehicles reflect
HALF_WIDTH_M = 0.9  # from a vehicle's side to its middle, as in the localization
LEAST_MPS = 2.7  # slower objects may be walkers
SMOOTH_S = 1.0  # velocities are slopes of the track over so long before and after a detection
WHOLE_S = 1e6  # longer than any window, so that tracks are not cut and a vehicle is one cluster
LEAST_HITS = 3  # with fewer detections a cell has no mean


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Pieces of lanes of `CELL_M`, in which a vehicle's place is one number.

    Parameters
    ----------
    lanes : Lanes
        The samples of centre lines from which the cells are made.
    of_sample : (m,) array
        The cell of each sample; -1 where lanes of one direction overlap.
    centre, left : (c, 2) arrays
        Middle of each cell in local coordinates, and the unit vector to the left of travel.
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
    alone = ~_overlapped(lanes)
    pieces = [(lanes.s_m // size).astype(np.int64) for size in (CELL_M, STRETCH_M)]
    cell, stretch = (
        np.unique(np.column_stack([lanes.lane, piece]), axis=0, return_inverse=True)[1].ravel()
        for piece in pieces
    )
    kept, of_kept = np.unique(cell[alone], return_inverse=True)
    of_sample = np.full(len(alone), NONE, dtype=np.int64)
    of_sample[alone] = of_kept
    count = np.maximum(np.bincount(of_kept, minlength=len(kept)), 1)
    mean = [
        np.bincount(of_kept, values[alone], minlength=len(kept)) / count
        for values in (*lanes.points[:, :2].T, *lanes.along.T)
    ]
    along = np.column_stack(mean[2:])
    along /= np.hypot(*along.T)[:, None]
    first = np.unique(of_kept, return_index=True)[1]
    _, number = np.unique(stretch[alone][first], return_inverse=True)
    return Cells(
        lanes=lanes,
        of_sample=of_sample,
        centre=np.column_stack(mean[:2]),
        left=np.column_stack([-along[:, 1], along[:, 0]]),
        stretch=number,
    )


def _overlapped(lanes: Lanes) -> Booleans:
    """Return which samples have another lane of their direction too near beside them."""
    pairs = cKDTree(lanes.points[:, :2]).query_pairs(APART_M, output_type="ndarray")
    found = np.zeros(len(lanes.points), dtype=bool)
    off = lanes.points[pairs[:, 1], :2] - lanes.points[pairs[:, 0], :2]
    way = lanes.along[pairs[:, 0]]
    alike = np.sum(way * lanes.along[pairs[:, 1]], axis=1) > SAME_WAY
    across = np.abs(off[:, 1] * way[:, 0] - off[:, 0] * way[:, 1])
    found[pairs[alike & (across > SAME_LINE_M)].ravel()] = True
    return found


@dataclass(frozen=True, kw_only=True)
class LanePlaces:
    """Places of vehicles in their lanes: a row for each vehicle and cell.

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
    """Return the places of those vehicles whose last detection falls into a span of time.

    Parameters
    ----------
    moving : Moving
        A window that holds this span and the time before.
    cells : Cells
        The lanes.
    state : State
        The pose by which detections are placed.
    since, until : float
        Begin and end of the span, UNIX seconds; the end is exclusive.
    """
    number = link_tracks(moving, segment_s=WHOLE_S)
    last = np.full(int(number.max(initial=NONE)) + 1, -np.inf)
    np.maximum.at(last, number[number != NONE], moving.time[number != NONE])
    ended = (last >= since) & (last < until)
    rows = np.flatnonzero((number != NONE) & ended[number])
    rows = rows[np.argsort(number[rows], kind="stable")]
    track = number[rows]
    points = state.to_map(moving.points[rows])
    smooth, velocity = _smoothed(track, moving.time[rows], points, moving.range_rate[rows])
    middle = _middles(smooth, velocity, state.position)
    sample, across_m, over_m = _on_lanes(cells.lanes, middle, velocity, state.position)
    cell = np.where(sample == NONE, NONE, cells.of_sample[sample])
    good = cell != NONE
    vehicle = track
    keys = np.column_stack([vehicle[good], cell[good]])
    pairs, of_pair, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    of_pair = of_pair.ravel()
    across_m, over_m = (
        np.bincount(of_pair, values[good], minlength=len(pairs)) / np.maximum(count, 1)
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
def _smoothed(  # pragma: no cover - compiled
    track: Integers, time: Floats, points: Floats, rate: Floats
) -> tuple[Floats, Floats]:
    """Return place (n, 3) and velocity (n, 2) by straight lines through neighbours in time.

    Single detections scatter over the width of a vehicle: matched to lanes one by one, those that a
    move shifts over the lane's edge would be cut off, which would hide half of the move.
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


def _middles(points: Floats, velocity: Floats, eye: Floats) -> Floats:
    """Return detections moved from the near side of their vehicle to its middle, (n, 3).

    From aside the vehicle's side reflects; from ahead or behind, its whole width.
    """
    arm = points[:, :2] - eye[:2]
    along = velocity / np.maximum(np.hypot(*velocity.T), 1e-9)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    beside, ahead = (np.sum(arm * way, axis=1) for way in (left, along))
    share = beside / np.maximum(np.abs(beside) + np.abs(ahead), 1e-9)
    found = points.copy()
    found[:, :2] += HALF_WIDTH_M * share[:, None] * left
    return found


def _on_lanes(
    lanes: Lanes, points: Floats, velocity: Floats, eye: Floats
) -> tuple[Integers, Floats, Floats]:
    """Return each detection's lane sample, and how far (m) it is to the left of and over it."""
    speed = np.hypot(*velocity.T)
    way = velocity / np.maximum(speed, 1e-9)[:, None]
    reach = np.linalg.norm(points - eye, axis=1)
    matches = match_along(lanes, points, way, speed, reach, least_cosine=SAME_WAY)
    _, across, over = lanes.beside(matches.lane, points)
    low, high = OVER_M
    good = matches.found & (speed > LEAST_MPS)
    good &= (np.abs(across) < WITHIN_M) & ~((over < low) | (over > high))
    return np.where(good, matches.lane, NONE), across, over
