"""Edge, a sensor's program: it stores detections near the road on disk and sends them to fusion."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event
from time import sleep

import geopandas as gpd
import numpy as np

from gis_radar.base import QUIET, STEP_US, Reporter, Text, require_same
from gis_radar.hdmap import read_tiles
from gis_radar.live.own_pose import FollowedPose, PoseFollower, rounded, view_of
from gis_radar.live.wire.broker import Link, SensorTopics
from gis_radar.live.wire.buffer import DiskBuffer
from gis_radar.live.wire.detections import DetectionSelector, FrameDetections, pack_detections
from gis_radar.live.wire.outbox import OFFLINE_STATUS, Outbox, status_message
from gis_radar.live.wire.payload import PoseContent, in_parts, key_of_pose
from gis_radar.live.wire.settings import EdgeFile, read_edge_file
from gis_radar.live.wire.sources import IDLE_S, Frames, Radar, Replay
from gis_radar.measures import road_near
from gis_radar.poses import ANGLES, POSITION, Pose, read_track
from gis_radar.recordings import Detections
from gis_radar.scans import SightTiles, find_sight

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
