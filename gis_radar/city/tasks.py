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
    Text,
    WarningList,
    atomic_write,
    json_text,
    only_writer,
)
from gis_radar.city.city import RESULTS
from gis_radar.city.settings import CityFile
from gis_radar.dataset import (
    STATED_LANES,
    Manifest,
    make_registered,
    open_dataset,
    site_folder,
    update_days,
)
from gis_radar.site import (
    HASH_LENGTH,
    RunState,
    Sensor,
    Site,
    conversion_of,
    do_stages,
    files_of,
    heatmap_stage,
    measure_stage,
    opened_run,
    prepare_site,
    read_site,
    refusals_of,
    stages_of,
)

_POSES = "poses"  # folder of a city with the poses that were found
_BASIS = ".basis"  # beside such a pose: what it was found from
_NOT_NEEDED = {"guess": None, "view": None}  # not needed where a pose is known
_CONVERTED = "recordings"  # folder of a city with the recordings that were converted

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
    with opened_run(task.results, task) as (state, _):
        site = _converted(read_site(task.file), task, state)
        if not site.sensor:
            return task
        registered = registered_recordings(task)
        new = {
            sensor.name: tuple(
                path for path in sensor.recordings
                if registered.get(path.resolve().as_posix()) != state.hash_of(path)
            )
            for sensor in site.sensor
        }  # fmt: skip
        site = _with_known_poses(site, new, task)
        outcomes = prepare_site(site, task.results, state, reporter=task)
    errors = {each.stage.sensor: each.error for each in outcomes if each.error is not None}
    task.failures += errors.items()
    for sensor in site.sensor:
        if sensor.pose is None and sensor.name not in errors:
            _store_pose(sensor, site, task)
    sensors = [
        each.model_copy(update={"recordings": new[each.name]})
        for each in site.sensor if new[each.name] and each.name not in errors
    ]  # fmt: skip
    if sensors:
        register_checked(site.model_copy(update={"sensor": tuple(sensors)}), task)
    if Manifest.is_there(task.dataset):
        streets = task.results / "tiles.gpkg" if site.map.streets else None
        open_dataset(task.dataset).state_lanes(**site.of_lanes, streets=streets, reporter=task)
    return task


def _converted(site: Site, task: SiteTask, state: RunState) -> Site:
    """Convert recordings of other formats one by one; leave out those that cannot be converted."""
    stages = {
        (sensor.name, path): conversion_of(
            (path,), _converted_path(path, sensor, task), sensor,
            Text("convert {}", f"{sensor.name}, {path}"),
        )
        for sensor in site.sensor for path in sensor.foreign
    }  # fmt: skip
    if not stages:
        return site
    outcomes = do_stages(stages.values(), site, task.results, state, reporter=task)
    task.failures += [(each.stage.sensor, each.error) for each in outcomes if each.error]
    sensors = []
    for sensor in site.sensor:
        native = [path for path in sensor.recordings if path not in sensor.foreign]
        made = [p for each in outcomes if each.stage.sensor == sensor.name for p in each.made]
        if native or made:
            changed = {"recordings": (*native, *made), "convert": None}
            sensors.append(sensor.model_copy(update=changed))
    return site.model_copy(update={"sensor": tuple(sensors)})


def _converted_path(path: Path, sensor: Sensor, task: SiteTask) -> Path:
    place = hashlib.sha256(os.fsencode(path.absolute())).hexdigest()[:12]
    return task.root / _CONVERTED / task.name / sensor.name / place / f"{path.stem}.parquet"


def _pose_path(sensor: Sensor, task: SiteTask) -> Path:
    return task.root / _POSES / task.name / f"{sensor.name}.json"


def _with_known_poses(site: Site, new: Mapping[str, tuple[Path, ...]], task: SiteTask) -> Site:
    """Give sensors the poses that an earlier run found, from what is stated now.

    Where guess, heading or map were changed, the pose is found again, from the `new` recordings:
    those that the dataset has keep theirs.
    """
    sensors = []
    for sensor in site.sensor:
        path = _pose_path(sensor, task)
        changed: dict[str, Any] = {}
        if sensor.pose is None and path.is_file():
            basis = path.with_suffix(_BASIS)
            is_same_basis = not basis.is_file() or basis.read_text(encoding="utf-8") == _basis(
                sensor, site
            )
            found_again = new[sensor.name] if not is_same_basis else ()
            changed = {"recordings": found_again} if found_again else _NOT_NEEDED | {"pose": path}
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


def registered_recordings(task: SiteTask) -> dict[str, str]:
    """Return the hash of each recording of the dataset, as it was when it was measured."""
    if not Manifest.is_there(task.dataset):
        return {}
    entries = open_dataset(task.dataset).recordings()
    return dict(zip(entries["path"], entries["digest"].str[:HASH_LENGTH], strict=True))


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
    # the first is written after hours were made, too
    changed = [dataset / name for name in ("recordings.parquet", STATED_LANES)]
    written_at = [each.stat().st_mtime_ns for each in changed if each.exists()]
    return not path.exists() or path.stat().st_mtime_ns < max(written_at, default=0)


def update_site(task: SiteTask, city: CityFile) -> SiteTask:
    """Bring the tables of dates up to date, delete old exact tables, report on the last month."""
    update_days(task.dataset, task)
    if city.keep is not None:
        open_dataset(task.dataset).keep(city.keep / 86_400.0, since_made=True, reporter=task)
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
