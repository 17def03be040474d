"""The stages of a site as data: for each its function, the files that it reads, and its outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from gis_radar.base import GisRadarError, Text
from gis_radar.dataset import STATED_LANES
from gis_radar.products import REPORT_FILES
from gis_radar.site import stages
from gis_radar.site.joint_poses import CANDIDATES_FILE, POSE_FILE, RECORDING_FILE
from gis_radar.site.settings import ConvertTable, Sensor, Site

OWNED_BY_RUN = (
    "road.", "tiles.gpkg", "sensors", "dataset", "heatmap", "sight.gpkg",
    "footprints.gpkg", "site.qgz", "site_", "run.json",
    "together.json", *REPORT_FILES,
)  # fmt: skip


Ending = Literal["done", "kept", "refused", "failed", "skipped"]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A step from files to files, as data.

    Parameters
    ----------
    name : str
        Name for the user and for the stage's record.
    work : callable
        A function of :mod:`gis_radar.site.stages`.
    inputs : mapping
        Files and folders, one or a tuple, by the function's arguments; all are needed.
    parts : mapping
        Tuples of files by argument, of which only existing ones are passed: one at least.
    beside : tuple of tuple of Path
        Files that the function finds by itself beside its outputs; of each tuple, one at least
        exists.
    options : mapping
        The function's other arguments, which JSON can hold.
    outputs : tuple of Path
        Files and folders that it makes, in the order of the function.
    phases : int
        Number of progress bars that its work would show by itself.
    sensor : str
        Name of its sensor: if it fails, other sensors go on. Empty if all depends on the stage.
    in_turn : str
        Name of the input whose files are read one after the other until one gives a result; the
        figure `asked` is the number read. Files added after these do not change the result.
    """

    name: str
    work: Callable[..., Mapping[str, Any]]
    inputs: Mapping[str, Path | tuple[Path, ...]]
    outputs: tuple[Path, ...]
    parts: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)
    beside: tuple[tuple[Path, ...], ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    phases: int = 1
    sensor: str = ""
    in_turn: str = ""

    @property
    def reads(self) -> tuple[Path, ...]:
        """All files and folders that it may read."""
        return (*self.needs, *(path for paths in self.choices for path in paths))

    @property
    def choices(self) -> tuple[tuple[Path, ...], ...]:
        """Tuples of which each must have one existing file at least."""
        return (*self.parts.values(), *self.beside)

    @property
    def needs(self) -> tuple[Path, ...]:
        """All files and folders that must exist."""
        given = self.inputs.values()
        return tuple(p for each in given for p in ([each] if isinstance(each, Path) else each))

    def reading_first(self, number: int | None) -> Stage:
        """Return the stage with at most `number` of the files that are read in turn."""
        if number is None or not self.in_turn:
            return self
        files = self.inputs[self.in_turn]
        files_read = files if isinstance(files, Path) else files[:number]
        return replace(self, inputs={**self.inputs, self.in_turn: files_read})

    @property
    def arguments(self) -> dict[str, Any]:
        """The function's arguments without its outputs; of the parts, those that exist."""
        existing = {name: [p for p in paths if p.exists()] for name, paths in self.parts.items()}
        return {**self.inputs, **existing, **self.options}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a stage.

    Parameters
    ----------
    stage : Stage
        The stage.
    state : str
        `done` now, `kept` from an earlier run, `refused` without a trustworthy answer, `failed` for
        bad data, `skipped` because a file that it needs is missing.
    figures : mapping
        Key figures of the result.
    warnings : sequence of str
        The warnings of its work.
    error : GisRadarError, optional
        The reason why there is no result.
    seconds : float
        Duration of its work, in this run or the earlier one.
    """

    stage: Stage
    state: Ending
    figures: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    error: GisRadarError | None = None
    seconds: float = 0.0

    @property
    def has_result(self) -> bool:
        """Whether there is a result, of this run or an earlier one."""
        return self.state in {"done", "kept"}

    @property
    def made(self) -> list[Path]:
        """The outputs that exist: a stage may make only some, such as a pose or candidates."""
        return [path for path in self.stage.outputs if self.has_result and path.exists()]


def stages_of(site: Site, folder: Path) -> list[Stage]:
    """Return the stages of a run, each after those that it needs.

    The last one is the report: it reads the record of the others, after they have ended.

    Parameters
    ----------
    site : Site
        From :func:`gis_radar.read_site`.
    folder : Path
        Folder for the results.
    """
    sensors = site.sensor
    return [
        *_road(site, folder),
        *(_conversion(each, folder) for each in sensors if each.foreign),
        # Poses take longest, so they come as early as possible.
        *(_localization(site, each, folder) for each in sensors if each.pose is None),
        *_joint_poses(site, folder),
        *(_pose(site, each, folder) for each in sensors),
        _tiles(site, folder),
        _measure(site, folder),
        *_lanes(site, folder),
        *_products(site, folder),
    ]


def _given(**files: Path | tuple[Path, ...] | None) -> dict[str, Path | tuple[Path, ...]]:
    """Return the inputs of a stage without those that the site does not have."""
    return {name: each for name, each in files.items() if each is not None}


def _map_options(site: Site) -> dict[str, Any]:
    return {"crs": site.map.crs, "origin": site.map.origin}


def _road(site: Site, folder: Path) -> Iterator[Stage]:
    """Yield the stage that makes the road's surface: a mask of scans, or a copy."""
    scan = site.scan
    if scan is not None and scan.road is not None:
        outputs = (folder / "road.laz",)
        inputs = {"road": scan.road}
        yield Stage(name=Text("road"), work=stages.road_stage, inputs=inputs, outputs=outputs)
    elif scan is not None:
        yield Stage(
            name=Text("mask"),
            work=stages.mask_stage,
            inputs={"map_file": site.map.file, "scans": scan.files},
            options={**_map_options(site), "scan_crs": scan.crs, "engine": scan.engine},
            outputs=tuple(folder / f"road.{end}" for end in ("laz", "pipeline.json", "roads.gpkg")),
            phases=3,
        )


def _conversion(sensor: Sensor, folder: Path) -> Stage:
    """Return the stage that converts a sensor's recordings in other formats to one recording."""
    output = folder / "sensors" / sensor.name / RECORDING_FILE
    return conversion_of(sensor.foreign, output, sensor, Text("convert {}", sensor.name))


def conversion_of(recordings: tuple[Path, ...], output: Path, sensor: Sensor, name: str) -> Stage:
    """Return the stage that converts recordings of a sensor to one, as its table says."""
    return Stage(
        name=name,
        work=stages.convert_stage,
        inputs={"recordings": recordings},
        options=(sensor.convert or ConvertTable()).model_dump(),
        outputs=(output,),
        phases=2,
        sensor=sensor.name,
    )


def _recordings(sensor: Sensor, folder: Path) -> tuple[Path, ...]:
    """Return the recordings of a sensor for later stages: converted ones in place of foreign."""
    foreign = set(sensor.foreign)
    readable = (path for path in sensor.recordings if path not in foreign)
    return (*readable, *(_conversion(sensor, folder).outputs if foreign else ()))


def _localization(site: Site, sensor: Sensor, folder: Path) -> Stage:
    """Return the stage that finds a sensor's pose from its own recordings."""
    place = folder / "sensors" / sensor.name
    scans = _scans(site)
    return Stage(
        name=Text("localize {}", sensor.name),
        work=stages.localize_stage,
        inputs=_given(
            recordings=_recordings(sensor, folder),
            map_file=site.map.file,
            road=folder / "road.laz",
            scans=scans,
        ),
        options={
            **_map_options(site),
            "sensor": sensor.name,
            **sensor.model_dump(include={"guess", "heading", "compass", "method"}),
            "scan_crs": site.scan.crs if site.scan else None,
        },
        outputs=(place / POSE_FILE, place / "localization.png", place / CANDIDATES_FILE),
        phases=5 if scans else 3,
        sensor=sensor.name,
        in_turn="recordings",
    )


def _view(sensor: Sensor) -> dict[str, float] | None:
    return None if sensor.view is None else sensor.view.model_dump()


def _joint_sensors(site: Site) -> list[Sensor]:
    """Return the sensors that are calibrated jointly: two at least, or none."""
    unplaced = [each for each in site.sensor if each.pose is None]
    joint = [each for each in unplaced if each.tied and each.method == "lane"]
    return joint if len(joint) > 1 else []


def _joint_poses(site: Site, folder: Path) -> Iterator[Stage]:
    """Yield the stage of joint calibration, where there are several sensors for it."""
    sensors = _joint_sensors(site)
    if not sensors:
        return
    places = [folder / "sensors" / each.name for each in sensors]
    found = (place / name for place in places for name in (POSE_FILE, CANDIDATES_FILE))
    readable, converted = _all_recordings(sensors, folder)
    yield Stage(
        name=Text("poses together"),
        work=stages.together_stage,
        inputs=_given(
            map_file=site.map.file,
            road=folder / "road.laz",
            recordings=tuple(path for paths in readable.values() for path in paths),
            clocks=site.measure.clocks,
        ),
        beside=((*found, *converted),),
        options={
            **_map_options(site),
            "sensors": {name: len(paths) for name, paths in readable.items()},
            "guesses": {each.name: each.guess for each in sensors},
        },
        outputs=(folder / "together.json",),
        phases=2,
    )


def _all_recordings(
    sensors: Sequence[Sensor], folder: Path
) -> tuple[dict[str, list[Path]], list[Path]]:
    """Return recordings that need no conversion, by sensor, and all converted recordings."""
    readable = {
        each.name: [p for p in each.recordings if p not in each.foreign] for each in sensors
    }
    foreign = [each for each in sensors if each.foreign]
    return readable, [path for each in foreign for path in _conversion(each, folder).outputs]


def _pose(site: Site, sensor: Sensor, folder: Path) -> Stage:
    """Return the stage that writes the pose of a sensor that all later stages use."""
    place = folder / "sensors" / sensor.name
    options: dict[str, Any] = {"sensor": sensor.name, "view": _view(sensor)}
    if sensor in _joint_sensors(site):
        return Stage(
            name=Text("pose {}", sensor.name),
            work=stages.tied_pose_stage,
            inputs={"together": folder / "together.json"},
            beside=((place / POSE_FILE,),),
            options=options,
            outputs=(place / "pose.json",),
            sensor=sensor.name,
        )
    pose = sensor.pose or place / POSE_FILE
    is_track = pose.suffix.lower() == ".csv"
    return Stage(
        name=Text("pose {}", sensor.name),
        work=stages.pose_stage,
        inputs={"pose": pose} | ({} if sensor.pose else {"candidates": place / CANDIDATES_FILE}),
        options={**options, "given": sensor.pose is not None},
        outputs=(place / ("track.csv" if is_track else "pose.json"),),
        sensor=sensor.name,
    )


def _tiles(site: Site, folder: Path) -> Stage:
    """Return the stage that splits the lanes into tiles."""
    return Stage(
        name=Text("tiles"),
        work=stages.tiles_stage,
        inputs=_given(
            map_file=site.map.file,
            streets=site.map.streets,
            road=folder / "road.laz" if site.scan else None,
        ),
        options={
            **_map_options(site),
            "street_field": site.map.street_field,
            "length_m": site.tiles.length,
            "subtypes": site.map.subtypes,
        },
        outputs=(folder / "tiles.gpkg",),
        phases=2,
    )


def _measure(site: Site, folder: Path) -> Stage:
    """Return the stage that measures the recordings of all sensors with a pose."""
    filters, scans = site.measure.model_dump(), _scans(site)
    clocks = filters.pop("clocks")
    filters["elevation_error_deg"] = filters.pop("elevation_error")
    poses = {each.name: _pose(site, each, folder).outputs[0] for each in site.sensor}
    readable, converted = _all_recordings(site.sensor, folder)
    return Stage(
        name=Text("measure"),
        work=stages.measure_stage,
        inputs=_given(
            map_file=site.map.file,
            tile_file=folder / "tiles.gpkg",
            recordings=tuple(path for paths in readable.values() for path in paths),
            clocks=clocks,
            scans=scans,
        ),
        parts={"poses": tuple(poses.values())},
        beside=((*poses.values(), *converted),),
        options={
            "sensors": {
                each.name: {
                    "recordings": len(readable[each.name]),
                    # a pose has its view already
                    "view": _view(each) if poses[each.name].suffix == ".csv" else None,
                    "cycle": each.cycle,
                }
                for each in site.sensor
            },
            **({} if clocks else {"clocks": None}),
            "scan_crs": site.scan.crs if site.scan else None,
            "filters": filters,
            "accept": [each.name for each in site.sensor if each.accept],
            "hits_only": not site.vehicles.follow,
            "timezone": site.timezone,
        },
        outputs=(folder / "dataset",),
        phases=4 if scans else 3,
    )


def _lanes(site: Site, folder: Path) -> Iterator[Stage]:
    """Yield the stage that names lanes, where the site file states something of them."""
    streets = folder / "tiles.gpkg" if site.map.streets else None
    if streets or any(site.of_lanes.values()):
        yield Stage(
            name=Text("lanes"),
            work=stages.lanes_stage,
            inputs=_given(streets=streets),
            beside=((folder / "dataset",),),
            options=site.of_lanes,
            outputs=(folder / "dataset" / STATED_LANES,),
        )


def _scans(site: Site) -> tuple[Path, ...] | None:
    return (site.scan.files or None) if site.scan else None


def _products(site: Site, folder: Path) -> Iterator[Stage]:
    """Yield the stages after measuring: heat maps, QGIS project, report."""
    dataset = folder / "dataset"
    for number, interval in enumerate(site.heatmap.intervals or (None,)):
        end = f"_{interval}" if number else ""
        yield Stage(
            name=Text("heat map{}", end.replace("_", " ")),
            work=stages.heatmap_stage,
            inputs={"dataset": dataset},
            options={
                "interval": interval,
                "labels": site.labels,
            },
            outputs=(folder / f"heatmap{end}",),
            phases=4,
        )  # fmt: skip
    poses = tuple(path for each in site.sensor for path in _pose(site, each, folder).outputs)
    lane_files = [each.outputs for each in _lanes(site, folder)]
    yield Stage(
        name=Text("QGIS project"),
        work=stages.project_stage,
        inputs={},
        beside=((folder / "heatmap",), poses, (dataset,)),
        options={"footprints": site.vehicles.footprints},
        outputs=(
            folder / "sensors.gpkg",
            folder / "sight.gpkg",
            folder / "footprints.gpkg",
            folder / "site.qgz",
        ),
    )
    yield Stage(
        name=Text("report"),
        work=stages.report_stage,
        inputs={},
        beside=((folder / "heatmap",), (folder / "run.json",), (dataset,), *lane_files),
        options={"csv_locale": site.csv_locale},
        outputs=tuple(folder / name for name in REPORT_FILES),
        phases=3,
    )
