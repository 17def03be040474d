"""Rows of a comparison: of each lane and measure, and of all stop lines together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import Booleans, NoAnswerError, Text
from gis_radar.measures import LEAST_DRIVEN, LEVEL, compare_values, holm_corrected

MORE, LESS, NOT_TOLD = "more", "less", "not told"


class Compared(NamedTuple):
    """A measure that is compared.

    Parameters
    ----------
    title : Text
        Name with unit.
    less, more : Text
        Words for a decrease and an increase.
    better : int
        1 where more is better, -1 where less is, 0 where neither.
    resolution : float
        Resolution of the measurement: smaller differences are not reported, however significant.
    digits : int
        Digits after the point that are shown.
    """

    title: Text
    less: Text
    more: Text
    better: int
    resolution: float
    digits: int


COMPARED = {
    "volume_veh_h": Compared(
        Text("Volume [veh/h]"), Text("fewer vehicles"), Text("more vehicles"), 0, 1.0, 0
    ),
    "speed_kmh": Compared(
        Text("Mean speed on the lane [km/h]"), Text("slower"), Text("faster"), 0, 0.1, 1
    ),
    "occupancy": Compared(
        Text("Occupancy [0-1]"), Text("less occupied"), Text("more occupied"), -1, 0.001, 3
    ),
    "delay_s": Compared(Text("Delay [s]"), Text("less delay"), Text("more delay"), -1, 0.1, 1),
    "queue_max_m": Compared(
        Text("Longest queue [m]"), Text("shorter queue"), Text("longer queue"), -1, 0.5, 1
    ),
    "queue_mean_m": Compared(
        Text("Mean queue [m]"), Text("shorter queue"), Text("longer queue"), -1, 0.5, 1
    ),
}


_LEAST_TOGETHER = 2  # from so many on, stop lines are compared together, too


class AlikeRows(NamedTuple):
    """Traffic of a lane, in the intervals that are compared.

    Parameters
    ----------
    before, after : GeoDataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    watchers : str
        Sensors that saw it.
    """

    before: gpd.GeoDataFrame
    after: gpd.GeoDataFrame
    watchers: str = ""


def compared_rows(lanes: Mapping[int, AlikeRows]) -> pd.DataFrame:
    """Return a row for each lane and measure, and of all stop lines, with verdicts.

    Parameters
    ----------
    lanes : mapping
        By number of the lane.

    Returns
    -------
    DataFrame
        As :attr:`Comparison.table`, without names and lines.

    Raises
    ------
    NoAnswerError
        If no measure is known in both periods.
    """
    values = {n: [_known(each) for each in (rows.before, rows.after)] for n, rows in lanes.items()}
    rows_found = [
        {"lane": n} | row | {"watchers": lanes[n].watchers}
        for n, periods in values.items()
        for row in _rows(periods)
    ]
    stops = [n for n, each in values.items() if all("queue_mean_m" in known for known in each)]
    if len(stops) >= _LEAST_TOGETHER:
        watchers = "; ".join(sorted({lanes[n].watchers for n in stops}))
        together = _together([values[n] for n in stops])
        rows_found += [{"lane": None} | row | {"watchers": watchers} for row in _rows(together)]
    if not rows_found:
        raise NoAnswerError(
            "no measure of any lane is known in both periods",
            hint="compare periods in which more of the lanes is visible",
        )
    return with_verdicts(pd.DataFrame(rows_found).astype({"lane": "Int64"}))


def _known(rows: gpd.GeoDataFrame) -> dict[str, pd.DataFrame]:
    """Return the values of a lane by measure; measures without any weight are left out."""
    values = {measure: interval_values(rows, measure) for measure in COMPARED}
    return {measure: each for measure, each in values.items() if each["weight"].sum() > 0.0}


def _together(lanes: Sequence[Sequence[Mapping[str, pd.DataFrame]]]) -> list[dict[str, Any]]:
    """Return the values of several lanes together, by period and measure."""
    periods: list[dict[str, Any]] = [{}, {}]
    for measure in COMPARED:
        of_periods = [[each[k].get(measure) for each in lanes] for k in range(2)]
        is_often_known = np.all([often_known(each) for each in of_periods], axis=0)
        if is_often_known.any():
            for into, each in zip(periods, of_periods, strict=True):
                mine = [values for values, is_often in zip(each, is_often_known, strict=True)
                        if is_often and values is not None]  # fmt: skip
                into[measure] = values_together(mine, adds=measure == "volume_veh_h")
    return periods


def _rows(periods: Sequence[Mapping[str, pd.DataFrame]]) -> Iterator[dict[str, Any]]:
    """Yield a row for each measure that is known in both periods."""
    for measure in COMPARED:
        if any(measure not in each for each in periods):
            continue
        result = compare_values(*(by_time(each[measure]) for each in periods))
        half_width = result.half_width(LEVEL)
        yield {
            "measure": measure, "before": result.before, "after": result.after,
            "difference": result.difference,
            "percent": 100.0 * result.difference / result.before if result.before else np.nan,
            "se": result.se, "low": result.difference - half_width,
            "high": result.difference + half_width,
            "p": result.p, "units": result.units, "count": result.count,
        }  # fmt: skip


def with_verdicts(table: pd.DataFrame) -> pd.DataFrame:
    """Add verdicts: which differences are significant among all lanes and measures."""
    table = table.assign(p_corrected=np.nan, verdict=NOT_TOLD)
    table["p_corrected"] = holm_corrected(table["p"].to_numpy(np.float64))
    least = table["measure"].map({name: of.resolution for name, of in COMPARED.items()})
    is_significant = (table["p_corrected"] < LEVEL) & (table["difference"].abs() >= least)
    table.loc[is_significant & (table["difference"] > 0.0), "verdict"] = MORE
    table.loc[is_significant & (table["difference"] < 0.0), "verdict"] = LESS
    return table


_LONGEST_MIN = 5  # minutes over which a queue's farthest back is taken, several cycles
# Least number of intervals of a lane that is taken together with others, as a share of the most
# that any of them has.
_KNOWN_SHARE = 0.9
LEAST_SEEN = 0.5  # least share of the intervals with traffic in which enough of a lane is visible


def interval_values(rows: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the values of a measure on one lane.

    Parameters
    ----------
    rows : DataFrame
        From :meth:`gis_radar.Dataset.traffic`, of the lane.
    measure : str
        One of :data:`gis_radar.products.comparison.rows.COMPARED`.

    Returns
    -------
    DataFrame
        By `begin`: `value` and `weight`, of which the measure is the quotient; without intervals in
        which it is unknown.
    """
    rows = rows.set_index("begin").sort_index()
    ones = pd.Series(1.0, rows.index)
    if measure == "delay_s":
        value, weight = _lost_time(rows)
    elif measure == "speed_kmh":
        weight = rows["density_veh_km"] * rows.geometry.length
        value = rows["flow_veh_h"] * rows.geometry.length
    elif measure == "occupancy":
        weight = ones * rows.geometry.length
        value = rows[measure] * weight
    elif measure == "queue_max_m":
        value, weight = _longest(rows), ones
    else:
        value, weight = rows[measure], ones
    return pd.DataFrame({"value": value, "weight": weight}, rows.index, dtype=np.float64).dropna()


def _lost_time(rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return the time lost on a lane, and the flow, also while nobody drives its length.

    The time spent is that of travel times, 3600 L k, of which q at free speed would need a part.
    Where too little of the lane is visible for travel times, nothing is known. As a delay, time
    lost is never under 0.
    """
    flow, density, travel_s, delay_s = (
        rows[name].astype(np.float64)
        for name in ("flow_veh_h", "density_veh_km", "travel_time_s", "delay_s")
    )
    drove = flow * (rows["end"] - rows.index).dt.total_seconds() / 3600.0 >= LEAST_DRIVEN
    time_per_vehicle = (travel_s * flow / density)[drove].median()
    hidden = travel_s.isna() & drove
    if hidden.sum() > (1.0 - LEAST_SEEN) * drove.sum():  # unknown while all stand, too
        time_per_vehicle = np.nan
    free_s = (travel_s - delay_s).max()  # less where nobody was delayed
    else_lost = (time_per_vehicle * density - free_s * flow).clip(lower=0.0)
    lost = (delay_s * flow).where(drove, else_lost)
    return lost if np.isfinite(time_per_vehicle) else lost * np.nan, flow


def _longest(rows: pd.DataFrame) -> pd.Series:
    """Return the farthest back of a queue in `_LONGEST_MIN` and longer, to each interval's end."""
    minutes = (rows["end"] - rows.index).dt.total_seconds().median() / 60.0
    several = max(round(_LONGEST_MIN / minutes), 1)
    longest: pd.Series = rows["queue_max_m"].rolling(several).max()
    return longest


def often_known(lanes: Sequence[pd.DataFrame | None]) -> Booleans:
    """Return which lanes have values in nearly as many intervals as the lane with most."""
    count = np.array([0 if values is None else len(values) for values in lanes])
    return np.asarray((count > 0) & (count >= _KNOWN_SHARE * count.max()), np.bool_)


def values_together(lanes: Sequence[pd.DataFrame], *, adds: bool) -> pd.DataFrame:
    """Return the values of a measure on several lanes together, of intervals known on all.

    Parameters
    ----------
    lanes : sequence of DataFrame
        From :func:`interval_values`.
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
