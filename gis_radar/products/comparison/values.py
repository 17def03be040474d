"""Values of measures by interval, as quotients of sums, which add up over intervals and lanes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from gis_radar.base import Booleans

LONGEST_MIN = 5  # minutes over which a queue's farthest back is taken, several cycles
KNOWN_SHARE = 0.9  # least share of the intervals of a lane that counts with others
LEAST_SEEN = 0.5  # least share of the intervals with traffic in which enough of a lane is visible


def interval_values(rows: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the values of a measure on one lane.

    Parameters
    ----------
    rows : DataFrame
        As from :meth:`gis_radar.Dataset.traffic`, of the lane.
    measure : str
        One of :data:`gis_radar.products.comparison.compared.COMPARED`.

    Returns
    -------
    DataFrame
        By `begin`: `value` and `weight`, of which the measure is the quotient; without intervals in
        which it is unknown.
    """
    rows = rows.set_index("begin").sort_index()
    whole = pd.Series(1.0, rows.index)
    if measure == "delay_s":
        value, weight = _lost_time(rows)
    elif measure == "speed_kmh":
        weight = rows["density_veh_km"] * rows.geometry.length
        value = rows["flow_veh_h"] * rows.geometry.length
    elif measure == "occupancy":
        weight = whole * rows.geometry.length
        value = rows[measure] * weight
    elif measure == "queue_max_m":
        value, weight = _longest(rows), whole
    else:
        value, weight = rows[measure], whole
    return pd.DataFrame({"value": value, "weight": weight}, rows.index, dtype=np.float64).dropna()


def _lost_time(rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return the time lost on a lane, and the flow, also while all stand.

    The lane is that of travel times, 3600 L k / q. Where too little of it is visible for these,
    nothing is known. As a delay, time lost is never under 0.
    """
    flow, density, travel_s, delay_s = (
        rows[name].astype(np.float64)
        for name in ("flow_veh_h", "density_veh_km", "travel_time_s", "delay_s")
    )
    of_one = (travel_s * flow / density)[flow > 0.0].median()
    hidden = travel_s.isna() & (flow > 0.0)
    if hidden.sum() > (1.0 - LEAST_SEEN) * (flow > 0.0).sum():  # nor is it known while all stand
        of_one = np.nan
    lost = (delay_s * flow).where(flow > 0.0, of_one * density)
    return lost if np.isfinite(of_one) else lost * np.nan, flow


def _longest(rows: pd.DataFrame) -> pd.Series:
    """Return the farthest back of a queue in `LONGEST_MIN` and longer, to each interval's end."""
    minutes = (rows["end"] - rows.index).dt.total_seconds().median() / 60.0
    several = max(round(LONGEST_MIN / minutes), 1)
    longest: pd.Series = rows["queue_max_m"].rolling(several).max()
    return longest


def often_known(lanes: Sequence[pd.DataFrame | None]) -> Booleans:
    """Return of which lanes values are known nearly as often as of any of them."""
    count = np.array([0 if values is None else len(values) for values in lanes])
    return np.asarray((count > 0) & (count >= KNOWN_SHARE * count.max()), np.bool_)


def values_together(lanes: Sequence[pd.DataFrame], *, adds: bool) -> pd.DataFrame:
    """Return the values of a measure on several lanes together, of intervals known on all.

    Parameters
    ----------
    lanes : sequence of DataFrame
        As from :func:`interval_values`.
    adds : bool
        Whether values add up, as volumes, and are no means.
    """
    table = pd.concat(lanes)
    sums = table.groupby(level=0).sum()
    sums = sums[table.groupby(level=0).size() == len(lanes)]
    return sums.assign(weight=sums["weight"] / len(lanes)) if adds else sums


def by_time(values: pd.DataFrame) -> pd.DataFrame:
    """Return values with `day` and `time`, minutes of the day, as they are compared."""
    begin = values.index.to_series().dt
    return values.assign(day=begin.date, time=60 * begin.hour + begin.minute)
