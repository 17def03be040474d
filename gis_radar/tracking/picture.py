"""A track as a picture: each component of the pose over time, with its error and events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gis_radar.axes import label_times
from gis_radar.localization.answer import SIGMA
from gis_radar.outputs import whole_file
from gis_radar.tracking.answer import Track
from gis_radar.tracking.drawing import draw_component

DPI = 150
SIZE_IN = (11.0, 8.0)
SETTINGS: dict[Any, Any] = {"font.family": ["DejaVu Sans"], "text.usetex": False, "font.size": 8}


def draw_track(track: Track, path: str | Path) -> None:
    """Draw the pose over time with bands of one and two sigma, and what happened (PNG).

    Parameters
    ----------
    track : Track
        As from :func:`gis_radar.track`.
    path : str or Path
        The picture; appears whole or not at all.
    """
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(3, 2, sharex=True)
        for i, name in enumerate(SIGMA):
            draw_component(axes[i % 3, i // 3], track.poses, name)
        for ax in axes[2]:
            label_times(ax)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
        figure.suptitle(track.told(), fontsize=10)
        with whole_file(Path(path)) as part:
            figure.savefig(part, format="png")
