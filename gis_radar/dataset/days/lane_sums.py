"""Sums of lane measures over quarters of an hour, and the measures that follow from them.

Measures along a lane are means by the kilometre-hours of it that were visible, queues by the time
in which the counting line was, or alike where only a presumed stop line was. How a measure combines
that is no plain sum is stated here only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gis_radar.base import Floats, quotient
from gis_radar.dataset.days.asked_time import QUARTER_S


def _queue_s(back_m: Floats, share: Floats) -> Floats:
    """Return the weight of mean queues: seconds, NaN where the queue is not known."""
    return np.where(np.isnan(back_m), np.nan, np.where(share > 0.0, share, 1.0) * QUARTER_S)


SUMMANDS: Mapping[str, tuple[Sequence[str], Callable[..., Floats]]] = {
    "quarters": (("volume",), lambda volume: np.isfinite(volume).astype(np.float64)),
    "visible_s": (("visible_share",), lambda share: share * QUARTER_S),
    "volume_variance": (("volume_se",), lambda error: error**2),
    "visible_km_h": (
        ("visible_km_h", "occupancy"),
        lambda area, occupancy: np.where(np.isfinite(occupancy), area, 0.0),
    ),
    "occupied_km_h": (("visible_km_h", "occupancy"), lambda area, occupancy: occupancy * area),
    "occupied_variance": (
        ("visible_km_h", "occupancy_se"), lambda area, error: (error * area) ** 2
    ),
    "vehicle_km": (("visible_km_h", "flow"), lambda area, flow: flow * area),
    "vehicle_h": (("visible_km_h", "density"), lambda area, density: density * area),
    "delay_h": (("delay_s", "volume"), lambda delay_s, volume: delay_s * volume / 3600.0),
    "queue_s": (("queue_mean_m", "visible_share"), _queue_s),
    "queue_m_s": (
        ("queue_mean_m", "visible_share"), lambda back_m, share: back_m * _queue_s(back_m, share)
    ),
}  # fmt: skip
"""By sum: the columns of `lane_measures` from which a quarter's summand is computed, and how."""

_QUOTIENTS = {
    "density": ("vehicle_h", "visible_km_h"),
    "flow": ("vehicle_km", "visible_km_h"),
    "speed_kmh": ("vehicle_km", "vehicle_h"),
    "occupancy": ("occupied_km_h", "visible_km_h"),
    "queue_mean_m": ("queue_m_s", "queue_s"),
}


def measures_of(sums: Mapping[str, Any]) -> dict[str, Floats]:
    """Return the measures of lanes that follow from sums.

    Parameters
    ----------
    sums : mapping of (n,) arrays
        By the names of `SUMMANDS`: those of areas, and of queues where their mean is wanted.

    Returns
    -------
    dict of (n,) arrays
        `density`, `flow`, `occupancy`, `occupancy_se`, `queue_mean_m` as in `lane_measures`, and
        `speed_kmh`, the space mean; NaN where nothing is visible, or nobody drives.
    """
    found = {
        name: quotient(sums[part], sums[whole])
        for name, (part, whole) in _QUOTIENTS.items() if part in sums
    }  # fmt: skip
    return found | {
        "occupancy_se": quotient(np.sqrt(sums["occupied_variance"]), sums["visible_km_h"])
    }
