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
from gis_radar.calibration.registration.certainty import (
    MAP_SIGMA_M,
    UNITS,
    is_fixed,
    longest_m,
    stated,
)
from gis_radar.calibration.registration.state import LEVER_M, along_arc, rotation
from gis_radar.calibration.scan.scan_check import (
    BETTER_SIGMAS,
    CLEAR_SIGMAS,
    LEAST_COVERED,
    SAME_DEG,
    SAME_M,
    Alignment,
    align,
)
from gis_radar.calibration.scan.scan_check_result import CONFIRMS, PoseOffset, ScanCheck
from gis_radar.calibration.scan.surroundings import Standing
from gis_radar.poses import COMPONENTS, Pose

# Places along an open direction: a pose and the truth may be that far from the guess, each to its
# own side; their step; and draws of their patches.
ALONG_M, STEP_M, TOPS = 20.0, 0.25, 200
SMALL = 1e-9
DRAWS = 20  # of patches, for the covariance: it is known to a sixth then
START = np.array([1.0, 1.0, 1.0])  # farthest start of a climb from the top: m, m, deg
OPEN_M = 0.5  # spread of the tops of an open direction: the starts spread 0.58 m
MOST_CHI2 = 16.0  # of up to three components, from which on both contradict each other (99.9 %)
PLANE = [0, 1, 5]  # of a covariance: easting, northing, yaw


def closed_along(pose: Pose, look: ScanCheck) -> tuple[Pose, Pose]:
    """Return a pose that traffic hardly fixes, as along a road, closed in that direction.

    Only places that the traffic allows are compared with the scan: those along the direction that
    it knows least, on a line or, where the pose turns along it, on a circle as round a bend.

    Parameters
    ----------
    pose : Pose
        With its covariance, by traffic.
    look : ScanCheck
        The check of this pose.

    Returns
    -------
    moved, closed : Pose
        The pose at the likeliest place, as certain as by traffic, and by both; the same pose where
        traffic leaves nothing open, or where scan and traffic together do not clearly prefer one
        place, by the sum of their squared standard deviations.
    """
    known = _covariance(pose)
    if known is None or not _is_open(known) or not look.covered >= LEAST_COVERED:
        return pose, pose
    lever = np.array([1.0, 1.0, LEVER_M])
    variances, ways = np.linalg.eigh(known[np.ix_(PLANE, PLANE)] * np.outer(lever, lever))
    way = ways[:, -1] / lever
    length = float(np.hypot(*way[:2]))
    way /= length  # the step of easting, northing (m), yaw (rad) for a metre
    places = np.arange(-ALONG_M, ALONG_M + 0.5 * STEP_M, STEP_M)
    ahead, left = rotation(-math.radians(pose.yaw)) @ way[:2]
    turns = way[2] * places
    offsets = [*along_arc(ahead * places, left * places, turns), np.degrees(turns)]
    alignment, patch = align(look.standing, look.structure), look.standing.patch
    patches = np.array([
        np.bincount(patch, alignment.at(each)) for each in np.transpose(offsets).tolist()
    ])  # fmt: skip
    top = int(np.argmax(patches.sum(axis=1)))
    gains = patches[top] - patches
    by_scan = gains.sum(axis=1) / np.maximum(np.sqrt((gains**2).sum(axis=1)), SMALL)
    by_traffic = (places**2 - places[top] ** 2) / (length**2 * variances[-1])
    both = by_scan**2 + by_traffic
    near = both - both.min() < CLEAR_SIGMAS**2
    if near[[0, -1]].any() or np.count_nonzero(np.diff(near)) > 2:
        return pose, pose  # it goes on beyond, or places apart from each other may be right
    count = patches.shape[1]
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=TOPS)
    tops = places[near][np.argmax(patches[near] @ drawn.T, axis=0)]
    # traffic's own place along it no longer counts: it is known far worse than by the scan
    moved, way = _moved_along(pose, known, way, float(tops.mean()))
    row = np.zeros((1, 6))
    row[0, PLANE] = way * (length * lever) ** 2  # how far along, of a step of the pose
    noise = np.array([[float(np.var(tops)) + MAP_SIGMA_M**2]])
    return moved, _measured(moved, np.asarray(_covariance(moved)), row, np.zeros(1), noise)


def _is_open(known: Floats) -> bool:
    """Return whether traffic allows poses that the check at this one does not take for the same."""
    yaw_deg = math.degrees(math.sqrt(known[5, 5]))
    return BETTER_SIGMAS * longest_m(known) > SAME_M or BETTER_SIGMAS * yaw_deg > SAME_DEG


def _moved_along(pose: Pose, known: Floats, way: Floats, place: float) -> tuple[Pose, Floats]:
    """Return a pose moved on a line or circle, with its covariance turned, and the way there."""
    turn = float(way[2]) * place
    frame = np.eye(6)
    frame[:2, :2] = rotation(turn)
    easting, northing = along_arc(way[0] * place, way[1] * place, turn)
    yaw = math.remainder(pose.yaw + math.degrees(turn), 360.0)
    moved = replace(
        pose,
        easting=pose.easting + float(easting),
        northing=pose.northing + float(northing),
        yaw=yaw,
        evidence={**pose.evidence, **stated(frame @ known @ frame.T)},
    )
    return moved, np.array([*(frame[:2, :2] @ way[:2]), way[2]])


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
    known = _covariance(pose)
    if known is None or look.verdict != CONFIRMS or look.best is None:
        return pose
    measured = offset_covariance(align(look.standing, look.structure), look.best)
    if measured is None:
        return pose
    to_map, rows = _to_map(look.pose), np.eye(6)[PLANE]
    # the scan lies as far off as the map, here and at the usual distance of what stands
    place = np.diag(np.square([MAP_SIGMA_M, MAP_SIGMA_M, MAP_SIGMA_M / LEVER_M]))
    turn = math.radians(math.remainder(look.pose.yaw - pose.yaw, 360.0))
    gap = to_map @ np.array(look.best.place)
    gap += [*(look.pose.position - pose.position)[:2], turn]
    return _measured(pose, known, rows, gap, to_map @ measured @ to_map.T + place)


def _covariance(pose: Pose) -> Floats | None:
    given = pose.evidence.get("covariance")
    return None if given is None else np.asarray(given, np.float64)


def _measured(pose: Pose, known: Floats, rows: Floats, gap: Floats, noise: Floats) -> Pose:
    """Return a pose after the measurement of some linear functions of it, if it is consistent."""
    total = np.linalg.inv(rows @ known @ rows.T + noise)
    if gap @ total @ gap > MOST_CHI2:
        return pose
    gain = known @ rows.T @ total
    left = known - gain @ rows @ known
    covariance = (left + left.T) / 2.0
    steps = dict(zip(COMPONENTS, (gain @ gap * UNITS).tolist(), strict=True))
    moved = {name: getattr(pose, name) + value for name, value in steps.items()}
    moved["yaw"] = math.remainder(moved["yaw"], 360.0)
    evidence = {**pose.evidence, **stated(covariance), "observable": is_fixed(covariance)}
    return replace(pose, **moved, evidence=evidence)


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
    longest_spread_m = math.sqrt(float(np.linalg.eigvalsh(lengths @ covariance @ lengths)[-1]))
    return None if longest_spread_m > OPEN_M else np.asarray(covariance)


def _to_map(pose: Pose) -> Floats:
    """Return the matrix from ahead, left (m), turn (deg) to easting, northing (m), yaw (rad)."""
    yaw = math.radians(pose.yaw)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, math.radians(1.0)]])
