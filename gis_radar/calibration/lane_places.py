"""LanePlaces: where in its lane each vehicle drives, cell by cell along the lanes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.calibration.lanes import Lanes, match_along
from gis_radar.calibration.state import State
from gis_radar.calibration.traces import NONE, Moving, link_tracks, straight_line

# Cells of lanes, in which a vehicle's place is one number; and stretches, in which whatever makes
# drivers change their habit (a parked van, a cyclist) concerns all cells.
CELL_M = 12.0
STRETCH_M = 48.0
# Where lanes of one direction run nearer than a lane's width, and are not the same line, a
# vehicle may be of either: left out.
APART_M = 2.2
SAME_LINE_M = 0.3
SAME_WAY = 0.9  # cosine of the angle between directions that are one, 25 degrees
WITHIN_M = 1.75  # half a lane: what is farther from its middle drives elsewhere
OVER_M = (-2.0, 5.0)  # heights over the road between which vehicles reflect
HALF_WIDTH_M = 0.9  # from a vehicle's side to its middle, as in the localization
LEAST_MPS = 2.7  # what is slower may walk
SMOOTH_S = 1.0  # a detection's velocity is the slope of its track so long before and after
WHOLE_S = 1e6  # tracks are not cut, a vehicle is one cluster: any length beyond that of the window
LEAST_HITS = 3  # fewer detections in a cell state no mean


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Pieces of lanes, each so long that a vehicle's place in it is one number.

    Parameters
    ----------
    lanes : Lanes
        The samples of centre lines that they are made of.
    of_sample : (m,) array
        The cell of each sample; -1 where lanes of one direction overlap.
    centre, left : (c, 2) arrays
        Middle of each cell in local coordinates, and the unit vector to the left of travel.
    stretch : (c,) array
        Which stretch of street a cell belongs to, from 0.
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
        Around a sensor.
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
    """Return the samples beside which another lane of their direction runs too near."""
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
    """Where vehicles drove: a row for each vehicle and cell.

    Parameters
    ----------
    vehicle : (n,) array
        Number of the vehicle, ascending from 0.
    cell : (n,) array
        Of :class:`Cells`.
    across_m : (n,) array
        Mean of its detections to the left of the lane's middle.
    over_m : (n,) array
        Mean of their heights over the road; NaN where the road's height is not known.
    count : (n,) array
        How many detections.
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
        """How many vehicles there are."""
        return int(self.vehicle.max(initial=NONE)) + 1


def lane_places(
    moving: Moving,
    cells: Cells,
    state: State,
    *,
    since: float,
    until: float,
) -> LanePlaces:
    """Return where those vehicles drove whose last detection falls into some time.

    Parameters
    ----------
    moving : Moving
        A window that holds that time and what goes before.
    cells : Cells
        The lanes.
    state : State
        With which pose detections are placed.
    since, until : float
        UNIX seconds: the time, its end not included.
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

    Single detections scatter over the width of a vehicle: to ask each of them for its lane would
    cut off, on one side, what a move shifts over the lane's edge, and hide half of the move.
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

    Seen from aside it is the side that reflects, from ahead or behind the whole width.
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
    """Return the lane sample of each detection that drives there, how far left and over it."""
    speed = np.hypot(*velocity.T)
    way = velocity / np.maximum(speed, 1e-9)[:, None]
    reach = np.linalg.norm(points - eye, axis=1)
    matches = match_along(lanes, points, way, speed, reach, least_cosine=SAME_WAY)
    _, across, over = lanes.beside(matches.lane, points)
    low, high = OVER_M
    good = matches.found & (speed > LEAST_MPS)
    good &= (np.abs(across) < WITHIN_M) & ~((over < low) | (over > high))
    return np.where(good, matches.lane, NONE), across, over
