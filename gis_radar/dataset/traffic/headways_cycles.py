"""Headways and cycles: traffic that is measured from exact tables when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_US,
    STEPS_PER_HOUR,
    InputError,
    interval_steps,
    speaking,
    tr,
    zone_of,
)
from gis_radar.dataset.days.lane_measures import LaneTraffic
from gis_radar.dataset.days.tables import STEPS_PER_QUARTER
from gis_radar.dataset.files.reading import Span
from gis_radar.dataset.files.source import Source, require_vehicles
from gis_radar.dataset.files.tables import TRACKS
from gis_radar.dataset.traffic.reader import interval_edges
from gis_radar.dataset.traffic.signals import read_signals
from gis_radar.hdmap import LANES_LAYER
from gis_radar.measures import (
    Cycle,
    FrontStates,
    Headways,
    LaneNetwork,
    StepGrid,
    VehicleTable,
    VisibleRuns,
    cycles,
    headways,
    lane_names,
)

_Hour: TypeAlias = tuple[StepGrid, FrontStates, VehicleTable, VisibleRuns]
_LENGTHS = ("cycle_s", "cycle_se_s", "queue_max_m", "queue_mean_m", "queue_end_m")
_HEADWAYS = ("headway_mean_s", "headway_se_s", "headway_median_s", "gap_mean_s", "gap_se_s")


def add_headways(
    dataset: Source, lanes: gpd.GeoDataFrame, interval: str, span: Span | None
) -> gpd.GeoDataFrame:
    """Add headways and gaps to the traffic of lanes; see :meth:`gis_radar.Dataset.traffic`."""
    steps = interval_steps(interval)
    network, hours = _exact(dataset, span)
    found = [headways(network, *each) for each in hours]
    pairs = Headways._make(map(np.concatenate, zip(*found, strict=True))) if found else None
    table = pd.DataFrame(pairs._asdict() if pairs else {name: [] for name in Headways._fields})
    part = min(steps, STEPS_PER_QUARTER)
    first = table["step"] // part * part
    low, high = span or (first.min(), first.max())
    table = table[(first >= low) & (first <= high)]
    zone = zone_of(dataset.timezone)
    times = _times(table["step"] // part * part)
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


def cycles_of(
    dataset: Source, signals: str | Path | None, span: Span | None, language: str | None
) -> pd.DataFrame:
    """Return the cycles of signals; see :meth:`gis_radar.Dataset.signal_cycles`."""
    require_vehicles(dataset)
    network, hours = _exact(dataset, span)
    with speaking(language):
        names = np.array(lane_names(dataset.layer(LANES_LAYER), network), object)
    at = {str(each): k for name in (names, network.lane) for k, each in enumerate(name.tolist())}
    known = None if signals is None else read_signals(signals, at, zone_of(dataset.timezone))
    if off := [lane for lane in known or () if not network.has_stop_line[lane]]:
        raise InputError("{}: lane {} has no stop line", signals, int(network.lane[off[0]]))
    found = [each for hour in hours for each in cycles(network, *hour, known=known)]
    with speaking(language):
        reason = [tr(each.reason) if each.reason else "" for each in found]
    table = pd.DataFrame(found, columns=list(Cycle._fields))
    place, zone = table["lane"].to_numpy(np.int64), zone_of(dataset.timezone)
    times = {"begin": _times(table["first"]), "end": _times(table["after"])}
    table = table.assign(lane=network.lane[place], counted=table["counted"].astype("Int64"))
    table = table.drop(columns=["first", "after", "reason"]).astype(dict.fromkeys(_LENGTHS, float))
    for column, (name, values) in enumerate(times.items(), start=1):
        table.insert(column, name, values.dt.tz_convert(zone))
    table.insert(1, "name", pd.array(names[place], "str"))
    return table.assign(reason=pd.array(reason, "str")).sort_values(
        ["lane", "begin"], ignore_index=True
    )


def _times(steps: pd.Series) -> pd.Series:
    return pd.to_datetime(steps.astype(np.int64) * STEP_US, unit="us", utc=True)


def _exact(dataset: Source, span: Span | None) -> tuple[LaneNetwork, Iterator[_Hour]]:
    """Return the network, and of each hour its grid, states, vehicles and visible runs."""
    traffic = LaneTraffic.of(dataset)
    records = [each for each in dataset.records(span).values() if TRACKS.name in each.parts]
    hours = (
        (StepGrid(begin=each.hour * STEPS_PER_HOUR, steps=STEPS_PER_HOUR, count=1),
         *traffic.exact(each))
        for each in records
    )  # fmt: skip
    return traffic.network, hours
