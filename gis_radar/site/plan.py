"""The stages of a site: from its file to all that a run makes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gis_radar.heatmap.heatmap import REPORT_FILES
from gis_radar.site.sensor import ConvertPart, Sensor
from gis_radar.site.site import Site
from gis_radar.site.stage import Stage

OWNED = (
    "road.", "tiles.gpkg", "sensors", "occupancy", "heatmap", "site.qgz", "site_", "run.json",
    "summary.md", *REPORT_FILES,
)  # fmt: skip


def stages_of(site: Site, folder: Path) -> list[Stage]:
    """Return the stages of a run, each after those that it needs.

    Parameters
    ----------
    site : Site
        From :func:`gis_radar.site.read_site`.
    folder : Path
        Where the results go.
    """
    road = () if site.scan is None else (folder / "road.laz",)
    poses = [_pose(site, sensor, folder, road) for sensor in site.sensor]
    return [
        *_road(site, folder),
        *(stage for sensor in site.sensor for stage in _conversion(sensor, folder)),
        # Poses take longest, so they come as early as they can.
        *poses,
        _tiles(site, folder, road),
        *(
            _occupancy(site, sensor, pose, folder)
            for sensor, pose in zip(site.sensor, poses, strict=True)
        ),
        *_heat_maps(site, folder),
        _project(site, poses, folder),
    ]


def _map_options(site: Site) -> dict[str, Any]:
    return {"crs": site.map.crs, "origin": site.map.origin}


def _road(site: Site, folder: Path) -> Iterator[Stage]:
    scan = site.scan
    if scan is None:
        return
    if scan.road is not None:
        yield Stage(
            name="road",
            work="take_road",
            inputs={"road": (scan.road,)},
            outputs=(folder / "road.laz",),
        )
        return
    yield Stage(
        name="mask",
        work="mask",
        inputs={"map_file": (site.map.file,), "scans": scan.files},
        options={**_map_options(site), "scan_crs": scan.crs, "engine": scan.engine},
        outputs=tuple(folder / f"road.{end}" for end in ("laz", "pipeline.json", "roads.gpkg")),
        phases=3,
    )


def _tiles(site: Site, folder: Path, road: tuple[Path, ...]) -> Stage:
    subtypes = site.map.subtypes
    return Stage(
        name="tiles",
        work="tiles",
        inputs={"map_file": (site.map.file,)} | ({"road": road} if road else {}),
        options={**_map_options(site), "length": site.tiles.length, "subtypes": subtypes},
        outputs=(folder / "tiles.gpkg",),
        phases=2,
    )


def _occupancy(site: Site, sensor: Sensor, pose: Stage, folder: Path) -> Stage:
    filters = asdict(site.occupancy)
    clocks = filters.pop("clocks")
    filters["elevation_error_deg"] = filters.pop("elevation_error")
    return Stage(
        name=f"occupancy {sensor.name}",
        work="occupancy",
        inputs={
            "recordings": _recordings(sensor, folder),
            "pose": pose.outputs[:1],
            "tile_file": (folder / "tiles.gpkg",),
            **({"clocks": (clocks,)} if clocks else {}),
        },
        options={
            "sensor": sensor.name,
            "view": _view(sensor),
            "filters": filters,
            "cycle": sensor.cycle,
        },
        outputs=(folder / "occupancy" / sensor.name,),
        sensor=sensor.name,
    )


def _recordings(sensor: Sensor, folder: Path) -> tuple[Path, ...]:
    """Return a sensor's recordings as the stages read them, once what is foreign is converted."""
    foreign = set(sensor.foreign)
    ours = tuple(path for path in sensor.recordings if path not in foreign)
    return (*ours, *((_converted(sensor, folder),) if foreign else ()))


def _converted(sensor: Sensor, folder: Path) -> Path:
    return folder / "sensors" / sensor.name / "recording.parquet"


def _conversion(sensor: Sensor, folder: Path) -> Iterator[Stage]:
    if sensor.foreign:
        yield Stage(
            name=f"convert {sensor.name}",
            work="convert",
            inputs={"recordings": sensor.foreign},
            options=asdict(sensor.convert or ConvertPart()),
            outputs=(_converted(sensor, folder),),
            phases=2,
            sensor=sensor.name,
        )


def _view(sensor: Sensor) -> dict[str, float] | None:
    return None if sensor.view is None else asdict(sensor.view)


def _pose(site: Site, sensor: Sensor, folder: Path, road: tuple[Path, ...]) -> Stage:
    if sensor.pose is not None:
        return _given_pose(sensor, sensor.pose, folder)
    place = folder / "sensors" / sensor.name
    scans = site.scan.files if site.scan else ()
    return Stage(
        name=f"localize {sensor.name}",
        work="find_pose",
        inputs={
            "recordings": _recordings(sensor, folder),
            "map_file": (site.map.file,),
            "road": road,
            **({"scans": scans} if scans else {}),
        },
        options={
            **_map_options(site),
            "sensor": sensor.name,
            "guess": sensor.guess,
            "heading": sensor.heading,
            "compass": sensor.compass,
            "method": sensor.method,
            "view": _view(sensor),
            "scan_crs": site.scan.crs if site.scan else None,
        },
        outputs=(place / "pose.json", place / "localization.png"),
        phases=5 if scans else 3,
        sensor=sensor.name,
    )


def _given_pose(sensor: Sensor, pose: Path, folder: Path) -> Stage:
    is_track = pose.suffix.lower() == ".csv"
    return Stage(
        name=f"pose {sensor.name}",
        work="take_pose",
        inputs={"pose": (pose,)},
        options={"sensor": sensor.name, "view": _view(sensor)},
        outputs=(folder / "sensors" / sensor.name / ("track.csv" if is_track else "pose.json"),),
        sensor=sensor.name,
    )


def _heat_maps(site: Site, folder: Path) -> Iterator[Stage]:
    for number, interval in enumerate(site.heatmap.intervals or (None,)):
        end = f"_{interval}" if number else ""
        yield Stage(
            name=f"heat map{end.replace('_', ' ')}",
            work="heat_map",
            inputs={"tile_file": (folder / "tiles.gpkg",)},
            parts={"occupancies": tuple(folder / "occupancy" / each.name for each in site.sensor)},
            options={"interval": interval},
            outputs=(folder / f"heatmap{end}",),
            phases=4,
        )


def _project(site: Site, poses: list[Stage], folder: Path) -> Stage:
    return Stage(
        name="QGIS project",
        work="qgis_project",
        inputs={"heat": (folder / "heatmap",)},
        parts={
            "poses": tuple(pose.outputs[0] for pose in poses),
            "occupancies": tuple(folder / "occupancy" / each.name for each in site.sensor),
        },
        options={"title": site.title, "time_zone": site.time_zone, "source": _sources(site)},
        outputs=(folder / "sensors.gpkg", folder / "site.qgz"),
    )


def _sources(site: Site) -> str:
    """Return where the data come from, in one line, each source once."""
    named = (site.map.source, site.scan.source if site.scan else None, *site.attribution)
    return "; ".join(dict.fromkeys(each for each in named if each))


def report_of(site: Site, folder: Path) -> Stage:
    """Return the last stage: the report, which reads what the run says of the others.

    Parameters
    ----------
    site : Site
        From :func:`gis_radar.site.read_site`.
    folder : Path
        Where the results go.
    """
    return Stage(
        name="report",
        work="report",
        inputs={"heat": (folder / "heatmap",), "told": (folder / "run.json",)},
        parts={"occupancies": tuple(folder / "occupancy" / each.name for each in site.sensor)},
        outputs=tuple(folder / name for name in REPORT_FILES),
        phases=3,
    )
