"""Axes of figures: made where none are given, labelled with units, turned into pictures.

Matplotlib is imported where it is used: whoever draws nothing does not wait for it.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC
from io import BytesIO
from typing import Any

SMALL_IN, SMALL_DPI = (4.6, 3.6), 80


def axes_or_new(ax: Any, size_in: tuple[float, float] = (7.0, 6.0)) -> Any:
    """Return the axes, or those of a new figure of pyplot where `ax` is None."""
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt  # noqa: PLC0415 - chooses a window system

    return plt.figure(figsize=size_in, layout="constrained").add_subplot()


def label_map(ax: Any) -> None:
    """Give axes in metres of the map their labels and equal scales."""
    ax.set_aspect("equal")
    ax.set(xlabel="easting, m", ylabel="northing, m")
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.locator_params(nbins=5)


def label_times(ax: Any) -> None:
    """Write UTC times along x, no longer than needed."""
    from matplotlib import dates  # noqa: PLC0415

    locator: Any = dates.AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator, tz=UTC))  # type: ignore[no-untyped-call]
    ax.set_xlabel("time, UTC")


def small_picture(draw: Callable[[Any], Any]) -> bytes:
    """Return what a function draws on axes as a small PNG, without pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=SMALL_IN, dpi=SMALL_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure.add_subplot())
    picture = BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
