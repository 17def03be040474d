"""Process that follows the vehicles of now; fusion never waits for it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.base import (
    QUIET,
    GisRadarError,
    InputError,
    Reporter,
    stop_pool,
    watch_parent,
)
from gis_radar.hdmap import LaneGraph, lane_graph
from gis_radar.live.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.first_run import SampleSensor
from gis_radar.live.now_filter import NowFilter, VehiclesNow
from gis_radar.live.payload import POSE_BYTES
from gis_radar.measures import rows_of
from gis_radar.poses import Pose
from gis_radar.tracking import map_detections

NOW_S, REORDER_S = 0.5, 0.3  # period of the results; how long frames wait for other sensors
OLD_S = 5.0  # older results are not shown
MOST_WAITING = 20_000  # most messages that wait for the process: 10 s of a hundred sensors
AGAIN_S = 30.0  # time until a process that ended is started again
SAMPLE_FRAMES = 100  # frames of the sample that are followed: in 5 s vehicles are found

Placed = tuple[int, Pose, float]
"""Number of a sensor, its pose, and the height of the road near it (m; NaN where not known)."""
PoseName = tuple[str, bytes]
"""Name of a sensor, and the key of its pose."""
Message = tuple[str, bytes]
"""Name of a sensor, and the content of what it sent."""


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
    unread, late : int
        Numbers of messages that were damaged or of no known pose, and of frames that were too old.
    """

    now: VehiclesNow
    unread: int
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
        self._placed: dict[PoseName, Placed] = {}
        self._unread = 0

    def go_on(
        self, placed: Mapping[PoseName, Placed], gone: Collection[PoseName],
        rows: Sequence[Message],
    ) -> VehiclesAnswer:  # fmt: skip
        """Process new poses and messages; return the vehicles `REORDER_S` before the newest.

        Parameters
        ----------
        placed : mapping
            Number, pose and road height (m) of a sensor, by its name and the key of the pose.
        gone : collection
            Poses to which no message refers any more.
        rows : sequence of Message
            In order of time.
        """
        self._placed |= placed
        for name in gone:
            self._placed.pop(name, None)
        for sensor, content in rows:
            try:
                self._take(sensor, content)
            except InputError:
                self._unread += 1
        self._filter.go_on(min(self._newest, time.time()) - REORDER_S)
        found = VehiclesAnswer(self._filter.now(), self._unread, self._filter.late)
        self._unread = self._filter.late = 0
        return found

    def _take(self, sensor: str, content: bytes) -> None:
        known = self._placed.get((sensor, content[:POSE_BYTES]))
        if known is None:
            self._unread += 1
            return
        number, pose, road_m = known
        for frame in unpack_detections(content)[1]:
            rows = frame.as_rows()
            self._newest = max(self._newest, frame.time_us / 1e6)
            self._filter.take(
                map_detections(
                    rows_of(rows, rows.present), pose, number, self._graph, road_m=road_m
                )
            )


_following: VehicleFollower | None = None  # the follower of this process


def _start(graph: LaneGraph | None) -> None:
    global _following  # noqa: PLW0603 - what all calls have in common
    watch_parent()
    _following = None if graph is None else VehicleFollower(graph)


def _go_on(
    placed: Mapping[PoseName, Placed], gone: Collection[PoseName], rows: Sequence[Message]
) -> VehiclesAnswer:
    assert _following is not None  # noqa: S101 - set when the process starts
    return _following.go_on(placed, gone, rows)


def run_vehicles_once() -> None:
    """Follow a few seconds of the sample, so that all loops are compiled."""
    sample = SampleSensor()
    selector, key = DetectionSelector(sample.road), bytes(POSE_BYTES)
    following = VehicleFollower(lane_graph(sample.roads.lanelets))
    for frame in sample.frames(SAMPLE_FRAMES):
        found = selector.find(frame, sample.pose, road_m=np.nan)
        message = (sample.pose.sensor, pack_detections([found], pose=key))
        following.go_on({(sample.pose.sensor, key): (0, sample.pose, np.nan)}, (), [message])


class LiveVehicles:
    """Vehicles of now of a live site.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    sensors : sequence of str
        Names of the site's sensors.
    crs : CRS
        The map frame.
    again_s : float
        Time until a process that ended is started again, seconds.
    reporter : Reporter
        Receives a line where the process ends.

    Attributes
    ----------
    dropped : int
        Number of messages dropped as the process was too busy, could not read them, or ended.
    late : int
        Number of frames that came too late to be followed.
    """

    def __init__(
        self, graph: LaneGraph, sensors: Sequence[str], crs: Any, *, again_s: float = AGAIN_S,
        reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.dropped = self.late = self.restarts = 0
        self._graph, self._crs, self._reporter = graph, crs, reporter
        self._again_s = again_s
        self._number = {name: k for k, name in enumerate(sorted(sensors))}
        self._placed: dict[PoseName, Placed] = {}
        self._fresh: dict[PoseName, Placed] = {}
        self._gone: set[PoseName] = set()
        self._waiting: list[Message] = []
        self._pool: ProcessPoolExecutor | None = None
        self._work: Future[VehiclesAnswer] | None = None
        self._handed = 0  # number of messages that the process has now
        self._now, self._told, self._start_at = VehiclesNow.none(), 0.0, 0.0

    def make_ready(self) -> Future[None]:
        """Start the process; the future is done once its loops are compiled."""
        self._fresh, self._gone = dict(self._placed), set()
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(
            1, mp_context=context, initializer=_start, initargs=(self._graph,)
        )
        return self._pool.submit(run_vehicles_once)

    def place(self, sensor: str, key: bytes, pose: Pose, road_m: float) -> None:
        """Add a pose to which messages refer."""
        self._placed[sensor, key] = self._fresh[sensor, key] = (self._number[sensor], pose, road_m)
        self._gone.discard((sensor, key))

    def forget(self, sensor: str, key: bytes) -> None:
        """Forget a pose to which no message refers any more."""
        self._placed.pop((sensor, key), None)
        self._gone.add((sensor, key))

    def take(self, sensor: str, content: bytes) -> None:
        """Add the content of a message."""
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append((sensor, content))
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
                self._now, unread, late = work.result()
                self.dropped, self.late = self.dropped + unread, self.late + late
                self._told, self._handed = now, 0
            except Exception as error:  # noqa: BLE001 - whatever it is, a new process begins anew
                self._lose(error)
        if self._pool is None and now >= self._start_at and self._start_at > 0.0:
            self.make_ready()
        if self._pool is not None and self._waiting and now - self._told >= NOW_S:
            rows, self._waiting = self._waiting, []
            self._handed = len(rows)
            fresh, gone = self._fresh, self._gone
            self._fresh, self._gone = {}, set()
            try:
                self._work = self._pool.submit(_go_on, fresh, gone, rows)
            except Exception as error:  # noqa: BLE001 - as above
                self._lose(error)

    def _lose(self, error: Exception) -> None:
        """Continue without the process for a while."""
        self.restarts += 1
        self.dropped += self._handed + len(self._waiting)
        self._handed = 0
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
            stop_pool(self._pool)
        self._pool, self._work, self._waiting = None, None, []
        self._now = VehiclesNow.none()

    def now(self) -> VehiclesNow:
        """Return the vehicles of now; none where the last answer is older than `OLD_S`."""
        return self._now if time.monotonic() - self._told < OLD_S else VehiclesNow.none()

    def figures(self) -> dict[str, float]:
        """Return counts, by name, for Prometheus."""
        return {
            "vehicles_now": float(len(self.now())),
            "vehicles_dropped_messages": float(self.dropped),
            "vehicles_late_frames": float(self.late),
            "vehicles_process_restarts": float(self.restarts),
        }

    def layer(self) -> gpd.GeoDataFrame:
        """Return the vehicles of now as points in the map."""
        return layer_of(self.now(), self._crs)
