"""Recordings at fusion, made from the spool, one for each hour and sensor.

A recording begins and ends two minutes after the full hour, so that an hour of the dataset has all
its inputs once its recording is added, and is made once. Until then parts of the recording wait
beside it. It holds each frame once, in the order of time, whenever and however often it arrived.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.base import (
    QUIET,
    ROWS_IN_GROUP,
    STEP_US,
    InputError,
    Integers,
    Reporter,
    Text,
    output_errors,
    step_begin,
)
from gis_radar.dataset import replacing
from gis_radar.live.hours.spool import FRAMES_RECORD, POSE_RECORD, SpoolFile
from gis_radar.live.wire.detections import FrameDetections, unpack_detections
from gis_radar.live.wire.payload import PoseContent, key_of_pose, unpack_message
from gis_radar.measures import HOUR_MARGIN_STEPS, FrameIndex
from gis_radar.poses import PoseTrack, pose_from_dict, read_track
from gis_radar.recordings import open_recording

HOUR_US = 3_600_000_000
HOUR_OFFSET_US = HOUR_MARGIN_STEPS * STEP_US  # from a full hour to begin and end of recordings
RECORDINGS_FOLDER, PARTS_FOLDER = "recordings", "parts"
_FRAMES_AT_ONCE = 20_000  # most frames of a sensor in memory: a quarter of an hour
_REPEATED = ["time", "z", "range_rate", "rcs", "pose"]  # columns with few values, as sent
_POSES = b"gis_radar.poses"  # key of the file's metadata
_SCHEMA = pa.schema(
    [("time", pa.float64()), *((name, pa.float32()) for name in ("x", "y", "z")),
     ("range_rate", pa.float32()), ("rcs", pa.float32()), ("pose", pa.string())]
)  # fmt: skip


def hour_of_time(time_us: int) -> int:
    """Return the hour since 1970 whose recording holds a time."""
    return (time_us - HOUR_OFFSET_US) // HOUR_US


def end_of_hour_s(hour: int) -> float:
    """Return the end of the recording of an hour, UNIX seconds."""
    return ((hour + 1) * HOUR_US + HOUR_OFFSET_US) / 1e6


def name_of_time(time_us: int) -> str:
    """Format a time for names of files, such as 20261123T0702Z."""
    return f"{datetime.fromtimestamp(time_us / 1e6, tz=UTC):%Y%m%dT%H%MZ}"


def time_of_name(name: str) -> int:
    """Return the time in a name of :func:`name_of_time`, microseconds since 1970."""
    parsed = datetime.strptime(name, "%Y%m%dT%H%MZ").replace(tzinfo=UTC)
    return round(parsed.timestamp() * 1e6)


def name_of_hour(hour: int) -> str:
    """Return the name of the recordings of an hour: the time of their begin."""
    return name_of_time(hour * HOUR_US + HOUR_OFFSET_US)


def recording_path(folder: Path, sensor: str, hour: int) -> Path:
    """Return the path of the recording of an hour."""
    return folder / RECORDINGS_FOLDER / sensor / f"{name_of_hour(hour)}.parquet"


def parts_of_hour(folder: Path, sensor: str, hour: int) -> list[Path]:
    """Return the parts that are not joined to a recording yet, in the order of arrival."""
    return sorted((folder / PARTS_FOLDER / sensor).glob(f"{name_of_hour(hour)}.*.parquet"))


def waiting_hours(folder: Path) -> set[int]:
    """Return the hours with waiting parts."""
    found = set()
    for path in (folder / PARTS_FOLDER).glob("*/*.*.parquet"):
        with suppress(ValueError):
            found.add(hour_of_time(time_of_name(path.name.partition(".")[0])))
    return found


def make_parts(folder: Path, spooled: Path, reporter: Reporter = QUIET) -> None:
    """Make parts of recordings from a file of the spool, then remove it; rename a damaged one.

    If it is killed at any moment, the next call gives the same parts.

    Raises
    ------
    OutputError
        If they cannot be written; the file then stays.
    """
    file = SpoolFile(spooled)
    for sensor, begins in file.by_sensor().items():
        poses: dict[str, Any] = {}
        numbers: dict[int, int] = {}
        for rows in _frames(file, begins, poses):
            hours = np.array([hour_of_time(each.time_us) for each, _ in rows])
            for hour in np.unique(hours).tolist():
                of_hour = [row for row, of in zip(rows, hours.tolist(), strict=True) if of == hour]
                numbers[hour] = numbers.get(hour, -1) + 1
                name = f"{name_of_hour(hour)}.{spooled.stem}-{numbers[hour]:04d}.parquet"
                path = folder / PARTS_FOLDER / sensor / name
                table, differing = _table(of_hour)
                _write(path, table, poses)
                _warn_of_differing(sensor, differing, path, reporter)
    with output_errors(spooled):
        if file.damaged:
            renamed = spooled.replace(spooled.with_suffix(".damaged"))
            reporter.warn(
                "{}: damaged records are left out; the file is kept as {}", spooled, renamed
            )
        else:
            spooled.unlink()


def _frames(
    file: SpoolFile, begins: Sequence[int], poses: dict[str, Any]
) -> Iterator[list[tuple[FrameDetections, str]]]:
    """Yield the frames of a sensor with the keys of their poses, some at a time."""
    rows: list[tuple[FrameDetections, str]] = []
    for begin in begins:
        record = file.at(begin)
        if record is None:
            continue
        if record.kind == POSE_RECORD:
            key = key_of_pose(record.payload).hex()
            poses[key] = PoseContent.unpack(record.payload).pose
        elif record.kind == FRAMES_RECORD:
            pose, frames = unpack_detections(unpack_message(record.payload)[1])
            if pose.hex() in poses:
                rows += [(each, pose.hex()) for each in frames]
            else:  # the record of its pose is damaged
                file.damaged = True
        if len(rows) >= _FRAMES_AT_ONCE:
            yield rows
            rows = []
    if rows:
        yield rows


def _warn_of_differing(sensor: str, count: int, path: Path, reporter: Reporter) -> None:
    """Warn of frames that were left out for another of the same time."""
    if count:
        reporter.warn(
            "{}: {:,} frames differ from others of the same time and are left out of {}: "
            "has another program the same name?",
            sensor,
            count,
            path.name,
        )


def _table(rows: Sequence[tuple[FrameDetections, str]]) -> tuple[pa.Table, int]:
    """Return frames as rows of a recording in the order of time, and how many were left out.

    Of frames with one time the first is taken; those that differ from it are counted.
    """
    known: dict[int, tuple[FrameDetections, str]] = {}
    differing = 0
    for row in rows:
        first, _ = known.setdefault(row[0].time_us, row)
        differing += not np.array_equal(first.points, row[0].points)
    ordered = [known[time_us] for time_us in sorted(known)]
    frames = [each.as_rows() for each, _ in ordered]
    points = np.concatenate([each.points for each in frames])
    columns = [
        np.concatenate([each.time for each in frames]), *points.T,
        np.concatenate([each.range_rate for each in frames]),
        np.concatenate([each.rcs for each in frames]),
    ]  # fmt: skip
    sizes = [len(each) for each in frames]
    pose = np.repeat(np.array([pose for _, pose in ordered], object), sizes)
    arrays = [
        pa.array(values, field.type)
        for values, field in zip([*columns, pose], _SCHEMA, strict=True)
    ]
    return pa.Table.from_arrays(arrays, schema=_SCHEMA), differing


def _write(path: Path, table: pa.Table, poses: dict[str, Any]) -> None:
    """Write a table of rows whole or not at all, and flush it to the disk."""
    named = {key: poses[key] for key in sorted(table["pose"].unique().to_pylist())}
    with output_errors(path), replacing(path) as fresh:
        pq.write_table(
            table.replace_schema_metadata({_POSES: json.dumps(named, sort_keys=True)}),
            fresh, compression="zstd", row_group_size=ROWS_IN_GROUP,
            use_dictionary=_REPEATED, use_byte_stream_split=["x", "y"],
        )  # fmt: skip


class JoinedRows:
    """Rows of a sensor from several files, each frame once.

    Parameters
    ----------
    paths : sequence of Path
        Recordings and parts: of two frames of one time that of the earlier file is taken.
    begin_us, end_us : int
        Microseconds since 1970: begin and exclusive end of the frames.

    Attributes
    ----------
    differing : int
        Number of frames left out, as another of the same time has other detections.
    """

    def __init__(self, paths: Sequence[Path], begin_us: int = 0, end_us: int = 1 << 62) -> None:
        self.poses: dict[str, Any] = {}
        self.differing = 0
        tables: list[pa.Table] = []
        known: dict[int, int] = {}
        for path in paths:
            with pq.ParquetFile(path) as file:
                table = file.read()
                self.poses |= json.loads(file.schema_arrow.metadata[_POSES])
            frames = FrameIndex.of(table["time"].to_numpy())
            sums = _frame_sums(table, frames)
            times = frames.time_us.tolist()
            keep = np.array([t not in known and begin_us <= t < end_us for t in times])
            pairs = zip(times, sums.tolist(), strict=True)
            self.differing += sum(known.get(t, check) != check for t, check in pairs)
            known |= {t: c for t, c in zip(times, sums.tolist(), strict=True) if t not in known}
            tables.append(table.filter(pa.array(keep[frames.of_row])))
        merged = pa.concat_tables(tables).combine_chunks()
        order = np.argsort(merged["time"].to_numpy(), kind="stable")
        self.table = merged if (np.diff(order) == 1).all() else merged.take(pa.array(order))

    def write(self, path: Path) -> PoseTrack:
        """Write the rows as a recording, and the sensor's poses beside it; return the poses."""
        _write(path, self.table, self.poses)
        track = self._track(path.parent.name)
        is_single = len(track.poses) == 1
        named = path.with_suffix(".json" if is_single else ".csv")
        if is_single:
            track.poses[0].write(named)
        else:
            track.write(named)
        path.with_suffix(".csv" if is_single else ".json").unlink(missing_ok=True)
        return read_track(named)

    def _track(self, sensor: str) -> PoseTrack:
        """Return the poses in force: each from the step of the first frame that names it."""
        frames = FrameIndex.of(self.table["time"].to_numpy())
        keys = self.table["pose"].take(pa.array(frames.begins)).to_pylist()
        poses, since, last = [], list[int](), None
        for key, step in zip(keys, (frames.time_us // STEP_US).tolist(), strict=True):
            if key != last and (not since or step > since[-1]):
                poses.append(pose_from_dict(self.poses[key], what=Text("the pose of {}", sensor)))
                since.append(step)
                last = key
        times = np.array([step_begin(step).timestamp() for step in since])
        return PoseTrack(poses=tuple(poses), since=times)


def _frame_sums(table: pa.Table, frames: FrameIndex) -> Integers:
    """Return a check sum of each frame's positions, by which two frames of one time differ."""
    x, y = (table[name].to_numpy().view(np.uint32).astype(np.int64) for name in ("x", "y"))
    return np.asarray(np.add.reduceat(x + 31 * y, frames.begins))


def join_parts(folder: Path, sensor: str, hour: int, reporter: Reporter) -> Path | None:
    """Join the parts of an hour into its recording; return it, None where there is none.

    Raises
    ------
    OutputError
        If it cannot be written; the parts then stay.
    """
    path, parts = recording_path(folder, sensor, hour), parts_of_hour(folder, sensor, hour)
    existing = [path] if path.exists() else []
    if not parts:
        return path if existing else None
    rows = JoinedRows([*existing, *parts])
    _warn_of_differing(sensor, rows.differing, path, reporter)
    rows.write(path)
    for each in parts:
        with output_errors(each):
            each.unlink()
    try:
        for _ in open_recording(path).read():
            pass
    except InputError as error:
        renamed = path.with_suffix(".refused")
        reporter.warn("{}: put aside as {}", error.message, renamed.name)
        path.replace(renamed)
        return None
    return path


def track_beside(path: Path) -> PoseTrack:
    """Read the pose track beside a recording."""
    single = path.with_suffix(".json")
    return read_track(single if single.exists() else path.with_suffix(".csv"))


def remove_old(
    folder: Path, *, keep_s: float, most_bytes: float, reporter: Reporter,
    is_needed: Callable[[Path], bool] = lambda _: False,
) -> None:  # fmt: skip
    """Remove recordings that are old and not needed, or exceed the room, the oldest first."""
    paths = sorted((folder / RECORDINGS_FOLDER).glob("*/*.parquet"), key=lambda each: each.name)
    sizes = {each: each.stat().st_size for each in paths}
    before = name_of_time(int((time.time() - keep_s) * 1e6))
    newest = {each.name for each in paths[-1:]}
    total, removed_early = sum(sizes.values()), 0
    for path in paths:
        full = total > most_bytes and path.name not in newest
        if path.name >= before and not full:
            break
        needed = is_needed(path)
        if needed and not full:
            continue
        removed_early += needed or path.name >= before
        total -= sizes[path]
        for each in (path, path.with_suffix(".json"), path.with_suffix(".csv")):
            with output_errors(each):
                each.unlink(missing_ok=True)
    if removed_early:
        reporter.warn(
            "{}: {} recordings are removed before their time, as they take over {:g} GB",
            folder / RECORDINGS_FOLDER,
            removed_early,
            most_bytes / 1000000000.0,
        )
