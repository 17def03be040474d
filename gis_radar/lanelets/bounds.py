"""The two bounds of a lanelet as arrays of points: direction, arc length, rungs between them.

Every function takes bounds as (n, 2) or (n, 3) arrays in metres, rows in order along the line;
where heights are given they are carried along and never decide anything.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gis_radar.arrays import Booleans, Floats
from gis_radar.lanelets.ribbons import arc_lengths, matched, turn


class CannotMendError(Exception):
    """A lanelet has to be left out; the message is the reason, in plain words."""


# How much of the plain arc-length pairing is kept; the first that works is taken.
_BLENDS = (0.75, 0.5, 0.25, 0.1, 0.03)
# What a bound may lose to cut corners before divisions move to corners; share of the outline.
_LOSS = 0.001
_LOSS_EACH = 0.1  # share of that loss from which a corner counts
# A lanelet that is whole is cut soundly at this length, see :mod:`mending`.
_SOUND_M = 0.5


class Drawn(NamedTuple):
    """Whether each bound has to be turned round to run in the driving direction."""

    turn_left: bool
    turn_right: bool


def without_repeats(bound: Floats) -> Floats:
    """Return a bound without points that repeat the one before them (in east and north)."""
    moved = np.any(bound[1:, :2] != bound[:-1, :2], axis=1)
    kept: Floats = bound[np.concatenate([[True], moved])]
    return kept


def length(bound: Floats) -> float:
    """Return the horizontal length of a bound in metres."""
    return float(arc_lengths(bound)[-1])


def at_fractions(bound: Floats, fractions: Floats) -> Floats:
    """Return the points at fractions 0 to 1 of a bound's horizontal length: (k, 2 or 3)."""
    along = arc_lengths(bound)
    where = fractions * along[-1]
    return np.column_stack([np.interp(where, along, column) for column in bound.T])


def slices(left: Floats, right: Floats, slice_m: float = _SOUND_M) -> int:
    """Return into how many slices of about `slice_m` metres a lanelet is cut, at least one."""
    return max(1, round((length(left) + length(right)) / 2.0 / slice_m))


def drawn_direction(left: Floats, right: Floats) -> Drawn:
    """Find the driving direction: the one that has the left bound on the left.

    First the bounds are made parallel: of the two ways to pair them, the one with the shorter
    rungs (mean over the length, so that loops with equal ends are distinguished, too). Then the
    signed area between them shows on which side the left bound is; if on the right, both are
    turned.

    Parameters
    ----------
    left, right : (n, 2 or 3) array
        The bounds as drawn, each in any direction, with two distinct points at least.

    Returns
    -------
    Drawn
        Which of them to turn round.
    """
    fractions = np.linspace(0.0, 1.0, 2 * max(len(left), len(right)) + 7)
    origin = left[0, :2]
    p, q = (
        at_fractions(left[:, :2] - origin, fractions),
        at_fractions(right[:, :2] - origin, fractions),
    )
    with_it = np.hypot(*(p - q).T).mean()
    against = np.hypot(*(p - q[::-1]).T).mean()
    opposed = bool(against < with_it)
    backward = bool(signed_area(p, q[::-1] if opposed else q) < 0.0)
    return Drawn(turn_left=backward, turn_right=backward != opposed)


def signed_area(left: Floats, right: Floats) -> float:
    """Return the area between two parallel bounds in m2, positive if `left` is on the left."""
    ring = np.concatenate([right[:, :2], left[::-1, :2]]) - right[0, :2]
    ahead = np.roll(ring, -1, axis=0)
    return float(np.sum(ring[:, 0] * ahead[:, 1] - ring[:, 1] * ahead[:, 0]) / 2.0)


def rungs(left: Floats, right: Floats, n: int) -> tuple[Floats, Floats]:
    """Return n + 1 pairs of points that cut a lanelet into n slices.

    Both bounds are divided into n parts of equal length. Where that would cut off too much of
    their corners, divisions move there. Where it would make slices that cross
    themselves (a bound with a bay, a very tight turn), points are paired by the shortest rungs
    instead, blended with equal lengths as far as all slices come out sound.

    Parameters
    ----------
    left, right : (k, 2 or 3) array
        The cleaned bounds in driving direction.
    n : int
        How many slices.

    Returns
    -------
    left_points, right_points : (n + 1, 2 or 3) array
        The ends of the rungs; first and last are the ends of the bounds, exactly.
    """
    even = np.linspace(0.0, 1.0, n + 1)
    best, fewest = (left[[0, -1]], right[[0, -1]]), n + 1
    for on_left, on_right in _pairings(left, right, even):
        pair = at_fractions(left, on_left), at_fractions(right, on_right)
        bad = int(np.count_nonzero(~sound(*pair)))
        if bad < fewest:
            best, fewest = pair, bad
        if not bad:
            return pair
    return best


def sound_rungs(left: Floats, right: Floats, slice_m: float) -> tuple[Floats, Floats]:
    """Return rungs about `slice_m` metres apart whose slices are all sound.

    Where that length makes slices that cross themselves (a long slice of a tight turn), the
    lanelet is cut into more; where even many do not help, into slices of half a metre.

    Parameters
    ----------
    left, right : (k, 2 or 3) array
        The cleaned bounds in driving direction.
    slice_m : float
        The length asked for, metres.

    Returns
    -------
    left_points, right_points : (n + 1, 2 or 3) array
        The ends of the rungs, as from :func:`rungs`.

    Raises
    ------
    CannotMendError
        If no number of slices is sound: the bounds have not been mended.
    """
    asked, surely = slices(left, right, slice_m), slices(left, right)
    for n in (*_growing(asked, 2 * max(asked, surely)), surely):
        pair = rungs(left, right, n)
        if sound(*pair).all():
            return pair
    raise CannotMendError("it cannot be cut into sound tiles")


def _growing(n: int, most: int) -> Iterator[int]:
    while n <= most:
        yield n
        n += max(1, n // 4)


def _pairings(left: Floats, right: Floats, even: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield ways to divide both bounds, the plainest first: fractions of their lengths."""
    most_loss = _LOSS * abs(signed_area(left, right))
    snapped = [_snapped(bound, even, most_loss) for bound in (left, right)]
    if any(fractions is not even for fractions in snapped):
        yield snapped[0], snapped[1]
    yield even, even
    path = matched(left, right)
    for keep in _BLENDS:
        on_left = keep * even + (1.0 - keep) * np.interp(even, path.even, path.left)
        on_right = keep * even + (1.0 - keep) * np.interp(even, path.even, path.right)
        yield on_left, on_right


def _snapped(bound: Floats, even: Floats, most_loss: float) -> Floats:
    """Put divisions on corners where cutting these off would lose too much area.

    Parameters
    ----------
    bound : (k, 2 or 3) array
        The bound.
    even : (n + 1,) array
        Equal fractions of its length.
    most_loss : float
        Area in m2 that may be lost to cut corners.

    Returns
    -------
    (n + 1,) array
        Ascending fractions, evenly spread between corners; `even` itself where none had to move.
    """
    if len(even) < 3 or len(bound) < 3:
        return even
    along = arc_lengths(bound)
    corners = along[1:-1] / along[-1]
    chords, n = at_fractions(bound[:, :2], even), len(even) - 1
    within = np.minimum((corners * n).astype(np.int64), n - 1)
    loss = np.abs(turn(chords[within], chords[within + 1], bound[1:-1, :2])) / 2.0
    if loss.sum() <= most_loss:
        return even
    worst = np.argsort(loss)[::-1][: n - 1]
    kept = np.sort(corners[worst[loss[worst] > _LOSS_EACH * most_loss]])
    # The division nearest to each corner, but every corner its own.
    turn_of = np.arange(len(kept))
    nearest = np.maximum.accumulate(np.rint(kept * n).astype(np.int64) - turn_of) + turn_of
    nearest = np.clip(nearest, turn_of + 1, n - len(kept) + turn_of)
    where = np.concatenate([[0], nearest, [n]])
    moved: Floats = np.interp(np.arange(n + 1), where, np.concatenate([[0.0], kept, [1.0]]))
    return moved


def sound(left_points: Floats, right_points: Floats) -> Booleans:
    """Return which slices between rungs are simple, and have their left side on the left.

    A quadrilateral is simple and runs counter-clockwise exactly if one of its diagonals cuts it
    into two counter-clockwise triangles. Slices that all are, and share their rungs, tile the
    outline of the rungs' ends without gap or overlap.

    Parameters
    ----------
    left_points, right_points : (n + 1, 2 or 3) array
        The ends of the rungs.

    Returns
    -------
    (n,) array of bool
    """
    origin = right_points[0, :2]
    p, q = right_points[:, :2] - origin, left_points[:, :2] - origin
    r0, r1, l0, l1 = p[:-1], p[1:], q[:-1], q[1:]
    one_way = (turn(r0, r1, l1) > 0.0) & (turn(r0, l1, l0) > 0.0)
    other_way = (turn(r0, r1, l0) > 0.0) & (turn(r1, l1, l0) > 0.0)
    answer: Booleans = one_way | other_way
    return answer
