"""Days of a dataset that were not measured: counts and measures are sums of measured parts.

A part is half a minute. Those of a quarter of an hour are drawn from the two levels of demand next
to the wanted one. The hours have no exact tables, as after `keep`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from functools import cached_property
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.calibration import Finding
from gis_radar.dataset import (
    TILE_COUNTS,
    Dataset,
    HourRecord,
    LaneTraffic,
    MeasureSettings,
    Origin,
    RollUps,
    hour_text,
    open_dataset,
    write_record,
)
from gis_radar.dataset.days.lane_measures import LANES_METHOD
from gis_radar.dataset.days.tables import QUARTERS, DayTables
from gis_radar.dataset.days.tile_counts import count_keys
from gis_radar.dataset.files.parts import HOURS_PER_DAY, PartDigest
from gis_radar.dataset.files.registry import RecordingEntry, Registry
from gis_radar.dataset.files.tables import HOUR_TABLES
from simulation.measured_minutes import PARTS, MeasuredParts

DRAWN = "drawn"  # entry of a dataset's settings, and folder in the paths of its recordings
_QUARTERS_A_DAY = HOURS_PER_DAY * QUARTERS
_NIGHT_DEMAND = 0.06  # demand as a share of the busiest
# Peaks on workdays and on others: local hour, width in hours, share of the busiest demand.
_WORKDAY_PEAKS = (7.7, 1.1, 0.8), (13.0, 3.2, 0.45), (17.1, 1.6, 0.8)
_PEAKS_BY_WORKDAY = {True: _WORKDAY_PEAKS, False: ((14.5, 3.6, 0.55),)}
_SATURDAY, _SUNDAY = 5, 6
_THREADS = 4
_DAY = timedelta(days=1)
_DAY_SIGMA, _QUARTER_SIGMA = 0.05, 0.08  # of the logarithm of demand: by day, by quarter


@dataclass(frozen=True, kw_only=True)
class DrawnEvents:
    """Events at a site on drawn days.

    Parameters
    ----------
    jam : (datetime, datetime), optional
        Begin and end of a jam: quarters are drawn from the last level of demand.
    silent : mapping
        Begin and end of the time in which a sensor delivers nothing, by sensor.
    shares : mapping
        Demand as a share of the usual, by the first day on which it holds.
    """

    jam: tuple[datetime, datetime] | None = None
    silent: Mapping[str, tuple[datetime, datetime]] = field(default_factory=dict)
    shares: Mapping[date, float] = field(default_factory=dict)

    def share(self, day: date) -> float:
        """Return the demand of a day as a share of the usual."""
        begun = [share for first, share in sorted(self.shares.items()) if first <= day]
        return begun[-1] if begun else 1.0

    def heard(self, sensors: Sequence[str], hour: datetime) -> frozenset[str]:
        """Return the sensors that deliver frames in an hour."""
        gone = {name for name, (begin, end) in self.silent.items() if begin <= hour < end}
        return frozenset(sensors) - gone


def demand_at(begin: pd.DatetimeIndex) -> Floats:
    """Return the usual demand at local times, as a share of the busiest."""
    hour = np.asarray(begin.hour + begin.minute / 60.0, np.float64)
    weekday = np.asarray(begin.day_of_week)
    found = np.full(len(begin), _NIGHT_DEMAND)
    for workday, peaks in _PEAKS_BY_WORKDAY.items():
        mine = (weekday < _SATURDAY) == workday
        for middle, width, share in peaks:
            found[mine] += share * np.exp(-0.5 * ((hour[mine] - middle) / width) ** 2)
    return np.asarray(np.minimum(found * np.where(weekday == _SUNDAY, 0.75, 1.0), 1.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class DayDrawer:
    """Source of the drawn days of a dataset.

    Parameters
    ----------
    dataset : Dataset
        The dataset with measured hours, to which days are added.
    parts : dict
        Measured parts by the sensors that deliver in them.
    demands : sequence of float
        Demand of each level, ascending; one over 1 is a jam.
    events : DrawnEvents
        Events.
    seed : int
        Seed of all random numbers.
    """

    dataset: Dataset
    parts: Mapping[frozenset[str], MeasuredParts]
    demands: Sequence[float]
    events: DrawnEvents = field(default_factory=DrawnEvents)
    seed: int = 1

    @cached_property
    def _sensors(self) -> list[str]:
        return self.dataset.sensors

    @cached_property
    def _method(self) -> int:
        return max(self.dataset.methods)

    def draw(self, begin: datetime, end: datetime, *, remark: str) -> Dataset:
        """Draw and write the hours from `begin` to `end`, and return the dataset.

        Parameters
        ----------
        begin, end : datetime
            Whole hours.
        remark : str
            Text about them for the dataset's settings.
        """
        folder, manifest = self.dataset.folder, self.dataset.manifest
        replace(manifest, settings=manifest.settings | {DRAWN: remark}).write(folder)
        days = [
            (max(day, begin), min(day + _DAY, end))
            for k in range((end.date() - begin.date()).days + 1)
            if (day := _midnight(begin) + k * _DAY) < end
        ]
        with ThreadPoolExecutor(_THREADS) as pool:  # threads mostly wait for the disk
            drawn = [hour for hours in pool.map(self.draw_day, days) for hour in hours]
        margin = MeasureSettings.from_dict(manifest.settings).margin
        registry = Registry.read(folder, manifest.fingerprint)
        entries = [entry for day in days for entry in self.entries(registry, *day)]
        known = replace(registry, entries=(*registry.entries, *entries))
        records = self.dataset.records()
        known.with_hours(records, margin).write_recordings()
        sums = RollUps(folder=folder, fingerprint=manifest.fingerprint, timezone=manifest.timezone)
        sums.update(drawn, records)
        return open_dataset(folder)

    def draw_day(self, span: tuple[datetime, datetime]) -> list[int]:
        """Write tables and records of a day; return its hours in which a sensor delivers."""
        midnight = _midnight(span[0])
        first = _hour(midnight)
        heard = {
            hour: self.events.heard(self._sensors, midnight + timedelta(hours=hour - first))
            for hour in range(_hour(span[0]), _hour(span[1]))
        }
        records = {hour: self._record(hour) for hour, sensors in heard.items() if sensors}
        times = self._times(midnight)
        made = dict[frozenset[str], tuple[pa.Table, pa.Table, pa.Table]]()
        for sensors in {heard[hour] for hour in records}:
            hours = np.array([hour - first for hour in records if heard[hour] == sensors])
            quarters = (hours[:, None] * QUARTERS + np.arange(QUARTERS)).ravel()
            made[sensors] = self.parts[sensors].rows(times[sensors][quarters], quarters)

        def rows(hour: int) -> list[pa.Table]:
            """Return the tables of an hour: tile counts, lane measures, turns."""
            found = made[heard[hour]]
            hours = [table["interval"].to_numpy() // QUARTERS for table in found]
            return [
                table.filter(each == hour - first) for table, each in zip(found, hours, strict=True)
            ]

        keys = count_keys(records)
        of_traffic = {hour: [LANES_METHOD, *key, *key] for hour, key in keys.items()}
        parts = zip(*map(rows, records), strict=True)
        for table, each in zip((TILE_COUNTS, *LaneTraffic.tables), parts, strict=False):
            whole = pa.concat_tables(each, promote_options="default")
            whole = whole.sort_by([(name, "ascending") for name in table.order])
            made_of = keys if table is TILE_COUNTS else of_traffic
            DayTables.of(self.dataset).file(table, first).write(whole, made_of)
        for record in records.values():
            write_record(self.dataset.folder, record)
        return [*records]

    def _times(self, begin: datetime) -> dict[frozenset[str], Floats]:
        """Draw how often each measured part is in each quarter of a day, by sensors."""
        rng = np.random.default_rng([self.seed, begin.toordinal()])
        quarters = pd.date_range(begin, periods=_QUARTERS_A_DAY, freq="15min")
        demand = demand_at(quarters.tz_convert(ZoneInfo(self.dataset.timezone)))
        demand *= self.events.share(begin.date()) * np.exp(rng.normal(0.0, _DAY_SIGMA))
        demand *= np.exp(rng.normal(0.0, _QUARTER_SIGMA, len(demand)))
        usual = np.array([each for each in self.demands if each <= 1.0])
        place = np.interp(demand, usual, np.arange(len(usual)))[:, None]
        level = np.floor(place + rng.random((len(demand), PARTS))).astype(np.int64)
        if self.events.jam is not None:
            since, until = map(pd.Timestamp, self.events.jam)
            level[np.asarray((quarters >= since) & (quarters < until))] = len(self.demands) - 1
        share = rng.random(level.shape)
        return {sensors: _times_of(parts, level, share) for sensors, parts in self.parts.items()}

    def _record(self, hour: int) -> HourRecord:
        manifest = self.dataset.manifest
        text = f"{DRAWN} {self.seed} {hour_text(hour)} of {self._sensors}"
        origin = Origin(
            fingerprint=manifest.fingerprint, method=self._method,
            inputs=hashlib.sha256(text.encode()).hexdigest(),
        )  # fmt: skip
        names = tuple(table.name for table in HOUR_TABLES)
        none = PartDigest(rows=0, size=0, sha256=hashlib.sha256(b"").hexdigest())
        return HourRecord(hour=hour, origin=origin, parts=dict.fromkeys(names, none), dropped=names)

    def entries(self, registry: Registry, begin: datetime, end: datetime) -> list[RecordingEntry]:
        """Return the entries of a day's recordings: one a sensor, two where it was silent."""
        found = list[RecordingEntry]()
        for each in {entry.sensor: entry for entry in registry.entries}.values():
            spans = [(begin, end)]
            if each.sensor in self.events.silent:
                since, until = self.events.silent[each.sensor]
                pairs = [(begin, min(end, since)), (max(begin, until), end)]
                spans = [(a, b) for a, b in pairs if a < b]
                spans = spans if since < end and begin < until else [(begin, end)]
            for first, last in spans:
                path = f"{DRAWN}/{each.sensor}_{first:%Y%m%dT%H%M}Z.parquet"
                of_site = f"{self.dataset.manifest.fingerprint} {path}"
                found.append(
                    replace(
                        each, path=path, digest=hashlib.sha256(of_site.encode()).hexdigest(),
                        first_time=first.timestamp(), last_time=last.timestamp() - STEP_S,
                        rows=0, hours=frozenset(),
                    )
                )  # fmt: skip
        return found


def _midnight(time: datetime) -> datetime:
    """Return the begin of the UTC date of a time."""
    return datetime.combine(time.astimezone(UTC).date(), datetime.min.time(), tzinfo=UTC)


def _hour(time: datetime) -> int:
    """Return the hour since 1970 of a time."""
    return int(time.timestamp()) // 3600


def _times_of(parts: MeasuredParts, level: Integers, share: Floats) -> Floats:
    """Return how often each part is in each quarter: (quarters, parts).

    `level` and `share` choose: the level of demand, and which of its parts (0 to 1).
    """
    count = np.bincount(parts.level)
    first = np.cumsum(count) - count
    part = first[level] + np.floor(share * count[level]).astype(np.int64)
    found = np.zeros((len(level), len(parts.level)))
    np.add.at(found, (np.arange(len(level))[:, None], part), 1.0)
    return found


def add_finding(dataset: Dataset, finding: Finding) -> None:
    """Add the finding of a check to a dataset's manifest."""
    manifest = dataset.manifest
    checks = manifest.checks | {finding.sensor: finding.record}
    replace(manifest, checks=checks).write(dataset.folder)
