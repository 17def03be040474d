"""The vehicles of now: followed by a process of its own, for which fusion never waits.

The tracker's filter takes what moves; who stands longer than it remembers stays shown where it
stood, until somebody drives there, or for three minutes.
"""

from __future__ import annotations

import multiprocessing
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.base import (
    QUIET,
    Floats,
    GisRadarError,
    InputError,
    Reporter,
    stop_pool,
    watch_parent,
)
from gis_radar.hdmap import LaneGraph, lane_graph
from gis_radar.live.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.first_run import SampleSensor
from gis_radar.live.payload import POSE_BYTES
from gis_radar.measures import rows_of
from gis_radar.poses import Pose
from gis_radar.tracking import (
    VEHICLE_DEFAULTS,
    ForwardFilter,
    MapDetections,
    VehicleSettings,
    are_persons,
    columns,
    map_detections,
    usual_rcs,
)

HEAVY_M = 7.0  # the contract: who is longer counts as heavy
LENGTHS_M, HEAVY_WIDTH_M, WIDTH_M = (4.6, 18.75), 2.5, 1.85
SURE_HITS = 6  # detections of a vehicle: with fewer the filter follows it for a moment only
HELD_S = 180.0  # one that stood when the filter lost it is shown for so long
GONE_MPS = 0.7  # who was faster when it was lost has left
SAME_M = 2.5  # what is nearer to where one stood is the same
RCS_KEPT, JUDGED = 40, 400  # cross sections of a vehicle, and vehicles by which walkers are told
NOW_S, REORDER_S = 0.5, 0.3  # how often they are told; how long frames wait for other sensors
OLD_S = 5.0  # vehicles of now that are older are none
MOST_WAITING = 20_000  # messages, while the process is busy: 10 s of a hundred sensors
AGAIN_S = 30.0  # after which a process that ended is started anew
SAMPLE_FRAMES = 100  # 5 s: with so many, vehicles are found

Placed = tuple[int, Pose, float]
"""Number of a sensor, its pose, and the height of the road near it (m; NaN where not known)."""
PoseName = tuple[str, bytes]
"""Name of a sensor, and the key of its pose."""
Message = tuple[str, bytes]
"""Name of a sensor, and the content of what it sent."""


@dataclass(frozen=True, kw_only=True)
class VehiclesNow:
    """Vehicles of a moment.

    Parameters
    ----------
    time : float
        UNIX seconds.
    vehicle : (n,) int64 array
        Numbers that mean nothing elsewhere.
    place : (n, 2) array
        Easting and northing of the middle.
    heading, speed, length_m, width_m : (n,) arrays
        Degrees as a yaw, m/s, metres.
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
        """Which are longer than 7 m."""
        return np.asarray(self.length_m > HEAVY_M)

    @classmethod
    def of(cls, time: float, rows: Floats) -> VehiclesNow:
        """Return those of rows (number, easting, northing, heading, speed, length)."""
        length = np.clip(rows[:, 5], *LENGTHS_M)
        return cls(
            time=time, vehicle=rows[:, 0].astype(np.int64), place=rows[:, 1:3],
            heading=np.degrees(np.angle(np.exp(1j * rows[:, 3]))), speed=rows[:, 4],
            length_m=length, width_m=np.where(length > HEAVY_M, HEAVY_WIDTH_M, WIDTH_M),
        )  # fmt: skip

    @classmethod
    def none(cls) -> VehiclesNow:
        """Return no vehicles."""
        return cls.of(float("nan"), np.zeros((0, 6)))


@dataclass(kw_only=True)
class _Known:
    """What was learned of a vehicle that the filter follows."""

    rcs: deque[float]
    fast: float = 0.0


@dataclass(kw_only=True)
class NowFilter:
    """Follows vehicles as detections come; nothing later corrects what it says.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    tracker : VehicleSettings
        Those of the tracker.

    Attributes
    ----------
    late : int
        Frames of which detections were too old to be followed.
    """

    graph: LaneGraph
    tracker: VehicleSettings
    late: int = 0
    _waiting: list[MapDetections] = field(default_factory=list)
    _known: dict[int, _Known] = field(default_factory=dict)
    _stood: dict[int, Floats] = field(default_factory=dict)  # by number, the row and when it was
    _shown: dict[int, Floats] = field(default_factory=dict)
    _same: dict[int, int] = field(default_factory=dict)
    _reached: float = -np.inf
    _still: float = np.nan

    def __post_init__(self) -> None:
        moving = self.tracker.detections.moving_mps
        self._filter = ForwardFilter(self.graph, self.tracker.forward, moving_mps=moving)

    def take(self, detections: MapDetections) -> None:
        """Take the detections of a frame, unless it is older than the last published moment."""
        fresh = detections.take(detections.time > self._reached)
        self.late += len(fresh) < len(detections)
        self._waiting.append(fresh)

    def go_on(self, until: float) -> None:
        """Follow what came up to a time."""
        waiting = MapDetections.join(self._waiting)
        ready = waiting.time <= until
        self._waiting = [waiting.take(~ready)]
        if until > self._reached + self.tracker.forward.stand_s:  # nothing came for long
            self._stood, self._shown = {}, {}
        self._reached = max(self._reached, until)
        detections = waiting.take(ready)
        if len(detections):
            number, states = self._filter.push(detections)
            self._learn(detections, number, states)
        self._show()

    def _learn(self, detections: MapDetections, number: np.ndarray, states: Floats) -> None:
        """Note cross sections and speeds, by which walkers are told."""
        still = np.abs(detections.range_rate) < self.tracker.detections.moving_mps
        known = usual_rcs(detections.rcs[still])
        self._still = known if np.isnan(self._still) else self._still
        if not np.isnan(known):
            self._still += 0.05 * (known - self._still)
        for each in np.unique(number[number >= 0]).tolist():
            rows = number == each
            found = self._known.pop(each, None) or _Known(rcs=deque(maxlen=RCS_KEPT))
            found.rcs.extend(detections.rcs[rows].tolist())
            found.fast = max(found.fast, float(states[rows, columns.SPEED].max()))
            self._known[each] = found  # the latest last
        while len(self._known) > JUDGED:
            del self._known[next(iter(self._known))]

    def _persons(self) -> set[int]:
        numbers = [*self._known]
        rcs = np.array([usual_rcs(np.array(each.rcs)) for each in self._known.values()])
        fast = np.array([each.fast for each in self._known.values()])
        person = are_persons(
            rcs, fast, np.full(len(rcs), np.nan), np.ones(len(rcs), np.bool_), self._still,
            self.tracker.bodies,
        )  # fmt: skip
        return {numbers[k] for k in np.flatnonzero(person).tolist()}

    def _show(self) -> None:
        """Take in the bodies of the filter, and whom it has lost since."""
        bodies = self._filter.bodies
        late = bodies[:, columns.LAST] <= self._reached - 60
        sure = (bodies[:, columns.HITS] >= SURE_HITS) & ~late
        persons = self._persons() if len(bodies) else set()
        alive: dict[int, Floats] = {}
        for body in bodies[sure]:
            if (number := int(body[columns.NUMBER])) not in persons:
                front, rear, heading = body[[columns.FRONT, columns.REAR, columns.HEADING]]
                way = np.array([np.cos(heading), np.sin(heading)])
                centre = body[[columns.X, columns.Y]] + 0.5 * (front - rear) * way
                alive[number] = np.array([*centre, heading, body[columns.SPEED], front + rear])
        places = np.array([each[:2] for each in alive.values()]).reshape(-1, 2)
        for number, row in self._shown.items():
            if number not in alive and row[3] < GONE_MPS:
                self._stood[number] = np.array([*row, self._reached])
        for number in [*self._stood]:
            near = self._near(self._stood[number][:2], places)
            if near is not None:  # it drives on, or another one is there
                new = [*alive][near]
                self._same.setdefault(new, self._same.get(number, number))
            late = self._reached - self._stood[number][5] > HELD_S
            if near is not None or late:
                del self._stood[number]
        self._same = {k: v for k, v in self._same.items() if k in alive or k in self._stood}
        self._shown = alive

    def _near(self, place: Floats, places: Floats) -> int | None:
        apart = np.hypot(*(places - place).T) if len(places) else np.zeros(0)
        nearest = int(apart.argmin()) if len(apart) else -1
        return nearest if len(apart) and apart[nearest] < SAME_M else None

    def now(self) -> VehiclesNow:
        """Return the vehicles of the last moment."""
        both = {**{k: row[:5] for k, row in self._stood.items()}, **self._shown}
        rows, used = [], {*both}
        for number, row in both.items():
            earlier = self._same.get(number, number)
            shown = number if earlier in used else earlier
            used.add(shown)
            rows.append((shown, *row))
        table = np.array(rows, np.float64).reshape(-1, 6)
        table[:, 1:3] += self.graph.origin
        return VehiclesNow.of(self._reached, table)


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
    """What the process returns for a batch of messages.

    Parameters
    ----------
    now : VehiclesNow
        The vehicles.
    unread, late : int
        Messages that are damaged or of no known pose, and frames that were too old, of this turn.
    """

    now: VehiclesNow
    unread: int
    late: int


class VehicleFollower:
    """Follows the vehicles of now from messages of sensors, in a process of its own.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    """

    def __init__(self, graph: LaneGraph) -> None:
        self._filter = NowFilter(graph=graph, tracker=VEHICLE_DEFAULTS)
        self._graph, self._newest = graph, -np.inf
        self._placed: dict[PoseName, Placed] = {}
        self._unread = 0

    def go_on(
        self, placed: Mapping[PoseName, Placed], gone: Collection[PoseName],
        rows: Sequence[Message],
    ) -> VehiclesAnswer:  # fmt: skip
        """Take new poses and messages; return the vehicles up to a moment before the newest.

        Parameters
        ----------
        placed : mapping
            Number, pose and road height (m) of a sensor, by its name and the key of the pose.
        gone : collection
            Poses that no message is found by any more.
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
                    rows_of(rows, rows.present), pose, number, self._graph,
                    VEHICLE_DEFAULTS.detections, road_m=road_m,
                )
            )  # fmt: skip


_following: VehicleFollower | None = None  # of the process


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
    """Follow a few seconds of the sample, by which all is compiled."""
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
        The site's.
    crs : CRS
        The map frame.
    reporter : Reporter
        Receives a line where the process ends.

    Attributes
    ----------
    dropped : int
        Messages that the process was too busy for or could not read, or that ended with it.
    late : int
        Frames that came too late to be followed.
    """

    def __init__(
        self, graph: LaneGraph, sensors: Sequence[str], crs: Any, *, reporter: Reporter = QUIET
    ) -> None:
        self.dropped = self.late = self.restarts = 0
        self._graph, self._crs, self._reporter = graph, crs, reporter
        self._number = {name: k for k, name in enumerate(sorted(sensors))}
        self._placed: dict[PoseName, Placed] = {}
        self._fresh: dict[PoseName, Placed] = {}
        self._gone: set[PoseName] = set()
        self._waiting: list[Message] = []
        self._pool: ProcessPoolExecutor | None = None
        self._work: Future[VehiclesAnswer] | None = None
        self._handed = 0  # messages that the process has at the moment
        self._now, self._told, self._start_at = VehiclesNow.none(), 0.0, 0.0

    def make_ready(self) -> Future[None]:
        """Start the process; what it runs is compiled there first, which the answer waits for."""
        self._fresh, self._gone = dict(self._placed), set()
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(
            1, mp_context=context, initializer=_start, initargs=(self._graph,)
        )
        return self._pool.submit(run_vehicles_once)

    def place(self, sensor: str, key: bytes, pose: Pose, road_m: float) -> None:
        """Take in a pose that messages name."""
        self._placed[sensor, key] = self._fresh[sensor, key] = (self._number[sensor], pose, road_m)
        self._gone.discard((sensor, key))

    def forget(self, sensor: str, key: bytes) -> None:
        """Forget a pose that no message names any more."""
        self._placed.pop((sensor, key), None)
        self._gone.add((sensor, key))

    def take(self, sensor: str, content: bytes) -> None:
        """Take the content of a message."""
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append((sensor, content))
        else:
            self.dropped += 1

    def turn(self) -> None:
        """Hand on what came, and take in what was found; called often."""
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
        """Go on without the process for a while."""
        self.restarts += 1
        self.dropped += self._handed + len(self._waiting)
        self._handed = 0
        reason = error.message if isinstance(error, GisRadarError) else type(error).__name__
        self._reporter.warn(
            "the process that follows the vehicles of now has ended ({}); a new one begins anew",
            reason,
        )
        self.close()
        self._start_at = time.monotonic() + AGAIN_S

    def close(self) -> None:
        """Stop the process."""
        if self._pool is not None:
            stop_pool(self._pool)
        self._pool, self._work, self._waiting = None, None, []
        self._now = VehiclesNow.none()

    def now(self) -> VehiclesNow:
        """Return the vehicles of now; none where nothing came for long."""
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
