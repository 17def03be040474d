"""The XML of a QGIS project: layers in groups, their styles, the view and the time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from pyproj import CRS

from gis_radar.crs import name_of
from gis_radar.heatmap.layers import LONG, WIDE
from gis_radar.heatmap.style import LEGEND_TITLE
from gis_radar.qgis.layers import Group, Layer
from gis_radar.qgis.sheet import Sheet, layout_element

VERSION = "3.34.0"
_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
_ANIMATED = "1"
# The figures of the map's time are UTC, whatever QGIS takes them for.
_LOCAL_TIME = (
    "format_date(datetime_from_epoch(epoch(to_datetime("
    "format_date({moment}, 'yyyy-MM-ddTHH:mm:ss') || 'Z'))), '{form}')"
)


@dataclass(frozen=True, kw_only=True)
class Span:
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
class View:
    """What the map shows at first.

    Parameters
    ----------
    crs : CRS
        Of the project.
    box : tuple of float
        West, south, east, north, metres.
    """

    crs: CRS
    box: tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Texts:
    """What is written around the map.

    Parameters
    ----------
    title : str
        Of the project and its print layout.
    time, source : str
        Of what the layout shows, and where it comes from.
    """

    title: str
    time: str = ""
    source: str = ""


def project_xml(
    texts: Texts, groups: Sequence[Group], view: View, span: Span | None, home: Path
) -> str:
    """Return a project as text.

    Parameters
    ----------
    texts : Texts
        Of the project.
    groups : sequence of Group
        Top to bottom.
    view : View
        Where the map begins.
    span : Span, optional
        What the temporal controller plays.
    home : Path
        The project's folder: the files are named from there.
    """
    root = Element("qgis", version=VERSION, projectname=texts.title)
    SubElement(root, "homePath", path="")
    SubElement(root, "title").text = texts.title
    _add_crs(SubElement(root, "projectCrs"), view.crs)
    tree = SubElement(root, "layer-tree-group")
    drawn = SubElement(root, "projectlayers")
    keys: dict[str, Layer] = {}
    for number, group in enumerate(groups):
        branch = SubElement(
            tree, "layer-tree-group", name=group.name, checked="Qt::Checked", expanded="1"
        )
        for place, layer in enumerate(group.layers):
            key = f"gis_radar_layer_{number}_{place}"  # QGIS drops ids of up to ten letters
            keys[key] = layer
            _add_leaf(branch, layer, key, home)
            _add_layer(drawn, layer, key, view.crs, home)
    _add_canvas(root, view)
    _add_properties(root, span)
    _add_view(root, view)
    if span is not None:
        _add_span(root, span)
    _add_layout(root, texts, keys, view, home)
    indent(root)
    return f"{_DOCTYPE}\n{tostring(root, encoding='unicode')}\n"


def _add_crs(parent: Element, crs: CRS) -> None:
    system = SubElement(parent, "spatialrefsys", nativeFormat="Wkt")
    SubElement(system, "wkt").text = crs.to_wkt()
    name = name_of(crs)
    SubElement(system, "authid").text = name if name.count(":") == 1 else ""


def _source(layer: Layer, home: Path) -> str:
    """Return file and table as seen from the project's folder, with forward slashes."""
    path = Path(os.path.relpath(layer.path, home)).as_posix()
    named = path if path.startswith("..") else f"./{path}"
    return f"{named}|layername={layer.table}" if layer.table else named


def _add_leaf(branch: Element, layer: Layer, key: str, home: Path) -> None:
    SubElement(
        branch, "layer-tree-layer", id=key, name=layer.name, source=_source(layer, home),
        providerKey=layer.provider, expanded=str(int(layer.shown)),
        checked="Qt::Checked" if layer.shown else "Qt::Unchecked",
    )  # fmt: skip


def _add_layer(drawn: Element, layer: Layer, key: str, crs: CRS, home: Path) -> None:
    element = SubElement(drawn, "maplayer", styleCategories="AllStyleCategories")
    if layer.table:
        element.attrib |= {"type": "vector", "geometry": layer.geometry, "labelsEnabled": "1"}
    else:
        element.set("type", "raster")
    SubElement(element, "id").text = key
    SubElement(element, "datasource").text = _source(layer, home)
    SubElement(element, "layername").text = layer.name
    _add_crs(SubElement(element, "srs"), crs)
    SubElement(element, "provider", encoding="UTF-8").text = layer.provider
    element.extend(part for part in layer.style() if part.tag != "layerGeometryType")


def _add_canvas(root: Element, view: View) -> None:
    canvas = SubElement(root, "mapcanvas", name="theMapCanvas", annotationsVisible="1")
    SubElement(canvas, "units").text = "meters"
    extent = SubElement(canvas, "extent")
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), view.box, strict=True):
        SubElement(extent, name).text = f"{value:.3f}"
    SubElement(canvas, "rotation").text = "0"
    _add_crs(SubElement(canvas, "destinationsrs"), view.crs)


def _add_properties(root: Element, span: Span | None) -> None:
    properties = SubElement(root, "properties")
    _add_value(SubElement(properties, "Paths"), "Absolute", "bool", "false")
    _add_value(SubElement(properties, "SpatialRefSys"), "ProjectionsEnabled", "int", "1")
    if span is None:
        return
    widget = SubElement(properties, "TemporalControllerWidget")
    _add_value(widget, "NavigationMode", "int", _ANIMATED)
    _add_value(widget, "StartDateTime", "QString", span.begin)
    _add_value(widget, "EndDateTime", "QString", span.end)
    clock = SubElement(properties, "TitleLabel")
    _add_value(clock, "Enabled", "bool", "true")
    _add_value(clock, "Label", "QString", _clock(span))
    _add_value(clock, "Placement", "int", "2")
    _add_value(clock, "BackgroundColor", "QString", "255,255,255,215")
    _add_value(clock, "MarginH", "int", "1")
    _add_value(clock, "MarginV", "int", "1")


def _clock(span: Span) -> str:
    """Return the text on the map that says the local time of what is shown."""
    short = "HH:mm" if span.step_s % 60 == 0 else "HH:mm:ss"
    begin = _LOCAL_TIME.format(moment="@map_start_time", form=f"ddd yyyy-MM-dd {short}")
    end = _LOCAL_TIME.format(moment="@map_end_time", form=short)
    return f"[% coalesce({begin} || ' - ' || {end}, '') %]"


def _add_value(parent: Element, name: str, kind: str, value: str) -> None:
    SubElement(parent, name, type=kind).text = value


def _add_view(root: Element, view: View) -> None:
    settings = SubElement(root, "ProjectViewSettings", UseProjectScales="0")
    names = ("xmin", "ymin", "xmax", "ymax")
    box = {name: f"{value:.3f}" for name, value in zip(names, view.box, strict=True)}
    _add_crs(SubElement(settings, "DefaultViewExtent", box), view.crs)


def _add_span(root: Element, span: Span) -> None:
    minutes = span.step_s % 60 == 0
    step = span.step_s / 60 if minutes else span.step_s
    settings = SubElement(
        root, "ProjectTimeSettings", timeStepUnit="min" if minutes else "s",
        timeStep=f"{step:g}", frameRate="1", cumulativeTemporalRange="0",
    )  # fmt: skip
    limits = SubElement(settings, "TemporalRange")
    SubElement(limits, "start").text = span.begin
    SubElement(limits, "end").text = span.end


def _add_layout(
    root: Element, texts: Texts, keys: dict[str, Layer], view: View, home: Path
) -> None:
    """Add a sheet of the whole time: what is by interval or pixels does not go onto it."""
    drawn = {
        key: layer for key, layer in keys.items() if layer.table and layer.table != LONG
    }  # fmt: skip
    # Occupancy first, its ground next, then the sensors.
    legend = sorted(drawn, key=lambda key: drawn[key].table != WIDE)
    sheet = Sheet(
        title=texts.title, time=texts.time, source=texts.source, box=view.box, drawn=drawn,
        legend=legend, legend_title=LEGEND_TITLE,
    )  # fmt: skip
    sources = {key: _source(layer, home) for key, layer in drawn.items()}
    SubElement(root, "Layouts").append(layout_element(sheet, sources))
