"""Outbox of a sensor: send the messages of the disk buffer, and drop those that fusion stored."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

from gis_radar.base import QUIET, InputError, OutputError, Reporter
from gis_radar.live.wire.broker import Link, SensorTopics
from gis_radar.live.wire.buffer import DiskBuffer, Waiting
from gis_radar.live.wire.payload import (
    DETECTIONS_TOPIC,
    MOST_CONTENT,
    POSE_BYTES,
    POSE_TOPIC,
    VERSION,
    Acknowledgement,
    Envelope,
    check_of,
    pack_message,
)

_AT_ONCE = 100  # most messages read from the buffer at once
# Messages sent ahead of the acknowledgement at first, and after a loss: 2 s of a radar, the way to
# fusion's disk and back. More follow as acknowledgements come (slow start, RFC 5681): if many
# sensors sent all again at once, copies of stored messages would fill the broker.
_FIRST_AHEAD = 40
UNACKNOWLEDGED = 400  # most messages ahead of the acknowledgement: 20 s of a radar
# Time without an acknowledgement after which messages are sent again, and twice that each further
# time, up to the longest: an outage of a night then costs a few MB of traffic.
_RESEND_S, _SLOWEST_RESEND_S = 15.0, 300.0
STATUS_S = 2.0  # between two reports of a sensor's state
ONLINE_STATUS, OFFLINE_STATUS = "online", "offline"


def status_message(state: str, **figures: object) -> bytes:
    """Return a message with a sensor's state."""
    return json.dumps({"version": VERSION, "state": state, **figures}).encode()


class Outbox:
    """Sender of the buffer's messages in order; lost ones are sent again until acknowledged.

    Parameters
    ----------
    buffer : DiskBuffer
        The buffer of the messages.
    link : Link
        Link to the broker.
    topics : SensorTopics
        Topics of the sensor.
    figures : callable
        Returns the figures of the sensor's status messages.
    reporter : Reporter
        Receives a line when the buffer is full or fusion refuses the stream.

    Attributes
    ----------
    lost : int
        Number of messages that were too long, or that the buffer did not take.
    stored : int
        The number up to which fusion has stored messages.
    """

    def __init__(
        self, buffer: DiskBuffer, link: Link, topics: SensorTopics, *,
        figures: Callable[[], dict[str, object]], reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.lost, self.stored = 0, buffer.stored
        self._buffer, self._link, self._topics = buffer, link, topics
        self._figures, self._reporter = figures, reporter
        self._ahead = _FIRST_AHEAD
        self._sent, self._connections, self._pose_sent = self.stored, 0, b""
        self._session, self._resend, self._refused = "", 0, ""
        self._progress = self._reported = time.monotonic()
        self._resend_wait_s = _RESEND_S
        self._drop_error = ""
        self._full = self._too_long = False

    def put(self, content: bytes) -> bool:
        """Add a message; return False if it is lost, as it is too long or the buffer is full."""
        if len(content) > MOST_CONTENT:  # the broker would cut the link at each try
            if not self._too_long:
                self._reporter.warn("a message of {:,} bytes is too long", len(content))
            self._too_long = True
            self.lost += 1
            return False
        taken = self._is_written(lambda: self._buffer.append(content))
        self.lost += not taken
        return taken

    def put_pose(self, message: bytes) -> bool:
        """Add the pose by which the next messages are selected; return whether it is stored."""
        return self._is_written(lambda: self._buffer.add_pose(message))

    def _is_written(self, write: Callable[[], object]) -> bool:
        """Write to the buffer, and return whether that was possible; report a full one once."""
        try:
            write()
        except OutputError as error:
            if not self._full:
                self._reporter.warn("{}: {}", error.message, error.hint)
            self._full = True
            return False
        self._full = False
        return True

    @property
    def empty(self) -> bool:
        """Whether fusion has stored all messages."""
        return self.stored >= self._buffer.last

    @property
    def _unacknowledged(self) -> int:
        """Number of messages that are sent and not acknowledged."""
        return self._sent - self.stored

    def pump(self) -> None:
        """Process acknowledgements of fusion, and send what is due."""
        while (message := self._link.take(0.0)) is not None:
            self._take_acknowledgement(message.payload)
        if not self._link.connected:
            return
        now = time.monotonic()
        if self._link.connections != self._connections:
            self._connections = self._link.connections
            self._reported = 0.0
            self._rewind()
        if now - self._reported >= STATUS_S:
            self._reported = now
            self._drop()
            status = status_message(
                ONLINE_STATUS, stream=self._buffer.stream.hex(), **self._figures()
            )
            self._link.publish(self._topics.of("status"), status, retain=True)
        if self._unacknowledged and now - self._progress > self._resend_wait_s:
            self._resend_wait_s = min(2 * self._resend_wait_s, _SLOWEST_RESEND_S)
            self._rewind()
        self._send()

    def _send(self) -> None:
        """Send waiting messages, as many ahead of the acknowledgement as allowed now."""
        ahead = min(self._ahead, UNACKNOWLEDGED)
        while not self.empty and (room := ahead - self._unacknowledged) > 0:
            waiting = list(self._buffer.read_after(self._sent, min(room, _AT_ONCE)))
            if not waiting:
                return
            if not self._unacknowledged:
                self._progress = time.monotonic()
            for each in waiting:
                self._send_pose(each)
                envelope = Envelope(
                    stream=self._buffer.stream, number=each.number, first=each.first,
                    live=each.number == self._buffer.last,
                )  # fmt: skip
                self._link.publish(
                    self._topics.of(DETECTIONS_TOPIC), pack_message(envelope, each.content), qos=0
                )
                self._sent = each.number

    def _send_pose(self, waiting: Waiting) -> None:
        """Send the pose of a message, if it is not that of the message before."""
        key = waiting.content[:POSE_BYTES]
        if key != self._pose_sent:
            pose = self._buffer.pose_of(waiting.number)
            self._link.publish(self._topics.of(POSE_TOPIC), pose, retain=True)
            self._pose_sent = key

    def _rewind(self) -> None:
        """Start to send all messages that fusion has not stored again, slowly at first."""
        self._ahead = _FIRST_AHEAD
        self._sent, self._progress, self._pose_sent = self.stored, time.monotonic(), b""

    def _drop(self) -> None:
        """Drop stored messages; if the disk is full, try again with the next status."""
        if self._buffer.stored >= self.stored:
            return
        try:
            self._buffer.acknowledge(self.stored)
        except OutputError as error:
            if error.message != self._drop_error:
                self._drop_error = error.message
                self._reporter.warn("{}; trying on", error.message)
            return
        self._drop_error = ""

    def _take_acknowledgement(self, payload: bytes) -> None:
        """Take an acknowledgement: drop stored messages, or send missing ones again."""
        try:
            acknowledgement = Acknowledgement.unpack(payload)
        except InputError as error:
            self._reporter.warn("fusion sends {}", error.message)
            return
        if acknowledgement.stream != self._buffer.stream.hex():
            return
        if acknowledgement.refused and acknowledgement.refused != self._refused:
            self._reporter.warn("fusion refuses what is sent: {}", acknowledgement.refused)
        self._refused = acknowledgement.refused
        if acknowledgement.stored > self.stored:
            if not self._matches_own(acknowledgement):
                self._start_new_stream()
                return
            self._ahead = min(self._ahead + acknowledgement.stored - self.stored, UNACKNOWLEDGED)
            self.stored = acknowledgement.stored
            self._drop()
            self._progress, self._resend_wait_s = time.monotonic(), _RESEND_S
            self._sent = max(self._sent, self.stored)
        if (acknowledgement.session, acknowledgement.resend) != (self._session, self._resend):
            self._session, self._resend = acknowledgement.session, acknowledgement.resend
            self._rewind()

    def _matches_own(self, acknowledgement: Acknowledgement) -> bool:
        """Return whether fusion's last stored message equals the one with its number here."""
        here = list(self._buffer.read_after(acknowledgement.stored - 1, 1))
        return any(
            each.number == acknowledgement.stored
            and check_of(each.content) == acknowledgement.check
            for each in here
        )

    def _start_new_stream(self) -> None:
        """Send all waiting messages as a new stream: another program or copy used this one."""
        self._reporter.warn(
            "fusion has stored other messages of this stream: all that waits is sent as a new one",
        )
        self._buffer.renew()
        self._reported = 0.0
        self._rewind()
