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

from gis_radar.arrays import Booleans, Floats
from gis_radar.heatmap import HeatMap
from gis_radar.heatmap.picture import INK, SENSOR, SOFT, image_of_figure, png
from gis_radar.notebooks import FONTS
from gis_radar.report.content import Chart, Strip
from gis_radar.report.lanes import LaneSums
from gis_radar.steps import Clock
from gis_radar.words import direction, figure_text, percent, street_label, tr

STRIPS, MOST_CHARTS = 14, 4  # lanes of a chart, which fills a page; as many charts
WIDTH_IN, STRIP_IN, EDGES_IN = 7.0, 0.56, 1.0
NAMES_IN, BESIDE_IN = 0.9, 0.42  # least room for names; from a name to its strip, for percent
DPI = 160
TOPS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)  # of the scale
BAND, UNSEEN = "#a8c4e0", "#e3e6e9"
MOST_TICKS = 7
ROUND_S = (
    *(5, 10, 20, 30, 60, 120, 300, 600, 900, 1800),
    *(hours * 3600 for hours in (1, 2, 3, 4, 6, 12, 24)),
)  # between the times below a chart
STREET_LETTERS = 20  # beside a strip
TALLEST_MM = 212.0  # on paper, of a chart of as many strips as fit
CLEAR = 0.05  # of the scale, free below and above: a line of 0 is not the axis
ACROSS, UP = 1000, 100  # units of a strip on the page, to the right and upwards


def draw_lanes_over_time(
    heat: HeatMap, sums: LaneSums, table: pd.DataFrame, clock: Clock
) -> list[Chart]:
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
    charts = []
    for first in range(0, len(rows), STRIPS):
        part = rows[first : first + STRIPS]
        names = [_named(row) for _, row in lanes.iloc[first : first + STRIPS].iterrows()]
        strips = [(name, share[:, i], error[:, i]) for name, i in zip(names, part, strict=True)]
        charts.append(_chart(heat, strips, top, clock))
    return charts


def _named(row: pd.Series) -> str:
    """Return how a strip is called."""
    known = shorten(str(row.get("street") or ""), STREET_LETTERS, placeholder="\u2026")
    street = street_label(known, row.get("street_part"))
    number = f"{row['lane']} {direction(row['east_m'], row['north_m'])}"
    return f"{street}\n{number}" if street else number


def _chart(
    heat: HeatMap, strips: Sequence[tuple[str, Floats, Floats]], top: float, clock: Clock
) -> Chart:
    height = EDGES_IN + STRIP_IN * len(strips)
    edges = [begin for begin, _ in heat.timeline.spans()] + [heat.timeline.span(-1)[1]]
    seconds = np.array([(each - edges[0]).total_seconds() for each in edges])
    times = _times(edges, seconds, clock)
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
        _add_times(axes[-1], times, clock)
        figure.text(
            0.012, 1 - 0.19 / height, _heading(heat.measure), fontsize=8.5, color=SOFT, va="center"
        )
        picture = image_of_figure(figure).convert("RGB").quantize(96)
    place = seconds / seconds[-1]
    return Chart(
        png=png(picture), width=picture.width, height=picture.height,
        tallest_mm=TALLEST_MM * height / (EDGES_IN + STRIP_IN * STRIPS),
        caption=_caption(heat.measure), alt=_described(heat, strips, clock),
        heading=_heading(heat.measure), top=f"{top * 100:g}", below=clock.name,
        strips=[_strip(name, place, share / top, error / top) for name, share, error in strips],
        times=[(float(at / seconds[-1]), label) for at, label in times],
    )  # fmt: skip


def _strip(name: str, place: Floats, share: Floats, error: Floats) -> Strip:
    """Return a strip as paths, of the place of each edge and shares of the scale."""
    seen = np.isfinite(share)
    low, high = (np.clip(share + side * error, 0.0, 1.0) for side in (-1, 1))
    unseen = [
        (float(place[run.start]), float(place[run.stop] - place[run.start])) for run in _runs(~seen)
    ]
    return Strip(
        name=name,
        line="".join(f"M{_path(place, share, run)}" for run in _runs(seen)),
        band="".join(
            f"M{_path(place, high, run)}L{_path(place, low, run, back=True)}Z"
            for run in _runs(np.isfinite(error))
        ),
        unseen=unseen,
    )


def _runs(which: Booleans) -> list[slice]:
    """Return the runs of intervals that are meant."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8)))
    return [slice(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def _path(place: Floats, share: Floats, run: slice, *, back: bool = False) -> str:
    """Return the steps of a run of intervals as points of a path, from left to right or back."""
    x = np.repeat(np.rint(place[run.start : run.stop + 1] * ACROSS).astype(int), 2)[1:-1]
    y = np.repeat(np.round((1.0 - share[run]) * UP, 1), 2)
    points = [f"{right} {down:g}" for right, down in zip(x.tolist(), y.tolist(), strict=True)]
    return " ".join(points[::-1] if back else points)


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
    for run in _runs(~np.isfinite(share)):
        ax.axvspan(
            seconds[run.start], seconds[run.stop],
            facecolor=UNSEEN, edgecolor=SOFT, hatch="////", lw=0,
        )  # fmt: skip
    low, high = (np.clip(share + side * error, 0, top) for side in (-1, 1))
    for run in _runs(np.isfinite(error)):
        edges = seconds[run.start : run.stop + 1]
        ax.stairs(high[run], edges, baseline=low[run], color=BAND, fill=True, linewidth=0)
    ax.stairs(share, seconds, color=SENSOR, linewidth=1.3, baseline=None)
    ax.set(ylim=(-CLEAR * top, (1 + CLEAR) * top), xlim=(seconds[0], seconds[-1]))
    ax.set_yticks([0, top], ["0", f"{top * 100:g}"], fontsize=7)
    ax.tick_params(length=2, color=SOFT, labelcolor=SOFT)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(SOFT)


def _times(edges: Sequence[datetime], seconds: Floats, clock: Clock) -> list[tuple[float, str]]:
    """Return the times below a chart, in seconds from the begin, and their labels."""
    every = max(1, -(-(len(edges) - 1) // MOST_TICKS))
    chosen = _round_times(edges, seconds, clock) or list(range(0, len(edges), every))
    return [(float(seconds[i]), clock.tick(edges[i], edges[chosen[0]])) for i in chosen]


def _round_times(edges: Sequence[datetime], seconds: Floats, clock: Clock) -> list[int]:
    """Return the edges at round times of the day, as few as have room; none where none are."""
    local = [each.astimezone(clock.zone) for each in edges]
    of_day = [(each.hour * 60 + each.minute) * 60 + each.second for each in local]
    for apart in ROUND_S:
        chosen = [i for i, second in enumerate(of_day) if second % apart == 0]
        if seconds[-1] / apart <= MOST_TICKS:
            return chosen if len(chosen) > 1 else []
    return []


def _add_times(ax: Axes, times: Sequence[tuple[float, str]], clock: Clock) -> None:
    """Write times below the last strip, and in which zone they are."""
    ax.set_xticks([at for at, _ in times], [label for _, label in times], fontsize=7.5)
    ax.tick_params(axis="x", length=3)
    ax.set_xlabel(clock.name, fontsize=8, color=SOFT)


def _heading(measure: str) -> str:
    if measure == "occupancy":
        return tr("Lane; occupancy, percent of visible time; band: standard error")
    return tr("Lane; radar hits, percent of observed time")


def _caption(measure: str) -> str:
    if measure == "occupancy":
        text = (
            "Each lane over the time, all on one scale: the mean occupancy of its tiles in each "
            "interval, and in the band what its standard error leaves open. Hatched grey: not "
            "visible."
        )
    else:
        text = (
            "Each lane over the time, all on one scale: the share of the observed time in which "
            "radar hit its tiles. Compare a lane with itself only. Hatched grey: not observed."
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
