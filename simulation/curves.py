"""Plane polylines: lengths, points along them, offsets and smooth turns.

A polyline is an ``(n, 2)`` array in metres, drawn in driving direction; left is positive.
"""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats

_STRAIGHT_RAD = np.radians(12.0)  # turns of less are drawn as a shift
_BACK_RAD = np.radians(150.0)  # turns of more are drawn as a U-turn


def arc_length(line: Floats) -> Floats:
    """Return the distance from the start to every vertex of a polyline, in metres."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def points_at(line: Floats, s_m: Floats) -> Floats:
    """Return the points of a polyline at the arc lengths `s_m`, clamped to its ends."""
    along = arc_length(line)
    return np.column_stack([np.interp(s_m, along, line[:, k]) for k in (0, 1)])


def tangents(line: Floats) -> Floats:
    """Return unit tangents at the vertices: the mean direction of the segments that meet."""
    steps = np.diff(line, axis=0)
    units = steps / np.maximum(np.hypot(*steps.T), 1e-12)[:, None]
    sums = np.vstack([units[:1], units[:-1] + units[1:], units[-1:]])
    return np.asarray(sums / np.maximum(np.hypot(*sums.T), 1e-12)[:, None])


def offset(line: Floats, left_m: float | Floats) -> Floats:
    """Return the polyline moved `left_m` to its left; by that much at vertices, too (mitre)."""
    along = tangents(line)
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    steps = np.diff(line, axis=0)
    units = steps / np.maximum(np.hypot(*steps.T), 1e-12)[:, None]
    first = np.vstack([units[:1], units])
    mitre = np.maximum(np.sum(first * along, axis=1), 0.5)
    return np.asarray(line + normals * (np.asarray(left_m) / mitre)[:, None])


def turn(start: Floats, start_dir: Floats, end: Floats, end_dir: Floats) -> Floats:
    """Return a cubic Bezier curve that leaves `start` and arrives at `end` in given directions.

    Where the two tangents meet ahead, its handles approximate a circular arc; else they are a part
    of the chord.
    """
    chord = float(np.hypot(*(end - start)))
    first, last = _handles(start, start_dir, end, end_dir, chord)
    control = np.array([start, start + first * start_dir, end - last * end_dir, end])
    u = np.linspace(0.0, 1.0, max(24, int(2.0 * chord)))[:, None]
    weights = np.hstack([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3])
    return np.asarray(weights @ control)


def _handles(
    start: Floats, start_dir: Floats, end: Floats, end_dir: Floats, chord: float
) -> tuple[float, float]:
    """Return the lengths of the two Bezier handles, in metres."""
    cross = start_dir[0] * end_dir[1] - start_dir[1] * end_dir[0]
    angle = float(np.arctan2(cross, start_dir @ end_dir))
    if abs(angle) < _STRAIGHT_RAD:
        return 0.4 * chord, 0.4 * chord
    if abs(angle) > _BACK_RAD:
        return 0.67 * chord, 0.67 * chord
    gap = end - start
    ahead = (gap[0] * end_dir[1] - gap[1] * end_dir[0]) / cross
    behind = (gap[1] * start_dir[0] - gap[0] * start_dir[1]) / cross
    if ahead <= 0.0 or behind <= 0.0:
        return 0.4 * chord, 0.4 * chord
    share = 4.0 / 3.0 * np.tan(abs(angle) / 4.0) / np.tan(abs(angle) / 2.0)
    return share * ahead, share * behind
