"""Work of fusion's worker process: recordings, hours of the dataset, provisional quarters."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import geopandas as gpd

from gis_radar.base import (
    GisRadarError,
    InputError,
    Reporter,
    WarningList,
    clear_leftovers,
    first_line,
    only_writer,
    output_errors,
    workers_here,
)
from gis_radar.calibration import UNKNOWN, LaneMap, RecordedSensor, check_plausibility
from gis_radar.dataset import (
    Dataset,
    Manifest,
    MeasureSettings,
    manifest_of,
    measure,
    open_dataset,
    read_hours,
    record_path,
    require_same_settings,
)
from gis_radar.hdmap import read_tiles
from gis_radar.live.hours.quarters import QUARTERS_KEPT, QuarterMeasures, read_quarters
from gis_radar.live.hours.recordings import (
    HOUR_OFFSET_US,
    HOUR_US,
    PARTS_FOLDER,
    RECORDINGS_FOLDER,
    JoinedRows,
    hour_of_time,
    join_parts,
    make_parts,
    name_of_hour,
    name_of_time,
    parts_of_hour,
    recording_path,
    remove_old,
    time_of_name,
    track_beside,
    waiting_hours,
)
from gis_radar.measures import Filters, validity_of
from gis_radar.poses import PoseTrack
from gis_radar.recordings import open_recording
from gis_radar.scans import SightScan, SightTiles
from gis_radar.tracking import map_of_tiles

DATASET, _PROVISIONAL, SIGHT = "dataset", "provisional", "sight"
QUARTER_US = HOUR_US // 4
LOOKAHEAD_US = 60_000_000  # frames after a provisional quarter that its vehicles are found by


@dataclass(frozen=True, kw_only=True)
class MeasuredSite:
    """Inputs of measuring a live site's dataset.

    Parameters
    ----------
    folder, map, tiles : Path
        Folder of the live system's files, and files of the lanes and tiles.
    sensors : sequence of str
        Names of the sensors.
    scans, scan_crs : sequence of Path, object
        Scans of what hides tiles, and their coordinate system.
    filters : Filters
        Filters of the detections that count as hits.
    cycles : dict
        Seconds from frame to frame, of sensors that state it.
    timezone : str
        Time zone of the site.
    vehicles : bool
        Whether vehicles are followed.
    keep_s, most_bytes : float
        Time for which recordings are kept, seconds, and their largest total size, bytes.
    of_lanes : mapping
        Names and free speeds of lanes, as :meth:`gis_radar.Dataset.state_lanes` takes them.
    processes : int, optional
        Number of processes that measure in parallel; by default all cores but fusion's.
    """

    folder: Path
    map: Path
    tiles: Path
    sensors: Sequence[str]
    scans: Sequence[Path]
    scan_crs: Any
    filters: Filters
    cycles: dict[str, float]
    timezone: str
    vehicles: bool
    keep_s: float
    most_bytes: float
    of_lanes: Mapping[str, Any]
    processes: int | None = None

    @property
    def workers(self) -> int:
        """Number of hours, or of blocks of one, measured in parallel."""
        return self.processes or max(workers_here() - 1, 1)

    @property
    def dataset(self) -> Path:
        """Folder of the dataset."""
        return self.folder / DATASET

    def measure(
        self, recordings: Sequence[tuple[Path, PoseTrack]], folder: Path, *, before_hour: int,
        reporter: Reporter,
    ) -> Dataset:  # fmt: skip
        """Measure recordings as `gis-radar measure` does."""
        return measure(
            [path for path, _ in recordings], [track for _, track in recordings],
            read_tiles(self.tiles), self.map, folder, scans=self.scans, scan_crs=self.scan_crs,
            sight_cache=self.folder / SIGHT if self.scans else None, filters=self.filters,
            cycles={name: self.cycles[name] for name in self.cycles
                    if any(track.sensor == name for _, track in recordings)},
            hits_only=not self.vehicles, timezone=self.timezone, before_hour=before_hour,
            check=False, processes=self.workers, reporter=reporter,
        )  # fmt: skip


@dataclass(kw_only=True)
class JobResult(WarningList):
    """Result of a job; a reporter of its work, which keeps the warnings.

    Parameters
    ----------
    not_measured : dict
        By hour, the reason why it could not be measured.
    quarters : list of QuarterMeasures
        The measured quarters.
    hours : list of int
        Hours that have to be made (again).
    doubts : dict
        By sensor, the doubt of the check of poses and recordings, None where all fits.
    unchecked : dict
        By sensor, the hour in which there was too little traffic for a verdict.
    """

    not_measured: dict[int, str] = field(default_factory=dict)
    quarters: list[QuarterMeasures] = field(default_factory=list)
    hours: list[int] = field(default_factory=list)
    doubts: dict[str, str | None] = field(default_factory=dict)
    unchecked: dict[str, int] = field(default_factory=dict)


def resume_hours(site: MeasuredSite, spooled: Sequence[Path]) -> JobResult:
    """Return the hours that an earlier run left to be made, and the quarters of the last day."""
    done = make_recordings(site, spooled)
    clear_leftovers(site.folder / PARTS_FOLDER)
    done.hours = sorted(waiting_hours(site.folder))
    for path in sorted((site.folder / RECORDINGS_FOLDER).glob("*/*.parquet")):
        hour = hour_of_time(time_of_name(path.stem))
        if hour not in done.hours and _is_newer(path, site.dataset, hour):
            done.hours.append(hour)
    for path in sorted((site.folder / _PROVISIONAL).glob("2*")):
        if Manifest.is_there(path / DATASET):
            quarter = time_of_name(path.name) // QUARTER_US
            done.quarters += _quarters_in(site, path / DATASET, [quarter])
    _read_last_day(site, done)
    return done


def _is_newer(path: Path, dataset: Path, hour: int) -> bool:
    """Return whether a recording changed since its hour was made."""
    record = record_path(dataset, hour)
    return not record.exists() or record.stat().st_mtime < path.stat().st_mtime


def make_recordings(site: MeasuredSite, spooled: Sequence[Path]) -> JobResult:
    """Make parts of recordings from files of the spool."""
    done = JobResult()
    for path in spooled:
        make_parts(site.folder, path, done)
    return done


def make_hours(
    site: MeasuredSite, spooled: Sequence[Path], hours: Sequence[int], *,
    check: Callable[..., Sequence[Any]] = check_plausibility,
) -> JobResult:  # fmt: skip
    """Make the recordings of hours that are over, and measure them.

    Parameters
    ----------
    site : MeasuredSite
        The site.
    spooled : sequence of Path
        Files of the spool that are closed.
    hours : sequence of int
        Hours since 1970 whose recordings are made.
    check : callable
        Compares poses and recordings with the map.
    """
    done = make_recordings(site, spooled)
    before_hour = hour_of_time(int(time.time() * 1e6))
    _measure_hours(site, hours, before_hour, done)
    if Manifest.is_there(site.dataset) and not Manifest.read(site.dataset).live:
        with only_writer(site.dataset.absolute(), reporter=done):
            replace(Manifest.read(site.dataset), live=True).write(site.dataset)
    if hours:
        _check_poses(site, max(hours), check, done)
    _read_last_day(site, done)
    _remove_provisional(site, before_hour)
    measured = _measured_paths(site)
    remove_old(
        site.folder, keep_s=site.keep_s, most_bytes=site.most_bytes, reporter=done,
        is_needed=lambda path: path.resolve().as_posix() not in measured,
    )  # fmt: skip
    return done


def _remove_provisional(site: MeasuredSite, before_hour: int) -> None:
    """Remove the quarters of hours that are measured, and those of over a day ago."""
    made = read_hours(site.dataset)
    for path in (site.folder / _PROVISIONAL).glob("2*"):
        hour = time_of_name(path.name) // HOUR_US
        if hour in made or hour < before_hour - QUARTERS_KEPT // 4:
            shutil.rmtree(path, ignore_errors=True)


def _measure_hours(
    site: MeasuredSite, hours: Sequence[int], before_hour: int, done: JobResult
) -> None:
    """Measure hours in parallel; record the reason for each that cannot be measured."""
    by_hour: dict[int, list[tuple[Path, PoseTrack]]] = {}
    for hour in hours:
        paths = (_recording_of(site, sensor, hour, done) for sensor in _sensors_of(site, hour))
        try:
            by_hour[hour] = [(path, track_beside(path)) for path in paths if path is not None]
        except InputError as error:
            done.not_measured[hour] = error.message
    groups = [each for each in by_hour.items() if each[1]]
    if len(groups) > 1 and site.workers > 1:
        every = [each for _, recordings in groups for each in recordings]
        with suppress(InputError):  # if one hour is bad, each is measured alone to find it
            site.measure(every, site.dataset, before_hour=before_hour, reporter=done)
            return
    for hour, recordings in groups:
        try:  # after an error the recordings stay, and the other hours are made
            site.measure(recordings, site.dataset, before_hour=before_hour, reporter=done)
        except InputError as error:
            done.not_measured[hour] = error.message


def _check_poses(
    site: MeasuredSite, hour: int, check: Callable[..., Sequence[Any]], done: JobResult
) -> None:
    """Check whether poses, recordings and map fit each other in the last measured hour.

    No table depends on the check. An earlier hour that is made again shows nothing about now.
    """
    paths = {name: recording_path(site.folder, name, hour) for name in site.sensors}
    try:
        if read_hours(site.dataset, hour + 1):
            return
        tiles = read_tiles(site.tiles)
        roads, _ = map_of_tiles(site.map, tiles)
        lanes = LaneMap.of_tiles(roads.lanelets, SightTiles.of(tiles))
        sensors = {
            name: RecordedSensor(recordings=[open_recording(path)], tracks=[track_beside(path)])
            for name, path in paths.items()
            if path.exists()
        }
        for each in check(sensors, lanes):
            if each.verdict == UNKNOWN:
                done.unchecked[each.sensor] = hour
            else:
                done.doubts[each.sensor] = each.text_with_advice if each.doubt else None
    except InputError:
        return  # damage is reported where the hour is measured
    except (GisRadarError, ArithmeticError, ValueError) as error:  # the hour's results stand
        done.warn("poses and recordings could not be checked: {}", first_line(error))


def _sensors_of(site: MeasuredSite, hour: int) -> list[str]:
    """Return the site's sensors, and former ones with frames of the hour that are not measured."""
    made = (site.folder / RECORDINGS_FOLDER).glob(f"*/{name_of_hour(hour)}.parquet")
    waiting = [
        *(site.folder / PARTS_FOLDER).glob(f"*/{name_of_hour(hour)}.*.parquet"),
        *(path for path in made if _is_newer(path, site.dataset, hour)),
    ]
    return sorted({*site.sensors, *(path.parent.name for path in waiting)})


def _measured_paths(site: MeasuredSite) -> set[str]:
    """Return the paths of the recordings that are in the dataset."""
    is_there = Manifest.is_there(site.dataset)
    return set(open_dataset(site.dataset).recordings()["path"]) if is_there else set()


def _recording_of(site: MeasuredSite, sensor: str, hour: int, done: JobResult) -> Path | None:
    """Make the recording of an hour from all its frames, and return it; None without frames."""
    path = recording_path(site.folder, sensor, hour)
    if not path.exists() and path.resolve().as_posix() in _measured_paths(site):
        parts = parts_of_hour(site.folder, sensor, hour)
        if parts:
            done.warn(
                "{}: frames of {} came after its recording was removed: left out",
                sensor,
                path.stem,
            )
        for each in parts:
            each.unlink()
        return None
    return join_parts(site.folder, sensor, hour, done)


def make_quarter(site: MeasuredSite, spooled: Sequence[Path], quarter: int) -> JobResult:
    """Measure a provisional quarter from the frames received so far; its hour replaces it later.

    Parameters and result are as of :func:`make_hours`.
    """
    done = make_recordings(site, spooled)
    begin_us = quarter * QUARTER_US
    path = site.folder / _PROVISIONAL / name_of_time(begin_us)
    span = (begin_us - HOUR_OFFSET_US, begin_us + QUARTER_US + LOOKAHEAD_US)
    with output_errors(path):
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
    recordings = []
    for sensor in site.sensors:
        sources = []
        for hour in range(hour_of_time(span[0]), hour_of_time(span[1]) + 1):
            recording = recording_path(site.folder, sensor, hour)
            sources += [recording] if recording.exists() else []
            sources += parts_of_hour(site.folder, sensor, hour)
        rows = JoinedRows(sources, *span) if sources else None
        if rows is not None and len(rows.table):
            place = path / RECORDINGS_FOLDER / sensor / f"{path.name}.parquet"
            recordings.append((place, rows.write(place)))
    if not recordings:
        shutil.rmtree(path, ignore_errors=True)
    else:
        dataset = path / DATASET
        site.measure(recordings, dataset, before_hour=1 << 40, reporter=done)
        done.quarters = _quarters_in(site, dataset, [quarter])
    return done


def _read_last_day(site: MeasuredSite, done: JobResult) -> None:
    """Name the lanes of the dataset, and read the quarters of the last day from it."""
    if Manifest.is_there(site.dataset):
        open_dataset(site.dataset).state_lanes(**site.of_lanes, reporter=done)
        last = int(time.time() * 1e6) // QUARTER_US
        done.quarters += _quarters_in(site, site.dataset, range(last - QUARTERS_KEPT, last + 1))


def _quarters_in(
    site: MeasuredSite, folder: Path, quarters: Sequence[int]
) -> list[QuarterMeasures]:
    return read_quarters(open_dataset(folder), read_tiles(site.tiles), quarters)


def refuse_other_settings(
    site: MeasuredSite, tiles: gpd.GeoDataFrame, scan: SightScan | None
) -> None:
    """Refuse a dataset to which no hour of the site could be added.

    Raises
    ------
    InputError
        If it was measured with other tiles, another map or other settings.
    """
    if not Manifest.is_there(site.dataset):
        return
    stored = Manifest.read(site.dataset)
    settings = MeasureSettings(filters=site.filters)
    if not site.vehicles or not stored.settings.get("vehicles"):
        settings = replace(settings, vehicles=False)
    _, described = map_of_tiles(site.map, tiles)
    of_site = manifest_of(tiles, described["digest"], scan, settings, site.timezone)
    require_same_settings(site.dataset, stored, of_site)
    valid_s = validity_of(site.cycles, site.sensors)
    known = open_dataset(site.dataset).recordings()
    for sensor, before_s in zip(known["sensor"], known["validity_s"], strict=True):
        if valid_s.get(sensor, before_s) != before_s:
            raise InputError(
                "{}: was measured with another {} of {}",
                site.dataset,
                "cycle",
                sensor,
                hint="state the same cycle, or name another folder in [live]",
            )
