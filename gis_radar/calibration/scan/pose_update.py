"""Update a pose by a scan check, with the measurement update of a Kalman filter.

Traffic fixes a pose across the lanes, but hardly along a straight road. Static structures such as
walls and trees fix it in both directions, relative to the scan, which may be shifted from the map.
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
    POSE_UNITS,
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

# Tried places along an open direction: reach to either side (a guess may be off by 15 m), step, and
# number of bootstrap draws.
_ALONG_M, _STEP_M, _PLACE_DRAWS = 20.0, 0.25, 200
# Least share of displacement in an open direction, the rest is rotation: below it, the sensor moves
# on a circle of less than 13 m radius.
_LEAST_LENGTH = 0.25
_MOST_SHARE = 0.25  # largest variance by the scan along it, as a share of that by traffic
_SMALL = 1e-9  # avoids a division by 0
_OFFSET_DRAWS = 20  # of patches, for the covariance: it is known to a sixth then
_START_SPREAD = np.array([1.0, 1.0, 1.0])  # largest offset of a climb's start: m, m, deg
_OPEN_M = 0.5  # 1 sigma of the maxima above which a direction is open; that of the starts is 0.58 m
_MOST_CHI2 = 16.0  # larger chi-squares of up to three components are a contradiction (99.9 %)


def fix_open_direction(pose: Pose, check: ScanCheck) -> tuple[Pose, Pose]:
    """Move a pose along its least-known direction to where it fits the scan best.

    The tried places are on a line in the direction of largest variance by traffic, or on a circle
    where the yaw changes along it, as in a bend.

    Parameters
    ----------
    pose : Pose
        With its covariance, by traffic.
    check : ScanCheck
        The check of this pose.

    Returns
    -------
    moved, closed : Pose
        The pose at the likeliest place along the direction: with the covariance by traffic, to be
        updated by another scan check, and with the variance by the scan along the direction. The
        given pose twice where no direction is open, where scan and traffic together do not clearly
        prefer one place, or where the variance by the scan is hardly smaller.
    """
    covariance = pose.parsed_evidence().covariance
    if covariance is None or not _is_open(covariance) or not check.covered >= LEAST_COVERED:
        return pose, pose
    lever = np.array([1.0, 1.0, LEVER_M])
    variances, axes = np.linalg.eigh(covariance[np.ix_(PLANE, PLANE)] * np.outer(lever, lever))
    direction = axes[:, -1] / lever
    length = float(np.hypot(*direction[:2]))
    if length < _LEAST_LENGTH:
        return pose, pose  # mainly a rotation: the check itself tries all headings
    direction /= length  # the step of easting, northing (m), yaw (rad) for a metre
    variance_m2 = length**2 * float(variances[-1])
    best = _best_place_along(pose, check, direction, variance_m2)
    if best is None or best[1] > _MOST_SHARE * variance_m2:
        return pose, pose
    place, noise_m2 = best
    row = np.zeros(6)
    row[PLANE] = direction * (length * lever) ** 2  # projects a step of the pose to the direction
    step = covariance @ row / (row @ covariance @ row)  # for a metre along; with height and tilt
    frame = np.eye(6)
    frame[:2, :2] = rotation(float(direction[2]) * place)
    steps = dict(zip(COMPONENTS, step * place * POSE_UNITS, strict=True))
    steps["easting"], steps["northing"] = along_arc(*(direction * place))
    turned = frame @ covariance @ frame.T
    moved = _apply_steps(pose, steps, turned)
    noise = np.array([[noise_m2]])
    return moved, _updated(moved, turned, (frame @ row)[None], np.zeros(1), noise) or moved


def _best_place_along(
    pose: Pose, check: ScanCheck, direction: Floats, variance_m2: float
) -> tuple[float, float] | None:
    """Return the likeliest place along a direction (m) and its variance; None if it is ambiguous.

    Parameters
    ----------
    pose, check
        As for :func:`fix_open_direction`.
    direction : (3,) array
        Step of easting, northing (m), yaw (rad) for a metre along it.
    variance_m2 : float
        Variance of the place along it, by traffic.
    """
    places = np.arange(-_ALONG_M, _ALONG_M + 0.5 * _STEP_M, _STEP_M)
    ahead, left = rotation(-math.radians(pose.yaw)) @ direction[:2]
    turns = direction[2] * places
    offsets = [*along_arc(ahead * places, left * places, turns), np.degrees(turns)]
    alignment, patch = align(check.standing, check.structure), check.standing.patch
    patches = np.array([
        np.bincount(patch, alignment.closeness_at(each)) for each in np.transpose(offsets).tolist()
    ])  # fmt: skip
    top = int(np.argmax(patches.sum(axis=1)))
    losses = patches[top] - patches
    z_scores = losses.sum(axis=1) / np.maximum(np.sqrt((losses**2).sum(axis=1)), _SMALL)
    chi2 = z_scores**2 + (places**2 - places[top] ** 2) / variance_m2
    likely = chi2 - chi2.min() < CLEAR_SIGMAS**2
    if likely[[0, -1]].any() or np.count_nonzero(np.diff(likely)) > 2:
        return None  # likely places reach the end of the line, or are several
    count = patches.shape[1]
    drawn = np.random.default_rng(0).multinomial(
        count, np.full(count, 1.0 / count), size=_PLACE_DRAWS
    )
    drawn_places = places[likely][np.argmax(patches[likely] @ drawn.T, axis=0)]
    return float(drawn_places.mean()), float(np.var(drawn_places)) + MAP_SIGMA_M**2


def _is_open(covariance: Floats) -> bool:
    """Return whether likely poses by traffic differ by more than the check takes for the same."""
    yaw_deg = math.degrees(math.sqrt(covariance[5, 5]))
    return BETTER_SIGMAS * longest_m(covariance) > SAME_M or BETTER_SIGMAS * yaw_deg > SAME_DEG


def updated_by_scan(pose: Pose, check: ScanCheck) -> Pose | None:
    """Return a pose updated by the offset at which static structures fit the scan best.

    Parameters
    ----------
    pose : Pose
        With its covariance, by traffic.
    check : ScanCheck
        The check of this pose, or of one nearby.

    Returns
    -------
    Pose or None
        The given pose where it states no covariance, where the check does not confirm its pose, or
        where static structures leave a direction open; None where scan and traffic contradict each
        other.
    """
    known = pose.parsed_evidence().covariance
    if known is None or check.verdict != CONFIRMS or check.best is None:
        return pose
    offset_noise = offset_covariance(align(check.standing, check.structure), check.best)
    if offset_noise is None:
        return pose
    to_map, rows = _offset_to_map(check.pose), np.eye(6)[PLANE]
    # shift of the scan against the map: in place, and in yaw at the usual distance of structures
    map_noise = np.diag(np.square([MAP_SIGMA_M, MAP_SIGMA_M, MAP_SIGMA_M / LEVER_M]))
    turn = math.radians(math.remainder(check.pose.yaw - pose.yaw, 360.0))
    gap = to_map @ np.array(check.best.place)
    gap += [*(check.pose.position - pose.position)[:2], turn]
    return _updated(pose, known, rows, gap, to_map @ offset_noise @ to_map.T + map_noise)


def _updated(
    pose: Pose, covariance: Floats, rows: Floats, gap: Floats, noise: Floats
) -> Pose | None:
    """Return a pose after a Kalman measurement update; None where it contradicts the measurement.

    Parameters
    ----------
    pose : Pose
        The pose before.
    covariance : (6, 6) array
        Covariance of the pose, metres and radians.
    rows : (k, 6) array
        Jacobian of the measurement.
    gap : (k,) array
        Innovation: measured less predicted.
    noise : (k, k) array
        Covariance of the measurement.
    """
    inverse = np.linalg.inv(rows @ covariance @ rows.T + noise)
    if gap @ inverse @ gap > _MOST_CHI2:
        return None
    gain = covariance @ rows.T @ inverse
    updated = covariance - gain @ rows @ covariance
    steps = dict(zip(COMPONENTS, gain @ gap * POSE_UNITS, strict=True))
    return _apply_steps(pose, steps, (updated + updated.T) / 2.0)


def _apply_steps(pose: Pose, steps: Mapping[str, float], covariance: Floats) -> Pose:
    """Return a pose moved by steps of its components, m and degrees, with a new covariance."""
    moved = {name: getattr(pose, name) + float(value) for name, value in steps.items()}
    moved["yaw"] = math.remainder(moved["yaw"], 360.0)
    evidence = {**pose.evidence, **stated(covariance), "observable": is_fixed(covariance)}
    return replace(pose, **moved, evidence=evidence)


def offset_covariance(alignment: Alignment, best: PoseOffset) -> Floats | None:
    """Return the covariance of the best offset, (ahead, left, turn): metres and degrees.

    Bootstrap over patches of neighbouring cells, which are independent. Each draw climbs to its
    maximum from another random start, so that the maxima scatter like the starts in an open
    direction, as along a single wall.

    Returns
    -------
    (3, 3) array, or None where a direction is open.
    """
    rng, tops = np.random.default_rng(0), []
    standing, patch = alignment.standing, alignment.standing.patch
    cells = [np.flatnonzero(patch == k) for k in range(int(patch.max()) + 1)]
    for _ in range(_OFFSET_DRAWS):
        rows = np.concatenate([cells[k] for k in rng.integers(0, len(cells), len(cells))])
        drawn = Standing(points=standing.points[rows], rustles=standing.rustles[rows])
        start = np.array(best.place) + rng.uniform(-_START_SPREAD, _START_SPREAD)
        tops.append(replace(alignment, standing=drawn).climb(start.tolist()).place)
    covariance = np.cov(tops, rowvar=False)
    lengths = np.diag([1.0, 1.0, math.radians(LEVER_M)])
    longest_spread_m = math.sqrt(float(np.linalg.eigvalsh(lengths @ covariance @ lengths)[-1]))
    return None if longest_spread_m > _OPEN_M else np.asarray(covariance)


def _offset_to_map(pose: Pose) -> Floats:
    """Return the matrix from ahead, left (m), turn (deg) to easting, northing (m), yaw (rad)."""
    yaw = math.radians(pose.yaw)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, math.radians(1.0)]])
