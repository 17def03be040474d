"""Follow the vehicles of now, in a process for which fusion never waits.

The tracker's forward filter follows moving vehicles; no later data correct what was shown. A
vehicle that stands for so long that the filter loses it is still shown at its place, until a
vehicle drives there, at most three minutes.
"""

from __future__ import annotations

import multiprocessing
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.base import QUIET, Floats, GisRadarError, Reporter, WorkerPool, watch_parent
from gis_radar.hdmap import LaneGraph, lane_graph, make_tiles, read_map
from gis_radar.live.wire.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.wire.payload import POSE_BYTES
from gis_radar.live.wire.sources import frames_of_recording
from gis_radar.measures import rows_of
from gis_radar.poses import Pose, read_pose
from gis_radar.sample import sample_folder
from gis_radar.scans import SightTiles
from gis_radar.tracking import (
    MOVING_MPS,
    STAND_S,
    ForwardFilter,
    MapDetections,
    are_persons,
    columns,
    map_detections,
    usual_rcs,
)

HEAVY_M = 7.0  # longer vehicles count as heavy (contract)
_LENGTHS_M, _HEAVY_WIDTH_M, _WIDTH_M = (4.6, 18.75), 2.5, 1.85
_SURE_HITS = 6  # least detections of a shown vehicle
_FOLLOWED_S = 60.0  # longest time after its last detection that a vehicle is shown as followed
STANDING_S = 180.0  # time that a vehicle which stood when the filter lost it is still shown
_LEAVING_MPS = 0.7  # a vehicle that was faster when it was lost has left
_SAME_M = 2.5  # a vehicle found nearer than this to the place of a standing one is the same
# Cross sections kept of a vehicle, and vehicles kept to distinguish walkers from.
_RCS_KEPT, _VEHICLES_KEPT = 40, 400


@dataclass(frozen=True, kw_only=True)
class VehiclesNow:
    """Vehicles of a moment.

    Parameters
    ----------
    time : float
        UNIX seconds.
    vehicle : (n,) int64 array
        Numbers of the vehicles, which no table shares.
    place : (n, 2) array
        Easting and northing of the middle, metres.
    heading, speed, length_m, width_m : (n,) arrays
        Yaw in degrees, m/s, metres.
    """

    time: float
    vehicle: np.ndarray
    place: Floats
    heading: Floats
    speed: Floats
    length_m: Floats
    width_m: Floats

    def __len__(self) -> int:
        return len(self.vehicle)

    @property
    def heavy(self) -> np.ndarray:
        """Whether each vehicle is heavy: longer than 7 m."""
        return np.asarray(self.length_m > HEAVY_M)

    @classmethod
    def of(cls, time: float, rows: Floats) -> VehiclesNow:
        """Return the vehicles of rows (number, easting, northing, heading, speed, length)."""
        length = np.clip(rows[:, 5], *_LENGTHS_M)
        return cls(
            time=time, vehicle=rows[:, 0].astype(np.int64), place=rows[:, 1:3],
            heading=np.degrees(np.angle(np.exp(1j * rows[:, 3]))), speed=rows[:, 4],
            length_m=length, width_m=np.where(length > HEAVY_M, _HEAVY_WIDTH_M, _WIDTH_M),
        )  # fmt: skip

    @classmethod
    def none(cls) -> VehiclesNow:
        """Return no vehicles."""
        return cls.of(float("nan"), np.zeros((0, 6)))


@dataclass(kw_only=True)
class _Learned:
    """Cross sections and speeds learned of a vehicle that the filter follows."""

    rcs: deque[float]
    max_speed: float = 0.0


@dataclass(kw_only=True)
class NowFilter:
    """Filter that follows vehicles as detections come; no later data correct its result.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.

    Attributes
    ----------
    late : int
        Number of frames whose detections came too late.
    """

    graph: LaneGraph
    late: int = 0
    _waiting: list[MapDetections] = field(default_factory=list)
    _known: dict[int, _Learned] = field(default_factory=dict)
    # Vehicles that the filter lost while they stood, by number: row of `_shown`, and time.
    _standing: dict[int, Floats] = field(default_factory=dict)
    # Vehicles of the filter by number: easting, northing, heading, speed, length.
    _shown: dict[int, Floats] = field(default_factory=dict)
    _shown_as: dict[int, int] = field(default_factory=dict)
    _reached: float = -np.inf
    _still_rcs: float = np.nan

    def __post_init__(self) -> None:
        self._filter = ForwardFilter(self.graph)

    def take(self, detections: MapDetections) -> None:
        """Add the detections of a frame, unless it is older than the last published time."""
        fresh = detections.take(detections.time > self._reached)
        self.late += len(fresh) < len(detections)
        self._waiting.append(fresh)

    def advance(self, until: float) -> None:
        """Filter the detections up to a time (UNIX seconds)."""
        waiting = MapDetections.join(self._waiting)
        ready = waiting.time <= until
        self._waiting = [waiting.take(~ready)]
        if until > self._reached + STAND_S:  # no detections for long
            self._standing, self._shown = {}, {}
        self._reached = max(self._reached, until)
        detections = waiting.take(ready)
        if len(detections):
            number, states = self._filter.push(detections)
            self._learn(detections, number, states)
        self._show()

    def _learn(self, detections: MapDetections, number: np.ndarray, states: Floats) -> None:
        """Record cross sections and speeds, by which persons are distinguished from vehicles."""
        still = np.abs(detections.range_rate) < MOVING_MPS
        known = usual_rcs(detections.rcs[still])
        self._still_rcs = known if np.isnan(self._still_rcs) else self._still_rcs
        if not np.isnan(known):
            self._still_rcs += 0.05 * (known - self._still_rcs)
        for each in np.unique(number[number >= 0]).tolist():
            rows = number == each
            found = self._known.pop(each, None) or _Learned(rcs=deque(maxlen=_RCS_KEPT))
            found.rcs.extend(detections.rcs[rows].tolist())
            found.max_speed = max(found.max_speed, float(states[rows, columns.SPEED].max()))
            self._known[each] = found  # the latest is last
        while len(self._known) > _VEHICLES_KEPT:
            del self._known[next(iter(self._known))]

    def _persons(self) -> set[int]:
        """Return the numbers of bodies that are persons, by cross sections and greatest speeds."""
        numbers = [*self._known]
        rcs = np.array([usual_rcs(np.array(each.rcs)) for each in self._known.values()])
        max_speed = np.array([each.max_speed for each in self._known.values()])
        person = are_persons(
            rcs, max_speed, np.full(len(rcs), np.nan), np.ones(len(rcs), np.bool_), self._still_rcs,
        )  # fmt: skip
        return {numbers[k] for k in np.flatnonzero(person).tolist()}

    def _show(self) -> None:
        """Update the shown vehicles by the filter's bodies, and hold those that it has lost."""
        bodies = self._filter.bodies
        recent = bodies[:, columns.LAST_TIME] > self._reached - _FOLLOWED_S
        sure = (bodies[:, columns.DETECTION_COUNT] >= _SURE_HITS) & recent
        persons = self._persons() if len(bodies) else set()
        alive: dict[int, Floats] = {}
        for body in bodies[sure]:
            if (number := int(body[columns.NUMBER])) not in persons:
                front, rear, heading = body[[columns.FRONT, columns.REAR, columns.HEADING]]
                direction = np.array([np.cos(heading), np.sin(heading)])
                centre = body[[columns.X, columns.Y]] + 0.5 * (front - rear) * direction
                alive[number] = np.array([*centre, heading, body[columns.SPEED], front + rear])
        places = np.array([each[:2] for each in alive.values()]).reshape(-1, 2)
        for number, row in self._shown.items():
            if number not in alive and row[3] < _LEAVING_MPS:
                self._standing[number] = np.array([*row, self._reached])
        for number in [*self._standing]:
            near = self._near(self._standing[number][:2], places)
            if near is not None:  # the vehicle drives on, or another one is at its place
                new = [*alive][near]
                self._shown_as.setdefault(new, self._shown_as.get(number, number))
            is_over = self._reached - self._standing[number][5] > STANDING_S
            if near is not None or is_over:
                del self._standing[number]
        self._shown_as = {
            k: v for k, v in self._shown_as.items() if k in alive or k in self._standing
        }
        self._shown = alive

    def _near(self, place: Floats, places: Floats) -> int | None:
        distance_m = np.hypot(*(places - place).T) if len(places) else np.zeros(0)
        nearest = int(distance_m.argmin()) if len(distance_m) else -1
        return nearest if len(distance_m) and distance_m[nearest] < _SAME_M else None

    def now(self) -> VehiclesNow:
        """Return the vehicles of the last moment."""
        rows_by_number = {**{k: row[:5] for k, row in self._standing.items()}, **self._shown}
        rows, used = [], {*rows_by_number}
        for number, row in rows_by_number.items():
            earlier = self._shown_as.get(number, number)
            shown = number if earlier in used else earlier
            used.add(shown)
            rows.append((shown, *row))
        table = np.array(rows, np.float64).reshape(-1, 6)
        table[:, 1:3] += self.graph.origin
        return VehiclesNow.of(self._reached, table)


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
