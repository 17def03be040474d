"""Compare the traffic of two periods by lane: differences of measures, with their significance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_S,
    InputError,
    NoAnswerError,
    Text,
    UsageError,
    speaking,
    tr,
)
from gis_radar.dataset import Dataset, day_numbers, open_dataset
from gis_radar.products.comparison.result import Comparison, Period
from gis_radar.products.comparison.rows import AlikeRows, compared_rows
from gis_radar.products.comparison.sights import LaneSights, lane_sights, seen_alike, shown_names

INTERVAL, FINER = "15min", "1min"
FEW_HOURS = 12  # periods up to so long have too few quarters of an hour: `FINER` is used


def compare(
    dataset: Dataset | str | Path,
    other: Dataset | str | Path | None = None,
    *,
    before: Period | str,
    after: Period | str,
    days: str | None = None,
    language: str | None = None,
) -> Comparison:
    """Compare the traffic of two periods by lane.

    Only what the same sensors saw alike in both is compared: periods of three days and more by
    days, shorter ones by times of day, or else by intervals
    (:mod:`gis_radar.measures.differences`). All lanes with a stop line are compared together, too.

    Parameters
    ----------
    dataset, other : Dataset, str or Path
        Datasets with vehicles, or their folders. The second period is of `other`, where that is
        given.
    before, after : (begin, end) or str
        The periods, as for :meth:`gis_radar.Dataset.traffic`, or as `2026-09-07/2026-09-21`;
        `(None, None)` for a whole dataset.
    days : str, optional
        Days of the week to compare, such as `Mo-Fr` or `Sa,Su`; by default all.
    language : str, optional
        Language of the lanes' names.

    Raises
    ------
    UsageError
        If the periods overlap, or there are no such days.
    InputError
        If the datasets differ in tiles, method or settings, or one holds no vehicles.
    NoAnswerError
        If no lane was seen alike in both periods.
    """
    before, after = map(_as_period, (before, after))
    dataset = open_dataset(dataset)
    other = dataset if other is None else open_dataset(other)
    _require_alike(dataset, other)
    if other.folder.resolve() == dataset.folder.resolve():
        _require_apart(dataset, before, after)
    sources = ((dataset, before), (other, after))
    rows = _rows(sources, day_numbers(days), language)
    sights = [lane_sights(source, table) for (source, _), table in zip(sources, rows, strict=True)]
    with speaking(language):
        together = tr("All stop lines together")
    return _compared(rows, sights, together, dataset.doubts, other.doubts)


def _as_period(period: Period | str) -> Period:
    """Return begin and end of a period, given as such or as `2026-09-07/2026-09-21`.

    Raises
    ------
    UsageError
        If it is none.
    """
    ends = [each.strip() for each in period.split("/")] if isinstance(period, str) else period
    if not (isinstance(ends, list | tuple) and len(ends) == 2 and all(ends)):
        raise UsageError("{} is no period, expected as 2026-09-07/2026-09-21", repr(period))
    return ends[0], ends[1]


def _require_alike(dataset: Dataset, other: Dataset) -> None:
    """Refuse datasets whose results differ for other reasons than the traffic."""
    both = (dataset, other)
    differing: dict[str, list[Any]] = {
        "tiles": [each.manifest.fingerprint for each in both],
        "settings": [each.manifest.settings for each in both],
        "methods": [number for each in both for number in each.methods],
    }
    for what, values in differing.items():
        if any(each != values[0] for each in values):
            raise InputError(
                "{} and {}: were made with different {}",
                dataset.folder,
                other.folder,
                what,
                hint="measure the recordings of both again, alike",
            )


def _require_apart(dataset: Dataset, before: Period, after: Period) -> None:
    first, second = dataset.span(*before), dataset.span(*after)
    if first is None or second is None or (first[0] <= second[1] and second[0] <= first[1]):
        raise UsageError(
            "the periods before and after overlap", hint="name two that have no time in common"
        )


def _rows(
    sources: Sequence[tuple[Dataset, Period]], days: set[int], language: str | None
) -> list[gpd.GeoDataFrame]:
    """Read the traffic of both periods, by `FINER` intervals where the periods are short."""
    records = [dataset.records(dataset.span(*period)) for dataset, period in sources]
    few = max(map(len, records)) <= FEW_HOURS
    exact = not any(hour.dropped for each in records for hour in each.values())
    interval = FINER if few and exact else INTERVAL
    return [_rows_of(*source, interval, days, language) for source in sources]


def _rows_of(
    dataset: Dataset, period: Period, interval: str, days: set[int], language: str | None
) -> gpd.GeoDataFrame:
    begin, end = period
    rows = dataset.traffic(interval, begin=begin, end=end, language=language)
    if rows.empty:
        raise InputError(
            "{}: no lane is observed from {} to {}",
            dataset.folder,
            begin or Text("its begin"),
            end or Text("its end"),
            hint="gis-radar dataset shows from when to when it was measured",
        )
    inside = rows["begin"].dt.day_of_week.isin(days)
    if end is not None:  # an interval that ends later holds traffic from after the period
        last = dataset.span(begin, end)
        ends = rows["end"].dt.tz_convert("UTC") - pd.Timestamp(0, tz="UTC")
        inside &= ends.dt.total_seconds() <= (0.0 if last is None else (last[1] + 1) * STEP_S)
    rows = rows[inside].reset_index(drop=True)
    if rows.empty:
        raise InputError(
            "{}: no whole interval of {} lies from {} to {} on the days asked for",
            dataset.folder,
            interval,
            begin or Text("its begin"),
            end or Text("its end"),
            hint="name a longer period, or other days",
        )
    return rows


def _compared(
    rows: Sequence[gpd.GeoDataFrame], sights: Sequence[LaneSights], together: str,
    *doubts: Sequence[str],
) -> Comparison:  # fmt: skip
    """Return the comparison; `together` is the name of all stop lines."""
    lines = pd.concat(rows)[["lane", "name", "geometry"]].drop_duplicates("lane").set_index("lane")
    left_out, used = [], np.zeros(2)
    alike: dict[int, AlikeRows] = {}
    for lane in sorted(map(int, lines.index)):
        watchers, why = seen_alike(sights[0], sights[1], lane)
        if watchers is None:
            left_out.append({"lane": lane, "name": lines.loc[lane, "name"], "seen": why})
            continue
        mine = [each.of_lane(lane) for each in sights]
        mine = [each[each["watchers"] == watchers] for each in mine]
        used += [len(each) for each in mine]
        alike[lane] = AlikeRows(mine[0], mine[1], shown_names(watchers))
    if not alike:
        raise NoAnswerError(
            "no lane was seen by the same sensors alike in both periods",
            hint="compare periods with the same sensors at the same places",
        )
    table = compared_rows(alike)
    if table["p"].isna().all():
        raise NoAnswerError(
            "too few intervals to tell a difference: at most {} of a lane in both periods",
            int(table["count"].max()),
            hint="compare three days and more in each, or three times of day in both",
        )
    named = lines["name"].reindex(table["lane"]).to_numpy()
    table.insert(1, "name", np.where(table["lane"].isna(), together, named))
    geometry = lines["geometry"].reindex(table["lane"]).to_numpy()
    before, after = ((each["begin"].min(), each["end"].max()) for each in rows)
    return Comparison(
        table=gpd.GeoDataFrame(table, geometry=geometry, crs=rows[0].crs),
        left_out=pd.DataFrame(left_out, columns=["lane", "name", "seen"]),
        used=(float(used[0] / len(rows[0])), float(used[1] / len(rows[1]))),
        before=before, after=after, doubts=sorted({line for each in doubts for line in each}),
    )  # fmt: skip
