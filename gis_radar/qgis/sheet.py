"""The print layout of a project: map, legend, scale bar, north arrow, title, time and source."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

from gis_radar.poses.style import legend_symbol
from gis_radar.qgis.layers import Layer

NAME = "Report"
_PAGE, _MAP, _PICTURE, _LABEL, _LEGEND, _SCALE_BAR = 65638, 65639, 65640, 65641, 65642, 65646
_WIDTH_MM, _HEIGHT_MM, _MARGIN_MM = 297.0, 210.0, 10.0  # A4, landscape
_SIDE_MM, _HEAD_MM, _FOOT_MM = 58.0, 20.0, 8.0
MAP_MM = (
    _WIDTH_MM - 2 * _MARGIN_MM - _SIDE_MM - 4,
    _HEIGHT_MM - 2 * _MARGIN_MM - _HEAD_MM - _FOOT_MM,
)
_INK, _SOFT = (17, 24, 39), (75, 85, 99)
_MAP_KEY, _PAGE_KEY = "{gis_radar_map}", "{gis_radar_page}"
_NORTH = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 20 24" width="400" height="480">
<path d="M10 7l5 16-5-4-5 4z" fill="#111827"/><path d="M10 7v12l5 4z" fill="#9ca3af"/>
<path d="M7.7 5.2V.8l4.6 4.4V.8" fill="none" stroke="#111827" stroke-width="1.2"/></svg>"""
# A segment of 1, 2 or 5 times a power of ten, at most 22 mm long, whatever the map's scale.
_SEGMENT = (
    "with_variable('most', map_get(item_variables('map'), 'map_scale') * 0.022, "
    "with_variable('power', 10 ^ floor(log10(@most)), "
    "@power * if(@most / @power >= 5, 5, if(@most / @power >= 2, 2, 1))))"
)
_EXPRESSION = "3"


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """What the layout says.

    Parameters
    ----------
    title : str
        Its heading.
    time : str
        Of what is shown, in the time of the place.
    source : str
        Where the data come from; empty where nobody said.
    box : tuple of float
        What the map shows at least: west, south, east, north, metres.
    drawn : mapping of str to Layer
        The layers of the map by their ids in the project, top to bottom.
    legend : sequence of str
        Ids of those that the legend explains, top to bottom.
    legend_title : str
        Heading of the legend.
    """

    title: str
    time: str
    source: str
    box: tuple[float, float, float, float]
    drawn: Mapping[str, Layer]
    legend: Sequence[str]
    legend_title: str


def layout_element(sheet: Sheet, sources: Mapping[str, str]) -> Element:
    """Return the layout as a project holds it.

    Parameters
    ----------
    sheet : Sheet
        What is on it.
    sources : mapping
        File and table of each layer, by its id.
    """
    layout = Element("Layout", name=NAME, units="mm", printResolution="300")
    _add_page(layout)
    width = _WIDTH_MM - 2 * _MARGIN_MM
    _add_map(layout, sheet, sources)
    _add_label(
        layout,
        sheet.title,
        (_MARGIN_MM, _MARGIN_MM - 1, width, 9),
        size=18,
        name="title",
        bold=True,
    )
    _add_label(layout, sheet.time, (_MARGIN_MM, _MARGIN_MM + 9, width, 7), size=12, name="time")
    left, top = _WIDTH_MM - _MARGIN_MM - _SIDE_MM, _MARGIN_MM + _HEAD_MM
    _add_north(layout, (left, top, 12, 15))
    _add_scale_bar(layout, (left, top + 19, _SIDE_MM, 12))
    _add_legend(layout, sheet, sources, (left - 2, top + 34, _SIDE_MM, 100))
    foot = _HEIGHT_MM - _MARGIN_MM - _FOOT_MM + 3
    if sheet.source:
        _add_label(
            layout,
            f"Source: {sheet.source}",
            (_MARGIN_MM, foot, width - 62, 8),
            size=8,
            name="source",
        )
    made = "Made with gis_radar, [% format_date(now(), 'yyyy-MM-dd') %]"
    _add_label(layout, made, (left, foot, _SIDE_MM, 8), size=8, name="made", to_right=True)
    return layout


def _add_page(layout: Element) -> None:
    pages = SubElement(layout, "PageCollection")
    page = _item(pages, _PAGE, (0, 0, _WIDTH_MM, _HEIGHT_MM), uuid=_PAGE_KEY)
    symbol = SubElement(page, "symbol", type="fill", name="", alpha="1")
    fill = SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1", "pass": "0"})
    _options(fill, {"color": "255,255,255,255", "style": "solid", "outline_style": "no"})


def _item(
    parent: Element, kind: int, place: tuple[float, float, float, float], **more: str
) -> Element:
    x, y, width, height = place
    where = f"{x:g},{y:g},mm"
    around = {
        "type": str(kind), "position": where, "positionOnPage": where,
        "size": f"{width:g},{height:g},mm", "referencePoint": "0", "visibility": "1",
        "opacity": "1", "frame": "false", "background": "false", "id": "",
        "zValue": str(len(parent)),
    }  # fmt: skip
    return SubElement(parent, "LayoutItem", around | more)


def _add_map(layout: Element, sheet: Sheet, sources: Mapping[str, str]) -> None:
    chart = _item(
        layout, _MAP, (_MARGIN_MM, _MARGIN_MM + _HEAD_MM, *MAP_MM), id="map", uuid=_MAP_KEY,
        frame="true", outlineWidthM="0.2,mm", background="true", keepLayerSet="true",
        isTemporal="0", drawCanvasItems="false", followPreset="false", mapRotation="0",
    )  # fmt: skip
    _colour(chart, "FrameColor", _SOFT)
    _colour(chart, "BackgroundColor", (255, 255, 255))
    names = ("xmin", "ymin", "xmax", "ymax")
    limits = zip(names, filling(sheet.box, *MAP_MM), strict=True)
    SubElement(chart, "Extent", {name: f"{value:.3f}" for name, value in limits})
    layers = SubElement(chart, "LayerSet")
    for key, layer in sheet.drawn.items():
        source = {"source": sources[key], "name": layer.name, "provider": layer.provider}
        SubElement(layers, "Layer", source).text = key


def filling(
    box: tuple[float, float, float, float], width: float, height: float
) -> tuple[float, float, float, float]:
    """Return the smallest box around another, with the same middle, that has a given shape."""
    west, south, east, north = box
    scale = max((east - west) / width, (north - south) / height)
    x, y = (west + east) / 2, (south + north) / 2
    half, high = scale * width / 2, scale * height / 2
    return x - half, y - high, x + half, y + high


def _add_label(
    layout: Element, text: str, place: tuple[float, float, float, float], *, size: int,
    name: str, bold: bool = False, to_right: bool = False,
) -> None:  # fmt: skip
    label = _item(
        layout, _LABEL, place, id=name, labelText=text,
        htmlState="0", halign="2" if to_right else "1",
        valign="32", marginX="0", marginY="0",
    )  # fmt: skip
    _text_style(label, size, bold=bold)


def _text_style(parent: Element, size: int, *, bold: bool = False) -> None:
    SubElement(
        parent, "text-style", fontFamily="Open Sans", fontSize=str(size), fontSizeUnit="Point",
        fontWeight="75" if bold else "50", namedStyle="Bold" if bold else "Regular",
        textColor=",".join(map(str, (*_INK, 255))), textOpacity="1", multilineHeight="1",
    )  # fmt: skip


def _add_north(layout: Element, place: tuple[float, float, float, float]) -> None:
    drawing = base64.b64encode(_NORTH.encode()).decode()
    _item(
        layout, _PICTURE, place, id="north arrow",
        file=f"base64:{drawing}", mode="2", resizeMode="0",
        anchorPoint="0", northMode="0", northOffset="0", mapUuid=_MAP_KEY,
    )  # fmt: skip


def _add_scale_bar(layout: Element, place: tuple[float, float, float, float]) -> None:
    bar = _item(
        layout, _SCALE_BAR, place, id="scale bar", style="Single Box",
        mapUuid=_MAP_KEY, unitType="meters",
        unitLabel="m", numSegments="2", numSegmentsLeft="0", numUnitsPerSegment="20",
        numMapUnitsPerScaleBarUnit="1", segmentSizeMode="0", height="2.2", labelBarSpace="2",
        boxContentSpace="0", alignment="0", method="HorizontalAverage",
    )  # fmt: skip
    _text_style(bar, 9)
    _colour(bar, "fillColor", (0, 0, 0))
    _colour(bar, "fillColor2", (255, 255, 255))
    _colour(bar, "strokeColor", (0, 0, 0))
    given = SubElement(SubElement(bar, "LayoutObject"), "dataDefinedProperties")
    whole = SubElement(given, "Option", type="Map")
    properties = SubElement(whole, "Option", name="properties", type="Map")
    one = SubElement(properties, "Option", name="dataDefinedScalebarSegmentWidth", type="Map")
    SubElement(one, "Option", name="active", type="bool", value="true")
    SubElement(one, "Option", name="expression", type="QString", value=_SEGMENT)
    SubElement(one, "Option", name="type", type="int", value=_EXPRESSION)
    SubElement(whole, "Option", name="type", type="QString", value="collection")


def _add_legend(
    layout: Element, sheet: Sheet, sources: Mapping[str, str],
    place: tuple[float, float, float, float],
) -> None:  # fmt: skip
    legend = _item(
        layout, _LEGEND, place, id="legend",
        title=sheet.legend_title, resizeToContents="1", boxSpace="2",
        symbolWidth="7", symbolHeight="4", columnCount="1", wrapChar="|", map_uuid=_MAP_KEY,
    )  # fmt: skip
    styles = SubElement(legend, "styles")
    for name, size, space in (("title", 10, "marginBottom"), ("group", 9, "marginTop"),
                              ("subgroup", 9, "marginTop"), ("symbolLabel", 9, "")):  # fmt: skip
        margins = {space: "2"} if space else {"marginTop": "2", "marginLeft": "2"}
        _text_style(SubElement(styles, "style", {"name": name, "alignment": "1"} | margins), size)
    tree = SubElement(legend, "layer-tree-group")
    for key in sheet.legend:
        layer = sheet.drawn[key]
        leaf = SubElement(
            tree, "layer-tree-layer", id=key, name=layer.name, source=sources[key],
            providerKey=layer.provider, checked="Qt::Checked", expanded="1",
        )  # fmt: skip
        told = {}
        if key == sheet.legend[0]:
            told["legend/title-style"] = "hidden"  # the heading says it already
        if layer.geometry == "Point":
            told["legend/custom-symbol-0"] = legend_symbol()
        _options(SubElement(leaf, "customproperties"), told)


def _colour(parent: Element, name: str, colour: tuple[int, int, int]) -> None:
    parts = zip(("red", "green", "blue", "alpha"), (*colour, 255), strict=True)
    SubElement(parent, name, {part: str(value) for part, value in parts})


def _options(parent: Element, values: Mapping[str, str]) -> None:
    options = SubElement(parent, "Option", type="Map")
    for name, value in values.items():
        SubElement(options, "Option", name=name, type="QString", value=value)
