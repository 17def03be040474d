"""Intake of fusion: check and count the sensors' messages, and put them in spool and windows."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from gis_radar.base import (
    QUIET,
    STEP_US,
    Floats,
    InputError,
    Integers,
    Reporter,
    Text,
    iso_from_step,
    require_same,
)
from gis_radar.live.health import SensorHealth
from gis_radar.live.hours.recordings import HOUR_US, hour_of_time
from gis_radar.live.hours.spool import (
    FRAMES_RECORD,
    HEAD_RECORD,
    SKIPPED_RECORD,
    STREAMS_KEPT,
    Spool,
    SpooledFrames,
    SpoolFile,
    marks_in,
)
from gis_radar.live.now.map_of_now import SensorReport, Windows
from gis_radar.live.now.vehicles_now import LiveVehicles
from gis_radar.live.wire.broker import FUSION, Received, parts_of
from gis_radar.live.wire.detections import FrameDetections, unpack_detections
from gis_radar.live.wire.outbox import ONLINE_STATUS
from gis_radar.live.wire.payload import (
    DETECTIONS_TOPIC,
    POSE_TOPIC,
    STREAM_BYTES,
    Envelope,
    PoseContent,
    VersionError,
    key_of_pose,
    read_record,
    stream_of,
    unpack_message,
)
from gis_radar.measures import FrameCounter, PoseNumbers, road_near
from gis_radar.poses import Pose, pose_from_dict
from gis_radar.scans import IN_SIGHT, SightScan, SightTiles, find_sight

_ACK_S = 1.0  # between two acknowledgements without a new number
# Time within which two streams of one sensor that alternate come from two programs of one name.
_TWINS_WITHIN_S = 60.0
_MOST_LOST = 2**63  # limit of a plausible count of lost messages: their numbers have 63 bits
STREAM = re.compile(f"[0-9a-f]{{{2 * STREAM_BYTES}}}")
AHEAD_S = 10.0  # a frame further in the future is of a wrong clock
_LONGEST_MESSAGE_US = HOUR_US  # longest time from first to last frame of a message
_MOST_NUMBER = 1 << 40  # largest number with which a stream may begin
_MOST_AHEAD = 1 << 24  # most numbers that may be missing if the sensor lost them: ten days
_POSES_KEPT = 64  # newest poses that are kept of a sensor
_FARTHEST_M = 20_000.0  # largest distance of a sensor from the tiles
_LAST_STEP = 5_000_000_000 * 20  # in 2128: times before it are written as ISO 8601


@dataclass(frozen=True, kw_only=True)
class PlacedPose:
    """A pose of a sensor, with values derived from it by which its frames are counted.

    Parameters
    ----------
    pose : Pose
        The pose.
    road_m : float
        Height of the road near the sensor, metres; NaN where not known.
    numbers : PoseNumbers
        Precomputed numbers by which frames are counted.
    in_sight : (n,) int64 array
        Positions of the tiles in sight.
    """

    pose: Pose
    road_m: float
    numbers: PoseNumbers
    in_sight: Integers


@dataclass(frozen=True, kw_only=True)
class KnownPose:
    """A pose that a sensor has sent.

    Parameters
    ----------
    message : bytes
        The message of the pose.
    placed : PlacedPose, optional
        The pose; None if it was refused.
    other_tiles : str
        Fingerprint of the message's tiles, where they differ from fusion's.
    """

    message: bytes
    placed: PlacedPose | None = None
    other_tiles: str = ""


@dataclass(kw_only=True)
class SensorState:
    """What fusion knows of a sensor.

    Parameters
    ----------
    health : SensorHealth
        Its counts and alarms.
    stream : str
        The stream that is received, in hexadecimal digits.
    resend, refused : int, str
        As acknowledgements state them.
    due : bool
        Whether an acknowledgement must be sent.
    asked_s, missed_s : float
        Monotonic seconds at which the acknowledgement was last repeated, and missing messages were
        last asked for.
    other : (str, float)
        The stream that was received before, and when it ended, monotonic seconds.
    numbers : dict
        Number of the last received message by stream, the latest last.
    poses : dict
        Poses by key, the latest last.
    acknowledged : int
        The number that was acknowledged last.
    pose : Pose, optional
        The newest pose.
    """

    health: SensorHealth
    stream: str = ""
    resend: int = 0
    refused: str = ""
    due: bool = False
    acknowledged: int = 0
    asked_s: float = -1e9
    missed_s: float = -1e9
    other: tuple[str, float] = ("", -1e9)
    numbers: dict[str, int] = field(default_factory=dict)
    poses: dict[bytes, KnownPose] = field(default_factory=dict)
    pose: Pose | None = None

    @property
    def received(self) -> int:
        """Number of the last message of the stream that is received."""
        return self.numbers.get(self.stream, 0)


class Intake:
    """Intake of the messages of a site's sensors.

    Parameters
    ----------
    names : iterable of str
        Names of the sensors.
    spool : Spool
        The spool, to which messages are appended.
    road : SightTiles
        All tiles.
    counter : FrameCounter
        Finds the tiles that frames hit.
    windows : Windows
        The windows of the map of now, to which frames are added.
    oldest_s : float
        Largest age of a frame, seconds.
    scan : SightScan, optional
        Scan of what hides tiles.
    reporter : Reporter
        Receives a line when a problem begins.

    Attributes
    ----------
    sensors : dict
        State of each sensor, by name.
    touched : set of int
        Hours of recordings of which frames came; the caller that processes them clears it.
    unknown : set of str
        Names of senders that are not in the site's file.
    vehicles : LiveVehicles, optional
        Receives messages for the vehicles of now.
    """

    def __init__(
        self, names: Iterable[str], *, spool: Spool, road: SightTiles, counter: FrameCounter,
        windows: Windows, oldest_s: float, scan: SightScan | None = None,
        vehicles: LiveVehicles | None = None, reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.unknown: set[str] = set()
        self.touched: set[int] = set()
        self.vehicles, self._spool = vehicles, spool
        self._road, self._scan = road, scan
        self._counter, self._windows = counter, windows
        self._oldest_s, self._reporter = oldest_s, reporter
        self.sensors = {
            name: SensorState(health=SensorHealth(name=name, reporter=reporter)) for name in names
        }

    def resume(self, files: Sequence[SpoolFile]) -> None:
        """Restore the marks of all streams, with which the newest file of the spool begins."""
        newest = max((k for k, each in enumerate(files) if each.has_head), default=0)
        last: dict[tuple[str, str], bytes] = {}
        for file in files[newest:]:
            for _, (kind, name, payload) in file.records():
                if kind == HEAD_RECORD:
                    self._spool.marks = marks_in(payload)
                elif name in self.sensors and kind in {FRAMES_RECORD, SKIPPED_RECORD}:
                    last.pop((name, stream_of(payload)), None)  # the latest stream stands last
                    last[name, stream_of(payload)] = payload
        self._spool.mark((name, payload) for (name, _), payload in last.items())
        for name, sensor in self.sensors.items():
            marks = self._spool.marks.get(name, {})
            sensor.numbers = {stream: mark.number for stream, mark in marks.items()}
            sensor.stream = next(reversed(marks), "")

    def handle(self, message: Received) -> None:
        """Process a message: count it, store it, or refuse it with a reason."""
        name, kind = parts_of(message.topic)
        sensor = self.sensors.get(name)
        if sensor is None:
            if name not in {"", FUSION, *self.unknown}:
                self.unknown.add(name)
                self._reporter.warn("{}: no sensor of this site: what it sends is left out", name)
            return
        sensor.health.counts["messages"] += 1
        try:
            if kind == "status":
                self._handle_status(sensor, message)
            elif kind == POSE_TOPIC:
                self._take_pose(sensor, message.payload)
            elif kind == DETECTIONS_TOPIC:
                self._handle_numbered(sensor, message)
        except VersionError as error:
            self._refuse(sensor, error.message)
        except InputError as error:
            sensor.health.counts["damaged"] += 1
            sensor.health.alarm("damaged", error.message)

    def _handle_status(self, sensor: SensorState, message: Received) -> None:
        """Take counts, alarms and the stream from a sensor's status message."""
        record = read_record(message.payload, what="a status")
        online = record.get("state") == ONLINE_STATUS
        sensor.health.alarm(
            "offline", None if online else Text("the broker lost it, or it was stopped")
        )
        for name in ("lost", "not_followed"):
            count = record.get(name)
            if type(count) is int and 0 <= count < _MOST_LOST:  # not true
                sensor.health.counts[name] = count
                if name == "lost":
                    sensor.health.alarm(name, Text("{} messages", count) if count else None)
        trusted = record.get("trusted") is not False
        sensor.health.alarm("moved", None if trusted else Text("its pose is not known"))
        stream = record.get("stream")
        if online and not message.retained and isinstance(stream, str) and STREAM.fullmatch(stream):
            self._use_stream(sensor, stream)

    def _use_stream(self, sensor: SensorState, stream: str) -> None:
        """Receive another stream of a sensor from now on; raise an alarm where two take turns."""
        if stream == sensor.stream:
            return
        now = time.monotonic()
        if sensor.other[0] == stream and now - sensor.other[1] < _TWINS_WITHIN_S:
            sensor.health.alarm(
                "twins", Text("streams {} and {} take turns", sensor.stream, stream)
            )
        sensor.other = (sensor.stream, now)
        sensor.stream, sensor.refused, sensor.due = stream, "", True
        sensor.numbers[stream] = sensor.numbers.pop(stream, 0)
        if len(sensor.numbers) > STREAMS_KEPT:
            del sensor.numbers[next(iter(sensor.numbers))]

    def _handle_numbered(self, sensor: SensorState, message: Received) -> None:
        """Spool and count a message with frames if it is the next of its stream."""
        envelope, content = unpack_message(message.payload)
        self._use_stream(sensor, envelope.stream.hex())
        if not self._follows(sensor, envelope):
            return
        try:
            key, frames = unpack_detections(content)
            reason = self._time_fault(frames, message.time)
        except InputError as error:
            self._skip(sensor, message, envelope, "damaged", error.message)
            return
        if reason:
            sensor.health.counts["off_time"] += len(frames)
            self._skip(sensor, message, envelope, "off_time", reason)
            return
        known = sensor.poses.get(key)
        if known is None:  # asked to send again, the sensor also sends the pose again
            sensor.health.counts["gaps"] += self._ask(sensor, again=True)
        elif known.other_tiles:
            expected = self._road.fingerprint
            self._refuse(sensor, Text("tiles {}, expected {}", known.other_tiles, expected))
        elif known.placed is None:
            self._skip(sensor, message, envelope, "damaged", Text("its pose is damaged"))
        else:
            self._received(sensor, message, envelope, pose=known.message)
            sensor.health.heard(message.time, frames[-1].time_us / 1e6, live=envelope.live)
            self._take_frames(sensor, frames, known.placed)
            if self.vehicles is not None:
                placed = known.placed
                self.vehicles.take(sensor.health.name, content, placed.pose, placed.road_m)

    def _follows(self, sensor: SensorState, envelope: Envelope) -> bool:
        """Return whether a message is the next of its stream; ask for missing ones."""
        received, number = sensor.received, envelope.number
        if number <= received:
            sensor.health.counts["duplicates"] += 1
            self._ask(sensor)
            return False
        if number == received + 1:
            return True
        most = received + _MOST_AHEAD if received else _MOST_NUMBER
        if number > most:
            raise InputError("a message of number {:,} after {:,}", number, received)
        if not envelope.first:
            sensor.health.counts["gaps"] += self._ask(sensor, again=True)
            return False
        if received:  # fusion's disk was restored from before its last acknowledgement
            lost = Text("{:,} messages that the sensor no longer has", number - 1 - received)
            sensor.health.alarm("lost", lost)
        return True

    def _time_fault(self, frames: Sequence[FrameDetections], now_s: float) -> str:
        """Return why the times of frames are impossible or too old; empty where they are not."""
        times = [each.time_us for each in frames]
        if any(earlier >= later for earlier, later in pairwise(times)):
            raise InputError("a message whose frames do not ascend in time")
        if times[-1] - times[0] > _LONGEST_MESSAGE_US:
            return Text("a message over {:.0f} h", (times[-1] - times[0]) / HOUR_US)
        for each in (times[0], times[-1]):
            if not (now_s - self._oldest_s) * 1e6 <= each <= (now_s + AHEAD_S) * 1e6:
                known = each < 1 << 62 and each // STEP_US < _LAST_STEP
                when = iso_from_step(each // STEP_US) if known else f"{each} us"
                return Text("frames of {}, {:,.0f} s from now", when, abs(each / 1000000.0 - now_s))
        return ""

    def _ask(self, sensor: SensorState, *, again: bool = False) -> bool:
        """Have the acknowledgement repeated, at most once a second; return whether it will be.

        With `again` it asks for the missing messages.
        """
        now = time.monotonic()
        if now - (sensor.missed_s if again else sensor.asked_s) < _ACK_S:
            return False
        sensor.asked_s, sensor.due = now, True
        sensor.missed_s = now if again else sensor.missed_s
        sensor.resend += again
        return True

    def _refuse(self, sensor: SensorState, reason: str) -> None:
        """Refuse a stream with a reason: it stays unacknowledged and waits at the sensor."""
        sensor.health.counts["refused"] += 1
        sensor.health.alarm("refused", reason)
        sensor.due = sensor.due or sensor.refused != reason
        sensor.refused = reason

    def _skip(
        self, sensor: SensorState, message: Received, envelope: Envelope, kind: str, reason: str
    ) -> None:
        """Skip a message that cannot be used, as else it would be sent again for ever."""
        sensor.health.counts["damaged"] += kind == "damaged"
        sensor.health.alarm(kind, Text("number {}: {}", envelope.number, reason))
        self._received(sensor, message, envelope)

    def _received(
        self, sensor: SensorState, message: Received, envelope: Envelope, *, pose: bytes = b""
    ) -> None:
        """Spool a message, with the message of its pose unless it was skipped."""
        self._spool.add(SpooledFrames(sensor.health.name, pose, message.payload))
        sensor.numbers[sensor.stream] = envelope.number
        if sensor.refused:
            sensor.refused = ""
            sensor.health.alarm("refused", None)

    def _take_pose(self, sensor: SensorState, message: bytes) -> None:
        """Add a pose to those that frames may name."""
        key, name = key_of_pose(message), sensor.health.name
        if key in sensor.poses:
            return
        found = PoseContent.unpack(message)
        known = KnownPose(message=message)
        if found.fingerprint != self._road.fingerprint:
            known = replace(known, other_tiles=found.fingerprint)
        else:
            try:
                placed = self._place_pose(name, found)
            except InputError as error:
                sensor.health.counts["damaged"] += 1
                sensor.health.alarm("damaged", error.message)
            else:
                known, sensor.pose = replace(known, placed=placed), placed.pose
        sensor.poses[key] = known
        if len(sensor.poses) > _POSES_KEPT:  # a sensor that names a forgotten pose is asked for it
            del sensor.poses[next(iter(sensor.poses))]

    def _place_pose(self, name: str, found: PoseContent) -> PlacedPose:
        """Return a received pose with the tiles in its sight; refuse one of another place."""
        what = Text("the pose of {}", name)
        pose = pose_from_dict(found.pose, what=what)
        if pose.sensor != name:
            raise InputError("{}: it is that of {}", what, f"{pose.sensor:.40}")
        require_same(pose.crs, self._road.crs, what=what, other_what="the tiles")
        offset_m: Floats = self._road.centres[:, :2] - pose.position[:2]
        if not np.hypot(*offset_m.T).min() <= _FARTHEST_M:
            raise InputError("{}: it is over {:g} km from the tiles", what, _FARTHEST_M / 1000)
        if self._scan is not None:
            self._scan.read([pose])
        sight = find_sight(pose, self._road, self._scan)
        road_m = road_near(sight, self._road)
        return PlacedPose(
            pose=sight.pose, road_m=road_m, numbers=PoseNumbers.of(pose, road_m=road_m),
            in_sight=np.flatnonzero(sight.state == IN_SIGHT),
        )  # fmt: skip

    def _take_frames(
        self, sensor: SensorState, frames: Sequence[FrameDetections], placed: PlacedPose
    ) -> None:
        """Count frames, for the map and for the sensor's health."""
        counts = sensor.health.counts
        self.touched |= {hour_of_time(each.time_us) for each in frames}
        for step, seen in self._seen(frames, placed):
            counts["hits"] += len(seen.tiles)
            if not self._windows.add(sensor.health.name, step, seen):
                counts["late_frames"] += 1
        counts["frames"] += len(frames)

    def _seen(
        self, frames: Sequence[FrameDetections], placed: PlacedPose
    ) -> Iterator[tuple[int, SensorReport]]:
        """Yield for each frame its step and the tiles that it hits."""
        for each in frames:
            (counted,) = self._counter.count(each.as_rows(), placed.numbers)
            yield each.time_us // STEP_US, SensorReport(counted.tiles, placed.in_sight)
