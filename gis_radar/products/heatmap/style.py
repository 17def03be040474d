"""Style of all heat maps: colour ramp, class breaks, and QGIS styles.

The QGIS styles are `tiles.qml.jinja` and `ground.qml`. The file loads with the standard library
only, so that a Python without the geographic packages, that of QGIS, has its classes.

The ramp runs from light yellow over red to near-black violet, in equal steps of lightness, so
that it reads the same in grey and for colour-blind eyes; dark is high, as in the paper's
section "Scalable Dynamic Occupancy Map". The breaks follow a 1-2-5 series, because occupancy
is mostly small (0.5 to 30 %), and never depend on the data, so that maps compare.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.sax.saxutils import escape

if TYPE_CHECKING:
    from jinja2 import Template

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
_LEGEND_TITLE = "Share of the observed time"
_LEGEND_SUBTITLE = "in which a tile is hit"

_HERE = Path(__file__).parent


class MeasureWords(NamedTuple):
    """Words of a measure on maps: title and subtitle of its legend, zero, no data."""

    title: str
    subtitle: str
    zero: str
    unknown: str


MAP_WORDS = {
    "hit_share": MeasureWords(_LEGEND_TITLE, _LEGEND_SUBTITLE, "never hit", "not observed"),
    "occupancy": MeasureWords(
        "Occupancy", "share of time with a vehicle", "no vehicle", "not visible"
    ),
}


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
        ColourClass(0.0, 0.0, NEVER_HIT, f"0 %, {MAP_WORDS[measure].zero}"),
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
    shown_ms = None if interval_s is None else _shown_ms(interval_s)
    return _filled(measure, least_s, layer=True, shown_ms=shown_ms, titles=titles)


def sidecar_qml(measure: str = "hit_share", least_s: float = 0.0) -> str:
    """Return the QGIS style of files that carry none: a GeoTIFF (first band) or a table.

    QGIS loads it by itself if it has the file's name with the suffix `.qml`.
    """
    return _filled(measure, least_s, layer=False, shown_ms=None, titles={})


def ground_qml(map_qml: str) -> str:
    """Return the QGIS style of all tiles as the ground below a heat map, in one colour and hatched.

    Where nothing is drawn above it, nothing was observed; on grey paper the hatch distinguishes
    it from classes as light as it is. Titles of columns are those of `map_qml`, the style of the
    map.
    """
    titles = map_qml[map_qml.index("  <aliases") : map_qml.index("  <mapTip")]
    qml = (_HERE / "ground.qml").read_text(encoding="utf-8")
    return qml.replace("  <layerGeometryType>", titles + "  <layerGeometryType>")


def _filled(measure: str, least_s: float, **more: Any) -> str:
    """Return `tiles.qml.jinja` with the classes of a measure."""
    rule = escape(uncertain_rule(least_s), {'"': "&quot;"}) if measure == "occupancy" else ""
    return text_template(_HERE / "tiles.qml.jinja").render(
        measure=measure, classes=colour_classes(measure), hatches=hatches(), rule=rule,
        tip=escape(_TIPS[measure]), rgba=_rgba, single=_single, **more,
    )  # fmt: skip


@cache
def text_template(path: Path) -> Template:
    """Return the template of a page or a QGIS style, which escapes texts."""
    from jinja2 import Environment, StrictUndefined  # noqa: PLC0415 - see above

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    return environment.from_string(path.read_text(encoding="utf-8"))


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
