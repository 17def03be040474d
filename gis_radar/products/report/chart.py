"""Draw each lane over the time of a report: a strip a lane, on one scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from textwrap import shorten

import numpy as np
import pandas as pd

from gis_radar.base import (
    Booleans,
    Clock,
    Floats,
    direction,
    figure_text,
    percent,
    street_label,
    tr,
)
from gis_radar.products.heatmap.heatmap import HeatMap
from gis_radar.products.report.content import Chart, Strip

_STRIPS, _MOST_CHARTS = 10, 6  # lanes of a chart; most charts, of which the first is printed
_TOPS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)  # highest values that the scale may have
MOST_TICKS = 7  # times below a chart
_ROUND_S = (
    *(5, 10, 20, 30, 60, 120, 300, 600, 900, 1800),
    *(hours * 3600 for hours in (1, 2, 3, 4, 6, 12, 24)),
)  # distances between the times below a chart
_STREET_LETTERS = 20  # most letters of a street beside a strip
_ACROSS, _UP = 1000, 100  # units of a strip on the page, to the right and upwards


def draw_lanes_over_time(
    heat: HeatMap, by_interval: pd.DataFrame, table: pd.DataFrame, clock: Clock
) -> list[Chart]:
    """Draw the share of each lane by interval, with its standard error; nothing of one interval.

    Parameters
    ----------
    heat : HeatMap
        The heat map.
    by_interval : DataFrame
        Its sums by lane and interval, from :func:`gis_radar.products.report.lanes.sums_of`.
    table : DataFrame
        From :func:`gis_radar.products.report.lanes.lane_table`: lanes with a share, in this order.
    clock : Clock
        Clock by which the times below are written.
    """
    if len(heat.timeline) < 2:
        return []
    lanes = table[table["share"].notna()].head(_STRIPS * _MOST_CHARTS)
    share, error = (
        by_interval[name].unstack(sort=False)[lanes["lane"]]  # noqa: PD010 - a value each
        for name in ("share", "share_se")
    )
    if not np.isfinite(share).any(axis=None):
        return []
    high = float(np.nanmax(share))
    top = next((each for each in _TOPS if each >= high), 1.0)
    charts = []
    for first in range(0, len(lanes), _STRIPS):
        strips = [
            (_strip_name(row), share[row["lane"]].to_numpy(), error[row["lane"]].to_numpy())
            for _, row in lanes.iloc[first : first + _STRIPS].iterrows()
        ]
        charts.append(_chart(heat, strips, top, clock))
    return charts


def _strip_name(row: pd.Series) -> str:
    """Return the name of a lane's strip: its street, number and direction."""
    known = shorten(str(row.get("street") or ""), _STREET_LETTERS, placeholder="\u2026")
    street = street_label(known, row.get("street_part"))
    number = f"{row['lane']} {direction(row['east_m'], row['north_m'])}"
    return f"{street}\n{number}" if street else number


def edges_of(spans: Sequence[tuple[datetime, datetime]]) -> tuple[list[datetime], list[int]]:
    """Return the edges of intervals and gaps, and the number of the interval in each; -1: a gap."""
    edges, interval = [spans[0][0]], list[int]()
    for number, (begin, end) in enumerate(spans):
        if begin > edges[-1]:
            edges.append(begin)
            interval.append(-1)
        edges.append(end)
        interval.append(number)
    return edges, interval


def _chart(
    heat: HeatMap, strips: Sequence[tuple[str, Floats, Floats]], top: float, clock: Clock
) -> Chart:
    edges, interval = edges_of(heat.timeline.spans())

    def spread(values: Floats) -> Floats:
        return np.append(values / top, np.nan)[interval]

    drawn = [(name, spread(share), spread(error)) for name, share, error in strips]
    return chart_over(
        edges, drawn, clock, caption=_caption(heat.measure), alt=_alt_text(heat, strips, clock),
        heading=_heading(heat.measure), top=f"{top * 100:g}",
    )  # fmt: skip


def chart_over(
    edges: Sequence[datetime], strips: Iterable[tuple[str, Floats, Floats]], clock: Clock,
    **words: str,
) -> Chart:  # fmt: skip
    """Return a chart of strips over time.

    Parameters
    ----------
    edges : sequence of datetime
        Edges of the intervals.
    strips : iterable of (name, share, error)
        As for :func:`strip_of`, from top to bottom.
    clock : Clock
        Clock by which the times below are written.
    **words
        The texts of the chart.
    """
    seconds = np.array([(each - edges[0]).total_seconds() for each in edges])
    times = times_below(edges, seconds, clock)
    return Chart(
        strips=[strip_of(name, seconds / seconds[-1], *known) for name, *known in strips],
        times=[(float(at / seconds[-1]), label) for at, label in times], below=clock.name, **words,
    )  # fmt: skip


def strip_of(name: str, place: Floats, share: Floats, error: Floats) -> Strip:
    """Return a strip as paths, of the place of each edge and shares of the scale.

    Parameters
    ----------
    name : str
        Name of the strip.
    place : (n + 1,) array
        Places of the edges of the intervals, from 0 to 1.
    share, error : (n,) array
        Value and error of each interval, as shares of the scale; NaN where nothing was seen.

    Returns
    -------
    Strip
        Paths of SVG: the line, the band of the error, and begin and width of what was not seen.
    """
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
    """Return the runs of intervals for which `which` is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8)))
    return [slice(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def _path(place: Floats, share: Floats, run: slice, *, back: bool = False) -> str:
    """Return the steps of a run of intervals as points of a path, from left to right or back."""
    x = np.repeat(np.rint(place[run.start : run.stop + 1] * _ACROSS).astype(int), 2)[1:-1]
    y = np.repeat(np.round((1.0 - share[run]) * _UP, 1), 2)
    points = [f"{right} {down:g}" for right, down in zip(x.tolist(), y.tolist(), strict=True)]
    return " ".join(points[::-1] if back else points)


def times_below(
    edges: Sequence[datetime], seconds: Floats, clock: Clock
) -> list[tuple[float, str]]:
    """Return the times below a chart: round ones where there are enough of them.

    Parameters
    ----------
    edges : sequence of datetime
        Edges of the intervals.
    seconds : (n,) array
        The edges as seconds from the first one.
    clock : Clock
        Clock by which they are written.

    Returns
    -------
    list of (float, str)
        Seconds from the begin, and labels.
    """
    every = max(1, -(-(len(edges) - 1) // MOST_TICKS))
    chosen = _round_times(edges, seconds, clock) or list(range(0, len(edges), every))
    return [(float(seconds[i]), clock.tick(edges[i], edges[chosen[0]])) for i in chosen]


def _round_times(edges: Sequence[datetime], seconds: Floats, clock: Clock) -> list[int]:
    """Return the edges at round times of the day, at most `MOST_TICKS`; none if there are none."""
    local = [each.astimezone(clock.zone) for each in edges]
    of_day = [(each.hour * 60 + each.minute) * 60 + each.second for each in local]
    for apart in _ROUND_S:
        chosen = [i for i, second in enumerate(of_day) if second % apart == 0]
        if seconds[-1] / apart <= MOST_TICKS:
            return chosen if len(chosen) > 1 else []
    return []


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


def _alt_text(heat: HeatMap, strips: Sequence[tuple[str, Floats, Floats]], clock: Clock) -> str:
    """Return a description of the chart: the highest interval of each lane."""
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
