"""The disk buffer of a sensor: what was measured waits here until fusion has stored it.

One SQLite file with a write-ahead log. A killed process loses nothing. Numbers are reserved in
blocks that are on disk before they are used, so that a loss of power gives none of them twice.
"""

from __future__ import annotations

import re
import secrets
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, Self

from gis_radar.errors import GisRadarError, InputError, OutputError
from gis_radar.live.database import LAST_NUMBER, damage_of, is_damage, is_foreign
from gis_radar.live.payload import KINDS, STREAM_BYTES, VERSION

FORMAT = 1
LOCK_S = 1.0  # for another program to let go of the file
BLOCK = 4_096  # numbers that are reserved at once: 3 min of frames
ROW_BYTES = 24  # that SQLite takes beside the content of a message; measured
CHECK_EVERY = 64  # messages between two looks at the size
_SCHEMA = """
CREATE TABLE IF NOT EXISTS notes (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS messages (number INTEGER PRIMARY KEY, kind INTEGER NOT NULL,
    content BLOB NOT NULL);
"""
_COLUMNS = {"notes": ("name", "value"), "messages": ("number", "kind", "content")}
_SOUND = {
    "notes": "typeof(value) = 'text'",
    "messages": f"number BETWEEN 1 AND {LAST_NUMBER} AND typeof(content) = 'blob' "
    f"AND typeof(kind) = 'integer' AND kind IN ({', '.join(map(str, KINDS))})",
}
_BEGINS = (b"", b"SQLite format 3\0", bytes(16))  # a power loss may leave zeros
OTHER_TILES, DAMAGED = "what waited speaks of other tiles", "it is damaged"


class Waiting(NamedTuple):
    """A message that fusion has not stored yet.

    Parameters
    ----------
    number, previous : int
        Its number, and that of the one before it; 0 where none before it is kept.
    kind : int
        Of its content.
    content : bytes
        What it holds.
    """

    number: int
    previous: int
    kind: int
    content: bytes


class FullError(OutputError):
    """A buffer that takes nothing more."""


class DiskBuffer:
    """Messages in order, until they are acknowledged.

    Parameters
    ----------
    path : Path
        The file; made where there is none.
    most_bytes : int
        How large it may become. Then it takes nothing more: what waits is never dropped.
    fingerprint : str
        Of the tiles that its messages speak of. A file that speaks of others is put aside, as is
        one that is damaged: the sensor then goes on with a new one.

    Attributes
    ----------
    stream : bytes
        Random, for as long as the file lives.
    put_aside : Path or None
        Where a file of other tiles, or of another version, or a damaged one went.
    why : str
        Why it was put aside.

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
        with _errors(path):
            self._refuse_foreign()
            if self._open() or self._damage():
                self._put_aside(DAMAGED)
            kept = (f"{FORMAT}.{VERSION}", fingerprint)
            if (self.note("format"), self.note("fingerprint")) not in {kept, ("", "")}:
                self._put_aside(OTHER_TILES)
            if not self.note("stream"):
                self.set_note("stream", secrets.token_hex(STREAM_BYTES))
                self.set_note("format", kept[0])
                self.set_note("fingerprint", fingerprint)
        self.stream = bytes.fromhex(self.note("stream"))
        (last,) = self._one("SELECT coalesce(max(number), 0) FROM messages")
        self._last = max(last, int(self.note("reserved") or 0))
        self._reserved = self._last
        self._appended = 0

    def _refuse_foreign(self) -> None:
        """Leave a file alone that is no buffer."""
        foreign = False
        if self.path.exists():
            with self.path.open("rb") as file:
                foreign = file.read(16) not in _BEGINS
        if not foreign and self.path.exists() and self.path.stat().st_size:
            with (
                suppress(UnicodeDecodeError),
                closing(sqlite3.connect(self.path, timeout=LOCK_S)) as database,
            ):
                try:
                    foreign = is_foreign(database, tuple(_COLUMNS))
                except sqlite3.Error as error:
                    if not is_damage(error):
                        raise
        if foreign:
            raise InputError(
                f"{self.path}: is no disk buffer of a sensor",
                hint="name another file, or move this one away",
            )

    def _open(self) -> bool:
        """Open the file; return whether it is damaged."""
        self._database = sqlite3.connect(self.path, isolation_level=None, timeout=LOCK_S)
        try:
            self._database.executescript(
                "PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL;"
                "PRAGMA locking_mode = EXCLUSIVE; PRAGMA wal_autocheckpoint = 400;" + _SCHEMA
            )
        except UnicodeDecodeError:
            return True
        except sqlite3.Error as error:
            if not is_damage(error):
                raise
            return True
        return False

    def _damage(self) -> bool:
        if damage_of(self._database, _COLUMNS, _SOUND):
            return True
        stream, reserved = self.note("stream"), self.note("reserved")
        begun = bool(re.fullmatch(f"[0-9a-f]{{{2 * STREAM_BYTES}}}", stream))
        empty = not stream and len(self) == 0  # killed before the first note
        counts = not reserved or (
            re.fullmatch("[0-9]{1,19}", reserved, re.ASCII) and int(reserved) <= LAST_NUMBER
        )
        return not ((begun or empty) and counts)

    def _put_aside(self, why: str) -> None:
        """Keep the file under another name, with its log, and begin a new one."""
        self._database.close()
        self.why = why
        self.put_aside = self.path.with_name(f"{self.path.name}.{secrets.token_hex(STREAM_BYTES)}")
        self.path.rename(self.put_aside)
        log = self.path.with_name(f"{self.path.name}-wal")
        if log.exists():  # it would be read into the new file
            log.rename(self.put_aside.with_name(f"{self.put_aside.name}-wal"))
        self.path.with_name(f"{self.path.name}-shm").unlink(missing_ok=True)
        self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._database.close()

    def __len__(self) -> int:
        (count,) = self._one("SELECT count(*) FROM messages")
        return int(count)

    @property
    def last(self) -> int:
        """The number that was given last."""
        return self._last

    @property
    def bytes_used(self) -> int:
        """How much of the file is in use, bytes."""
        (pages,) = self._one("PRAGMA page_count")
        (free,) = self._one("PRAGMA freelist_count")
        (size,) = self._one("PRAGMA page_size")
        return int((pages - free) * size)

    def append(self, kind: int, content: bytes) -> int:
        """Add a message and return its number.

        Raises
        ------
        FullError
            If the buffer or the disk is full: the message is not taken.
        """
        if self._appended % CHECK_EVERY == 0 and self.bytes_used > self._most_bytes:
            raise FullError(
                f"{self.path}: the buffer is full ({self.bytes_used / 1e6:,.0f} MB)",
                hint="fusion has not acknowledged; what comes now is lost",
            )
        with _errors(self.path):
            if self._last >= self._reserved:
                self._reserve()
            row = (self._last + 1, kind, content)
            self._database.execute("INSERT INTO messages VALUES (?, ?, ?)", row)
        self._last += 1
        self._appended += 1
        return self._last

    def _reserve(self) -> None:
        """Reserve numbers, on disk before any of them is used."""
        self._database.execute("PRAGMA synchronous = FULL")
        try:
            self.set_note("reserved", str(self._last + BLOCK))
        finally:
            self._database.execute("PRAGMA synchronous = NORMAL")
        self._reserved = self._last + BLOCK

    def read_after(self, number: int, most: int) -> Iterator[Waiting]:
        """Read messages that wait, from after a number on."""
        (previous,) = self._one(
            "SELECT coalesce(max(number), 0) FROM messages WHERE number <= ?", number
        )
        with _errors(self.path):
            rows = self._database.execute(
                "SELECT number, kind, content FROM messages WHERE number > ? ORDER BY number "
                "LIMIT ?", (number, most),
            ).fetchall()  # fmt: skip
        for row in rows:
            yield Waiting(row[0], previous, row[1], row[2])
            previous = row[0]

    def acknowledge(self, number: int) -> None:
        """Drop all messages up to a number: fusion has stored them."""
        with _errors(self.path):
            self._database.execute("DELETE FROM messages WHERE number <= ?", (number,))
            self._appended = 0

    def note(self, name: str) -> str:
        """Return a text that is kept beside the messages; empty where there is none."""
        found = self._database.execute("SELECT value FROM notes WHERE name = ?", (name,)).fetchone()
        return str(found[0]) if found else ""

    def set_note(self, name: str, value: str) -> None:
        """Keep a text beside the messages."""
        self._database.execute("INSERT OR REPLACE INTO notes VALUES (?, ?)", (name, value))

    def _one(self, query: str, *values: int) -> tuple[int, ...]:
        with _errors(self.path):
            found = self._database.execute(query, values).fetchone()
        return tuple(found)


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    """Name the file where SQLite cannot write it."""
    try:
        yield
    except GisRadarError:
        raise
    except (sqlite3.Error, OSError) as error:
        full = "full" in str(error)
        kind = FullError if full else OutputError
        reason = "the disk is full" if full else str(error)
        hint = "what comes now is lost" if full else "is another edge running with this buffer?"
        raise kind(f"{path}: cannot be written: {reason}", hint=hint) from error
