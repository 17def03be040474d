"""Changes, methods of a dataset: recordings withdrawn or found again, exact tables deleted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date, datetime, time, timedelta
from pathlib import Path
from time import time as clock
from zoneinfo import ZoneInfo

from gis_radar.base import QUIET, InputError, Reporter, Text, UsageError, output_errors, zone_of
from gis_radar.dataset.days.lane_measures import day_makers
from gis_radar.dataset.files.manifest import Manifest, locked_for_writing
from gis_radar.dataset.files.parts import days_of, digest_of, hour_text, part_path
from gis_radar.dataset.files.records import HourRecord, read_hours, record_path, write_record
from gis_radar.dataset.files.registry import RecordingEntry, Registry, touched_hours
from gis_radar.dataset.files.source import DatasetFiles
from gis_radar.dataset.files.tables import FRAMES, HITS, OBSERVED, OCCUPIED, TABLES, TRACKS, VISIBLE

EXACT = (FRAMES, HITS, OBSERVED, VISIBLE, OCCUPIED, TRACKS)
"""Tables that :func:`keep` deletes: they hold single steps, and take nearly all of the space."""
_DAY_TOLERANCE_S = 1.0
"""Seconds that a recording may reach beyond its day: clocks of loggers are no more exact."""


def _recordings_of_day(
    folder: Path, entries: Iterable[RecordingEntry], day: date, zone: ZoneInfo
) -> list[RecordingEntry]:
    """Return the recordings of a day; refuse one that reaches far into another."""
    begin, end = (
        datetime.combine(each, time.min, zone).timestamp() for each in (day, day + timedelta(1))
    )
    of_day = []
    for entry in entries:
        first, last = entry.first_time, entry.last_time
        is_in = begin <= first and last < end
        if not is_in and min(last, end) - max(first, begin) <= _DAY_TOLERANCE_S:
            continue  # of the day before or after
        if first < begin - _DAY_TOLERANCE_S or last >= end + _DAY_TOLERANCE_S:
            raise InputError(
                "{}: reaches from {} to {}, out of {}",
                entry.path, *(datetime.fromtimestamp(at, zone).isoformat(" ", "seconds")
                             for at in (first, last)), day,
                hint="withdraw it by its name, and measure what lies outside the day from a "
                "recording that was cut there",
            )  # fmt: skip
        of_day.append(entry)
    if not of_day:
        raise InputError(
            "{}: has no such recording of {}", folder, day,
            hint="gis-radar dataset shows from when to when it was measured",
        )  # fmt: skip
    return of_day


def _recordings_of_sensor(registry: Registry, sensor: str | None) -> list[RecordingEntry]:
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
    dataset: DatasetFiles, recordings: Sequence[str | Path] = (), *, sensor: str | None = None,
    day: date | str | None = None, processes: int = 1, reporter: Reporter = QUIET,
) -> list[str]:  # fmt: skip
    """Withdraw recordings; the hours that they reach into are made again.

    Parameters
    ----------
    recordings : sequence of paths
        Paths, or file names where these are unique. The files may be gone; those of all other
        recordings of the same hours must be there.
    sensor : str, optional
        In place of `recordings`: all those of a sensor.
    day : date or str, optional
        In place of `recordings`: all those of a day by the clocks of the site, such as
        2026-10-05; with `sensor`, only that sensor's. They must lie in the day, to a second.
    processes : int
        Number of hours, or of blocks of an hour, made in parallel.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    list of str
        Paths of the recordings that were withdrawn.

    Raises
    ------
    UsageError
        If nothing is named, or recordings and a sensor or day.
    InputError
        If there is no such recording, one reaches out of the day, another needed one is missing
        or changed, or exact tables of their hours were deleted.
    """
    from gis_radar.dataset.hours.making import (  # noqa: PLC0415 - the tracker, 0.6 s
        finish_tables,
        update_dataset,
    )
    from gis_radar.dataset.hours.registered import measure_settings_of, site_of  # noqa: PLC0415

    if bool(recordings) == (sensor is not None or day is not None):
        raise UsageError("name either recordings to withdraw, or a sensor, a day or both")
    try:
        day = date.fromisoformat(day) if isinstance(day, str) else day
    except ValueError:
        raise UsageError("{} is no day", repr(day), hint="such as 2026-10-05") from None
    folder = dataset.folder
    with locked_for_writing(folder, reporter):
        manifest = Manifest.read(folder)  # others may have written since it was opened
        settings = measure_settings_of(manifest, folder)
        before = Registry.read(folder, dataset.manifest.fingerprint)
        try:
            withdrawn = [
                _recording_named(before, each) for each in recordings
            ] or _recordings_of_sensor(before, sensor)
            if day is not None:
                withdrawn = _recordings_of_day(folder, withdrawn, day, zone_of(manifest.timezone))
        except InputError:  # a killed run may have withdrawn it, and left some of its tables
            left = {hour for hour, each in read_hours(folder).items() if not each.dropped}
            if before.missing_hours(settings.margin) or left - set(before.hours):
                site = site_of(folder, manifest)
                update_dataset(site, before, before, processes=processes, reporter=reporter)
            else:
                finish_tables(folder)
            raise
        kept = tuple(each for each in before.entries if each not in withdrawn)
        hours = touched_hours(before.hours, withdrawn, settings.margin)
        _refuse_dropped(folder, hours)
        poses = before.poses.of(each.pose for each in kept)
        after = replace(before, entries=kept, poses=poses).without_hours(hours)
        update_dataset(
            site_of(folder, manifest), before, after, processes=processes, reporter=reporter
        )
        sensors = {each.sensor for each in kept}
        checks = {name: of for name, of in manifest.checks.items() if name in sensors}
        if checks != manifest.checks:
            replace(manifest, checks=checks).write(folder)
    return [each.path for each in withdrawn]


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


def relink(dataset: DatasetFiles, search: str | Path, *, reporter: Reporter = QUIET) -> int:
    """Find recordings whose files were moved, by their contents, and return how many.

    Parameters
    ----------
    search : str or Path
        A folder; in it and in the folders below, all files with the suffix of a missing
        recording are compared.
    reporter : Reporter
        Receives progress, and a warning for each recording that is not found.

    Raises
    ------
    InputError
        If there is no such folder.
    """
    if not Path(search).is_dir():
        raise InputError("{}: is no folder", search, hint="name one to look for recordings in")
    with locked_for_writing(dataset.folder, reporter):
        registry = Registry.read(dataset.folder, dataset.manifest.fingerprint)
        lost = {each.digest: each for each in registry.entries if not _is_there(each)}
        new_paths: dict[str, Path] = {}
        endings = {Path(each.path).suffix.lower() for each in lost.values()}
        paths = sorted(
            path for path in Path(search).rglob("*")
            if path.suffix.lower() in endings and path.is_file()
        )  # fmt: skip
        for done, path in enumerate(paths):
            digest = digest_of(path)
            if digest in lost:
                new_paths.setdefault(digest, path.resolve())
            reporter.progress("looking for recordings", done + 1, len(paths))
        entries = tuple(
            replace(each, path=new_paths[each.digest].as_posix())
            if each.digest in new_paths
            else each
            for each in registry.entries
        )
        replace(registry, entries=entries).write_recordings()
    for digest, entry in lost.items():
        if digest not in new_paths:
            reporter.warn("{}: is not in {}", entry.path, search)
    return len(new_paths)


def _is_there(entry: RecordingEntry) -> bool:
    path = Path(entry.path)
    return path.is_file() and digest_of(path) == entry.digest


def _recording_named(registry: Registry, recording: str | Path) -> RecordingEntry:
    """Return the one recording with a path or file name."""
    path = Path(recording)
    matching = [each for each in registry.entries if Path(each.path) == path.resolve()]
    matching = matching or [
        each for each in registry.entries if Path(each.path).name == str(recording)
    ]
    if len(matching) == 1:
        return matching[0]
    names = ", ".join(each.path for each in matching or registry.entries)
    what = "has no recording" if not matching else "has several recordings"
    raise InputError(
        "{}: {} {}", registry.folder, what, recording, hint=Text("name one of {}", names)
    )


def keep(
    dataset: DatasetFiles, days: float, *, since_made: bool = False, reporter: Reporter = QUIET
) -> list[str]:
    """Delete the exact tables of old hours, so that room stays for new ones.

    Tile counts, lane measures, turns, vehicles and passages stay; they are brought up to date
    before. The hours take no recordings any more.

    Parameters
    ----------
    days : float
        Hours that ended longer ago lose `frames`, `hits`, `observed`, `visible`, `occupied` and
        `tracks`; the last of them keeps its own, from which vehicles go on in the next hour.
    since_made : bool
        Delete only what was also made so long ago: an archive keeps its tables as long as others.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    list of str
        Begins of the hours, ISO 8601.

    Raises
    ------
    UsageError
        If `days` is negative or no number.
    InputError
        If counts of these hours cannot be made or read; then nothing is deleted.
    """
    from gis_radar.dataset.hours.registered import measure_settings_of  # noqa: PLC0415 - 0.6 s

    if not 0.0 <= days < math.inf:
        raise UsageError("{} days are no time to keep exact tables", days)
    folder, fingerprint = dataset.folder, dataset.manifest.fingerprint
    with locked_for_writing(folder, reporter):
        settings = measure_settings_of(Manifest.read(folder), folder)
        unmade = set(Registry.read(folder, fingerprint).missing_hours(settings.margin))
        records = read_hours(folder)
        limit_s = clock() - 86_400 * days
        over = limit_s // 3600
        young = {
            hour for hour, each in records.items()
            if since_made and not each.dropped
            and record_path(folder, hour).stat().st_mtime > limit_s
        }  # fmt: skip
        # the next hour, which may be made again, continues the tracks of this one
        old = [h for h in records if h + 1 < over and (unmade | young).isdisjoint((h, h + 1))]
        dropped = {hour: _without_exact(records[hour]) for hour in old}
        fresh = [hour for hour in old if dropped[hour] != records[hour]]
        for maker in day_makers(folder, fingerprint):
            for day in days_of(fresh):
                maker.update(day, records)
            maker.check(fresh)
        for done, (hour, record) in enumerate(dropped.items()):
            if hour in fresh:
                write_record(folder, record)  # first, so that nobody opens a part that is deleted
            for name in record.dropped:  # those of a killed run, too
                path = part_path(folder, TABLES[name], hour)
                with output_errors(path):
                    path.unlink(missing_ok=True)
                with suppress(OSError):  # it holds other hours of the date
                    path.parent.rmdir()
            reporter.progress("deleting exact tables", done + 1, len(dropped))
    return [hour_text(hour) for hour in fresh]


def _without_exact(record: HourRecord) -> HourRecord:
    names = {table.name for table in EXACT} & record.parts.keys()
    gone = [name for name in TABLES if name in names.union(record.dropped)]
    return replace(record, dropped=tuple(gone))
