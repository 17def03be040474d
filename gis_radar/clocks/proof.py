"""Whether two sensors, at the offset found, truly saw the same vehicles."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gis_radar.arrays import Floats, Integers
from gis_radar.clocks.sightings import Sightings

NEAR_M = 8.0
NEAR_S = 0.2
NEAR_MPS = 1.0
PLACE_M = 10.0
DECOYS_S = (-3.0, -2.0, -1.5, 1.5, 2.0, 3.0)
LEAST_SHARE = 0.45
LEAST_LEAD = 1.3
LEAST_SIGHTINGS = 50
MOST_SIGHTINGS = 20_000


def doubt_of(one: Sightings, other: Sightings, offset_s: float) -> str:
    """Return why an offset is not to be trusted; nothing where it is.

    Where both look at the same road, most of what one sees the other sees at the same time, and
    far less of it a moment before or after. Traffic that follows a signal is alike from
    cycle to cycle, but not vehicle by vehicle.

    Parameters
    ----------
    one, other : Sightings
        Of two sensors.
    offset_s : float
        By how much the clock of `other` is ahead.
    """
    share = _share_of_both(one, other, offset_s)
    decoys = [_share_of_both(one, other, offset_s + decoy_s) for decoy_s in DECOYS_S]
    if not share >= LEAST_SHARE:
        return "at no lag do they see the same vehicles"
    if not share >= LEAST_LEAD * np.nanmax([0.0, *decoys]):
        return "their common traffic looks alike at other lags too"
    return ""


def _share_of_both(one: Sightings, other: Sightings, offset_s: float) -> float:
    return (_share_seen(one, other, offset_s) + _share_seen(other, one, -offset_s)) / 2


def _share_seen(one: Sightings, other: Sightings, offset_s: float) -> float:
    """Return the share of what `one` sees, where and while `other` sees too, that both see."""
    time = other.time - offset_s
    within = (one.time > time[0] + NEAR_S) & (one.time < time[-1] - NEAR_S)
    mine = one.take(np.flatnonzero(within & np.isin(_place(one), _place(other))))
    if len(mine) < LEAST_SIGHTINGS:
        return np.nan
    mine = mine.take(np.arange(0, len(mine), -(-len(mine) // MOST_SIGHTINGS)))
    begin = mine.time[0]
    tree = cKDTree(_points(other, time - begin))
    apart, _ = tree.query(_points(mine, mine.time - begin), p=np.inf, distance_upper_bound=1.0)
    return float(np.isfinite(apart).mean())


def _place(sightings: Sightings) -> Integers:
    return sightings.lanelet * 100_000 + (sightings.s_m // PLACE_M).astype(np.int64)


def _points(sightings: Sightings, time: Floats) -> Floats:
    return np.column_stack(
        [
            sightings.lanelet * 1e4,
            sightings.s_m / NEAR_M,
            time / NEAR_S,
            sightings.speed / NEAR_MPS,
        ]
    )
