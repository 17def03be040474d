"""A track as a picture: each component of the pose over time, with its error and events."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import dates
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gis_radar.arrays import Booleans, Floats
from gis_radar.localization.answer import SIGMA
from gis_radar.outputs import whole_file
from gis_radar.tracking.answer import Track
from gis_radar.tracking.follower import MOVED, REJECTED

DPI = 150
SIZE_IN = (11.0, 8.0)
LINE, NEAR, FAR, MOVE, REJECT, QUIET = (
    "#1d4ed8", "#93b4f5", "#dbe6fd", "#c2410c", "#fcd9a0", "#e5e7eb",
)  # fmt: skip
SETTINGS: dict[Any, Any] = {"font.family": ["DejaVu Sans"], "text.usetex": False, "font.size": 8}
LEAST_SPAN = (0.1, 0.05)  # of an axis, metres and degrees: noise shall not fill it


def draw_track(track: Track, path: str | Path) -> None:
    """Draw the pose over time with bands of one and two sigma, and what happened (PNG).

    Parameters
    ----------
    track : Track
        As from :func:`gis_radar.track`.
    path : str or Path
        The picture; appears whole or not at all.
    """
    poses = track.poses.poses
    time = np.array([datetime.fromtimestamp(s, tz=UTC) for s in track.poses.since])
    events = np.array([pose.evidence["event"] for pose in poses])
    idle = np.array([not pose.evidence["corrected"] for pose in poses])
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(3, 2, sharex=True)
        for i, name in enumerate(SIGMA):
            ax, angle = axes[i % 3, i // 3], i > 2
            value = np.array([getattr(pose, name) for pose in poses])
            value = np.degrees(np.unwrap(np.radians(value))) if angle else value
            sigma = np.array([pose.evidence["sigma"][name] for pose in poses])
            _draw_events(ax, time, events, idle)
            _draw_component(ax, time, value, sigma, events == MOVED, LEAST_SPAN[angle])
            ax.set_ylabel(f"{name}, {'deg' if angle else 'm'}")
            ax.grid(axis="y", color="#eeeeee", linewidth=0.6)
            ax.set_axisbelow(True)
            ax.spines[["top", "right"]].set_visible(False)
        locator = dates.AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
        clock = dates.ConciseDateFormatter(locator, tz=UTC)  # type: ignore[no-untyped-call]
        axes[2, 0].xaxis.set_major_locator(locator)
        axes[2, 0].xaxis.set_major_formatter(clock)
        for ax in axes[2]:
            ax.set_xlabel("time, UTC")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
        figure.suptitle(_title(track), fontsize=10)
        with whole_file(Path(path)) as part:
            figure.savefig(part, format="png")


def _draw_component(
    ax: Axes, time: np.ndarray, value: Floats, sigma: Floats, moved: Booleans, least: float
) -> None:
    """Draw one component; a move breaks the line."""
    for number, piece in enumerate(np.split(np.arange(len(value)), np.flatnonzero(moved))):
        if len(piece) == 0:
            continue
        # a pose holds until the next one
        until = min(int(piece[-1]) + 1, len(value) - 1)
        t = np.append(time[piece], time[until])
        y, s = (np.append(v[piece], v[piece[-1]]) for v in (value, sigma))
        labels = ("pose", "1 sigma", "2 sigma") if number == 0 else (None, None, None)
        ax.fill_between(t, y - 2 * s, y + 2 * s, color=FAR, linewidth=0, label=labels[2])
        ax.fill_between(t, y - s, y + s, color=NEAR, linewidth=0, label=labels[1])
        ax.plot(t, y, color=LINE, linewidth=1.3, label=labels[0])
    later = slice(min(4, len(value) - 1), None)  # the first poses are wide
    low = float((value - 2.5 * sigma)[later].min())
    high = float((value + 2.5 * sigma)[later].max())
    extra = max(least - (high - low), 0.0) / 2
    ax.set_ylim(low - extra, high + extra)
    ax.ticklabel_format(axis="y", useOffset=False, style="plain")


def _draw_events(ax: Axes, time: np.ndarray, events: np.ndarray, idle: Booleans) -> None:
    kinds = (
        (idle & (events == ""), QUIET, "no correction"),
        (events == REJECTED, REJECT, REJECTED),
    )
    for which, colour, label in kinds:
        for count, i in enumerate(np.flatnonzero(which[1:]) + 1):
            end = time[min(int(i) + 1, len(time) - 1)]
            said = label if count == 0 else None
            ax.axvspan(time[i], end, color=colour, alpha=0.5, linewidth=0, label=said)
    for count, i in enumerate(np.flatnonzero(events == MOVED)):
        said = MOVED if count == 0 else None
        ax.axvline(time[i], color=MOVE, linewidth=1.2, linestyle=(0, (4, 2)), label=said)


def _title(track: Track) -> str:
    poses = track.poses.poses
    sigma = poses[-1].evidence["sigma"]
    across = float(np.hypot(sigma["easting"], sigma["northing"]))
    moves = sum(event.kind == MOVED for event in track.events)
    said = [
        f"{track.poses.sensor}: {len(poses)} poses",
        "never moved" if not moves else f"moved {moves} time{'s' * (moves > 1)}",
        f"at the end \u00b1 {across:.2f} m, yaw \u00b1 {sigma['yaw']:.2f} deg",
    ]
    return "; ".join(said)
