"""Write the QGIS project of a folder of results."""

from __future__ import annotations

import hashlib
import itertools
import sqlite3
import zipfile
from contextlib import closing
from datetime import datetime
from pathlib import Path

import pyogrio
from pyproj import CRS

from gis_radar.crs import Box, metric_crs
from gis_radar.errors import InputError, OutputError, UsageError
from gis_radar.files import whole_file
from gis_radar.heatmap.layers import LONG, WIDE
from gis_radar.poses.files import read_track
from gis_radar.poses.layers import write_sensors
from gis_radar.progress import QUIET, Reporter
from gis_radar.qgis.document import (
    ProjectContent,
    TimeRange,
    heatmap_layers,
    project_xml,
    sensor_layers,
)
from gis_radar.steps import seconds_from_iso, zone_of

MAP_MARGIN = 0.05
"""Around what was observed, as a share of its size: the road goes on a little to each side."""

_MARK = b"gis_radar "
_TIMES = f'SELECT min("begin"), min("end"), max("end") FROM "{LONG}"'  # noqa: S608 - our own name


def write_qgis_project(
    path: str | Path,
    *,
    heatmap: str | Path,
    sensors: str | Path | None = None,
    title: str = "",
    time_zone: str = "UTC",
    source: str = "",
) -> None:
    """Write a QGIS project with a print layout: a heat map, and the sensors that made it.

    Files are named relative to the project, so that a folder with all of them can be moved.

    Parameters
    ----------
    path : str or Path
        The project, ending in `.qgz`; it appears whole or not at all.
    heatmap : str or Path
        Folder of a heat map.
    sensors : str or Path, optional
        GeoPackage of :func:`gis_radar.write_sensors`.
    title : str
        Of the project and the layout; by default the file's name.
    time_zone : str
        Of the time on the layout, such as `Europe/Berlin`.
    source : str
        Where the data come from, for the layout.

    Raises
    ------
    UsageError
        If the name does not end in `.qgz`.
    InputError
        If the folder holds no heat map.
    OutputError
        If there is a project that somebody has edited.
    """
    path = Path(path)
    if path.suffix.lower() != ".qgz":
        raise UsageError(f"{path}: a QGIS project ends in .qgz", hint="end the name in .qgz")
    if was_edited(path):
        raise OutputError(f"{path}: somebody has edited this project", hint="name another output")
    package = Path(heatmap) / "heatmap.gpkg"
    crs, box = _observed_box(package)
    played = _time_range(package)
    layers = heatmap_layers(Path(heatmap).resolve(), played.step_s if played else 0.0)
    if sensors is not None:
        layers |= sensor_layers(Path(sensors).resolve())
    content = ProjectContent(
        title=title or path.stem, time=_local_time(played, time_zone) if played else "",
        source=source, crs=crs, box=box, layers=layers, played=played,
    )  # fmt: skip
    write_project_file(path, project_xml(content, path.resolve().parent))


def write_site_project(
    folder: str | Path,
    *,
    title: str = "",
    time_zone: str = "UTC",
    source: str = "",
    reporter: Reporter = QUIET,
) -> list[Path]:
    """Write the layers of the sensors and the project into the folder of a site's results.

    A project that somebody has edited stays as it is; the new one is put beside it.

    Parameters
    ----------
    folder : str or Path
        Holds `heatmap/`, the poses as `sensors/NAME/pose.json` or `track.csv`, of which the last
        pose counts, and `occupancy/NAME/` of the sensors that the heat map shows; without any
        `occupancy/`, all sensors are shown.
    title : str
        Of the project; by default the folder's name.
    time_zone, source : str
        As :func:`write_qgis_project` takes them.
    reporter : Reporter
        Receives a warning where an edited project is in the way.

    Returns
    -------
    list of Path
        `sensors.gpkg`, where there is a pose, and `site.qgz`; `site_2.qgz` where that was edited.
    """
    folder = Path(folder)
    poses = _poses(folder)
    sensors = folder / "sensors.gpkg" if poses else None
    if sensors is not None:
        write_sensors([read_track(path).poses[-1] for path in poses], sensors)
    project = unedited_name(folder / "site.qgz")
    if project.name != "site.qgz":
        reporter.log(
            f"site.qgz was edited and stays as it is; the new project is {project.name}", "warning"
        )
    write_qgis_project(
        project, heatmap=folder / "heatmap", sensors=sensors,
        title=title or folder.resolve().name, time_zone=time_zone, source=source,
    )  # fmt: skip
    return [path for path in (sensors, project) if path is not None]


def _poses(folder: Path) -> list[Path]:
    """Return the poses of the sensors that the heat map shows, by name."""
    shown = {path.name for path in (folder / "occupancy").glob("*/")}
    found = {path.parent.name: path for path in (folder / "sensors").glob("*/track.csv")}
    found |= {path.parent.name: path for path in (folder / "sensors").glob("*/pose.json")}
    return [found[name] for name in sorted(found) if not shown or name in shown]


def _observed_box(package: Path) -> tuple[CRS, Box]:
    """Return the CRS, and the box around the tiles that were observed, or all where none was."""
    if not package.is_file():
        raise InputError(f"{package}: no such file", hint="make it with: gis-radar heatmap")
    try:
        info = pyogrio.read_info(package, layer=WIDE, force_total_bounds=True)
        _, boxes = pyogrio.read_bounds(package, layer=WIDE, where="observed_s > 0")
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, ValueError) as error:
        raise InputError(f"{package}: not a heat map: {str(error).splitlines()[0]}") from error
    crs = metric_crs(info["crs"], what=str(package))
    west, south, east, north = (float(value) for value in info["total_bounds"])
    if boxes.shape[1]:
        west, south = (float(value) for value in boxes[:2].min(axis=1))
        east, north = (float(value) for value in boxes[2:].max(axis=1))
    margin = MAP_MARGIN * max(east - west, north - south)
    return crs, (west - margin, south - margin, east + margin, north + margin)


def _time_range(package: Path) -> TimeRange | None:
    with closing(sqlite3.connect(f"{package.resolve().as_uri()}?mode=ro", uri=True)) as database:
        try:
            begin, first_end, end = database.execute(_TIMES).fetchone()
        except sqlite3.Error as error:
            raise InputError(f"{package}: not a heat map: {error}") from error
    if begin is None:
        return None
    length_s = seconds_from_iso(first_end, what="end") - seconds_from_iso(begin, what="begin")
    return TimeRange(begin=begin, end=end, step_s=round(length_s, 3))


def _local_time(played: TimeRange, time_zone: str) -> str:
    """Return the time that a project covers in local form."""
    zone = zone_of(time_zone)
    begin, end = (
        datetime.fromisoformat(text).astimezone(zone) for text in (played.begin, played.end)
    )
    clock = "%H:%M:%S" if begin.second or end.second else "%H:%M"
    day = f"%Y-%m-%d {clock}"
    last = end.strftime(clock if begin.date() == end.date() else day)
    return f"{begin.strftime(day)} \u2013 {last} ({time_zone})"


def write_project_file(path: Path, text: str) -> None:
    """Write a project; the same text gives the same file.

    Its mark is gone once QGIS, or anybody else, has saved the project.

    Parameters
    ----------
    path : Path
        Ends in `.qgz`; it appears whole or not at all.
    text : str
        XML of the project.
    """
    with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(f"{path.stem}.qgs"), text, zipfile.ZIP_DEFLATED)
        archive.comment = _mark(text.encode())


def was_edited(path: Path) -> bool:
    """Tell whether a file is there and is not just as :func:`write_project_file` left it."""
    if not path.exists():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = archive.namelist()
            return archive.comment != _mark(archive.read(name))
    except (OSError, ValueError, zipfile.BadZipFile):
        return True


def unedited_name(path: Path) -> Path:
    """Return the first of `site.qgz`, `site_2.qgz`, ... that nobody has edited."""
    numbered = (path.with_stem(f"{path.stem}_{number}") for number in itertools.count(2))
    return next(name for name in itertools.chain([path], numbered) if not was_edited(name))


def _mark(content: bytes) -> bytes:
    return _MARK + hashlib.blake2b(content, digest_size=16).hexdigest().encode()
