"""The two bounds of a lanelet as arrays of points: direction, arc length, rungs between them.

Every function takes bounds as (n, 2) or (n, 3) arrays in metres, rows in order along the line;
heights are carried along and never decide anything. A rung connects a point of the left bound with
one of the right; two consecutive rungs enclose a slice.

Where rungs at equal shares of both lengths fail, those of a ribbon are used: a strip of triangles
between the bounds, each with one side on one bound and its tip on the other. Of all strips that
only move forward, dynamic programming finds that with the least length of wrongly turned triangles
and then the shortest rungs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, Text


class CannotMendError(Exception):
    """A lanelet that must be left out; the message is the reason, in plain words."""


# Weights of the pairing by equal lengths, against the ribbon's; the first that works is taken.
_BLENDS = (0.75, 0.5, 0.25, 0.1, 0.03)
# Share of the outline that chords may cut off a bound's corners before rungs move to corners.
_LOSS_SHARE = 0.001
_CORNER_LOSS_SHARE = 0.1  # share of that loss from which on a rung moves to a corner
# Length of the slices into which every sound lanelet can be cut soundly, see :mod:`mending`.
_SOUND_M = 0.5


def without_repeats(bound: Floats) -> Floats:
    """Return a bound without points that repeat the one before them (in east and north)."""
    moved = np.any(bound[1:, :2] != bound[:-1, :2], axis=1)
    kept: Floats = bound[np.concatenate([[True], moved])]
    return kept


def bound_length(bound: Floats) -> float:
    """Return the horizontal length of a bound in metres."""
    return float(arc_lengths(bound)[-1])


def at_fractions(bound: Floats, fractions: Floats) -> Floats:
    """Return the points at fractions 0 to 1 of a bound's horizontal length: (k, 2 or 3)."""
    along = arc_lengths(bound)
    where = fractions * along[-1]
    return np.column_stack([np.interp(where, along, column) for column in bound.T])


def slices(left: Floats, right: Floats, slice_m: float = _SOUND_M) -> int:
    """Return the number of slices of about `slice_m` metres in a lanelet, at least one."""
    return max(1, round((bound_length(left) + bound_length(right)) / 2.0 / slice_m))


def drawn_direction(left: Floats, right: Floats) -> tuple[bool, bool]:
    """Find the driving direction: the one that has the left bound on the left.

    First the bounds are made parallel: of the two ways to pair them, the one with the shorter rungs
    is taken (mean over the length, which distinguishes loops with equal ends, too). Then the signed
    area between them shows the side of the left bound; if it is the right, both are reversed.

    Parameters
    ----------
    left, right : (n, 2 or 3) array
        The bounds as drawn, each in any direction, with two distinct points at least.

    Returns
    -------
    turn_left, turn_right : bool
        Which of them to reverse.
    """
    fractions = np.linspace(0.0, 1.0, 2 * max(len(left), len(right)) + 7)
    origin = left[0, :2]
    p, q = (
        at_fractions(left[:, :2] - origin, fractions),
        at_fractions(right[:, :2] - origin, fractions),
    )
    as_drawn_m = np.hypot(*(p - q).T).mean()
    reversed_m = np.hypot(*(p - q[::-1]).T).mean()
    opposed = bool(reversed_m < as_drawn_m)
    backward = bool(signed_area(p, q[::-1] if opposed else q) < 0.0)
    return backward, backward != opposed


def signed_area(left: Floats, right: Floats) -> float:
    """Return the area between two parallel bounds in m2, positive if `left` is on the left."""
    ring = np.concatenate([right[:, :2], left[::-1, :2]]) - right[0, :2]
    ahead = np.roll(ring, -1, axis=0)
    return float(np.sum(ring[:, 0] * ahead[:, 1] - ring[:, 1] * ahead[:, 0]) / 2.0)


def rungs(left: Floats, right: Floats, n: int) -> tuple[Floats, Floats]:
    """Return n + 1 pairs of points that cut a lanelet into n slices.

    Both bounds are divided into n parts of equal length. Where that would cut off too much of their
    corners, ends of rungs move to corners. Where slices would cross themselves (a bound with a bay,
    a very tight turn), the ribbon of shortest rungs pairs the points instead, blended with equal
    lengths as far as all slices stay sound.

    Parameters
    ----------
    left, right : (k, 2 or 3) array
        The cleaned bounds in driving direction.
    n : int
        Number of slices.

    Returns
    -------
    left_points, right_points : (n + 1, 2 or 3) array
        Ends of the rungs; the first and the last are exactly the ends of the bounds.
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

    Where slices of that length cross themselves (a long slice of a tight turn), more slices are
    tried, at last those of half a metre.

    Parameters
    ----------
    left, right : (k, 2 or 3) array
        The cleaned bounds in driving direction.
    slice_m : float
        Wanted length of the slices, metres.

    Returns
    -------
    left_points, right_points : (n + 1, 2 or 3) array
        The ends of the rungs, as from :func:`rungs`.

    Raises
    ------
    CannotMendError
        If no number of slices is sound: the bounds have not been mended.
    """
    wanted_count, default_count = slices(left, right, slice_m), slices(left, right)
    for n in (*_slice_counts(wanted_count, 2 * max(wanted_count, default_count)), default_count):
        pair = rungs(left, right, n)
        if sound(*pair).all():
            return pair
    raise CannotMendError(Text("it cannot be cut into sound tiles"))


def _slice_counts(n: int, most: int) -> Iterator[int]:
    """Yield numbers of slices to try: `n`, then each a quarter more, up to `most`."""
    while n <= most:
        yield n
        n += max(1, n // 4)


def _pairings(left: Floats, right: Floats, even: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield ways to divide both bounds, as fractions of their lengths; the simplest come first."""
    most_loss = _LOSS_SHARE * abs(signed_area(left, right))
    snapped = [_snapped(bound, even, most_loss) for bound in (left, right)]
    if any(fractions is not even for fractions in snapped):
        yield snapped[0], snapped[1]
    yield even, even
    path = ribbon_between(left, right)
    for keep in _BLENDS:
        on_left = keep * even + (1.0 - keep) * np.interp(even, path.even, path.left)
        on_right = keep * even + (1.0 - keep) * np.interp(even, path.even, path.right)
        yield on_left, on_right


def _snapped(bound: Floats, even: Floats, most_loss: float) -> Floats:
    """Return fractions moved to corners where chords would cut off more than `most_loss` m2.

    They ascend, evenly spread between corners; it is `even` itself where none had to move.
    """
    if len(even) < 3 or len(bound) < 3:
        return even
    along = arc_lengths(bound)
    corners = along[1:-1] / along[-1]
    chords, n = at_fractions(bound[:, :2], even), len(even) - 1
    within = np.minimum((corners * n).astype(np.int64), n - 1)
    loss = np.abs(orientation(chords[within], chords[within + 1], bound[1:-1, :2])) / 2.0
    if loss.sum() <= most_loss:
        return even
    worst = np.argsort(loss)[::-1][: n - 1]
    corner_at = np.sort(corners[worst[loss[worst] > _CORNER_LOSS_SHARE * most_loss]])
    # Each corner takes its nearest division that no other corner has.
    order = np.arange(len(corner_at))
    nearest = np.maximum.accumulate(np.rint(corner_at * n).astype(np.int64) - order) + order
    nearest = np.clip(nearest, order + 1, n - len(corner_at) + order)
    where = np.concatenate([[0], nearest, [n]])
    fractions: Floats = np.interp(
        np.arange(n + 1), where, np.concatenate([[0.0], corner_at, [1.0]])
    )
    return fractions


def sound(left_points: Floats, right_points: Floats) -> Booleans:
    """Return which slices between rungs are simple, and have their left side on the left.

    A quadrilateral is simple and runs counter-clockwise if and only if one of its diagonals cuts it
    into two counter-clockwise triangles. Where that holds for all slices, they tile the outline of
    the rungs' ends without gap or overlap, as they share their rungs.

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
    by_first_diagonal = (orientation(r0, r1, l1) > 0.0) & (orientation(r0, l1, l0) > 0.0)
    by_second_diagonal = (orientation(r0, r1, l0) > 0.0) & (orientation(r1, l1, l0) > 0.0)
    answer: Booleans = by_first_diagonal | by_second_diagonal
    return answer


_SPACING_POINTS = 300  # points on both bounds together; the work grows with its square
_MOST_POINTS = 1200  # points on a bound, drawn ones included: limits time and memory
WRONG_TURN_M = 1e4  # metres that a rung may grow to avoid a wrongly turned triangle: any length
_FLAT_M2 = 1e-9  # area of a triangle that is flat, not wrongly turned


@dataclass(frozen=True, kw_only=True)
class Ribbon:
    """A pairing of two bounds that only moves forward on both.

    Parameters
    ----------
    left, right : (k,) array
        Fractions of the bounds' lengths, ascending together from 0 to 1.
    even : (k,) array
        Mean of both, the parameter of the pairing.
    left_wrong, right_wrong : (m, 2) array
        Begin and end, as fractions of the bound's length, of stretches whose triangles are wrongly
        turned: there the bound runs backwards.
    """

    left: Floats
    right: Floats
    even: Floats
    left_wrong: Floats
    right_wrong: Floats


def arc_lengths(line: Floats) -> Floats:
    """Return the horizontal distance of each point from the start, along the line: (n,) metres."""
    steps = line[1:] - line[:-1]
    along = np.zeros(len(line))
    np.cumsum(np.hypot(steps[:, 0], steps[:, 1]), out=along[1:])
    return along


def orientation(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return twice the signed area (m2) of triangles a b c: positive if counter-clockwise."""
    ab, ac = b - a, c - a
    area: Floats = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    return area


def ribbon_between(left: Floats, right: Floats, penalty_m: float = WRONG_TURN_M) -> Ribbon:
    """Return the ribbon between two bounds in driving direction.

    Parameters
    ----------
    left, right : (n, 2 or 3) array
        The bounds in metres. Points are added between vertices that are far apart.
    penalty_m : float
        Metres a rung may grow to avoid a wrongly turned triangle.

    Returns
    -------
    Ribbon
        The pairing, and the stretches where a bound runs backwards.
    """
    spacing = (arc_lengths(left)[-1] + arc_lengths(right)[-1]) / _SPACING_POINTS
    p, s = _refined(left[:, :2] - right[0, :2], max(spacing, 0.1))
    q, t = _refined(right[:, :2] - right[0, :2], max(spacing, 0.1))
    rows, columns = _cheapest_path(p, q, penalty_m)
    moves_left, moves_right = np.diff(rows) == 1, np.diff(columns) == 1
    wrong = _wrong_length(p, q, rows, columns, moves_left) > 0.0
    a, b = s[rows], t[columns]
    return Ribbon(
        left=a,
        right=b,
        even=(a + b) / 2.0,
        left_wrong=_stretches(a, wrong & moves_left),
        right_wrong=_stretches(b, wrong & moves_right),
    )


def _stretches(fractions: Floats, wrong: Booleans) -> Floats:
    """Return begin and end of the wrong moves between consecutive fractions, (m, 2)."""
    starts = np.flatnonzero(wrong)
    return np.column_stack([fractions[starts], fractions[starts + 1]]).reshape(-1, 2)


def _refined(line: Floats, spacing: float) -> tuple[Floats, Floats]:
    """Return a line with points added until none are farther apart than `spacing` m.

    With it come the points' fractions of the length.
    """
    along = arc_lengths(line)
    parts = np.maximum(1, np.ceil(np.diff(along) / spacing).astype(np.int64))
    where = np.concatenate(
        [
            np.linspace(a, b, k, endpoint=False)
            for a, b, k in zip(along, along[1:], parts, strict=False)
        ]
        + [along[-1:]]
    )
    if len(where) > _MOST_POINTS:
        where = np.linspace(0.0, along[-1], _MOST_POINTS)
    points = np.column_stack([np.interp(where, along, column) for column in line.T])
    return points, where / along[-1]


def _cheapest_path(p: Floats, q: Floats, penalty_m: float) -> tuple[Integers, Integers]:
    """Return the rungs of the best strip as indices into `p` and `q`; each moves on one of them."""
    rung = np.hypot(p[:, None, 0] - q[None, :, 0], p[:, None, 1] - q[None, :, 1])
    step_p, step_q = np.hypot(*np.diff(p, axis=0).T), np.hypot(*np.diff(q, axis=0).T)
    # Moving on the left: triangle (tip on the right, ahead, behind) must be counter-clockwise.
    wrong_p = orientation(q[None, :], p[1:, None], p[:-1, None]) <= 0.0
    wrong_q = orientation(p[:, None], q[None, :-1], q[None, 1:]) <= 0.0
    cost_p = step_p[:, None] * (rung[1:] + penalty_m * wrong_p)
    cost_q = step_q[None, :] * (rung[:, 1:] + penalty_m * wrong_q)
    total = np.full(rung.shape, np.inf)
    from_left = np.zeros(rung.shape, dtype=np.bool_)
    total[0, 0] = 0.0
    for diagonal in range(1, len(p) + len(q) - 1):
        i = np.arange(max(0, diagonal - len(q) + 1), min(len(p), diagonal + 1))
        j = diagonal - i
        by_p = np.where(i > 0, total[i - 1, j] + cost_p[i - 1, j], np.inf)
        by_q = np.where(j > 0, total[i, j - 1] + cost_q[i, j - 1], np.inf)
        total[i, j] = np.minimum(by_p, by_q)
        from_left[i, j] = by_p < by_q
    return _walk_back(from_left)


def _walk_back(from_left: Booleans) -> tuple[Integers, Integers]:
    """Return the path that ends at the last pair of points, by the move that led to each pair."""
    i, j = from_left.shape[0] - 1, from_left.shape[1] - 1
    path = [(i, j)]
    while i or j:
        i, j = (i - 1, j) if (from_left[i, j] and i) or not j else (i, j - 1)
        path.append((i, j))
    rows, columns = np.array(path[::-1], dtype=np.int64).T
    return rows, columns


def _wrong_length(
    p: Floats, q: Floats, rows: Integers, columns: Integers, moves_left: Booleans
) -> Floats:
    """Return the length (m) of the side of each wrongly turned triangle, 0 for the others."""
    tip = np.where(moves_left[:, None], q[columns[:-1]], p[rows[:-1]])
    behind = np.where(moves_left[:, None], p[rows[:-1]], q[columns[:-1]])
    ahead = np.where(moves_left[:, None], p[rows[1:]], q[columns[1:]])
    area = np.where(moves_left, 1.0, -1.0) * orientation(tip, ahead, behind)
    side: Floats = np.where(area < -_FLAT_M2, np.hypot(*(ahead - behind).T), 0.0)
    return side
