"""Matching: to each sample the nearest lane that its Doppler allows."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.registration.lanes import CELL_M, STEP_M, Lanes
from gis_radar.registration.state import State
from gis_radar.traces import Samples

LEVEL_M = 4.0  # a lane of another storey is no match
SLACK_MPS = 0.5  # noise, and the turning of a long vehicle


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Which lane sample each trace sample lies on.

    Parameters
    ----------
    lane : (n,) int array
        Index of the lane sample; any where there is no match.
    found : (n,) bool array
        Whether there is one.
    """

    lane: Integers
    found: Booleans


def match(lanes: Lanes, samples: Samples, state: State) -> Matches:
    """Find for each sample the nearest lane of a direction that fits its range rate.

    Parameters
    ----------
    lanes : Lanes
        The map.
    samples : Samples
        Traces.
    state : State
        Where the sensor is thought to be.
    """
    points = state.to_map(samples.points)
    lane, found = _match(
        points,
        directions(points[:, :2] - state.position[:2]),
        np.linalg.norm(samples.points, axis=1),
        samples.range_rate,
        lanes.points,
        lanes.along,
        lanes.top_speed,
        lanes.corner,
        lanes.nearest,
    )
    return Matches(lane=lane, found=found)


@numba.njit(cache=True, nogil=True)
def _match(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    points: Floats,
    sight: Floats,
    reach: Floats,
    range_rate: Floats,
    lane_points: Floats,
    along: Floats,
    top_speed: Floats,
    corner: Floats,
    nearest: NDArray[np.int32],
) -> tuple[Integers, Booleans]:
    """Return the lane sample of each point, and whether there is one."""
    bins, rows, columns = nearest.shape
    lane = np.zeros(len(points), dtype=np.int64)
    found = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        column = int(np.floor((points[i, 0] - corner[0]) / CELL_M))
        row = int(np.floor((points[i, 1] - corner[1]) / CELL_M))
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        best = np.inf
        for b in range(bins):
            k = nearest[b, row, column]
            if k < 0:
                continue
            # Doppler sign and size: the speed along the lane that explains the range rate
            # is neither negative nor above the lane's top speed
            cosine = along[k, 0] * sight[i, 0] + along[k, 1] * sight[i, 1]
            forward = range_rate[i] if cosine >= 0.0 else -range_rate[i]
            if forward < -SLACK_MPS or forward > abs(cosine) * top_speed[k] + SLACK_MPS:
                continue
            x, y, z = points[i] - lane_points[k]
            ahead = abs(x * along[k, 0] + y * along[k, 1])
            across = y * along[k, 0] - x * along[k, 1]
            # past the end of a lane counts as off it; samples lie a step apart
            gap = np.hypot(across, max(ahead - 1.5 * STEP_M, 0.0))
            if abs(z) > LEVEL_M + 0.05 * reach[i]:
                continue
            if gap < best:
                best = gap
                lane[i] = k
                found[i] = True
    return lane, found


def directions(vectors: Floats) -> Floats:
    """Return (n, 2) vectors at length one; a vector without length points east."""
    length = np.hypot(vectors[:, 0], vectors[:, 1])
    unit = vectors / np.maximum(length, 1e-9)[:, None]
    return np.where(length[:, None] > 1e-9, unit, [1.0, 0.0])
