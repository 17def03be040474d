"""Process that follows the vehicles of now; fusion never waits for it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import Future
from itertools import islice
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.base import QUIET, GisRadarError, Reporter, WorkerPool, watch_parent
from gis_radar.hdmap import LaneGraph, lane_graph, make_tiles, read_map
from gis_radar.live.now.now_filter import NowFilter, VehiclesNow
from gis_radar.live.wire.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.wire.payload import POSE_BYTES
from gis_radar.live.wire.sources import frames_of_recording
from gis_radar.measures import rows_of
from gis_radar.poses import Pose, read_pose
from gis_radar.sample import sample_folder
from gis_radar.scans import SightTiles
from gis_radar.tracking import map_detections

_NOW_S, _REORDER_S = 0.5, 0.3  # period of the results; how long frames wait for other sensors
_LONGEST_SHOWN_S = 5.0  # older results are not shown
MOST_WAITING = 20_000  # most messages that wait for the process: 10 s of a hundred sensors
_RESTART_S = 30.0  # time until a process that ended is started again
_SAMPLE_FRAMES = 100  # frames of the sample that are followed: in 5 s vehicles are found


class PlacedMessage(NamedTuple):
    """Message of a sensor, with the pose by which its detections were selected.

    Parameters
    ----------
    sensor : int
        Number of the sensor.
    pose : Pose
        Its pose.
    road_m : float
        Height of the road near it, metres; NaN where not known.
    content : bytes
        Content of the message.
    """

    sensor: int
    pose: Pose
    road_m: float
    content: bytes


def layer_of(now: VehiclesNow, crs: Any) -> gpd.GeoDataFrame:
    """Return vehicles as points: `vehicle, speed` (m/s), `heading, length_m, heavy`."""
    return gpd.GeoDataFrame(
        {
            "vehicle": now.vehicle, "speed": now.speed.round(2), "heading": now.heading.round(1),
            "length_m": now.length_m.round(1), "heavy": now.heavy,
        },
        geometry=shapely.points(now.place.reshape(-1, 2)), crs=crs,
    )  # fmt: skip


class VehiclesAnswer(NamedTuple):
    """Answer of the process to a batch of messages.

    Parameters
    ----------
    now : VehiclesNow
        The vehicles.
    late : int
        Number of frames that were too old.
    """

    now: VehiclesNow
    late: int


class VehicleFollower:
    """Follower of the vehicles of now from messages of sensors, in a process of its own.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    """

    def __init__(self, graph: LaneGraph) -> None:
        self._filter = NowFilter(graph=graph)
        self._graph, self._newest = graph, -np.inf

    def advance(self, messages: Sequence[PlacedMessage]) -> VehiclesAnswer:
        """Process messages by time; return the vehicles `_REORDER_S` before the newest."""
        for sensor, pose, road_m, content in messages:
            for frame in unpack_detections(content)[1]:
                rows = frame.as_rows()
                self._newest = max(self._newest, frame.time_us / 1e6)
                present = rows_of(rows, rows.present)
                self._filter.take(map_detections(present, pose, sensor, self._graph, road_m=road_m))
        self._filter.advance(min(self._newest, time.time()) - _REORDER_S)
        found = VehiclesAnswer(self._filter.now(), self._filter.late)
        self._filter.late = 0
        return found


_following: VehicleFollower | None = None  # the follower of this process


def _start(graph: LaneGraph) -> None:
    global _following  # noqa: PLW0603 - an initializer has no other way
    watch_parent()
    _following = VehicleFollower(graph)


def _advance(messages: Sequence[PlacedMessage]) -> VehiclesAnswer:
    assert _following is not None  # noqa: S101 - set when the process starts
    return _following.advance(messages)


def run_vehicles_once() -> None:
    """Follow a few seconds of the sample, so that numba compiles before frames come."""
    sample = sample_folder()
    roads, pose = read_map(sample / "junction.osm"), read_pose(sample / "R1.json")
    selector = DetectionSelector(SightTiles.of(make_tiles(roads)))
    following = VehicleFollower(lane_graph(roads.lanelets))
    for frame in islice(frames_of_recording(sample / "R1.parquet"), _SAMPLE_FRAMES):
        found = selector.find(frame, pose, road_m=np.nan)
        content = pack_detections([found], pose=bytes(POSE_BYTES))
        following.advance([PlacedMessage(0, pose, np.nan, content)])


class LiveVehicles:
    """Vehicles of now of a live site.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    sensors : sequence of str
        Names of the site's sensors.
    again_s : float
        Time until a process that ended is started again, seconds.
    reporter : Reporter
        Receives a line where the process ends.

    Attributes
    ----------
    dropped : int
        Number of messages dropped as the process was too busy, or ended.
    late : int
        Number of frames that came too late to be followed.
    """

    def __init__(
        self, graph: LaneGraph, sensors: Sequence[str], *, again_s: float = _RESTART_S,
        reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.dropped = self.late = self.restarts = 0
        self._graph, self._reporter = graph, reporter
        self._again_s = again_s
        self._number = {name: k for k, name in enumerate(sorted(sensors))}
        self._waiting: list[PlacedMessage] = []
        self._pool: WorkerPool | None = None
        self._work: Future[VehiclesAnswer] | None = None
        self._submitted = 0  # number of messages that the process has now
        self._now, self._answered_s, self._start_at = VehiclesNow.none(), 0.0, 0.0

    def make_ready(self) -> Future[None]:
        """Start the process; the future is done once its loops are compiled."""
        context = multiprocessing.get_context("spawn")
        self._pool = WorkerPool(1, context=context, initializer=_start, given=(self._graph,))
        return self._pool.submit(run_vehicles_once)

    def take(self, sensor: str, content: bytes, pose: Pose, road_m: float) -> None:
        """Add the content of a message, its pose, and the height of the road near the sensor."""
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append(PlacedMessage(self._number[sensor], pose, road_m, content))
        else:
            self.dropped += 1

    def poll(self) -> None:
        """Submit waiting messages, and receive the process's answer; called often."""
        now = time.monotonic()
        if self._work is not None:
            if not self._work.done():
                return
            work, self._work = self._work, None
            try:
                self._now, late = work.result()
                self.late += late
                self._answered_s, self._submitted = now, 0
            except Exception as error:  # noqa: BLE001 - whatever it is, a new process begins anew
                self._restart_later(error)
        if self._pool is None and now >= self._start_at and self._start_at > 0.0:
            self.make_ready()
        if self._pool is not None and self._waiting and now - self._answered_s >= _NOW_S:
            messages, self._waiting = self._waiting, []
            self._submitted = len(messages)
            try:
                self._work = self._pool.submit(_advance, messages)
            except Exception as error:  # noqa: BLE001 - as above
                self._restart_later(error)

    def _restart_later(self, error: Exception) -> None:
        """Stop the process after an error, and plan to start another one."""
        self.restarts += 1
        self.dropped += self._submitted + len(self._waiting)
        self._submitted = 0
        reason = error.message if isinstance(error, GisRadarError) else type(error).__name__
        self._reporter.warn(
            "the process that follows the vehicles of now has ended ({}); a new one begins anew",
            reason,
        )
        self.close()
        self._start_at = time.monotonic() + self._again_s

    def close(self) -> None:
        """Stop the process."""
        if self._pool is not None:
            self._pool.stop()
        self._pool, self._work, self._waiting = None, None, []
        self._now = VehiclesNow.none()

    def now(self) -> VehiclesNow:
        """Return the vehicles of now; none if the last answer is older than `_LONGEST_SHOWN_S`."""
        is_recent = time.monotonic() - self._answered_s < _LONGEST_SHOWN_S
        return self._now if is_recent else VehiclesNow.none()

    def figures(self) -> dict[str, float]:
        """Return counts, by name, for Prometheus."""
        return {
            "vehicles_now": float(len(self.now())),
            "vehicles_dropped_messages": float(self.dropped),
            "vehicles_late_frames": float(self.late),
            "vehicles_process_restarts": float(self.restarts),
        }
