"""Calibration monitor: follow the pose of a sensor through a recording."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from gis_radar.base import (
    QUIET,
    STEP_S,
    Floats,
    NoAnswerError,
    Reporter,
    Text,
    iso_from_step,
    require_same,
    seconds_from_iso,
    step_of,
)
from gis_radar.calibration.monitoring.kalman_filter import (
    CYCLE_S,
    KNOCK,
    Estimate,
    by_common_error,
    corrected,
    covariance_from_angles,
    displaced,
    innovation,
    likeliest_move,
    predicted,
    widened,
)
from gis_radar.calibration.monitoring.moves import (
    MOVE_GATE,
    Change,
    MoveTest,
    Scatter,
    SuspectedMove,
)
from gis_radar.calibration.monitoring.pose_track import (
    MOVED,
    NOTHING,
    REJECTED,
    Row,
    Track,
    track_of,
)
from gis_radar.calibration.monitoring.stationary_targets import Displacement, Watch
from gis_radar.calibration.monitoring.windows import WindowFit, WindowFitter, WindowTraffic
from gis_radar.calibration.registration.hypotheses import PRIOR_REFLECTION_M
from gis_radar.calibration.registration.traces import LEAST_FRAMES, WINDOW_FRAMES
from gis_radar.calibration.single.lane_method import LEAST_TRACKS
from gis_radar.calibration.single.moving import MovingWindow
from gis_radar.calibration.single.result import Problem
from gis_radar.hdmap import LaneletMap
from gis_radar.poses import COMPONENTS, Evidence, Pose, PoseTrack, as_track
from gis_radar.recordings import Detections, Recording, as_recording

# Time of rejected fits, a full window, after which the sensor counts as moved with unknown pose.
LOST_S = 100.0
# 1 sigma of a start pose that states none: measured with tape, compass and spirit level.
BY_HAND = (1.0, 1.0, 1.0, math.radians(2.0), math.radians(2.0), math.radians(2.0))
_LEAST_CYCLE = 0.5  # least length of the last cycle, as a share of a full one, to give a pose
# Least sigma of a start pose; keeps the covariance regular.
_LEAST_SIGMA = (1e-3, 1e-3, 1e-3, math.radians(1e-3), math.radians(1e-3), math.radians(1e-3))
# Share of the variance of a localized pose that is noise of its window; the rest, by errors of map
# and model, is common to all windows.
_NOISE_SHARE = 0.3

_STAGE = "following the pose"
_SAME_MAP = ("lane", "track")  # methods whose poses share the map's errors
_HINT = Text("find the pose with gis-radar localize")


def track(
    recording: str | Path | Recording,
    roads: LaneletMap,
    road_points: Floats,
    pose: Pose | PoseTrack | str | Path,
    *,
    reporter: Reporter = QUIET,
) -> Track:
    """Follow the pose of a sensor through a recording, one corrected pose each cycle.

    The recording is read once, in batches; memory holds the frames of the window and the poses.

    Parameters
    ----------
    recording : str, Path or Recording
        The frames.
    roads : LaneletMap
        The lanes.
    road_points : (n, 3) array
        Points of the road's surface in the map's CRS, as :func:`gis_radar.read_road` gives them.
    pose : Pose, PoseTrack or its file
        Pose of the sensor at the begin of the recording, as from :func:`gis_radar.localize`; of a
        track the pose that is valid then.
    reporter : Reporter
        Receives progress and remarks.

    Raises
    ------
    CrsError
        If pose and map are in different coordinate systems.
    InputError
        If the recording cannot be read, or scan and map do not overlap.
    NoAnswerError
        If the data do not confirm the start pose: too little traffic, too few frames, or a pose
        too far off.
    """
    opened, start_track = as_recording(recording), as_track(pose)
    opened.require_elevation("its pose cannot be followed")
    require_same(start_track.poses[0].crs, roads.crs, what="the pose", other_what="the map")
    cycles = _cycles(opened, reporter)
    first, first_end = next(cycles)
    begin = float(first.time[0])
    start = start_track.poses[int(start_track.at(np.array([begin]))[0])]
    problem = Problem(
        name=start.sensor,
        roads=roads,
        road=np.asarray(road_points, dtype=np.float64),
        guess=start.position[:2],
    )
    fitter = WindowFitter(problem, reporter=reporter)
    follower = Follower(fitter, start_estimate(start, begin), name=start.sensor, reporter=reporter)
    for rows, end in chain([(first, first_end)], cycles):
        follower.push(rows)
        if end is not None:
            follower.cycle(end)
    follower.finish(str(opened.path))
    followed = track_of(problem, start, follower.rows)
    for line in followed.poses.warn_uncertain(begin, follower.now.time):
        reporter.warn(line)
    return followed


def _cycles(recording: Recording, reporter: Reporter) -> Iterator[tuple[Detections, float | None]]:
    """Yield batches of a recording, cut at the ends of cycles: with that time, or None between."""
    begin = last = due = np.nan
    done = 0
    for batch in recording.read():
        rows, done = batch, done + len(batch)
        if np.isnan(due):
            begin, due = float(rows.time[0]), float(rows.time[0]) + CYCLE_S
        last = float(rows.time[-1])
        while len(rows) and last >= due:
            early = rows.time < due
            yield rows.take(early), due
            rows = rows.take(~early)
            # skip cycles without frames
            count = np.floor((rows.time[0] - begin) / CYCLE_S) + 1.0
            due = begin + CYCLE_S * count
            if due <= rows.time[0]:  # rounding: the cycle must end after this frame
                due = begin + CYCLE_S * (count + 1.0)
        yield rows, None
        reporter.progress(_STAGE, done, recording.rows)
    if due - last < (1.0 - _LEAST_CYCLE) * CYCLE_S:
        yield rows.take(np.zeros(len(rows), dtype=bool)), due


def start_estimate(pose: Pose, time: float) -> Estimate:
    """Convert a pose to an estimate; its easting and northing become the local (0, 0).

    A pose that was found from the same data gets the sigma of one measured by hand, so that they
    do not count twice.

    Parameters
    ----------
    pose : Pose
        A pose with `covariance` or `sigma` in its evidence, or neither.
    time : float
        UNIX seconds of the first frame.

    Raises
    ------
    InputError
        If covariance or sigma are invalid.
    """
    evidence = pose.parsed_evidence()
    shares_errors = evidence.method in _SAME_MAP
    covariance = _stated_covariance(evidence)
    if covariance is None or (shares_errors and _uses_data_after(evidence, time, pose.sensor)):
        shares_errors = False
        covariance = np.diag(np.square(BY_HAND))
    turn_covariance = covariance_from_angles(pose.quaternion, covariance) + np.diag(
        np.square(_LEAST_SIGMA)
    )
    position = np.array([0.0, 0.0, pose.height])
    common = np.zeros((6, 6))
    if shares_errors:
        common = -by_common_error(turn_covariance - _NOISE_SHARE * turn_covariance)
    return Estimate(
        time=time,
        position=position,
        quaternion=pose.quaternion,
        covariance=turn_covariance,
        common=common,
    )


def _uses_data_after(evidence: Evidence, time: float, sensor: str) -> bool:
    """Return whether a pose was found from data after a time (UNIX seconds), or may have been."""
    if not evidence.time:
        return True
    found_at = seconds_from_iso(evidence.time, what=Text("pose of {}: time", sensor))
    return found_at > time + STEP_S


def _stated_covariance(evidence: Evidence) -> Floats | None:
    """Return the (6, 6) covariance of a pose, missing sigmas as `BY_HAND`; None if it has none."""
    if evidence.covariance is not None or not evidence.sigma:
        return evidence.covariance
    sigma = np.array(BY_HAND)
    for i, name in enumerate(COMPONENTS):
        if name in evidence.sigma:
            stated = evidence.sigma[name]
            sigma[i] = stated if i < 3 else math.radians(stated)
    return np.diag(sigma**2)


class Follower:
    """Follows the pose of one sensor through its frames.

    Each cycle fits the rolling window to the lanes, and with this fit corrects the estimate from
    **before the window began**, so that no detection counts twice although windows overlap.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    start : Estimate
        The start pose.
    name : str
        Name of the sensor, for warnings.
    reporter : Reporter
        Receives a warning for each move.
    """

    def __init__(
        self,
        fitter: WindowFitter,
        start: Estimate,
        *,
        name: str = "the sensor",
        reporter: Reporter = QUIET,
    ) -> None:
        self.rows = [Row(estimate=start)]
        self.confirmed = False
        self._fitter = fitter
        self._name, self._reporter = name, reporter
        self.watch, self.scatter = Watch(), Scatter()
        self._window = MovingWindow()
        self._past: deque[Estimate] = deque([start])
        self._reflection_m = PRIOR_REFLECTION_M
        self._last_fit: WindowFit | None = None
        self._vehicles = 0
        self._rejected_since: Estimate | None = None

    @property
    def now(self) -> Estimate:
        """The latest estimate."""
        return self.rows[-1].estimate

    def push(self, rows: Detections) -> None:
        """Add the next detections, if there are any."""
        if len(rows):
            self._window.push(rows)
            self.watch.push(rows)

    def cycle(self, time: float) -> None:
        """End a cycle: correct the pose by the frames of the window.

        Parameters
        ----------
        time : float
            End of the cycle, UNIX seconds, from which the corrected pose is valid.

        Raises
        ------
        NoAnswerError
            If a full window of traffic does not confirm the start pose.
        """
        traffic = WindowTraffic.of(self._window.moving())
        suspected = self._suspected_move(traffic, time)
        if suspected is not None and suspected.change is not None:
            self._restart_at_change(suspected.change, time)
        else:
            row = self._correct(
                traffic, time, suspected=suspected is not None and suspected.certain
            )
            self._append(row if suspected is None else _widened_row(row, suspected.move))
        self._give_up_if_lost(time)
        move = self.watch.find_move(self.now.state(self._reflection_m).R_map_sensor, time)
        if move is not None and self.confirmed:
            self._apply_move(move, time)
        self._vehicles = max(self._vehicles, traffic.vehicles)
        if not self.confirmed and self._window.full and self._last_fit:
            self._refuse_start(self._last_fit)

    def _suspected_move(self, traffic: WindowTraffic, time: float) -> SuspectedMove | None:
        """Return the move that the newest part of the window suggests, or None."""
        if not self.confirmed or traffic.vehicles < LEAST_TRACKS or self.watch.unmoved:
            return None
        expected = partial(self._expected, time=time)
        test = MoveTest(
            fitter=self._fitter, traffic=traffic, now=time, expected=expected, scatter=self.scatter
        )
        return test.suspected(self._reflection_m)

    def _correct(self, traffic: WindowTraffic, time: float, *, suspected: bool) -> Row:
        """Return the pose at `time`, corrected by the window if its fit is trusted."""
        row = Row(estimate=predicted(self.now, time), vehicles=traffic.vehicles)
        if suspected:
            return replace(row, event=REJECTED)
        prior = self._expected(traffic.moving.begin, time)
        window_fit = self._fitter.fit(traffic, prior, self._reflection_m)
        if window_fit is None:
            return row
        self._last_fit = window_fit
        gap = innovation(prior, window_fit.measurement)
        row = replace(row, fitness=window_fit.fit.fitness, chi2=gap.chi2)
        if not window_fit.on_lanes:
            return replace(row, event=REJECTED)
        if window_fit.trusted and gap.chi2 > MOVE_GATE:
            return _widened_row(replace(row, event=REJECTED), likeliest_move(gap))
        if not window_fit.trusted:
            return row  # not converged
        if not self._window.full:
            self._fitter.refuse_other_lane(window_fit)
        self.confirmed = True
        self._reflection_m = window_fit.fit.state.reflection
        self._fitter.adapt(window_fit)
        return replace(row, estimate=corrected(prior, window_fit.measurement), corrected=True)

    def _expected(self, before: float, time: float) -> Estimate:
        """Return the pose at `time`, predicted from the data until `before` (UNIX seconds)."""
        return predicted(self._estimate_before(before), time)

    def _estimate_before(self, time: float) -> Estimate:
        """Return the latest estimate that used no data after a time, else the first."""
        earlier = [e for e in self._past if e.time <= time]
        return earlier[-1] if earlier else self._past[0]

    def _append(self, row: Row) -> None:
        """Append a row; drop past estimates that no window needs."""
        self.rows.append(row)
        self._past.append(row.estimate)
        while len(self._past) > 1 and self._past[1].time <= self._window.begin:
            self._past.popleft()

    def _apply_move(self, displacement: Displacement, time: float) -> None:
        """Move the pose by a displacement, from the begin of its blocks on; restart the watch."""
        since = time - displacement.seconds
        earlier = [row.estimate for row in self.rows if row.estimate.time <= since]
        before = predicted((earlier or [self.rows[0].estimate])[-1], since)
        new = displaced(before, displacement.move, displacement.covariance)
        self._continue_from_move(Row(estimate=new, vehicles=self.rows[-1].vehicles))
        self._warn_of_move(new, displacement.move)

    def _continue_from_move(self, row: Row, later: str = NOTHING) -> None:
        """Continue from the pose after a move, with the frames and rows since then."""
        self._window.forget(row.estimate.time)
        self._replace_since(replace(row, event=MOVED), later)
        self._past, self._rejected_since = deque([row.estimate]), None
        self.watch.restart()

    def _warn_of_move(self, new: Estimate, move: Floats) -> None:
        """Report a move, with its size and time."""
        when = iso_from_step(int(step_of(np.array(new.time))))
        self._reporter.warn(
            "{} was moved by about {:.2f} m and {:.2f} deg around {}",
            self._name,
            np.linalg.norm(move[:3]),
            np.degrees(np.linalg.norm(move[3:])),
            when,
        )

    def _restart_at_change(self, change: Change, time: float) -> None:
        """Restart the filter at a change of the pose, and replace the rows since then."""
        before, fit = self._expected(change.time, change.time), change.fit.fit
        start = _after_blow(before)
        new = corrected(start, change.fit.measurement)
        self._reflection_m = fit.state.reflection
        row = Row(
            estimate=new, vehicles=change.fit.samples.tracks, fitness=fit.fitness,
            chi2=change.chi2, corrected=True,
        )  # fmt: skip
        self.rows.append(replace(row, estimate=predicted(new, time)))
        self._continue_from_move(row)
        self._past = deque([start, self.now])
        gap = innovation(before, change.fit.measurement)
        self._warn_of_move(new, likeliest_move(gap))

    def _give_up_if_lost(self, time: float) -> None:
        """Declare `moved` with unknown pose after `LOST_S` of rejected fits."""
        row = self.rows[-1]
        if row.event != REJECTED:
            self._rejected_since = None
            return
        if self._rejected_since is None:
            self._rejected_since = row.estimate
        if not self.confirmed or time - self._rejected_since.time < LOST_S:
            return
        self._continue_from_move(Row(estimate=_after_blow(self._rejected_since)), REJECTED)

    def _replace_since(self, row: Row, event: str = NOTHING) -> None:
        """Insert a row, and replace all later ones by its predictions."""
        begin = row.estimate.time
        late = [r.estimate.time for r in self.rows if r.estimate.time > begin]
        self.rows = [r for r in self.rows if r.estimate.time < begin] + [row]
        self.rows += [
            replace(row, estimate=predicted(row.estimate, time), event=event) for time in late
        ]

    def finish(self, name: str) -> None:
        """Refuse a track whose start pose was not confirmed.

        Parameters
        ----------
        name : str
            Name of the recording.

        Raises
        ------
        NoAnswerError
            If there were too few frames or vehicles, or they contradict the start pose.
        """
        if self.confirmed:
            return
        if len(self._window) < LEAST_FRAMES:
            raise NoAnswerError(
                "{}: {} frames, at least {} are needed",
                name,
                len(self._window),
                LEAST_FRAMES,
                hint=Text("record longer: {} frames are a good length", WINDOW_FRAMES),
            )
        if self._last_fit:
            self._refuse_start(self._last_fit)
        raise NoAnswerError(
            "{}: {} moving vehicles in the window, at least {} are needed to confirm the "
            "start pose",
            name,
            self._vehicles,
            LEAST_TRACKS,
            hint="record while traffic flows",
        )

    def _refuse_start(self, seen: WindowFit) -> None:
        """Refuse the start pose, which a fit contradicts."""
        if not seen.trusted:
            raise NoAnswerError(
                "at the start pose only {:.0%} of the traffic lie on lanes",
                seen.fit.fitness,
                hint=_HINT,
            )
        gap: Floats = innovation(self.rows[0].estimate, seen.measurement).gap
        raise NoAnswerError(
            "the traffic puts the sensor {:.2f} m and {:.2f} deg from its start pose, "
            "more than that pose's sigma allows",
            np.linalg.norm(gap[:3]),
            np.degrees(np.linalg.norm(gap[3:])),
            hint=_HINT,
        )


def _after_blow(estimate: Estimate) -> Estimate:
    """Return an estimate with the covariance of a blow, `KNOCK`, added."""
    return replace(estimate, covariance=estimate.covariance + np.diag(np.square(KNOCK)))


def _widened_row(row: Row, move: Floats) -> Row:
    """Return a row with its estimate widened by a possible move."""
    return replace(row, estimate=widened(row.estimate, move))
