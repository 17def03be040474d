"""A heat map as a picture for a report: the tiles, a legend in words, scale, north, and time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from gis_radar.arrays import Floats
from gis_radar.axes import axes_or_new, label_map
from gis_radar.heatmap import style
from gis_radar.heatmap.annotations import (
    INK,
    SOFT,
    add_legend,
    add_scale_bar,
    add_side,
    add_titles,
    time_span,
)
from gis_radar.heatmap.detail import busiest_window, free_corner
from gis_radar.heatmap.tally import Tally
from gis_radar.progress import Reporter
from gis_radar.tiles import quads

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
    levels = style.levels()
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
