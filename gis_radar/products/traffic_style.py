"""QGIS style of lanes and turns: coloured by classes, turns as wide as their volume."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

from gis_radar.base import tr
from gis_radar.products.heatmap.style import qgis_document

VOLUMES = "volume_veh_h"
BREAKS = (0.0, 50.0, 100.0, 200.0, 400.0, 600.0, 900.0, 1200.0, 1e6)  # of lanes, veh/h
# Not those of heat maps, on which these layers lie: one colour would mean two things.
SHADES = (
    "#9eedcc", "#79d1bb", "#52b6aa", "#269a99", "#107e85", "#02636f", "#094956", "#00313f",
)  # fmt: skip
_SHORTER_MS = 10  # as in heat maps: QGIS takes an interval that ends at a moment for one with it
_LANE_MM, _TURN_ALPHA = 1.2, 200  # turns cross: those below are seen through
_WIDTH = f'max(0.4, min(6, "{VOLUMES}" / 100))'  # mm: 1 for 100 veh/h
NAMED = {
    "lanes": ["name"], "turns": ["from_name", "to_name"], "sections": ["section", "direction"],
}  # fmt: skip
"""Columns that name a row of a layer."""


class LineClass(NamedTuple):
    """Class of a layer: values from `low` to `high`, their colour and label."""

    low: float
    high: float
    colour: str
    label: str


def traffic_style(interval_s: float, titles: Mapping[str, str], layer: str) -> str:
    """Return the QGIS style of a layer of lanes, turns or sections as QML.

    Parameters
    ----------
    interval_s : float
        Time for which the temporal controller shows a row from its `begin`, seconds.
    titles : mapping
        Titles of the columns, by name.
    layer : {"lanes", "turns", "sections"}
        The layer; the lines of turns are as wide as their volume, with an arrow at the end.
    """
    root = Element(
        "qgis", {"version": "3.34", "styleCategories": "Symbology|MapTips|Fields|Temporal"}
    )
    SubElement(root, "temporal", {
        "enabled": "1", "mode": "1", "limitMode": "0", "startField": "begin", "endField": "end",
        "fixedDuration": str(max(0, round(interval_s * 1000) - _SHORTER_MS)), "durationUnit": "ms",
        "durationField": "", "accumulate": "0", "startExpression": "", "endExpression": "",
    })  # fmt: skip
    classes = (
        LineClass(low, high, colour, f"{low:g} - {high:g}" if high < BREAKS[-1] else f"> {low:g}")
        for (low, high), colour in zip(pairwise(BREAKS), SHADES, strict=True)
    )
    _add_classes(root, VOLUMES, classes, unit=f" {tr('veh/h')}", wide=layer == "turns")
    aliases = SubElement(root, "aliases")
    for number, (name, title) in enumerate(titles.items(), start=1):
        SubElement(aliases, "alias", {"index": str(number), "field": name, "name": title})
    SubElement(root, "mapTip", {"enabled": "1"}).text = _tip(layer)
    return _document(root)


def class_style(column: str, classes: Iterable[LineClass]) -> str:
    """Return the QGIS style of a layer of lanes that are coloured by the class of a column."""
    root = Element("qgis", {"version": "3.34", "styleCategories": "Symbology"})
    _add_classes(root, column, classes)
    return _document(root)


def _add_classes(
    root: Element, column: str, classes: Iterable[LineClass], *, unit: str = "", wide: bool = False
) -> None:
    renderer = SubElement(root, "renderer-v2", {
        "type": "graduatedSymbol", "attr": column, "graduatedMethod": "GraduatedColor",
        "symbollevels": "0", "forceraster": "0", "enableorderby": "0",
    })  # fmt: skip
    ranges, symbols = SubElement(renderer, "ranges"), SubElement(renderer, "symbols")
    for k, each in enumerate(classes):
        SubElement(ranges, "range", {
            "symbol": str(k), "render": "true", "lower": f"{each.low:g}", "upper": f"{each.high:g}",
            "label": f"{each.label}{unit}",
        })  # fmt: skip
        shade = ",".join(map(str, bytes.fromhex(each.colour[1:])))
        _add_symbol(symbols, str(k), shade, wide=wide)


def _document(root: Element) -> str:
    """Return a style of lines as text."""
    SubElement(root, "layerGeometryType").text = "1"
    return qgis_document(root)


def _add_symbol(symbols: Element, name: str, colour: str, *, wide: bool) -> None:
    """Add a line, of turns as wide as the volume and with an arrow at its end."""
    symbol = _symbol(symbols, "line", name)
    layer = SubElement(symbol, "layer", {"class": "SimpleLine", "enabled": "1", "pass": "0"})
    _add_options(
        SubElement(layer, "Option", {"type": "Map"}),
        {
            "line_color": f"{colour},{_TURN_ALPHA if wide else 255}", "line_width_unit": "MM",
            "line_width": str(_LANE_MM), "capstyle": "flat", "joinstyle": "round",
        },
    )  # fmt: skip
    if not wide:
        return
    _set_by_expression(layer, "outlineWidth", _WIDTH)
    arrow = SubElement(symbol, "layer", {"class": "MarkerLine", "enabled": "1", "pass": "0"})
    places = SubElement(arrow, "Option", {"type": "Map"})
    _add_options(places, {"placements": "LastVertex", "rotate": "1"})
    head = SubElement(
        _symbol(arrow, "marker", f"@{name}@1"),
        "layer",
        {"class": "SimpleMarker", "enabled": "1", "pass": "0"},
    )
    _add_options(
        SubElement(head, "Option", {"type": "Map"}),
        {"name": "filled_arrowhead", "color": f"{colour},255", "outline_style": "no", "size": "3"},
    )
    _set_by_expression(head, "size", f"2 + 1.2 * {_WIDTH}")


def _symbol(parent: Element, kind: str, name: str) -> Element:
    common = {"alpha": "1", "clip_to_extent": "1", "force_rhr": "0"}
    return SubElement(parent, "symbol", {"type": kind, "name": name, **common})


def _set_by_expression(layer: Element, name: str, expression: str) -> None:
    """Set a property of a symbol's layer by a QGIS expression."""
    properties = SubElement(SubElement(layer, "data_defined_properties"), "Option", {"type": "Map"})
    _add_options(properties, {"name": "", "type": "collection"})
    listed = SubElement(properties, "Option", {"name": "properties", "type": "Map"})
    entry = SubElement(listed, "Option", {"name": name, "type": "Map"})
    SubElement(entry, "Option", {"name": "active", "type": "bool", "value": "true"})
    SubElement(entry, "Option", {"name": "expression", "type": "QString", "value": expression})
    SubElement(entry, "Option", {"name": "type", "type": "int", "value": "3"})


def _add_options(parent: Element, values: dict[str, str]) -> None:
    for name, value in values.items():
        SubElement(parent, "Option", {"name": name, "type": "QString", "value": value})


def _tip(layer: str) -> str:
    """Return the map tip of QGIS, in which names are escaped."""

    def text(column: str) -> str:
        return f"[% replace(replace(\"{column}\", '&', '&amp;'), '<', '&lt;') %]"

    name = " &rarr; ".join(map(text, NAMED[layer]))
    number = f"""[% coalesce(format_number("{VOLUMES}", 0), '\u2013') %] {tr("veh/h")}"""
    speed = """, [% coalesce(format_number("speed_kmh", 0), '\u2013') %] km/h"""
    speed = speed if layer == "lanes" else ""
    return f"<b>{name}</b><br>{number}{speed}"
