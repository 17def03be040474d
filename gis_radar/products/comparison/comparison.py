"""Compare the traffic of two periods by lane: differences of measures, with their significance.

Only intervals of a lane that the same sensors saw alike are compared: a second radar sees past what
hides vehicles from the first one, so it finds more of them, which must not look like more traffic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_S,
    Booleans,
    Floats,
    InputError,
    NoAnswerError,
    Text,
    UsageError,
    in_language,
    tr,
)
from gis_radar.dataset import Dataset, LaneTraffic, day_numbers, open_dataset
from gis_radar.hdmap import LANES_LAYER
from gis_radar.products.comparison.result import Comparison, Period
from gis_radar.products.comparison.rows import AlikeRows, compared_rows

INTERVAL, _FINER = "15min", "1min"
_COUNTED_BY = ["lane", "lanelets", "stop_line_m"]  # of lanes: what is counted where
_FEW_HOURS = 12  # periods up to so long have too few quarters of an hour: `_FINER` is used


def compare(
    dataset: Dataset | str | Path,
    other: Dataset | str | Path | None = None,
    *,
    before: Period | str = (None, None),
    after: Period | str = (None, None),
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
        The periods, as for :meth:`gis_radar.Dataset.traffic`, or as `2026-09-07/2026-09-21`; by
        default all of the dataset.
    days : str, optional
        Days of the week to compare, such as `Mo-Fr` or `Sa,Su`; by default all.
    language : str, optional
        Language of the lanes' names.

    Raises
    ------
    UsageError
        If the periods overlap, or there are no such days.
    InputError
        If the datasets differ in tiles, lanes, time zone, method or settings, or one holds no
        vehicles.
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
    tables = _rows(sources, day_numbers(days), language)
    sights = [
        lane_sights(source, table) for (source, _), table in zip(sources, tables, strict=True)
    ]
    with in_language(language):
        name_of_all = tr("All stop lines together")
    doubts = (dataset.doubts, other.doubts, _shared_traffic(sources))
    return _compared(tables, sights, name_of_all, *doubts)


def _as_period(period: Period | str) -> Period:
    """Return begin and end of a period, given as such or as `2026-09-07/2026-09-21`.

    Raises
    ------
    UsageError
        If it is none.
    """
    ends = [each.strip() for each in period.split("/")] if isinstance(period, str) else period
    if not (isinstance(ends, list | tuple) and len(ends) == 2 and "" not in ends):
        raise UsageError("{} is no period, expected as 2026-09-07/2026-09-21", repr(period))
    return ends[0], ends[1]


def _require_alike(dataset: Dataset, other: Dataset) -> None:
    """Refuse datasets whose results differ for other reasons than the traffic."""
    both = (dataset, other)
    differing: dict[Text, list[Any]] = {
        Text("tiles"): [each.manifest.fingerprint for each in both],
        Text("settings"): [each.manifest.settings for each in both],
        Text("time zones"): [each.timezone for each in both],  # times of the day are compared
        Text("methods"): [number for each in both for number in each.methods],
    }
    if len({each.manifest.map for each in both}) > 1:  # such as speed limits may differ
        lanes = [pd.DataFrame(each.layer(LANES_LAYER)) for each in both]
        differing[Text("lanes")] = [each.filter(_COUNTED_BY).to_csv() for each in lanes]
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


def _shared_traffic(sources: Sequence[tuple[Dataset, Period]]) -> list[str]:
    """Return a doubt for each recording of whose time both periods hold a part."""
    columns = ["path", "digest", "begin", "end"]
    first, second = (source.recordings()[columns] for source, _ in sources)
    both = first.merge(second, on="digest")
    begins, ends = ([_seconds(both[f"{name}_{side}"]) for side in "xy"] for name in columns[2:])
    for source, period in sources:
        if (span := source.span(*period)) is not None:
            begins.append(np.full(len(both), span[0] * STEP_S))
            ends.append(np.full(len(both), (span[1] + 1) * STEP_S))
    shared = np.max(begins, axis=0) < np.min(ends, axis=0)
    names = sorted({Path(each).name for each in both.loc[shared, "path_x"]})
    return [Text("{}: is in both periods: its traffic is compared with itself", n) for n in names]


def _rows(
    sources: Sequence[tuple[Dataset, Period]], days: set[int], language: str | None
) -> list[gpd.GeoDataFrame]:
    """Read the traffic of both periods, by `_FINER` intervals where the periods are short."""
    records = [dataset.records(dataset.span(*period)) for dataset, period in sources]
    for (dataset, (begin, end)), of_period in zip(sources, records, strict=True):
        if not of_period:
            raise InputError(
                "{}: no lane is observed from {} to {}",
                dataset.folder,
                begin or Text("its begin"),
                end or Text("its end"),
                hint="gis-radar dataset shows from when to when it was measured",
            )
    methods = [
        (number, dataset.folder)
        for (dataset, _), of_period in zip(sources, records, strict=True)
        for number in LaneTraffic.of(dataset).methods(of_period)
    ]
    if len({number for number, _ in methods}) > 1:
        raise InputError(
            "{}: lanes were measured by another method, and their exact tables are gone",
            min(methods)[1],
            hint="compare periods that were measured alike",
        )
    few = max(map(len, records)) <= _FEW_HOURS
    exact = not any(hour.dropped for each in records for hour in each.values())
    interval = _FINER if few and exact else INTERVAL
    return [_rows_of(*source, interval, days, language) for source in sources]


def _rows_of(
    dataset: Dataset, period: Period, interval: str, days: set[int], language: str | None
) -> gpd.GeoDataFrame:
    begin, end = period
    rows = dataset.traffic(interval, begin=begin, end=end, language=language)
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
    lines = (
        pd.concat(rows)[["lane", "name", "stop_line", "geometry"]]
        .drop_duplicates("lane")
        .set_index("lane")
    )
    left_out, rows_used = [], np.zeros(2)
    alike: dict[int, AlikeRows] = {}
    for lane in sorted(map(int, lines.index)):
        watchers, why = seen_alike(sights[0], sights[1], lane)
        if watchers is None:
            left_out.append({"lane": lane, "name": lines.loc[lane, "name"], "seen": why})
            continue
        alike_rows = [each.of_lane(lane) for each in sights]
        alike_rows = [each[each["watchers"] == watchers] for each in alike_rows]
        rows_used += [len(each) for each in alike_rows]
        alike[lane] = AlikeRows(alike_rows[0], alike_rows[1], shown_names(watchers))
    if not alike:
        raise NoAnswerError(
            "no lane was seen by the same sensors alike in both periods",
            hint="compare periods in which the same sensors, at the same places, recorded nine "
            "tenths of an interval and more: a minute, of long periods a quarter of an hour",
        )
    table = compared_rows(alike)
    if table["p"].isna().all():
        raise NoAnswerError(
            "too few intervals to tell a difference: at most {} of a lane in both periods",
            int(table["count"].max()),
            hint="compare three days and more in each, or three times of day in both",
        )
    names = lines["name"].reindex(table["lane"]).to_numpy()
    table.insert(1, "name", np.where(table["lane"].isna(), together, names))
    table["stop_line"] = lines["stop_line"].reindex(table["lane"]).to_numpy()
    geometry = lines["geometry"].reindex(table["lane"]).to_numpy()
    before, after = ((each["begin"].min(), each["end"].max()) for each in rows)
    return Comparison(
        table=gpd.GeoDataFrame(table, geometry=geometry, crs=rows[0].crs),
        left_out=pd.DataFrame(left_out, columns=["lane", "name", "seen"]),
        used=(float(rows_used[0] / len(rows[0])), float(rows_used[1] / len(rows[1]))),
        before=before, after=after, doubts=sorted({line for each in doubts for line in each}),
    )  # fmt: skip


_ACTIVE_SHARE = 0.9  # least recorded share of an interval of a sensor that counts as present
_SEPARATOR = "\x1f"  # separator of sensors' names, which may hold a comma
_ALIKE_SHARE = 0.9  # least share, of the lane's tiles seen in either period, that is seen in both


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneSights:
    """Sensors that see lanes in the intervals of a period.

    Parameters
    ----------
    rows : DataFrame
        A row for each lane and interval, with `lane`, `begin`, `end` and `watchers`: the joined
        names of the sensors that see a part of the lane; null where one of them recorded only a
        part of the interval.
    tiles : dict
        By sensor and lane, the ids of the lane's tiles in the sensor's sight in the period.
    """

    rows: pd.DataFrame
    tiles: dict[tuple[str, int], frozenset[int]]

    def of_lane(self, lane: int) -> pd.DataFrame:
        """Return the rows of a lane that can be compared."""
        mine = self.rows[self.rows["lane"] == lane]
        return mine[mine["watchers"].notna()]


def lane_sights(dataset: Dataset, rows: pd.DataFrame) -> LaneSights:
    """Find the sensors that see the lanes of a table of traffic.

    Parameters
    ----------
    dataset : Dataset
        The dataset, with recordings, poses and sights.
    rows : DataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    """
    spans = rows[["begin", "end"]].drop_duplicates().sort_values("begin")
    begin, end = (_seconds(spans[name]) for name in ("begin", "end"))
    recordings, poses = dataset.recordings(), dataset.poses()
    recorded = [_seconds(recordings[name]) for name in ("begin", "end")]
    overlapping = recordings[(recorded[0] < end.max()) & (recorded[1] > begin.min())]
    sensors = sorted(set(overlapping["sensor"]))
    tiles = _tiles_by_lane(dataset, overlapping, poses)
    lanes = np.unique(rows["lane"].to_numpy(np.int64))
    sees = np.array([[(each, int(lane)) in tiles for each in sensors] for lane in lanes])
    active, partly = _activity(overlapping, sensors, begin, end)
    lane_place = np.searchsorted(lanes, rows["lane"].to_numpy(np.int64))
    interval_place = np.searchsorted(begin, _seconds(rows["begin"]))
    sees_row = sees[lane_place].reshape(len(rows), -1)
    watching, doubtful = (
        sees_row & active[interval_place],
        (sees_row & partly[interval_place]).any(axis=1),
    )
    names = [_joined_names(sensors, row) for row in watching]
    watchers = pd.Series(names, rows.index, dtype=object).mask(np.asarray(doubtful))
    return LaneSights(rows=rows.assign(watchers=watchers), tiles=tiles)


def _seconds(times: pd.Series) -> Floats:
    """Return times as UNIX seconds."""
    since = times.dt.tz_convert("UTC") - pd.Timestamp(0, tz="UTC")
    return np.asarray(since.dt.total_seconds(), np.float64)


def _joined_names(sensors: Sequence[str], row: Booleans) -> str | None:
    return (
        _SEPARATOR.join(name for name, is_there in zip(sensors, row, strict=True) if is_there)
        or None
    )


def _activity(
    recordings: pd.DataFrame, sensors: Sequence[str], begin: Floats, end: Floats
) -> tuple[Booleans, Booleans]:
    """Return by interval and sensor whether it recorded all of it, and whether only a part."""
    seconds = np.zeros((len(begin), len(sensors)))
    times = (_seconds(recordings[name]) for name in ("begin", "end"))
    latest = dict.fromkeys(sensors, 0.0)  # what two recordings hold counts once
    for sensor, first, last in sorted(zip(recordings["sensor"], *times, strict=True)):
        overlap = np.minimum(end, last) - np.maximum(begin, max(first, latest[sensor]))
        latest[sensor] = max(last, latest[sensor])
        seconds[:, sensors.index(sensor)] += np.maximum(overlap, 0.0)
    share = seconds / (end - begin)[:, None]
    active = share >= _ACTIVE_SHARE
    return active, (share > 1.0 - _ACTIVE_SHARE) & ~active


def _tiles_by_lane(
    dataset: Dataset, recordings: pd.DataFrame, poses: pd.DataFrame
) -> dict[tuple[str, int], frozenset[int]]:
    """Return by sensor and lane the tiles in sight of the poses of its recordings."""
    network = LaneTraffic.of(dataset).network
    lane_of = pd.Series(network.lane[network.tile_lane], network.tile_id)
    heads = poses.loc[poses["track"].isin(recordings["pose"]), ["sensor", "sight"]]
    sights = dataset.sights().merge(heads.drop_duplicates(), left_on="pose", right_on="sight")
    pairs = sights[["sensor", "tile_id"]].drop_duplicates()
    lanes = lane_of.reindex(pairs["tile_id"].to_numpy(np.int64)).to_numpy()
    known = pairs.assign(lane=lanes).dropna()
    groups = known.astype({"lane": np.int64}).groupby(["sensor", "lane"])["tile_id"]
    return {key: frozenset(ids.tolist()) for key, ids in groups}  # type: ignore[misc]


def shown_names(watchers: str) -> str:
    """Return the joined names of sensors separated by commas, for texts."""
    return ", ".join(watchers.split(_SEPARATOR))


def seen_alike(before: LaneSights, after: LaneSights, lane: int) -> tuple[str | None, str]:
    """Return the sensors by which a lane can be compared, or None, and the reason if it cannot.

    Of several groups of sensors that see it in both periods, the one with most intervals is taken.
    """
    counts = [each.of_lane(lane)["watchers"].value_counts() for each in (before, after)]
    both = counts[0].index.intersection(counts[1].index)
    if not len(both):
        seen = (shown_names(next(iter(count.index), "-")) for count in counts)
        return None, " / ".join(seen)
    watchers = str(max(sorted(both), key=lambda name: min(count[name] for count in counts)))
    for sensor in watchers.split(_SEPARATOR):
        first, second = (each.tiles[sensor, lane] for each in (before, after))
        if len(first & second) < _ALIKE_SHARE * len(first | second):
            return None, f"{sensor}: {len(first)} / {len(second)}"
    return watchers, ""
