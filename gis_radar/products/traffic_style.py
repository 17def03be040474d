"""QGIS style of lanes and turns: coloured by classes, turns as wide as their volume."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

from gis_radar.base import tr
from gis_radar.products.heatmap.style import text_template

VOLUMES = "volume_veh_h"
_BREAKS = (0.0, 50.0, 100.0, 200.0, 400.0, 600.0, 900.0, 1200.0, 1e6)  # of lanes, veh/h
# Not those of heat maps, on which these layers lie: one colour would mean two things.
SHADES = (
    "#9eedcc", "#79d1bb", "#52b6aa", "#269a99", "#107e85", "#02636f", "#094956", "#00313f",
)  # fmt: skip
_SHORTER_MS = 10  # less than an interval, as in heat maps: QGIS counts the end of an interval to it
_NAMED = {
    "lanes": ["name"], "turns": ["from_name", "to_name"], "sections": ["section", "direction"],
}  # fmt: skip
"""Columns that name a row of a layer."""


class LineClass(NamedTuple):
    """Class of a layer: values from `low` to `high`, their colour and label."""

    low: float
    high: float
    colour: str
    label: str

    @property
    def rgb(self) -> str:
        """Its colour as QGIS writes it."""
        return ",".join(map(str, bytes.fromhex(self.colour[1:])))


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
    classes = [
        LineClass(low, high, colour, _class_label(low, high))
        for (low, high), colour in zip(pairwise(_BREAKS), SHADES, strict=True)
    ]
    return _filled(
        column=VOLUMES, classes=classes, unit=f" {tr('veh/h')}", wide=layer == "turns", timed=True,
        shown_ms=max(0, round(interval_s * 1000) - _SHORTER_MS), titles=titles,
        tip=escape(_tip(layer, interval_s)),
        figure=_figure(interval_s) if layer == "sections" else "",
    )  # fmt: skip


def class_style(column: str, classes: Iterable[LineClass]) -> str:
    """Return the QGIS style of a layer of lanes that are coloured by the class of a column."""
    return _filled(
        column=column, classes=list(classes), unit="", wide=False, timed=False, figure=""
    )


def _class_label(low: float, high: float) -> str:
    """Return the words of a class of volumes."""
    if high == _BREAKS[-1]:
        return tr("over {low}", low=f"{low:g}")
    return tr("{low} to {high}", low=f"{low:g}", high=f"{high:g}")


def _figure(interval_s: float) -> str:
    """Return the expression of a section's label: a line with its name, one with its volume."""
    return f"\"section\" || '\\n' || \"direction\" || ': ' || {_volume(interval_s)}"


def _volume(interval_s: float) -> str:
    """Return the expression of a volume with its standard error and unit."""
    error = f'"volume_se" * {3600.0 / interval_s:.10g}'
    unit = tr("veh/h").replace("'", "''")
    return (
        f"coalesce(format_number(\"{VOLUMES}\", 0) || ' \u00b1 ' || format_number({error}, 0), "
        f"'\u2013') || ' {unit}'"
    )


def _filled(**content: Any) -> str:
    return text_template(Path(__file__).parent / "lines.qml.jinja").render(**content)


def _tip(layer: str, interval_s: float) -> str:
    """Return the map tip of QGIS, in which names are escaped."""

    def text(column: str) -> str:
        return f"[% replace(replace(\"{column}\", '&', '&amp;'), '<', '&lt;') %]"

    name = " &rarr; ".join(map(text, _NAMED[layer]))
    speed = """, [% coalesce(format_number("speed_kmh", 0), '\u2013') %] km/h"""
    speed = speed if layer == "lanes" else ""
    return f"<b>{name}</b><br>[% {_volume(interval_s)} %]{speed}"
