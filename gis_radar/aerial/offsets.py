"""How much higher a scan lies than a map's own heights: their vertical datums may differ."""

from __future__ import annotations

import numpy as np

from gis_radar.aerial.store import PointStore

BIN_M = 0.25
MOST_M = 500.0
ENOUGH = 20_000  # points of a block say it; more only take time


def scan_over_map(store: PointStore) -> float:
    """Return the most frequent height of points over the map's roads, NaN where it knows none.

    Roads lie at one offset to within centimetres, while trees, roofs and other levels spread over
    many; so the mode finds them without knowing which points are road.
    """
    levels = [level for level in store.site.roads.levels if level.has_heights]
    if not levels:
        return float("nan")
    bins = np.zeros(int(2 * MOST_M / BIN_M) + 1, np.int64)
    for block in range(len(store.site.shapes)):
        xyz, _ = store.points(block)
        xyz = xyz[:: max(1, len(xyz) // ENOUGH)]
        xy = xyz[:, :2] + store.site.corner(block)
        for level in levels:
            place = np.rint((xyz[:, 2] - level.height_near(xy) + MOST_M) / BIN_M)
            kept = (place >= 0) & (place < len(bins))
            bins += np.bincount(place[kept].astype(np.int64), minlength=len(bins))
    return float(np.argmax(bins) * BIN_M - MOST_M) if bins.any() else float("nan")
