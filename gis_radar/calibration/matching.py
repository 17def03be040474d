"""Matching: to each sample the nearest lane that its Doppler allows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gis_radar.arrays import Booleans, Floats, Integers, compiled
from gis_radar.calibration.lanes import LANE_CELL_M, LANE_STEP_M, Lanes
from gis_radar.calibration.settings import LOCALIZATION, LocalizationSettings
from gis_radar.calibration.state import State
from gis_radar.calibration.traces import Samples

# Largest height between sample and lane, plus that share of the range (3 degrees of tilt).
LEVEL_M = 4.0
LEVEL_SHARE = 0.05
BORDER_M = 1.0  # a sample nearer to its lane's middle is no other lane's: less than half a lane

NO_WAY_M = 1e-9


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What a registration works on.

    Parameters
    ----------
    lanes : Lanes
        The map around the guess.
    samples : Samples
        The traces.
    settings : LocalizationSettings
        How to go about it.
    """

    lanes: Lanes
    samples: Samples
    settings: LocalizationSettings = LOCALIZATION

    def of(self, samples: Samples) -> Scene:
        """Return the scene with other samples."""
        return replace(self, samples=samples)


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Samples as they lie in the map, where the sensor is in some state.

    Parameters
    ----------
    samples : Samples
        Traces.
    state : State
        Of the sensor.
    points : (n, 3) array
        The samples in local map coordinates.
    arms : (n, 3) array
        The same as seen from the sensor, in the map's axes.
    flat : (n,) array
        How far off they are in the plane, metres.
    sight : (n, 2) array
        Unit vectors from the sensor to them; east where there is no way.
    """

    samples: Samples
    state: State
    points: Floats
    arms: Floats
    flat: Floats
    sight: Floats


def place(samples: Samples, state: State) -> Placed:
    """Return samples as they lie in the map.

    Parameters
    ----------
    samples : Samples
        Traces.
    state : State
        Where the sensor is thought to be.
    """
    turn = np.ascontiguousarray(state.R_map_sensor)  # other layouts would be compiled anew
    points, arms, flat, sight = _placed(samples.points, turn, state.position)
    return Placed(samples=samples, state=state, points=points, arms=arms, flat=flat, sight=sight)


@compiled
def _placed(  # pragma: no cover - compiled
    seen: Floats, turn: Floats, position: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return points, arms, distances and directions of sight, as in `Placed`."""
    points, arms = np.empty((len(seen), 3)), np.empty((len(seen), 3))
    flat, sight = np.empty(len(seen)), np.empty((len(seen), 2))
    for i in range(len(seen)):
        for j in range(3):
            arms[i, j] = turn[j, 0] * seen[i, 0] + turn[j, 1] * seen[i, 1] + turn[j, 2] * seen[i, 2]
            points[i, j] = arms[i, j] + position[j]
        flat[i] = np.hypot(arms[i, 0], arms[i, 1])
        sight[i, 0], sight[i, 1] = 1.0, 0.0
        if flat[i] > NO_WAY_M:
            sight[i, 0], sight[i, 1] = arms[i, 0] / flat[i], arms[i, 1] / flat[i]
    return points, arms, flat, sight


@dataclass(frozen=True, kw_only=True)
class Matches:
    """The lane sample of each trace sample.

    Parameters
    ----------
    lane : (n,) int array
        Index of the lane sample; any where there is no match.
    found : (n,) bool array
        Whether there is one.
    """

    lane: Integers
    found: Booleans


def match(lanes: Lanes, placed: Placed) -> Matches:
    """Find for each sample the nearest lane of a direction that fits its range rate.

    Parameters
    ----------
    lanes : Lanes
        The map.
    placed : Placed
        Traces, with the sensor where it is thought to be.
    """
    s = lanes.settings
    lane, found = _match(
        np.array([LANE_CELL_M, LANE_STEP_M, LEVEL_M, LEVEL_SHARE, BORDER_M, s.slack_mps]),
        placed.points,
        placed.sight,
        placed.samples.reach,
        placed.samples.range_rate,
        lanes.points,
        lanes.along,
        lanes.top_speed,
        lanes.corner,
        lanes.nearest,
    )
    return Matches(lane=lane, found=found)


@compiled
def _match(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    settings: Floats,
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
    cell_m, step_m, level_m, level_share, border_m, slack_mps = settings
    bins, rows, columns = nearest.shape
    lane = np.zeros(len(points), dtype=np.int64)
    found = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        best = np.inf
        for b in range(bins):
            east, north = points[i, 0] - corner[0], points[i, 1] - corner[1]
            # the nearest lane of a cell's centre; then, where lanes meet, of the cell beside it
            for _ in range(2):
                column, row = int(np.floor(east / cell_m)), int(np.floor(north / cell_m))
                if not (0 <= column < columns and 0 <= row < rows):
                    break
                k = nearest[b, row, column]
                if k < 0:
                    break
                # not as arrays: numba would allocate one for each
                x = points[i, 0] - lane_points[k, 0]
                y = points[i, 1] - lane_points[k, 1]
                z = points[i, 2] - lane_points[k, 2]
                across = y * along[k, 0] - x * along[k, 1]
                # Doppler sign and size: the speed along the lane that explains the range rate
                # is neither negative nor above the lane's top speed
                cosine = along[k, 0] * sight[i, 0] + along[k, 1] * sight[i, 1]
                forward = range_rate[i] if cosine >= 0.0 else -range_rate[i]
                allowed = -slack_mps <= forward <= abs(cosine) * top_speed[k] + slack_mps
                if allowed and abs(z) <= level_m + level_share * reach[i]:
                    # past the end of a lane counts as off it; samples are a step apart
                    ahead = abs(x * along[k, 0] + y * along[k, 1])
                    gap = np.hypot(across, max(ahead - 1.5 * step_m, 0.0))
                    if gap < best:
                        best = gap
                        lane[i] = k
                        found[i] = True
                if abs(across) < border_m:
                    break
                east -= np.copysign(cell_m, across) * along[k, 1]
                north += np.copysign(cell_m, across) * along[k, 0]
    return lane, found
