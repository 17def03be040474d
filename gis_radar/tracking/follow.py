"""Tracking: the pose of a sensor followed through a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.crs import require_same
from gis_radar.lanelets import LaneletMap
from gis_radar.localization.result import Problem
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import COMPONENTS, Evidence, Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Detections, Recording, as_recording
from gis_radar.steps import STEP_S, seconds_from_iso
from gis_radar.tracking.filter import Estimate, Measurement, covariance_from_angles
from gis_radar.tracking.follower import Follower
from gis_radar.tracking.settings import DEFAULTS, TrackingSettings
from gis_radar.tracking.track import Track, track_of
from gis_radar.tracking.windows import WindowFitter

STAGE = "following the pose"
SAME_MAP = ("lane", "track")  # methods that share the map's errors with ours


def track(
    recording: str | Path | Recording,
    roads: LaneletMap,
    road_points: Floats,
    pose: Pose | PoseTrack,
    *,
    settings: TrackingSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> Track:
    """Follow the pose of a sensor through a recording, one corrected pose every 5 s.

    The recording is read once, piece by piece; memory is that of the last 2000 frames and of the
    poses.

    Parameters
    ----------
    recording : str, Path or Recording
        The frames.
    roads : LaneletMap
        The lanes.
    road_points : (n, 3) array
        Points of the road's surface in the map's CRS, as :func:`gis_radar.read_road` gives them.
    pose : Pose or PoseTrack
        Where the sensor stands when the recording begins, as :func:`gis_radar.localize` finds it;
        of a track the pose that holds then.
    settings : TrackingSettings
        All constants of the tracking.
    reporter : Reporter
        Told the progress and remarks.

    Raises
    ------
    CrsError
        If pose and map are in different coordinate systems.
    InputError
        If the recording cannot be read, or scan and map do not overlap.
    NoAnswerError
        If the data do not confirm the start pose: no traffic, too few frames, a pose too far off.
    """
    opened, known = as_recording(recording), as_track(pose)
    require_same(known.poses[0].crs, roads.crs, what="the pose", other_what="the map")
    cycles = _cycles(opened, settings, reporter)
    first, ends = next(cycles)
    begin = float(first.time[0])
    start = known.poses[int(known.at(np.array([begin]))[0])]
    problem = Problem(
        name=start.sensor,
        roads=roads,
        road=np.asarray(road_points, dtype=np.float64),
        guess=start.position[:2],
        heading=None,
    )
    fitter = WindowFitter(problem, settings, reporter=reporter)
    follower = Follower(fitter, start_estimate(start, begin, settings), settings)
    for piece, end in chain([(first, ends)], cycles):
        follower.push(piece)
        if end is not None:
            follower.cycle(end)
    follower.finish(str(opened.path))
    return track_of(problem, start, follower.rows, settings)


def _cycles(
    recording: Recording, settings: TrackingSettings, reporter: Reporter
) -> Iterator[tuple[Detections, float | None]]:
    """Cut a recording where a cycle ends; yield its parts, and the time where one has ended."""
    cycle_s = settings.cycle_s
    begin = last = due = np.nan
    done = 0
    for batch in recording.read():
        piece, done = batch, done + len(batch)
        if np.isnan(due):
            begin, due = float(piece.time[0]), float(piece.time[0]) + cycle_s
        last = float(piece.time[-1])
        while len(piece) and last >= due:
            early = piece.time < due
            yield piece.take(early), due
            piece = piece.take(~early)
            # no pose where there are no frames
            due = begin + cycle_s * (np.floor((piece.time[0] - begin) / cycle_s) + 1.0)
        yield piece, None
        reporter.progress(STAGE, done, recording.rows)
    if due - last < (1.0 - settings.least_cycle) * cycle_s:
        yield piece.take(np.zeros(len(piece), dtype=bool)), due


def start_estimate(pose: Pose, time: float, settings: TrackingSettings = DEFAULTS) -> Estimate:
    """Return a pose as an estimate; its easting and northing are the local (0, 0).

    A pose that was found from the very data that follow holds no further information: it is where
    to begin, and its uncertainty that of a pose measured by hand.

    Parameters
    ----------
    pose : Pose
        With `covariance` or `sigma` in its evidence, or neither.
    time : float
        UNIX seconds of the first frame.
    settings : TrackingSettings
        Of a pose without sigma.

    Raises
    ------
    InputError
        If covariance or sigma are none.
    """
    evidence = pose.parsed_evidence()
    found_here = evidence.method in SAME_MAP
    by_hand = np.array(settings.by_hand)
    covariance = _stated_covariance(evidence, by_hand)
    if covariance is None or (found_here and _sees(evidence, time, pose.sensor)):
        found_here = False
        covariance = np.diag(by_hand**2)
    turned = covariance_from_angles(pose.quaternion, covariance) + np.diag(
        np.square(settings.least_sigma)
    )
    position = np.array([0.0, 0.0, pose.height])
    common = np.zeros((6, 6))
    if found_here:
        measured = Measurement(
            position=position,
            quaternion=pose.quaternion,
            covariance=turned,
            noise=settings.noise_share * turned,
        )
        common = -measured.common
    return Estimate(
        time=time,
        position=position,
        quaternion=pose.quaternion,
        covariance=turned,
        common=common,
    )


def _sees(evidence: Evidence, time: float, sensor: str) -> bool:
    """Tell whether a pose was found from data after a time."""
    if not evidence.time:
        return True
    found = seconds_from_iso(evidence.time, what=f"pose of {sensor}: time")
    return found > time + STEP_S


def _stated_covariance(evidence: Evidence, by_hand: Floats) -> Floats | None:
    """Return the (6, 6) covariance of a pose, where sigma lacks a component by hand's; or None."""
    if evidence.covariance is not None or not evidence.sigma:
        return evidence.covariance
    sigma = by_hand.copy()
    for i, name in enumerate(COMPONENTS):
        if name in evidence.sigma:
            stated = evidence.sigma[name]
            sigma[i] = stated if i < 3 else math.radians(stated)
    return np.diag(sigma**2)
