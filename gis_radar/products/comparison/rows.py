"""Rows of a comparison: of each lane and measure, and of all stop lines together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import NoAnswerError
from gis_radar.measures import LEVEL, compare_values, holm_corrected
from gis_radar.products.comparison.compared import COMPARED, LESS, MORE, NOT_TOLD
from gis_radar.products.comparison.values import (
    by_time,
    interval_values,
    often_known,
    values_together,
)

LEAST_TOGETHER = 2  # stop lines that are compared together, too


class AlikeRows(NamedTuple):
    """Traffic of a lane, in the intervals that compare.

    Parameters
    ----------
    before, after : GeoDataFrame
        As from :meth:`gis_radar.Dataset.traffic`.
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
    found = [
        {"lane": n} | row | {"watchers": lanes[n].watchers}
        for n, periods in values.items()
        for row in _rows(periods)
    ]
    stops = [n for n, each in values.items() if all("queue_mean_m" in known for known in each)]
    if len(stops) >= LEAST_TOGETHER:
        watchers = "; ".join(sorted({lanes[n].watchers for n in stops}))
        together = _together([values[n] for n in stops])
        found += [{"lane": None} | row | {"watchers": watchers} for row in _rows(together)]
    if not found:
        raise NoAnswerError(
            "no measure of any lane is known in both periods",
            hint="compare periods in which more of the lanes is visible",
        )
    return with_verdicts(pd.DataFrame(found).astype({"lane": "Int64"}))


def _known(rows: gpd.GeoDataFrame) -> dict[str, pd.DataFrame]:
    """Return the values of a lane by measure, of those that are known: none is of no vehicle."""
    values = {measure: interval_values(rows, measure) for measure in COMPARED}
    return {measure: each for measure, each in values.items() if each["weight"].sum() > 0.0}


def _together(lanes: Sequence[Sequence[Mapping[str, pd.DataFrame]]]) -> list[dict[str, Any]]:
    """Return the values of lanes together, by period and measure: what a signal changes adds up."""
    found: list[dict[str, Any]] = [{}, {}]
    for measure in COMPARED:
        known = [[each[k].get(measure) for each in lanes] for k in range(2)]
        often = np.all([often_known(each) for each in known], axis=0)
        if often.any():
            for into, each in zip(found, known, strict=True):
                mine = [values for values, is_often in zip(each, often, strict=True)
                        if is_often and values is not None]  # fmt: skip
                into[measure] = values_together(mine, adds=measure == "volume_veh_h")
    return found


def _rows(periods: Sequence[Mapping[str, pd.DataFrame]]) -> Iterator[dict[str, Any]]:
    """Yield a row for each measure that is known in both periods."""
    for measure in COMPARED:
        if any(measure not in each for each in periods):
            continue
        found = compare_values(*(by_time(each[measure]) for each in periods))
        half = found.half_width(LEVEL)
        yield {
            "measure": measure, "before": found.before, "after": found.after,
            "difference": found.difference,
            "percent": 100.0 * found.difference / found.before if found.before else np.nan,
            "se": found.se, "low": found.difference - half, "high": found.difference + half,
            "p": found.p, "units": found.units, "count": found.count,
        }  # fmt: skip


def with_verdicts(table: pd.DataFrame) -> pd.DataFrame:
    """Add verdicts: which differences are significant among all lanes and measures."""
    table = table.assign(p_corrected=np.nan, verdict=NOT_TOLD)
    table["p_corrected"] = holm_corrected(table["p"].to_numpy(np.float64))
    least = table["measure"].map({name: of.resolution for name, of in COMPARED.items()})
    told = (table["p_corrected"] < LEVEL) & (table["difference"].abs() >= least)
    table.loc[told & (table["difference"] > 0.0), "verdict"] = MORE
    table.loc[told & (table["difference"] < 0.0), "verdict"] = LESS
    return table
