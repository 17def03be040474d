"""Draw a heat map: the figure for a report with legend and time, and plots."""

from __future__ import annotations

import textwrap
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gis_radar.base import (
    FONTS,
    Clock,
    Floats,
    Reporter,
    axes_or_new,
    figure_text,
    in_language,
    label_map,
    name_of,
    percent,
    tr,
)
from gis_radar.hdmap import quads
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.intervals import When
from gis_radar.products.heatmap.occupancy import surest
from gis_radar.products.heatmap.picture import (
    INK,
    SOFT,
    STRIPE,
    Extent,
    add_scale_bar,
    legend_in_words,
    map_extent,
    map_picture,
)

_DPI = 200
_FINER = 2  # pixels of the picture for each pixel of the figure, so that edges are smooth
_WIDTH_IN = 10.0  # width of the figure
_MAP_WIDTH_IN = 7.15  # width of the map in it
_MAP_HEIGHT_IN = (5.5, 8.6)  # lowest, which the legend needs, and highest
_EDGE_IN = 0.3  # left of the map
_TITLE_IN = 0.85  # height of the title and two lines below it
_SMALL, _LINE = 8.5, 132  # points of small letters, and how many of them fit in a line
_BELOW_TITLE = 82  # letters: as far as the scale bar
# Points; letters that fit, beside the north arrow.
TITLE, _TITLE_LETTERS, _HEAD_LETTERS = 17, 46, 26
_LINE_IN = 0.16  # height of a line of small letters
_FRAME = "#9aa1a8"
_HATCH, _UNSURE_HATCH = "////", "\\\\\\"
_APART = {style.NEVER_HIT, style.UNCERTAIN, style.NOT_OBSERVED}  # in the legend
_TITLES = {"hit_share": "Hit share heat map", "occupancy": "Occupancy heat map"}
_MEANINGS = {
    "hit_share": (
        "A tile is hit in a step of 50 ms when a radar detection falls in it; overlapping "
        "views count once."
    ),
    "occupancy": (
        "20 % are 12 seconds of every minute with a vehicle on the tile, moving or waiting. "
        "Uncertain: the standard error (±) is as large as the value and 2 points or more, or the "
        "tile was visible for less than half as long as the best seen one. Not visible: no sensor "
        "sees it. Highest tile: the highest value once its ± is taken off."
    ),
}
_PLOT_PIXELS, SMALL_PIXELS = 1_100_000, 400_000  # pixels of a plot (180 an inch), a notebook card


def draw(
    tally: Tally,
    ax: Axes | None = None,
    *,
    interval: When = None,
    begin: Any = None,
    end: Any = None,
    legend: bool = True,
    most_pixels: int = _PLOT_PIXELS,
) -> Axes:
    """Draw the tiles in the classes of all heat maps, the busiest on top.

    The plot shows occupancy where vehicles are known, else hit share, in the labels' language.

    Parameters
    ----------
    ax : Axes, optional
        Axes to draw on; by default those of a new figure of pyplot.
    interval : int, slice, str or datetime, optional
        Number of the interval, from 0 or negative from the end, or a time in it, such as
        `2025-06-12 07:30` by the clocks of the site; by default the whole time.
    begin, end : str or datetime, optional
        Times between which all intervals are taken, in place of `interval`.
    legend : bool
        Whether a legend of the classes is drawn beside it.
    most_pixels : int
        Largest number of pixels of the picture.

    Returns
    -------
    Axes
        The axes, in metres of the map, cropped to the tiles that were observed.

    Raises
    ------
    UsageError
        If there is no such interval.
    """
    chosen = tally.chosen(interval, begin=begin, end=end)
    share, vague = tally.shown(chosen), tally.uncertain(chosen)
    ax = axes_or_new(ax, (8.5, 6.0))
    extent = _extent(tally, (0.0, np.inf))
    map_picture(quads(tally.tiles), extent, most_pixels).show(ax, share, vague)
    with in_language(tally.labels.language):
        label_map(ax)
        ax.set_title(time_span(tally, chosen), fontsize="medium")
        if legend:
            _add_legend(ax, tally.measure)
    return ax


def _extent(tally: Tally, aspect: tuple[float, float]) -> Extent:
    """Return the extent of the tiles observed in the whole time."""
    return map_extent(quads(tally.tiles), tally.shares().observed_s > 0, aspect)


def _swatch(corner: tuple[float, float], size: tuple[float, float], colour: str) -> Rectangle:
    """Return a field of the legend, hatched where its colour means not observed or uncertain."""
    field = Rectangle(corner, *size, edgecolor=SOFT, linewidth=0.5)
    if colour == style.UNCERTAIN:
        field.set(facecolor=style.RAMP[0], hatch=_UNSURE_HATCH, edgecolor=style.HATCH_DARK)
        return field
    field.set_facecolor(colour)
    if colour == style.NOT_OBSERVED:
        field.set(hatch=_HATCH, edgecolor=STRIPE)
    return field


def _add_legend(ax: Axes, measure: str) -> None:
    """Write the classes of a measure beside axes."""
    colours, labels = zip(*legend_in_words(measure), strict=True)
    handles = [_swatch((0, 0), (1, 1), colour) for colour in colours]
    ax.legend(
        handles, labels, title=tr(style.MAP_WORDS[measure].title), loc="upper left",
        bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, frameon=False, fontsize="small",
        title_fontsize="small", alignment="left",
    )  # fmt: skip


def write_figure(tally: Tally, path: Path, reporter: Reporter) -> None:
    """Write the picture as PNG, 2000 pixels wide."""
    reporter.progress("drawing the picture", 0, 1)
    with mpl.rc_context(FONTS), in_language(tally.labels.language):
        figure = heatmap_figure(tally)
        named = filter(None, (tally.labels.title, tr(_TITLES[tally.measure])))
        about = {"Title": ", ".join(named), "Description": time_span(tally)}
        if tally.labels.sources:
            about["Source"] = "; ".join(tally.labels.sources)
        figure.savefig(path, dpi=_DPI, metadata=about)
    reporter.progress("drawing the picture", 1, 1)


def heatmap_figure(tally: Tally) -> Figure:
    """Draw the page of a heat map: the map, a title above, explanations beside and below.

    Parameters
    ----------
    tally : Tally
        The heat map.

    Returns
    -------
    Figure
        Not yet written to a file.
    """
    lowest, highest = (tall / _MAP_WIDTH_IN for tall in _MAP_HEIGHT_IN)
    extent = _extent(tally, (lowest, highest))
    foot_in = 0.26 + _LINE_IN * len(_foot(tally))
    width_m, height_m = extent[1] - extent[0]
    tall_in = _MAP_WIDTH_IN * height_m / width_m
    title_in = _TITLE_IN + _LINE_IN * (len(_head(tally)) - 2)
    figure = Figure(figsize=(_WIDTH_IN, tall_in + title_in + foot_in), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    ax = _axes(figure, _EDGE_IN, foot_in, _MAP_WIDTH_IN, tall_in)
    _add_map(ax, tally, extent, _MAP_WIDTH_IN)
    _add_detail(ax, tally, extent)
    _frame(ax, _FRAME)
    beside = _EDGE_IN + _MAP_WIDTH_IN
    over_in = float(figure.get_size_inches()[1]) - 0.72  # beside the title, off the tiles
    add_scale_bar(figure, (beside, over_in), _MAP_WIDTH_IN / float(width_m))
    _add_titles(figure, tally)
    _add_side(_axes(figure, beside, foot_in, _WIDTH_IN - beside, tall_in), tally)
    return figure


def _axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Add axes at a place given in inches."""
    across, up = figure.get_size_inches()
    return figure.add_axes((left / across, bottom / up, width / across, height / up))


def _add_map(ax: Axes, tally: Tally, extent: Extent, width_in: float) -> None:
    """Draw the whole time on axes of a given width."""
    width_m, height_m = extent[1] - extent[0]
    most_pixels = (width_in * _DPI * _FINER) ** 2 * float(height_m / width_m)
    picture = map_picture(quads(tally.tiles), extent, int(most_pixels))
    box = ax.get_window_extent()
    dots = round(box.width), round(box.height)
    picture.show(ax, tally.shown(), tally.uncertain(), dots=dots)
    ax.set(xlim=(extent[0][0], extent[1][0]), ylim=(extent[0][1], extent[1][1]))


def _add_titles(figure: Figure, tally: Tally) -> None:
    """Write title and time span above the map, and meaning and sources below it."""
    width_in, height_in = figure.get_size_inches()
    left = _EDGE_IN / width_in
    line: dict[str, Any] = {"ha": "left", "va": "baseline", "parse_math": False}
    title, *below = _head(tally)
    size = max(TITLE * min(1.0, _TITLE_LETTERS / len(title)), _SMALL)
    figure.text(
        left, 1 - 0.42 / height_in, title, fontsize=size, fontweight="bold", color=INK, **line
    )
    for number, text in enumerate(below):
        down = 1 - (0.68 + number * _LINE_IN) / height_in
        figure.text(left, down, text, fontsize=_SMALL, color=SOFT, **line)
    for number, text in enumerate(reversed(_foot(tally))):
        up = (0.2 + number * _LINE_IN) / height_in
        figure.text(left, up, text, fontsize=_SMALL, color=SOFT, **line)


def _head(tally: Tally) -> list[str]:
    """Return the title, and the lines below it, none of which reaches the scale bar."""
    measure, when = tr(_TITLES[tally.measure]), time_span(tally)
    if not tally.labels.title:
        return [measure, *textwrap.wrap(when, _BELOW_TITLE)]
    both = f"{measure}, {when}"
    if len(both) <= _BELOW_TITLE:
        return [tally.labels.title, both]
    return [tally.labels.title, measure, *textwrap.wrap(when, _BELOW_TITLE)]


def _foot(tally: Tally) -> list[str]:
    """Return the lines under the map."""
    crs = f"{tally.crs.name} ({name_of(tally.crs)[:20]})."
    parts = [tr(_MEANINGS[tally.measure]), crs]
    if tally.labels.sources:
        parts.append(tr("Sources: {sources}.", sources="; ".join(tally.labels.sources)))
    return textwrap.wrap(" ".join(parts), _LINE)


def time_span(tally: Tally, interval: int | slice | None = None) -> str:
    """Return the time span, or that of intervals, as text in the labels' time zone."""
    times = tally.whole if interval is None else tally.timeline
    rows = interval if isinstance(interval, slice) else slice(interval or 0, None)
    first = range(len(times))[rows]
    last = first[-1] if isinstance(interval, slice) else first[0]
    begin, end = times.span(first[0])[0], times.span(last)[1]
    clock = Clock(zone=tally.zone, first=begin, last=end)
    if int(times.end[last] - times.begin[first[0]]) == 1:
        return tr(
            "{day}, {time}, one step of 50 ms ({zone})",
            day=clock.date(begin), time=clock.time(begin), zone=clock.name,
        )  # fmt: skip
    return clock.long_span_in_zone(begin, end)


def _add_side(ax: Axes, tally: Tally) -> None:
    """Draw the legend and the figures of the map, in inches from the top left."""
    box = ax.get_window_extent()
    ax.set_xlim(0, box.width / _DPI)
    ax.set_ylim(box.height / _DPI, 0)
    ax.axis("off")
    words = style.MAP_WORDS[tally.measure]
    size = 10 * min(1.0, _HEAD_LETTERS / len(tr(words.title)))
    ax.text(0.25, 0.12, tr(words.title), fontsize=size, fontweight="bold", color=INK)
    ax.text(0.25, 0.3, tr(words.subtitle), fontsize=_SMALL, color=SOFT)
    y = 0.5
    for colour, label in legend_in_words(tally.measure):
        apart = 0.08 if colour in _APART else 0.0
        ax.add_patch(_swatch((0.25, y + apart), (0.34, 0.24), colour))
        if colour == style.UNCERTAIN:  # over pale colours and over deep ones
            deep = Rectangle((0.42, y + apart), 0.17, 0.24, linewidth=0.5, hatch=_UNSURE_HATCH)
            deep.set(facecolor=style.RAMP[4], edgecolor=style.HATCH_LIGHT)
            ax.add_patch(deep)
        ax.text(0.7, y + apart + 0.125, label, fontsize=_SMALL, color=INK, va="center")
        y += 0.24 + apart
    for number, (name, value) in enumerate(_facts(tally)):
        ax.text(0.25, y + 0.46 + number * 0.44, name, fontsize=_SMALL, color=SOFT)
        ax.text(0.25, y + 0.65 + number * 0.44, value, fontsize=10, color=INK, parse_math=False)


def _facts(tally: Tally) -> list[tuple[str, str]]:
    figures, sensors = tally.figures(), tally.sensors
    facts = [
        (tr("Sensors"), ", ".join(sensors) if len(", ".join(sensors)) < 24 else str(len(sensors))),
        (tr("Tiles observed"), figure_text(figures["tiles_observed"])),
        (tr("Tiles hit"), figure_text(figures["tiles_hit"])),
    ]
    shares = tally.occupancy_shares()
    if shares is not None:
        part, whole = figure_text(figures["tiles_visible"]), figure_text(len(tally.tiles))
        facts[1:] = [(tr("Tiles visible"), tr("{part} of {all}", part=part, all=whole))]
        mean = percent(figures["mean_occupancy"], error=figures["mean_occupancy_se"])
        facts.append((tr("Mean occupancy"), mean))
        if np.any(shares.occupancy > 0):
            top = surest(shares.occupancy, shares.occupancy_se)
            best = percent(shares.occupancy[top], error=shares.occupancy_se[top])
            facts.append((tr("Highest tile"), best))
    return facts


_INSETS = (0.42, 0.36, 0.3)  # sides of the inset to try, as shares of the map's shorter side
_WINDOW = 0.12  # side of the window that it shows, as a share of the map's shorter side
_SMALLEST_MAP_M = 150.0  # shorter side of a map from which on it has an inset
_SMALLEST_WINDOW_M = 45.0  # least side of the window that the inset shows
_GAP = 0.02  # around the inset, as a share of the map's shorter side
CELLS = 4  # a window's side in cells of the search

Box = tuple[float, float, float, float]


def busiest_window(centres: Floats, share: Floats, extent: Extent) -> Extent | None:
    """Return the square window with the highest sum of shares.

    Parameters
    ----------
    centres : (n, 2) array
        Centres of the tiles, metres.
    share : (n,) array
        Their occupancy or hit share, NaN where there is no data.
    extent : (south-west, north-east)
        Extent of the map.

    Returns
    -------
    (south-west, north-east) or None
        None where nothing was hit, or the map is small enough to need no inset.
    """
    low, high = extent
    shorter = float((high - low).min())
    weight = np.nan_to_num(share)
    if shorter < _SMALLEST_MAP_M or not weight.any():
        return None
    side = max(_SMALLEST_WINDOW_M, _WINDOW * shorter)
    x, y = (np.arange(low[i], high[i] + side, side / CELLS) for i in (0, 1))
    cells, _, _ = np.histogram2d(centres[:, 0], centres[:, 1], bins=[x, y], weights=weight)
    total = np.pad(cells.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    far, near = slice(CELLS, None), slice(None, -CELLS)
    sums = total[far, far] - total[near, far] - total[far, near] + total[near, near]
    place = np.unravel_index(int(sums.argmax()), sums.shape)
    corner = np.array([x[place[0]], y[place[1]]])
    return corner, corner + side


def free_corner(centres: Floats, extent: Extent) -> Box | None:
    """Return the largest square in a corner of the map without a tile.

    Returns
    -------
    (left, bottom, width, height) or None
        As shares of the map; None where each corner has tiles.
    """
    low, high = extent
    unit = (high - low).min() / (high - low)  # the shorter side, as a share of both
    place = (centres - low) / (high - low)
    for size, east, north in product(_INSETS, (1, 0), (1, 0)):
        side, gap = size * unit, _GAP * unit
        corner = gap + np.array([east, north]) * (1 - side - 2 * gap)
        inside = (place >= corner - gap) & (place <= corner + side + gap)
        if not inside.all(axis=1).any():
            return float(corner[0]), float(corner[1]), float(side[0]), float(side[1])
    return None


def _add_detail(ax: Axes, tally: Tally, extent: Extent) -> None:
    """Draw the busiest place larger in a corner of the map, where one is free."""
    centres = quads(tally.tiles).mean(axis=1)
    window = busiest_window(centres, tally.shown(), extent)
    corner = free_corner(centres, extent)
    if window is None or corner is None:
        return
    inset = ax.inset_axes(corner, zorder=4)
    _add_map(inset, tally, window, corner[2] * _MAP_WIDTH_IN)
    _frame(inset, INK)
    low, high = window
    ax.add_patch(
        Rectangle(tuple(low), *(high - low), fill=False, edgecolor=INK, linewidth=0.8, zorder=4)
    )
    inset.text(
        0.03, 0.96, tr("detail, {length} m across", length=figure_text((high - low)[0])),
        transform=inset.transAxes, fontsize=_SMALL, color=INK, va="top",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.88, "pad": 1.5},
    )  # fmt: skip


def _frame(ax: Axes, colour: str) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set(color=colour, linewidth=0.8)
