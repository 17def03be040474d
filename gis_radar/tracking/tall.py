"""Tall vehicles: lengths by heights over the road.

Seen from one end a lorry shows no more of its length than a car, and in a queue its ends look like
those of two cars. But cars scatter from below a metre and a half, lorries and buses from all of
their three to four metres, and who is tall is long.
"""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats
from gis_radar.tracking.management_settings import TallSettings


def tall_odds(height_m: Floats, range_m: Floats, settings: TallSettings) -> float:
    """Return the logarithm of the odds of a lorry or bus over a car by heights.

    Parameters
    ----------
    height_m : (n,) array
        Of the detections over the road; NaN where unknown.
    range_m : (n,) array
        From the sensor.
    settings : TallSettings
        Heights of cars and lorries, and their errors.
    """
    known = np.isfinite(height_m)
    if known.sum() < settings.least_rows:
        return 0.0
    range_ = float(np.median(range_m[known]))
    mean = float(height_m[known].mean())
    noise = settings.bias_rad**2 + settings.elevation_rad**2 / known.sum()
    odds = 0.0
    for sign, (middle, spread) in ((1.0, settings.lorry_m), (-1.0, settings.car_m)):
        variance = spread**2 + noise * range_**2
        odds += sign * (-0.5 * (mean - middle) ** 2 / variance - 0.5 * np.log(variance))
    return float(np.clip(odds, -settings.most_odds, settings.most_odds))


def one_tall_odds(odds: tuple[float, float], settings: TallSettings) -> float:
    """Return the logarithm of the odds of one lorry over two vehicles by the heights of two parts.

    Parameters
    ----------
    odds : (float, float)
        Of each part, as of :func:`tall_odds`.
    settings : TallSettings
        How many vehicles are lorries.
    """
    share = settings.lorry_share
    return float(-np.log((1.0 - share) * np.exp(-np.array(odds)) + share).sum())
