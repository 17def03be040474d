"""Own pose of a sensor, followed every 5 s by its traffic."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, Full, Queue, SimpleQueue
from threading import Event, Thread

import numpy as np

from gis_radar.base import QUIET, Floats, NoAnswerError, Reporter
from gis_radar.calibration import (
    CYCLE_S,
    LOST_S,
    MOVED,
    Follower,
    Problem,
    WindowFitter,
    start_estimate,
    track_of,
)
from gis_radar.hdmap import LaneletMap, read_map
from gis_radar.live.wire.settings import EdgeFile
from gis_radar.poses import ANGLES, DECIMALS, POSITION, Pose, View
from gis_radar.recordings import Detections
from gis_radar.scans import read_road

WAITING_FRAMES = 2_000  # most frames that wait for a fit to end: 100 s
_ROWS_KEPT = 1_440  # poses that the follower keeps: 2 h


def rounded(pose: Pose) -> Pose:
    """Round a pose to the digits of a pose track, so that both are the same."""
    names = (*POSITION, *ANGLES)
    return replace(pose, **{name: round(getattr(pose, name), DECIMALS) for name in names})


def view_of(file: EdgeFile) -> View | None:
    """Return the view in a sensor's file, or None."""
    return None if file.view is None else View(**vars(file.view))


@dataclass(frozen=True, kw_only=True)
class FollowedPose:
    """Result of the follower.

    Parameters
    ----------
    pose : Pose
        The pose from now on.
    trusted : bool
        False from a move until a whole window of traffic has corrected the pose again.
    refused : str
        The reason why the traffic does not confirm the start pose; empty where it does.
    """

    pose: Pose
    trusted: bool = True
    refused: str = ""


class PoseFollower:
    """Follower of the pose in a thread of its own, as a fit takes longer than a frame.

    The tracking is that of `gis-radar track`. It notices a move afterwards and replaces earlier
    poses, but detections selected by these are already sent. So the pose counts as unknown from the
    moment at which the move is noticed.

    Parameters
    ----------
    follower : Follower
        Fits the pose to windows of frames.
    problem : Problem
        Map, road and place for the fits.
    start : Pose
        The start pose.
    begin : float
        UNIX seconds of the first frame to follow.
    doubted : bool
        Whether traffic refused the pose before: it is trusted only once traffic confirms it.
    """

    def __init__(
        self, follower: Follower, problem: Problem, start: Pose, begin: float, *,
        doubted: bool = False,
    ) -> None:  # fmt: skip
        self._follower, self._problem, self._doubted = follower, problem, doubted
        self._frames: Queue[Detections | None] = Queue(WAITING_FRAMES)
        self._results: SimpleQueue[FollowedPose | Exception] = SimpleQueue()
        self._ended = Event()
        self._start, self._due = start, begin + CYCLE_S
        self._moved_at = -np.inf
        self._thread = Thread(target=self._work, daemon=True, name="pose")
        self._thread.start()

    @classmethod
    def of(
        cls, file: EdgeFile, start: Pose, begin: float, *, doubted: bool = False,
        reporter: Reporter = QUIET,
    ) -> PoseFollower:  # fmt: skip
        """Follow the pose of a sensor by map and road of its file, and log each move."""
        roads, road = _map_of(file, start)
        problem = Problem(
            name=start.sensor, roads=roads, road=road, guess=start.position[:2], heading=None
        )
        follower = Follower(
            WindowFitter(problem, reporter=reporter),
            start_estimate(start, begin), name=start.sensor, reporter=reporter,
        )  # fmt: skip
        return cls(follower, problem, start, begin, doubted=doubted)

    def push(self, frame: Detections) -> bool:
        """Take the next frame; return False where fits are too slow for it."""
        try:
            if not self._ended.is_set():  # else nothing follows
                self._frames.put_nowait(frame)
        except Full:
            return False
        return True

    def latest(self) -> FollowedPose | None:
        """Return a pose newer than the last call, or None; raise an error of the thread."""
        newest = None
        while not self._results.empty():
            found = self._results.get()
            if isinstance(found, Exception):
                raise found
            newest = found
        return newest

    def close(self) -> None:
        """Stop following."""
        self._ended.set()
        with suppress(Full):
            self._frames.put_nowait(None)
        self._thread.join()

    def _work(self) -> None:
        """Run on the thread: follow until closed; a refusal or an error becomes a result."""
        try:
            self._follow()
        except NoAnswerError as error:
            self._results.put(FollowedPose(pose=self._start, trusted=False, refused=error.message))
        except Exception as error:  # noqa: BLE001 - raised by latest, in the edge's own thread
            self._results.put(error)
        self._ended.set()
        with suppress(Empty):
            while True:
                self._frames.get_nowait()

    def _follow(self) -> None:
        """Push frames to the follower, and run a cycle every `CYCLE_S`."""
        while (frame := self._frames.get()) is not None and not self._ended.is_set():
            now = float(frame.time[0])
            if now >= self._due:
                self._cycle(self._due)
                cycles = np.floor((now - self._due) / CYCLE_S) + 1.0
                self._due += float(cycles) * CYCLE_S
            self._follower.push(frame)

    def _cycle(self, time: float) -> None:
        """Fit the pose to the last window, and put it into the results with its trust."""
        known = {id(row) for row in self._follower.rows}
        self._follower.cycle(time)
        rows = self._follower.rows
        if any(row.event == MOVED and id(row) not in known for row in rows):
            self._moved_at = time
        confirmed = self._follower.confirmed or not self._doubted
        trusted = confirmed and self._moved_at == -np.inf
        if confirmed and not trusted and rows[-1].corrected and time - self._moved_at >= LOST_S:
            trusted, self._moved_at = True, -np.inf
        pose = track_of(self._problem, self._start, rows[-1:]).poses.poses[0]
        self._results.put(FollowedPose(pose=rounded(pose), trusted=trusted))
        del rows[:-_ROWS_KEPT]


def _map_of(file: EdgeFile, pose: Pose) -> tuple[LaneletMap, Floats]:
    if file.map is None or file.road is None:
        raise NoAnswerError("{}: there is nothing to follow the pose by", file.path)
    roads = read_map(file.map.file, crs=file.map.crs or pose.crs, origin=file.map.origin)
    return roads, read_road(file.road, roads.crs)
