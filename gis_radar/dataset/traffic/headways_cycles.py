"""Headways and cycles: traffic that is measured from exact tables when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_US,
    STEPS_PER_HOUR,
    STEPS_PER_SECOND,
    InputError,
    Text,
    csv_rows,
    in_language,
    interval_steps,
    listed,
    stated_moment,
    step_at,
    text_in,
    tr,
    zone_of,
)
from gis_radar.dataset.days.lane_measures import LaneTraffic
from gis_radar.dataset.days.tables import STEPS_PER_QUARTER
from gis_radar.dataset.files.frame_times import recorded_span
from gis_radar.dataset.files.parts import hour_text
from gis_radar.dataset.files.records import Span
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.files.tables import TRACKS
from gis_radar.dataset.traffic.reader import interval_edges
from gis_radar.hdmap import LANES_LAYER
from gis_radar.measures import (
    Cycle,
    Greens,
    Headways,
    LaneNetwork,
    TrackedLanes,
    cycles,
    headways,
    lane_names,
)

_LENGTHS = ("cycle_s", "cycle_se_s", "queue_max_m", "queue_mean_m", "queue_end_m")
_HEADWAYS = ("headway_mean_s", "headway_se_s", "headway_median_s", "gap_mean_s", "gap_se_s")


def add_headways(
    dataset: DatasetFiles, lanes: gpd.GeoDataFrame, interval: str, span: Span | None
) -> gpd.GeoDataFrame:
    """Add headways and gaps to the traffic of lanes; see :meth:`gis_radar.Dataset.traffic`."""
    steps = interval_steps(interval)
    network, hours = _exact_hours(dataset, span)
    parts = list(map(headways, hours))
    pairs = Headways._make(map(np.concatenate, zip(*parts, strict=True))) if parts else None
    table = pd.DataFrame(pairs._asdict() if pairs else {name: [] for name in Headways._fields})
    part = min(steps, STEPS_PER_QUARTER)
    first = table["step"] // part * part
    low, high = span or (first.min(), first.max())
    table = table[(first >= low) & (first <= high)]
    zone = zone_of(dataset.timezone)
    times = _utc_times(table["step"] // part * part)
    table = table.assign(
        lane=network.lane[table["lane"].astype(np.int64)],
        begin=interval_edges(times, steps, zone)["begin"].dt.tz_convert(zone),
    )
    sums = _by_interval(table).reindex(pd.MultiIndex.from_frame(lanes[["lane", "begin"]]))
    number = sums.pop("headways").fillna(0).set_axis(lanes.index).astype("Int64")
    added: dict[str, Any] = {"headways": number.where(lanes["counted"].notna())}
    added |= {name: sums[name].to_numpy(np.float64) for name in _HEADWAYS}
    shape = lanes.geometry.name
    return lanes.drop(columns=shape).assign(**added).join(lanes[[shape]]).set_geometry(shape)


def _by_interval(table: pd.DataFrame) -> pd.DataFrame:
    """Return means, medians and errors, by lane and interval.

    The mean of n headways has the variance s^2 / n, and as n may be wrong by counting also
    mean^2 var(n) / n^2.
    """
    groups = table.groupby(["lane", "begin"])
    number, gaps = groups.size(), groups["gap_s"].count()
    mean = groups["headway_s"].mean()
    of_number = groups["variance"].sum() / number**2
    of_gap, gap = groups["gap_s"].std() ** 2 / gaps, groups["gap_s"].mean()
    values = (
        mean, np.sqrt(groups["headway_s"].std() ** 2 / number + mean**2 * of_number),
        groups["headway_s"].median(), gap, np.sqrt(of_gap + gap**2 * of_number),
    )  # fmt: skip
    named = dict(zip(_HEADWAYS, values, strict=True))
    return pd.DataFrame({"headways": number, **named})


def signal_cycles(
    dataset: DatasetFiles, *, signals: str | Path | None = None, begin: Moment = None,
    end: Moment = None, language: str | None = None,
) -> pd.DataFrame:  # fmt: skip
    """Return the cycles of signals at stop lines, as the traffic shows them.

    Parameters
    ----------
    signals : str or Path, optional
        CSV of green times, which count in place of those that the traffic shows: `lane` (its
        number or name), `green_begin`, and where known `green_end`; without a zone by the
        clocks of the site.
    begin, end, language
        As for :meth:`traffic`; hours are taken as a whole.

    Returns
    -------
    DataFrame
        A row a stop line and cycle, from a begin of green to the next: `lane`, `name`, `begin`,
        `end`, `cycle_s` and `cycle_se_s` (of the hour), `counted`, `queue_max_m`,
        `queue_mean_m`, `queue_end_m` (at the end of green), `reason` (why figures are missing).
        Where no cycle can be inferred in an hour, one row with the reason.

    Raises
    ------
    InputError
        If vehicles were not looked for, nothing was measured from begin to end, exact tables of
        that time were deleted, or the signals are not what they should be or of a lane without
        a stop line.
    """
    require_vehicles(dataset)
    span = recorded_span(dataset, begin, end)
    network, hours = _exact_hours(dataset, span)
    with in_language(language):
        names = np.array(lane_names(dataset.layer(LANES_LAYER), network), object)
    place_of = {
        str(each): k for name in (names, network.lane) for k, each in enumerate(name.tolist())
    }
    known = None if signals is None else read_signals(signals, place_of, zone_of(dataset.timezone))
    if without_line := [lane for lane in known or () if not network.has_stop_line[lane]]:
        raise InputError(
            "{}: lane {} has no stop line", signals, int(network.lane[without_line[0]])
        )
    measured = [*dataset.records(span)]
    if (
        known
        and measured
        and not any(
            np.isin(each.begin // STEPS_PER_HOUR, measured).any() for each in known.values()
        )
    ):
        raise InputError(
            "{}: none of its greens begins in the time that was measured, {} to {}",
            signals, hour_text(measured[0]), hour_text(measured[-1] + 1),
            hint="are they of another day, or by clocks of another time zone?",
        )  # fmt: skip
    rows = [each for hour in hours for each in cycles(hour, known)]
    with in_language(language):
        reason = [tr(each.reason) if each.reason else "" for each in rows]
    table = pd.DataFrame(rows, columns=list(Cycle._fields))
    place, zone = table["lane"].to_numpy(np.int64), zone_of(dataset.timezone)
    times = {"begin": _utc_times(table["first"]), "end": _utc_times(table["after"])}
    table = table.assign(lane=network.lane[place], counted=table["counted"].astype("Int64"))
    table = table.drop(columns=["first", "after", "reason"]).astype(dict.fromkeys(_LENGTHS, float))
    for column, (name, values) in enumerate(times.items(), start=1):
        table.insert(column, name, values.dt.tz_convert(zone))
    table.insert(1, "name", pd.array(names[place], "str"))
    return table.assign(reason=pd.array(reason, "str")).sort_values(
        ["lane", "begin"], ignore_index=True
    )


def _utc_times(steps: pd.Series) -> pd.Series:
    return pd.to_datetime(steps.astype(np.int64) * STEP_US, unit="us", utc=True)


def _exact_hours(
    dataset: DatasetFiles, span: Span | None
) -> tuple[LaneNetwork, Iterator[TrackedLanes]]:
    """Return the network, and the lanes of each hour with all vehicles on them."""
    traffic = LaneTraffic.of(dataset)
    records = [each for each in dataset.records(span).values() if TRACKS.name in each.parts]
    return traffic.network, map(traffic.exact, records)


_NEEDED = ("lane", "green_begin")


def read_signals(path: str | Path, lanes: Mapping[str, int], zone: ZoneInfo) -> dict[int, Greens]:
    """Read begins and, where they are stated, ends of green.

    Parameters
    ----------
    path : str or Path
        CSV with a header: `lane`, its number or name; `green_begin` and, optional, `green_end`,
        without a zone by the clocks of the site.
    lanes : mapping
        Positions of the lanes by their numbers, as text, and their names.
    zone : ZoneInfo
        Time zone of the site.

    Raises
    ------
    InputError
        If it is no such table, is empty, names an unknown lane, or a green ends before it begins or
        after the next one begins, or two begin within a second.
    """
    header, rows = csv_rows(path, Text("not a table of signals"))
    if missing := [name for name in _NEEDED if name not in header]:
        hint = Text("columns are lane, green_begin, green_end")
        raise InputError("{}: lacks the columns {}", path, listed(missing), hint=hint)
    if not rows:
        raise InputError("{}: holds no green times", path)
    greens: dict[int, dict[int, int]] = {}
    for number, row in rows:
        what = f"{path}, line {number}"
        lane, begin, end = (text_in(row, name) for name in (*_NEEDED, "green_end"))
        if lane not in lanes:
            raise InputError(
                "{}: lane {} is none that was measured", what, repr(lane),
                hint="traffic.csv lists lanes with numbers and names",
            )  # fmt: skip
        first, ends = _step(begin, zone, f"{what}: green_begin"), greens.setdefault(lanes[lane], {})
        if first in ends:
            raise InputError("{}: a green of the lane begins then already", what)
        ends[first] = _step(end, zone, f"{what}: green_end") if end else -1
    return {lane: _greens(greens[lane], path) for lane in sorted(greens)}


def _step(text: str, zone: ZoneInfo, what: str) -> int:
    return int(step_at(stated_moment(text, zone, what), zone, what=what))


def _greens(ends: Mapping[int, int], path: str | Path) -> Greens:
    begin = np.array(sorted(ends), np.int64)
    end = np.array([ends[each] for each in begin.tolist()], np.int64)
    stated = end >= 0
    after = np.append(begin[1:], np.iinfo(np.int64).max)
    if (stated & ((end <= begin) | (end > after))).any():
        raise InputError("{}: a green ends before it begins, or after the next one begins", path)
    if (np.diff(begin) < STEPS_PER_SECOND).any():  # queues are measured each second
        raise InputError("{}: two greens begin within a second", path)
    return Greens(begin, end)
