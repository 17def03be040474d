"""Tasks of a city's run as functions from files to files, which any worker can carry out.

Their arguments are paths and numbers. A worker reads and writes the files of the city itself, which
lie where all workers see them: only names and figures pass between the run and its workers.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from gis_radar import products
from gis_radar.base import (
    GisRadarError,
    InputError,
    WarningList,
    atomic_write,
    json_text,
    only_writer,
    read_json,
    write_json,
)
from gis_radar.city.city import RESULTS
from gis_radar.city.settings import CityFile
from gis_radar.dataset import Manifest, make_registered, open_dataset, site_folder, update_days
from gis_radar.site import (
    Sensor,
    Site,
    convert_stage,
    files_of,
    heatmap_stage,
    measure_stage,
    prepare_site,
    read_site,
    refusals_of,
    stages_of,
)

_POSES = "poses"  # folder of a city with the poses that were found
_BASIS = ".basis"  # beside such a pose: what it was found from
_NOT_NEEDED = {"guess": None, "view": None}  # not needed where a pose is known
_CONVERTED = "recordings"  # folder of a city with the recordings that were converted
_OPTIONS = "options.json"  # beside a converted recording: how it was converted
_REGISTERED = ".gis-radar/recordings.json"  # what was registered, below the results of a site

Failure = tuple[str, GisRadarError]
"""Name of what has no result (site, sensor or hour), and the error."""


@dataclass(kw_only=True)
class SiteTask(WarningList):
    """A site of a city for its tasks, whose failures and warnings it collects.

    Parameters
    ----------
    root : Path
        Folder of the city.
    name : str
        Name of the site.
    file : Path
        The site file.
    failures : list of Failure
        Names of what has no result, with the errors.
    """

    root: Path
    name: str
    file: Path
    failures: list[Failure] = field(default_factory=list)

    @property
    def dataset(self) -> Path:
        """Folder of its dataset."""
        return site_folder(self.root, self.name)

    @property
    def results(self) -> Path:
        """Folder of all else that is made of it."""
        return self.root / RESULTS / self.name


def add_recordings(task: SiteTask) -> SiteTask:
    """Prepare a site, and register its new recordings in its dataset; no hour is made yet.

    Poses are found once, from the first recordings, and kept in the city's folder `poses`:
    recordings that come later change none of them; a changed guess, heading or map does. Recordings
    that the dataset has keep the pose that they were measured with.

    Raises
    ------
    GisRadarError
        If there is no result for the whole site.
    """
    site = _with_known_poses(_converted(read_site(task.file), task), task)
    if not site.sensor:
        return task
    outcomes = prepare_site(site, task.results, reporter=task)
    errors = {
        each.stage.sensor: each.error for each in outcomes if each.stage.sensor and each.error
    }
    task.failures += [(name, error) for name, error in errors.items() if error is not None]
    for sensor in site.sensor:
        if sensor.pose is None and sensor.name not in errors:
            _store_pose(sensor, site, task)
    states = {path: _state_of(path) for each in site.sensor for path in each.recordings}
    before = registered_recordings(task)
    new = {
        each.name: [path for path in each.recordings if before.get(_name_of(path)) != states[path]]
        for each in site.sensor if each.name not in errors
    }  # fmt: skip
    sensors = [
        each.model_copy(update={"recordings": tuple(new[each.name])})
        for each in site.sensor if new.get(each.name)
    ]  # fmt: skip
    if sensors:
        register_checked(site.model_copy(update={"sensor": tuple(sensors)}), task)
        store_registered(task, before | {_name_of(path): state for path, state in states.items()})
    return task


def _converted(site: Site, task: SiteTask) -> Site:
    """Convert recordings of other formats one by one, those that are new or were changed."""
    sensors = []
    for sensor in site.sensor:
        paths = [each for each in sensor.recordings if each not in sensor.foreign]
        options = sensor.convert.model_dump() if sensor.convert else {}
        stated = json_text(options)
        for path in sensor.foreign:
            place = hashlib.sha256(os.fsencode(path.absolute())).hexdigest()[:12]
            converted = (
                task.root / _CONVERTED / task.name / sensor.name / place / f"{path.stem}.parquet"
            )
            if not _is_converted(path, converted, stated):
                converted.with_name(_OPTIONS).unlink(missing_ok=True)  # those of the earlier file
                try:
                    convert_stage(recordings=[path], outputs=[converted], reporter=task, **options)
                except GisRadarError as error:
                    task.failures.append((sensor.name, error))
                    continue
                converted.with_name(_OPTIONS).write_text(stated, encoding="utf-8")
            paths.append(converted)
        if paths:
            changed = {"recordings": tuple(paths), "convert": None}
            sensors.append(sensor.model_copy(update=changed))
    return site.model_copy(update={"sensor": tuple(sensors)})


def _is_converted(path: Path, converted: Path, stated: str) -> bool:
    """Return whether a recording was converted since it was written, by the stated options."""
    converted.parent.mkdir(parents=True, exist_ok=True)
    if not converted.exists() or converted.stat().st_mtime < path.stat().st_mtime:
        return False
    options_file = converted.with_name(_OPTIONS)
    return options_file.exists() and options_file.read_text(encoding="utf-8") == stated


def _pose_path(sensor: Sensor, task: SiteTask) -> Path:
    return task.root / _POSES / task.name / f"{sensor.name}.json"


def _with_known_poses(site: Site, task: SiteTask) -> Site:
    """Give sensors the poses that an earlier run found, from what is stated now.

    Where guess, heading or map were changed, the pose is found again, from the recordings that the
    dataset does not have: those that it has keep theirs.
    """
    sensors, registered = [], registered_recordings(task)
    for sensor in site.sensor:
        path = _pose_path(sensor, task)
        changed: dict[str, Any] = {}
        if sensor.pose is None and path.is_file():
            new = tuple(p for p in sensor.recordings if registered.get(_name_of(p)) != _state_of(p))
            basis = path.with_suffix(_BASIS)
            is_same_basis = not basis.is_file() or basis.read_text(encoding="utf-8") == _basis(
                sensor, site
            )
            changed = (
                {"recordings": new} if new and not is_same_basis else _NOT_NEEDED | {"pose": path}
            )
        sensors.append(sensor.model_copy(update=changed))
    return site.model_copy(update={"sensor": tuple(sensors)})


def _basis(sensor: Sensor, site: Site) -> str:
    """Return what the pose of a sensor is found from, but for its recordings and the scans."""
    stated = sensor.model_dump(include={"guess", "heading", "compass", "method"})
    return json_text({**stated, "map": hashlib.sha256(site.map.file.read_bytes()).hexdigest()})


def _store_pose(sensor: Sensor, site: Site, task: SiteTask) -> None:
    path = _pose_path(sensor, task)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_bytes((task.results / "sensors" / sensor.name / "pose.json").read_bytes())
    with atomic_write(path.with_suffix(_BASIS)) as part:
        part.write_text(_basis(sensor, site), encoding="utf-8")


def _name_of(recording: Path) -> str:
    return recording.resolve().as_posix()


def _state_of(recording: Path) -> list[int]:
    """Return time of writing and size of a file, which change when it is written."""
    state = recording.stat()
    return [state.st_mtime_ns, state.st_size]


def registered_recordings(task: SiteTask) -> dict[str, list[int]]:
    """Return the recordings of the dataset, each as its file was when it was read."""
    if not Manifest.is_there(task.dataset):
        return {}
    try:
        seen = read_json(task.results / _REGISTERED, what="a list of recordings")
        return {path: seen[path] for path in open_dataset(task.dataset).recordings()["path"]
                if path in seen}  # fmt: skip
    except InputError:
        return {}  # all are looked at again: those that are the same change no hour


def store_registered(task: SiteTask, states: Mapping[str, list[int]]) -> None:
    """Write which recordings the dataset has, and as they were when they were read."""
    paths = {*open_dataset(task.dataset).recordings()["path"]}
    in_dataset = {path: state for path, state in sorted(states.items()) if path in paths}
    write_json(task.results / _REGISTERED, in_dataset)


def register_checked(site: Site, task: SiteTask) -> None:
    """Check recordings and add them to the dataset, without making their hours.

    A damaged recording is named and left out; what was refused with it is tried again.
    """
    pending = {each.name: each for each in site.sensor}
    while pending:
        try:
            refused = _register(site.model_copy(update={"sensor": tuple(pending.values())}), task)
            again = {name: pending[name] for name in refused}
        except InputError as error:
            refused = {name: error for name, each in pending.items()
                       if files_of(error, each.recordings)}  # fmt: skip
            again = pending
            if not refused:
                raise
        task.failures += refused.items()
        pending = {}
        for name, sensor in again.items():
            paths = sensor.recordings
            damaged = files_of(refused[name], paths) if name in refused else []
            paths = tuple(path for path in paths if path not in damaged)
            if paths and (damaged or name not in refused):
                pending[name] = sensor.model_copy(update={"recordings": paths})


def _register(site: Site, task: SiteTask) -> dict[str, GisRadarError]:
    """Register recordings; return the error of each sensor that was left out."""
    stage = next(s for s in stages_of(site, task.results) if s.work is measure_stage)
    figures = measure_stage(
        **stage.arguments, outputs=[task.dataset], reporter=task, only=False, before_hour=0
    )
    return refusals_of(figures, site.timezone)


def make_site_hour(dataset: Path, hour: int, processes: int) -> int:
    """Make an hour of a dataset from its registered recordings; return its number of vehicles.

    A worker that an earlier run has left behind, or that was taken for lost, may still be making
    it: this one waits, so that what is written last follows from what is registered now.
    """
    with only_writer(dataset, lock=dataset / f".{hour}.lock", waits=True):
        return make_registered(dataset, hour, processes).vehicles


def is_older(path: Path, dataset: Path) -> bool:
    """Return whether a result is missing, or older than the last change of a dataset."""
    changed = dataset / "recordings.parquet"  # written after hours were made, too
    if not path.exists():
        return True
    return changed.exists() and path.stat().st_mtime_ns < changed.stat().st_mtime_ns


def update_site(task: SiteTask, city: CityFile) -> SiteTask:
    """Bring the tables of dates up to date, delete old exact tables, report on the last month."""
    update_days(task.dataset, task)
    if city.keep is not None:
        open_dataset(task.dataset).keep(city.keep / 86_400.0, reporter=task)
    if city.reports and is_older(task.results / "report.html", task.dataset):
        _report(task, city.timezone)
    return task


def _report(task: SiteTask, timezone: str) -> None:
    """Write heat map and report of the local month of the last measured hour."""
    site, hours = read_site(task.file), open_dataset(task.dataset).records()
    if not hours:
        return
    last = pd.Timestamp(max(hours) * 3600, unit="s", tz="UTC").tz_convert(timezone)
    begin = last.normalize().replace(day=1)
    heatmap_stage(
        dataset=task.dataset, outputs=[task.results / "heatmap"], reporter=task,
        labels=site.labels, begin=begin, end=begin + pd.DateOffset(months=1),
    )  # fmt: skip
    products.write_report(
        task.results, dataset=task.dataset, csv_locale=site.csv_locale, reporter=task
    )
