"""Pose track of a sensor: poses over time, events, and picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import (
    STEP_US,
    Booleans,
    Floats,
    UsageError,
    axes_or_new,
    card,
    iso_from_step,
    label_times,
    picture_file,
    step_of,
)
from gis_radar.calibration.monitoring.kalman_filter import Estimate
from gis_radar.calibration.registration.certainty import stated
from gis_radar.calibration.single.result import Problem
from gis_radar.poses import COMPONENTS, Pose, PoseTrack

_LINE, _NEAR, _FAR, _MOVE, _REJECT, _QUIET = (
    "#1d4ed8", "#93b4f5", "#dbe6fd", "#c2410c", "#fcd9a0", "#e5e7eb",
)  # fmt: skip
MOVED, REJECTED, NOTHING = "moved", "rejected", ""
_DPI = 150
_SIZE_IN = (11.0, 8.0)
_LEAST_SPAN = (0.1, 0.05)  # least span of an axis, metres and degrees, lest noise fill it


def _draw_bands(
    ax: Any, time: np.ndarray, value: Floats, sigma: Floats, moved: Booleans, least: float
) -> None:
    """Draw one component with bands of 1 and 2 sigma; the line breaks at moves."""
    for number, rows in enumerate(np.split(np.arange(len(value)), np.flatnonzero(moved))):
        if len(rows) == 0:
            continue
        # a pose holds until the next one
        until = min(int(rows[-1]) + 1, len(value) - 1)
        t = np.append(time[rows], time[until])
        y, s = (np.append(v[rows], v[rows[-1]]) for v in (value, sigma))
        labels = ("pose", "1 sigma", "2 sigma") if number == 0 else (None, None, None)
        ax.fill_between(
            t, y - 2 * s, y + 2 * s, step="post", color=_FAR, linewidth=0, label=labels[2]
        )
        ax.fill_between(t, y - s, y + s, step="post", color=_NEAR, linewidth=0, label=labels[1])
        ax.plot(t, y, color=_LINE, linewidth=1.3, drawstyle="steps-post", label=labels[0])
    later = slice(min(4, len(value) - 1), None)  # the first poses have wide bands
    low = float((value - 2.5 * sigma)[later].min())
    high = float((value + 2.5 * sigma)[later].max())
    extra = max(least - (high - low), 0.0) / 2
    ax.set_ylim(low - extra, high + extra)
    ax.ticklabel_format(axis="y", useOffset=False, style="plain")


def _draw_events(ax: Any, time: np.ndarray, events: np.ndarray, idle: Booleans) -> None:
    """Draw bands where the pose was not corrected or a fit was rejected, and lines at moves."""
    kinds = (
        (idle & (events == ""), _QUIET, "no correction"),
        (events == REJECTED, _REJECT, REJECTED),
    )
    for which, colour, label in kinds:
        for count, i in enumerate(np.flatnonzero(which[1:]) + 1):
            end = time[min(int(i) + 1, len(time) - 1)]
            words = label if count == 0 else None
            ax.axvspan(time[i], end, color=colour, alpha=0.5, linewidth=0, label=words)
    for count, i in enumerate(np.flatnonzero(events == MOVED)):
        words = MOVED if count == 0 else None
        ax.axvline(time[i], color=_MOVE, linewidth=1.2, linestyle=(0, (4, 2)), label=words)


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of a pose track.

    Parameters
    ----------
    estimate : Estimate
        The pose, valid from its time on.
    event : str
        `moved`, `rejected`, or empty.
    vehicles : int
        Number of vehicles in the window.
    fitness : float
        Share of the window's samples on lanes; NaN without a fit.
    chi2 : float
        Chi-square of the innovation by the window's fit; NaN without a fit.
    corrected : bool
        Whether the window corrected the pose.
    """

    estimate: Estimate
    event: str = NOTHING
    vehicles: int = 0
    fitness: float = float("nan")
    chi2: float = float("nan")
    corrected: bool = False


@dataclass(frozen=True, kw_only=True)
class Event:
    """Event of a pose track.

    Parameters
    ----------
    time : str
        Time, ISO 8601, UTC.
    kind : str
        `moved`: the sensor has another pose since then; `rejected`: the fit of the window was not
        used.
    """

    time: str
    kind: str


@dataclass(frozen=True, kw_only=True)
class Track:
    """Result of following a sensor's pose through a recording.

    Parameters
    ----------
    poses : PoseTrack
        One corrected pose every 5 s, each with `sigma`, `covariance`, `event`, `vehicles` and
        `fitness` in its evidence.
    events : tuple of Event
        In the order of time.
    """

    poses: PoseTrack
    events: tuple[Event, ...] = field(default=())

    def figures(self) -> Mapping[str, Any]:
        """Return the main figures of the track, by name."""
        first, last = self.poses.poses[0], self.poses.poses[-1]
        sigma = last.evidence["sigma"]
        measured = sum(pose.evidence["corrected"] for pose in self.poses.poses)
        return {
            "poses": len(self.poses.poses),
            "corrected": measured,
            "rejected": sum(event.kind == REJECTED for event in self.events),
            "moved": [event.time for event in self.events if event.kind == MOVED],
            **{name: round(getattr(last, name), 3) for name in COMPONENTS},
            **{f"sigma_{name}": float(f"{value:.2g}") for name, value in sigma.items()},
            "shift_m": round(float(np.linalg.norm(last.position - first.position)), 3),
        }

    def plot(self, component: str = "easting", ax: Any = None) -> Any:
        """Draw a component of the pose over time, with bands of one and two sigma, and events.

        Parameters
        ----------
        component : str
            `easting`, `northing`, `height` (metres), `roll`, `pitch` or `yaw` (degrees). All six
            on one page: :meth:`draw`.
        ax : matplotlib Axes, optional
            Axes to draw on; by default those of a new figure.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        UsageError
            If there is no such component.
        """
        if component not in COMPONENTS:
            raise UsageError(
                "component is {}, expected one of {}", repr(component), ", ".join(COMPONENTS)
            )
        ax = axes_or_new(ax, (8.0, 3.5))
        self._draw(component, ax)
        label_times(ax)
        ax.set_title(self.describe(), fontsize="medium")
        ax.legend(loc="best", frameon=False, ncols=3)
        return ax

    def draw(self, path: str | Path) -> None:
        """Draw the pose over time with bands of one and two sigma, and events, as a PNG.

        Parameters
        ----------
        path : str or Path
            The picture; appears whole or not at all.
        """
        with picture_file(path, _SIZE_IN, _DPI) as figure:
            axes = figure.subplots(3, 2, sharex=True)
            for i, name in enumerate(COMPONENTS):
                self._draw(name, axes[i % 3, i // 3])
            for ax in axes[2]:
                label_times(ax)
            handles, labels = axes[0, 0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
            figure.suptitle(self.describe(), fontsize=10)

    def _draw(self, component: str, ax: Any) -> None:
        poses, angle = self.poses.poses, COMPONENTS.index(component) > 2
        time = np.array([datetime.fromtimestamp(s, tz=UTC) for s in self.poses.since])
        events = np.array([pose.evidence["event"] for pose in poses])
        idle = np.array([not pose.evidence["corrected"] for pose in poses])
        value = np.array([getattr(pose, component) for pose in poses])
        value = np.degrees(np.unwrap(np.radians(value))) if angle else value
        sigma = np.array([pose.evidence["sigma"][component] for pose in poses])
        _draw_events(ax, time, events, idle)
        _draw_bands(ax, time, value, sigma, events == MOVED, _LEAST_SPAN[angle])
        ax.set_ylabel(f"{component}, {'deg' if angle else 'm'}")
        ax.grid(axis="y", color="#eeeeee", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)

    def describe(self) -> str:
        """Return a line with the number of poses, the number of moves, and the last sigma."""
        sigma = self.poses.poses[-1].evidence["sigma"]
        across = float(np.hypot(sigma["easting"], sigma["northing"]))
        moves = sum(event.kind == MOVED for event in self.events)
        words = [
            f"{self.poses.sensor}: {len(self.poses.poses)} poses",
            "no move noticed" if not moves else f"moved {moves} time{'s' * (moves > 1)}",
            f"at the end \u00b1 {across:.2f} m, yaw \u00b1 {sigma['yaw']:.2f} deg",
        ]
        return "; ".join(words)

    def __repr__(self) -> str:
        return f"Track({self.describe()})"

    def _repr_html_(self) -> str:
        return card(f"Track of {self.poses.sensor}", self.figures())


def track_of(problem: Problem, start: Pose, rows: list[Row]) -> Track:
    """Convert the rows of a follower to poses in the map.

    Parameters
    ----------
    problem : Problem
        The sensor; its guess is the local (0, 0).
    start : Pose
        The start pose, whose view every pose gets.
    rows : list of Row
        Rows in the order of time.
    """
    steps = step_of(np.array([row.estimate.time for row in rows]))
    is_later = np.append(True, np.diff(steps) > 0)
    distinct = [(int(s), row) for s, row, new in zip(steps, rows, is_later, strict=True) if new]
    poses = [replace(_pose(problem, row, step), view=start.view) for step, row in distinct]
    since = np.array([step * STEP_US / 1e6 for step, _ in distinct])
    events = [
        Event(time=iso_from_step(step), kind=row.event) for step, row in distinct if row.event
    ]
    track = PoseTrack(poses=tuple(poses), since=since)
    return Track(poses=track, events=tuple(events))


def _pose(problem: Problem, row: Row, step: int) -> Pose:
    estimate = row.estimate
    evidence = {
        **stated(estimate.angle_covariance),
        "time": iso_from_step(step),
        "method": "track",
        "event": row.event,
        "vehicles": row.vehicles,
        "fitness": row.fitness,
        "corrected": row.corrected,
    }
    return problem.pose(estimate.state(0.0), evidence)
