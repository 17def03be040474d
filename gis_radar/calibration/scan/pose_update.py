"""Update of a pose by a scan check: traffic and what stands as two measurements of one pose.

Traffic fixes a pose across the lanes and hardly along a straight road; walls and trees fix it in
both directions, but to the scan, which may lie beside the map. Both are combined as the measurement
update of a Kalman filter does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gis_radar.base import Floats
from gis_radar.calibration.registration.certainty import (
    MAP_SIGMA_M,
    PLANE,
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

# Places along an open direction: how far they go to either side (a guess may be off by 15 m), their
# step, and draws of their patches.
ALONG_M, STEP_M, TOPS = 20.0, 0.25, 200
LEAST_LENGTH = 0.25  # of the way in a metre of an open direction: less is a circle of under 13 m
MOST_SHARE = 0.25  # of the traffic's variance along it, for the scan's: traffic's mean is left out
SMALL = 1e-9
DRAWS = 20  # of patches, for the covariance: it is known to a sixth then
START = np.array([1.0, 1.0, 1.0])  # farthest start of a climb from the top: m, m, deg
OPEN_M = 0.5  # spread of the tops of an open direction: the starts spread 0.58 m
MOST_CHI2 = 16.0  # of up to three components, from which on both contradict each other (99.9 %)


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
        The pose at the likeliest place along the direction: with the traffic's covariance, so that
        the scan can measure it once, and with the scan's variance along it. The same pose twice
        where traffic leaves nothing open, where scan and traffic together do not clearly prefer
        one place, by the sum of their squared standard deviations, or where the scan knows it
        hardly better than traffic.
    """
    known = _covariance(pose)
    if known is None or not _is_open(known) or not look.covered >= LEAST_COVERED:
        return pose, pose
    lever = np.array([1.0, 1.0, LEVER_M])
    variances, ways = np.linalg.eigh(known[np.ix_(PLANE, PLANE)] * np.outer(lever, lever))
    way = ways[:, -1] / lever
    length = float(np.hypot(*way[:2]))
    if length < LEAST_LENGTH:
        return pose, pose  # a turn rather than a way: the check itself tries all headings
    way /= length  # the step of easting, northing (m), yaw (rad) for a metre
    variance_m2 = length**2 * float(variances[-1])
    found = _likeliest(pose, look, way, variance_m2)
    if found is None or found[1] > MOST_SHARE * variance_m2:
        return pose, pose  # the scan leaves it open, too, or knows it hardly better
    place, noise_m2 = found
    row = np.zeros(6)
    row[PLANE] = way * (length * lever) ** 2  # how far along, of a step of the pose
    step = known @ row / (row @ known @ row)  # for a metre along: height and tilt follow
    frame = np.eye(6)
    frame[:2, :2] = rotation(float(way[2]) * place)
    steps = dict(zip(COMPONENTS, step * place * UNITS, strict=True))
    steps["easting"], steps["northing"] = along_arc(*(way * place))
    turned = frame @ known @ frame.T
    moved = _stepped(pose, steps, turned)
    noise = np.array([[noise_m2]])
    return moved, _measured(moved, turned, (frame @ row)[None], np.zeros(1), noise) or moved


def _likeliest(
    pose: Pose, look: ScanCheck, way: Floats, variance_m2: float
) -> tuple[float, float] | None:
    """Return the likeliest place along a way and its variance by the scan; None where it is open.

    Parameters
    ----------
    pose, look
        As for :func:`closed_along`.
    way : (3,) array
        The step of easting, northing (m), yaw (rad) for a metre.
    variance_m2 : float
        Variance of the place along it, by traffic.
    """
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
    both = by_scan**2 + (places**2 - places[top] ** 2) / variance_m2
    near = both - both.min() < CLEAR_SIGMAS**2
    if near[[0, -1]].any() or np.count_nonzero(np.diff(near)) > 2:
        return None  # it goes on beyond, or places apart from each other may be right
    count = patches.shape[1]
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=TOPS)
    tops = places[near][np.argmax(patches[near] @ drawn.T, axis=0)]
    return float(tops.mean()), float(np.var(tops)) + MAP_SIGMA_M**2


def _is_open(known: Floats) -> bool:
    """Return whether traffic allows poses that the check at this one does not take for the same."""
    yaw_deg = math.degrees(math.sqrt(known[5, 5]))
    return BETTER_SIGMAS * longest_m(known) > SAME_M or BETTER_SIGMAS * yaw_deg > SAME_DEG


def updated_by_scan(pose: Pose, look: ScanCheck) -> Pose | None:
    """Return a pose updated by where what stands fits the scan best.

    Parameters
    ----------
    pose : Pose
        With its covariance, by traffic.
    look : ScanCheck
        The check of this pose, or of one nearby.

    Returns
    -------
    Pose or None
        The same pose where it states no covariance, where the check does not confirm the pose that
        it looked at, or where what stands leaves a direction open; None where it contradicts the
        traffic.
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


def _measured(pose: Pose, known: Floats, rows: Floats, gap: Floats, noise: Floats) -> Pose | None:
    """Return a pose after the measurement of some linear functions of it; None if inconsistent."""
    total = np.linalg.inv(rows @ known @ rows.T + noise)
    if gap @ total @ gap > MOST_CHI2:
        return None
    gain = known @ rows.T @ total
    left = known - gain @ rows @ known
    steps = dict(zip(COMPONENTS, gain @ gap * UNITS, strict=True))
    return _stepped(pose, steps, (left + left.T) / 2.0)


def _stepped(pose: Pose, steps: Mapping[str, float], covariance: Floats) -> Pose:
    """Return a pose after steps of its components, m and degrees, with another covariance."""
    moved = {name: getattr(pose, name) + float(value) for name, value in steps.items()}
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
