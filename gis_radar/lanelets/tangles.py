"""Lines that cross: a bound that crosses itself, or the other bound."""

from __future__ import annotations

import numpy as np
from shapely import LineString, Point, STRtree, box, get_coordinates

from gis_radar.arrays import Floats, Integers
from gis_radar.lanelets.bounds import CannotMendError, without_repeats
from gis_radar.lanelets.ribbons import arc_lengths

_LOOP_SHARE = 0.5  # of the bound; a longer loop may be the road itself
_END_M = 1.0  # from an end, in which bounds may cross by careless drawing
_END_SHARE = 0.2  # of the bound, where that is less
_PASSES = 20  # a loop each
_NEAR_M = 1e-6  # rounding of coordinates of 1e7 m in float64 is 2e-9


def without_loops(bound: Floats, side: str) -> Floats:
    """Return a bound with small loops cut off where it crosses itself.

    Parameters
    ----------
    bound : (n, 2 or 3) array
        The points of the bound, metres.
    side : str
        `left` or `right`, for the reason.

    Returns
    -------
    (m, 2 or 3) array
        The same array where there was no loop.

    Raises
    ------
    CannotMendError
        If a loop is more than half of the bound.
    """
    for _ in range(_PASSES):
        if LineString(bound[:, :2]).is_simple:
            return bound
        bound = _first_loop_cut(bound, side)
    raise CannotMendError(f"the {side} bound crosses itself again and again")


def _first_loop_cut(bound: Floats, side: str) -> Floats:
    i, j = _near_pairs(bound[:, :2])
    on_first, on_second = _crossings(bound[:, :2], i, j)
    hits = np.flatnonzero(np.isfinite(on_first))
    if not len(hits):
        raise CannotMendError(f"the {side} bound touches itself")
    first, second = int(i[hits[0]]), int(j[hits[0]])
    t, u = on_first[hits[0]], on_second[hits[0]]
    along = arc_lengths(bound)
    start = along[first] + t * (along[first + 1] - along[first])
    stop = along[second] + u * (along[second + 1] - along[second])
    if stop - start > _LOOP_SHARE * along[-1]:
        raise CannotMendError(f"the {side} bound crosses itself in a large loop")
    knot = bound[first] + t * (bound[first + 1] - bound[first])
    return without_repeats(np.concatenate([bound[: first + 1], knot[None], bound[second + 1 :]]))


def _near_pairs(line: Floats) -> tuple[Integers, Integers]:
    """Return the segments i < j of a line whose boxes meet, ascending by i, then j."""
    low = np.minimum(line[1:], line[:-1]) - _NEAR_M
    high = np.maximum(line[1:], line[:-1]) + _NEAR_M
    boxes = box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    i, j = STRtree(boxes).query(boxes)
    i, j = i[i < j], j[i < j]
    order = np.lexsort((j, i))
    return i[order], j[order]


def _crossings(line: Floats, i: Integers, j: Integers) -> tuple[Floats, Floats]:
    """Return where on segments i and j of a line (0 to 1) they meet; NaN if they do not.

    Segments that follow each other share a point, and meet otherwise only if the second one runs
    back over the first.
    """
    ab, cd, ac = line[i + 1] - line[i], line[j + 1] - line[j], line[j] - line[i]
    across = _cross(ab, cd)
    one, other = np.hypot(*ab.T), np.hypot(*cd.T)
    adjacent = j == i + 1
    back = adjacent & (np.abs(across) <= 1e-12 * one * other) & (np.sum(ab * cd, axis=1) < 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = _cross(ac, cd) / across, _cross(ac, ab) / across
    met = ~adjacent & (across != 0.0) & (t >= 0.0) & (t <= 1.0) & (u >= 0.0) & (u <= 1.0)
    t = np.where(back, 1.0 - np.minimum(1.0, other / one), np.where(met, t, np.nan))
    u = np.where(back, np.minimum(1.0, one / other), np.where(met, u, np.nan))
    return t, u


def _cross(a: Floats, b: Floats) -> Floats:
    area: Floats = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return area


def part_at_crossings(left: Floats, right: Floats, repairs: list[str]) -> tuple[Floats, Floats]:
    """Cut off what is beyond a crossing of the two bounds right at an end.

    Raises
    ------
    CannotMendError
        If the bounds cross or meet anywhere else.
    """
    for _ in range(4):
        meeting = _meeting_places(left, right)
        if not len(meeting):
            return left, right
        here = meeting[0]
        on_left, on_right = _along(left, here), _along(right, here)
        if _near_start(left, on_left) and _near_start(right, on_right):
            left, right = _cut_start(left, on_left), _cut_start(right, on_right)
            repairs.append("bounds that crossed at the start cut there")
        elif _near_start(left[::-1], _along(left[::-1], here)) and _near_start(
            right[::-1], _along(right[::-1], here)
        ):
            left = _cut_start(left[::-1], _along(left[::-1], here))[::-1]
            right = _cut_start(right[::-1], _along(right[::-1], here))[::-1]
            repairs.append("bounds that crossed at the end cut there")
        else:
            raise CannotMendError("its bounds cross or meet between its ends")
    raise CannotMendError("its bounds cross again and again")


def _meeting_places(left: Floats, right: Floats) -> Floats:
    """Return where the bounds meet, apart from ends that they share: (k, 2)."""
    met = LineString(left[:, :2]).intersection(LineString(right[:, :2]))
    places: Floats = get_coordinates(met)
    shared = _shared_runs(left, right)
    if not len(places) or not len(shared):
        return places
    gaps = np.hypot(*(places[:, None] - shared[None]).transpose(2, 0, 1))
    apart: Floats = places[gaps.min(axis=1) > 1e-6]
    return apart


def _shared_runs(left: Floats, right: Floats) -> Floats:
    """Return the points that both bounds share from either end on."""
    n = min(len(left), len(right))
    same_start = np.all(left[:n, :2] == right[:n, :2], axis=1)
    same_end = np.all(left[::-1][:n, :2] == right[::-1][:n, :2], axis=1)
    head = int(np.argmin(same_start)) if not same_start.all() else n
    tail = int(np.argmin(same_end)) if not same_end.all() else n
    return np.concatenate([left[:head, :2], left[::-1][:tail, :2]])


def _along(bound: Floats, point: Floats) -> float:
    """Return how far along a bound a point on it is, in metres."""
    return float(LineString(bound[:, :2]).project(Point(point)))


def _near_start(bound: Floats, along: float) -> bool:
    return along <= min(_END_M, _END_SHARE * float(arc_lengths(bound)[-1]))


def _cut_start(bound: Floats, along: float) -> Floats:
    lengths = arc_lengths(bound)
    start = [np.interp(along, lengths, column) for column in bound.T]
    return without_repeats(np.concatenate([[start], bound[lengths > along]]))
