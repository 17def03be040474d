"""The one look of all heat maps: colour ramp, class breaks, and QGIS and SLD styles of them.

Everything here needs the standard library only, so that a Python without the geographic
packages can load this file by itself.

The ramp runs from light yellow over red to near-black violet, in equal steps of lightness, so
that it reads the same in grey and for colour-blind eyes; dark is high, as in the paper's
section "Scalable Dynamic Occupancy Map". The breaks follow a 1-2-5 series, because hit occupancy
is mostly small (0.5 to 30 %), and never depend on the data, so that maps compare.
"""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

BREAKS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
RAMP = (
    "#f8eca1", "#f3be56", "#ef891a", "#df5028", "#ba1c4d", "#830460", "#480d58", "#18083b",
)  # fmt: skip
NEVER_HIT = "#dce8f1"
NOT_OBSERVED = "#b9bdc1"  # for pictures; layers leave such tiles transparent
LEGEND_TITLE = "Share of the observed time"
NOT_OBSERVED_LABEL = "not observed"

_QGIS_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
_BEGIN_AND_DURATION = "1"
_INCLUDE_BEGIN_EXCLUDE_END = "0"


class ColourClass(NamedTuple):
    """A class of occupancy: more than `lower` up to `upper`; the first is exactly 0."""

    lower: float
    upper: float
    colour: str
    label: str


def colour_classes() -> tuple[ColourClass, ...]:
    """Return the classes of occupancy from 0 to 1, lowest first."""
    bounds = zip(pairwise(BREAKS), RAMP, strict=True)
    return (
        ColourClass(0.0, 0.0, NEVER_HIT, "0 %, never hit"),
        *(ColourClass(low, high, colour, _label(low, high)) for (low, high), colour in bounds),
    )


def _label(lower: float, upper: float) -> str:
    if lower == 0.0:
        return f"up to {upper * 100:g} %"
    return f"{lower * 100:g} to {upper * 100:g} %"


def vector_qml(*, begin: str = "", end: str = "", length_s: float = 0.0) -> str:
    """Return the QGIS style of a layer of tiles.

    Parameters
    ----------
    begin, end : str
        Fields with the begin and the end of each row, for the temporal controller; empty
        where a layer holds the whole time.
    length_s : float
        Length of a row's interval, seconds.

    Returns
    -------
    str
        QML text. Where tiles overlap, the busiest is on top.
    """
    root = Element("qgis", version="3.34", styleCategories="Symbology|Temporal")
    if begin:
        _add_temporal(root, begin, end, length_s)
    _add_renderer(root)
    SubElement(root, "layerGeometryType").text = "2"
    return _document(root, _QGIS_DOCTYPE)


def ground_qml() -> str:
    """Return the QGIS style of all tiles as the ground below a heat map, in one colour.

    Where nothing lies above it, nothing was observed.
    """
    root = Element("qgis", version="3.34", styleCategories="Symbology")
    renderer = SubElement(root, "renderer-v2", type="singleSymbol", symbollevels="0")
    _add_fill(SubElement(renderer, "symbols"), "0", NOT_OBSERVED, outline_mm=0.3)
    SubElement(root, "layerGeometryType").text = "2"
    return _document(root, _QGIS_DOCTYPE)


def _add_temporal(root: Element, begin: str, end: str, length_s: float) -> None:
    """Show a row from its begin for its length.

    QGIS compares the times of a GeoPackage as text, one with a Z and one without, and so takes
    an interval that ends at a moment for one that holds it. A hundredth of a second less ends
    that; it is more than QGIS loses in rounding, and less than a step.
    """
    shown_ms = max(0, round(length_s * 1000) - 10)
    SubElement(
        root, "temporal", enabled="1", mode=_BEGIN_AND_DURATION,
        limitMode=_INCLUDE_BEGIN_EXCLUDE_END, startField=begin, endField=end,
        fixedDuration=str(shown_ms), durationUnit="ms", durationField="", accumulate="0",
        startExpression="", endExpression="",
    )  # fmt: skip


def _add_renderer(root: Element) -> None:
    renderer = SubElement(
        root, "renderer-v2", type="graduatedSymbol", attr="occupancy", symbollevels="0",
        graduatedMethod="GraduatedColor", forceraster="0", enableorderby="1",
    )  # fmt: skip
    ranges = SubElement(renderer, "ranges")
    symbols = SubElement(renderer, "symbols")
    for name, level in enumerate(colour_classes()):
        SubElement(
            ranges, "range", symbol=str(name), render="true", label=level.label,
            lower=f"{level.lower:.15f}", upper=f"{level.upper:.15f}",
        )  # fmt: skip
        _add_fill(symbols, str(name), level.colour)
    order = SubElement(renderer, "orderby")
    SubElement(order, "orderByClause", asc="1", nullsFirst="1").text = '"occupancy"'


def _add_fill(symbols: Element, name: str, colour: str, *, outline_mm: float = 0.1) -> None:
    symbol = SubElement(
        symbols, "symbol", type="fill", name=name, alpha="1", clip_to_extent="1",
        force_rhr="0", is_animated="0", frame_rate="10",
    )  # fmt: skip
    layer = SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1", "pass": "0"})
    options = SubElement(layer, "Option", type="Map")
    values = {
        "color": _rgba(colour),
        "style": "solid",
        "outline_color": _rgba(colour),  # closes the hairlines between neighbours
        "outline_style": "solid",
        "outline_width": f"{outline_mm:g}",
        "outline_width_unit": "MM",
    }
    for key, value in values.items():
        SubElement(options, "Option", name=key, type="QString", value=value)


def sidecar_qml() -> str:
    """Return the QGIS style of files that carry none: a GeoTIFF (first band) or a table.

    QGIS loads it by itself where it has the name of the file and the ending `.qml`.
    """
    root = Element("qgis", version="3.34", styleCategories="Symbology")
    _add_raster_renderer(SubElement(root, "pipe"))
    _add_renderer(root)
    return _document(root, _QGIS_DOCTYPE)


def _add_raster_renderer(pipe: Element) -> None:
    renderer = SubElement(
        pipe, "rasterrenderer", type="singlebandpseudocolor", band="1", opacity="1",
        alphaBand="-1", classificationMin="0", classificationMax="1", nodataColor="",
    )  # fmt: skip
    shader = SubElement(
        SubElement(renderer, "rastershader"), "colorrampshader",
        colorRampType="DISCRETE", classificationMode="1", clip="0",
        minimumValue="0", maximumValue="1", labelPrecision="3",
    )  # fmt: skip
    for level in colour_classes():
        SubElement(
            shader, "item", value=f"{_single(level.upper):.17g}", color=level.colour,
            alpha="255", label=level.label,
        )  # fmt: skip


def sld(layer: str) -> str:
    """Return the style of a layer as Styled Layer Descriptor 1.0, for map servers."""
    root = Element("StyledLayerDescriptor", {
        "version": "1.0.0",
        "xmlns": "http://www.opengis.net/sld",
        "xmlns:ogc": "http://www.opengis.net/ogc",
    })  # fmt: skip
    named = SubElement(root, "NamedLayer")
    SubElement(named, "Name").text = layer
    style = SubElement(SubElement(named, "UserStyle"), "FeatureTypeStyle")
    for level in colour_classes():
        rule = SubElement(style, "Rule")
        SubElement(rule, "Name").text = level.label
        _add_filter(SubElement(rule, "ogc:Filter"), level)
        fill = SubElement(SubElement(rule, "PolygonSymbolizer"), "Fill")
        SubElement(fill, "CssParameter", name="fill").text = level.colour
    return _document(root, '<?xml version="1.0" encoding="UTF-8"?>')


def _add_filter(parent: Element, level: ColourClass) -> None:
    if level.upper == 0.0:
        _add_comparison(parent, "ogc:PropertyIsEqualTo", 0.0)
        return
    both = SubElement(parent, "ogc:And")
    _add_comparison(both, "ogc:PropertyIsGreaterThan", level.lower)
    _add_comparison(both, "ogc:PropertyIsLessThanOrEqualTo", level.upper)


def _add_comparison(parent: Element, kind: str, value: float) -> None:
    comparison = SubElement(parent, kind)
    SubElement(comparison, "ogc:PropertyName").text = "occupancy"
    SubElement(comparison, "ogc:Literal").text = f"{value:g}"


def _rgba(colour: str) -> str:
    parts = bytes.fromhex(colour.removeprefix("#"))
    return ",".join(map(str, [*parts, 255]))


def _single(value: float) -> float:
    """Return the value as a float32 pixel holds it, so that a pixel on a break stays below."""
    return float(struct.unpack("f", struct.pack("f", value))[0])


def _document(root: Element, heading: str) -> str:
    indent(root)
    return f"{heading}\n{tostring(root, encoding='unicode')}\n"
