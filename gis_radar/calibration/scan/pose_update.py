"""Update of a pose by a scan check: traffic and what stands as two measurements of one pose.

Traffic fixes a pose across the lanes and hardly along a straight road; walls and trees fix it in
both directions, but to the scan, which may lie beside the map. Both are combined as the measurement
update of a Kalman filter does.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gis_radar.base import Floats
from gis_radar.calibration.registration.certainty import MAP_SIGMA_M, UNITS, is_fixed, stated
from gis_radar.calibration.registration.state import LEVER_M
from gis_radar.calibration.scan.scan_check import CLOSE_M, Alignment, align
from gis_radar.calibration.scan.scan_check_result import CONFIRMS, PoseOffset, ScanCheck
from gis_radar.calibration.scan.surroundings import Standing
from gis_radar.poses import COMPONENTS, Pose

DRAWS = 20  # of patches, for the covariance: it is known to a sixth then
START = np.array([1.0, 1.0, 1.0])  # farthest start of a climb from the top: m, m, deg
MOST_CHI2 = 16.0  # of three components, from which on both contradict each other (99.9 %)
PLANE = [0, 1, 5]  # of a covariance: easting, northing, yaw


def updated_by_scan(pose: Pose, look: ScanCheck) -> Pose:
    """Return a pose updated by where what stands fits the scan best.

    Parameters
    ----------
    pose : Pose
        With its covariance, by traffic.
    look : ScanCheck
        The check of this pose, or of one nearby.

    Returns
    -------
    Pose
        The same pose where it states no covariance, where the check does not confirm the pose that
        it looked at, or where what stands leaves a direction open or contradicts the traffic.
    """
    given = pose.evidence.get("covariance")
    if given is None or look.verdict != CONFIRMS or look.best is None:
        return pose
    known = np.asarray(given, np.float64)
    measured = offset_covariance(align(look.standing, look.structure), look.best)
    if measured is None:
        return pose
    to_map, gap = _to_map(look.pose), _between(pose, look.best_pose)
    # the scan lies as far off as the map, here and at the usual distance of what stands
    place = np.diag(np.square([MAP_SIGMA_M, MAP_SIGMA_M, MAP_SIGMA_M / LEVER_M]))
    noise = to_map @ measured @ to_map.T + place
    total = np.linalg.inv(known[np.ix_(PLANE, PLANE)] + noise)
    if gap @ total @ gap > MOST_CHI2:
        return pose
    gain = known[:, PLANE] @ total
    left = known - gain @ known[PLANE]
    return _moved(pose, gain @ gap, (left + left.T) / 2.0)


def offset_covariance(alignment: Alignment, best: PoseOffset) -> Floats | None:
    """Return the covariance of the best offset, (ahead, left, turn): metres and degrees.

    Patches of neighbouring cells, the independent parts of what stands, are drawn anew (bootstrap);
    each time the top is climbed to from another start nearby, so that a direction that is open, as
    along a single wall, spreads as far as the starts do.

    Returns
    -------
    (3, 3) array, or None where a direction is open.
    """
    rng, tops = np.random.default_rng(0), []
    standing, patch = alignment.standing, alignment.standing.patch
    cells = [np.flatnonzero(patch == k) for k in range(int(patch.max()) + 1)]
    for _ in range(DRAWS):
        rows = np.concatenate([cells[k] for k in rng.integers(0, len(cells), len(cells))])
        drawn = Standing(points=standing.points[rows], rustles=standing.rustles[rows])
        start = np.array(best.place) + rng.uniform(-START, START)
        tops.append(replace(alignment, standing=drawn).climbed(start.tolist()).place)
    covariance = np.cov(tops, rowvar=False)
    lengths = np.diag([1.0, 1.0, math.radians(LEVER_M)])
    longest_m = math.sqrt(float(np.linalg.eigvalsh(lengths @ covariance @ lengths)[-1]))
    return None if longest_m > CLOSE_M else np.asarray(covariance)


def _to_map(pose: Pose) -> Floats:
    """Return the matrix from ahead, left (m), turn (deg) to easting, northing (m), yaw (rad)."""
    yaw = math.radians(pose.yaw)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, math.radians(1.0)]])


def _between(pose: Pose, other: Pose) -> Floats:
    """Return the step from a pose to another: easting, northing (m), yaw (rad)."""
    turn = math.radians(math.remainder(other.yaw - pose.yaw, 360.0))
    return np.array([*(other.position - pose.position)[:2], turn])


def _moved(pose: Pose, step: Floats, covariance: Floats) -> Pose:
    """Return a pose after a step, in the order of a covariance, with its new covariance."""
    steps = dict(zip(COMPONENTS, (step * UNITS).tolist(), strict=True))
    moved = {name: getattr(pose, name) + value for name, value in steps.items()}
    moved["yaw"] = math.remainder(moved["yaw"], 360.0)
    evidence = {**pose.evidence, **stated(covariance), "observable": is_fixed(covariance)}
    return replace(pose, **moved, evidence=evidence)
