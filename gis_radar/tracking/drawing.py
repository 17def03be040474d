"""What pictures of a track are drawn of: a component over time with its error, and events."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from matplotlib.axes import Axes

from gis_radar.arrays import Booleans, Floats
from gis_radar.localization.answer import SIGMA
from gis_radar.pose_files import PoseTrack
from gis_radar.tracking.follower import MOVED, REJECTED

LINE, NEAR, FAR, MOVE, REJECT, QUIET = (
    "#1d4ed8", "#93b4f5", "#dbe6fd", "#c2410c", "#fcd9a0", "#e5e7eb",
)  # fmt: skip
LEAST_SPAN = (0.1, 0.05)  # of an axis, metres and degrees: noise shall not fill it


def draw_component(ax: Axes, track: PoseTrack, name: str) -> None:
    """Draw a component of the pose over time with bands of one and two sigma, and events.

    Parameters
    ----------
    ax : Axes
        Where; its x are times.
    track : PoseTrack
        The poses, with the evidence of a followed track.
    name : str
        One of `SIGMA`.
    """
    poses, angle = track.poses, SIGMA.index(name) > 2
    time = np.array([datetime.fromtimestamp(s, tz=UTC) for s in track.since])
    events = np.array([pose.evidence["event"] for pose in poses])
    idle = np.array([not pose.evidence["corrected"] for pose in poses])
    value = np.array([getattr(pose, name) for pose in poses])
    value = np.degrees(np.unwrap(np.radians(value))) if angle else value
    sigma = np.array([pose.evidence["sigma"][name] for pose in poses])
    _draw_events(ax, time, events, idle)
    _draw_bands(ax, time, value, sigma, events == MOVED, LEAST_SPAN[angle])
    ax.set_ylabel(f"{name}, {'deg' if angle else 'm'}")
    ax.grid(axis="y", color="#eeeeee", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _draw_bands(
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
        ax.fill_between(
            t, y - 2 * s, y + 2 * s, step="post", color=FAR, linewidth=0, label=labels[2]
        )
        ax.fill_between(t, y - s, y + s, step="post", color=NEAR, linewidth=0, label=labels[1])
        ax.plot(t, y, color=LINE, linewidth=1.3, drawstyle="steps-post", label=labels[0])
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
