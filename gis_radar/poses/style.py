"""How QGIS shows sensors: an arrow where one looks, its view, the ellipse of its place.

Everything here needs the standard library only, as the style of the heat maps.
"""

from __future__ import annotations

from collections.abc import Callable
from xml.etree.ElementTree import Element, SubElement, indent, tostring

INK = "17,24,39,255"  # near black: reads on every class of the ramp
VIEW = "29,78,216,255"
_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
_GRID_BEARING = '90 - "yaw"'  # a marker turns clockwise from up, yaw anticlockwise from east
_EXPRESSION = "3"
_OVER_POINT = "1"
_DISTANCE_MM = 2.5
# A label stands behind its sensor, so that it leaves the arrow free: eighths of a turn from east.
_EIGHTH = '(round((("yaw" + 900) % 360) / 45) % 8)'
_QUADRANT = f"array_get(array(5, 2, 1, 0, 3, 6, 7, 8), {_EIGHTH})"
_ASIDE = f'array(-{_DISTANCE_MM} * cos(radians("yaw")), {_DISTANCE_MM} * sin(radians("yaw")))'
_LABEL = (
    "\"sensor\" || coalesce(' ± ' || "
    "format_number(sqrt(\"sigma_easting\"^2 + \"sigma_northing\"^2), 2) || ' m', '')"
)


def sensors_qml() -> str:
    """Return the style of the points: an arrow along yaw, the name, and how well it is known."""
    root = _root("Symbology|Labeling", labels=True)
    symbol = _symbol(root, "marker")
    arrow = {
        "name": "arrow", "size": "8", "color": VIEW, "outline_color": "255,255,255,255",
        "outline_width": "0.4", "vertical_anchor_point": "2",
    }  # fmt: skip
    turned = _layer(symbol, "SimpleMarker", arrow)
    _given(SubElement(turned, "data_defined_properties"), angle=_GRID_BEARING)
    dot = {"name": "circle", "size": "2.6", "color": INK, "outline_color": "255,255,255,255"}
    _layer(symbol, "SimpleMarker", dot)
    _label(root)
    return _document(root, geometry="0")


def legend_symbol() -> str:
    """Return what a legend shows for a sensor: it looks along the line, which takes less room."""
    symbol = Element("symbol", type="marker", name="0", alpha="1", clip_to_extent="1")
    arrow = {"name": "arrow", "size": "4.4", "angle": "90", "color": VIEW, "outline_style": "no",
             "offset": "0,-1"}  # fmt: skip
    _layer(symbol, "SimpleMarker", arrow)
    dot = {"name": "circle", "size": "2.4", "color": INK, "outline_style": "no", "offset": "-2,0"}
    _layer(symbol, "SimpleMarker", dot)
    return tostring(symbol, encoding="unicode")


def views_qml() -> str:
    """Return the style of the views: an outline that hides nothing."""
    root = _root("Symbology")
    outline = {
        "style": "no", "color": VIEW, "outline_color": VIEW, "outline_style": "dash",
        "outline_width": "0.4",
    }  # fmt: skip
    _layer(_symbol(root, "fill"), "SimpleFill", outline)
    return _document(root, geometry="2")


def uncertainty_qml() -> str:
    """Return the style of the ellipses."""
    root = _root("Symbology")
    fill = {"style": "solid", "color": "29,78,216,60", "outline_color": INK, "outline_width": "0.3"}
    _layer(_symbol(root, "fill"), "SimpleFill", fill)
    return _document(root, geometry="2")


QML: dict[str, Callable[[], str]] = {
    "sensors": sensors_qml,
    "views": views_qml,
    "uncertainty": uncertainty_qml,
}


def _root(categories: str, *, labels: bool = False) -> Element:
    shown = str(int(labels))
    return Element("qgis", version="3.34", styleCategories=categories, labelsEnabled=shown)


def _symbol(root: Element, kind: str) -> Element:
    renderer = SubElement(root, "renderer-v2", type="singleSymbol", symbollevels="0")
    return SubElement(
        SubElement(renderer, "symbols"), "symbol", type=kind, name="0", alpha="1",
        clip_to_extent="1", force_rhr="0",
    )  # fmt: skip


def _layer(symbol: Element, kind: str, values: dict[str, str]) -> Element:
    layer = SubElement(symbol, "layer", {"class": kind, "enabled": "1", "pass": "0"})
    _options(layer, values)
    return layer


def _options(parent: Element, values: dict[str, str]) -> Element:
    options = SubElement(parent, "Option", type="Map")
    for key, value in values.items():
        SubElement(options, "Option", name=key, type="QString", value=value)
    return options


def _given(parent: Element, **expressions: str) -> None:
    """Let properties follow from a row."""
    whole = SubElement(parent, "Option", type="Map")
    properties = SubElement(whole, "Option", name="properties", type="Map")
    for name, expression in expressions.items():
        one = SubElement(properties, "Option", name=name, type="Map")
        SubElement(one, "Option", name="active", type="bool", value="true")
        SubElement(one, "Option", name="expression", type="QString", value=expression)
        SubElement(one, "Option", name="type", type="int", value=_EXPRESSION)
    SubElement(whole, "Option", name="type", type="QString", value="collection")


def _label(root: Element) -> None:
    settings = SubElement(SubElement(root, "labeling", type="simple"), "settings")
    text = SubElement(
        settings, "text-style", fieldName=_LABEL, isExpression="1", fontSize="9",
        fontSizeUnit="Point", fontFamily="Open Sans", fontWeight="75", namedStyle="Bold",
        textColor=INK, textOpacity="1",
    )  # fmt: skip
    SubElement(
        text, "text-buffer", bufferDraw="1", bufferSize="0.9", bufferSizeUnits="MM",
        bufferColor="255,255,255,255", bufferOpacity="0.9", bufferJoinStyle="128",
    )  # fmt: skip
    SubElement(
        settings, "placement", placement=_OVER_POINT, offsetUnits="MM", xOffset="0", yOffset="0",
        quadOffset="4", priority="8", overlapHandling="AllowOverlapIfRequired",
    )  # fmt: skip
    SubElement(settings, "rendering", drawLabels="1", obstacle="0", scaleVisibility="0")
    _given(SubElement(settings, "dd_properties"), OffsetQuad=_QUADRANT, OffsetXY=_ASIDE)


def _document(root: Element, *, geometry: str) -> str:
    SubElement(root, "layerGeometryType").text = geometry
    indent(root)
    return f"{_DOCTYPE}\n{tostring(root, encoding='unicode')}\n"
