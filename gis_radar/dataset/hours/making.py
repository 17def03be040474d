"""Change the recordings of a dataset, and make the hours that the change touches.

The registry is written first, without the hours that a change touches: whenever a run is killed,
the next one sees which hours to make. An hour's record is removed before any of its parts changes.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from operator import attrgetter
from pathlib import Path

from gis_radar.base import (
    GisRadarError,
    InputError,
    Reporter,
    Text,
    output_errors,
    watch_parent,
    worker_pool,
)
from gis_radar.dataset.days.lane_measures import day_makers
from gis_radar.dataset.days.rollups import RollUps
from gis_radar.dataset.files.manifest import Manifest, locked_for_writing
from gis_radar.dataset.files.parts import days_of, digest_of, hour_text, part_path
from gis_radar.dataset.files.records import HourRecord, read_hour, read_hours, remove_record
from gis_radar.dataset.files.registry import (
    Placing,
    RecordingEntry,
    Registry,
    source_of,
    touched_hours,
    validity_by_sensor,
)
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.tables import DAY_TABLES, HOUR_TABLES
from gis_radar.dataset.hours.job import HourSite, MadeHour, read_sensors
from gis_radar.dataset.hours.registered import (
    hours_to_make,
    is_complete,
    kept_site,
    make_registered,
    measure_settings_of,
)
from gis_radar.measures import HourWindow

_STAGE = "measuring"
_REGISTRY_EVERY_S = 2.0  # between writes of the registry, which is large for a year's recordings
RELINK = Text(
    "gis-radar dataset DATASET --relink FOLDER finds what was moved, --withdraw takes it out"
)


def update_dataset(
    site: HourSite,
    before: Registry,
    after: Registry,
    *,
    just_read: Iterable[RecordingEntry] = (),
    before_hour: int | None = None,
    processes: int = 1,
    reporter: Reporter,
) -> list[MadeHour]:
    """Bring a dataset from one state of its registry to another.

    Parameters
    ----------
    site : HourSite
        Inputs that all hours have in common.
    before, after : Registry
        Registry before and after; `after` omits the hours to make again.
    just_read : iterable of RecordingEntry
        Recordings whose files were read just now, and need not be checked again.
    before_hour : int, optional
        Only hours before this one (since 1970) are made: for later ones recordings are expected.
    processes : int
        Number of hours, or of blocks of an hour, made in parallel.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    list of MadeHour
        The hours made, ascending.

    Raises
    ------
    InputError
        If a needed recording is missing, changed or refused; then the dataset stays as it is.
    """
    margin = site.settings.margin
    records, just_read = read_hours(site.folder), list(just_read)
    validity_by_sensor(after.entries)  # refuses different ones of a sensor
    just_read_paths = {each.path for each in just_read}
    added = _added(before, after, just_read_paths)
    for each in added:
        _refuse_dropped(each.path, each.reached_hours(margin), records)
    missing = hours_to_make(after, records, margin, touched_hours(after.hours, just_read, margin))
    missing = [hour for hour in missing if before_hour is None or hour < before_hour]
    _refuse_dropped(site.folder, missing, records)
    _require_recordings(after, missing, margin, just_read_paths)
    present = (records[hour] for hour in missing if hour in records)
    if any(is_complete(site.folder, each) for each in present):  # whole hours stay on a refusal
        reaching = after.by_hour(margin)
        for hour in touched_hours(missing, added, margin):
            _check_recordings(site, hour, [after.placing(each) for each in reaching[hour]])
    after = after.without_hours(missing)
    all_poses = before.poses.joined(after.poses)
    if added:
        _forget_sights(before.without_hours(missing), after)
        after.write_poses(all_poses)
    if after.entries != before.entries:
        after.write_recordings()
    # counts of hours whose exact tables were deleted stay
    removed = {hour for hour in records.keys() - set(after.hours) if not records[hour].dropped}
    for hour in {*missing, *removed}:
        remove_record(site.folder, hour)
    _remove_parts(site.folder, removed | _left_hours(site.folder, {*records, *missing}))
    made = _make_and_record(site, before, after, missing, processes, reporter)
    if missing:
        after = after.with_hours(missing, margin)
        after.write_recordings()
    poses = after.poses.of(each.pose for each in after.entries)
    if poses.tracks.keys() != all_poses.tracks.keys():
        after.write_poses(poses)
    if made or removed:
        changed = {*missing, *removed}
        kept_records = {hour: each for hour, each in records.items() if hour not in changed}
        new_records = {each.hour: read_hour(site.folder, each.hour) for each in made}
        records_after = kept_records | {
            hour: each for hour, each in new_records.items() if each is not None
        }
        _update_tables(
            site.folder, changed | {*list(kept_records)[-1:]}, dict(sorted(records_after.items()))
        )
    else:  # an earlier run may have been killed here
        _update_tables(site.folder, {*records, *_counted_dates(site.folder)}, records)
    return sorted(made, key=lambda each: each.hour)


def _forget_sights(before: Registry, after: Registry) -> None:
    """Leave open what poses see whose sights change, so that a run may be killed on the way."""
    sights = {each.pose: each.sights for each in after.entries}
    entries = tuple(
        each if sights.get(each.pose, each.sights) == each.sights else replace(each, sights=None)
        for each in before.entries
    )
    if entries != before.entries:
        replace(before, entries=entries).write_recordings()


def _added(before: Registry, after: Registry, just_read: set[str]) -> list[RecordingEntry]:
    """Return the recordings that are new, placed otherwise, or read just now with other sights."""
    placed = attrgetter("key", "pose")
    sights = {placed(each): each.sights for each in before.entries}
    return [
        each for each in after.entries
        if placed(each) not in sights
        or (each.path in just_read and sights[placed(each)] != each.sights)
    ]  # fmt: skip


def _make_and_record(
    site: HourSite, before: Registry, after: Registry, hours: Sequence[int], processes: int,
    reporter: Reporter,
) -> list[MadeHour]:  # fmt: skip
    """Make hours, and record from time to time which are made, so that a killed run can resume."""
    made, written_s = list[MadeHour](), time.monotonic()

    def write_registry() -> None:
        after.with_hours([each.hour for each in made], site.settings.margin).write_recordings()

    reporter.progress(_STAGE, 0, len(hours))
    try:
        for each in _make_hours(site, hours, processes):
            made.append(each)
            reporter.progress(_STAGE, len(made), len(hours))
            if time.monotonic() - written_s > _REGISTRY_EVERY_S:
                write_registry()
                written_s = time.monotonic()
    except InputError:
        _roll_back(site.folder, before, [each.hour for each in made])
        raise
    except BaseException:
        with suppress(GisRadarError):
            write_registry()
        raise
    return made


def _refuse_dropped(
    what: Path | str, hours: Iterable[int], records: Mapping[int, HourRecord]
) -> None:
    """Refuse to add to hours whose exact tables were deleted."""
    for hour in hours:
        if hour in records and records[hour].dropped:
            raise InputError(
                "{}: {} takes no recordings any more: its {} were deleted after the time "
                "to keep them",
                what,
                hour_text(hour),
                records[hour].dropped[0],
                hint="leave such recordings away, or measure that time into another dataset",
            )


def _require_recordings(
    registry: Registry, hours: Iterable[int], margin: int, looked_at: set[str]
) -> None:
    """Refuse to make hours whose recordings are missing or changed."""
    for each in registry.entries:
        touched = touched_hours(hours, [each], margin)
        if not touched or each.path in looked_at:
            continue
        path = Path(each.path)
        if not path.is_file():
            what = Text("is not there")
        elif digest_of(path) != each.digest:
            what = Text("has changed since it was measured")
        else:
            continue
        raise InputError("{}: {}, and {} needs it", path, what, hour_text(touched[0]), hint=RELINK)


def _check_recordings(site: HourSite, hour: int, placings: Sequence[Placing]) -> None:
    """Read the recordings of a present hour, to find errors before any of its parts changes."""
    window = HourWindow(hour=hour, margin=site.settings.margin)
    read_sensors(site, window, [source_of(*each) for each in placings], count_hits=False)


def _remove_parts(folder: Path, hours: Iterable[int]) -> None:
    for hour in hours:
        for table in HOUR_TABLES:
            path = part_path(folder, table, hour)
            with output_errors(path):
                path.unlink(missing_ok=True)


def _roll_back(folder: Path, before: Registry, made: Sequence[int]) -> None:
    """Restore the registry before the change, without the hours that were made since."""
    for hour in made:
        remove_record(folder, hour)
    _remove_parts(folder, set(made) - set(before.hours))
    before = before.without_hours(made)
    before.write_recordings()
    before.write_poses(before.poses)


def update_days(folder: Path, reporter: Reporter) -> None:
    """Bring the tables of all dates of a dataset up to date.

    Raises
    ------
    OutputError
        If another run is writing it.
    """
    with locked_for_writing(folder, reporter):
        finish_tables(folder)


def finish_tables(folder: Path) -> None:
    """Bring the tables of all dates up to date, and remove those of hours that are gone."""
    records = read_hours(folder)
    _remove_parts(folder, _left_hours(folder, set(records)))
    _update_tables(folder, {*records, *_counted_dates(folder)}, records)


def _counted_dates(folder: Path) -> set[int]:
    """Return the first hours of the dates that have tables, also where all hours are gone."""
    return {_hour_of(path, "00") for path in _files_of(folder, DAY_TABLES, "*")}


def _left_hours(folder: Path, known: set[int]) -> set[int]:
    """Return the hours, other than the known ones, of which a killed run left parts."""
    paths = _files_of(folder, HOUR_TABLES, "[0-2][0-9]")
    return {_hour_of(path, path.stem) for path in paths} - known


def _files_of(folder: Path, tables: Iterable[TableSchema], stem: str) -> Iterator[Path]:
    for table in tables:
        yield from (folder / table.name).glob(f"date=????-??-??/{stem}.parquet")


def _hour_of(path: Path, hour: str) -> int:
    date = path.parent.name.removeprefix("date=")
    return int(datetime.fromisoformat(f"{date}T{hour}:00Z").timestamp()) // 3600


def _update_tables(folder: Path, hours: Iterable[int], records: Mapping[int, HourRecord]) -> None:
    """Update the tables of the dates and months of some hours, and of the hour after each."""
    manifest = Manifest.read(folder)
    touched = {later for hour in hours for later in (hour, hour + 1)}
    for maker in day_makers(folder, manifest.fingerprint):
        for day in days_of(touched):
            maker.update(day, records)
    rolled = RollUps(folder=folder, fingerprint=manifest.fingerprint, timezone=manifest.timezone)
    rolled.update(touched, records)


@dataclass(kw_only=True)
class OpenHours:
    """Hours of a dataset that are to be made, elsewhere and in any order.

    Parameters
    ----------
    registry : Registry
        The registry without these hours.
    margin : int
        Steps on either side of an hour from which its parts follow.
    missing : list of int
        The hours to make, ascending.
    refused : dict
        By hour, why it cannot be made.
    made : list of int
        Those that were made, as the caller adds them.
    """

    registry: Registry
    margin: int
    missing: list[int]
    refused: dict[int, InputError]
    made: list[int] = field(default_factory=list)

    def note(self) -> None:
        """Record the hours that were made."""
        self.registry.with_hours(self.made, self.margin).write_recordings()


@contextmanager
def open_hours(folder: Path, reporter: Reporter) -> Iterator[OpenHours]:
    """Lock a dataset for writing, and find the hours that are missing or of an earlier method.

    Raises
    ------
    InputError
        If the dataset is damaged.
    OutputError
        If another run is writing it.
    """
    with locked_for_writing(folder, reporter):
        manifest = Manifest.read(folder)
        margin = measure_settings_of(manifest, folder).margin
        registry, records = Registry.read(folder, manifest.fingerprint), read_hours(folder)
        missing = hours_to_make(registry, records, margin, registry.hours)
        there = {each.path for each in registry.entries if Path(each.path).is_file()}
        refused: dict[int, InputError] = {}
        for hour in missing:
            try:
                _refuse_dropped(folder, [hour], records)
                _require_recordings(registry, [hour], margin, there)
            except InputError as error:
                refused[hour] = error
        missing = [hour for hour in missing if hour not in refused]
        without = registry.without_hours(missing)
        if without.entries != registry.entries:
            without.write_recordings()
        yield OpenHours(registry=without, margin=margin, missing=missing, refused=refused)


def _make_hours(site: HourSite, hours: Sequence[int], processes: int) -> Iterator[MadeHour]:
    """Make hours, one after the other or in parallel, and yield them as they are done."""
    workers = min(processes, len(hours))
    with kept_site(site):
        if workers < 2:
            yield from (make_registered(site.folder, hour, processes) for hour in hours)
            return
        share = processes // workers
        with worker_pool(workers, watch_parent) as pool:
            running = [pool.submit(make_registered, site.folder, hour, share) for hour in hours]
            for each in as_completed(running):
                yield each.result()
