"""The intake of fusion: what sensors send is checked, counted, and put in journal and windows."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, field
from itertools import chain, cycle
from typing import TYPE_CHECKING

import numpy as np

from gis_radar.arrays import Booleans
from gis_radar.crs import require_same
from gis_radar.errors import InputError, OutputError, placed
from gis_radar.live.broker import FUSION, Received, SensorTopics, parts_of
from gis_radar.live.health import SensorHealth
from gis_radar.live.hits_folder.tile_sets import unpack_tiles
from gis_radar.live.hours import HOUR_STEPS, HOUR_US
from gis_radar.live.journal import FrameRow, Journal, PoseRow
from gis_radar.live.map_of_now import MapOfNow
from gis_radar.live.old_poses import PosesOfSensor, drop_old_poses
from gis_radar.live.outbox import ONLINE
from gis_radar.live.payload import (
    DETECTIONS,
    FINGERPRINT_BYTES,
    KINDS,
    POSE,
    STREAM_BYTES,
    VERSION,
    Envelope,
    PoseContent,
    VersionError,
    read_record,
    unpack_hits,
    unpack_message,
)
from gis_radar.live.settings import DEFAULTS, LiveSettings
from gis_radar.live.store import KnownPose
from gis_radar.live.windows import Seen, Windows
from gis_radar.measures.hit_counter import CountedFrame
from gis_radar.measures.views import SharedViews, ViewBook
from gis_radar.poses.pose import Pose, pose_from_dict
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEP_US

if TYPE_CHECKING:
    from gis_radar.live.vehicles.in_fusion import LiveVehicles

ACK_S = 1.0  # between two acknowledgements of nothing new
TWINS_WITHIN_S = 60.0  # two streams of one sensor that take turns
MOST_LOST = 2**63  # of messages, as of their numbers
STREAM = re.compile(f"[0-9a-f]{{{2 * STREAM_BYTES}}}")


@dataclass(kw_only=True)
class SensorState:
    """What fusion knows of a sensor.

    Parameters
    ----------
    health : SensorHealth
        Its counts and alarms.
    topics : SensorTopics
        Its own.
    stream : str
        Which is received, in hexadecimal digits.
    received, stored : int
        The number up to which all is received, and on disk.
    poses : dict
        By stream and number, the id of the row in the journal.
    standing : SharedViews
        Which of its poses share a view.
    pose : Pose, optional
        The newest.
    """

    health: SensorHealth
    topics: SensorTopics
    stream: str = ""
    received: int = 0
    stored: int = 0
    resend: int = 0
    refused: str = ""
    due: bool = False
    asked_s: float = -1e9
    missed_s: float = -1e9
    other: tuple[str, float] = ("", -1e9)
    poses: dict[tuple[str, int], int] = field(default_factory=dict)
    standing: SharedViews = field(default_factory=SharedViews)
    pose: Pose | None = None


class Intake:
    """Takes what the sensors of a site send.

    Parameters
    ----------
    names : iterable of str
        The sensors.
    site : str
        The site's name in topics.
    book : ViewBook
        All tiles, and the views met so far.
    journal : Journal
        Where frames go.
    windows : Windows
        Where they go, too, for the map of now.
    current : MapOfNow
        The map, which is told what views see.
    settings : LiveSettings
        Of the alarms.
    reporter : Reporter
        Receives a line when something begins to be wrong.

    Attributes
    ----------
    sensors : dict
        By name.
    poses : dict
        By the id of their rows in the journal.
    touched : dict
        By hour, when a frame of it came last (monotonic seconds).
    unknown : set of str
        Sensors that send and are not of the site.
    vehicles : LiveVehicles, optional
        Takes what vehicles are followed by.
    """

    vehicles: LiveVehicles | None = None

    def __init__(
        self,
        names: Iterable[str],
        *,
        site: str,
        book: ViewBook,
        journal: Journal,
        windows: Windows,
        current: MapOfNow,
        settings: LiveSettings = DEFAULTS,
        reporter: Reporter = QUIET,
    ) -> None:
        self.poses: dict[int, KnownPose] = {}
        self.unknown: set[str] = set()
        self._unwritten = ""
        self.touched: dict[int, float] = dict.fromkeys(journal.hours(), -1e9)
        self._site, self._book, self._journal = site, book, journal
        self._windows, self._map = windows, current
        self._settings, self._reporter = settings, reporter
        with placed(str(journal.path)):
            self.sensors = {name: self._sensor(name) for name in names}
        self._turns = cycle(self.sensors)
        for name in journal.sensors():
            if name not in self.sensors:
                reporter.log(
                    f"{journal.path}: holds frames of {name}, which the site no longer names: they "
                    "are written once it does again",
                    "warning",
                )

    def _sensor(self, name: str) -> SensorState:
        """Return what the journal holds of a sensor."""
        health = SensorHealth(name=name, settings=self._settings, reporter=self._reporter)
        state = SensorState(health=health, topics=SensorTopics(self._site, name))
        heads: dict[int, PoseRow] = {}
        rows = self._journal.poses(name)
        by_id = {row.id: row for row in rows}
        views: dict[int, str] = {}  # of the scan of now: that of the journal may be another
        for row in rows:
            content = PoseContent.unpack(row.content)
            if row.standing not in views:
                seen = PoseContent.unpack(by_id[row.standing].content)
                views[row.standing] = self._see(seen, name)
            self.poses[row.id] = KnownPose(content=content, view=views[row.standing])
            state.poses[row.stream, row.number] = row.id
            if content.pose.get("event") == "moved":
                heads = {}
            heads.pop(row.standing, None)  # the one in force comes last
            heads[row.standing] = by_id[row.standing]
            self._map.holds_s[name] = content.validity_s
        known = [
            (number, pose_from_dict(PoseContent.unpack(row.content).pose, what=name))
            for number, row in heads.items()
        ]
        state.standing = SharedViews(self._book.settings, known)
        state.pose = known[-1][1] if known else None
        for (sensor, stream), stored in self._journal.marks().items():
            if sensor == name:
                state.stream, state.received, state.stored = stream, stored, stored
        return state

    def _see(self, content: PoseContent, sensor: str) -> str:
        """Return the name of what a pose sees, and keep it for the map."""
        view = self._book.see(pose_from_dict(content.pose, what=f"the pose of {sensor}"))
        if view not in self._map.views:
            mask: Booleans = np.isin(self._book.road.tile_id, self._book.tiles[view])
            self._map.views[view] = mask
        return view

    def resume(self, begin_us: int, now_us: int) -> Iterator[tuple[int, dict[str, Seen]]]:
        """Yield the closed steps of a time again, of an hour at most, from what the journal holds.

        So a new start after a kill goes on counting; once stopped, all is written and counts begin
        anew.
        """
        begin_us, count = max(begin_us, now_us - HOUR_US), len(self._book.road.tile_id)
        with placed(str(self._journal.path)):
            for name in self.sensors:
                for row in chain.from_iterable(self._journal.frames(name, begin_us, now_us)):
                    tiles = unpack_tiles(row.tiles, below=count, what="tiles of a frame")
                    seen = Seen(tiles, self.poses[row.pose].view)
                    self._windows.add(name, row.time_us // STEP_US, seen)
        yield from self._windows.close(now_us, most=HOUR_STEPS)

    def handle(self, message: Received) -> None:
        """Take a message: count it, store it, or say why not."""
        name, kind = parts_of(message.topic)
        sensor = self.sensors.get(name)
        if sensor is None:
            if name not in {"", FUSION, *self.unknown}:
                self.unknown.add(name)
                self._reporter.log(
                    f"{name}: no sensor of this site: what it sends is left out", "warning"
                )
            return
        sensor.health.counts["messages"] += 1
        try:
            if kind == "status":
                self._handle_status(sensor, message)
            else:
                self._handle_numbered(sensor, message)
        except VersionError as error:
            if kind == KINDS[DETECTIONS]:
                sensor.health.alarm("detections", error.message)
            else:
                self._refuse(sensor, error.message)
        except InputError as error:
            sensor.health.counts["damaged"] += 1
            sensor.health.alarm("damaged", error.message)
        except OutputError as error:  # it comes again, as it is not acknowledged
            if error.message != self._unwritten:
                self._unwritten = error.message
                hint = f" ({error.hint})" if error.hint else ""
                self._reporter.log(error.message + hint, "warning")

    def _handle_status(self, sensor: SensorState, message: Received) -> None:
        record = read_record(message.payload, what="a status", version=VERSION)
        online = record.get("state") == ONLINE
        sensor.health.alarm("offline", None if online else "the broker lost it, or it was stopped")
        lost = record.get("lost")
        if isinstance(lost, int) and 0 <= lost < MOST_LOST:
            sensor.health.lost = lost
            sensor.health.alarm("lost", f"{lost} messages" if lost > 0 else None)
        stream = record.get("stream")
        if online and isinstance(stream, str) and STREAM.fullmatch(stream):
            self._use_stream(sensor, stream)

    def _use_stream(self, sensor: SensorState, stream: str) -> None:
        if stream == sensor.stream:
            return
        now = time.monotonic()
        if sensor.other[0] == stream and now - sensor.other[1] < TWINS_WITHIN_S:
            sensor.health.alarm("twins", f"streams {sensor.stream} and {stream} take turns")
        sensor.other = (sensor.stream, now)
        sensor.stream, sensor.refused, sensor.due = stream, "", True
        sensor.received, sensor.stored = self._journal.mark(sensor.health.name, stream)

    def _handle_numbered(self, sensor: SensorState, message: Received) -> None:
        envelope, content = unpack_message(message.payload)
        if envelope.kind == DETECTIONS:
            if self.vehicles is not None:
                self.vehicles.take(
                    sensor.health, envelope.stream.hex(), content, sensor.poses, self.poses
                )
                sensor.health.alarm("detections", None)
            return
        if not (message.retained and sensor.stream):
            self._use_stream(sensor, envelope.stream.hex())
        if envelope.stream.hex() != sensor.stream:
            return  # kept by the broker from an earlier buffer
        if message.retained:
            self._take_kept(sensor, envelope, content)
            return
        if envelope.number <= sensor.received:
            sensor.health.counts["duplicates"] += 1
            self._ask(sensor)
            return
        if envelope.previous > sensor.received:
            sensor.health.counts["gaps"] += self._ask(sensor, again=True)
            return
        if envelope.kind == POSE:
            if self._take_pose(sensor, envelope, content):
                self._received(sensor, envelope, [])
        else:
            self._take_hits(sensor, envelope, content, message)

    def _ask(self, sensor: SensorState, *, again: bool = False) -> bool:
        """Acknowledge anew, at most each second: the sensor does not know what is stored."""
        now = time.monotonic()
        if now - (sensor.missed_s if again else sensor.asked_s) < ACK_S:
            return False
        sensor.asked_s, sensor.due = now, True
        sensor.missed_s = now if again else sensor.missed_s
        sensor.resend += again
        return True

    def _refuse(self, sensor: SensorState, reason: str) -> None:
        """Leave a stream unacknowledged, and say why: it waits at the sensor."""
        sensor.health.counts["refused"] += 1
        sensor.health.alarm("refused", reason)
        sensor.due = sensor.due or sensor.refused != reason
        sensor.refused = reason

    def forget(self) -> None:
        """Drop what is old of one sensor, in turn: poses that nothing names, and their views.

        Raises
        ------
        OutputError
            If the journal cannot be written.
        """
        name = next(self._turns)
        sensor = self.sensors[name]
        mine = PosesOfSensor(name, sensor.standing.heads, sensor.poses)
        if drop_old_poses(mine, self.poses, self._journal):
            views = {(s, self.poses[i].view) for s, e in self.sensors.items()
                     for i in e.poses.values()}  # fmt: skip
            self._book.keep(views)
            self._map.views = {view: self._map.views[view] for _, view in views}

    def _take_kept(self, sensor: SensorState, envelope: Envelope, content: bytes) -> None:
        """Take the pose that the broker kept: frames may speak of it where a journal was lost."""
        if envelope.kind == POSE and envelope.number > sensor.received:  # else it is an old one
            self._take_pose(sensor, envelope, content)

    def _take_pose(self, sensor: SensorState, envelope: Envelope, content: bytes) -> bool:
        """Add a pose to those that are known; return whether it is one of them then."""
        name = sensor.health.name
        if (sensor.stream, envelope.number) in sensor.poses:
            return True
        try:
            found = PoseContent.unpack(content)
            what = f"the pose of {name}"
            pose = pose_from_dict(found.pose, what=what)
            require_same(pose.crs, self._book.road.crs, what=what, other_what="the tiles")
        except InputError as error:
            self._skip(sensor, envelope, error.message)
            return False
        if found.fingerprint != self._book.road.fingerprint:
            self._refuse(
                sensor, f"tiles {found.fingerprint}, expected {self._book.road.fingerprint}"
            )
            return False
        row_id = self._journal.next_pose()
        standings = copy(sensor.standing)  # kept only once the pose is on disk
        standing = standings.add(pose, row_id)
        view = self._see(found, name) if standing == row_id else self.poses[standing].view
        self._journal.add_pose(
            PoseRow(row_id, name, sensor.stream, envelope.number, content, standing, view)
        )
        self._unwritten, sensor.standing = "", standings
        self.poses[row_id] = KnownPose(content=found, view=view)
        sensor.poses[sensor.stream, envelope.number] = row_id
        sensor.pose = pose
        self._map.holds_s[name] = found.validity_s
        sensor.health.alarm("moved", None if found.trusted else "its pose is not known")
        return True

    def _skip(self, sensor: SensorState, envelope: Envelope, reason: str) -> None:
        """Go past a message that is damaged where it was made: it would come again for ever."""
        sensor.health.counts["damaged"] += 1
        sensor.health.alarm("damaged", f"number {envelope.number}: {reason}")
        self._received(sensor, envelope, [])

    def _received(self, sensor: SensorState, envelope: Envelope, rows: list[FrameRow]) -> None:
        self._journal.add(rows, sensor.health.name, sensor.stream, envelope.number)
        sensor.received = envelope.number
        if sensor.refused:
            sensor.refused = ""
            sensor.health.alarm("refused", None)

    def _take_hits(
        self, sensor: SensorState, envelope: Envelope, content: bytes, message: Received
    ) -> None:
        fingerprint = self._book.road.fingerprint
        if content[:FINGERPRINT_BYTES] != bytes.fromhex(fingerprint)[:FINGERPRINT_BYTES]:
            begin = content[:FINGERPRINT_BYTES].hex()
            self._refuse(sensor, f"tiles {begin}..., expected {fingerprint}")
            return
        try:
            found = unpack_hits(content, tiles=len(self._book.road.tile_id))
        except InputError as error:
            self._skip(sensor, envelope, error.message)
            return
        pose = sensor.poses.get((sensor.stream, found.pose))
        if pose is None:
            self._skip(sensor, envelope, f"its pose, number {found.pose}, is not known")
            return
        known, health = self.poses[pose], sensor.health
        newest_s = found.frames[-1].time_us / 1e6
        health.heard(message.time, newest_s, live=envelope.live)
        if not known.content.trusted:
            health.counts["not_counted"] += len(found.frames)
            self._received(sensor, envelope, [])
            return
        pairs = zip(found.frames, found.sets, strict=True)
        rows = [_row_of(frame, health.name, pose, tiles) for frame, tiles in pairs]
        for frame in found.frames:
            health.counts["hits"] += len(frame.tiles)
            seen = Seen(frame.tiles, known.view)
            if not self._windows.add(health.name, frame.time_us // STEP_US, seen):
                health.counts["late_frames"] += 1
            self.touched[frame.time_us // HOUR_US] = time.monotonic()
        health.counts["frames"] += len(rows)
        self._received(sensor, envelope, rows)


def _row_of(frame: CountedFrame, sensor: str, pose: int, tiles: bytes) -> FrameRow:
    return FrameRow(
        sensor, frame.time_us, pose, frame.detections, frame.moving, frame.wild, frame.checksum,
        tiles,
    )  # fmt: skip
