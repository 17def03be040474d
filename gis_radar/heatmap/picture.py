"""A heat map as a picture for a report: the tiles, a legend in words, scale, north, and time."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from gis_radar.arrays import Floats
from gis_radar.crs import name_of
from gis_radar.heatmap import style
from gis_radar.heatmap.counting import Tally
from gis_radar.notebooks import axes_or_new, label_map
from gis_radar.progress import Reporter
from gis_radar.steps import STEPS_PER_SECOND, step_begin
from gis_radar.tiles.tiles import quads

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
    classes = [(level.colour, level.label) for level in reversed(style.colour_classes())]
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
    for level in reversed(style.colour_classes()):
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


INSETS = (0.42, 0.36, 0.3)  # sides of the inset to try, of the map's shorter side
WINDOW = 0.12  # side of what it shows, of the map's shorter side
SMALLEST_MAP_M = 150.0
SMALLEST_WINDOW_M = 45.0
GAP = 0.02
CELLS = 4  # a window's side in cells of the search

_Extent = tuple[Floats, Floats]
Box = tuple[float, float, float, float]


def busiest_window(centres: Floats, share: Floats, extent: _Extent) -> _Extent | None:
    """Return the square window with the highest sum of occupancy.

    Parameters
    ----------
    centres : (n, 2) array
        Centres of the tiles, metres.
    share : (n,) array
        Their occupancy, NaN where not observed.
    extent : (south-west, north-east)
        The map's.

    Returns
    -------
    (south-west, north-east) or None
        None where nothing was hit, or the map is small enough to be read without.
    """
    low, high = extent
    shorter = float((high - low).min())
    weight = np.nan_to_num(share)
    if shorter < SMALLEST_MAP_M or not weight.any():
        return None
    side = max(SMALLEST_WINDOW_M, WINDOW * shorter)
    x, y = (np.arange(low[i], high[i] + side, side / CELLS) for i in (0, 1))
    cells, _, _ = np.histogram2d(centres[:, 0], centres[:, 1], bins=[x, y], weights=weight)
    total = np.pad(cells.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    far, near = slice(CELLS, None), slice(None, -CELLS)
    sums = total[far, far] - total[near, far] - total[far, near] + total[near, near]
    place = np.unravel_index(int(sums.argmax()), sums.shape)
    corner = np.array([x[place[0]], y[place[1]]])
    return corner, corner + side


def free_corner(centres: Floats, extent: _Extent) -> Box | None:
    """Return the largest square in a corner of the map in which no tile lies.

    Returns
    -------
    (left, bottom, width, height) or None
        As shares of the map; None where each corner has tiles.
    """
    low, high = extent
    unit = (high - low).min() / (high - low)  # the shorter side, as a share of both
    place = (centres - low) / (high - low)
    for size, east, north in product(INSETS, (1, 0), (1, 0)):
        side, gap = size * unit, GAP * unit
        corner = gap + np.array([east, north]) * (1 - side - 2 * gap)
        inside = (place >= corner - gap) & (place <= corner + side + gap)
        if not inside.all(axis=1).any():
            return float(corner[0]), float(corner[1]), float(side[0]), float(side[1])
    return None


DPI = 200
WIDTH_IN = 10.0
MAP_WIDTH_IN = 7.15
MAP_HEIGHT_IN = (5.1, 8.6)  # lowest, which the legend needs, and highest
EDGE_IN = 0.3
TITLE_IN = 0.85
FOOT_IN = 0.42
LEAST_MARGIN_M = 5.0
FRAME = "#9aa1a8"
SETTINGS: dict[Any, Any] = {"font.family": ["DejaVu Sans"], "text.usetex": False, "font.size": 8}

Extent = tuple[Floats, Floats]  # south-west and north-east, metres


def draw(
    tally: Tally, ax: Axes | None = None, *, interval: int | None = None, legend: bool = True
) -> Axes:
    """Draw the occupancy of the tiles, the busiest on top.

    Parameters
    ----------
    tally : Tally
        What to draw.
    ax : Axes, optional
        Where; without it, on a new figure of pyplot.
    interval : int, optional
        Which interval; without it, the whole time.
    legend : bool
        Whether the classes stand beside it.

    Returns
    -------
    Axes
        In metres of the map, cropped to the tiles that were observed.
    """
    ax = axes_or_new(ax, (8.5, 6.0))
    _add_tiles(ax, tally, _bounds(tally), interval=interval)
    label_map(ax)
    ax.set_title(time_span(tally, interval), fontsize="medium")
    if legend:
        add_legend(ax)
    return ax


def write_picture(tally: Tally, path: Path, reporter: Reporter) -> None:
    """Write the picture as PNG, 2000 pixels wide.

    Parameters
    ----------
    tally : Tally
        What to draw.
    path : Path
        The file.
    reporter : Reporter
        Where progress goes.
    """
    reporter.progress("drawing the picture", 0, 1)
    with mpl.rc_context(SETTINGS):
        figure = _figure(tally)
        about = {"Title": "Occupancy heat map", "Description": time_span(tally)}
        figure.savefig(path, dpi=DPI, metadata=about)
    reporter.progress("drawing the picture", 1, 1)


def _figure(tally: Tally) -> Figure:
    width_m, height_m = np.subtract(*_bounds(tally)[::-1])
    tall_in = float(np.clip(MAP_WIDTH_IN * height_m / width_m, *MAP_HEIGHT_IN))
    extent = _widened(_bounds(tally), tall_in / MAP_WIDTH_IN)
    figure = Figure(figsize=(WIDTH_IN, tall_in + TITLE_IN + FOOT_IN), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    ax = _axes(figure, EDGE_IN, FOOT_IN, MAP_WIDTH_IN, tall_in)
    _add_tiles(ax, tally, extent)
    _add_detail(ax, tally, extent)
    _frame(ax, FRAME)
    metre_in = MAP_WIDTH_IN / float((extent[1] - extent[0])[0])
    add_scale_bar(figure, EDGE_IN + MAP_WIDTH_IN, metre_in)
    add_titles(figure, tally, EDGE_IN)
    beside = EDGE_IN + MAP_WIDTH_IN
    add_side(_axes(figure, beside, FOOT_IN, WIDTH_IN - beside, tall_in), tally, DPI)
    return figure


def _axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Add axes at a place given in inches."""
    across, up = figure.get_size_inches()
    return figure.add_axes((left / across, bottom / up, width / across, height / up))


def _bounds(tally: Tally) -> Extent:
    """Return the extent of what was observed, with a margin."""
    _, observed = tally.steps()
    shown = tally.seen[observed > 0] if observed.any() else tally.seen
    corners = quads(tally.tiles.iloc[shown])
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    margin = max(LEAST_MARGIN_M, 0.03 * float((high - low).max()))
    return low - margin, high + margin


def _widened(extent: Extent, aspect: float) -> Extent:
    """Return the extent, widened to a given height per width."""
    low, high = extent
    width, height = high - low
    size = np.array([max(width, height / aspect), max(height, width * aspect)])
    return (low + high - size) / 2, (low + high + size) / 2


def _add_tiles(
    ax: Axes, tally: Tally, extent: Extent, outline: float = 0.9, interval: int | None = None
) -> None:
    """Draw the tiles over a dark edge, of which only the outline of the road stays in sight."""
    low, high = extent
    corners = quads(tally.tiles)
    shown = (corners.max(axis=1) >= low).all(axis=1) & (corners.min(axis=1) <= high).all(axis=1)
    share = tally.shares(interval).occupancy[shown]
    order = np.argsort(np.nan_to_num(share, nan=-1.0), kind="stable")
    # Coordinates near zero: those of UTM leave few digits to the renderer.
    shapes, colours = corners[shown][order] - low, _colours(share[order])
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    moved = Affine2D().translate(*low) + ax.transData
    for faces, width in ((SOFT, outline), (colours, 0.2)):
        ax.add_collection(
            PolyCollection(
                shapes, facecolors=faces, edgecolors=faces, linewidths=width, transform=moved
            )
        )


def _colours(share: Floats) -> NDArray[np.float64]:
    """Return the colour of each occupancy, by the classes of the style."""
    levels = style.colour_classes()
    palette = mpl.colors.to_rgba_array([level.colour for level in levels] + [style.NOT_OBSERVED])
    place = np.searchsorted([level.upper for level in levels], share)
    return np.asarray(palette[np.where(np.isnan(share), len(levels), place)])


def _add_detail(ax: Axes, tally: Tally, extent: Extent) -> None:
    """Draw the busiest place larger in a corner of the map, where one is free."""
    centres = quads(tally.tiles).mean(axis=1)
    window = busiest_window(centres, tally.shares().occupancy, extent)
    corner = free_corner(centres, extent)
    if window is None or corner is None:
        return
    inset = ax.inset_axes(corner, zorder=4)
    _add_tiles(inset, tally, window, outline=1.4)
    _frame(inset, INK)
    low, high = window
    ax.add_patch(
        Rectangle(tuple(low), *(high - low), fill=False, edgecolor=INK, linewidth=0.8, zorder=4)
    )
    inset.text(
        0.03, 0.96, f"busiest place, {(high - low)[0]:.0f} m across",
        transform=inset.transAxes, fontsize=7, color=INK, va="top",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.88, "pad": 1.5},
    )  # fmt: skip


def _frame(ax: Axes, colour: str) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set(color=colour, linewidth=0.8)
