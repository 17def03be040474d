"""The store: a folder of hits an hour, from the frames of the journal."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd

from gis_radar.arrays import Integers
from gis_radar.errors import InputError
from gis_radar.files import atomic_folder, output_errors
from gis_radar.live.hits_folder.folder import (
    OWNED,
    StoredHits,
    merge_stored_hits,
    read_stored_hits,
    runs_of_frames,
    table_of_frames,
    table_of_views,
)
from gis_radar.live.hits_folder.streams import merge_distinct
from gis_radar.live.hits_folder.tables import merge_logs
from gis_radar.live.hits_folder.tile_sets import unpack_sets
from gis_radar.live.hours import HOUR_US, LIVE_RECORDING, hour_name
from gis_radar.live.journal import FrameRow
from gis_radar.live.payload import PoseContent
from gis_radar.measures.rows import Rows
from gis_radar.measures.validity import Runs, union
from gis_radar.steps import STEP_US


class StoredFrames(Protocol):
    """Frames on disk, such as the journal's."""

    @property
    def path(self) -> Path:
        """The file, for messages."""

    def frames(self, sensor: str, begin_us: int, end_us: int) -> Iterator[list[FrameRow]]:
        """Read the frames of a sensor in a time, the end left out, piece by piece."""

    def drop_hour(self, hour: int, sensors: Sequence[str]) -> None:
        """Drop these sensors' frames of an hour: they are written elsewhere, and on disk."""


@dataclass(frozen=True, kw_only=True)
class KnownPose:
    """A pose of a sensor as fusion knows it.

    Parameters
    ----------
    content : PoseContent
        As it was sent.
    view : str
        Name of what the sensor sees from it.
    """

    content: PoseContent
    view: str


@dataclass(frozen=True, kw_only=True)
class Store:
    """Where hours are written.

    Parameters
    ----------
    folder : Path
        It holds a folder an hour: `2026-11-23T07Z`.
    fingerprint : str
        Of the tiles.
    tile_id : (n,) int64 array
        Their ids.
    sight : dict or str
        As a manifest describes it.
    """

    folder: Path
    fingerprint: str
    tile_id: Integers
    sight: Any

    def path_of(self, hour: int) -> Path:
        """Return the folder of an hour since 1970."""
        return self.folder / hour_name(hour)

    def write_hour(
        self, hour: int, journal: StoredFrames, poses: Mapping[int, KnownPose],
        tiles: Mapping[str, Integers], sensors: Sequence[str],
    ) -> Path | None:  # fmt: skip
        """Write the frames of an hour, added to those that are there; then drop them.

        Killed at any moment, it is done again and gives the same: all tables are sets.

        Parameters
        ----------
        hour : int
            Since 1970.
        journal : Journal
            With the frames.
        poses : mapping
            By id of their rows in the journal.
        tiles : mapping
            Ids of the tiles by name of view.
        sensors : sequence of str
            Those whose frames are written; the journal keeps what others sent.

        Raises
        ------
        OutputError
            If it cannot be written; the journal then keeps the frames.
        """
        found = _Hour(self, hour, journal, poses, tiles)
        with_frames = [sensor for sensor in sorted(sensors) if found.read(sensor)]
        path = self.path_of(hour)
        if not with_frames:
            return None
        hits_folder = found.hits_folder(with_frames)
        if path.exists():
            hits_folder = merge_stored_hits([read_stored_hits(path), hits_folder])
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_folder(path, owned=OWNED) as part:
            hits_folder.write(part)
            for file in part.iterdir():
                _sync(file)
            _sync(part)
        _sync(self.folder)
        journal.drop_hour(hour, with_frames)
        return path


class _Hour:
    """The frames of an hour, as the tables of a folder of hits."""

    def __init__(
        self, store: Store, hour: int, journal: StoredFrames, poses: Mapping[int, KnownPose],
        tiles: Mapping[str, Integers],
    ) -> None:  # fmt: skip
        self._store, self._journal, self._poses, self._tiles = store, journal, poses, tiles
        self._span = (hour * HOUR_US, (hour + 1) * HOUR_US)
        self._steps: dict[tuple[str, str], list[Runs]] = {}
        self._met: dict[str, list[int]] = {}

    def read(self, sensor: str) -> bool:
        """Find the steps and poses of a sensor's frames; return whether it has any."""
        met: dict[int, None] = {}
        for rows in self._journal.frames(sensor, *self._span):
            pose = np.array([row.pose for row in rows])
            step = np.array([row.time_us for row in rows]) // STEP_US
            for each in np.unique(pose).tolist():
                met[each] = None
                steps = step[pose == each]
                key = (sensor, self._poses[each].view)
                self._steps.setdefault(key, []).append(union([Runs(first=steps, last=steps)]))
        self._met[sensor] = sorted(met)
        return bool(met)

    def hits_folder(self, sensors: Sequence[str]) -> StoredHits:
        """Return the hour's hit share; its hits are read when they are asked for."""
        frames = table_of_frames(
            pd.concat([runs_of_frames(*key, union(runs)) for key, runs in self._steps.items()])
        )
        return StoredHits(
            fingerprint=self._store.fingerprint,
            frames=frames,
            views=table_of_views(frames, dict(self._tiles)),
            hits_by_sensor=lambda names: merge_distinct(
                [self._hits(sensor, names.index(sensor)) for sensor in sensors], 3
            ),
            frame_log=lambda names: merge_logs(
                [self._log(sensor, names.index(sensor)) for sensor in sensors]
            ),
            sources=[self._source(sensor) for sensor in sensors],
            validity_s={
                sensor: self._poses[self._met[sensor][-1]].content.validity_s for sensor in sensors
            },
        )

    def _source(self, sensor: str) -> dict[str, Any]:
        met = [self._poses[each].content for each in self._met[sensor]]
        distinct = {json.dumps(each.pose, sort_keys=True): each.pose for each in met}
        return {
            "recording": LIVE_RECORDING,
            "rows": 0,
            "sensor": sensor,
            "poses": list(distinct.values()),
            "filters": met[-1].filters,
            "settings": met[-1].settings,
            "sight": self._store.sight,
        }

    def _pieces(self, sensor: str) -> Iterator[tuple[list[FrameRow], Integers, Integers]]:
        """Yield frames, the positions of all their tiles, and how many each has."""
        for rows in self._journal.frames(sensor, *self._span):
            sizes = np.cumsum([0, *(len(row.tiles) for row in rows)])
            data = np.frombuffer(b"".join(row.tiles for row in rows), np.uint8)
            tiles, begins = unpack_sets(data, sizes, what=str(self._journal.path))
            if len(tiles) and tiles.max() >= len(self._store.tile_id):
                last, count = int(tiles.max()), len(self._store.tile_id)
                raise InputError(f"{self._journal.path}: damaged: names tile {last} of {count}")
            yield rows, tiles, np.diff(begins)

    def _hits(self, sensor: str, number: int) -> Iterator[Rows]:
        for rows, tiles, count in self._pieces(sensor):
            step = np.array([row.time_us for row in rows]) // STEP_US
            yield np.repeat(step, count), self._store.tile_id[tiles], np.full(len(tiles), number)

    def _log(self, sensor: str, number: int) -> Iterator[Rows]:
        for rows, _, count in self._pieces(sensor):
            columns = np.array(
                [(r.time_us, r.pose, r.detections, r.moving, r.wild, r.checksum) for r in rows],
                np.int64,
            ).T
            seen = {
                pose: len(self._tiles[self._poses[pose].view]) for pose in set(columns[1].tolist())
            }
            tiles_seen = np.array([seen[pose] for pose in columns[1].tolist()], np.int64)
            none = np.zeros(len(rows), np.int64)
            yield (
                columns[0], none + number, *columns[2:5], count, tiles_seen, columns[5], none,
            )  # fmt: skip


def _sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk."""
    with output_errors(path):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
