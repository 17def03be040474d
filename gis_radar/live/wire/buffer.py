"""Disk buffer of a sensor, in which messages wait until fusion has stored them.

It is one SQLite file with a write-ahead log. A killed process loses nothing. Each opening begins a
new stream, so that a file restored from an older copy uses no number twice.
"""

from __future__ import annotations

import secrets
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Self

from gis_radar.base import GisRadarError, InputError, OutputError, Text
from gis_radar.live.wire.payload import STREAM_BYTES, VERSION

_LOCK_S = 1.0  # wait for another program to release the file
_LAST_NUMBER = 1 << 62  # largest number of a message, so that the next ones fit in 64 bits
_CHECK_EVERY = 64  # messages between two checks of the size
_APPLICATION = b"grbu"  # mark of a buffer in the file's header
_TABLE = """CREATE TABLE IF NOT EXISTS {} (
    number INTEGER PRIMARY KEY CHECK (number BETWEEN 1 AND {}),
    {} BLOB NOT NULL CHECK (typeof({}) = 'blob'));"""
_SCHEMA = f"""
PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL;
PRAGMA locking_mode = EXCLUSIVE; PRAGMA wal_autocheckpoint = 400;
CREATE TABLE IF NOT EXISTS notes (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
{_TABLE.format("messages", _LAST_NUMBER, "content", "content")}
{_TABLE.format("poses", _LAST_NUMBER, "message", "message")}
"""
_TABLE_CHECKS = ("SELECT number, content FROM messages", "SELECT number, message FROM poses")
# Begins of SQLite's error names that mean no damage: the file is in use, or the disk full or gone.
_NOT_DAMAGE = ("BUSY", "LOCKED", "FULL", "IOERR", "READONLY", "CANTOPEN", "NOMEM", "PERM", "AUTH")
_HEADER = (b"SQLite format 3\0", slice(68, 72))  # begin of the file, and place of the mark in it
_OTHER_TILES, DAMAGED = "what waited speaks of other tiles", "it is damaged"


class Waiting(NamedTuple):
    """A message that fusion has not stored yet.

    Parameters
    ----------
    number : int
        Number of the message in the stream.
    first : bool
        True if no earlier message is in the buffer.
    content : bytes
        Content of the message.
    """

    number: int
    first: bool
    content: bytes


class FullError(OutputError):
    """Error of a full buffer, or a full disk."""


class DiskBuffer:
    """Buffer of messages in order, until they are acknowledged.

    Parameters
    ----------
    path : Path
        The file, which is made where there is none.
    most_bytes : int
        Largest size, bytes. A full buffer takes no messages: waiting ones are never dropped.
    fingerprint : str
        Fingerprint of the messages' tiles. A file for other tiles is renamed, as is a damaged one,
        and a new one is begun.

    Attributes
    ----------
    stream : bytes
        Random id, new at each opening.
    last, stored : int
        The last number given, and the number up to which messages were acknowledged and dropped.
    put_aside : Path or None
        New path of an earlier file that was for other tiles, of another version, or damaged.
    why : str
        The reason for that.

    Raises
    ------
    InputError
        If there is a file that is no buffer.
    OutputError
        If the file cannot be opened.
    """

    def __init__(self, path: Path, *, most_bytes: int, fingerprint: str) -> None:
        self.path, self._most_bytes = path, most_bytes
        self.put_aside: Path | None = None
        self.why = ""
        mark = f"{VERSION} {fingerprint}".encode()
        with _errors(path):
            self._refuse_foreign()
            if (found_mark := self._open()) not in {mark, b""}:
                self._put_aside(DAMAGED if found_mark is None else _OTHER_TILES)
                self._open()
            self._database.execute("INSERT OR REPLACE INTO notes VALUES ('of', ?)", (mark,))
        first, last, pose = self._row(
            "SELECT coalesce(min(number), 0), coalesce(max(number), 0), "
            "(SELECT coalesce(max(number), 1) FROM poses) FROM messages"
        )
        self.last = max(last, pose - 1)  # a pose holds for its number and the later ones
        self.stored, self._appended = first - 1 if first else self.last, 0
        self.renew()

    def renew(self) -> None:
        """Begin a new stream, to which the waiting messages belong, too."""
        self.stream = secrets.token_bytes(STREAM_BYTES)

    def _refuse_foreign(self) -> None:
        """Refuse a file that is no buffer, unless it is all zeros, as a power loss may leave it."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            head = file.read(100)
        begins, place = _HEADER
        if head.strip(b"\0") and not (head.startswith(begins) and head[place] == _APPLICATION):
            raise InputError(
                "{}: is no disk buffer of a sensor",
                self.path,
                hint="name another file, or move this one away",
            )

    def _open(self) -> bytes | None:
        """Open the file; return its mark of version and tiles, None where it is damaged."""
        self._database = sqlite3.connect(self.path, isolation_level=None, timeout=_LOCK_S)
        try:
            if self._database.execute("PRAGMA application_id").fetchone() == (0,):  # a new one
                number = int.from_bytes(_APPLICATION)
                self._database.execute(f"PRAGMA application_id = {number}")
            self._database.executescript(_SCHEMA)
            (check,) = self._database.execute("PRAGMA quick_check(1)").fetchone()
            for query in _TABLE_CHECKS:
                self._database.execute(f"{query} LIMIT 0")
            query = "SELECT cast(value AS BLOB) FROM notes WHERE name = 'of'"
            mark = self._database.execute(query).fetchone() or (b"",)
        except sqlite3.Error as error:
            name = getattr(error, "sqlite_errorname", "SQLITE_ERROR").removeprefix("SQLITE_")
            if name.startswith(_NOT_DAMAGE):
                raise
            return None
        return bytes(mark[0]) if check == "ok" else None

    def _put_aside(self, why: str) -> None:
        """Rename the file, with its log."""
        self._database.close()
        self.why = why
        self.put_aside = self.path.with_name(f"{self.path.name}.{secrets.token_hex(STREAM_BYTES)}")
        self.path.rename(self.put_aside)
        log = self.path.with_name(f"{self.path.name}-wal")
        if log.exists():  # it would be read into the new file
            log.rename(self.put_aside.with_name(f"{self.put_aside.name}-wal"))
        self.path.with_name(f"{self.path.name}-shm").unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._database.close()

    def __len__(self) -> int:
        return self.last - self.stored

    @property
    def bytes_used(self) -> int:
        """Bytes of the file that are in use."""
        (pages,) = self._row("PRAGMA page_count")
        (free,) = self._row("PRAGMA freelist_count")
        (size,) = self._row("PRAGMA page_size")
        return int((pages - free) * size)

    def append(self, content: bytes) -> int:
        """Add a message and return its number.

        Raises
        ------
        FullError
            If the buffer or the disk is full: the message is not taken.
        """
        if self._appended % _CHECK_EVERY == 0 and self.bytes_used > self._most_bytes:
            raise FullError(
                "{}: the buffer is full ({:,.0f} MB)",
                self.path,
                self.bytes_used / 1000000.0,
                hint="fusion has not acknowledged; what comes now is lost",
            )
        with _errors(self.path):
            row = (self.last + 1, content)
            self._database.execute("INSERT INTO messages VALUES (?, ?)", row)
        self.last += 1
        self._appended += 1
        return self.last

    def add_pose(self, message: bytes) -> None:
        """Store the pose by which the detections of the next messages were selected.

        Raises
        ------
        FullError
            If the disk is full: the pose is not taken.
        """
        with _errors(self.path):
            row = (self.last + 1, message)
            self._database.execute("INSERT OR REPLACE INTO poses VALUES (?, ?)", row)

    def pose_of(self, number: int) -> bytes:
        """Return the pose by which the detections of a message were selected."""
        query = "SELECT message FROM poses WHERE number <= ? ORDER BY number DESC"
        with _errors(self.path):
            found = self._database.execute(f"{query} LIMIT 1", (number,)).fetchone()
        return found[0] if found else b""

    def read_after(self, number: int, most: int) -> Iterator[Waiting]:
        """Read up to `most` waiting messages after a number."""
        with _errors(self.path):
            rows = self._database.execute(
                "SELECT number, content FROM messages WHERE number > ? "
                "ORDER BY number LIMIT ?", (number, most),
            ).fetchall()  # fmt: skip
        before = max(number, self.stored)
        for row in rows:
            yield Waiting(row[0], row[0] == self.stored + 1 or row[0] != before + 1, row[1])
            before = row[0]

    def acknowledge(self, number: int) -> None:
        """Drop all messages up to a number: fusion has stored them."""
        number = min(number, self.last)
        with _errors(self.path):
            self._database.execute("DELETE FROM messages WHERE number <= ?", (number,))
            self._database.execute(
                "DELETE FROM poses WHERE number < "
                "(SELECT max(number) FROM poses WHERE number <= ?)", (number + 1,),
            )  # fmt: skip
        self.stored, self._appended = max(self.stored, number), 0

    def _row(self, query: str) -> tuple[int, ...]:
        with _errors(self.path):
            found = self._database.execute(query).fetchone()
        return tuple(found)


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    """Convert errors of SQLite to ones that name the file."""
    try:
        yield
    except GisRadarError:
        raise
    except (sqlite3.Error, OSError) as error:
        full = "full" in str(error)
        kind = FullError if full else OutputError
        reason = "the disk is full" if full else str(error)
        hint = "what comes now is lost" if full else "is another edge running with this buffer?"
        raise kind(Text("{}: cannot be written: {}", path, reason), hint=hint) from error
