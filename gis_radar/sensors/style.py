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
    _turned(_layer(symbol, "SimpleMarker", arrow))
    dot = {"name": "circle", "size": "2.6", "color": INK, "outline_color": "255,255,255,255"}
    _layer(symbol, "SimpleMarker", dot)
    _label(root)
    return _document(root, geometry="0")


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


def _turned(layer: Element) -> None:
    whole = SubElement(SubElement(layer, "data_defined_properties"), "Option", type="Map")
    properties = SubElement(whole, "Option", name="properties", type="Map")
    angle = SubElement(properties, "Option", name="angle", type="Map")
    SubElement(angle, "Option", name="active", type="bool", value="true")
    SubElement(angle, "Option", name="expression", type="QString", value=_GRID_BEARING)
    SubElement(angle, "Option", name="type", type="int", value=_EXPRESSION)
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
    SubElement(settings, "placement", placement="0", dist="3", distUnits="MM", priority="8")
    SubElement(settings, "rendering", drawLabels="1", obstacle="0", scaleVisibility="0")


def _document(root: Element, *, geometry: str) -> str:
    SubElement(root, "layerGeometryType").text = geometry
    indent(root)
    return f"{_DOCTYPE}\n{tostring(root, encoding='unicode')}\n"
