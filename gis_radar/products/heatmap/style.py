"""Style of all heat maps: colour ramp, class breaks, and QGIS styles.

The QGIS styles are `occupancy.qml`, a pattern, and `ground.qml`. Everything here needs the
standard library only, so that a Python without the geographic packages can load this file.

The ramp runs from light yellow over red to near-black violet, in equal steps of lightness, so
that it reads the same in grey and for colour-blind eyes; dark is high, as in the paper's
section "Scalable Dynamic Occupancy Map". The breaks follow a 1-2-5 series, because occupancy
is mostly small (0.5 to 30 %), and never depend on the data, so that maps compare.
"""

from __future__ import annotations

import copy
import struct
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, parse, tostring

BREAKS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # occupancy and hit share
RAMP = (
    "#f1dd88", "#f3be56", "#ef891a", "#df5028", "#ba1c4d", "#830460", "#480d58", "#18083b",
)  # fmt: skip
NEVER_HIT = "#f1f6fb"  # nearly the colour of paper
NOT_OBSERVED = "#b9bdc1"  # in pictures; layers leave such tiles transparent
UNCERTAIN = "uncertain"  # label of uncertain tiles, which are hatched over their class's colour
UNCERTAIN_FROM = 0.02  # uncertain: a standard error as large as the occupancy, and over this
UNCERTAIN_SEEN = 0.5  # uncertain: visible for a smaller share of the longest visible time
HATCH_DARK, HATCH_LIGHT = "#6b7278", "#ffffff"  # over pale colours and over deep ones
_PALE = 4  # number of pale classes, from 0 up
LEGEND_TITLE = "Share of the observed time"
LEGEND_SUBTITLE = "in which a tile is hit"

_HERE = Path(__file__).parent


class MeasureWords(NamedTuple):
    """Words of a measure on maps: title and subtitle of its legend, zero, no data."""

    title: str
    subtitle: str
    zero: str
    unknown: str


MAP_WORDS = {
    "hit_share": MeasureWords(LEGEND_TITLE, LEGEND_SUBTITLE, "never hit", "not observed"),
    "occupancy": MeasureWords(
        "Occupancy", "share of time with a vehicle", "no vehicle", "not visible"
    ),
}


OTHER_SHARE = MeasureWords("Share of time", "", "never", "no data")  # of a column of tile counts

# A lane's name is shown as text: QGIS takes a tip for HTML.
_LANE = "replace(replace(attribute('lane'), '&', '&amp;'), '<', '&lt;')"
_SEEN = f"""([% format_number("{{}}_s", 0) %] s)[% coalesce('<br>' || {_LANE}, '') %]"""
# What QGIS shows under the cursor, numbers as its language writes them.
_TIPS = {
    "hit_share": """<b>[% coalesce(format_number(100 * "hit_share", 1) || ' %', '\u2013') %]</b> """
    + _SEEN.format("observed"),
    "occupancy": """<b>[% coalesce(format_number(100 * "occupancy", 1) || ' \u00b1 ' ||"""
    """ format_number(100 * "occupancy_se", 1) || ' %', '\u2013') %]</b> """
    + _SEEN.format("visible"),
}


class ColourClass(NamedTuple):
    """A class of a share: more than `lower` up to `upper`; the first is exactly 0."""

    lower: float
    upper: float
    colour: str
    label: str


def colour_classes(measure: str = "hit_share") -> tuple[ColourClass, ...]:
    """Return the classes of hit share or occupancy from 0 to 1, lowest first."""
    bounds = zip(pairwise(BREAKS), RAMP, strict=True)
    return (
        ColourClass(0.0, 0.0, NEVER_HIT, f"0 %, {MAP_WORDS.get(measure, OTHER_SHARE).zero}"),
        *(ColourClass(low, high, colour, _label(low, high)) for (low, high), colour in bounds),
    )


def legend(measure: str = "hit_share") -> tuple[tuple[str, str], ...]:
    """Return colours with their labels, highest class first, not observed last.

    The last but one of occupancy is that of uncertain tiles: no colour but a hatch, `UNCERTAIN`.
    """
    classes = [(each.colour, each.label) for each in reversed(colour_classes(measure))]
    unsure = ((UNCERTAIN, UNCERTAIN),) if measure == "occupancy" else ()
    return (*classes, *unsure, (NOT_OBSERVED, MAP_WORDS[measure].unknown))


def hatches() -> tuple[str, ...]:
    """Return for each class, lowest first, the colour of the hatch of uncertain tiles."""
    classes = range(len(colour_classes()))
    return tuple(HATCH_DARK if place < _PALE else HATCH_LIGHT for place in classes)


def uncertain_rule(least_s: float) -> str:
    """Return the QGIS expression of uncertain tiles; `least_s` is half the longest time."""
    vague = f'"occupancy_se" >= {UNCERTAIN_FROM} AND "occupancy_se" >= "occupancy"'
    return f'{vague} OR "visible_s" < {least_s:.10g}'


def _label(lower: float, upper: float) -> str:
    if lower == 0.0:
        return f"up to {upper * 100:g} %"
    return f"{lower * 100:g} to {upper * 100:g} %"


def vector_qml(
    *,
    interval_s: float | None = None,
    measure: str = "hit_share",
    least_s: float = 0.0,
    titles: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return the QGIS style of a layer of tiles.

    Parameters
    ----------
    measure : str
        The column that it shows, `hit_share` or `occupancy`.
    interval_s : float, optional
        Length of the interval of each row, seconds: the temporal controller shows a row for so
        long from its `begin`. Without it, the layer holds the whole time.
    least_s : float
        Occupancy of tiles that were visible for less, seconds, is hatched as uncertain.
    titles : mapping
        Titles of the fields, by name.

    Returns
    -------
    str
        QML text. Where tiles overlap, the busiest is on top.
    """
    without = ("pipe",) if interval_s is not None else ("pipe", "temporal")
    root = _measure_style(measure, least_s, without=without)
    if interval_s is not None:
        element_at(root, "temporal").set("fixedDuration", str(_shown_ms(interval_s)))
    aliases = element_at(root, "aliases")
    for number, (name, title) in enumerate(titles.items()):
        SubElement(aliases, "alias", {"index": str(number), "field": name, "name": title})
    return qgis_document(root)


def sidecar_qml(measure: str = "hit_share", least_s: float = 0.0) -> str:
    """Return the QGIS style of files that carry none: a GeoTIFF (first band) or a table.

    QGIS loads it by itself if it has the file's name with the suffix `.qml`.
    """
    root = _measure_style(measure, least_s, without=("temporal", "layerGeometryType"))
    root.set("styleCategories", "Symbology")
    return qgis_document(root)


def ground_qml() -> str:
    """Return the QGIS style of all tiles as the ground below a heat map, in one colour and hatched.

    Where nothing is drawn above it, nothing was observed; on grey paper the hatch tells it from
    classes as light as it is.
    """
    return (_HERE / "ground.qml").read_text(encoding="utf-8")


def _measure_style(measure: str, least_s: float, *, without: tuple[str, ...]) -> Element:
    """Return `occupancy.qml` with an entry for each class of a measure, without some parts."""
    root = parse(_HERE / "occupancy.qml").getroot()  # noqa: S314 - our own file
    for name in without:
        root.remove(element_at(root, name))
    for parent in ("pipe//colorrampshader", "renderer-v2/ranges", "renderer-v2/symbols"):
        if (entries := root.find(parent)) is not None:
            _repeat_for_each_class(entries, measure)
    if measure == "occupancy":
        _hatch(element_at(root, "renderer-v2"), least_s)
    element_at(root, "mapTip").text = _TIPS.get(measure, "")
    element_at(root, "renderer-v2").set("attr", measure)
    element_at(root, "renderer-v2/orderby/orderByClause").text = f'"{measure}"'
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
                element_at(entry, f".//Option[@name='{name}']").set("value", _rgba(each.colour))


def _hatch(renderer: Element, least_s: float) -> None:
    """Hatch uncertain tiles in each class, and add an entry to the legend.

    The entry is a class of its own, above all shares, that no tile is in.
    """
    pattern = element_at(parse(_HERE / "hatch.qml").getroot(), "symbol")  # noqa: S314 - our own file
    symbols = element_at(renderer, "symbols")
    for symbol, colour in zip(symbols, hatches(), strict=True):
        layer = copy.deepcopy(element_at(pattern, "layer"))
        shown = f"if({uncertain_rule(least_s)}, 'solid', 'no')"
        element_at(layer, ".//Option[@name='expression']").set("value", shown)
        _colour_lines(layer, colour)
        symbol.append(layer)
    entry = copy.deepcopy(pattern)
    entry.set("name", str(len(symbols)))
    line = element_at(entry, "layer/symbol/layer")
    line.remove(element_at(line, "data_defined_properties"))
    element_at(line, ".//Option[@name='line_style']").set("value", "solid")
    _colour_lines(element_at(entry, "layer"), HATCH_DARK)
    symbols.append(entry)
    bounds = {"lower": "2.000000000000000", "upper": "2.000000000000000"}
    named = {"symbol": entry.get("name", ""), "render": "true", "label": UNCERTAIN}
    SubElement(element_at(renderer, "ranges"), "range", named | bounds)


def _colour_lines(layer: Element, colour: str) -> None:
    for option in layer.iterfind(".//Option"):
        if option.get("name") in {"color", "line_color"}:
            option.set("value", _rgba(colour))


def element_at(root: Element, path: str) -> Element:
    """Return an element of one of our templates, which has it."""
    found = root.find(path)
    if found is None:
        raise LookupError(f"the template has no {path}")
    return found


def _shown_ms(interval_s: float) -> int:
    """Return how long a row is shown, a hundredth of a second less than its interval.

    QGIS compares the times of a GeoPackage as text, one with a Z and one without, and so takes an
    interval that ends at a moment for one that holds it. 10 ms are more than QGIS loses in
    rounding, and less than a step.
    """
    return max(0, round(interval_s * 1000) - 10)


def _rgba(colour: str) -> str:
    parts = bytes.fromhex(colour.removeprefix("#"))
    return ",".join(map(str, [*parts, 255]))


def _single(value: float) -> float:
    """Round a value to float32 as pixels are, so that a pixel on a break stays below it."""
    return float(struct.unpack("f", struct.pack("f", value))[0])


def qgis_document(root: Element) -> str:
    """Return a style or project of QGIS as text."""
    indent(root)
    heading = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    return f"{heading}\n{tostring(root, encoding='unicode')}\n"
