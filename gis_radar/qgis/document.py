"""Fill in the templates of a QGIS project and of its print layout, `project.qgs` and `sheet.qpt`.

The plugin makes its reports from the same `sheet.qpt`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from pyproj import CRS

from gis_radar.crs import Box, name_of
from gis_radar.heatmap import style
from gis_radar.heatmap.layers import LONG, WIDE
from gis_radar.poses.layers import SENSORS, UNCERTAINTY, VIEWS, read_style

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
_LIMITS = ("xmin", "ymin", "xmax", "ymax")


@dataclass(frozen=True, kw_only=True)
class LayerSource:
    """Where a layer of the template comes from, and how it looks.

    Parameters
    ----------
    path : Path
        The file.
    table : str
        Its layer, empty for a raster.
    qml : str
        Its style.
    """

    path: Path
    table: str = ""
    qml: str


@dataclass(frozen=True, kw_only=True)
class TimeRange:
    """The time that a project plays.

    Parameters
    ----------
    begin, end : str
        ISO 8601, UTC, with `Z`.
    step_s : float
        Length of an interval, seconds.
    """

    begin: str
    end: str
    step_s: float


@dataclass(frozen=True, kw_only=True)
class ProjectContent:
    """What a project shows.

    Parameters
    ----------
    title : str
        Of the project and its print layout.
    time, source : str
        Of what the layout shows, in the time of the place, and where the data come from.
    crs : CRS
        Of the project and all layers.
    box : tuple of float
        What the map shows at first, and the layout at least: west, south, east, north, metres.
    layers : mapping of str to LayerSource
        By their ids in the template; what is not here is left out.
    played : TimeRange, optional
        What the temporal controller plays.
    """

    title: str
    time: str
    source: str
    crs: CRS
    box: Box
    layers: Mapping[str, LayerSource]
    played: TimeRange | None


def sensor_layers(path: Path) -> dict[str, LayerSource]:
    """Return the layers of a file of sensors."""
    return {
        f"gis_radar_{table}": LayerSource(path=path, table=table, qml=read_style(table))
        for table in (SENSORS, UNCERTAINTY, VIEWS)
    }


def heatmap_layers(folder: Path, interval_s: float) -> dict[str, LayerSource]:
    """Return the layers of a heat map.

    Parameters
    ----------
    folder : Path
        Of the heat map.
    interval_s : float
        Length of its intervals, seconds.
    """
    package, raster = folder / "heatmap.gpkg", folder / "heatmap.tif"
    by_interval = style.vector_qml(interval_s=interval_s)
    layers = {
        "heatmap_by_interval": LayerSource(path=package, table=LONG, qml=by_interval),
        "heatmap": LayerSource(path=package, table=WIDE, qml=style.vector_qml()),
        "ground": LayerSource(path=package, table=WIDE, qml=style.ground_qml()),
    }
    if raster.is_file():
        layers["raster"] = LayerSource(path=raster, qml=style.sidecar_qml())
    return {f"gis_radar_{name}": layer for name, layer in layers.items()}


def project_xml(content: ProjectContent, home: Path) -> str:
    """Return a project as text.

    Parameters
    ----------
    content : ProjectContent
        What it shows.
    home : Path
        The project's folder: the files are named from there.
    """
    root = _template("project.qgs")
    root.set("projectname", content.title)
    _find(root, "title").text = content.title
    _find(root, "layer-tree-group/layer-tree-group[@name='Heat map']").set(
        "name", style.LEGEND_TITLE
    )
    _find(root, "Layouts").append(_sheet(content))
    _fill_layers(root, content.layers, home)
    _fill_time(root, content.played)
    _fill_place(root, content.crs, content.box)
    indent(root)
    return f"{_DOCTYPE}\n{tostring(root, encoding='unicode')}\n"


def _sheet(content: ProjectContent) -> Element:
    """Return the print layout; its layers are still to be filled in."""
    layout = _template("sheet.qpt")
    _item(layout, "title").set("labelText", content.title)
    _item(layout, "time").set("labelText", content.time)
    _item(layout, "legend").set("title", style.LEGEND_TITLE)
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


def _fill_layers(root: Element, layers: Mapping[str, LayerSource], home: Path) -> None:
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


def _source(layer: LayerSource, home: Path) -> str:
    """Return file and table as seen from the project's folder, with forward slashes."""
    path = Path(os.path.relpath(layer.path, home)).as_posix()
    named = path if path.startswith("..") else f"./{path}"
    return f"{named}|layername={layer.table}" if layer.table else named


def _fill_time(root: Element, played: TimeRange | None) -> None:
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
