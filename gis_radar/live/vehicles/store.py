"""What following vehicles keeps on disk: detections of the last minutes, and vehicles of the hour.

One SQLite file beside the journal. Detections are not acknowledged to sensors: what a kill takes
are those of the last second. A block and the detections that it makes needless go in one commit, so
that no vehicle counts twice.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.errors import GisRadarError, OutputError
from gis_radar.live.database import as_one, damage_of, is_damage
from gis_radar.measures.views import name_of_view
from gis_radar.poses.pose import pose_from_dict
from gis_radar.steps import STEP_US
from gis_radar.tracking.batches import BlockEdge, VehicleBatch
from gis_radar.tracking.tables import FRAMES, TRACKS, VEHICLES, TableKind
from gis_radar.tracking.visibility import SensorView

FARTHEST_M, LONGEST_M = 1e9, 1e3  # of places in a map, and of vehicles
LOCK_S = 5.0  # for another program to let go of the file
_SCHEMA = """
CREATE TABLE IF NOT EXISTS notes (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS views (sensor TEXT, view TEXT, tiles BLOB NOT NULL,
    easting REAL NOT NULL, northing REAL NOT NULL, height REAL NOT NULL, road_m REAL,
    PRIMARY KEY (sensor, view)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS poses (id INTEGER PRIMARY KEY, sensor TEXT NOT NULL, view TEXT NOT NULL,
    validity_s REAL NOT NULL, content TEXT NOT NULL, UNIQUE (sensor, view, validity_s, content));
CREATE TABLE IF NOT EXISTS frames (time_us INTEGER, sensor TEXT, pose INTEGER NOT NULL,
    content BLOB NOT NULL, PRIMARY KEY (time_us, sensor)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS pieces (first_step INTEGER PRIMARY KEY, last_step INTEGER NOT NULL,
    tracks BLOB NOT NULL, vehicles BLOB NOT NULL, frames BLOB NOT NULL, poses TEXT NOT NULL,
    edge BLOB NOT NULL, found INTEGER NOT NULL);
"""
_COLUMNS = {
    "notes": ("name", "value"),
    "views": ("sensor", "view", "tiles", "easting", "northing", "height", "road_m"),
    "poses": ("id", "sensor", "view", "validity_s", "content"),
    "frames": ("time_us", "sensor", "pose", "content"),
    "pieces": (
        "first_step", "last_step", "tracks", "vehicles", "frames", "poses", "edge", "found",
    ),
}  # fmt: skip
_SOUND = {  # steps up to the year 2150, pieces of an hour at most
    "notes": "typeof(name) = 'text' AND typeof(value) = 'text'",
    "views": "typeof(sensor) = 'text' AND typeof(view) = 'text' AND typeof(tiles) = 'blob' AND "
    "length(tiles) % 8 = 0 AND typeof(coalesce(road_m, 0.0)) = 'real' AND "
    "abs(coalesce(road_m, 0.0)) < 1e9 AND typeof(easting) = 'real' AND abs(easting) < 1e9 AND "
    "typeof(northing) = 'real' AND abs(northing) < 1e9 AND typeof(height) = 'real' AND "
    "abs(height) < 1e9",
    "poses": "typeof(sensor) = 'text' AND typeof(view) = 'text' "
    "AND typeof(validity_s) = 'real' AND "
    "validity_s > 0 AND validity_s < 1e4 AND typeof(content) = 'text' AND "
    "json_type(content) = 'object' AND "
    "(sensor, view) IN (SELECT sensor, view FROM views)",
    "frames": "typeof(time_us) = 'integer' AND typeof(sensor) = 'text' AND "
    "typeof(pose) = 'integer' AND typeof(content) = 'blob'",
    "pieces": "first_step BETWEEN 0 AND 113605632000 AND typeof(last_step) = 'integer' AND "
    "last_step BETWEEN first_step AND first_step + 72000 AND "
    "typeof(found) = 'integer' AND found >= 0 AND json_type(poses) = 'array' AND NOT EXISTS "
    "(SELECT 1 FROM json_each(pieces.poses) AS each WHERE each.value NOT IN (SELECT id FROM poses)"
    " OR each.type != 'integer')",
}
_OLD_POSES = """
DELETE FROM poses WHERE id NOT IN (SELECT value FROM json_each(?))
    AND id NOT IN (SELECT pose FROM frames)
    AND id NOT IN (SELECT value FROM pieces, json_each(pieces.poses))
"""
_OLD_VIEWS = "DELETE FROM views WHERE (sensor, view) NOT IN (SELECT sensor, view FROM poses)"


class DetectionRow(NamedTuple):
    """A frame of detections; `pose` is the id of its row, `content` that of a message."""

    time_us: int
    sensor: str
    pose: int
    content: bytes


@dataclass(frozen=True, kw_only=True)
class FollowedPose:
    """A pose of a sensor by which vehicles are followed.

    Parameters
    ----------
    sensor, view : str
        Whose, and the name of what it sees.
    validity_s : float
        How long a frame is valid, seconds.
    content : dict
        As a pose file holds it.
    """

    sensor: str
    view: str
    validity_s: float
    content: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class StoredBatch:
    """Vehicles of a block, with the ids of the poses by which they were seen."""

    batch: VehicleBatch
    poses: tuple[int, ...]


class VehicleStore:
    """Detections and vehicles on disk; safe to use from several threads.

    Parameters
    ----------
    path : Path
        The file; made where there is none.
    fingerprint : str
        Of the tiles; what speaks of others is dropped.

    Attributes
    ----------
    put_aside : Path or None
        Where a file went that is damaged; a new one is begun.

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path, *, fingerprint: str) -> None:
        self.path, self._lock = path, RLock()
        self.put_aside: Path | None = None
        with self._errors():
            if self._open() or self._damaged():
                self._put_aside()
            known = self._database.execute("SELECT value FROM notes").fetchone()
            if known != (fingerprint,):
                with as_one(self._database):
                    for table in ("notes", "views", "poses", "frames", "pieces"):
                        self._database.execute(f"DELETE FROM {table}")  # noqa: S608 - own names
                    row = ("fingerprint", fingerprint)
                    self._database.execute("INSERT INTO notes VALUES (?, ?)", row)

    def _open(self) -> bool:
        """Open the file; return whether it is damaged."""
        self._database = sqlite3.connect(
            self.path, isolation_level=None, timeout=LOCK_S, check_same_thread=False
        )
        try:
            self._database.executescript(
                "PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL;" + _SCHEMA
            )
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if isinstance(error, sqlite3.Error) and not is_damage(error):
                raise
            return True
        return False

    def _damaged(self) -> bool:
        """Return whether something in the file cannot be read: all of it is read once."""
        if damage_of(self._database, _COLUMNS, _SOUND):
            return True
        try:
            self.edge()
            for pose in self.poses().values():
                pose_from_dict(pose.content, what=f"the pose of {pose.sensor}")
            views = [view for view, _ in self.views()]
            if any(view.view != name_of_view(view.tile_id) for view in views):
                return True
            named = {(view.sensor, view.view) for view in views}
            return not all(_is_sound(each.batch, named) for each in self.batches(-(2**62), 2**62))
        except (GisRadarError, pa.ArrowException, ValueError, TypeError, LookupError,
                ArithmeticError):  # fmt: skip
            return True

    def _put_aside(self) -> None:
        """Keep the file under another name, with its log, and begin a new one."""
        self._database.close()
        self.put_aside = self.path.with_name(f"{self.path.name}.{secrets.token_hex(4)}")
        self.path.rename(self.put_aside)
        with suppress(FileNotFoundError):  # it would be read into the new file
            log = self.path.with_name(f"{self.path.name}-wal")
            log.rename(self.put_aside.with_name(f"{self.put_aside.name}-wal"))
        self.path.with_name(f"{self.path.name}-shm").unlink(missing_ok=True)
        self._open()

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._database.close()

    def add_view(self, view: SensorView, road_m: float) -> None:
        """Add what a sensor sees, and the height of the road near it."""
        row = (view.sensor, view.view, view.tile_id.astype("<i8").tobytes(),
               *map(float, view.position), None if np.isnan(road_m) else road_m)  # fmt: skip
        with self._errors():
            self._database.execute("INSERT OR REPLACE INTO views VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def views(self) -> list[tuple[SensorView, float]]:
        """Return what sensors see, with the height of the road near them (NaN: not known)."""
        with self._lock:
            rows = self._database.execute("SELECT * FROM views").fetchall()
        return [
            (
                SensorView(
                    sensor=sensor, view=view, tile_id=np.frombuffer(tiles, "<i8").astype(np.int64),
                    position=np.array(place),
                ),
                np.nan if road_m is None else road_m,
            )
            for sensor, view, tiles, *place, road_m in rows
        ]  # fmt: skip

    def add_pose(self, pose: FollowedPose) -> int:
        """Add a pose; return its id, that of the same one where it is known."""
        row = (pose.sensor, pose.view, pose.validity_s, json.dumps(pose.content, sort_keys=True))
        with self._errors():
            self._database.execute(
                "INSERT OR IGNORE INTO poses (sensor, view, validity_s, content) "
                "VALUES (?, ?, ?, ?)",
                row,
            )
            (found,) = self._database.execute(
                "SELECT id FROM poses "
                "WHERE sensor = ? AND view = ? AND validity_s = ? AND content = ?",
                row,
            ).fetchone()
        return int(found)

    def poses(self) -> dict[int, FollowedPose]:
        """Return all poses by id."""
        with self._lock:
            rows = self._database.execute("SELECT * FROM poses").fetchall()
        return {
            row[0]: FollowedPose(
                sensor=row[1], view=row[2], validity_s=row[3], content=json.loads(row[4])
            )
            for row in rows
        }

    def forget_poses(self, kept: Sequence[int]) -> None:
        """Drop poses but some that no frame or piece names, and what is seen from no pose."""
        with self._errors(), as_one(self._database):
            self._database.execute(_OLD_POSES, (json.dumps([*kept]),))
            self._database.execute(_OLD_VIEWS)

    def add_frames(
        self, rows: Sequence[DetectionRow], anew: Mapping[str, int] | None = None
    ) -> None:
        """Add frames; one that is there is the same.

        Parameters
        ----------
        rows : sequence of DetectionRow
            The frames.
        anew : mapping
            By sensor, from when on what is there is dropped first, as one (us).
        """
        with self._errors(), as_one(self._database):
            for sensor, since_us in (anew or {}).items():
                self._database.execute(
                    "DELETE FROM frames WHERE sensor = ? AND time_us >= ?", (sensor, since_us)
                )
            self._database.executemany("INSERT OR IGNORE INTO frames VALUES (?, ?, ?, ?)", rows)

    def seconds(self) -> Iterator[list[DetectionRow]]:
        """Yield all frames by time, those of a second at once."""
        begin: int | None = -(2**62)
        while begin is not None:
            with self._lock:
                (begin,) = self._database.execute(
                    "SELECT min(time_us) FROM frames WHERE time_us >= ?", (begin,)
                ).fetchone()
                rows = self._database.execute(
                    "SELECT * FROM frames WHERE time_us BETWEEN ? AND ? + 999999", (begin, begin)
                ).fetchall()
            if begin is not None:
                yield [DetectionRow(*row) for row in rows]
                begin += 1_000_000

    def drop_from(self, step: int) -> None:
        """Drop all frames and pieces from a step on, as one."""
        with self._errors(), as_one(self._database):
            self._database.execute("DELETE FROM frames WHERE time_us >= ?", (step * STEP_US,))
            self._database.execute("DELETE FROM pieces WHERE first_step >= ?", (step,))

    def add_batch(
        self, found: StoredBatch, edge: BlockEdge, *, needed_us: int, kept_step: int
    ) -> None:
        """Add the vehicles of a block; drop frames and pieces that nobody needs any more."""
        batch = found.batch
        row = (
            batch.first_step, batch.last_step, _packed(TRACKS, batch.tracks),
            _packed(VEHICLES, batch.vehicles), _packed(FRAMES, batch.frames),
            json.dumps(found.poses), json.dumps(edge.table.to_numpy().tolist()).encode(),
            edge.found,
        )  # fmt: skip
        with self._errors(), as_one(self._database):
            self._database.execute(
                "INSERT OR REPLACE INTO pieces VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row
            )
            self._database.execute("DELETE FROM frames WHERE time_us < ?", (needed_us,))
            self._database.execute("DELETE FROM pieces WHERE last_step < ?", (kept_step,))

    def edge(self) -> BlockEdge | None:
        """Return where the last block ended; None where there is none."""
        with self._lock:
            row = self._database.execute(
                "SELECT last_step, found, edge FROM pieces ORDER BY first_step DESC LIMIT 1"
            ).fetchone()
        if row is None:
            return None
        table = pd.DataFrame(json.loads(row[2]), columns=[*BlockEdge.COLUMNS])
        if not np.isfinite(table.to_numpy(np.float64)).all():
            raise ValueError("an edge with what is no number")
        return BlockEdge(step=row[0], found=row[1], table=table)

    def batch_hours(self, steps: int) -> list[int]:
        """Return the hours in which pieces begin, each of so many steps, ascending."""
        query = "SELECT DISTINCT first_step / ? FROM pieces ORDER BY 1"
        with self._lock:
            return [hour for (hour,) in self._database.execute(query, (steps,))]

    def batches(self, first: int, last: int) -> Iterator[StoredBatch]:
        """Read the batches that begin from one step to another, in order."""
        with self._lock:
            steps = self._database.execute(
                "SELECT first_step FROM pieces WHERE first_step BETWEEN ? AND ? ORDER BY 1",
                (first, last),
            ).fetchall()
        for (step,) in steps:
            with self._lock:
                row = self._database.execute(
                    "SELECT last_step, tracks, vehicles, frames, poses FROM pieces "
                    "WHERE first_step = ?", (step,)
                ).fetchone()  # fmt: skip
            if row is None:
                continue
            tables = map(_unpacked, (TRACKS, VEHICLES, FRAMES), row[1:4])
            tracks, vehicles, frames = tables
            batch = VehicleBatch(
                first_step=step, last_step=row[0], tracks=tracks, vehicles=vehicles, frames=frames
            )
            yield StoredBatch(batch=batch, poses=tuple(json.loads(row[4])))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        with self._lock:
            try:
                yield
            except (sqlite3.Error, OSError) as error:
                raise OutputError(
                    f"{self.path}: cannot be written: {error}",
                    hint="vehicles of this time may be missing",
                ) from error


def _is_sound(batch: VehicleBatch, views: set[tuple[str, str]]) -> bool:
    """Return whether the tables of a batch fit to it and to each other."""
    tracks, vehicles, frames = batch.tracks, batch.vehicles, batch.frames
    inside = tracks["step"].between(batch.first_step, batch.last_step)
    numbers = tracks[["easting", "northing", "heading", "speed"]]
    sizes = vehicles[["length_m", "width_m", "p_heavy"]]
    return bool(
        inside.all()
        and vehicles["vehicle"].is_unique
        and tracks["vehicle"].isin(vehicles["vehicle"]).all()
        and not tracks.duplicated(["step", "vehicle"]).any()
        and (numbers.abs() < FARTHEST_M).all(axis=None)
        and (sizes.abs() < LONGEST_M).all(axis=None)
        and {*zip(frames["sensor"], frames["view"], strict=True)} <= views
        and frames["first_step"].between(batch.first_step, frames["last_step"]).all()
        and (frames["last_step"] <= batch.last_step).all()
    )


def _packed(kind: TableKind, table: pd.DataFrame) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(kind.to_arrow(kind.typed(table)), sink, compression="zstd")
    return bytes(sink.getvalue().to_pybytes())


def _unpacked(kind: TableKind, content: bytes) -> pd.DataFrame:
    table = pq.read_table(pa.BufferReader(content), schema=kind.schema)
    return kind.typed(table.to_pandas(types_mapper={pa.int64(): pd.Int64Dtype()}.get))
