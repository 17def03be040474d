"""The look of traffic in QGIS: lanes and turns coloured by volume, turns as wide as it."""

from __future__ import annotations

from itertools import pairwise
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from gis_radar.products.heatmap.style import RAMP

VOLUMES = "volume_veh_h"
BREAKS = (0.0, 50.0, 100.0, 200.0, 400.0, 600.0, 900.0, 1200.0, 3000.0)  # of lanes, veh/h
_SHORTER_MS = 10  # as in heat maps: QGIS takes an interval that ends at a moment for one with it
_LANE_MM, _TURN_MM = 1.2, 0.4
_WIDTH = f'max(0.4, min(6, "{VOLUMES}" / 100))'  # mm: 1 for 100 veh/h


def traffic_style(interval_s: float, *, wide: bool) -> str:
    """Return the QGIS style of a layer of lanes or turns as QML.

    Parameters
    ----------
    interval_s : float
        For how long the temporal controller shows a row from its `begin`.
    wide : bool
        Whether lines are as wide as the volume, with an arrow at their end: turns.
    """
    root = Element("qgis", {"version": "3.34", "styleCategories": "Symbology|MapTips|Temporal"})
    SubElement(root, "temporal", {
        "enabled": "1", "mode": "1", "limitMode": "0", "startField": "begin", "endField": "end",
        "fixedDuration": str(max(0, round(interval_s * 1000) - _SHORTER_MS)), "durationUnit": "ms",
        "durationField": "", "accumulate": "0", "startExpression": "", "endExpression": "",
    })  # fmt: skip
    renderer = SubElement(root, "renderer-v2", {
        "type": "graduatedSymbol", "attr": VOLUMES, "graduatedMethod": "GraduatedColor",
        "symbollevels": "0", "forceraster": "0", "enableorderby": "0",
    })  # fmt: skip
    ranges, symbols = SubElement(renderer, "ranges"), SubElement(renderer, "symbols")
    for k, ((low, high), colour) in enumerate(zip(pairwise(BREAKS), RAMP, strict=True)):
        SubElement(ranges, "range", {
            "symbol": str(k), "render": "true", "lower": f"{low:g}", "upper": f"{high:g}",
            "label": f"{low:g} - {high:g} veh/h",
        })  # fmt: skip
        _add_symbol(symbols, str(k), ",".join(map(str, bytes.fromhex(colour[1:]))), wide=wide)
    SubElement(root, "mapTip", {"enabled": "1"}).text = _tip(wide=wide)
    SubElement(root, "layerGeometryType").text = "1"
    indent(root)
    heading = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    return f"{heading}\n{tostring(root, encoding='unicode')}\n"


def _add_symbol(symbols: Element, name: str, colour: str, *, wide: bool) -> None:
    symbol = SubElement(symbols, "symbol", {
        "type": "line", "name": name, "alpha": "1", "clip_to_extent": "1", "force_rhr": "0",
    })  # fmt: skip
    kind = "ArrowLine" if wide else "SimpleLine"
    layer = SubElement(symbol, "layer", {"class": kind, "enabled": "1", "pass": "0"})
    options = SubElement(layer, "Option", {"type": "Map"})
    if not wide:
        values = {"line_color": f"{colour},255", "line_width": str(_LANE_MM), "capstyle": "flat"}
        _add_options(options, values | {"line_width_unit": "MM"})
        return
    _add_options(options, {
        "arrow_width": str(_TURN_MM), "arrow_start_width": str(_TURN_MM), "arrow_width_unit": "MM",
        "arrow_start_width_unit": "MM", "head_length": "2.5", "head_thickness": "1.2",
        "is_curved": "0", "is_repeated": "0", "arrow_type": "0", "head_type": "0",
    })  # fmt: skip
    fill = SubElement(layer, "symbol", {
        "type": "fill", "name": f"@{name}@0", "alpha": "1", "clip_to_extent": "1", "force_rhr": "0",
    })  # fmt: skip
    inner = SubElement(fill, "layer", {"class": "SimpleFill", "enabled": "1", "pass": "0"})
    _add_options(
        SubElement(inner, "Option", {"type": "Map"}),
        {"color": f"{colour},230", "style": "solid", "outline_style": "no"},
    )
    properties = SubElement(SubElement(layer, "data_defined_properties"), "Option", {"type": "Map"})
    _add_options(properties, {"name": "", "type": "collection"})
    listed = SubElement(properties, "Option", {"name": "properties", "type": "Map"})
    for each in ("arrowWidth", "arrowStartWidth"):
        entry = SubElement(listed, "Option", {"name": each, "type": "Map"})
        SubElement(entry, "Option", {"name": "active", "type": "bool", "value": "true"})
        SubElement(entry, "Option", {"name": "expression", "type": "QString", "value": _WIDTH})
        SubElement(entry, "Option", {"name": "type", "type": "int", "value": "3"})


def _add_options(parent: Element, values: dict[str, str]) -> None:
    for name, value in values.items():
        SubElement(parent, "Option", {"name": name, "type": "QString", "value": value})


def _tip(*, wide: bool) -> str:
    """Return what QGIS shows under the cursor; names are text, not HTML."""

    def text(column: str) -> str:
        return f"[% replace(replace(\"{column}\", '&', '&amp;'), '<', '&lt;') %]"

    name = f"{text('from_name')} &rarr; {text('to_name')}" if wide else text("name")
    number = f"""[% coalesce(format_number("{VOLUMES}", 0), '\u2013') %] veh/h"""
    speed = "" if wide else """, [% coalesce(format_number("speed_kmh", 0), '\u2013') %] km/h"""
    return f"<b>{name}</b><br>{number}{speed}"
