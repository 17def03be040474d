"""The journal of fusion: frames on disk before they are acknowledged, until their hour is written.

One SQLite file. A commit reaches the disk as a whole: frames and the numbers up to which they are
stored, so that whatever is killed, an acknowledged frame is there, and none is there twice. While
an hour is written, on another thread, frames of it that come late wait in a table of their own.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple, Self

import numpy as np

from gis_radar.errors import InputError, OutputError
from gis_radar.live.database import as_one, damage_of, is_damage, is_foreign
from gis_radar.live.hours import HOUR_US
from gis_radar.steps import in_known_years

LOCK_S = 1.0  # for another program to let go of the file
FRAMES_AT_ONCE = 2_000  # read for an hour: 100 s of a radar
DROPPED_AT_ONCE_US = HOUR_US // 12  # so that a commit need not wait long
TURN_S = 0.005  # in which a commit that waits gets its turn
_FRAMES = """
CREATE TABLE IF NOT EXISTS {} (sensor TEXT, time_us INTEGER, pose INTEGER NOT NULL,
    detections INTEGER NOT NULL, moving INTEGER NOT NULL, wild INTEGER NOT NULL,
    checksum INTEGER NOT NULL, tiles BLOB NOT NULL, PRIMARY KEY (sensor, time_us)) WITHOUT ROWID;
"""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS notes (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS marks (sensor TEXT, stream TEXT, stored INTEGER NOT NULL,
    PRIMARY KEY (sensor, stream));
CREATE TABLE IF NOT EXISTS poses (id INTEGER PRIMARY KEY, sensor TEXT NOT NULL,
    stream TEXT NOT NULL, number INTEGER NOT NULL, content BLOB NOT NULL,
    standing INTEGER NOT NULL, view TEXT NOT NULL, UNIQUE (sensor, stream, number));
"""
_SCHEMA += _FRAMES.format("frames") + _FRAMES.format("late")
_COLUMNS = {
    "notes": ("name", "value"),
    "marks": ("sensor", "stream", "stored"),
    "poses": ("id", "sensor", "stream", "number", "content", "standing", "view"),
    "frames": (
        "sensor", "time_us", "pose", "detections", "moving", "wild", "checksum", "tiles",
    ),
}  # fmt: skip
_INSERT = {
    "frames": "INSERT OR IGNORE INTO frames VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
    "late": "INSERT OR IGNORE INTO late VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
}
_COLUMNS["late"] = _COLUMNS["frames"]
_SOUND = {
    "notes": "typeof(name) = 'text' AND typeof(value) = 'text'",
    "marks": "typeof(sensor) = 'text' AND typeof(stream) = 'text' AND typeof(stored) = 'integer' "
    "AND stored BETWEEN 0 AND (1 << 62)",
    "poses": "typeof(sensor) = 'text' AND typeof(stream) = 'text' AND typeof(content) = 'blob' "
    "AND typeof(number) = 'integer' AND typeof(view) = 'text' AND id BETWEEN 1 AND (1 << 62) "
    "AND EXISTS (SELECT 1 FROM poses AS other WHERE other.id = poses.standing "
    "AND other.sensor = poses.sensor)",
    "frames": "typeof(sensor) = 'text' AND typeof(tiles) = 'blob' AND typeof(time_us) = 'integer' "
    "AND typeof(pose) = 'integer' AND typeof(detections) = 'integer' "
    "AND typeof(moving) = 'integer' AND typeof(wild) = 'integer' AND typeof(checksum) = 'integer' "
    "AND min(time_us, detections, moving, wild, checksum) >= 0 "
    "AND EXISTS (SELECT 1 FROM poses WHERE poses.id = frames.pose "
    "AND poses.sensor = frames.sensor)",
}
_SOUND["late"] = _SOUND["frames"].replace("frames.", "late.")


class FrameRow(NamedTuple):
    """A frame in the journal; `pose` is the id of its row, `tiles` the bytes of the set."""

    sensor: str
    time_us: int
    pose: int
    detections: int
    moving: int
    wild: int
    checksum: int
    tiles: bytes


class PoseRow(NamedTuple):
    """A pose in the journal; `standing` is the id of the row whose view it shares."""

    id: int
    sensor: str
    stream: str
    number: int
    content: bytes
    standing: int
    view: str


class PoseName(NamedTuple):
    """A pose in the journal, without its content."""

    id: int
    stream: str
    number: int
    standing: int


def read_frames(
    database: sqlite3.Connection, sensor: str, begin_us: int, end_us: int, lock: Any = None
) -> Iterator[list[FrameRow]]:
    """Read the frames of a sensor in a time, the end left out, piece by piece.

    Parameters
    ----------
    database : Connection
        With a table `frames`.
    sensor : str
        Its name.
    begin_us, end_us : int
        Microseconds since 1970.
    lock : RLock, optional
        Held while a piece is read.
    """
    while True:
        with lock or nullcontext():
            rows = database.execute(
                "SELECT * FROM frames WHERE sensor = ? AND time_us >= ? AND time_us < ? "
                "ORDER BY time_us LIMIT ?",
                (sensor, begin_us, end_us, FRAMES_AT_ONCE),
            ).fetchall()
        if not rows:
            return
        yield [FrameRow(*row) for row in rows]
        begin_us = rows[-1][1] + 1


class Journal:
    """Frames, poses and marks on disk.

    Parameters
    ----------
    path : Path
        The file; made where there is none.
    fingerprint : str
        Of the tiles.

    Raises
    ------
    InputError
        If it is damaged, or no journal.
    OutputError
        If it cannot be written, or is one of other tiles.
    """

    def __init__(self, path: Path, *, fingerprint: str) -> None:
        self.path: Path = path
        self._waiting: list[FrameRow] = []
        self._marks: dict[tuple[str, str], int] = {}
        self._going: list[FrameRow] = []  # to the disk, by `write`
        self._going_marks: dict[tuple[str, str], int] = {}
        self._lock, self._watched = RLock(), -1
        with self._errors():
            self._database = sqlite3.connect(
                path, isolation_level=None, timeout=LOCK_S, check_same_thread=False
            )
            try:
                foreign = is_foreign(self._database, tuple(_COLUMNS))
                if not foreign:
                    self._begin(fingerprint)
            except (sqlite3.Error, UnicodeDecodeError) as error:
                if isinstance(error, sqlite3.Error) and not is_damage(error):
                    raise
                raise self._damaged("it cannot be read") from error
            if foreign:
                self._database.close()
                raise InputError(
                    f"{path}: is no journal of the live system", hint="move this file away"
                )
            if why := damage_of(self._database, _COLUMNS, _SOUND):
                raise self._damaged(why)
            last = self._database.execute("SELECT max(time_us) FROM frames").fetchone()[0] or 0
            if not in_known_years(np.array([last / 1e6])).all():
                raise self._damaged("its frames are of no known year")
            (known,) = self._database.execute(
                "SELECT value FROM notes WHERE name = 'fingerprint'"
            ).fetchone()
        if known != fingerprint:
            self._database.close()
            raise OutputError(
                f"{path}: holds frames on tiles {known}, not {fingerprint}",
                hint="name another folder for the new tiles",
            )
        self.unwatch()

    def _begin(self, fingerprint: str) -> None:
        """Make the tables where there are none."""
        self._database.executescript(
            "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL;"
            "PRAGMA locking_mode = EXCLUSIVE;" + _SCHEMA
        )
        row = ("fingerprint", fingerprint)
        self._database.execute("INSERT OR IGNORE INTO notes VALUES (?, ?)", row)

    def _damaged(self, why: str) -> InputError:
        self._database.close()
        return InputError(
            f"{self.path}: damaged: {why}",
            hint="move it away: what fusion had not acknowledged comes again, the frames of the "
            "hours that were not written yet are in it alone",
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:  # another thread may be writing
            self._database.close()

    @property
    def waiting(self) -> int:
        """Frames that the next commit brings to the disk."""
        return len(self._waiting)

    def marks(self) -> dict[tuple[str, str], int]:
        """Return up to which number each stream (sensor, stream) is stored, the newest last."""
        rows = self._database.execute("SELECT sensor, stream, stored FROM marks ORDER BY rowid")
        return {(sensor, stream): stored for sensor, stream, stored in rows}

    def mark(self, sensor: str, stream: str) -> tuple[int, int]:
        """Return up to which number a stream was taken, and up to which it is on disk."""
        key = (sensor, stream)
        with self._lock:  # not in the midst of a commit
            stored = self.marks().get(key, 0)
        taken = (self._going_marks.get(key, 0), self._marks.get(key, 0))
        return max(stored, *taken), stored

    def poses(self, sensor: str) -> list[PoseRow]:
        """Return the poses of a sensor, in order."""
        found = self._database.execute(
            "SELECT * FROM poses WHERE sensor = ? ORDER BY id", (sensor,)
        )
        return [PoseRow(*row) for row in found]

    def pose_names(self, sensor: str) -> list[PoseName]:
        """Return the poses of a sensor, in order, without their contents."""
        found = self._database.execute(
            "SELECT id, stream, number, standing FROM poses WHERE sensor = ? ORDER BY id", (sensor,)
        )
        return [PoseName(*row) for row in found]

    def next_pose(self) -> int:
        """Return the id of the next pose."""
        (found,) = self._database.execute("SELECT coalesce(max(id), 0) + 1 FROM poses").fetchone()
        return int(found)

    def add_pose(self, row: PoseRow) -> None:
        """Add a pose, at once."""
        with self._errors():
            self._database.execute("INSERT INTO poses VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def poses_named(self, sensor: str) -> set[int]:
        """Return the ids of the poses that frames of a sensor name, on disk or not yet."""
        rows = [*self._going, *self._waiting]  # before the query: a commit may end meanwhile
        found = self._database.execute(
            "SELECT DISTINCT pose FROM frames WHERE sensor = ? "
            "UNION SELECT DISTINCT pose FROM late WHERE sensor = ?",
            (sensor, sensor),
        ).fetchall()
        return {pose for (pose,) in found} | {row.pose for row in rows if row.sensor == sensor}

    def drop_poses(self, ids: Iterable[int]) -> None:
        """Drop poses that nothing names any more, all or none: others stand for them."""
        with self._errors(), as_one(self._database):
            self._database.executemany("DELETE FROM poses WHERE id = ?", [(each,) for each in ids])

    def add(self, frames: Sequence[FrameRow], sensor: str, stream: str, number: int) -> None:
        """Take the frames of a message; the next commit brings them to the disk."""
        self._waiting += frames
        self._marks[sensor, stream] = number

    def commit(self) -> None:
        """Bring all that was taken to the disk, as a whole.

        Raises
        ------
        OutputError
            If the disk is full or fails: what was taken stays taken, for the next commit.
        """
        if self.collect():
            self.write()

    def collect(self) -> bool:
        """Collect what was taken for the next :meth:`write`; return whether there is anything."""
        self._going += self._waiting
        self._going_marks |= self._marks
        self._waiting, self._marks = [], {}
        return bool(self._going_marks)

    def write(self) -> None:
        """Bring what was collected to the disk; meanwhile another thread may take more.

        Raises
        ------
        OutputError
            As :meth:`commit`.
        """
        with self._errors(), as_one(self._database):
            for table, rows in self._by_table().items():
                self._database.executemany(_INSERT[table], rows)
            self._database.executemany(
                "INSERT INTO marks VALUES (?, ?, ?) ON CONFLICT DO UPDATE "
                "SET stored = max(stored, excluded.stored)",
                [(*key, number) for key, number in self._going_marks.items()],
            )
        self._going, self._going_marks = [], {}

    def _by_table(self) -> dict[str, list[FrameRow]]:
        """Return the frames that go to the disk by the table where they go."""
        if self._watched < 0:
            return {"frames": self._going}
        begin, end = self._watched * HOUR_US, (self._watched + 1) * HOUR_US
        late = [row for row in self._going if begin <= row.time_us < end]
        rest = [row for row in self._going if not begin <= row.time_us < end]
        return {"frames": rest, "late": late}

    @property
    def streams_waiting(self) -> int:
        """Streams of which the next commit brings frames or numbers to the disk."""
        return len(self._marks)

    def watch(self, hour: int) -> None:
        """Let the frames of an hour stay as they are: it is being written, on another thread."""
        self._watched = hour

    def unwatch(self) -> None:
        """Put frames that came late meanwhile to the others."""
        self._watched = -1
        with self._errors():
            if self._database.execute("SELECT 1 FROM late LIMIT 1").fetchone() is None:
                return
            self._database.execute("BEGIN IMMEDIATE")
            try:
                self._database.execute("INSERT OR IGNORE INTO frames SELECT * FROM late")
                self._database.execute("DELETE FROM late")
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise

    def hours(self) -> list[int]:
        """Return the hours since 1970 of which frames are kept."""
        query = "SELECT DISTINCT time_us / ? FROM frames ORDER BY 1"
        rows = self._database.execute(query, (HOUR_US,))
        return [hour for (hour,) in rows]

    def frames(self, sensor: str, begin_us: int, end_us: int) -> Iterator[list[FrameRow]]:
        """Read the frames of a sensor in a time, the end left out, piece by piece."""
        yield from read_frames(self._database, sensor, begin_us, end_us, self._lock)

    def copy_hour(self, hour: int, sensors: Sequence[str], path: Path) -> set[int]:
        """Copy these sensors' frames of an hour to a file; return the ids of their poses.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        with self._errors():
            path.unlink(missing_ok=True)
            self._database.execute("ATTACH ? AS hour", (str(path),))
        try:
            with self._errors():
                self._database.execute("PRAGMA hour.synchronous = OFF")
                self._database.execute(_FRAMES.format("hour.frames"))
            for sensor in sensors:
                for begin in range(hour * HOUR_US, (hour + 1) * HOUR_US, DROPPED_AT_ONCE_US):
                    with self._errors():
                        self._database.execute(
                            "INSERT INTO hour.frames SELECT * FROM main.frames "
                            "WHERE sensor = ? AND time_us >= ? AND time_us < ?",
                            (sensor, begin, begin + DROPPED_AT_ONCE_US),
                        )
                    time.sleep(TURN_S)
            with self._errors():
                rows = self._database.execute("SELECT DISTINCT pose FROM hour.frames").fetchall()
            return {pose for (pose,) in rows}
        finally:
            with self._errors():
                self._database.execute("DETACH hour")

    def drop_hour(self, hour: int, sensors: Sequence[str]) -> None:
        """Drop these sensors' frames of an hour: they are written elsewhere, and on disk."""
        for sensor in sensors:
            for begin in range(hour * HOUR_US, (hour + 1) * HOUR_US, DROPPED_AT_ONCE_US):
                with self._errors():
                    self._database.execute(
                        "DELETE FROM frames WHERE sensor = ? AND time_us >= ? AND time_us < ?",
                        (sensor, begin, begin + DROPPED_AT_ONCE_US),
                    )
                time.sleep(TURN_S)

    def sensors(self) -> list[str]:
        """Return the sensors of which frames are kept."""
        rows = self._database.execute("SELECT DISTINCT sensor FROM frames ORDER BY 1")
        return [sensor for (sensor,) in rows]

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            with self._lock:  # another thread may write an hour meanwhile
                yield
        except (sqlite3.Error, OSError, OverflowError) as error:
            reason = "the disk is full" if "full" in str(error) else str(error)
            raise OutputError(
                f"{self.path}: cannot be written: {reason}",
                hint="nothing is acknowledged meanwhile: frames wait at the sensors",
            ) from error
