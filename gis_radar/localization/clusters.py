"""DBSCAN on a grid: no neighbour list is stored, so memory stays that of the points."""

from __future__ import annotations

import numpy as np

from gis_radar.arrays import Floats, Integers, compiled

NOISE = -1


def cluster(points: Floats, *, eps_m: float, min_points: int) -> Integers:
    """Group points by density (Ester et al. 1996).

    Parameters
    ----------
    points : (n, 3) array
        Metres.
    eps_m : float
        Radius of a neighbourhood.
    min_points : int
        Points in the neighbourhood, itself included, that make a point a core.

    Returns
    -------
    (n,) int64 array
        Number of the cluster, the largest is 0; `NOISE` for points of none. A point at the
        border of several clusters belongs to that of its nearest core.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    cells = np.floor((points - points.min(axis=0)) / eps_m).astype(np.int64) + 1
    shape = cells.max(axis=0) + 2
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    unique, first = np.unique(keys[order], return_index=True)
    steps = np.array(
        [
            (i * shape[1] + j) * shape[2] + k
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            for k in (-1, 0, 1)
        ],
        dtype=np.int64,
    )
    ends = np.append(first[1:], len(keys)).astype(np.int64)
    root = _dbscan(
        points[order], keys[order], unique, first.astype(np.int64), ends, steps, eps_m, min_points
    )
    labels = np.empty(len(points), dtype=np.int64)
    labels[order] = root
    return _by_size(labels)


def _by_size(roots: Integers) -> Integers:
    """Give the clusters numbers by size, the largest first."""
    names, inverse, counts = np.unique(roots, return_inverse=True, return_counts=True)
    counts = np.where(names == NOISE, -1, counts)
    place = np.empty(len(names), dtype=np.int64)
    place[np.argsort(-counts, kind="stable")] = np.arange(len(names))
    place[names == NOISE] = NOISE
    return np.asarray(place[inverse])


@compiled
def _find(parent: Integers, i: int) -> int:  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _dbscan(  # noqa: C901, PLR0912 - numba takes plain arrays  # pragma: no cover
    points: Floats,
    keys: Integers,
    unique: Integers,
    first: Integers,
    ends: Integers,
    steps: Integers,
    eps_m: float,
    min_points: int,
) -> Integers:
    """Return the root of each point's cluster; points are sorted by cell."""
    count = len(points)
    core = np.zeros(count, dtype=np.bool_)
    parent = np.arange(count)
    nearest = np.full(count, NOISE)
    for job in range(3):  # cores, then unions of cores, then borders
        for i in range(count):
            if job == 1 and not core[i]:
                continue
            if job == 2 and core[i]:
                nearest[i] = _find(parent, i)
                continue
            seen, best = 0, eps_m * eps_m
            for step in steps:
                cell = np.searchsorted(unique, keys[i] + step)
                if cell == len(unique) or unique[cell] != keys[i] + step:
                    continue
                for j in range(first[cell], ends[cell]):
                    gap = np.sum((points[i] - points[j]) ** 2)
                    if gap > eps_m * eps_m:
                        continue
                    if job == 0:
                        seen += 1
                        if seen >= min_points:
                            break
                    elif job == 1 and j < i and core[j]:
                        a, b = _find(parent, i), _find(parent, j)
                        parent[max(a, b)] = min(a, b)
                    elif job == 2 and core[j] and gap <= best:
                        best = gap
                        nearest[i] = _find(parent, j)
                if job == 0 and seen >= min_points:
                    core[i] = True
                    break
    return nearest
