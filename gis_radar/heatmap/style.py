"""The one look of all heat maps: colour ramp, class breaks, and QGIS and SLD styles of them.

The QGIS styles are `occupancy.qml`, a pattern, and `ground.qml`. Everything here needs the
standard library only, so that a Python without the geographic packages can load this file.

The ramp runs from light yellow over red to near-black violet, in equal steps of lightness, so
that it reads the same in grey and for colour-blind eyes; dark is high, as in the paper's
section "Scalable Dynamic Occupancy Map". The breaks follow a 1-2-5 series, because hit occupancy
is mostly small (0.5 to 30 %), and never depend on the data, so that maps compare.
"""

from __future__ import annotations

import copy
import struct
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, parse, tostring

BREAKS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # occupancy, shares of 1
RAMP = (
    "#f8eca1", "#f3be56", "#ef891a", "#df5028", "#ba1c4d", "#830460", "#480d58", "#18083b",
)  # fmt: skip
NEVER_HIT = "#dce8f1"
NOT_OBSERVED = "#b9bdc1"  # for pictures; layers leave such tiles transparent
LEGEND_TITLE = "Share of the observed time"
LEGEND_SUBTITLE = "in which a tile is hit"

_QGIS_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
_HERE = Path(__file__).parent


class MeasureWords(NamedTuple):
    """How maps call a measure: title of its legend and what follows it, zero, no data."""

    title: str
    subtitle: str
    zero: str
    unknown: str


WORDS = {
    "occupancy": MeasureWords(LEGEND_TITLE, LEGEND_SUBTITLE, "never hit", "not observed"),
    "coverage": MeasureWords(
        "Coverage", "share of time with a vehicle", "no vehicle", "not visible"
    ),
}


class ColourClass(NamedTuple):
    """A class of occupancy or coverage: more than `lower` up to `upper`; the first is exactly 0."""

    lower: float
    upper: float
    colour: str
    label: str


def colour_classes(measure: str = "occupancy") -> tuple[ColourClass, ...]:
    """Return the classes of occupancy or coverage from 0 to 1, lowest first."""
    bounds = zip(pairwise(BREAKS), RAMP, strict=True)
    return (
        ColourClass(0.0, 0.0, NEVER_HIT, f"0 %, {WORDS[measure].zero}"),
        *(ColourClass(low, high, colour, _label(low, high)) for (low, high), colour in bounds),
    )


def legend(measure: str = "occupancy") -> tuple[tuple[str, str], ...]:
    """Return colours with their labels, highest class first, not observed last."""
    classes = [(each.colour, each.label) for each in reversed(colour_classes(measure))]
    return (*classes, (NOT_OBSERVED, WORDS[measure].unknown))


def _label(lower: float, upper: float) -> str:
    if lower == 0.0:
        return f"up to {upper * 100:g} %"
    return f"{lower * 100:g} to {upper * 100:g} %"


def vector_qml(*, interval_s: float | None = None, measure: str = "occupancy") -> str:
    """Return the QGIS style of a layer of tiles.

    Parameters
    ----------
    measure : str
        The column that it shows, `occupancy` or `coverage`.
    interval_s : float, optional
        Length of the interval of each row, seconds: the temporal controller shows a row for so
        long from its `begin`. Without it, the layer holds the whole time.

    Returns
    -------
    str
        QML text. Where tiles overlap, the busiest is on top.
    """
    without = ("pipe",) if interval_s is not None else ("pipe", "temporal")
    root = _measure_style(measure, without=without)
    if interval_s is not None:
        _element(root, "temporal").set("fixedDuration", str(_shown_ms(interval_s)))
    return _document(root, _QGIS_DOCTYPE)


def sidecar_qml(measure: str = "occupancy") -> str:
    """Return the QGIS style of files that carry none: a GeoTIFF (first band) or a table.

    QGIS loads it by itself where it has the name of the file and the ending `.qml`.
    """
    root = _measure_style(measure, without=("temporal", "layerGeometryType"))
    root.set("styleCategories", "Symbology")
    return _document(root, _QGIS_DOCTYPE)


def ground_qml() -> str:
    """Return the QGIS style of all tiles as the ground below a heat map, in one colour.

    Where nothing is drawn above it, nothing was observed.
    """
    return (_HERE / "ground.qml").read_text(encoding="utf-8")


def _measure_style(measure: str, *, without: tuple[str, ...]) -> Element:
    """Return `occupancy.qml` with an entry for each class of a measure, without some parts."""
    root = parse(_HERE / "occupancy.qml").getroot()  # noqa: S314 - our own file
    for name in without:
        root.remove(_element(root, name))
    for parent in ("pipe//colorrampshader", "renderer-v2/ranges", "renderer-v2/symbols"):
        if (entries := root.find(parent)) is not None:
            _repeat_for_each_class(entries, measure)
    _element(root, "renderer-v2").set("attr", measure)
    _element(root, "renderer-v2/orderby/orderByClause").text = f'"{measure}"'
    return root


def _repeat_for_each_class(entries: Element, measure: str) -> None:
    """Replace the only entry by one for each colour class."""
    (pattern,) = entries
    entries.remove(pattern)
    for number, each in enumerate(colour_classes(measure)):
        entry = copy.deepcopy(pattern)
        entries.append(entry)
        if entry.tag == "item":
            value = f"{_single(each.upper):.17g}"
            entry.attrib |= {"value": value, "color": each.colour, "label": each.label}
        elif entry.tag == "range":
            entry.attrib |= {"symbol": str(number), "label": each.label}
            entry.attrib |= {"lower": f"{each.lower:.15f}", "upper": f"{each.upper:.15f}"}
        else:
            entry.set("name", str(number))
            for name in ("color", "outline_color"):
                _element(entry, f".//Option[@name='{name}']").set("value", _rgba(each.colour))


def _element(root: Element, path: str) -> Element:
    found = root.find(path)
    if found is None:
        raise LookupError(f"occupancy.qml: no {path}")
    return found


def _shown_ms(interval_s: float) -> int:
    """Return how long a row is shown, a hundredth of a second less than its interval.

    QGIS compares the times of a GeoPackage as text, one with a Z and one without, and so takes an
    interval that ends at a moment for one that holds it. 10 ms are more than QGIS loses in
    rounding, and less than a step.
    """
    return max(0, round(interval_s * 1000) - 10)


def sld(layer: str, measure: str = "occupancy") -> str:
    """Return the style of a layer as Styled Layer Descriptor 1.0, for map servers."""
    root = Element("StyledLayerDescriptor", {
        "version": "1.0.0",
        "xmlns": "http://www.opengis.net/sld",
        "xmlns:ogc": "http://www.opengis.net/ogc",
    })  # fmt: skip
    named = SubElement(root, "NamedLayer")
    SubElement(named, "Name").text = layer
    style = SubElement(SubElement(named, "UserStyle"), "FeatureTypeStyle")
    for level in colour_classes(measure):
        rule = SubElement(style, "Rule")
        SubElement(rule, "Name").text = level.label
        _add_filter(SubElement(rule, "ogc:Filter"), level, measure)
        fill = SubElement(SubElement(rule, "PolygonSymbolizer"), "Fill")
        SubElement(fill, "CssParameter", name="fill").text = level.colour
    return _document(root, '<?xml version="1.0" encoding="UTF-8"?>')


def _add_filter(parent: Element, level: ColourClass, measure: str) -> None:
    if level.upper == 0.0:
        _add_comparison(parent, "ogc:PropertyIsEqualTo", measure, 0.0)
        return
    both = SubElement(parent, "ogc:And")
    _add_comparison(both, "ogc:PropertyIsGreaterThan", measure, level.lower)
    _add_comparison(both, "ogc:PropertyIsLessThanOrEqualTo", measure, level.upper)


def _add_comparison(parent: Element, kind: str, measure: str, value: float) -> None:
    comparison = SubElement(parent, kind)
    SubElement(comparison, "ogc:PropertyName").text = measure
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
