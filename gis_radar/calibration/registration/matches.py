"""Match samples to lanes that are near and whose direction agrees with the range rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.calibration.registration.lanes import (
    BORDER_M,
    LANE_CELL_M,
    LANE_STEP_M,
    NEXT_LANE_M,
    Lanes,
    Placed,
)

# Largest difference of height between sample and lane, metres, plus a share of the range: 3
# degrees of tilt.
_LEVEL_M = 4.0
_LEVEL_SHARE = 0.05
_SLACK_MPS = 0.5  # tolerance of range rates: noise, and the rotation of a long vehicle


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Association of trace samples with lane samples.

    Parameters
    ----------
    lane : (n,) int array
        Index of the lane sample; arbitrary where there is no match.
    found : (n,) bool array
        Whether there is a match.
    path_cost : (n,) array
        Negative log likelihood of a change of lanes before the sample, plus that of a position
        past the end of its lane.
    """

    lane: Integers
    found: Booleans
    path_cost: Floats


def match(lanes: Lanes, placed: Placed) -> Matches:
    """Find for each sample the nearest lane whose direction agrees with its range rate.

    Parameters
    ----------
    lanes : Lanes
        The map.
    placed : Placed
        Traces, placed by the assumed state of the sensor.
    """
    samples = placed.samples
    return match_along(lanes, placed.points, placed.sight, samples.range_rate, samples.reach)


def match_along(
    lanes: Lanes,
    points: Floats,
    direction: Floats,
    speed: Floats,
    reach: Floats,
    *,
    least_cosine: float = 0.0,
) -> Matches:
    """Find for each point the nearest lane on which a vehicle may have its speed.

    On a lane the speed component along `direction` has the sign of the lane's direction, and the
    lane's top speed bounds it.

    Parameters
    ----------
    lanes : Lanes
        The map.
    points : (n, 3) array
        Local map coordinates; a height that is NaN fits every lane.
    direction : (n, 2) array
        Unit vectors along which the speed is known: the line of sight, or the direction of travel.
    speed : (n,) array
        Speed along `direction`, m/s.
    reach : (n,) array
        Distance from the sensor, metres; the tolerance of height grows with it.
    least_cosine : float
        Least cosine of the angle between lane and `direction`.
    """
    no_neighbours = np.empty((len(lanes.points), 0), dtype=np.int64)
    lane = _match_lanes(
        1, no_neighbours, least_cosine, points, direction, reach, speed, *lanes.raster
    )[:, 0]
    return Matches(lane=np.maximum(lane, 0), found=lane >= 0, path_cost=np.zeros(len(lane)))


def lanes_near(lanes: Lanes, placed: Placed, *, most: int) -> Integers:
    """Find for each sample all lanes that are near and agree with its range rate.

    Parameters
    ----------
    lanes : Lanes
        The map.
    placed : Placed
        Traces, placed by the assumed state of the sensor.
    most : int
        Largest number of lanes of a sample.

    Returns
    -------
    (n, most) int64 array
        Indices of lane samples: first that of :func:`match`, then of other lanes; -1 for none.
    """
    samples = placed.samples
    return _match_lanes(
        most, lanes.next_lanes, 0.0, placed.points, placed.sight, samples.reach,
        samples.range_rate, *lanes.raster,
    )  # fmt: skip


@compiled
def _match_lanes(  # noqa: C901, PLR0917 - calls of compiled functions cost  # pragma: no cover
    most: int,
    next_lanes: Integers,
    least_cosine: float,
    points: Floats,
    sight: Floats,
    reach: Floats,
    range_rate: Floats,
    lane_points: Floats,
    along: Floats,
    top_speed: Floats,
    corner: Floats,
    nearest: NDArray[np.int32],
) -> Integers:
    """Return lane samples near each point, the nearest one first; -1 for none."""
    rows, columns, bins = nearest.shape
    cells, lane = nearest.reshape(rows * columns, bins), np.full((len(points), most), -1)
    for i in range(len(points)):
        # scalars: numba would allocate arrays, and load an array's value again after each write
        px, py, pz, rate = points[i, 0], points[i, 1], points[i, 2], range_rate[i]
        sight_x, sight_y = sight[i, 0], sight[i, 1]
        level_m, count, best = _LEVEL_M + _LEVEL_SHARE * reach[i], 0, np.inf
        east, north = px - corner[0], py - corner[1]
        home = _cell(east, north, rows, columns)
        for b in range(bins):
            cell, before = home, -1
            # the lane nearest to the centre of the point's cell may not be the nearest to the
            # point: try the next cell in its direction, too
            for _ in range(2):
                k = cells[cell, b] if cell >= 0 else -1
                if k < 0 or k == before:
                    break
                before, left = k, 0.0
                for side in range(1 + next_lanes.shape[1]):
                    q = int(next_lanes[k, side - 1]) if side > 0 else int(k)
                    if q < 0:
                        continue
                    x, y, z = px - lane_points[q, 0], py - lane_points[q, 1], pz - lane_points[q, 2]
                    across = y * along[q, 0] - x * along[q, 1]
                    left = left if side > 0 else across
                    # the speed along the lane that explains the range rate is neither negative nor
                    # above the lane's top speed; `&`, as branches would be guessed wrongly
                    cosine = along[q, 0] * sight_x + along[q, 1] * sight_y
                    forward, top = rate if cosine >= 0.0 else -rate, abs(cosine) * top_speed[q]
                    allowed = (forward >= -_SLACK_MPS) & (forward <= top + _SLACK_MPS)
                    allowed &= (abs(cosine) >= least_cosine) & (not abs(z) > level_m)  # or NaN
                    if not allowed:
                        if side > 0:
                            continue
                        break
                    # the distance past the end of a lane counts, too; samples are a step apart
                    ahead = max(abs(x * along[q, 0] + y * along[q, 1]) - 1.5 * LANE_STEP_M, 0.0)
                    gap = across**2 + ahead**2
                    if gap < best or gap < NEXT_LANE_M**2:
                        count = _insert(lane, i, q, count, gap < best)
                        best = min(gap, best)
                    elif side == 0:
                        break
                if abs(left) < BORDER_M:
                    break
                step_m = np.copysign(LANE_CELL_M, left)
                x, y = step_m * along[k, 0], step_m * along[k, 1]
                cell = _cell(east - y, north + x, rows, columns)
    return lane


@compiled
def _cell(east: float, north: float, rows: int, columns: int) -> int:  # pragma: no cover - compiled
    """Return the number of the cell at a place (metres from the grid's corner); -1 for none."""
    column, row = int(np.floor(east / LANE_CELL_M)), int(np.floor(north / LANE_CELL_M))
    return row * columns + column if 0 <= column < columns and 0 <= row < rows else -1


@compiled
def _insert(  # pragma: no cover - compiled
    rows: Integers,
    i: int,
    lane: int,
    count: int,
    first: bool,  # noqa: FBT001
) -> int:
    """Insert a lane into row i, which holds `count`, as the first or last; return the new count."""
    at, most = 0, rows.shape[1]
    while at < count and rows[i, at] != lane:
        at += 1
    if first:
        at = min(at, most - 1)
        rows[i, at], rows[i, 0] = rows[i, 0], lane
    elif at < most:
        rows[i, at] = lane
    return int(max(count, min(at + 1, most)))
