"""Pairing the points of two bounds where equal lengths do not do: the ribbon of shortest rungs.

The ribbon is a strip of triangles between the bounds. Each has one side on a bound and its tip on
the other one. Of all strips that only move forward, the one is taken that has the least length
of wrongly turned triangles and then the shortest rungs (dynamic programming).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers

_SPACING_POINTS = 300  # on both bounds together; the work grows with its square
_MOST_POINTS = 1200  # on a bound, drawn ones included: bounds time and memory
NEVER_M = 1e4  # a rung gets so much longer to avoid a wrongly turned triangle: any way round
_FLAT_M2 = 1e-9  # sideways is not backwards


@dataclass(frozen=True, kw_only=True)
class Ribbon:
    """A monotone pairing of two bounds.

    Parameters
    ----------
    left, right : (k,) array
        Fractions of the bounds' lengths, ascending together from 0 to 1.
    even : (k,) array
        The mean of both, which parametrises the pairing.
    left_wrong, right_wrong : (m, 2) array
        Stretches, in fractions of each bound's length, whose triangles are wrongly turned: there
        the bound runs backwards.
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


def turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return twice the signed area of triangles a b c in m2, positive if counter-clockwise."""
    ab, ac = b - a, c - a
    area: Floats = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    return area


def matched(left: Floats, right: Floats, wrong_m: float = NEVER_M) -> Ribbon:
    """Return the ribbon between two bounds in driving direction.

    Parameters
    ----------
    left, right : (n, 2 or 3) array
        The bounds in metres. All their vertices take part, and points between them where these
        are far apart.
    wrong_m : float
        How many metres longer a rung may get to avoid a wrongly turned triangle.

    Returns
    -------
    Ribbon
        The pairing, and where it cannot go forward.
    """
    spacing = (arc_lengths(left)[-1] + arc_lengths(right)[-1]) / _SPACING_POINTS
    p, s = _refined(left[:, :2] - right[0, :2], max(spacing, 0.1))
    q, t = _refined(right[:, :2] - right[0, :2], max(spacing, 0.1))
    rows, columns = _cheapest_path(p, q, wrong_m)
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
    starts = np.flatnonzero(wrong)
    return np.column_stack([fractions[starts], fractions[starts + 1]]).reshape(-1, 2)


def _refined(line: Floats, spacing: float) -> tuple[Floats, Floats]:
    """Return a line with points added until none are farther apart, and their length fractions."""
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


def _cheapest_path(p: Floats, q: Floats, wrong_m: float) -> tuple[Integers, Integers]:
    """Return the indices of the rungs of the best strip, one step on one bound at a time."""
    rung = np.hypot(p[:, None, 0] - q[None, :, 0], p[:, None, 1] - q[None, :, 1])
    step_p, step_q = np.hypot(*np.diff(p, axis=0).T), np.hypot(*np.diff(q, axis=0).T)
    # Moving on the left: triangle (tip on the right, ahead, behind) must be counter-clockwise.
    wrong_p = turn(q[None, :], p[1:, None], p[:-1, None]) <= 0.0
    wrong_q = turn(p[:, None], q[None, :-1], q[None, 1:]) <= 0.0
    cost_p = step_p[:, None] * (rung[1:] + wrong_m * wrong_p)
    cost_q = step_q[None, :] * (rung[:, 1:] + wrong_m * wrong_q)
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
    """Return how long the side of each triangle is where it is wrongly turned, else 0."""
    tip = np.where(moves_left[:, None], q[columns[:-1]], p[rows[:-1]])
    behind = np.where(moves_left[:, None], p[rows[:-1]], q[columns[:-1]])
    ahead = np.where(moves_left[:, None], p[rows[1:]], q[columns[1:]])
    area = np.where(moves_left, 1.0, -1.0) * turn(tip, ahead, behind)
    side: Floats = np.where(area < -_FLAT_M2, np.hypot(*(ahead - behind).T), 0.0)
    return side
