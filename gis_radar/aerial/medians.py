"""Medians over a cell and the eight around it, compiled: one pass over sorted points."""

from __future__ import annotations

import numba
import numpy as np

from gis_radar.arrays import Floats, Integers


@numba.njit(cache=True)
def medians(  # pragma: no cover - compiled
    cell: Integers, value: Floats, width: int
) -> tuple[Integers, Floats]:
    """Return the cells that have points and the medians of the values in and around each.

    Parameters
    ----------
    cell : (n,) int64 array
        The cell of each point in a square grid, row by row; ascending.
    value : (n,) array
        What to take the median of.
    width : int
        Cells a row.
    """
    begin = np.zeros(width * width + 1, np.int64)
    for i in range(len(cell)):
        begin[cell[i] + 1] += 1
    most = begin.max()
    count = 0
    for k in range(width * width):
        count += begin[k + 1] > 0
        begin[k + 1] += begin[k]
    cells, median = np.empty(count, np.int64), np.empty(count)
    some = np.empty(9 * most)
    at = 0
    for k in range(width * width):
        if begin[k + 1] == begin[k]:
            continue
        row, column = k // width, k % width
        total = 0
        for r in range(max(row - 1, 0), min(row + 2, width)):
            first = r * width + max(column - 1, 0)
            last = r * width + min(column + 2, width)
            for i in range(begin[first], begin[last]):
                some[total] = value[i]
                total += 1
        upper = _nth(some, total, total // 2)
        if total % 2 == 0:
            lower = some[0]
            for i in range(1, total // 2):
                lower = max(lower, some[i])
            upper = (lower + upper) / 2.0
        cells[at], median[at] = k, upper
        at += 1
    return cells, median


@numba.njit(cache=True)
def _nth(some: Floats, total: int, nth: int) -> float:  # pragma: no cover - compiled
    """Return the nth smallest of the first values (Hoare), and move smaller ones before it."""
    low, high = 0, total - 1
    while low < high:
        pivot = some[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while some[i] < pivot:
                i += 1
            while some[j] > pivot:
                j -= 1
            if i <= j:
                some[i], some[j] = some[j], some[i]
                i += 1
                j -= 1
        if nth <= j:
            high = j
        elif nth >= i:
            low = i
        else:
            break
    return some[nth]  # type: ignore[no-any-return]
