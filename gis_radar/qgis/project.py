"""Write the QGIS project of a folder of results: fill in `project.qgs` and `sheet.qpt`.

The plugin makes its reports from the same `sheet.qpt`.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import sqlite3
import textwrap
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import closing
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

import pyogrio
from pyproj import CRS

from gis_radar.crs import Box, metric_crs, name_of
from gis_radar.errors import InputError, OutputError, UsageError
from gis_radar.files import whole_file
from gis_radar.geopackage import read_styles
from gis_radar.heatmap import style
from gis_radar.heatmap.step_table import LONG, TIMES, WIDE
from gis_radar.occupancy import read_occupancy
from gis_radar.occupancy.views import sight_of_views
from gis_radar.poses.files import read_track
from gis_radar.poses.layers import SENSORS, UNCERTAINTY, VIEWS, read_style, write_sensors
from gis_radar.poses.pose import pose_from_dict
from gis_radar.progress import QUIET, Reporter
from gis_radar.sight import SightTiles, write_sights
from gis_radar.sight.layers import SIGHT_LAYER
from gis_radar.steps import seconds_from_iso, zone_of
from gis_radar.tiles.tiles import read_tiles
from gis_radar.vehicles import read_vehicles
from gis_radar.vehicles.layer import (
    FOOTPRINTS,
    LAYER_DEFAULTS,
    footprint_style,
    write_footprints,
)

MAP_MARGIN = 0.05
"""Around what was observed, as a share of its size: the road goes on a little to each side."""

_MARK = b"gis_radar "
_TIMES = f'SELECT min("begin"), min("end"), max("end") FROM "{TIMES}"'  # noqa: S608 - our own name


def write_qgis_project(
    path: str | Path,
    *,
    heatmap: str | Path,
    sensors: str | Path | None = None,
    sight: str | Path | None = None,
    footprints: str | Path | None = None,
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
    sight : str or Path, optional
        GeoPackage of :func:`gis_radar.write_sights`: what the sensors see, off at first.
    footprints : str or Path, optional
        GeoPackage of :func:`gis_radar.write_footprints`: the project then plays single vehicles,
        half second by half second.
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
    measure = _measure(package)
    layers = _heatmap_layers(Path(heatmap).resolve(), measure)
    if sensors is not None:
        layers |= _sensor_layers(Path(sensors).resolve())
    if sight is not None:
        qml = files("gis_radar.sight").joinpath("sight.qml").read_text(encoding="utf-8")
        layers["gis_radar_sight"] = _LayerSource(Path(sight).resolve(), qml, SIGHT_LAYER)
    if footprints is not None:
        layers["gis_radar_footprints"] = _LayerSource(
            Path(footprints).resolve(), footprint_style(), FOOTPRINTS
        )
        played = played and played._replace(step_s=LAYER_DEFAULTS.shown_s)
    content = _ProjectContent(
        title=title or path.stem, time=_local_time(played, time_zone) if played else "",
        source=source, crs=crs, box=box, layers=layers, played=played, measure=measure,
    )  # fmt: skip
    _write_project_file(path, _project_xml(content, path.resolve().parent))


def write_site_project(
    folder: str | Path,
    *,
    footprints: bool = False,
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
    footprints : bool
        Whether the single vehicles of `vehicles/` are written as a layer that the project plays;
        without it, an earlier such layer is deleted.
    title : str
        Of the project; by default the folder's name.
    time_zone, source : str
        As :func:`write_qgis_project` takes them.
    reporter : Reporter
        Receives a warning where an edited project is in the way.

    Returns
    -------
    list of Path
        `sensors.gpkg`, where there is a pose, `sight.gpkg`, where there are occupancies,
        `footprints.gpkg`, where they are asked for and there are vehicles, and `site.qgz`;
        `site_2.qgz` where that was edited.
    """
    folder = Path(folder)
    poses = _poses(folder)
    sensors = folder / "sensors.gpkg" if poses else None
    if sensors is not None:
        write_sensors([read_track(path).poses[-1] for path in poses], sensors)
    sight = _write_sight(folder)
    vehicles = _write_footprints(folder, asked=footprints, reporter=reporter)
    numbered = (folder / f"site_{number}.qgz" for number in itertools.count(2))
    names = itertools.chain([folder / "site.qgz"], numbered)
    project = next(name for name in names if not was_edited(name))
    if project.name != "site.qgz":
        reporter.log(
            f"site.qgz was edited and stays as it is; the new project is {project.name}", "warning"
        )
    write_qgis_project(
        project, heatmap=folder / "heatmap", sensors=sensors, sight=sight, footprints=vehicles,
        title=title or folder.resolve().name, time_zone=time_zone, source=source,
    )  # fmt: skip
    return [path for path in (sensors, sight, vehicles, project) if path is not None]


def _write_sight(folder: Path) -> Path | None:
    """Write what the sensors see, as their occupancies have it; None where there are none."""
    found = [
        read_occupancy(path.parent) for path in sorted(folder.glob("occupancy/*/manifest.json"))
    ]
    if not found or not (folder / "tiles.gpkg").is_file():
        return None
    tiles = read_tiles(folder / "tiles.gpkg")
    road = SightTiles.of(tiles)
    sights = [
        sight_of_views(
            each.views, pose_from_dict(each.sources[-1]["poses"][-1], what=each.place), road
        )
        for each in found
    ]
    write_sights(sights, tiles, folder / "sight.gpkg")
    return folder / "sight.gpkg"


def _write_footprints(folder: Path, *, asked: bool, reporter: Reporter) -> Path | None:
    """Write the layer of single vehicles; None where it is not asked for, or there are none."""
    path, vehicles = folder / f"{FOOTPRINTS}.gpkg", folder / "vehicles"
    if not asked or not vehicles.is_dir():
        path.unlink(missing_ok=True)
        return None
    write_footprints(read_vehicles(vehicles), path, reporter=reporter)
    return path


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


def _time_range(package: Path) -> _TimeRange | None:
    with closing(sqlite3.connect(f"{package.resolve().as_uri()}?mode=ro", uri=True)) as database:
        try:
            begin, first_end, end = database.execute(_TIMES).fetchone()
        except sqlite3.Error as error:
            raise InputError(f"{package}: not a heat map: {error}") from error
    if begin is None:
        return None
    length_s = seconds_from_iso(first_end, what="end") - seconds_from_iso(begin, what="begin")
    return _TimeRange(begin, end, round(length_s, 3))


def _local_time(played: _TimeRange, time_zone: str) -> str:
    """Return the time that a project covers in local form."""
    zone = zone_of(time_zone)
    begin, end = (
        datetime.fromisoformat(text).astimezone(zone) for text in (played.begin, played.end)
    )
    clock = "%H:%M:%S" if begin.second or end.second else "%H:%M"
    day = f"%Y-%m-%d {clock}"
    last = end.strftime(clock if begin.date() == end.date() else day)
    return f"{begin.strftime(day)} \u2013 {last} ({time_zone})"


def _write_project_file(path: Path, text: str) -> None:
    """Write a project; the same text gives the same file.

    Its mark is gone once QGIS, or anybody else, has saved the project.
    """
    with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(f"{path.stem}.qgs"), text, zipfile.ZIP_DEFLATED)
        archive.comment = _mark(text.encode())


def was_edited(path: Path) -> bool:
    """Return whether a file is there and not as :func:`write_qgis_project` left it."""
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


# The project as XML.

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
_FRAMES_A_SECOND = "2"  # vehicles move as fast as they drove
_LEGEND_WIDTH = 28  # letters that fit beside the map
_LIMITS = ("xmin", "ymin", "xmax", "ymax")


class _LayerSource(NamedTuple):
    """Where a layer of the template comes from, and how it looks; a raster has no table."""

    path: Path
    qml: str
    table: str = ""


class _TimeRange(NamedTuple):
    """The time that a project plays: ISO 8601 in UTC, and the length of its steps, seconds."""

    begin: str
    end: str
    step_s: float


class _ProjectContent(NamedTuple):
    """What a project shows; its layers are named by their ids in the template."""

    title: str
    time: str
    source: str
    crs: CRS
    box: Box
    layers: Mapping[str, _LayerSource]
    played: _TimeRange | None
    measure: str


def _sensor_layers(path: Path) -> dict[str, _LayerSource]:
    """Return the layers of a file of sensors."""
    return {
        f"gis_radar_{table}": _LayerSource(path, read_style(table), table)
        for table in (SENSORS, UNCERTAINTY, VIEWS)
    }


def _measure(package: Path) -> str:
    """Return what a heat map shows: coverage, where it was made with vehicles."""
    fields = pyogrio.read_info(package, layer=WIDE)["fields"]
    return "coverage" if "coverage" in fields else "occupancy"


def _heatmap_layers(folder: Path, measure: str) -> dict[str, _LayerSource]:
    """Return the layers of a heat map, as their own file styles them."""
    package, raster = folder / "heatmap.gpkg", folder / "heatmap.tif"
    qml = read_styles(package)
    layers = {
        "heatmap_by_interval": _LayerSource(package, qml[LONG], LONG),
        "heatmap": _LayerSource(package, qml[WIDE], WIDE),
        "ground": _LayerSource(package, style.ground_qml(), WIDE),
    }
    if raster.is_file():
        layers["raster"] = _LayerSource(raster, style.sidecar_qml(measure))
    return {f"gis_radar_{name}": layer for name, layer in layers.items()}


def _project_xml(content: _ProjectContent, home: Path) -> str:
    """Return a project as text; its files are named from its folder."""
    root = _template("project.qgs")
    root.set("projectname", content.title)
    _find(root, "title").text = content.title
    _find(root, "layer-tree-group/layer-tree-group[@name='Heat map']").set(
        "name", style.WORDS[content.measure].title
    )
    _find(root, "Layouts").append(_sheet(content))
    _fill_layers(root, content.layers, home)
    _fill_time(root, content.played)
    if "gis_radar_footprints" in content.layers:
        _find(root, "ProjectTimeSettings").set("frameRate", _FRAMES_A_SECOND)
    _fill_place(root, content.crs, content.box)
    if content.measure != "occupancy":
        _rename_layers(root, content.measure)
    indent(root)
    return f"{_DOCTYPE}\n{tostring(root, encoding='unicode')}\n"


def _rename_layers(root: Element, measure: str) -> None:
    """Call the layers of the template, which are of occupancy, by another measure."""
    for element in root.iter():
        if (name := element.get("name", "")).startswith("Occupancy"):
            element.set("name", name.replace("Occupancy", measure.capitalize()))
        if element.tag == "layername" and (element.text or "").startswith("Occupancy"):
            element.text = (element.text or "").replace("Occupancy", measure.capitalize())


def _sheet(content: _ProjectContent) -> Element:
    """Return the print layout; its layers are still to be filled in."""
    layout = _template("sheet.qpt")
    _item(layout, "title").set("labelText", content.title)
    _item(layout, "time").set("labelText", content.time)
    words = style.WORDS[content.measure]
    lines = [words.title, *textwrap.wrap(words.subtitle, _LEGEND_WIDTH)]
    _item(layout, "legend").set("title", "|".join(lines))  # the wrap character of the legend
    if content.source:
        _item(layout, "source").set("labelText", f"Source: {content.source}")
    else:
        layout.remove(_item(layout, "source"))
    chart = _item(layout, "map")
    width, height, _ = chart.attrib["size"].split(",")
    box = fit_box(content.box, float(width), float(height))
    _find(chart, "Extent").attrib |= _limits(box)
    return layout


def fit_box(box: Box, width: float, height: float) -> Box:
    """Return the smallest box around another, with the same middle, that has a given shape."""
    west, south, east, north = box
    scale = max((east - west) / width, (north - south) / height)
    x, y = (west + east) / 2, (south + north) / 2
    half, high = scale * width / 2, scale * height / 2
    return x - half, y - high, x + half, y + high


def _fill_layers(root: Element, layers: Mapping[str, _LayerSource], home: Path) -> None:
    for parent, element, key in list(_layer_elements(root)):
        layer = layers.get(key)
        if layer is None:
            parent.remove(element)
        elif element.tag == "maplayer":
            _find(element, "datasource").text = _source(layer, home)
            body = layer.qml[layer.qml.index("<qgis") :]
            parts = fromstring(body)  # noqa: S314 - our own text
            element.extend(part for part in parts if part.tag != "layerGeometryType")
        else:
            element.set("source", _source(layer, home))
    tree = _find(root, "layer-tree-group")
    for group in tree.findall("layer-tree-group"):
        if len(group) == 0:
            tree.remove(group)


def _layer_elements(root: Element) -> Iterator[tuple[Element, Element, str]]:
    """Yield what stands for a layer, with its parent and its id."""
    for parent in root.iter():
        for element in parent:
            if element.tag == "maplayer":
                yield parent, element, element.findtext("id", "")
            elif element.tag == "layer-tree-layer":
                yield parent, element, element.get("id", "")
            elif element.tag == "Layer":
                yield parent, element, element.text or ""


def _source(layer: _LayerSource, home: Path) -> str:
    """Return file and table as seen from the project's folder, with forward slashes."""
    path = Path(os.path.relpath(layer.path, home)).as_posix()
    named = path if path.startswith("..") else f"./{path}"
    return f"{named}|layername={layer.table}" if layer.table else named


def _fill_time(root: Element, played: _TimeRange | None) -> None:
    settings, properties = _find(root, "ProjectTimeSettings"), _find(root, "properties")
    controller = _find(properties, "TemporalControllerWidget")
    clock = _find(properties, "TitleLabel")
    if played is None:
        root.remove(settings)
        properties.remove(controller)
        properties.remove(clock)
        return
    for begin in (_find(settings, "TemporalRange/start"), _find(controller, "StartDateTime")):
        begin.text = played.begin
    for end in (_find(settings, "TemporalRange/end"), _find(controller, "EndDateTime")):
        end.text = played.end
    label = _find(clock, "Label")
    minutes = played.step_s % 60 == 0
    label.text = (label.text or "").replace("CLOCK", "HH:mm" if minutes else "HH:mm:ss")
    if played.step_s < 1.0:  # the clock of the begin and that of the end would be the same
        label.text = (label.text or "").partition(" || ' - '")[0] + ", '') %]"
    step = played.step_s / 60 if minutes else played.step_s
    settings.attrib |= {"timeStep": f"{step:g}", "timeStepUnit": "min" if minutes else "s"}


def _fill_place(root: Element, crs: CRS, box: Box) -> None:
    for name, value in _limits(box).items():
        _find(root, f"mapcanvas/extent/{name}").text = value
    _find(root, "ProjectViewSettings/DefaultViewExtent").attrib |= _limits(box)
    name = name_of(crs)
    for system in root.iter("spatialrefsys"):
        SubElement(system, "wkt").text = crs.to_wkt()
        SubElement(system, "authid").text = name if name.count(":") == 1 else ""


def _limits(box: Box) -> dict[str, str]:
    return {name: f"{value:.3f}" for name, value in zip(_LIMITS, box, strict=True)}


def _template(name: str) -> Element:
    text = (files(__package__) / name).read_text(encoding="utf-8")
    return fromstring(text)  # noqa: S314 - our own file


def _item(layout: Element, name: str) -> Element:
    return _find(layout, f"LayoutItem[@id='{name}']")


def _find(root: Element, path: str) -> Element:
    found = root.find(path)
    if found is None:
        raise LookupError(f"the template has no {path}")
    return found
