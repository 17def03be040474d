"""Spool of fusion: files in which messages wait, as they came, until they are in recordings.

Records are appended and synced. Each file begins with the marks of all streams, so that the newest
one says where each stream continues, and contains the poses that its frames refer to.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from array import array
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from gis_radar.base import output_errors, sync_folder
from gis_radar.live.wire.payload import check_of, stream_of, unpack_message

# Kinds of records; a skipped one is a message that is not counted.
HEAD_RECORD, POSE_RECORD, FRAMES_RECORD, SKIPPED_RECORD = range(4)
_ENDING = ".spool"
_BEGIN = struct.Struct(">II")  # begin of a record: its length, and the CRC-32 of its content
_MOST_RECORD = 1 << 24  # most bytes of a record: the marks of thousands of sensors
_ZEROS = bytes(8)  # may stand at the end after a power loss
STREAMS_KEPT = 8  # newest streams of a sensor whose marks are kept


class Mark(NamedTuple):
    """The last message of a stream that is on the disk.

    Parameters
    ----------
    number : int
        Its number; 0 if there is none.
    check : int
        Check sum of its content.
    """

    number: int
    check: int


class Record(NamedTuple):
    """A record of the spool.

    Parameters
    ----------
    kind : int
        `HEAD_RECORD`, `POSE_RECORD`, `FRAMES_RECORD` or `SKIPPED_RECORD`.
    sensor : str
        Name of the sensor; empty for the head.
    payload : bytes
        A message as it arrived, or the marks as JSON.
    """

    kind: int
    sensor: str
    payload: bytes


class SpooledFrames(NamedTuple):
    """A message with frames on its way to the spool.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    pose : bytes
        Message of the pose that it refers to; empty for a skipped message.
    payload : bytes
        The message as it arrived.
    """

    sensor: str
    pose: bytes
    payload: bytes


class Spool:
    """Spool of messages; `add` and `collect` are for one thread, the rest for one other.

    Parameters
    ----------
    folder : Path
        Folder of the files, made where there is none; :meth:`rotate` begins the first file.

    Attributes
    ----------
    marks : dict
        Marks by sensor and stream, the latest last; replaced, never changed in place.

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.marks: dict[str, dict[str, Mark]] = {}
        self._waiting: list[SpooledFrames] = []
        self._batch: list[SpooledFrames] = []
        self._handle, self._size, self._path = -1, 0, folder
        self._written: set[tuple[str, bytes]] = set()
        with output_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)

    @property
    def waiting(self) -> int:
        """Number of messages that are not on disk yet."""
        return len(self._waiting) + len(self._batch)

    @property
    def size(self) -> int:
        """Bytes of the open file."""
        return self._size

    def add(self, message: SpooledFrames) -> None:
        """Add a message to the next batch."""
        self._waiting.append(message)

    def collect(self) -> bool:
        """Close the batch of messages for `write`; return whether there are any."""
        self._batch += self._waiting
        self._waiting = []
        return bool(self._batch)

    def write(self) -> None:
        """Write the batch to the disk.

        Raises
        ------
        OutputError
            If it cannot be written; then none of it is in the file, and the next call retries.
        """
        written, parts = set(self._written), list[bytes]()
        for each in self._batch:
            named = (each.sensor, each.pose)
            if each.pose and named not in written:
                written.add(named)
                parts.append(_packed(Record(POSE_RECORD, each.sensor, each.pose)))
            kind = FRAMES_RECORD if each.pose else SKIPPED_RECORD
            parts.append(_packed(Record(kind, each.sensor, each.payload)))
        self._append(b"".join(parts))
        self.mark([(each.sensor, each.payload) for each in self._batch])
        self._written, self._batch = written, []

    def mark(self, messages: Iterable[tuple[str, bytes]]) -> None:
        """Record that messages of sensors are on the disk, in the order in which they came."""
        last = dict[tuple[str, str], bytes]()
        for sensor, payload in messages:
            last.pop((sensor, stream_of(payload)), None)  # so that the latest stream stands last
            last[sensor, stream_of(payload)] = payload
        marks = dict(self.marks)
        for (sensor, stream), payload in last.items():
            envelope, content = unpack_message(payload)
            streams = {name: mark for name, mark in marks.get(sensor, {}).items() if name != stream}
            streams[stream] = Mark(envelope.number, check_of(content))
            marks[sensor] = dict(list(streams.items())[-STREAMS_KEPT:])
        self.marks = marks

    def mark_of(self, sensor: str, stream: str) -> Mark:
        """Return the mark of a stream."""
        return self.marks.get(sensor, {}).get(stream, Mark(0, 0))

    def _append(self, data: bytes) -> None:
        """Append bytes to the open file and sync it; on failure cut it back to its old end."""
        try:
            with output_errors(self._path):
                rest = memoryview(data)
                while rest:
                    rest = rest[os.write(self._handle, rest) :]
                os.fsync(self._handle)
        except BaseException:
            with suppress(OSError):  # a torn record would hide those after it
                os.ftruncate(self._handle, self._size)
                os.lseek(self._handle, self._size, os.SEEK_SET)
            raise
        self._size += len(data)

    def rotate(self) -> None:
        """Continue in a new file, which begins with the marks of all streams.

        Raises
        ------
        OutputError
            If it cannot be written: the old file stays in use.
        """
        before = (self._handle, self._size, self._written, self._path)
        numbers = [int(each.stem) for each in spool_files(self.folder)]
        path = self.folder / f"{max(numbers, default=0) + 1:08d}{_ENDING}"
        with output_errors(path):
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._handle, self._size, self._written, self._path = handle, 0, set(), path
        try:
            self._append(_packed(Record(HEAD_RECORD, "", json.dumps(self.marks).encode())))
            sync_folder(self.folder)
        except BaseException:
            os.close(handle)
            with suppress(OSError):
                path.unlink()
            self._handle, self._size, self._written, self._path = before
            raise
        if before[0] >= 0:
            os.close(before[0])

    @property
    def closed(self) -> list[Path]:
        """The closed files, in order."""
        return [each for each in spool_files(self.folder) if each != self._path]

    def close(self) -> None:
        """Close the file."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


def _packed(record: Record) -> bytes:
    name = record.sensor.encode()
    body = struct.pack(">BH", record.kind, len(name)) + name + record.payload
    return _BEGIN.pack(len(body), zlib.crc32(body)) + body


def marks_in(head: bytes) -> dict[str, dict[str, Mark]]:
    """Return the marks in the payload of a head."""
    return {
        sensor: {stream: Mark(*mark) for stream, mark in streams.items()}
        for sensor, streams in json.loads(head).items()
    }


def spool_files(folder: Path) -> list[Path]:
    """Return the files of a spool, in order."""
    return sorted(each for each in folder.glob(f"*{_ENDING}") if each.stem.isdigit())


class SpoolFile:
    """Reader of a file of the spool, which skips damaged records.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    damaged : bool
        Whether :meth:`records` skipped bytes that are not the torn end of a crash.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damaged = path, False
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""

    @property
    def has_head(self) -> bool:
        """Whether it begins with the marks of all streams; a crash may have torn them."""
        first = self.at(0)
        return first is not None and first.kind == HEAD_RECORD

    def records(self) -> Iterator[tuple[int, Record]]:
        """Yield all records, each with its offset in the file."""
        at = end = 0  # end: of the last whole record
        while at < len(self._data):
            if (record := self.at(at)) is None:
                at += 1
                continue
            self.damaged = self.damaged or at > end
            yield at, record
            at = end = at + _BEGIN.size + _BEGIN.unpack_from(self._data, at)[0]
        self.damaged = self.damaged or not self._is_torn(end)

    def _is_torn(self, end: int) -> bool:
        """Return whether the bytes after the last whole record are a torn end of a crash."""
        rest = len(self._data) - end - _BEGIN.size
        if rest < 0 or self._data[-len(_ZEROS) :] == _ZEROS:
            return True
        return bool(_BEGIN.unpack_from(self._data, end)[0] > rest)

    def at(self, at: int) -> Record | None:
        """Return the record at an offset; None where there is no whole one."""
        if at + _BEGIN.size > len(self._data):
            return None
        size, check = _BEGIN.unpack_from(self._data, at)
        if not 3 <= size <= min(_MOST_RECORD, len(self._data) - at - _BEGIN.size):
            return None
        body = bytes(self._data[at + _BEGIN.size : at + _BEGIN.size + size])
        if zlib.crc32(body) != check:
            return None
        kind, length = struct.unpack_from(">BH", body)
        return Record(kind, body[3 : 3 + length].decode(), body[3 + length :])

    def by_sensor(self) -> dict[str, array[int]]:
        """Return the offsets of each sensor's records."""
        found: dict[str, array[int]] = {}
        for at, record in self.records():
            if record.sensor:
                found.setdefault(record.sensor, array("Q")).append(at)
        return found
