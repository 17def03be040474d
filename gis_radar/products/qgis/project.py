"""Write the QGIS project of a folder of results, which the plugin's reports start from."""

from __future__ import annotations

import hashlib
import itertools
import json
import zipfile
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio

from gis_radar.base import (
    QUIET,
    STEPS_PER_SECOND,
    Box,
    OutputError,
    Reporter,
    Text,
    UsageError,
    atomic_write,
    in_language,
    known_language,
    long_span,
    metric_crs,
    zone_of,
)
from gis_radar.dataset import FOOTPRINTS, SHOWN_S, Dataset, footprint_style, open_dataset
from gis_radar.hdmap import LANES_LAYER, STOP_LINES_LAYER, lane_style
from gis_radar.measures import sight_of_tiles
from gis_radar.poses import (
    SENSORS,
    UNCERTAINTY,
    VIEWS,
    pose_from_dict,
    read_style,
    read_track,
    write_sensors,
)
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.layers import HEATMAP_FILE, read_package, styles_of
from gis_radar.products.heatmap.package_tables import LONG, WIDE, interval_times
from gis_radar.products.qgis.project_xml import LayerSource, ProjectContent, TimeRange, project_xml
from gis_radar.scans import SIGHT_LAYER, SightTiles, write_sights

_MAP_MARGIN = 0.05
"""Margin around the observed tiles, as a share of their extent."""
_LEAST_RECORDED = 0.05
"""Share of the first interval that is played for which it was recorded."""


def write_qgis_project(
    path: str | Path,
    *,
    heatmap: str | Path,
    sensors: str | Path | None = None,
    sight: str | Path | None = None,
    lanes: str | Path | None = None,
    footprints: str | Path | None = None,
    title: str | None = None,
    timezone: str | None = None,
    source: str | None = None,
    language: str | None = None,
) -> None:
    """Write a QGIS project with a print layout: a heat map, and the sensors that made it.

    Files are named relative to the project, so that a folder with all of them can be moved.

    Parameters
    ----------
    path : str or Path
        The project, ending in `.qgz`; it appears whole or not at all.
    heatmap : str or Path
        Folder of a heat map, or its GeoPackage.
    sensors : str or Path, optional
        GeoPackage of :func:`gis_radar.poses.write_sensors`.
    sight : str or Path, optional
        GeoPackage of :func:`gis_radar.scans.write_sights`: what the sensors see, hidden at first.
    lanes : str or Path, optional
        GeoPackage with the layers `lanes` and `stop_lines`, from :func:`gis_radar.write_tiles`.
    footprints : str or Path, optional
        GeoPackage of :meth:`gis_radar.Dataset.write_footprints`: the project then plays single
        vehicles, half second by half second.
    title : str, optional
        Title of project and layout; by default that of the heat map, else the file's name.
    timezone : str, optional
        Time zone of the times on layout and map; by default that of the heat map.
    source : str, optional
        Source of the data, for the layout; by default those of the heat map.
    language : str, optional
        Language of names of layers, legends and layout; by default that of the heat map.

    Raises
    ------
    UsageError
        If the name does not end in `.qgz`, or there is no such language.
    InputError
        If the folder holds no heat map.
    OutputError
        If the present project was edited.
    """
    path = Path(path)
    if path.suffix.lower() != ".qgz":
        raise UsageError("{}: a QGIS project ends in .qgz", path, hint="end the name in .qgz")
    if was_edited(path):
        raise OutputError("{}: somebody has edited this project", path, hint="name another output")
    package = Path(heatmap).resolve()
    package = package / HEATMAP_FILE if package.is_dir() else package
    heat = Tally(**read_package(Path(heatmap)))
    timezone, language = timezone or heat.labels.timezone, language or heat.labels.language
    played = _time_range(heat, timezone)
    layers = _heatmap_layers(heat, package)
    if sensors is not None:
        layers |= _layers_with_rows(
            Path(sensors).resolve(), (SENSORS, UNCERTAINTY, VIEWS), read_style
        )
    if sight is not None:
        qml = files("gis_radar.scans.sight").joinpath("sight.qml").read_text(encoding="utf-8")
        layers["gis_radar_sight"] = LayerSource(Path(sight).resolve(), qml, SIGHT_LAYER)
    if lanes is not None:
        layers |= _lane_layers(Path(lanes).resolve())
    if footprints is not None:
        layers["gis_radar_footprints"] = LayerSource(
            Path(footprints).resolve(), footprint_style(), FOOTPRINTS
        )
        played = played._replace(step_s=SHOWN_S)
    with in_language(known_language(language)):
        # of what was recorded: the last interval may end later
        time = long_span(*heat.whole.span(), zone_of(timezone))
    content = ProjectContent(
        title=title or heat.labels.title or path.stem, time=time,
        source="; ".join(heat.labels.sources) if source is None else source,
        crs=metric_crs(heat.crs, what=str(heatmap)), box=_observed_box(heat), layers=layers,
        played=played, measure=heat.measure, language=language,
    )  # fmt: skip
    write_project_file(path, project_xml(content, path.resolve().parent))


def write_site_project(
    folder: str | Path,
    *,
    footprints: bool = False,
    reporter: Reporter = QUIET,
    **options: Any,
) -> list[Path]:
    """Write the layers of the sensors and the project into the folder of a site's results.

    A project that was edited stays as it is; the new one is written beside it.

    Parameters
    ----------
    folder : str or Path
        Holds `heatmap/`, the poses as `sensors/NAME/pose.json` or `track.csv`, of which the last
        pose counts, and `dataset/` of the sensors that the heat map shows.
    footprints : bool
        Whether the single vehicles of the dataset are written as a layer that the project plays;
        without it, an earlier such layer is deleted.
    reporter : Reporter
        Receives a warning where an edited project is in the way.
    **options
        Title, time zone, source and language, as for :func:`write_qgis_project`.

    Returns
    -------
    list of Path
        `sensors.gpkg`, where there is a pose, `sight.gpkg`,
        `footprints.gpkg`, where they are asked for and there are vehicles, and `site.qgz`;
        `site_2.qgz` where that was edited.
    """
    folder = Path(folder)
    dataset = open_dataset(folder / "dataset")
    poses = _poses(folder, dataset)
    sensors = folder / "sensors.gpkg" if poses else None
    if sensors is not None:
        write_sensors([read_track(path).poses[-1] for path in poses], sensors)
    sight = _write_sight(folder, dataset)
    vehicles = folder / f"{FOOTPRINTS}.gpkg" if footprints and dataset.has_vehicles else None
    if vehicles is None:
        (folder / f"{FOOTPRINTS}.gpkg").unlink(missing_ok=True)
    else:
        dataset.write_footprints(vehicles, reporter=reporter)
    numbered = (folder / f"site_{number}.qgz" for number in itertools.count(2))
    names = itertools.chain([folder / "site.qgz"], numbered)
    project = next(name for name in names if not was_edited(name))
    if project.name != "site.qgz":
        reporter.warn("site.qgz was edited and stays as it is; the new project is {}", project.name)
    tiles = folder / "tiles.gpkg"
    write_qgis_project(
        project, heatmap=folder / "heatmap", sensors=sensors, sight=sight, footprints=vehicles,
        lanes=tiles if _lane_layers(tiles.resolve()) else None, **options,
    )  # fmt: skip
    return [path for path in (sensors, sight, vehicles, project) if path is not None]


def _lane_layers(tiles: Path) -> dict[str, LayerSource]:
    """Return the layers of lanes of a file of tiles, if it has any."""
    return (
        _layers_with_rows(tiles, (LANES_LAYER, STOP_LINES_LAYER), lane_style)
        if tiles.is_file()
        else {}
    )


def _write_sight(folder: Path, dataset: Dataset) -> Path:
    """Write the sensors' sights of the dataset; return the file."""
    tiles, poses = dataset.tiles(), dataset.last_poses()
    road, sights = SightTiles.of(tiles), []
    for sensor, document in zip(poses["sensor"], poses["document"], strict=True):
        pose = pose_from_dict(json.loads(document), what=Text("{}: a pose", dataset.folder))
        sights.append(sight_of_tiles(dataset.sight_of(sensor), pose, road))
    write_sights(sights, tiles, folder / "sight.gpkg")
    return folder / "sight.gpkg"


def _poses(folder: Path, dataset: Dataset) -> list[Path]:
    """Return the poses of the sensors that the heat map shows, by name."""
    paths = {path.parent.name: path for path in (folder / "sensors").glob("*/track.csv")}
    paths |= {path.parent.name: path for path in (folder / "sensors").glob("*/pose.json")}
    return [paths[name] for name in sorted(paths) if name in dataset.sensors]


def _observed_box(heat: Tally) -> Box:
    """Return the box around the observed tiles, or around all if none was."""
    observed = heat.shares().observed_s > 0
    shown = heat.tiles[observed] if observed.any() else heat.tiles
    west, south, east, north = map(float, shown.total_bounds)
    margin = _MAP_MARGIN * max(east - west, north - south)
    return west - margin, south - margin, east + margin, north + margin


def _time_range(heat: Tally, timezone: str) -> TimeRange:
    """Return the time that is played: from the first interval that was recorded for 5 % or more.

    The project opens with it, and of one in which the recording only begins all is uncertain.
    """
    times = [*interval_times(heat)]
    steps = heat.timeline.end - heat.timeline.begin
    begun = heat.observed.max(axis=1, initial=0) >= _LEAST_RECORDED * steps
    length_s = float(steps[0]) / STEPS_PER_SECOND
    return TimeRange(times[int(np.argmax(begun))][1], times[-1][2], length_s, timezone)


def _layers_with_rows(
    path: Path, tables: Sequence[str], style_of: Callable[[str], str]
) -> dict[str, LayerSource]:
    """Return layers of a file that have rows, so that legends name no empty ones."""
    names = {str(name) for name, _ in pyogrio.list_layers(path)}
    return {
        f"gis_radar_{table}": LayerSource(path, style_of(table), table)
        for table in tables
        if table in names
        and pyogrio.read_info(path, layer=table, force_feature_count=True)["features"] > 0
    }


def _heatmap_layers(heat: Tally, package: Path) -> dict[str, LayerSource]:
    """Return the layers of a heat map in our own styles, whatever styles its file holds."""
    qml = styles_of(heat)
    raster = package.with_name("hits.tif" if heat.occupancy is None else "heatmap.tif")
    layers = {
        "by_interval": LayerSource(package, qml[LONG], LONG),
        "heatmap": LayerSource(package, qml[WIDE], WIDE),
        "ground": LayerSource(package, style.ground_qml(qml[WIDE]), WIDE),
    }
    if raster.is_file():
        layers["raster"] = LayerSource(raster, style.sidecar_qml(heat.measure))
    # No id may begin as another: QGIS's lists of layers would drop the wrong one.
    return {f"gis_radar_{name}": layer for name, layer in layers.items()}


_MARK = b"gis_radar "


def write_project_file(path: Path, text: str) -> None:
    """Write a project; the same text gives the same file.

    A mark in the file, which is lost when QGIS saves the project, shows that it was not edited.
    """
    with atomic_write(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(f"{path.stem}.qgs"), text, zipfile.ZIP_DEFLATED)
        archive.comment = _mark(text.encode())


def was_edited(path: Path) -> bool:
    """Return whether a file exists and differs from what was written."""
    if not path.exists():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = archive.namelist()
            return archive.comment != _mark(archive.read(name))
    except (OSError, ValueError, zipfile.BadZipFile):
        return True


def _mark(content: bytes) -> bytes:
    return _MARK + hashlib.blake2b(content, digest_size=16).hexdigest().encode()
