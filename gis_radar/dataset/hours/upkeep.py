"""Withdraw recordings from a dataset, find moved ones, delete old exact tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date, datetime, time, timedelta
from pathlib import Path
from time import time as clock
from zoneinfo import ZoneInfo

from gis_radar.base import InputError, Reporter, Text, UsageError, output_errors, zone_of
from gis_radar.dataset.days.lane_measures import day_makers
from gis_radar.dataset.files.manifest import Manifest
from gis_radar.dataset.files.parts import days_of, digest_of, hour_text, part_path
from gis_radar.dataset.files.records import HourRecord, read_hours, write_record
from gis_radar.dataset.files.registry import (
    RecordingEntry,
    Registry,
    touched_hours,
)
from gis_radar.dataset.files.source import Source
from gis_radar.dataset.files.tables import FRAMES, HITS, OBSERVED, OCCUPIED, TABLES, TRACKS, VISIBLE
from gis_radar.dataset.hours.making import change, writing
from gis_radar.dataset.hours.registered import measure_settings_of, site_of

EXACT = (FRAMES, HITS, OBSERVED, VISIBLE, OCCUPIED, TRACKS)
"""Tables that are deleted after their time: they tell of single steps, and are nearly all room."""
OVER_S = 1.0
"""How far a recording of a day may reach out of it: loggers and clocks are no more exact."""


def _of_day(
    folder: Path, entries: Iterable[RecordingEntry], day: date, zone: ZoneInfo
) -> list[RecordingEntry]:
    """Return the recordings of a day; refuse one that reaches far into another."""
    begin, end = (
        datetime.combine(each, time.min, zone).timestamp() for each in (day, day + timedelta(1))
    )
    found = []
    for each in entries:
        first, last = each.first_time, each.last_time
        is_in = begin <= first and last < end
        if not is_in and min(last, end) - max(first, begin) <= OVER_S:
            continue  # of the day before or after
        if first < begin - OVER_S or last >= end + OVER_S:
            raise InputError(
                "{}: reaches from {} to {}, out of {}",
                each.path, *(datetime.fromtimestamp(at, zone).isoformat(" ", "seconds")
                             for at in (first, last)), day,
                hint="withdraw it by its name, and measure what lies outside the day from a "
                "recording that was cut there",
            )  # fmt: skip
        found.append(each)
    if not found:
        raise InputError(
            "{}: has no such recording of {}", folder, day,
            hint="gis-radar dataset shows from when to when it was measured",
        )  # fmt: skip
    return found


def _of_sensor(registry: Registry, sensor: str | None) -> list[RecordingEntry]:
    """Return the recordings of a sensor, or all."""
    found = [each for each in registry.entries if sensor in (None, each.sensor)]
    if sensor is not None and not found:
        known = ", ".join(sorted({each.sensor for each in registry.entries}))
        raise InputError(
            "{}: has no recording of {}", registry.folder, sensor,
            hint=Text("its sensors are {}", known),
        )  # fmt: skip
    return found


def withdraw(
    dataset: Source, recordings: Sequence[str | Path], sensor: str | None, day: date | str | None,
    processes: int, reporter: Reporter,
) -> list[str]:  # fmt: skip
    """Withdraw recordings from a dataset; see :meth:`gis_radar.Dataset.withdraw`."""
    if bool(recordings) == (sensor is not None or day is not None):
        raise UsageError("name either recordings to withdraw, or a sensor, a day or both")
    try:
        day = date.fromisoformat(day) if isinstance(day, str) else day
    except ValueError:
        raise UsageError("{} is no day", repr(day), hint="such as 2026-10-05") from None
    folder = dataset.folder
    with writing(folder, reporter):
        manifest = Manifest.read(folder)  # others may have written since it was opened
        settings = measure_settings_of(manifest, folder)
        before = Registry.read(folder, dataset.manifest.fingerprint)
        gone = [_named(before, each) for each in recordings] or _of_sensor(before, sensor)
        if day is not None:
            gone = _of_day(folder, gone, day, zone_of(manifest.timezone))
        kept = tuple(each for each in before.entries if each not in gone)
        hours = touched_hours(before.hours, gone, settings.margin)
        _refuse_dropped(folder, hours)
        poses = before.poses.of(each.pose for each in kept)
        after = replace(before, entries=kept, poses=poses).without_hours(hours)
        change(site_of(folder, manifest), before, after, processes=processes, reporter=reporter)
        sensors = {each.sensor for each in kept}
        checks = {name: of for name, of in manifest.checks.items() if name in sensors}
        if checks != manifest.checks:
            replace(manifest, checks=checks).write(folder)
    return [each.path for each in gone]


def _refuse_dropped(folder: Path, hours: Sequence[int]) -> None:
    """Refuse to make hours again whose exact tables were deleted."""
    for record in read_hours(folder, min(hours), max(hours)).values():
        if record.hour in hours and record.dropped:
            raise InputError(
                "{}: {} stays as it was counted: its exact tables were deleted after the time "
                "to keep them",
                folder,
                hour_text(record.hour),
                hint="withdraw only recordings of later hours",
            )


def relink(folder: Path, search: str | Path, fingerprint: str, reporter: Reporter) -> int:
    """Find recordings that were moved; see :meth:`gis_radar.Dataset.relink`."""
    if not Path(search).is_dir():
        raise InputError("{}: is no folder", search, hint="name one to look for recordings in")
    with writing(folder, reporter):
        registry = Registry.read(folder, fingerprint)
        lost = {each.digest: each for each in registry.entries if not _is_there(each)}
        found: dict[str, Path] = {}
        endings = {Path(each.path).suffix.lower() for each in lost.values()}
        paths = sorted(
            path for path in Path(search).rglob("*")
            if path.suffix.lower() in endings and path.is_file()
        )  # fmt: skip
        for done, path in enumerate(paths):
            digest = digest_of(path)
            if digest in lost:
                found.setdefault(digest, path.resolve())
            reporter.progress("looking for recordings", done + 1, len(paths))
        entries = tuple(
            replace(each, path=found[each.digest].as_posix()) if each.digest in found else each
            for each in registry.entries
        )
        replace(registry, entries=entries).write_recordings()
    for digest, entry in lost.items():
        if digest not in found:
            reporter.warn("{}: is not in {}", entry.path, search)
    return len(found)


def _is_there(entry: RecordingEntry) -> bool:
    path = Path(entry.path)
    return path.is_file() and digest_of(path) == entry.digest


def _named(registry: Registry, recording: str | Path) -> RecordingEntry:
    """Return the one recording with a path or file name."""
    path = Path(recording)
    same = [each for each in registry.entries if Path(each.path) == path.resolve()]
    same = same or [each for each in registry.entries if Path(each.path).name == str(recording)]
    if len(same) == 1:
        return same[0]
    names = ", ".join(each.path for each in same or registry.entries)
    what = "has no recording" if not same else "has several recordings"
    raise InputError(
        "{}: {} {}", registry.folder, what, recording, hint=Text("name one of {}", names)
    )


def keep(folder: Path, days: float, fingerprint: str, *, reporter: Reporter) -> list[str]:
    """Delete the exact tables of old hours; see :meth:`gis_radar.Dataset.keep`."""
    if not 0.0 <= days < math.inf:
        raise UsageError("{} days are no time to keep exact tables", days)
    with writing(folder, reporter):
        settings = measure_settings_of(Manifest.read(folder), folder)
        unmade = set(Registry.read(folder, fingerprint).missing_hours(settings.margin))
        records = read_hours(folder)
        over = (clock() - 86_400 * days) // 3600
        # vehicles go on from an hour in the next one, which may be made again
        old = [h for h in records if h + 1 < over and unmade.isdisjoint((h, h + 1))]
        dropped = {hour: _without_exact(records[hour]) for hour in old}
        fresh = [hour for hour in old if dropped[hour] != records[hour]]
        for maker in day_makers(folder, fingerprint):
            for day in days_of(fresh):
                maker.update(day, records)
            maker.check(fresh)
        for done, (hour, record) in enumerate(dropped.items()):
            if hour in fresh:
                write_record(folder, record)  # whoever reads then knows that the parts go
            for name in record.dropped:  # those of a killed run, too
                path = part_path(folder, TABLES[name], hour)
                with output_errors(path):
                    path.unlink(missing_ok=True)
                with suppress(OSError):  # other hours of the date
                    path.parent.rmdir()
            reporter.progress("deleting exact tables", done + 1, len(dropped))
    return [hour_text(hour) for hour in fresh]


def _without_exact(record: HourRecord) -> HourRecord:
    names = {table.name for table in EXACT} & record.parts.keys()
    gone = [name for name in TABLES if name in names.union(record.dropped)]
    return replace(record, dropped=tuple(gone))
