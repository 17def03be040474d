"""Messages between sensors and fusion: their bytes.

What must not be lost is a stream of numbered messages: frames with the tiles that they hit, and the
poses that these were found by. Detections, for tracking, are of the moment and have no
number. Numbers are varints (LEB128); `docs/live.md` has the layout. Status and acknowledgement are
JSON.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from gis_radar.arrays import Integers
from gis_radar.errors import InputError
from gis_radar.json_documents import parsed_json
from gis_radar.live.hits_folder.tile_sets import pack_tiles, unpack_tiles
from gis_radar.measures.hit_counter import CountedFrame
from gis_radar.steps import FIRST_YEAR, LAST_YEAR, LONGEST_CYCLE_S, in_known_years

VERSION, DETECTIONS_VERSION = 1, 2
HITS, POSE, DETECTIONS = 1, 2, 3
KINDS = {HITS: "hits", POSE: "pose", DETECTIONS: "detections"}
_LIVE = 0x80  # of the byte with the kind: sent as soon as it was made
_HEAD = struct.Struct(">BB4s")
STREAM_BYTES, FINGERPRINT_BYTES = 4, 4
MOST_BYTES = 65_536  # of a message; a frame takes 100
MOST_FRAMES = 1_000  # in a message
MOST_VALIDITY_S = 1.5 * LONGEST_CYCLE_S  # of a frame: up to the next one, with some delay
_MOST_VARINT = 9  # bytes of a number under 2**63
MOST_CONTENT = MOST_BYTES - _HEAD.size - 2 * _MOST_VARINT  # of a message, without its envelope
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Envelope:
    """What a message says of itself before its content.

    Parameters
    ----------
    kind : int
        `HITS`, `POSE` or `DETECTIONS`.
    stream : bytes
        Which buffer it is from: 4 random bytes.
    number : int
        Its number in the stream, ascending; 0 where it has none.
    previous : int
        The number of the message before it, 0 where none before it is kept.
    live : bool
        Whether it was sent as soon as it was made.
    """

    kind: int
    stream: bytes
    number: int = 0
    previous: int = 0
    live: bool = True


def pack_message(envelope: Envelope, content: bytes) -> bytes:
    """Return the bytes of a message."""
    kind = envelope.kind | (_LIVE if envelope.live else 0)
    gap = envelope.number - envelope.previous if envelope.previous else 0
    numbers = varint(envelope.number) + varint(gap)
    return _HEAD.pack(version_of(envelope.kind), kind, envelope.stream) + numbers + content


def version_of(kind: int) -> int:
    """Return the version of messages of a kind."""
    return DETECTIONS_VERSION if kind == DETECTIONS else VERSION


def unpack_message(data: bytes) -> tuple[Envelope, bytes]:
    """Return the envelope of a message, and its content.

    Raises
    ------
    InputError
        If it is too long or too short, of another version, or of a kind that is not known.
    """
    if len(data) > MOST_BYTES:
        raise InputError(f"a message of {len(data):,} bytes, expected {MOST_BYTES:,} at most")
    version = version_of(data[1] & ~_LIVE) if len(data) > 1 else VERSION
    if not data or data[0] != version:
        raise VersionError(
            f"a message of version {data[0] if data else 'none'}, expected {version}",
            hint="sensor and fusion need the same version of gis_radar",
        )
    if len(data) < _HEAD.size:
        raise InputError(f"a message of {len(data)} bytes")
    _, kind, stream = _HEAD.unpack_from(data)
    read = Numbers(data, _HEAD.size)
    number, gap = read.take(), read.take()
    if kind & ~_LIVE not in KINDS or gap > number:
        raise InputError(f"a message of kind {kind & ~_LIVE}, number {number}, gap {gap}")
    envelope = Envelope(
        kind=kind & ~_LIVE, stream=stream, number=number, previous=number - gap if gap else 0,
        live=bool(kind & _LIVE),
    )  # fmt: skip
    return envelope, data[read.at :]


class VersionError(InputError):
    """A message of a version that is not known here."""


def pack_hits(frames: Sequence[CountedFrame], *, pose: int, fingerprint: str) -> bytes:
    """Return frames as the content of a message.

    Parameters
    ----------
    frames : sequence of CountedFrame
        In order of time.
    pose : int
        Number of the message with the pose that they were found by.
    fingerprint : str
        Of the tiles.
    """
    parts = [bytes.fromhex(fingerprint)[:FINGERPRINT_BYTES], varint(pose), varint(len(frames))]
    before = 0
    for frame in frames:
        tiles = pack_tiles(frame.tiles)
        head = (
            frame.time_us - before, frame.detections, frame.moving, frame.wild, frame.checksum,
            len(tiles),
        )  # fmt: skip
        parts += [*map(varint, head), tiles]
        before = frame.time_us
    return b"".join(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class HitsContent:
    """Frames of a message, with what they refer to.

    Parameters
    ----------
    frames : tuple of CountedFrame
        In order of time.
    sets : tuple of bytes
        Their sets of tiles as they were sent, which is how they are stored.
    pose : int
        Number of the message with their pose.
    tiles_begin : str
        The first digits of the fingerprint of their tiles.
    """

    frames: tuple[CountedFrame, ...]
    sets: tuple[bytes, ...]
    pose: int
    tiles_begin: str


def unpack_hits(content: bytes, *, tiles: int) -> HitsContent:
    """Return the frames of a message.

    Parameters
    ----------
    content : bytes
        As of :func:`pack_hits`.
    tiles : int
        How many there are.

    Raises
    ------
    InputError
        If the bytes are no such content, or name a tile or a year that is not there.
    """
    read = Numbers(content, FINGERPRINT_BYTES)
    pose, count = read.take(), read.take()
    if not 0 < count <= MOST_FRAMES:
        raise InputError(f"a message of {count} frames, expected 1 to {MOST_FRAMES}")
    frames, sets, time_us = [], [], 0
    for _ in range(count):
        gap, detections, moving, wild, checksum, size = (read.take() for _ in range(6))
        time_us += gap
        sets.append(read.bytes(size))
        found = unpack_tiles(sets[-1], below=tiles, what="a frame's tiles")
        frames.append(
            CountedFrame(
                time_us=time_us, detections=detections, moving=moving, wild=wild,
                checksum=checksum, tiles=found,
            )
        )  # fmt: skip
    read.end()
    seconds = np.array([frame.time_us / 1e6 for frame in frames])
    if not (known := in_known_years(seconds)).all():
        raise InputError(
            f"a frame at {seconds[~known][0]:g} s, outside the years {FIRST_YEAR} to {LAST_YEAR}"
        )
    digits = content[:FINGERPRINT_BYTES].hex()
    return HitsContent(frames=tuple(frames), sets=tuple(sets), pose=pose, tiles_begin=digits)


def in_parts(frames: Sequence[T], pack: Callable[[Sequence[T]], bytes]) -> Iterator[bytes]:
    """Yield frames as contents that a message can hold; a single frame may still be too long.

    Parameters
    ----------
    frames : sequence
        In order of time.
    pack : callable
        Makes the content of some of them.
    """
    content = pack(frames)
    if len(content) <= MOST_CONTENT or len(frames) == 1:
        yield content
        return
    half = len(frames) // 2
    yield from in_parts(frames[:half], pack)
    yield from in_parts(frames[half:], pack)


def folded(values: Integers) -> Integers:
    """Return signed numbers as numbers from 0: 0, -1, 1, -2, ... become 0, 1, 2, 3, ..."""
    return np.asarray((values << 1) ^ (values >> 63))


def unfolded(values: Integers) -> Integers:
    """Return what :func:`folded` folded."""
    return np.asarray((values >> 1) ^ -(values & 1))


def varint(value: int) -> bytes:
    """Return a number from 0 in groups of seven bits (LEB128)."""
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)


class Numbers:
    """Varints, one after the other."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self.at = data, at
        if at > len(data):
            raise InputError(f"a message ends after {len(data)} bytes")

    def take(self) -> int:
        """Take a number."""
        value = 0
        for shift in range(0, 7 * _MOST_VARINT, 7):
            if self.at >= len(self._data):
                break
            byte = self._data[self.at]
            self.at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise InputError(f"a message ends within a number, after {len(self._data)} bytes")

    def rest(self) -> memoryview:
        """Look at what follows."""
        return memoryview(self._data)[self.at :]

    def bytes(self, size: int) -> bytes:
        """Take so many bytes."""
        if size > len(self._data) - self.at:
            raise InputError(f"a message ends too soon, after {len(self._data)} bytes")
        self.at += size
        return self._data[self.at - size : self.at]

    def end(self) -> None:
        """Refuse what is left."""
        if self.at != len(self._data):
            raise InputError(f"a message has {len(self._data) - self.at} bytes too many")


@dataclass(frozen=True, kw_only=True)
class PoseContent:
    """A pose that a sensor found or was given, with what else makes hits of detections.

    Parameters
    ----------
    pose : dict
        As a pose file holds it.
    since_step : int
        The step from which it holds.
    fingerprint : str
        Of the tiles.
    filters, settings : dict
        Which detections count, and the constants of the hit share.
    validity_s : float
        How long a frame is valid, seconds.
    trusted : bool
        False after the sensor was moved, until its pose is known again: frames then do not count.
    """

    pose: dict[str, Any]
    since_step: int
    fingerprint: str
    filters: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    validity_s: float = 0.1
    trusted: bool = True

    def pack(self) -> bytes:
        """Return it as the content of a message."""
        return json.dumps(vars(self), separators=(",", ":")).encode()

    @classmethod
    def unpack(cls, content: bytes) -> PoseContent:
        """Return what the content of a message holds.

        Raises
        ------
        InputError
            If it is none.
        """
        record = read_record(content, what="a pose")
        kinds = {"pose": dict, "since_step": int, "fingerprint": str, "filters": dict,
                 "settings": dict, "validity_s": float | int, "trusted": bool}  # fmt: skip
        odd = [name for name, kind in kinds.items() if not isinstance(record.get(name), kind)]
        odd += (
            ["validity_s"] if not odd and not 0.0 < record["validity_s"] <= MOST_VALIDITY_S else []
        )
        if odd:
            raise InputError(f"a message with a pose: {odd[0]} is {record.get(odd[0])!r:.80}")
        return cls(**{name: record[name] for name in kinds})


@dataclass(frozen=True, kw_only=True)
class Acknowledgement:
    """What fusion has stored of a sensor's stream.

    Parameters
    ----------
    stream : str
        Which, in hexadecimal digits.
    stored : int
        All messages up to this number are on fusion's disk.
    session : str
        Which run of fusion says so: after a new one all later messages are sent again.
    resend : int
        Grows by one each time that messages are missing: those after `stored` are to be sent again.
    refused : str
        Why the stream is not taken; empty where it is.
    """

    stream: str
    stored: int
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
        record = read_record(data, what="an acknowledgement", version=VERSION)
        texts, numbers = ("stream", "session", "refused"), ("stored", "resend")
        odd = [name for name in texts if not isinstance(record.get(name), str)]
        odd += [name for name in numbers if not isinstance(record.get(name), int)]
        if odd:
            raise InputError(f"an acknowledgement: {odd[0]} is {record.get(odd[0])!r:.80}")
        return cls(**{name: record[name] for name in (*texts, *numbers)})


def read_record(data: bytes, *, what: str, version: int | None = None) -> dict[str, Any]:
    """Return the table of a message in JSON.

    Parameters
    ----------
    data : bytes
        The message, or its content.
    what : str
        What it should be, for messages.
    version : int, optional
        Which it must state.

    Raises
    ------
    InputError
        If it is no table, too long, or of another version.
    """
    if len(data) > MOST_BYTES:
        raise InputError(f"{what}: {len(data):,} bytes, expected {MOST_BYTES:,} at most")
    try:
        record = parsed_json(data.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what}: no JSON") from error
    if not isinstance(record, dict):
        raise InputError(f"{what}: no table")
    if version is not None and record.get("version") != version:
        raise VersionError(f"{what} of version {record.get('version')!r:.20}, expected {version}")
    return record
