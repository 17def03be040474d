"""Rows of whole numbers as columns of equal length."""

from __future__ import annotations

import math

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers

Rows = tuple[Integers, ...]
MOST_KEYS = 1 << 62  # of rows as one number each


def distinct(*columns: Integers) -> Rows:
    """Return each row of some columns once, ascending by the first, then by the second, ..."""
    if len(columns[0]) == 0:
        return columns
    lowest = [int(column.min()) for column in columns]
    sizes = [int(column.max()) - low + 1 for column, low in zip(columns, lowest, strict=True)]
    if math.prod(sizes) >= MOST_KEYS:
        order = np.lexsort(columns[::-1])
        columns = tuple(column[order] for column in columns)
        new = np.logical_or.reduce([fresh(column) for column in columns])
        return tuple(column[new] for column in columns)
    # One number a row sorts several times faster than columns.
    keys = columns[0] - lowest[0]
    for column, low, size in zip(columns[1:], lowest[1:], sizes[1:], strict=True):
        keys = keys * size + (column - low)
    keys.sort()
    keys = keys[fresh(keys)]
    found = []
    for low, size in zip(lowest[:0:-1], sizes[:0:-1], strict=True):
        keys, column = np.divmod(keys, size)
        found.append(column + low)
    return (keys + lowest[0], *reversed(found))


def fresh(values: Integers | Floats) -> Booleans:
    """Return which values differ from the one before; the first one does."""
    differs = np.ones(len(values), dtype=np.bool_)
    np.not_equal(values[1:], values[:-1], out=differs[1:])
    return differs
