"""Edge, a sensor's program: it stores detections near the road on disk and sends them to fusion."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import Empty, Full, Queue, SimpleQueue
from threading import Event, Thread
from time import sleep

import geopandas as gpd
import numpy as np

from gis_radar.base import QUIET, STEP_US, Floats, NoAnswerError, Reporter, Text, require_same
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
from gis_radar.hdmap import LaneletMap, read_map, read_tiles
from gis_radar.live.wire.broker import Link, SensorTopics
from gis_radar.live.wire.detections import DetectionSelector, FrameDetections, pack_detections
from gis_radar.live.wire.outbox import OFFLINE_STATUS, DiskBuffer, Outbox, status_message
from gis_radar.live.wire.payload import PoseContent, in_parts, key_of_pose
from gis_radar.live.wire.settings import EdgeFile, read_edge_file
from gis_radar.live.wire.sources import IDLE_S, Frames, Radar, Replay
from gis_radar.measures import road_near
from gis_radar.poses import ANGLES, DECIMALS, POSITION, Pose, View, read_track
from gis_radar.recordings import Detections
from gis_radar.scans import SightTiles, find_sight, read_road

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


_RETRY_FRAMES = 500  # frames until a pose that traffic refused is followed again: 25 s


class Edge:
    """Edge of one sensor.

    Parameters
    ----------
    file : EdgeFile
        The sensor's file.
    reporter : Reporter
        Receives the log.

    Raises
    ------
    InputError
        If tiles or pose cannot be read, or do not fit each other.
    """

    def __init__(self, file: EdgeFile, *, reporter: Reporter = QUIET) -> None:
        self.frames = self.not_sent = self.not_followed = 0
        self._file, self._reporter = file, reporter
        tiles = read_tiles(file.tiles)
        self._road = SightTiles.of(tiles)
        self._pose: Pose | None = None
        self._pose_key, self._road_m = b"", np.nan
        self._last_step, self._trusted = -1, True
        self._last_time, self._doubted = -np.inf, False
        self._newest_pose: FollowedPose | None = FollowedPose(pose=self._read_pose(tiles))
        self._follower: PoseFollower | None = None
        self._waiting: list[FrameDetections] = []
        self._selector = DetectionSelector(self._road)
        self._frames_to_retry = 0  # frames until a pose that traffic refused is followed again

    def _read_pose(self, tiles: gpd.GeoDataFrame) -> Pose:
        """Return the pose of the sensor's file, in the tiles' CRS, with its name and view there."""
        pose = read_track(self._file.pose).poses[-1]
        what = Text("the pose of {}", pose.sensor)
        require_same(pose.crs, tiles.crs, what=what, other_what="the tiles")
        view = view_of(self._file)
        pose = replace(pose, sensor=self._file.sensor)
        return rounded(pose if view is None else pose.with_view(view))

    def run(self, stop: Event) -> None:
        """Run until the source ends and fusion has stored all, or until stopped.

        Parameters
        ----------
        stop : Event
            Event that stops it; waiting messages stay on disk.

        Raises
        ------
        InputError
            If the source cannot be read.
        """
        file = self._file
        topics = SensorTopics(file.site, file.sensor)
        most = int(file.buffer.megabytes * 1e6)
        with DiskBuffer(
            file.buffer_path, most_bytes=most, fingerprint=self._road.fingerprint
        ) as buffer:
            if buffer.put_aside:
                self._reporter.warn("{}: {}, and is put aside", buffer.put_aside, buffer.why)
            will = status_message(OFFLINE_STATUS, stream=buffer.stream.hex())
            link = Link(
                file.address(), name=f"{file.site}-{file.sensor}", topics=(topics.of("ack"),),
                will=(topics.of("status"), will), reporter=self._reporter,
            )  # fmt: skip
            self.outbox = Outbox(
                buffer, link, topics, figures=lambda: self._figures(buffer),
                reporter=self._reporter,
            )  # fmt: skip
            link.open()
            try:
                self._work(stop)
            finally:
                self._stop_following()
                link.close(topics.of("status"), will)

    def figures(self) -> dict[str, object]:
        """Return counts of what it did, by name."""
        return {"frames": self.frames, "not_sent": self.not_sent, "lost": self.outbox.lost}

    def _figures(self, buffer: DiskBuffer) -> dict[str, object]:
        """Return the figures of a status message."""
        return {
            "fingerprint": self._road.fingerprint,
            "frames": self.frames,
            "lost": self.outbox.lost,
            "not_followed": self.not_followed,
            "waiting_bytes": buffer.bytes_used,
            "trusted": self._trusted,
        }

    def source(self) -> Frames:
        """Yield the frames of the source as they come, None while no frame comes."""
        source = self._file.source
        if source.recording is not None:
            return Replay(path=source.recording, speed=source.speed, loop_s=source.loop).frames()
        radar = Radar(source=source.address or "", sensor=source.sensor, reporter=self._reporter)
        return radar.frames()

    def new_follower(self, start: Pose, begin: float, *, doubted: bool) -> PoseFollower:
        """Begin to follow a pose, as :meth:`PoseFollower.of` does."""
        return PoseFollower.of(self._file, start, begin, doubted=doubted, reporter=self._reporter)

    def _work(self, stop: Event) -> None:
        """Process frames until stopped or the source ends; then wait for fusion to store all."""
        for frame in self.source():
            if stop.is_set():
                break
            if frame is not None:
                self._reset_after_jump(frame)
                self._process(frame)
            self.outbox.pump()
        self._flush()
        while not (stop.is_set() or self.outbox.empty):
            self.outbox.pump()
            sleep(IDLE_S)

    def _reset_after_jump(self, frame: Detections) -> None:
        """Reset the waiting frames after a backward jump of the clock."""
        time = float(frame.time[0])
        if time < self._last_time:
            self._flush()
            self._last_step = -1
            self._stop_following()
        self._last_time = time

    def _process(self, frame: Detections) -> None:
        """Select the detections of a frame by the newest pose, which is used from a new step on."""
        if self._follower is not None:
            self.not_followed += not self._follower.push(frame)
            self._newest_pose = self._follower.latest() or self._newest_pose
            if self._newest_pose is not None and self._newest_pose.refused:
                self._pause_following()
        elif self._doubted:
            self._frames_to_retry -= 1
            if self._frames_to_retry <= 0:
                self._start_following(frame)
        step = int(np.rint(frame.time[0] * 1e6)) // STEP_US
        newest = self._newest_pose
        if newest is not None and step > self._last_step and self._use_pose(newest):
            self._newest_pose = None
        if self._follower is None and not self._doubted:
            self._start_following(frame)
        self._select(frame)

    def _pause_following(self) -> None:
        """Stop following a pose that traffic refused, for `_RETRY_FRAMES`."""
        self._stop_following()
        self._doubted, self._frames_to_retry = True, _RETRY_FRAMES

    def _start_following(self, frame: Detections) -> None:
        """Start following the pose from a frame on, where the sensor's file asks for it."""
        file = self._file
        if file.follow and file.map is not None and file.road is not None and self._pose:
            begin = float(frame.time[0])
            start = self._newest_pose.pose if self._newest_pose is not None else self._pose
            self._follower = self.new_follower(start, begin, doubted=self._doubted)

    def _stop_following(self) -> None:
        if self._follower is not None:
            self._follower.close()
        self._follower = None

    def _use_pose(self, found: FollowedPose) -> bool:
        """Select detections by a pose from now on, and send it; return False on a full disk."""
        is_same = self._pose is not None and _is_same(self._pose, found.pose)
        if is_same and found.trusted == self._trusted:
            return True
        self._flush()
        content = PoseContent(pose=found.pose.as_dict(), fingerprint=self._road.fingerprint).pack()
        if not self.outbox.put_pose(content):  # fusion would not know it: keep the earlier one
            return False
        if found.refused and self._trusted:
            self._reporter.warn("the pose is not confirmed: {}", found.refused)
        self._pose, self._pose_key = found.pose, key_of_pose(content)
        self._road_m = road_near(find_sight(found.pose, self._road), self._road)
        self._trusted = found.trusted
        self._doubted = self._doubted and not found.trusted
        return True

    def _select(self, frame: Detections) -> None:
        """Add the detections near the road to the next message, where the pose is known."""
        if self._pose is None:  # the buffer refused it
            self.frames += 1
            self.not_sent += 1
            return
        selected = self._selector.find(frame, self._pose, road_m=self._road_m)
        self.frames += 1
        self._last_step = selected.time_us // STEP_US
        if not self._trusted:
            self.not_sent += 1
            return
        self._waiting.append(selected)
        if len(self._waiting) >= self._file.frames_a_message:
            self._flush()

    def _flush(self) -> None:
        """Put the waiting frames on disk, as one message where they fit."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            for content in in_parts(waiting, partial(pack_detections, pose=self._pose_key)):
                self.outbox.put(content)


def _is_same(first: Pose, second: Pose) -> bool:
    names = (*POSITION, *ANGLES, "view")
    return all(getattr(first, name) == getattr(second, name) for name in names)


def run_edge(path: str | Path, *, stop: Event | None = None, reporter: Reporter = QUIET) -> Edge:
    """Run the edge of a sensor.

    Parameters
    ----------
    path : str or Path
        A sensor's file, described in `docs/live.md`.
    stop : Event, optional
        Event that stops it; by default only the end of the source does.
    reporter : Reporter
        Receives the log.

    Returns
    -------
    Edge
        The edge, with its counts.

    Raises
    ------
    InputError
        If the file, tiles, pose or source cannot be read.
    """
    edge = Edge(read_edge_file(path), reporter=reporter)
    edge.run(stop or Event())
    return edge
