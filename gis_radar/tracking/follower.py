"""The follower: frames in, a corrected pose every five seconds out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import NoAnswerError
from gis_radar.localization.state import State
from gis_radar.localization.traces import MovingWindow
from gis_radar.recordings.recording import Detections
from gis_radar.tracking.filter import (
    Estimate,
    corrected,
    innovation,
    likeliest_move,
    predicted,
    widened,
)
from gis_radar.tracking.moves import Change, SuspectedMove, suspect_move
from gis_radar.tracking.settings import DEFAULTS, TrackingSettings
from gis_radar.tracking.windows import WindowFit, WindowFitter, WindowTraffic

MOVED, REJECTED, NOTHING = "moved", "rejected", ""
HINT = "find the pose with gis-radar localize"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One pose of the track.

    Parameters
    ----------
    estimate : Estimate
        The pose, from its time on.
    event : str
        `moved`, `rejected`, or nothing.
    vehicles : int
        Moving objects in the window.
    fitness : float
        Share of the window's traces on lanes; NaN where it was not registered.
    chi2 : float
        How far the window's pose lay from the expected one; NaN where it was not registered.
    corrected : bool
        Whether the window corrected the pose.
    """

    estimate: Estimate
    event: str = NOTHING
    vehicles: int = 0
    fitness: float = float("nan")
    chi2: float = float("nan")
    corrected: bool = False


class Follower:
    """Follows the pose of one sensor through its frames.

    Each cycle lays the rolling window on the lanes and corrects by it the estimate that was valid
    **before the window began**: so no detection counts twice although windows overlap by 95 %.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    start : Estimate
        The pose to begin with.
    settings : TrackingSettings
        Of window, prediction and moves.
    """

    def __init__(
        self, fitter: WindowFitter, start: Estimate, settings: TrackingSettings = DEFAULTS
    ) -> None:
        self.rows = [Row(estimate=start)]
        self.confirmed = False
        self._fitter = fitter
        self._settings = settings
        traces = settings.localization.traces
        self._window = MovingWindow(frames=traces.frames, min_speed=traces.min_speed_mps)
        self._past: deque[Estimate] = deque([start])
        self._like = start.state(
            State(
                position=start.position,
                R_map_sensor=np.eye(3),
                reflection=settings.localization.hypotheses.reflection_m,
            )
        )
        self._seen: WindowFit | None = None
        self._vehicles = 0
        self._rejected_since: Estimate | None = None

    @property
    def now(self) -> Estimate:
        """The latest estimate."""
        return self.rows[-1].estimate

    def push(self, piece: Detections) -> None:
        """Take the next detections, if there are any."""
        if len(piece):
            self._window.push(piece)

    def cycle(self, time: float) -> None:
        """Correct the pose from all frames so far.

        Parameters
        ----------
        time : float
            UNIX seconds: the end of the last frame, when the corrected pose becomes valid.

        Raises
        ------
        NoAnswerError
            If a whole window of traffic does not confirm the start pose.
        """
        traffic = WindowTraffic.of(self._window.moving(), self._settings.localization.traces)
        suspected = self._suspected_move(traffic, time)
        if suspected is not None and suspected.change is not None:
            self._restart(suspected.change, time)
        else:
            row = self._corrected(
                traffic, time, suspected=suspected is not None and suspected.certain
            )
            self._keep(row if suspected is None else _allowing(row, suspected.move))
        self._give_up_if_lost(time)
        self._vehicles = max(self._vehicles, traffic.tracks)
        if not self.confirmed and self._full and self._seen:
            self._refuse_start(self._seen)

    def _suspected_move(self, traffic: WindowTraffic, time: float) -> SuspectedMove | None:
        """Return the move that the newest data suggest, or none."""
        if not self.confirmed or traffic.tracks < self._settings.localization.answer.least_tracks:
            return None
        expected = partial(self._expected, time=time)
        return suspect_move(self._fitter, traffic, time, expected, self._like)

    def _corrected(self, traffic: WindowTraffic, time: float, *, suspected: bool) -> Row:
        held = Row(estimate=self._later(self.now, time), vehicles=traffic.tracks)
        if suspected:
            return replace(held, event=REJECTED)
        prior = self._expected(traffic.moving.begin, time)
        seen = self._fitter.fit(traffic, prior, self._like)
        if seen is None:
            return held
        self._seen = seen
        found = innovation(prior, seen.measurement)
        held = replace(held, fitness=seen.fit.fitness, chi2=found.chi2)
        if not seen.on_lanes:
            return replace(held, event=REJECTED)
        if seen.trusted and found.chi2 > self._settings.gate:
            return _allowing(
                replace(held, event=REJECTED), likeliest_move(found, self._settings.knock)
            )
        if not seen.trusted:
            return held  # not converged: no measurement
        if not self._full:
            self._fitter.refuse_other_lane(seen)
        self.confirmed = True
        self._like = seen.fit.state
        self._fitter.adapt(seen)
        return replace(held, estimate=corrected(prior, seen.measurement), corrected=True)

    @property
    def _full(self) -> bool:
        """Whether the window has its whole length."""
        return len(self._window) == self._settings.localization.traces.frames

    def _later(self, estimate: Estimate, time: float) -> Estimate:
        return predicted(estimate, time, self._settings.drift)

    def _expected(self, seen: float, time: float) -> Estimate:
        """Return the pose at a time, predicted from the data before another."""
        return self._later(self._before(seen), time)

    def _knocked(self, estimate: Estimate) -> Estimate:
        """Return an estimate whose sensor may have moved."""
        spread = np.diag(np.square(self._settings.knock))
        return replace(estimate, covariance=estimate.covariance + spread)

    def _before(self, time: float) -> Estimate:
        """Return the latest estimate that has seen no data after a time, or else the first."""
        earlier = [e for e in self._past if e.time <= time]
        return earlier[-1] if earlier else self._past[0]

    def _keep(self, row: Row) -> None:
        self.rows.append(row)
        self._past.append(row.estimate)
        while len(self._past) > 1 and self._past[1].time <= self._window.begin:
            self._past.popleft()

    def _restart(self, change: Change, time: float) -> None:
        """Restart at a change, and replace the poses since then."""
        start = self._knocked(self._expected(change.time, change.time))
        new = corrected(start, change.found.measurement)
        self._window.forget(change.time)
        self._like = change.found.fit.state
        vehicles, fitness = change.found.samples.tracks, change.found.fit.fitness
        row = Row(
            estimate=new, vehicles=vehicles, fitness=fitness, chi2=change.chi2, corrected=True
        )
        self.rows.append(replace(row, estimate=self._later(new, time)))
        self._replace_since(replace(row, event=MOVED))
        self._past = deque([start, self.now])

    def _give_up_if_lost(self, time: float) -> None:
        """Declare `moved` with unknown pose after 100 s of rejected fits."""
        row = self.rows[-1]
        if row.event != REJECTED:
            self._rejected_since = None
            return
        if self._rejected_since is None:
            self._rejected_since = row.estimate
        if not self.confirmed or time - self._rejected_since.time < self._settings.lost_s:
            return
        lost = self._knocked(self._rejected_since)
        self._window.forget(lost.time)
        self._replace_since(Row(estimate=lost, event=MOVED), REJECTED)
        self._past, self._rejected_since = deque([lost]), None

    def _replace_since(self, row: Row, event: str = NOTHING) -> None:
        """Put a row in, and what follows from it in the place of all later ones."""
        begin = row.estimate.time
        late = [r.estimate.time for r in self.rows if r.estimate.time > begin]
        self.rows = [r for r in self.rows if r.estimate.time < begin] + [row]
        self.rows += [
            replace(row, estimate=self._later(row.estimate, time), event=event) for time in late
        ]

    def finish(self, name: str) -> None:
        """Refuse a track that no data have confirmed.

        Parameters
        ----------
        name : str
            Of the recording.

        Raises
        ------
        NoAnswerError
            If there were too few frames or vehicles, or they contradict the start pose.
        """
        if self.confirmed:
            return
        least = self._settings.localization.traces.least_frames
        if len(self._window) < least:
            raise NoAnswerError(
                f"{name}: {len(self._window)} frames, at least {least} are needed",
                hint="record longer: 100 s are a good length",
            )
        if self._seen:
            self._refuse_start(self._seen)
        least = self._settings.localization.answer.least_tracks
        raise NoAnswerError(
            f"{name}: {self._vehicles} moving vehicles within 100 s, at least {least} are needed "
            "to confirm the start pose",
            hint="record while traffic flows",
        )

    def _refuse_start(self, seen: WindowFit) -> None:
        if not seen.trusted:
            raise NoAnswerError(
                f"at the start pose only {seen.fit.fitness:.0%} of the traffic lie on lanes",
                hint=HINT,
            )
        gap: Floats = innovation(self.rows[0].estimate, seen.measurement).gap
        raise NoAnswerError(
            f"the traffic puts the sensor {np.linalg.norm(gap[:3]):.2f} m and "
            f"{np.degrees(np.linalg.norm(gap[3:])):.2f} deg from its start pose, more than that "
            "pose's sigma allows",
            hint=HINT,
        )


def _allowing(row: Row, move: Floats) -> Row:
    """Return a row whose pose may have moved: a failure must not look like an answer."""
    return replace(row, estimate=widened(row.estimate, move))
