"""Tracking: the pose of a sensor followed through a recording."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.crs import require_same
from gis_radar.lanelets import LaneletMap
from gis_radar.localization.result import Problem
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Detections, Recording, as_recording
from gis_radar.tracking.follower import LEAST_CYCLE, Follower
from gis_radar.tracking.moves import CYCLE_S
from gis_radar.tracking.start import start_estimate
from gis_radar.tracking.track import Track, answer
from gis_radar.tracking.windows import WindowFitter

STAGE = "following the pose"


def track(
    recording: str | Path | Recording,
    roads: LaneletMap,
    road_points: Floats,
    pose: Pose | PoseTrack,
    *,
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
    cycles = _cycles(opened, reporter)
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
    fitter = WindowFitter(problem, reporter=reporter)
    follower = Follower(fitter, start_estimate(start, begin))
    for piece, end in chain([(first, ends)], cycles):
        follower.push(piece)
        if end is not None:
            follower.cycle(end)
    follower.finish(str(opened.path))
    return answer(problem, start, follower.rows)


def _cycles(recording: Recording, reporter: Reporter) -> Iterator[tuple[Detections, float | None]]:
    """Cut a recording where a cycle ends; yield its parts, and the time where one has ended."""
    begin = last = due = np.nan
    done = 0
    for batch in recording.read():
        piece, done = batch, done + len(batch)
        if np.isnan(due):
            begin, due = float(piece.time[0]), float(piece.time[0]) + CYCLE_S
        last = float(piece.time[-1])
        while len(piece) and last >= due:
            early = piece.time < due
            yield piece.take(early), due
            piece = piece.take(~early)
            # no pose where there are no frames
            due = begin + CYCLE_S * (np.floor((piece.time[0] - begin) / CYCLE_S) + 1.0)
        yield piece, None
        reporter.progress(STAGE, done, recording.rows)
    if due - last < (1.0 - LEAST_CYCLE) * CYCLE_S:
        yield piece.take(np.zeros(len(piece), dtype=bool)), due
