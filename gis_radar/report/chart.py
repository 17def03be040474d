"""Draw each lane over the time of a report: a strip a lane, on one scale."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from textwrap import shorten

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MplFigure
from matplotlib.transforms import ScaledTranslation

from gis_radar.arrays import Floats
from gis_radar.heatmap import HeatMap
from gis_radar.heatmap.picture import INK, SENSOR, SOFT, image_of_figure, png
from gis_radar.notebooks import FONTS
from gis_radar.report.content import Figure
from gis_radar.report.lanes import LaneSums
from gis_radar.steps import Clock
from gis_radar.words import direction, figure_text, percent, tr

STRIPS, MOST_CHARTS = 14, 4  # lanes of a chart, which fills a page; as many charts
WIDTH_IN, STRIP_IN, EDGES_IN = 7.0, 0.56, 1.0
NAMES_IN, BESIDE_IN = 0.9, 0.42  # least room for names; from a name to its strip, for percent
DPI = 160
TOPS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)  # of the scale
BAND, UNSEEN = "#a8c4e0", "#e3e6e9"
MOST_TICKS = 7
STREET_LETTERS = 20  # beside a strip


def draw_lanes_over_time(
    heat: HeatMap, sums: LaneSums, table: pd.DataFrame, clock: Clock
) -> list[Figure]:
    """Draw the share of each lane by interval, with its standard error; nothing of one interval.

    Parameters
    ----------
    heat : HeatMap
        Whose intervals.
    sums : LaneSums
        Its sums by lane and interval.
    table : DataFrame
        From :func:`gis_radar.report.lanes.lane_table`: lanes with a share, in this order.
    clock : Clock
        Whose times stand below.
    """
    if len(heat.timeline) < 2:
        return []
    lanes = table[table["share"].notna()].head(STRIPS * MOST_CHARTS)
    place = {lane.number: i for i, lane in enumerate(sums.lanes)}
    rows = [place[int(number)] for number in lanes["lane"]]
    with np.errstate(invalid="ignore", divide="ignore"):
        share, error = sums.part_s / sums.base_s, sums.error_s / sums.base_s
    if not rows or not np.isfinite(share[:, rows]).any():
        return []
    high = float(np.nanmax(share[:, rows]))
    top = next((each for each in TOPS if each >= high), 1.0)
    figures = []
    for first in range(0, len(rows), STRIPS):
        part = rows[first : first + STRIPS]
        names = [_named(row) for _, row in lanes.iloc[first : first + STRIPS].iterrows()]
        strips = [(name, share[:, i], error[:, i]) for name, i in zip(names, part, strict=True)]
        figures.append(_chart(heat, strips, top, clock))
    return figures


def _named(row: pd.Series) -> str:
    """Return how a strip is called."""
    street = shorten(str(row.get("street") or ""), STREET_LETTERS, placeholder="\u2026")
    number = f"{row['lane']} {direction(row['east_m'], row['north_m'])}"
    return f"{street}\n{number}" if street else number


def _chart(
    heat: HeatMap, strips: Sequence[tuple[str, Floats, Floats]], top: float, clock: Clock
) -> Figure:
    height = EDGES_IN + STRIP_IN * len(strips)
    edges = [begin for begin, _ in heat.timeline.spans()] + [heat.timeline.span(-1)[1]]
    seconds = np.array([(each - edges[0]).total_seconds() for each in edges])
    with mpl.rc_context(FONTS):
        figure = MplFigure(figsize=(WIDTH_IN, height), dpi=DPI)
        axes = figure.subplots(len(strips), 1, sharex=True, squeeze=False)[:, 0]
        for ax, (_, share, error) in zip(axes, strips, strict=True):
            _add_strip(ax, seconds, share, error, top)
        names_in = _add_names(list(axes), [name for name, _, _ in strips])
        figure.subplots_adjust(
            left=(names_in + BESIDE_IN) / WIDTH_IN, right=1 - 0.32 / WIDTH_IN,
            top=1 - 0.32 / height, bottom=0.62 / height, hspace=0.22,
        )  # fmt: skip
        _add_times(axes[-1], edges, seconds, clock)
        figure.text(
            0.012, 1 - 0.19 / height, _heading(heat.measure), fontsize=8.5, color=SOFT, va="center"
        )
        picture = image_of_figure(figure).convert("RGB").quantize(96)
    return Figure(
        png=png(picture), width=picture.width, height=picture.height, tallest_mm=212.0,
        caption=_caption(heat.measure), alt=_described(heat, strips, clock),
    )  # fmt: skip


def _add_names(axes: Sequence[Axes], names: Sequence[str]) -> float:
    """Write the names left of their strips; return the inches that the longest takes."""
    widest = NAMES_IN
    for ax, name in zip(axes, names, strict=True):
        label = ax.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=8.5, color=INK)
        beside = ScaledTranslation(-BESIDE_IN, 0.0, ax.figure.dpi_scale_trans)
        ax.yaxis.set_label_coords(0.0, 0.5, transform=ax.transAxes + beside)
        widest = max(widest, label.get_window_extent().width / DPI + 0.08)
    return widest


def _add_strip(ax: Axes, seconds: Floats, share: Floats, error: Floats, top: float) -> None:
    """Draw one lane: its share as steps, the error as a band, grey where it was not seen."""
    seen = np.isfinite(share)
    low, high = (np.nan_to_num(np.clip(share + side * error, 0, top)) for side in (-1, 1))
    for i in np.flatnonzero(~seen):
        ax.axvspan(seconds[i], seconds[i + 1], facecolor=UNSEEN, edgecolor=SOFT, hatch="////", lw=0)
    if np.isfinite(error).any():
        ax.fill_between(
            seconds, np.append(low, low[-1]), np.append(high, high[-1]), step="post", color=BAND,
            where=np.append(seen, seen[-1]), linewidth=0,
        )  # fmt: skip
    ax.stairs(share, seconds, color=SENSOR, linewidth=1.3, baseline=None)
    ax.set(ylim=(0, top), xlim=(seconds[0], seconds[-1]))
    ax.set_yticks([0, top], ["0", f"{top * 100:g}"], fontsize=7)
    ax.tick_params(length=2, color=SOFT, labelcolor=SOFT)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(SOFT)


def _add_times(ax: Axes, edges: Sequence[datetime], seconds: Floats, clock: Clock) -> None:
    """Write times below the last strip, at begins of intervals, and in which zone they are."""
    every = max(1, -(-(len(edges) - 1) // MOST_TICKS))
    chosen = list(range(0, len(edges), every))
    labels = [clock.tick(edges[i], edges[0]) for i in chosen]
    ax.set_xticks(seconds[chosen], labels, fontsize=7.5)
    ax.tick_params(axis="x", length=3)
    ax.set_xlabel(clock.name, fontsize=8, color=SOFT)


def _heading(measure: str) -> str:
    if measure == "coverage":
        return tr("Lane; coverage, percent of visible time; band: standard error")
    return tr("Lane; radar hits, percent of observed time")


def _caption(measure: str) -> str:
    if measure == "coverage":
        text = (
            "Each lane over the time, all on one scale: the mean coverage of its tiles in each "
            "interval, and in the band what its standard error leaves open. Grey: not visible."
        )
    else:
        text = (
            "Each lane over the time, all on one scale: the share of the observed time in which "
            "radar hit its tiles. Compare a lane with itself only. Grey: not observed."
        )
    return tr(text)


def _described(heat: HeatMap, strips: Sequence[tuple[str, Floats, Floats]], clock: Clock) -> str:
    """Return the chart in words: of each lane, its highest interval."""
    lines = []
    for name, share, _ in strips:
        if np.isfinite(share).any():
            best = int(np.nanargmax(share))
            span = clock.span(*heat.timeline.span(best))
            lines.append(f"{name}: {percent(float(share[best]), 0)}, {span}")
    text = "Chart of {n} lanes over {intervals} intervals. Highest interval of each: {lines}."
    return tr(
        text, n=len(strips), intervals=figure_text(len(heat.timeline)), lines="; ".join(lines)
    )
