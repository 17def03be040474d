"""Fill in the templates of a QGIS project and its print layout: `project.qgs` and `sheet.qpt`."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from pyproj import CRS

from gis_radar.base import (
    Box,
    class_label,
    column_title,
    name_of,
    translated,
    utc_offsets,
    zone_of,
)
from gis_radar.products.heatmap import style

_FRAMES_A_SECOND = "2"  # steps of 0.5 s: vehicles move in real time
_DATE = {"en": "yyyy-MM-dd", "de": "dd.MM.yyyy"}
_LEGEND_WIDTH = 28  # letters that fit beside the map
_LIMITS = ("xmin", "ymin", "xmax", "ymax")


class LayerSource(NamedTuple):
    """Source and style of a layer of the template; a raster has no table."""

    path: Path
    qml: str
    table: str = ""


class TimeRange(NamedTuple):
    """Time range that a project plays: ISO 8601 in UTC, steps in seconds, time zone."""

    begin: str
    end: str
    step_s: float
    timezone: str = "UTC"


class ProjectContent(NamedTuple):
    """Content of a project; its layers are named by their ids in the template."""

    title: str
    time: str
    source: str
    crs: CRS
    box: Box
    layers: Mapping[str, LayerSource]
    played: TimeRange
    measure: str
    language: str

    def word(self, text: str) -> str:
        """Return a text in the language of the project."""
        return translated(text, self.language)


def project_xml(content: ProjectContent, home: Path) -> str:
    """Return a project as text; its files are named from its folder."""
    root = _template("project.qgs")
    root.set("projectname", content.title)
    _element_at(root, "title").text = content.title
    _element_at(root, "layer-tree-group/layer-tree-group[@name='Heat map']").set(
        "name", style.MAP_WORDS[content.measure].title
    )
    _element_at(root, "Layouts").append(_sheet(content))
    _fill_layers(root, content.layers, home)
    _fill_time(root, content.played, content.language)
    if "gis_radar_footprints" in content.layers:
        _element_at(root, "ProjectTimeSettings").set("frameRate", _FRAMES_A_SECOND)
    _fill_crs_and_extent(root, content.crs, content.box)
    if content.measure != "hit_share":
        _rename_layers(root, content.measure)
    _translate(root, content.language)
    indent(root)
    heading = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    return f"{heading}\n{tostring(root, encoding='unicode')}\n"


def _rename_layers(root: Element, measure: str) -> None:
    """Rename the layers of the template, which are of hit share, to another measure."""
    for element in root.iter():
        if element.tag == "alias":
            continue  # of the field `hit_share`, which stands beside occupancy
        if (name := element.get("name", "")).startswith("Hit share"):
            element.set("name", name.replace("Hit share", measure.capitalize()))
        if element.tag == "layername" and (element.text or "").startswith("Hit share"):
            element.text = (element.text or "").replace("Hit share", measure.capitalize())


_NAMED = {"layer-tree-group", "layer-tree-layer"}
_NUMBER = re.compile(r"format_number\(.*?, \d+(?=\))")
_LABELLED = {"category", "range", "rule", "item"}  # classes of a legend, of vectors and rasters


def _translate(root: Element, language: str) -> None:
    """Translate names of layers and fields, labels of classes and formats of dates."""
    for element in root.iter():
        if element.tag in _NAMED and "name" in element.attrib:
            element.set("name", translated(element.attrib["name"], language))
        elif element.tag == "layername":
            element.text = translated(element.text or "", language)
        elif element.tag == "alias":
            element.set("name", column_title(element.get("name", ""), language))
        elif element.tag in _LABELLED and element.get("label"):
            element.set("label", class_label(element.attrib["label"], language))
        elif element.tag == "text-style" and "format_number" in element.get("fieldName", ""):
            element.set("fieldName", _numbers_in(element.attrib["fieldName"], language))


def _numbers_in(expression: str, language: str) -> str:
    """Return a label's expression with numbers in a language, which may differ from QGIS's."""
    return _NUMBER.sub(rf"\g<0>, '{language}'", expression)


def _sheet(content: ProjectContent) -> Element:
    """Return the print layout; its layers are still to be filled in."""
    layout = _template("sheet.qpt")
    _item(layout, "title").set("labelText", unevaluated(content.title))
    _item(layout, "time").set("labelText", unevaluated(content.time))
    layout.set("name", content.word(layout.get("name", "")))
    title, subtitle = (content.word(each) for each in style.MAP_WORDS[content.measure][:2])
    lines = [title, *textwrap.wrap(subtitle, _LEGEND_WIDTH)]
    _item(layout, "legend").set("title", "|".join(lines))  # the wrap character of the legend
    today = f"[% format_date(now(), '{_DATE[content.language]}') %]"
    _item(layout, "made").set("labelText", f"{content.word('Made with gis_radar')}, {today}")
    if content.source:
        _item(layout, "source").set(
            "labelText", f"{content.word('Source')}: {unevaluated(content.source)}"
        )
    else:
        layout.remove(_item(layout, "source"))
    _keep_explanation(layout, content)
    chart = _item(layout, "map")
    width, height, _ = chart.attrib["size"].split(",")
    box = fit_box(content.box, float(width), float(height))
    _element_at(chart, "Extent").attrib |= _extent_values(box)
    return layout


def _keep_explanation(layout: Element, content: ProjectContent) -> None:
    """Keep on the sheet only the explanation of its measure, in its language."""
    for measure in style.MAP_WORDS:
        item = _item(layout, f"meaning {measure}")
        if measure != content.measure:
            layout.remove(item)
        else:
            item.set("labelText", content.word(item.get("labelText", "")))


def unevaluated(text: str) -> str:
    """Escape a text so that QGIS does not evaluate anything between `[%` and `%]` in it."""
    return text.replace("[%", "[% '[' || '%' %]")


def fit_box(box: Box, width: float, height: float) -> Box:
    """Return the smallest box around another, with the same middle and a given aspect."""
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
            _element_at(element, "datasource").text = _source(layer, home)
            body = layer.qml[layer.qml.index("<qgis") :]
            parts = fromstring(body)  # noqa: S314 - our own text
            element.extend(part for part in parts if part.tag != "layerGeometryType")
        else:
            element.set("source", _source(layer, home))
    tree = _element_at(root, "layer-tree-group")
    for group in tree.findall("layer-tree-group"):
        if len(group) == 0:
            tree.remove(group)


def _layer_elements(root: Element) -> Iterator[tuple[Element, Element, str]]:
    """Yield the elements that refer to a layer, each with its parent and the layer's id."""
    for parent in root.iter():
        for element in parent:
            if element.tag == "maplayer":
                yield parent, element, element.findtext("id", "")
            elif element.tag == "layer-tree-layer":
                yield parent, element, element.get("id", "")
            elif element.tag == "Layer":
                yield parent, element, element.text or ""


def _source(layer: LayerSource, home: Path) -> str:
    """Return file and table relative to the project's folder, with forward slashes."""
    path = Path(os.path.relpath(layer.path, home)).as_posix()
    named = path if path.startswith("..") else f"./{path}"
    return f"{named}|layername={layer.table}" if layer.table else named


def _fill_time(root: Element, played: TimeRange, language: str) -> None:
    settings, properties = _element_at(root, "ProjectTimeSettings"), _element_at(root, "properties")
    controller = _element_at(properties, "TemporalControllerWidget")
    clock = _element_at(properties, "TitleLabel")
    for begin in (
        _element_at(settings, "TemporalRange/start"),
        _element_at(controller, "StartDateTime"),
    ):
        begin.text = played.begin
    for end in (_element_at(settings, "TemporalRange/end"), _element_at(controller, "EndDateTime")):
        end.text = played.end
    minutes = played.step_s % 60 == 0
    _element_at(clock, "Label").text = map_clock(played, language)
    step = played.step_s / 60 if minutes else played.step_s
    settings.attrib |= {"timeStep": f"{step:g}", "timeStepUnit": "min" if minutes else "s"}


_FIGURES = "yyyy-MM-ddTHH:mm:ss"  # format of the map's time, whose figures are UTC
_TIMED = ("gis_radar_by_interval", "gis_radar_footprints")  # layers that have a time


def map_clock(played: TimeRange, language: str) -> str:
    """Return the text on the map: the time that it shows by the site's clock, with its zone.

    As expressions of QGIS have no time zones, it holds the zone's offsets. It is empty while no
    layer with a time is shown.
    """
    zone = zone_of(played.timezone)
    begin, end = (datetime.fromisoformat(text) for text in (played.begin, played.end))
    offsets = utc_offsets(zone, begin, end + timedelta(days=1))
    clock = "HH:mm" if played.step_s % 60 == 0 else "HH:mm:ss"

    def local(name: str, pattern: str) -> str:
        utc = f"format_date(@{name}, '{_FIGURES}')"
        shift = _by_time(utc, [(since, f"{offset} seconds") for since, offset in offsets])
        moved = f"to_datetime({utc} || 'Z') + to_interval({shift})"
        return f"format_date({moved}, '{pattern}', '{language}')"

    day = f"ddd {_DATE[language]} {clock}"
    named = played.timezone if played.timezone != "UTC" else ""
    texts = [(since, _zone_text(named, offset)) for since, offset in offsets]
    parts = [local("map_start_time", day)]
    if played.step_s >= 1.0:  # else the clocks of begin and end would be the same
        parts += ["' - '", local("map_end_time", clock)]
    parts.append(_by_time(f"format_date(@map_start_time, '{_FIGURES}')", texts))
    shown = " or ".join(f"array_contains(@map_layer_ids, '{each}')" for each in _TIMED)
    return f"[% if({shown}, coalesce({' || '.join(parts)}, ''), '') %]"


def _zone_text(name: str, offset_s: int) -> str:
    """Return the end of the text on the map: the zone by name and offset."""
    if not name:
        return " (UTC)"
    minutes = abs(offset_s) // 60
    return f" ({name}, UTC{'-' if offset_s < 0 else '+'}{minutes // 60:02d}:{minutes % 60:02d})"


def _by_time(figures: str, values: list[tuple[datetime, str]]) -> str:
    """Return an expression of the value that holds at a time, given by its figures in UTC."""
    text = f"'{values[-1][1]}'"
    for (_, value), (since, _) in reversed(list(pairwise(values))):
        text = f"if({figures} < '{since:%Y-%m-%dT%H:%M:%S}', '{value}', {text})"
    return text


def _fill_crs_and_extent(root: Element, crs: CRS, box: Box) -> None:
    for name, value in _extent_values(box).items():
        _element_at(root, f"mapcanvas/extent/{name}").text = value
    _element_at(root, "ProjectViewSettings/DefaultViewExtent").attrib |= _extent_values(box)
    name = name_of(crs)
    for system in root.iter("spatialrefsys"):
        SubElement(system, "wkt").text = crs.to_wkt()
        SubElement(system, "authid").text = name if name.count(":") == 1 else ""


def _extent_values(box: Box) -> dict[str, str]:
    return {name: f"{value:.3f}" for name, value in zip(_LIMITS, box, strict=True)}


def _template(name: str) -> Element:
    text = (files(__package__) / name).read_text(encoding="utf-8")
    return fromstring(text)  # noqa: S314 - our own file


def _item(layout: Element, name: str) -> Element:
    return _element_at(layout, f"LayoutItem[@id='{name}']")


def _element_at(root: Element, path: str) -> Element:
    """Return an element of one of our templates, which has it."""
    found = root.find(path)
    if found is None:
        raise LookupError(f"the template has no {path}")
    return found
