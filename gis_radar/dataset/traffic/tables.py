"""Traffic of a dataset by lane, turn, queue and cycle: methods of :class:`gis_radar.Dataset`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_S,
    STEP_US,
    STEPS_PER_HOUR,
    STEPS_PER_SECOND,
    InputError,
    Text,
    UsageError,
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
from gis_radar.dataset.files.frame_times import recorded_span, recording_steps
from gis_radar.dataset.files.parts import hour_text
from gis_radar.dataset.files.records import Span
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.files.tables import TRACKS
from gis_radar.dataset.traffic.reader import TrafficReader, interval_edges
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


_USUAL = "15min"
# Lengths of intervals, each with the longest time (s) that it is used for: some 30 of a recording,
# then 96 a day.
_INTERVALS = (("1min", 1800.0), ("5min", 10_800.0), (_USUAL, np.inf))


def suited_interval(
    dataset: DatasetFiles, begin: Moment = None, end: Moment = None
) -> tuple[str, int | None]:
    """Return the length of intervals that suits a time, and the step in which the first begins.

    Parameters
    ----------
    dataset : DatasetFiles
        The dataset.
    begin, end : str, datetime or step, optional
        The time, of which that in recordings counts.
    """
    span = dataset.span(begin, end)
    recorded = recording_steps(dataset)
    recorded = recorded if span is None else recorded.within(*span)
    length_s = np.ptp(np.append(recorded.first, recorded.last)) * STEP_S if len(recorded) else 0.0
    interval = next(name for name, most_s in _INTERVALS if length_s <= most_s)
    if interval != _USUAL and any(each.dropped for each in dataset.records(span).values()):
        interval = _USUAL
    steps = interval_steps(interval)
    return interval, None if span is None or begin is None else span[0] // steps * steps


def traffic(
    dataset: DatasetFiles, interval: str | None = None, *, begin: Moment = None,
    end: Moment = None, language: str | None = None, whole: bool = False, headways: bool = False,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the traffic of lanes, a row for each lane and interval.

    Parameters
    ----------
    interval : str, optional
        Length of the intervals, such as `1h`: a multiple of 15 min that divides a day, or a
        divisor of 15 min from 1 min on; by default `15min`. Intervals follow the clocks of the
        site.
    begin, end : str, datetime or step, optional
        Times between which the intervals begin.
    language : str, optional
        Language of the lanes' names, `en` or `de`; by default the current one, else English.
    whole : bool
        One row a lane, of all intervals together that were measured: from the begin of the
        first to the end of the last, `volume` without the time between. Intervals count by the
        share of them that was visible, so that those in which a recording begins or ends count
        less. They are of 15 min, or of `interval` where that is less. By default they suit the
        time, as in the report: `1min` up to half an hour, `5min` up to three hours, and from the
        one on in which it begins.
    headways : bool
        Add headways and gaps, which are measured from exact tables.

    Returns
    -------
    GeoDataFrame
        By lane and time: `lane` (its number), `name`; `begin`, `end` in the site's zone;
        `visible_share`, `counted`, `volume` (vehicles in the interval), `volume_se`,
        `volume_veh_h`, `heavy`; `speed_kmh` (space mean), `speed_time_mean_kmh`,
        `speed_85_kmh`; `occupancy`, `occupancy_se`, `density_veh_km`, `flow_veh_h`,
        `travel_time_s`, `delay_s`, `queue_max_m`, `queue_mean_m`, `sight_m`, `stop_line`
        (`drawn` in the map, or `presumed`), `stops`; the lane's line. Null where nothing is
        visible. Lanes that no sensor observes have no rows. With headways `headways` (number of
        pairs of consecutive vehicles at the counting line, between which it was visible
        throughout), `headway_mean_s` (front to front), `headway_se_s`, `headway_median_s`,
        `gap_mean_s` (rear to front), `gap_se_s`. Null where the line was not visible, means
        without a pair, errors with less than two.

    Raises
    ------
    UsageError
        If there is no such interval, or headways are asked of the whole time.
    InputError
        If vehicles were not looked for, or nothing was measured from begin to end; or if the
        interval is under 15 min, or headways are asked, and exact tables were deleted.
    """
    if headways and whole:
        raise UsageError("headways are of intervals, not of the whole time")
    lanes = _reader(dataset, interval, begin, end, language, whole=whole).lanes()
    if headways:
        return add_headways(dataset, lanes, interval or _USUAL, dataset.span(begin, end))
    return lanes


def turns(
    dataset: DatasetFiles, interval: str | None = None, *, begin: Moment = None,
    end: Moment = None, language: str | None = None, whole: bool = False,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the volumes of turns, a row for each turn and interval; as :meth:`traffic`.

    Returns
    -------
    GeoDataFrame
        `from_lane`, `to_lane`, `from_name`, `to_name`, `turn` (`left`, `straight`, `right` or
        `back`), `begin`, `end`, `visible_share`, `volume`, `volume_se`, `volume_veh_h`; the way
        from the stop line to the exit.
    """
    return _reader(dataset, interval, begin, end, language, whole=whole).turns()


def queues(
    dataset: DatasetFiles, interval: str = _USUAL, *, begin: Moment = None, end: Moment = None,
    language: str | None = None,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the queues at stop lines: rows of :meth:`traffic` in which a stop line is visible.

    Before a junction for which the map draws none, a stop line is presumed.

    Returns
    -------
    GeoDataFrame
        `lane`, `name`, `begin`, `end`, `visible_share`, `queue_max_m`, `queue_mean_m`,
        `sight_m` (how far before the stop line the lane is in sight: a queue that reaches as
        far may be longer), `stop_line` (`drawn` in the map, or `presumed`), `stops`, `delay_s`;
        the lane's line.
    """
    lanes = _reader(dataset, interval, begin, end, language).lanes()
    lanes = lanes[lanes["queue_max_m"].notna()].reset_index(drop=True)
    return lanes[
        ["lane", "name", "begin", "end", "visible_share", "queue_max_m", "queue_mean_m",
         "sight_m", "stop_line", "stops", "delay_s", "geometry"]
    ]  # fmt: skip


def _reader(
    dataset: DatasetFiles, interval: str | None, begin: Moment, end: Moment, language: str | None,
    *, whole: bool = False,
) -> TrafficReader:  # fmt: skip
    require_vehicles(dataset)
    if interval is None and whole:
        interval, begin = suited_interval(dataset, begin, end)
    interval = interval or _USUAL
    steps = min(interval_steps(interval), STEPS_PER_QUARTER)
    return TrafficReader(
        dataset=dataset, interval=interval, span=recorded_span(dataset, begin, end, steps),
        language=language, whole=whole,
    )  # fmt: skip
