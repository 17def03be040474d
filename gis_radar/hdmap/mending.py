"""Mend the bounds of a lanelet: loops, crossings, fold-backs, and ends without width.

Functions take bounds as (n, 2) or (n, 3) arrays in metres, in driving direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from shapely import LineString, Point, Polygon, STRtree, box, get_coordinates

from gis_radar.base import Floats, Integers, Text
from gis_radar.hdmap.bounds import (
    WRONG_TURN_M,
    CannotMendError,
    arc_lengths,
    at_fractions,
    bound_length,
    orientation,
    ribbon_between,
    rungs,
    signed_area,
    slices,
    sound,
    without_repeats,
)

_NO_WIDTH_M = 0.01  # maps are drawn to centimetres
_NO_LENGTH_M = 0.01  # as _NO_WIDTH_M
_MOST_LENGTH_M = 100_000.0  # a longer bound has a node in the wrong place
_PASSES = 8  # each removes one stretch that runs backwards
# Metres a rung may grow to avoid a wrongly turned triangle, tried in this order.
_PENALTIES_M = (WRONG_TURN_M, 100.0, 10.0, 3.0)
_RESUME_M = 0.1  # after the rung that a bound crosses, so that the slice there has an area
_TINY = 1e-9  # rounding of fractions of a length
_OPPOSITE = 1e-6  # length of the sum of two unit vectors that cancel


@dataclass(frozen=True, kw_only=True)
class Mended:
    """The bounds of one lanelet, fit to be cut into slices.

    Parameters
    ----------
    left, right : (n, 2 or 3) array
        The cleaned bounds.
    repairs : tuple of str
        Description of each repair, in plain words.
    """

    left: Floats
    right: Floats
    repairs: tuple[str, ...]


def mend(left: Floats, right: Floats) -> Mended:
    """Return the bounds of a lanelet, mended so that it can be cut into sound slices.

    A sound lanelet is only freed of repeated points. Otherwise, in this order: small loops of a
    bound are cut off; bounds that cross near an end are cut there; ends without width are moved
    apart by 1 cm; stretches where a bound runs backwards are removed.

    Parameters
    ----------
    left, right : (n, 2 or 3) array
        The bounds in driving direction.

    Returns
    -------
    Mended
        The bounds, and the repairs.

    Raises
    ------
    CannotMendError
        If the lanelet must be left out; the message is the reason.
    """
    left, right = without_repeats(left), without_repeats(right)
    _require_extent(left, right)
    if is_sound(left, right):
        return Mended(left=left, right=right, repairs=())
    repairs: list[str] = []
    left, right = _without_loops(left, right, repairs)
    left, right = cut_at_crossings(left, right, repairs)
    left, right = _with_ends_apart(left, right, repairs)
    left, right = _without_fold_backs(left, right, repairs)
    _require_extent(left, right)
    if not is_sound(left, right):
        raise CannotMendError(Text("its outline crosses itself and cannot be mended"))
    return Mended(left=left, right=right, repairs=tuple(repairs))


def outline(left: Floats, right: Floats) -> Polygon:
    """Return the polygon between two bounds; a ring road has a hole."""
    if len(left) > 3 and len(right) > 3 and _closed(left) and _closed(right):
        rings = sorted((Polygon(left[:, :2]), Polygon(right[:, :2])), key=lambda ring: ring.area)
        return Polygon(rings[1].exterior, [rings[0].exterior])
    return Polygon(np.concatenate([right[:, :2], left[::-1, :2]]))


def is_sound(left: Floats, right: Floats) -> bool:
    """Return whether a lanelet needs no mending."""
    ends = np.hypot(*(left[[0, -1], :2] - right[[0, -1], :2]).T)
    return bool(
        ends.min() >= _NO_WIDTH_M * (1.0 - 1e-6)
        and LineString(left[:, :2]).is_simple
        and LineString(right[:, :2]).is_simple
        and outline(left, right).is_valid
        and sound(*rungs(left, right, slices(left, right))).all()
        and (_plainly_forward(left, right) or not _runs_backward(left, right))
    )


def _require_extent(left: Floats, right: Floats) -> None:
    """Refuse bounds without length, of impossible length, or without an area between them."""
    for side, bound in (("left", left), ("right", right)):
        if len(bound) < 2 or bound_length(bound) < _NO_LENGTH_M:
            raise CannotMendError(Text("the {} bound has no length", Text(side)))
        if bound_length(bound) > _MOST_LENGTH_M:
            far = Text("{:.0f} km long", bound_length(bound) / 1000.0)
            raise CannotMendError(
                Text("the {} bound is {}: a node is in the wrong place", Text(side), far)
            )
    mean_length = (bound_length(left) + bound_length(right)) / 2.0
    if abs(signed_area(left, right)) < _NO_WIDTH_M * mean_length:
        raise CannotMendError(Text("it has no width: its bounds lie on each other, or cross"))


def _closed(bound: Floats) -> bool:
    return bool(np.all(bound[0, :2] == bound[-1, :2]))


def _without_loops(left: Floats, right: Floats, repairs: list[str]) -> tuple[Floats, Floats]:
    """Return the bounds without small loops; add a repair for each that had one."""
    cleaned = []
    for side, bound in (("left", left), ("right", right)):
        cleaned.append(without_loops(bound, side))
        if cleaned[-1] is not bound:
            repairs.append(Text("a loop of the {} bound cut off", Text(side)))
    return cleaned[0], cleaned[1]


def _with_ends_apart(left: Floats, right: Floats, repairs: list[str]) -> tuple[Floats, Floats]:
    """Return the bounds with ends without width moved apart by 1 cm, across the lanelet."""
    if _gap(left[0], right[0]) < _NO_WIDTH_M:
        left, right = _with_start_apart(left, right)
        repairs.append("start without width parted by 1 cm")
    if _gap(left[-1], right[-1]) < _NO_WIDTH_M:
        # Seen backwards, the end is a start, and left is right.
        right, left = (bound[::-1] for bound in _with_start_apart(right[::-1], left[::-1]))
        repairs.append("end without width parted by 1 cm")
    return left, right


def _gap(a: Floats, b: Floats) -> float:
    return float(np.hypot(*(a - b)[:2]))


def _with_start_apart(left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return the bounds with their common first points moved apart, across the mean direction."""
    shared = min(len(left), len(right))
    gaps = np.hypot(*(left[:shared, :2] - right[:shared, :2]).T)
    touching = int(np.argmax(gaps >= _NO_WIDTH_M)) if np.any(gaps >= _NO_WIDTH_M) else shared
    left, right = left.copy(), right.copy()
    for i in range(touching):
        middle = (left[i, :2] + right[i, :2]) / 2.0
        along = _heading(left, i) + _heading(right, i)
        if np.hypot(*along) < _OPPOSITE:
            raise CannotMendError(Text("its bounds leave a common end in opposite directions"))
        across = np.array([-along[1], along[0]]) / np.hypot(*along) * _NO_WIDTH_M / 2.0
        left[i, :2], right[i, :2] = middle + across, middle - across
    return left, right


def _heading(bound: Floats, i: int) -> Floats:
    """Return the unit vector along a bound after its point `i`, before it for the last point."""
    i = min(i, len(bound) - 2)
    step = bound[i + 1, :2] - bound[i, :2]
    unit: Floats = step / np.hypot(*step)
    return unit


def _plainly_forward(left: Floats, right: Floats) -> bool:
    """Return whether the other bound is on the proper side all along, paired by equal lengths."""
    return bool(_has_on_right(left, right) and _has_on_right(right[::-1], left[::-1]))


def _has_on_right(bound: Floats, other: Floats) -> bool:
    """Return whether all of a bound has the other one on its right."""
    along = arc_lengths(bound)
    middle = (along[1:] + along[:-1]) / 2.0 / along[-1]
    opposite = at_fractions(other[:, :2], middle)
    return bool(np.all(orientation(opposite, bound[1:, :2], bound[:-1, :2]) > 0.0))


def _runs_backward(left: Floats, right: Floats) -> bool:
    ribbon = ribbon_between(left, right)
    return len(ribbon.left_wrong) > 0 or len(ribbon.right_wrong) > 0


def _without_fold_backs(left: Floats, right: Floats, repairs: list[str]) -> tuple[Floats, Floats]:
    """Return the bounds without the stretches where one runs backwards.

    A very slanted rung can make a backward stretch look forward. If slices then still cross
    themselves, it is tried again with less slanted rungs allowed.
    """
    for penalty_m in _PENALTIES_M:
        forward = _unfolded_both(left, right, penalty_m)
        if is_sound(*forward):
            break
    for side, before, after in zip(("left", "right"), (left, right), forward, strict=True):
        if after is not before:
            repairs.append(Text("fold-back of the {} bound taken out", Text(side)))
    return forward


def _unfolded_both(left: Floats, right: Floats, penalty_m: float) -> tuple[Floats, Floats]:
    """Return the bounds without stretches that run backwards, at most `_PASSES` of them."""
    for _ in range(_PASSES):
        ribbon = ribbon_between(left, right, penalty_m)
        if len(ribbon.left_wrong):
            left = _unfolded(left, right, ribbon.left_wrong[0], ribbon.left, ribbon.right)
        elif len(ribbon.right_wrong):
            # Seen backwards, the right bound is a left one.
            wrong = 1.0 - ribbon.right_wrong[-1, ::-1]
            reversed_pairs = 1.0 - ribbon.right[::-1], 1.0 - ribbon.left[::-1]
            right = _unfolded(right[::-1], left[::-1], wrong, *reversed_pairs)[::-1]
        else:
            break
        _require_extent(left, right)
    return left, right


def _unfolded(
    bound: Floats, other: Floats, wrong: Floats, on_bound: Floats, on_other: Floats
) -> Floats:
    """Return a left bound without its first stretch that runs backwards.

    From the turning point on, points behind the rung there are left out until the bound is ahead of
    it again. If it never is, the points ahead of the last rung are left out instead.
    """
    fractions = arc_lengths(bound) / bound_length(bound)
    tip = at_fractions(bound, wrong[:1])
    foot = at_fractions(other, np.interp(wrong[:1], on_bound, on_other))
    behind = orientation(foot[:, :2], tip[:, :2], bound[:, :2])
    ahead = np.flatnonzero((behind < 0.0) & (fractions >= wrong[1] - _TINY))
    if len(ahead):
        rest = _resumed(bound[ahead[0] - 1 :], behind[ahead[0] - 1 :])
        return without_repeats(np.concatenate([bound[fractions < wrong[0] - _TINY], tip, rest]))
    before_end = orientation(other[-1:, :2], bound[-1:, :2], bound[:, :2])
    last = int(np.flatnonzero((before_end > 0.0) & (fractions <= wrong[0] + _TINY))[-1:].sum())
    rest = _resumed(bound[last + 1 :: -1], -before_end[last + 1 :: -1])[::-1]
    return without_repeats(np.concatenate([rest, bound[-1:]]))


def _resumed(bound: Floats, behind: Floats) -> Floats:
    """Return a bound from `_RESUME_M` after the rung that its first segment crosses.

    `behind` is proportional to each point's distance behind the rung: positive for the first point,
    not for the second.
    """
    step = float(np.hypot(*(bound[1] - bound[0])[:2]))
    across = behind[0] - behind[1]
    share = float(np.clip(behind[0] / across, 0.0, 1.0)) if across > 0.0 else 0.0
    share += min(_RESUME_M / step, (1.0 - share) / 2.0)
    first = bound[0] + share * (bound[1] - bound[0])
    return np.concatenate([first[None], bound[1:]])


_LOOP_SHARE = 0.5  # longest loop, as a share of the bound; a longer one may be the road itself
_END_M = 1.0  # from an end, within which a crossing is careless drawing
_END_SHARE = 0.2  # the same as a share of the bound, where that is less
_MOST_LOOPS = 20  # of a bound
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
    for _ in range(_MOST_LOOPS):
        if LineString(bound[:, :2]).is_simple:
            return bound
        bound = without_first_loop(bound, side)
    raise CannotMendError(Text("the {} bound crosses itself again and again", Text(side)))


def without_first_loop(bound: Floats, side: str) -> Floats:
    """Return a bound that crosses itself without its first loop.

    Parameters
    ----------
    bound : (n, 2) or (n, 3) array
        Points of the bound, metres.
    side : str
        `left` or `right`, for the message.

    Returns
    -------
    (m, 2) or (m, 3) array
        The bound with the crossing's point in place of the loop.

    Raises
    ------
    CannotMendError
        If the bound only touches itself, or the loop is a large part of it.
    """
    i, j = _near_pairs(bound[:, :2])
    on_first, on_second = _crossings(bound[:, :2], i, j)
    hits = np.flatnonzero(np.isfinite(on_first))
    if not len(hits):
        raise CannotMendError(Text("the {} bound touches itself", Text(side)))
    first, second = int(i[hits[0]]), int(j[hits[0]])
    t, u = on_first[hits[0]], on_second[hits[0]]
    along = arc_lengths(bound)
    start = along[first] + t * (along[first + 1] - along[first])
    stop = along[second] + u * (along[second + 1] - along[second])
    if stop - start > _LOOP_SHARE * along[-1]:
        raise CannotMendError(Text("the {} bound crosses itself in a large loop", Text(side)))
    crossing = bound[first] + t * (bound[first + 1] - bound[first])
    return without_repeats(
        np.concatenate([bound[: first + 1], crossing[None], bound[second + 1 :]])
    )


def _near_pairs(line: Floats) -> tuple[Integers, Integers]:
    """Return pairs i < j of segments of a line whose bounding boxes meet, by i, then j."""
    low = np.minimum(line[1:], line[:-1]) - _NEAR_M
    high = np.maximum(line[1:], line[:-1]) + _NEAR_M
    boxes = box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    i, j = STRtree(boxes).query(boxes)
    i, j = i[i < j], j[i < j]
    order = np.lexsort((j, i))
    return i[order], j[order]


def _crossings(line: Floats, i: Integers, j: Integers) -> tuple[Floats, Floats]:
    """Return the places (0 to 1) on segments i and j of a line where they meet; NaN if nowhere.

    Consecutive segments share a point; they meet elsewhere only if the second runs back over the
    first.
    """
    ab, cd, ac = line[i + 1] - line[i], line[j + 1] - line[j], line[j] - line[i]
    across = _cross(ab, cd)
    length_i, length_j = np.hypot(*ab.T), np.hypot(*cd.T)
    adjacent = j == i + 1
    back = (
        adjacent & (np.abs(across) <= 1e-12 * length_i * length_j) & (np.sum(ab * cd, axis=1) < 0.0)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = _cross(ac, cd) / across, _cross(ac, ab) / across
    met = ~adjacent & (across != 0.0) & (t >= 0.0) & (t <= 1.0) & (u >= 0.0) & (u <= 1.0)
    t = np.where(back, 1.0 - np.minimum(1.0, length_j / length_i), np.where(met, t, np.nan))
    u = np.where(back, np.minimum(1.0, length_i / length_j), np.where(met, u, np.nan))
    return t, u


def _cross(a: Floats, b: Floats) -> Floats:
    area: Floats = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return area


def cut_at_crossings(left: Floats, right: Floats, repairs: list[str]) -> tuple[Floats, Floats]:
    """Return the bounds cut off at a crossing near an end.

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
            raise CannotMendError(Text("its bounds cross or meet between its ends"))
    raise CannotMendError(Text("its bounds cross again and again"))


def _meeting_places(left: Floats, right: Floats) -> Floats:
    """Return the points (k, 2) at which the bounds meet, without those shared from an end on."""
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
    """Return the distance (m) along a bound of a point on it."""
    return float(LineString(bound[:, :2]).project(Point(point)))


def _near_start(bound: Floats, along: float) -> bool:
    return along <= min(_END_M, _END_SHARE * float(arc_lengths(bound)[-1]))


def _cut_start(bound: Floats, along: float) -> Floats:
    lengths = arc_lengths(bound)
    start = [np.interp(along, lengths, column) for column in bound.T]
    return without_repeats(np.concatenate([[start], bound[lengths > along]]))
