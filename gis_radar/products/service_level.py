"""Levels of service at signals, from the delay: by the Highway Capacity Manual."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import UsageError

HANDBOOKS = {
    "hcm": {"A": 10.0, "B": 20.0, "C": 35.0, "D": 55.0, "E": 80.0, "F": np.inf},
}
"""Longest mean delay (s a vehicle) of each level, at signals.

`hcm`: Highway Capacity Manual (TRB, 6th edition, 2016), signalized intersections.
"""


def service_levels(lanes: gpd.GeoDataFrame, handbook: str) -> pd.Series:
    """Return the levels of service of lanes with a stop line.

    Parameters
    ----------
    lanes : GeoDataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    handbook : {"hcm"}
        Whose thresholds count.

    Returns
    -------
    Series
        Letters. Null without a stop line or a delay, and where a queue reaches back beyond the
        lane: its delay is then not all of it.

    Raises
    ------
    UsageError
        If there is no such handbook.
    """
    if handbook not in HANDBOOKS:
        raise UsageError("service is {}, expected one of {}", repr(handbook), ", ".join(HANDBOOKS))
    limits = HANDBOOKS[handbook]
    delay = lanes["delay_s"].to_numpy(np.float64)
    level = np.array(list(limits), object)[
        np.searchsorted(list(limits.values()), np.nan_to_num(delay))
    ]
    inside = lanes["queue_max_m"] <= lanes.length
    told = np.where(inside & np.isfinite(delay), level, None)
    return pd.Series(told, lanes.index, dtype=object)
