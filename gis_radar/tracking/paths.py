"""Paths of vehicles: polylines through a filter's states that a vehicle can have driven."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gis_radar.base import Floats, Integers, compiled, heading_difference
from gis_radar.tracking.size import LONGEST_M

_TIGHTEST_M = 5.0  # radius of the turning circle of a small car
_FASTEST_MPS = 70.0  # largest speed, 250 km/h
_TURN_ERROR_RAD = 0.35  # largest error of the difference of two states' headings
# Sigma of a vehicle's direction about that of its path, radians: 3 degrees, by errors of maps in
# bends, lane changes, and swinging bodies.
DIRECTION_RAD = 0.05
_SMOOTHING_M = 3  # sigma of the normal kernel by which a path is smoothed, whole metres
_ROUNDING_M = 1e-6  # more than distances of a few kilometres are off by rounding
_ANCHORS = 5  # states that are tried as a start of the path: hardly all of them are outliers


@dataclass(frozen=True, eq=False)
class Path:
    """A polyline in the map that goes on straight beyond its ends.

    Parameters
    ----------
    points : (n, 2) array
        Its vertices, metres, two at least.
    """

    points: Floats

    @cached_property
    def s_m(self) -> Floats:
        """Distance of each vertex from the first, metres."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.points, axis=0).T))])

    @cached_property
    def heading(self) -> Floats:
        """Direction of each segment, radians, without jumps."""
        return np.unwrap(np.arctan2(*np.diff(self.points, axis=0).T[::-1]))

    def at(self, s_m: Floats) -> tuple[Floats, Floats]:
        """Return places (k, 2) and headings (k,) at distances along the path."""
        last = len(self.s_m) - 2
        k = np.clip(np.searchsorted(self.s_m, s_m, side="right") - 1, 0, last)
        away = (s_m - self.s_m[k])[:, None] * self._direction[k]
        return self.points[k] + away, self.heading_at(s_m)

    def heading_at(self, s_m: Floats) -> Floats:
        """Return headings (k,) at distances along the path."""
        return np.interp(s_m, self._middle, self.heading)

    @cached_property
    def most_bend(self) -> float:
        """Largest change of heading within about a metre of the path, radians."""
        return float(np.abs(np.gradient(self.heading)).max()) if len(self.heading) > 1 else 0.0

    @cached_property
    def _middle(self) -> Floats:
        return np.asarray(0.5 * (self.s_m[1:] + self.s_m[:-1]))

    @cached_property
    def _direction(self) -> Floats:
        return np.column_stack([np.cos(self.heading), np.sin(self.heading)])

    def project(self, points: Floats, guess: Floats, reach_m: float) -> tuple[Floats, Floats]:
        """Return distances (m) of points along and left of the path, near a guess of the former.

        Parameters
        ----------
        points : (k, 2) array
            Metres.
        guess : (k,) array
            Approximate distance along the path, metres.
        reach_m : float
            Largest error of the guess, metres.
        """
        return _project(np.ascontiguousarray(points), guess, self.points, self.s_m, reach_m)


@compiled
def _project(
    points: Floats, guess: Floats, line: Floats, s_m: Floats, reach_m: float
) -> tuple[Floats, Floats]:  # pragma: no cover - compiled
    """Return what `project` does; segments are passed over that are farther than the best one.

    No place within `a` metres along the path of a vertex at distance `d` is nearer than ``d - a``.
    """
    along, left = np.empty(len(points)), np.empty(len(points))
    last = len(s_m) - 2
    for i in range(len(points)):
        low = max(min(np.searchsorted(s_m, guess[i] - reach_m) - 1, last), 0)
        high = max(min(np.searchsorted(s_m, guess[i] + reach_m), last + 1), low + 1)
        near = min(max(np.searchsorted(s_m, guess[i]), low), high - 1)
        least = math.hypot(points[i, 0] - line[near, 0], points[i, 1] - line[near, 1]) + _ROUNDING_M
        best, k = 1e18, low
        while k < high:
            dx, dy = points[i, 0] - line[k, 0], points[i, 1] - line[k, 1]
            beyond = s_m[k] + math.sqrt(dx * dx + dy * dy) - least
            if 0 < k < last and s_m[k + 1] < beyond:
                k += 1
                while k < min(high, last) and s_m[k + 1] < beyond:
                    k += 1
                continue
            bx, by = line[k + 1, 0] - line[k, 0], line[k + 1, 1] - line[k, 1]
            length = np.sqrt(bx * bx + by * by)
            t = (dx * bx + dy * by) / (length * length)
            if k > 0:
                t = max(t, 0.0)
            if k < last:
                t = min(t, 1.0)
            ex, ey = dx - t * bx, dy - t * by
            if ex * ex + ey * ey < best:
                best = ex * ex + ey * ey
                least = min(least, math.sqrt(best) + _ROUNDING_M)
                along[i] = s_m[k] + t * length
                left[i] = (bx * dy - by * dx) / length
            k += 1
    return along, left


def path_through(states: Floats, spacing_m: float) -> tuple[Path, Floats]:
    """Return a smooth path through states in the order of time, and the place of each along it.

    Only states ahead of earlier ones count: those of a body's rear lie behind those of its front.

    Parameters
    ----------
    states : (n, 4) array
        East, north (m), heading (radians), and time (s).
    spacing_m : float
        Distance between the states that count.

    Returns
    -------
    path : Path
        It goes on for 20 m before the first and after the last state.
    along_m : (n,) array
        Distance along it, at each state, of the last state that counts so far.
    """
    kept = _progress(np.ascontiguousarray(states[:, :4]), spacing_m)
    ends = states[kept[[0, -1]], 2]
    way = np.column_stack([np.cos(ends), np.sin(ends)])
    places = states[kept, :2]
    # straight ends as long as a body, for its parts beyond the first and last place
    before = places[0] - np.arange(20.0, 0.0, -1.0)[:, None] * way[0]
    after = places[-1] + np.arange(1.0, 21.0)[:, None] * way[1]
    path = _smoothed(np.vstack([before, _bridged(states[kept, :3]), after]))
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
    way_m *= (path.s_m[-1] - 40.0) / max(way_m[-1], 1.0)
    counts = np.maximum(np.searchsorted(kept, np.arange(len(states)), side="right") - 1, 0)
    return path, 20.0 + way_m[counts]


def _progress(states: Floats, spacing_m: float) -> Integers:
    """Return rows of states `spacing_m` apart, both ways from the start that gives most."""
    last = len(states) - 1
    tracks: list[Integers] = []
    for anchor in np.unique(np.linspace(0, last, _ANCHORS).astype(np.int64)).tolist():
        after = _progress_from(states, anchor, 1, spacing_m)
        before = _progress_from(states, anchor, -1, spacing_m)
        tracks.append(np.concatenate([before[:0:-1], after]))
    return max(tracks, key=len)


@compiled
def _progress_from(
    states: Floats, first: int, sign: int, spacing_m: float
) -> Integers:  # pragma: no cover - compiled
    """Return the rows from one on, by time (1) or backward (-1), at steps of `spacing_m` ahead."""
    kept = np.empty(len(states), np.int64)
    kept[0], count, k = first, 1, first + sign
    while 0 <= k < len(states):
        last = kept[count - 1]
        dx, dy = states[k, 0] - states[last, 0], states[k, 1] - states[last, 1]
        ahead_m = sign * (dx * np.cos(states[k, 2]) + dy * np.sin(states[k, 2]))
        turn = abs(heading_difference(states[k, 2], states[last, 2]))
        way_m, lapse = np.hypot(dx, dy), abs(states[k, 3] - states[last, 3])
        # no vehicle turns within less distance, or is faster: such a state is an outlier
        able = turn < _TURN_ERROR_RAD + way_m / _TIGHTEST_M
        able = able and way_m < LONGEST_M + _FASTEST_MPS * lapse
        if ahead_m >= spacing_m and able:
            kept[count] = k
            count += 1
        k += sign
    return kept[:count]


def _bridged(states: Floats) -> Floats:
    """Return the places of states, with a cubic curve (Hermite) over gaps of more than 3 m."""
    parts, begin = list[Floats](), 0
    gaps = np.hypot(*np.diff(states[:, :2], axis=0).T)
    for k in np.flatnonzero(gaps > 3.0).tolist():
        a, b, gap = states[k], states[k + 1], float(gaps[k])
        t = np.linspace(0.0, 1.0, int(gap) + 2)[1:-1, None]
        out, back = (gap * np.array([np.cos(x[2]), np.sin(x[2])]) for x in (a, b))
        curve = (
            (2 * t**3 - 3 * t**2 + 1) * a[:2] + (t**3 - 2 * t**2 + t) * out
            + (3 * t**2 - 2 * t**3) * b[:2] + (t**3 - t**2) * back
        )  # fmt: skip
        parts += [states[begin : k + 1, :2], curve]
        begin = k + 1
    return np.vstack([*parts, states[begin:, :2]])


def _smoothed(line: Floats) -> Path:
    """Return a line with a vertex a metre, smoothed so that its bends stay as they are.

    A kernel alone moves a bend to its inner side and begins it early. So the residual is smoothed
    and added, twice (Tukey's *twicing*): half of a wave of 11 m is left.
    """
    line = _every_metre(line)
    smooth = _filtered(line)
    for _ in range(2):
        smooth += _filtered(line - smooth)
    return Path(_every_metre(smooth))


def _every_metre(line: Floats) -> Floats:
    """Return a line resampled to a vertex a metre."""
    s = Path(line).s_m
    every = np.arange(0.0, s[-1], 1.0)
    return np.column_stack([np.interp(every, s, line[:, k]) for k in range(2)])


def _filtered(line: Floats) -> Floats:
    """Smooth a line by a normal kernel of `_SMOOTHING_M`, mirrored about its end points."""
    reach = 3 * _SMOOTHING_M
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTHING_M) ** 2)
    padded = np.vstack(
        [2 * line[0] - line[reach:0:-1], line, 2 * line[-1] - line[-2 : -reach - 2 : -1]]
    )
    return np.column_stack([np.convolve(each, kernel / kernel.sum(), "valid") for each in padded.T])
