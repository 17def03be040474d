"""Tall vehicles: heights of detections as evidence of long vehicles.

Seen from one end, a lorry looks as short as a car, and in a queue its ends look like those of two
cars. But cars scatter from below a metre and a half, lorries and buses from all of their three to
four metres, and tall vehicles are long.
"""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats

# Mean height of the detections of a car, and of a lorry or bus, with its standard deviation between
# vehicles, metres: the middle of their bodies.
_CAR_M, _LORRY_M = (0.75, 0.3), (1.6, 0.5)
# Sigma of the elevation, radians: common to all detections of a vehicle, and of each.
BIAS_RAD, ELEVATION_RAD = 0.006, 0.0175
_LEAST_ROWS = 10  # least number of heights; fewer are no evidence
MOST_ODDS = 4.0  # largest log odds by heights
LORRY_SHARE = 0.12  # share of lorries and buses in traffic


def tall_odds(height_m: Floats, range_m: Floats) -> float:
    """Return the log odds of a lorry or bus over a car by heights.

    Parameters
    ----------
    height_m : (n,) array
        Heights of the detections over the road, metres; NaN where unknown.
    range_m : (n,) array
        Distances from the sensor, metres.
    """
    known = np.isfinite(height_m)
    if known.sum() < _LEAST_ROWS:
        return 0.0
    range_ = float(np.median(range_m[known]))
    mean = float(height_m[known].mean())
    noise = BIAS_RAD**2 + ELEVATION_RAD**2 / known.sum()
    odds = 0.0
    for sign, (middle, spread) in ((1.0, _LORRY_M), (-1.0, _CAR_M)):
        variance = spread**2 + noise * range_**2
        odds += sign * (-0.5 * (mean - middle) ** 2 / variance - 0.5 * np.log(variance))
    return float(np.clip(odds, -MOST_ODDS, MOST_ODDS))


def one_tall_odds(odds: tuple[float, float]) -> float:
    """Return the log odds of one lorry or bus over two vehicles, by the heights of two parts.

    Parameters
    ----------
    odds : (float, float)
        Log odds of each part, from :func:`tall_odds`.
    """
    return float(-np.log((1.0 - LORRY_SHARE) * np.exp(-np.array(odds)) + LORRY_SHARE).sum())
