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
LEVEL_M = 4.0
LEVEL_SHARE = 0.05
SLACK_MPS = 0.5  # tolerance of range rates: noise, and the rotation of a long vehicle


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
def _match_lanes(  # noqa: C901, PLR0912, PLR0917 - calls of compiled functions cost  # pragma: no cover
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
    bins, rows, columns = nearest.shape
    lane = np.full((len(points), most), -1)
    for i in range(len(points)):
        best = np.inf
        for b in range(bins):
            east, north = points[i, 0] - corner[0], points[i, 1] - corner[1]
            # the lane nearest to the centre of the point's cell may not be the nearest to the
            # point: try the next cell in its direction, too
            for _ in range(2):
                column, row = int(np.floor(east / LANE_CELL_M)), int(np.floor(north / LANE_CELL_M))
                if not (0 <= column < columns and 0 <= row < rows):
                    break
                k = nearest[b, row, column]
                if k < 0:
                    break
                left, q = 0.0, int(k)
                for side in range(1 + next_lanes.shape[1]):
                    if side > 0:
                        q = int(next_lanes[k, side - 1])
                        if q < 0:
                            continue
                    # scalars: numba would allocate arrays
                    x = points[i, 0] - lane_points[q, 0]
                    y = points[i, 1] - lane_points[q, 1]
                    z = points[i, 2] - lane_points[q, 2]
                    across = y * along[q, 0] - x * along[q, 1]
                    left = left if side > 0 else across
                    # the speed along the lane that explains the range rate is neither negative nor
                    # above the lane's top speed
                    cosine = along[q, 0] * sight[i, 0] + along[q, 1] * sight[i, 1]
                    forward = range_rate[i] if cosine >= 0.0 else -range_rate[i]
                    allowed = -SLACK_MPS <= forward <= abs(cosine) * top_speed[q] + SLACK_MPS
                    allowed = allowed and abs(cosine) >= least_cosine
                    if not allowed or abs(z) > LEVEL_M + LEVEL_SHARE * reach[i]:  # or NaN
                        if side > 0:
                            continue
                        break
                    # the distance past the end of a lane counts, too; samples are a step apart
                    ahead = abs(x * along[q, 0] + y * along[q, 1]) - 1.5 * LANE_STEP_M
                    gap = np.sqrt(across**2 + ahead**2) if ahead > 0.0 else abs(across)
                    if gap < best or gap < NEXT_LANE_M:
                        best = _insert_by_gap(lane, i, q, gap, best)
                    elif side == 0:
                        break
                if abs(left) < BORDER_M:
                    break
                east -= np.copysign(LANE_CELL_M, left) * along[k, 1]
                north += np.copysign(LANE_CELL_M, left) * along[k, 0]
    return lane


@compiled
def _insert_by_gap(
    rows: Integers, i: int, lane: int, gap: float, best: float
) -> float:  # pragma: no cover
    """Insert a lane into row i, the nearest one first; return the least gap of the row, metres."""
    for at in range(rows.shape[1]):
        if rows[i, at] < 0 or rows[i, at] == lane:
            break
    if gap < best:
        rows[i, at], rows[i, 0] = rows[i, 0], lane
    elif rows[i, at] < 0:
        rows[i, at] = lane
    return min(gap, best)
