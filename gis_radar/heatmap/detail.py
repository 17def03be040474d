"""Where a picture can show the busiest place larger, and which place that is."""

from __future__ import annotations

from itertools import product

import numpy as np

from gis_radar.arrays import Floats

INSETS = (0.42, 0.36, 0.3)  # sides of the inset to try, of the map's shorter side
WINDOW = 0.12  # side of what it shows, of the map's shorter side
SMALLEST_MAP_M = 150.0
SMALLEST_WINDOW_M = 45.0
GAP = 0.02
CELLS = 4  # a window's side in cells of the search

Extent = tuple[Floats, Floats]
Box = tuple[float, float, float, float]


def busiest_window(centres: Floats, share: Floats, extent: Extent) -> Extent | None:
    """Return the square window with the highest sum of occupancy.

    Parameters
    ----------
    centres : (n, 2) array
        Centres of the tiles, metres.
    share : (n,) array
        Their occupancy, NaN where not observed.
    extent : (south-west, north-east)
        The map's.

    Returns
    -------
    (south-west, north-east) or None
        None where nothing was hit, or the map is small enough to be read without.
    """
    low, high = extent
    shorter = float((high - low).min())
    weight = np.nan_to_num(share)
    if shorter < SMALLEST_MAP_M or not weight.any():
        return None
    side = max(SMALLEST_WINDOW_M, WINDOW * shorter)
    x, y = (np.arange(low[i], high[i] + side, side / CELLS) for i in (0, 1))
    cells, _, _ = np.histogram2d(centres[:, 0], centres[:, 1], bins=[x, y], weights=weight)
    total = np.pad(cells.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    far, near = slice(CELLS, None), slice(None, -CELLS)
    sums = total[far, far] - total[near, far] - total[far, near] + total[near, near]
    place = np.unravel_index(int(sums.argmax()), sums.shape)
    corner = np.array([x[place[0]], y[place[1]]])
    return corner, corner + side


def free_corner(centres: Floats, extent: Extent) -> Box | None:
    """Return the largest square in a corner of the map in which no tile lies.

    Returns
    -------
    (left, bottom, width, height) or None
        As shares of the map; None where each corner has tiles.
    """
    low, high = extent
    unit = (high - low).min() / (high - low)  # the shorter side, as a share of both
    place = (centres - low) / (high - low)
    for size, east, north in product(INSETS, (1, 0), (1, 0)):
        side, gap = size * unit, GAP * unit
        corner = gap + np.array([east, north]) * (1 - side - 2 * gap)
        inside = (place >= corner - gap) & (place <= corner + side + gap)
        if not inside.all(axis=1).any():
            return float(corner[0]), float(corner[1]), float(side[0]), float(side[1])
    return None
