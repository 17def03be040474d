"""Pack and unpack messages between sensors and fusion.

Frames with their detections near the road, which must not be lost, are a stream of numbered
messages. Each names the pose by which they were selected with a key that follows from the pose's
content, so that a pose may come at any time, and repeatedly. Numbers are varints (LEB128);
`docs/live.md` has the layout. Pose, status and acknowledgement are JSON.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from gis_radar.base import InputError, Text, parsed_json

VERSION = 2
DETECTIONS_TOPIC, POSE_TOPIC = "detections", "pose"  # topics
_LIVE, _FIRST = 0x80, 0x40  # flags: sent at once; no earlier message is in the sensor's buffer
_HEAD = struct.Struct(">BB4s")
_HEAD_BYTES = _HEAD.size  # bytes before the number
STREAM_BYTES, POSE_BYTES = 4, 4  # bytes of a stream's id, and of a pose's key
MOST_BYTES = 65_536  # most bytes of a message; a frame takes 350
MOST_FRAMES = 100  # most frames of a message
_MOST_VARINT = 9  # bytes of a number under 2**63
MOST_CONTENT = MOST_BYTES - _HEAD.size - _MOST_VARINT  # most bytes without the envelope
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Envelope:
    """Envelope of a message, before its content.

    Parameters
    ----------
    stream : bytes
        Id of the stream: 4 random bytes for each run of a sensor's program.
    number : int
        Number of the message in the stream, one more than that of the message before it.
    first : bool
        Whether the sensor's buffer holds no earlier message.
    live : bool
        Whether it was sent as soon as it was made.
    """

    stream: bytes
    number: int
    first: bool = False
    live: bool = True


def pack_message(envelope: Envelope, content: bytes) -> bytes:
    """Return the bytes of a message."""
    flags = _LIVE * envelope.live + _FIRST * envelope.first
    return _HEAD.pack(VERSION, flags, envelope.stream) + varint(envelope.number) + content


def unpack_message(data: bytes) -> tuple[Envelope, bytes]:
    """Return the envelope of a message, and its content.

    Raises
    ------
    InputError
        If it is too long or too short, or of another version.
    """
    if len(data) > MOST_BYTES:
        raise InputError("a message of {:,} bytes, expected {:,} at most", len(data), MOST_BYTES)
    if not data or data[0] != VERSION:
        raise VersionError(
            "a message of version {}, expected {}",
            data[0] if data else Text("none"),
            VERSION,
            hint="sensor and fusion need the same version of gis_radar",
        )
    if len(data) < _HEAD.size:
        raise InputError("a message of {} bytes", len(data))
    _, flags, stream = _HEAD.unpack_from(data)
    read = Numbers(data, _HEAD.size)
    envelope = Envelope(
        stream=stream, number=read.take(), first=bool(flags & _FIRST), live=bool(flags & _LIVE)
    )
    return envelope, data[read.at :]


def stream_of(message: bytes) -> str:
    """Return the stream of a message in hexadecimal digits."""
    return message[_HEAD_BYTES - STREAM_BYTES : _HEAD_BYTES].hex()


class VersionError(InputError):
    """Error of a message with an unknown version."""


def check_of(content: bytes) -> int:
    """Return the check sum of a message's content, by which sensor and fusion compare it."""
    return zlib.crc32(content)


def in_parts(frames: Sequence[T], pack: Callable[[Sequence[T]], bytes]) -> Iterator[bytes]:
    """Yield frames as contents that fit in messages; a single frame may still be too long.

    Parameters
    ----------
    frames : sequence
        In order of time.
    pack : callable
        Packs some of the frames to a content.
    """
    content = pack(frames)
    if len(content) <= MOST_CONTENT or len(frames) == 1:
        yield content
        return
    half = len(frames) // 2
    yield from in_parts(frames[:half], pack)
    yield from in_parts(frames[half:], pack)


def varint(value: int) -> bytes:
    """Return a number >= 0 in groups of seven bits (LEB128)."""
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)


class Numbers:
    """Reader of varints and bytes, one after the other."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self.at = data, at
        if at > len(data):
            raise InputError("a message ends after {} bytes", len(data))

    def take(self) -> int:
        """Read a number."""
        value = 0
        for shift in range(0, 7 * _MOST_VARINT, 7):
            if self.at >= len(self._data):
                break
            byte = self._data[self.at]
            self.at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise InputError("a message ends within a number, after {} bytes", len(self._data))

    def bytes(self, size: int) -> bytes:
        """Read `size` bytes."""
        if size > len(self._data) - self.at:
            raise InputError("a message ends too soon, after {} bytes", len(self._data))
        self.at += size
        return self._data[self.at - size : self.at]

    def end(self) -> None:
        """Refuse bytes after the end."""
        if self.at != len(self._data):
            raise InputError("a message has {} bytes too many", len(self._data) - self.at)


@dataclass(frozen=True, kw_only=True)
class PoseContent:
    """A pose that a sensor found or was given.

    Parameters
    ----------
    pose : dict
        The record of a pose file.
    fingerprint : str
        Fingerprint of the tiles near which detections are sent.
    """

    pose: dict[str, Any]
    fingerprint: str

    def pack(self) -> bytes:
        """Return it as a message."""
        return json.dumps({"version": VERSION, **vars(self)}, separators=(",", ":")).encode()

    @classmethod
    def unpack(cls, content: bytes) -> PoseContent:
        """Return what a message holds.

        Raises
        ------
        InputError
            If it is none, or of another version.
        """
        return cls(**_fields(content, Text("a pose"), {"pose": dict, "fingerprint": str}))


def key_of_pose(message: bytes) -> bytes:
    """Return the key by which frames name a pose, from the message that holds it."""
    return hashlib.blake2b(message, digest_size=POSE_BYTES).digest()


@dataclass(frozen=True, kw_only=True)
class Acknowledgement:
    """Acknowledgement: what fusion has stored of a sensor's stream.

    Parameters
    ----------
    stream : str
        The stream, in hexadecimal digits.
    stored : int
        All messages up to this number are on fusion's disk.
    check : int
        Check sum of the content of that message: a sensor whose own differs begins a new stream.
    session : str
        Id of fusion's run: when it changes, all later messages are sent again.
    resend : int
        Grows by one each time that messages are missing; those after `stored` are then sent again.
    refused : str
        The reason why the stream is refused; empty where it is taken.
    """

    stream: str
    stored: int
    check: int
    session: str
    resend: int = 0
    refused: str = ""

    def pack(self) -> bytes:
        """Return it as a message."""
        return json.dumps({"version": VERSION, **vars(self)}).encode()

    @classmethod
    def unpack(cls, data: bytes) -> Acknowledgement:
        """Return what a message holds.

        Raises
        ------
        InputError
            If it is none, or of another version.
        """
        texts, numbers = ("stream", "session", "refused"), ("stored", "check", "resend")
        kinds = {**dict.fromkeys(texts, str), **dict.fromkeys(numbers, int)}
        return cls(**_fields(data, Text("an acknowledgement"), kinds))


def _fields(data: bytes, what: str, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Return the fields of a message, after checking the type of each."""
    record = read_record(data, what=what)
    for name, kind in kinds.items():
        if not isinstance(record.get(name), kind):
            raise InputError("{}: {} is {}", what, name, f"{record.get(name)!r:.80}")
    return {name: record[name] for name in kinds}


def read_record(data: bytes, *, what: str) -> dict[str, Any]:
    """Return the table of a message in JSON.

    Parameters
    ----------
    data : bytes
        The message, or its content.
    what : str
        Its kind, for error messages.

    Raises
    ------
    InputError
        If it is no table, too long, or of another version.
    """
    if len(data) > MOST_BYTES:
        raise InputError("{}: {:,} bytes, expected {:,} at most", what, len(data), MOST_BYTES)
    try:
        record = parsed_json(data.decode())
    except (ValueError, RecursionError) as error:
        raise InputError("{}: no JSON", what) from error
    if not isinstance(record, dict):
        raise InputError("{}: no table", what)
    if record.get("version") != VERSION:
        raise VersionError(
            "{} of version {}, expected {}", what, f"{record.get('version')!r:.20}", VERSION
        )
    return record
