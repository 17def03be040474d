"""What stands around the map in a picture: titles, legend, scale bar, north arrow, figures."""

from __future__ import annotations

import math
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from gis_radar.clock import STEPS_PER_SECOND, step_begin
from gis_radar.crs import name_of
from gis_radar.heatmap import style
from gis_radar.heatmap.tally import Tally

INK, SOFT = "#1d2126", "#59616a"


def add_scale_bar(figure: Figure, right_in: float, metre_in: float) -> None:
    """Draw a scale bar and a north arrow over the upper right corner of the map.

    Parameters
    ----------
    figure : Figure
        Where; both stand beside the title, so that they hide no tile.
    right_in : float
        Right edge of the map, inches.
    metre_in : float
        Inches on paper of a metre.
    """
    bar_m = round_length(1.4 / metre_in)
    bar_in = bar_m * metre_in
    right, base = right_in - 0.55, figure.get_size_inches()[1] - 0.72
    left = right - bar_in
    inches = figure.dpi_scale_trans
    for start, face in ((left, INK), (left + bar_in / 2, "white")):
        bar = Rectangle(
            (start, base), bar_in / 2, 0.06, transform=inches,
            facecolor=face, edgecolor=INK, linewidth=0.6,
        )  # fmt: skip
        figure.add_artist(bar)
    text: dict[str, Any] = {"transform": inches, "color": INK, "va": "bottom", "ha": "center"}
    figure.text(left, base + 0.11, "0", fontsize=8, **text)
    figure.text(right, base + 0.11, f"{bar_m:g} m", fontsize=8, **text)
    tip = right_in - 0.1
    for side, face in ((-1, INK), (1, "white")):
        corners = [(tip, base + 0.24), (tip + side * 0.07, base), (tip, base + 0.05)]
        arrow = Polygon(corners, transform=inches, facecolor=face, edgecolor=INK, linewidth=0.6)
        figure.add_artist(arrow)
    figure.text(tip, base + 0.27, "N", fontsize=7, fontweight="bold", **text)


def round_length(longest_m: float) -> float:
    """Return the longest length of 1, 2 or 5 times a power of ten that is not over `longest_m`."""
    power = 10.0 ** math.floor(math.log10(longest_m))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= longest_m * (1 + 1e-9))


def add_titles(figure: Figure, tally: Tally, left_in: float) -> None:
    """Write the title and the time span over the map, and what is meant under it."""
    width_in, height_in = figure.get_size_inches()
    left = left_in / width_in
    line: dict[str, Any] = {"ha": "left", "va": "baseline"}
    figure.text(
        left, 1 - 0.42 / height_in, "Occupancy heat map",
        fontsize=17, fontweight="bold", color=INK, **line,
    )  # fmt: skip
    figure.text(left, 1 - 0.68 / height_in, time_span(tally), fontsize=10, color=SOFT, **line)
    figure.text(left, 0.2 / height_in, _foot(tally), fontsize=6.5, color=SOFT, **line)


def _foot(tally: Tally) -> str:
    crs = tally.crs
    return (
        f"{crs.name} ({name_of(crs)[:20]}). A tile is occupied in a step of 50 ms when a radar "
        "detection falls in it; overlapping views count once."
    )


def time_span(tally: Tally, interval: int | None = None) -> str:
    """Say the time span, or that of an interval, in UTC, no longer than needed."""
    times, row = (tally.whole, 0) if interval is None else (tally.timeline, interval)
    first, after = int(times.begin[row]), int(times.end[row])
    begin, end = step_begin(first), step_begin(after)
    finest = "milliseconds" if (first % STEPS_PER_SECOND or after % STEPS_PER_SECOND) else "seconds"
    date, time = begin.date().isoformat(), begin.time().isoformat(timespec=finest)
    if after - first == 1:
        return f"{date}  {time} UTC, one step of 50 ms"
    until = end.time().isoformat(timespec=finest)
    if begin.date() != end.date():
        until = f"{end.date().isoformat()}  {until}"
    return f"{date}  {time} to {until} UTC"


def add_legend(ax: Axes) -> None:
    """Write the classes of occupancy beside axes."""
    classes = [(level.colour, level.label) for level in reversed(style.levels())]
    handles = [
        Rectangle((0, 0), 1, 1, facecolor=colour, edgecolor=SOFT, linewidth=0.5, label=label)
        for colour, label in (*classes, (style.NOT_OBSERVED, style.NOT_OBSERVED_LABEL))
    ]
    ax.legend(
        handles=handles, title=style.LEGEND_TITLE, loc="upper left", bbox_to_anchor=(1.01, 1.0),
        borderaxespad=0.0, frameon=False, fontsize="small", title_fontsize="small",
        alignment="left",
    )  # fmt: skip


def add_side(ax: Axes, tally: Tally, dpi: float) -> None:
    """Draw the legend and the figures of the map, in inches from the top left."""
    box = ax.get_window_extent()
    ax.set_xlim(0, box.width / dpi)
    ax.set_ylim(box.height / dpi, 0)
    ax.axis("off")
    ax.text(0.25, 0.12, style.LEGEND_TITLE, fontsize=9.5, fontweight="bold", color=INK)
    ax.text(0.25, 0.3, "in which a tile is hit", fontsize=8.5, color=SOFT)
    y = 0.5
    for level in reversed(style.levels()):
        gap = 0.08 if level.upper == 0.0 else 0.0
        _add_swatch(ax, y + gap, level.colour, level.label)
        y += 0.24 + gap
    _add_swatch(ax, y + 0.08, style.NOT_OBSERVED, style.NOT_OBSERVED_LABEL)
    for number, (name, value) in enumerate(_facts(tally)):
        ax.text(0.25, y + 0.78 + number * 0.4, name, fontsize=7, color=SOFT)
        ax.text(0.25, y + 0.95 + number * 0.4, value, fontsize=8.5, color=INK, parse_math=False)


def _add_swatch(ax: Axes, y: float, colour: str, label: str) -> None:
    ax.add_patch(Rectangle((0.25, y), 0.34, 0.24, facecolor=colour, edgecolor=SOFT, linewidth=0.5))
    ax.text(0.7, y + 0.125, label, fontsize=8.5, color=INK, va="center")


def _facts(tally: Tally) -> list[tuple[str, str]]:
    known, sensors = tally.figures(), tally.sensors
    facts = [
        ("Sensors", ", ".join(sensors) if len(", ".join(sensors)) < 24 else str(len(sensors))),
        ("Tiles observed", f"{known['tiles_observed']:,}".replace(",", " ")),
        ("Tiles hit", f"{known['tiles_hit']:,}".replace(",", " ")),
    ]
    if "busiest_tile" in known:
        occupied_s, observed_s = known["busiest_occupied_s"], known["busiest_observed_s"]
        share = f"{known['busiest_occupancy'] * 100:.1f} %"
        facts.append(("Busiest tile", f"{occupied_s:.6g} of {observed_s:.6g} s, {share}"))
    return facts
