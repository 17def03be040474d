"""The answer: a track of poses, and what happened on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gis_radar.axes import axes_or_new, label_times
from gis_radar.cards import card
from gis_radar.clock import STEP_US, iso_from_step, step_of
from gis_radar.errors import UsageError
from gis_radar.localization.answer import SIGMA, Site
from gis_radar.pose import Pose
from gis_radar.pose_files import PoseTrack
from gis_radar.registration import State
from gis_radar.tracking.follower import MOVED, REJECTED, Row


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened to the sensor.

    Parameters
    ----------
    time : str
        When, ISO 8601, UTC.
    kind : str
        `moved`: the sensor stands or looks elsewhere since then; `rejected`: what the data say
        was left out, and the pose kept.
    """

    time: str
    kind: str


@dataclass(frozen=True, kw_only=True)
class Track:
    """The poses of a sensor over a recording.

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
        """Return figures worth a look, by name."""
        first, last = self.poses.poses[0], self.poses.poses[-1]
        sigma = last.evidence["sigma"]
        measured = sum(pose.evidence["corrected"] for pose in self.poses.poses)
        return {
            "poses": len(self.poses.poses),
            "corrected": measured,
            "rejected": sum(event.kind == REJECTED for event in self.events),
            "moved": [event.time for event in self.events if event.kind == MOVED],
            **{name: round(getattr(last, name), 3) for name in SIGMA},
            **{f"sigma_{name}": float(f"{value:.2g}") for name, value in sigma.items()},
            "shift_m": round(float(np.linalg.norm(last.position - first.position)), 3),
        }

    def plot(self, component: str = "easting", ax: Any = None) -> Any:
        """Draw a component of the pose over time, with bands of one and two sigma, and events.

        Parameters
        ----------
        component : str
            `easting`, `northing`, `height` (metres), `roll`, `pitch` or `yaw` (degrees). All six
            on one page: :func:`gis_radar.draw_track`.
        ax : matplotlib Axes, optional
            Where; without it, on a new figure.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        UsageError
            If there is no such component.
        """
        if component not in SIGMA:
            raise UsageError(f"component is {component!r}, expected one of {', '.join(SIGMA)}")
        # not at the top: whoever draws nothing does not wait for matplotlib
        from gis_radar.tracking.drawing import draw_component  # noqa: PLC0415

        ax = axes_or_new(ax, (8.0, 3.5))
        draw_component(ax, self.poses, component)
        label_times(ax)
        ax.set_title(self.told(), fontsize="medium")
        ax.legend(loc="best", frameon=False, ncols=3)
        return ax

    def told(self) -> str:
        """Return the track in a line: how many poses, what moved, how well the end is known."""
        sigma = self.poses.poses[-1].evidence["sigma"]
        across = float(np.hypot(sigma["easting"], sigma["northing"]))
        moves = sum(event.kind == MOVED for event in self.events)
        said = [
            f"{self.poses.sensor}: {len(self.poses.poses)} poses",
            "never moved" if not moves else f"moved {moves} time{'s' * (moves > 1)}",
            f"at the end \u00b1 {across:.2f} m, yaw \u00b1 {sigma['yaw']:.2f} deg",
        ]
        return "; ".join(said)

    def __repr__(self) -> str:
        return f"Track({self.told()})"

    def _repr_html_(self) -> str:
        return card(f"Track of {self.poses.sensor}", self.figures())


def answer(site: Site, start: Pose, rows: list[Row]) -> Track:
    """Return the rows of a follower as poses in the map.

    Parameters
    ----------
    site : Site
        The sensor; its guess is the local (0, 0).
    start : Pose
        Its view goes into every pose.
    rows : list of Row
        In the order of time.
    """
    steps = step_of(np.array([row.estimate.time for row in rows]))
    later = np.append(True, np.diff(steps) > 0)
    kept = [(int(s), row) for s, row, new in zip(steps, rows, later, strict=True) if new]
    poses = [replace(_pose(site, row, step), view=start.view) for step, row in kept]
    since = np.array([step * STEP_US / 1e6 for step, _ in kept])
    events = [Event(time=iso_from_step(step), kind=row.event) for step, row in kept if row.event]
    return Track(poses=PoseTrack(poses=tuple(poses), since=since), events=tuple(events))


def _pose(site: Site, row: Row, step: int) -> Pose:
    estimate = row.estimate
    covariance = estimate.angle_covariance
    sigma = np.sqrt(np.diag(covariance))
    sigma[3:] = np.degrees(sigma[3:])
    state = estimate.state(
        State(position=estimate.position, R_map_sensor=np.eye(3), reflection=0.0)
    )
    evidence = {
        "sigma": {name: float(value) for name, value in zip(SIGMA, sigma, strict=True)},
        "covariance": covariance.tolist(),
        "time": iso_from_step(step),
        "method": "track",
        "event": row.event,
        "vehicles": row.vehicles,
        "fitness": row.fitness,
        "corrected": row.corrected,
    }
    return site.pose(state, evidence)
