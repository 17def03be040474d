"""Tall vehicles: what heights over the road tell of lengths.

Seen from one end a lorry shows no more of its length than a car, and in a queue its ends look like
those of two cars. But cars return from below a metre and a half, lorries and buses from all of
their three to four metres, and who is tall is long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.settings import TallSettings
from gis_radar.vehicles.standing import Stand


def tall_odds(height_m: Floats, range_m: Floats, settings: TallSettings) -> float:
    """Return how much heights speak for a lorry or a bus, as the logarithm of odds over a car.

    Parameters
    ----------
    height_m : (n,) array
        Of the detections over the road; NaN where unknown.
    range_m : (n,) array
        From the sensor.
    settings : TallSettings
        How high cars and lorries return from, and how well heights are known.
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


def join_tall(stands: Sequence[Stand], echoes: Echoes, settings: TallSettings) -> list[Stand]:
    """Return the stands, with neighbours that are both of one tall vehicle as one.

    Parameters
    ----------
    stands : sequence of Stand
        In any order.
    echoes : Echoes
        All detections.
    settings : TallSettings
        Constants.
    """
    order = sorted(stands, key=lambda each: (each.strip, each.rear_m))
    odds = [_odds(each.rows, echoes, settings) for each in order]
    joined: list[Stand] = []
    gone: set[int] = set()
    for k, one in enumerate(order):
        if k in gone:
            continue
        best, total = -1, settings.least_odds
        for j in range(k + 1, len(order)):
            other = order[j]
            if other.strip != one.strip or other.rear_m > one.front_m + settings.gap_m:
                break
            if j not in gone and _may_be_one(one, other, settings) and odds[k] + odds[j] > total:
                best, total = j, odds[k] + odds[j]
        if best < 0:
            joined.append(one)
            continue
        gone.add(best)
        other = order[best]
        joined.append(
            replace(
                one, front_m=max(one.front_m, other.front_m), begin=min(one.begin, other.begin),
                end=max(one.end, other.end), rows=np.union1d(one.rows, other.rows),
            )
        )  # fmt: skip
    return joined


def _odds(rows: Integers, echoes: Echoes, settings: TallSettings) -> float:
    return tall_odds(echoes.height_m[rows], echoes.range_m[rows], settings)


def _may_be_one(one: Stand, other: Stand, settings: TallSettings) -> bool:
    """Tell whether two stands are at a time, and together no longer than a vehicle."""
    both = min(one.end, other.end) - max(one.begin, other.begin)
    least = settings.both_share * max(one.end - one.begin, other.end - other.begin)
    return both > least and other.front_m - one.rear_m < settings.longest_m
