"""Traffic by lane as tidy tables with names, local times, km/h and vehicles an hour."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import (
    STEP_S,
    STEP_US,
    STEPS_PER_HOUR,
    STEPS_PER_SECOND,
    Booleans,
    Floats,
    InputError,
    Integers,
    UsageError,
    in_language,
    interval_steps,
    quotient,
    zone_of,
)
from gis_radar.dataset.days.lane_measures import LaneTraffic
from gis_radar.dataset.days.lane_sums import SUMMANDS, measures_of
from gis_radar.dataset.days.tables import STEPS_PER_QUARTER
from gis_radar.dataset.files.frame_times import follow_a_recording
from gis_radar.dataset.files.parts import hour_text
from gis_radar.dataset.files.records import HourRecord, Span
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.source import DatasetFiles
from gis_radar.dataset.files.tables import LANE_MEASURES, TRACKS, TURNS
from gis_radar.dataset.traffic.shifts import MISSED_ACROSS, OtherLanes, lanes_across, shifts_of
from gis_radar.hdmap import LANES_LAYER, TILES_LAYER
from gis_radar.measures import (
    LEAST_DRIVEN,
    LEAST_VISIBLE_SHARE,
    SPEED_CLASS_KMH,
    LaneNetwork,
    lane_names,
    turn_lines,
)

_LEAST_STEPS = 60 * STEPS_PER_SECOND  # least length of an interval: shorter ones have no volume
_DAY_STEPS = 24 * STEPS_PER_HOUR
_KEPT_HOURS = 4  # of measures by shorter intervals: those that three hours touch
_WITH_LANE, _WITH_TURN = ["lane"], ["from_lane", "to_lane"]
_LANE_COLUMNS = (
    "lane", "name", "begin", "end", "visible_share", "counted", "volume", "volume_se",
    "volume_veh_h", "heavy", "speed_kmh", "speed_time_mean_kmh", "speed_85_kmh", "occupancy",
    "occupancy_se", "density_veh_km", "flow_veh_h", "travel_time_s", "delay_s", "queue_max_m",
    "queue_mean_m", "sight_m", "stop_line", "stops",
)  # fmt: skip
_TURN_COLUMNS = (
    *_WITH_TURN, "from_name", "to_name", "turn", "begin", "end", "visible_share", "volume",
    "volume_se", "volume_veh_h",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TrafficReader:
    """Reader of lane measures and turns by intervals of any allowed length.

    Parameters
    ----------
    dataset : DatasetFiles
        The dataset, of which complete hours are read.
    interval : str
        Length of the intervals: `1min`, `5min`, `15min`, `1h`, `24h`. They follow the clocks of the
        site, so that days may have 23 or 25 hours. Under 15 min they are measured from the
        exact tables.
    span : (int, int), optional
        First and last step in which intervals may begin.
    language : str, optional
        Language of the names; by default the current one.
    line_m : mapping
        Counting lines, as for :class:`LaneTraffic`; with any, intervals of 15 min and more are
        measured from the exact tables, too.
    whole : bool
        Whether all intervals are one, as for :meth:`gis_radar.Dataset.traffic`.
    """

    dataset: DatasetFiles
    interval: str = "15min"
    span: Span | None = None
    language: str | None = None
    line_m: Mapping[int, float] = field(default_factory=dict)
    whole: bool = False

    @cached_property
    def traffic(self) -> LaneTraffic:
        """Lane measures of the dataset."""
        return replace(LaneTraffic.of(self.dataset), line_m=self.line_m)

    def lanes(self) -> gpd.GeoDataFrame:
        """Return a row for each lane and interval, as :meth:`gis_radar.Dataset.traffic` does."""
        table, network = self._rows(LANE_MEASURES), self.traffic.network
        for name in ("volume", "occupancy"):
            left_open = self._lasting_variance(table, "lane", name)
            table[f"{name}_se"] = np.sqrt(table[f"{name}_se"] ** 2 + left_open)
        layer = self.dataset.layer(LANES_LAYER)
        drove = table["flow"] * table["hours"] >= LEAST_DRIVEN
        table["travel_time_s"] = table["travel_time_s"].where(drove)
        table["delay_s"] = delays(table, layer, network)
        with in_language(self.language):
            names = lane_names(layer, network)
        place = np.searchsorted(network.lane, table["lane"].to_numpy(np.int64))
        lines = layer.set_index("lane").geometry.loc[network.lane.tolist()].array[place]
        shown = table.assign(
            name=np.array(names, object)[place], volume_veh_h=table["volume"] / table["hours"],
            speed_kmh=table["speed_mean"] * 3.6,
            speed_time_mean_kmh=table["speed_time_mean"] * 3.6,
            speed_85_kmh=_speed_85_kmh(table["speed_counts"]),
            density_veh_km=table["density"], flow_veh_h=table["flow"],
            sight_m=network.sight_m(self.dataset.sights()["tile_id"].unique())[place],
            stop_line=np.array(network.stop_line, object)[place],
        )[[*_LANE_COLUMNS]]  # fmt: skip
        return gpd.GeoDataFrame(shown, geometry=lines, crs=self.dataset.manifest.crs)

    def turns(self) -> gpd.GeoDataFrame:
        """Return a row for each turn and interval, as :meth:`gis_radar.Dataset.turns` does."""
        rolled_up = self.whole or _checked_steps(self.interval) > STEPS_PER_QUARTER
        lanes = self._rows(LANE_MEASURES) if rolled_up else None
        table, network = self._rows(TURNS, lanes), self.traffic.network
        if lanes is not None and not table.empty:
            table = _scaled_to_approaches(table, lanes)
        ways, layer = network.turns(), self.dataset.layer(LANES_LAYER)
        with in_language(self.language):
            names = np.array(lane_names(layer, network), object)
        words, lines = turn_lines(layer, network, ways)
        pairs = {
            (int(network.lane[way.start]), int(network.lane[way.end])): k
            for k, way in enumerate(ways)
        }
        keys = zip(table["from_lane"].tolist(), table["to_lane"].tolist(), strict=True)
        turn_row = np.array([pairs[key] for key in keys], np.int64)
        start, end = (
            np.searchsorted(network.lane, table[name].to_numpy(np.int64)) for name in _WITH_TURN
        )
        approach = table.groupby(["from_lane", "begin"])["volume"].transform("sum")
        share_of_approach = (table["volume"] / approach.where(approach > 0.0)).fillna(1.0)
        left_open = share_of_approach * np.sqrt(
            self._lasting_variance(table, "from_lane", "volume")
        )
        table["volume_se"] = np.hypot(table["volume_se"], left_open)
        shown = table.assign(
            from_name=names[start], to_name=names[end], turn=np.array(words, object)[turn_row],
            volume_veh_h=table["volume"] / table["hours"],
        )[[*_TURN_COLUMNS]]  # fmt: skip
        lines_at = gpd.GeoSeries(lines, crs=self.dataset.manifest.crs).array[turn_row]
        return gpd.GeoDataFrame(shown, geometry=lines_at, crs=self.dataset.manifest.crs)

    @cached_property
    def _tiles(self) -> gpd.GeoDataFrame:
        return self.dataset.layer(TILES_LAYER).sort_values("tile_id", ignore_index=True)

    @cached_property
    def _other_lanes(self) -> OtherLanes:
        shifts = shifts_of(self.dataset.poses(), self.dataset.sights(), self._tiles)
        return OtherLanes.of(shifts, self._tiles, self.traffic.network)

    @cached_property
    def _looked_across(self) -> Booleans:
        poses, sights = self.dataset.poses(), self.dataset.sights()
        return lanes_across(poses, sights, self._tiles, self.traffic.network)

    def _lasting_variance(self, table: pd.DataFrame, lane: str, name: str) -> Floats:
        """Return for each row the variance of a measure that no time averages out.

        It comes from errors of poses, and for a volume also from vehicles that are missed where all
        sensors look straight across the lane. Its cause is the same in all intervals, so it is
        added after quarters are summed.
        """
        network = self.traffic.network
        sums = table.groupby([lane, "begin"], as_index=False)[name].sum(min_count=1)
        wide = sums.pivot_table(name, lane, "begin", dropna=False).reindex(network.lane)
        variance = self._other_lanes.variance(wide.to_numpy(np.float64))
        if name == "volume":
            variance[self._looked_across] += (
                MISSED_ACROSS * wide.to_numpy(np.float64)[self._looked_across]
            ) ** 2
        row = np.searchsorted(network.lane, table[lane].to_numpy(np.int64))
        return np.asarray(variance[row, wide.columns.get_indexer(table["begin"])])

    def _rows(self, table: TableSchema, lanes: pd.DataFrame | None = None) -> pd.DataFrame:
        """Return rows with `begin` and `end` by the clocks of the site.

        The whole time is that of `lanes` if given: turns have no rows of unobserved approaches.
        """
        steps = _checked_steps(self.interval)
        zone = zone_of(self.dataset.manifest.timezone)
        finer = bool(self.line_m) or steps < STEPS_PER_QUARTER
        part_steps = min(steps, STEPS_PER_QUARTER)
        read, known = self.traffic.read, self.dataset.records(self.span)
        parts = self._finer(table, known, part_steps) if finer else read(table, known, self.span)
        empty = table.empty().append_column("first_step", pa.array([], pa.int64()))
        rows = pa.concat_tables([empty, *parts]).drop_columns(["interval"]).to_pandas()
        rows = rows[~follow_a_recording(self.dataset, rows["first_step"].to_numpy(), part_steps)]
        begin = pd.to_datetime(rows.pop("first_step") * STEP_US, unit="us", utc=True)
        part_h = part_steps * STEP_S / 3600.0
        rows = rows.assign(begin=begin, end=begin + _timedelta(part_steps), hours=part_h)
        for name in ("counted", "stops"):
            if name in rows:
                rows[name] = rows[name].astype("Int64")
        in_one = self.whole and not rows.empty
        if in_one:
            time = {"begin": rows["begin"].min(), "end": rows["end"].max(),
                    "hours": rows["begin"].nunique() * part_h}  # fmt: skip
            if lanes is not None:
                time = {name: lanes[name].iloc[0] for name in time}
            rows = rows.assign(**time)
        elif steps > STEPS_PER_QUARTER:
            rows = rows.assign(**interval_edges(rows["begin"], steps, zone))
            rows["hours"] = (rows["end"] - rows["begin"]).dt.total_seconds() / 3600.0
        if in_one or steps > STEPS_PER_QUARTER:
            weight = rows["visible_share"] if in_one else 1.0
            rows = _rolled_up(rows.assign(weight=weight), part_h, self.traffic.network)
        rows = rows.assign(**{name: rows[name].dt.tz_convert(zone) for name in ("begin", "end")})
        keys = _WITH_LANE if table is LANE_MEASURES else _WITH_TURN
        ordered: pd.DataFrame = rows.sort_values([*keys, "begin"], ignore_index=True)
        return ordered

    def _finer(
        self, table: TableSchema, records: Mapping[int, HourRecord], steps: int
    ) -> Iterator[pa.Table]:
        for hour, record in records.items():
            if TRACKS.name not in record.parts:
                continue
            if TRACKS.name in record.dropped:
                raise InputError(
                    "{}: {} has no exact tables any more, which intervals under 15 min and count "
                    "sections are measured from",
                    self.traffic.folder,
                    hour_text(hour),
                    hint="ask for 15min or more of lanes, or for a later time",
                )
            rows = self._measured(record, steps)[table is TURNS]
            first = hour * STEPS_PER_HOUR + rows["interval"].to_numpy().astype(np.int64) * steps
            low, high = self.span or (first.min(initial=0), first.max(initial=0))
            inside = pa.array((first >= low) & (first <= high))
            yield rows.append_column("first_step", pa.array(first)).filter(inside)

    def _measured(self, record: HourRecord, steps: int) -> tuple[pa.Table, pa.Table]:
        """Measure an hour by shorter intervals, once for lanes, turns and the whole time."""
        kept = self.dataset.cache.setdefault("finer", {})
        key = (record.hour, steps, *self.line_m.items(), *self.traffic.key(record))
        if key not in kept:
            if len(kept) >= _KEPT_HOURS:
                del kept[next(iter(kept))]
            kept[key] = self.traffic.finer(record, steps)
        found: tuple[pa.Table, pa.Table] = kept[key]
        return found


def _checked_steps(interval: str) -> int:
    """Return the length of an interval in steps; refuse one that does not fit 15 min and the day.

    Raises
    ------
    UsageError
        If it is no length, under a minute, or does not divide a day.
    """
    steps = interval_steps(interval)
    part = steps >= _LEAST_STEPS and STEPS_PER_QUARTER % steps == 0
    if not part and (steps % STEPS_PER_QUARTER or _DAY_STEPS % steps):
        raise UsageError(
            "interval {} is neither a part of 15 min nor a multiple of it that divides a day",
            repr(interval),
            hint="such as 1min, 5min, 15min, 1h or 24h",
        )
    return steps


def _timedelta(steps: int) -> pd.Timedelta:
    return pd.Timedelta(seconds=steps * STEP_S)


def interval_edges(begin: pd.Series, steps: int, zone: ZoneInfo) -> pd.DataFrame:
    """Return begin and end of the intervals of quarters, by the clocks of the site.

    Intervals up to an hour have their exact length; longer ones end by the clock.
    """
    wall = begin.dt.tz_convert(zone).dt.tz_localize(None)
    floor = wall.dt.floor(_timedelta(steps))
    if steps <= STEPS_PER_HOUR:
        first = begin - (wall - floor)
        return pd.DataFrame({"begin": first, "end": first + _timedelta(steps)})
    edges = {
        name: (floor + after)
        .dt.tz_localize(zone, ambiguous=np.ones(len(floor), np.bool_), nonexistent="shift_forward")
        .dt.tz_convert("UTC")
        for name, after in (("begin", pd.Timedelta(0)), ("end", _timedelta(steps)))
    }
    return pd.DataFrame(edges)


def _rolled_up(rows: pd.DataFrame, part_h: float, network: LaneNetwork) -> pd.DataFrame:
    """Sum intervals of `part_h` hours; those without a volume get the mean of the others.

    Each interval with a volume counts by its `weight`.
    """
    keys = [name for name in (*_WITH_LANE, *_WITH_TURN) if name in rows]
    known, part_weight = rows["volume"].notna(), rows["weight"]
    rows = rows.assign(
        known=known, weight=part_weight.where(known, 0.0), volume=rows["volume"] * part_weight,
        variance=(rows["volume_se"].astype(np.float64) * part_weight) ** 2,
    )  # fmt: skip
    groups = rows.groupby([*keys, "begin", "end", "hours"], sort=True)
    sums = groups[["visible_share", "known", "weight", "variance"]].sum()
    parts = _lengths_h(sums.index) / part_h
    of_known = sums["known"].to_numpy(np.float64)
    scale = parts / np.maximum(sums["weight"].to_numpy(np.float64), 1e-9)
    total_per_known = parts / np.maximum(of_known, 1e-9)
    volume = groups["volume"].sum(min_count=1) * scale
    share = sums["visible_share"].to_numpy(np.float64) / parts
    enough = (sums["known"].to_numpy() > 0) & (share >= LEAST_VISIBLE_SHARE)
    error = np.sqrt(
        scale**2 * sums["variance"]
        + (volume / total_per_known + 0.5) * (total_per_known**2 - total_per_known)
    )
    rolled = pd.DataFrame(
        {
            "visible_share": share,
            "volume": np.where(enough, volume, np.nan),
            "volume_se": np.where(enough, error, np.nan),
        },
        index=sums.index,
    )
    if "lane" in rows:
        rolled = rolled.join(_lane_sums(rows, groups, network))
    return rolled.reset_index()


def _scaled_to_approaches(turns: pd.DataFrame, lanes: pd.DataFrame) -> pd.DataFrame:
    """Scale the volumes of turns, so that those of an approach sum to its volume.

    Where nobody was followed to an exit, turns are not known and approaches are. Where one of the
    turns is never known, the others stay as they are.
    """
    keys = ["from_lane", "begin"]
    total = turns.groupby(keys)["volume"].transform(lambda each: each.sum(skipna=False))
    approach = lanes.set_index(["lane", "begin"])["volume"]
    volume = approach.reindex(pd.MultiIndex.from_frame(turns[keys])).to_numpy()
    scale = (volume / total.where(total > 0.0)).fillna(1.0).mask((total == 0.0) & (volume > 0.0))
    return turns.assign(**{name: turns[name] * scale for name in ("volume", "volume_se")})


def _lane_sums(rows: pd.DataFrame, groups: Any, network: LaneNetwork) -> pd.DataFrame:
    """Return the other measures of lanes over longer intervals."""
    group = groups.ngroup().to_numpy()

    def total(values: Any) -> Floats:
        summed = pd.Series(np.asarray(values, np.float64)).groupby(group).sum(min_count=1)
        return summed.to_numpy(np.float64)

    known = {
        name: rows[name].to_numpy(np.float64, na_value=np.nan)
        for name in rows.select_dtypes("number")
    }
    sums = {
        name: total(summand(*(known[each] for each in sources)))
        for name, (sources, summand) in SUMMANDS.items()
    }
    measures: dict[str, Any] = measures_of(sums)
    by_speed = known["speed_time_mean"] * known["counted"]
    measures["speed_time_mean"] = quotient(
        total(by_speed), total(np.where(np.isfinite(by_speed), known["counted"], np.nan))
    )
    for name in ("counted", "stops"):
        measures[name] = pd.Series(total(known[name])).astype("Int64").array
    measures["heavy"] = total(known["heavy"])
    measures["queue_max_m"] = groups["queue_max_m"].max().to_numpy()
    index = groups.size().index
    measures["speed_counts"] = _summed_lists(rows["speed_counts"], group, len(index))
    measures["speed_mean"] = measures.pop("speed_kmh") / 3.6
    place = np.searchsorted(network.lane, np.asarray(index.get_level_values("lane"), np.int64))
    length_m = network.length_m[place]
    enough = sums["visible_km_h"] >= LEAST_VISIBLE_SHARE * length_m / 1000.0 * _lengths_h(index)
    measures["travel_time_s"] = np.where(enough, quotient(length_m, measures["speed_mean"]), np.nan)
    return pd.DataFrame(measures, index=index)


def _summed_lists(lists: pd.Series, group: Integers, count: int) -> list[Integers | None]:
    """Return the sums of the lists of each group, None of a group without any."""
    known = lists.notna().to_numpy()
    if not known.any():
        return [None] * count
    values = np.stack(lists[known].to_list())
    sums, has = np.zeros((count, values.shape[1]), np.int64), np.zeros(count, np.bool_)
    np.add.at(sums, group[known], values)
    has[group[known]] = True
    return [row if is_known else None for row, is_known in zip(sums, has, strict=True)]


def _lengths_h(index: pd.MultiIndex | pd.Index) -> Floats:
    """Return the lengths of intervals in hours."""
    return np.asarray(index.get_level_values("hours"), np.float64)


def _speed_85_kmh(counts: pd.Series) -> Floats:
    """Return the speeds that 85 % do not exceed, of speeds spread evenly within their classes."""
    speeds = np.full(len(counts), np.nan)
    rows = np.flatnonzero(counts.notna())
    if not len(rows):
        return speeds
    below = np.cumsum(np.stack(counts.iloc[rows].to_list()), axis=1).astype(np.float64)
    rows, below = rows[below[:, -1] > 0], below[below[:, -1] > 0]
    wanted = 0.85 * below[:, -1]
    k = (below < wanted[:, None]).sum(axis=1)
    row = np.arange(len(k))
    before = np.where(k > 0, below[row, k - 1], 0.0)
    speeds[rows] = (k + (wanted - before) / (below[row, k] - before)) * SPEED_CLASS_KMH
    return speeds


def delays(table: pd.DataFrame, layer: gpd.GeoDataFrame, network: LaneNetwork) -> pd.Series:
    """Return delays against the free speeds of a layer, which may differ from those when measured.

    Parameters
    ----------
    table : DataFrame
        Table with `lane` and `travel_time_s`.
    layer : GeoDataFrame
        The layer `lanes`.
    network : LaneNetwork
        Its lengths.

    Returns
    -------
    Series
        Seconds; NaN where travel time or free speed is unknown.
    """
    limit = layer.get("speed_limit_kmh", pd.Series(np.nan, layer.index)).astype(np.float64)
    free_s = pd.Series(network.length_m, network.lane) / (limit.set_axis(layer["lane"]) / 3.6)
    delay: pd.Series = table["travel_time_s"] - table["lane"].map(free_s)
    return delay.clip(lower=0.0)
