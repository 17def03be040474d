"""Clusters of cells, as DBSCAN finds them: what is too small for a road goes.

DBSCAN runs here on the cells of the cropped road, never on the raw cloud. On a regular grid its
neighbourhoods are sums over a disc, and its clusters the connected patches of core cells.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from gis_radar.arrays import Booleans

# A cell is a core with so many cells within the radius, itself among them.
RADIUS_CELLS = 2
CORE_CELLS = 5
LEAST_CELLS = 20  # 5 m2: less than a car's outline


def large_clusters(filled: Booleans) -> Booleans:
    """Return the cells of clusters of at least `LEAST_CELLS`.

    Parameters
    ----------
    filled : (rows, columns) bool array
        Cells with a point.
    """
    reach = np.arange(-RADIUS_CELLS, RADIUS_CELLS + 1)
    disc = np.hypot(*np.meshgrid(reach, reach)) <= RADIUS_CELLS
    around = ndimage.convolve(filled.astype(np.uint8), disc.astype(np.uint8), mode="constant")
    core = filled & (around >= CORE_CELLS)
    # Cores a radius apart touch when each is grown by one cell.
    patch, _ = ndimage.label(grown(core), np.ones((3, 3)))
    member = np.where(filled, patch, 0)
    sizes = np.bincount(member.ravel())
    sizes[0] = 0
    return np.asarray(sizes[member] >= LEAST_CELLS)


def grown(cells: Booleans) -> Booleans:
    """Return cells and the eight around each."""
    wide = cells.copy()
    wide[:, 1:] |= cells[:, :-1]
    wide[:, :-1] |= cells[:, 1:]
    tall = wide.copy()
    tall[1:] |= wide[:-1]
    tall[:-1] |= wide[1:]
    return tall
