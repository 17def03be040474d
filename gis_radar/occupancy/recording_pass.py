"""One pass over a recording: from its columns to hits, frame log and all else that is counted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.occupancy.counting_loop import POSE, TIME_US
from gis_radar.occupancy.folder import frames_of
from gis_radar.occupancy.frame_steps import FrameTimes, Runs, union
from gis_radar.occupancy.hit_counter import NO_TILES, Counted, HitCounter, rows_of_columns
from gis_radar.occupancy.hits import SortedTableWriter
from gis_radar.occupancy.placing import PoseNumbers
from gis_radar.occupancy.settings import Filters, OccupancySettings
from gis_radar.occupancy.views import PlacedRecording, ViewBook, places_of
from gis_radar.recordings.raw_rows import RawRows, read_raw
from gis_radar.recordings.recording import RangeCounts
from gis_radar.sight import MovementCounter, describe_sight
from gis_radar.steps import STEP_US, step_of
from gis_radar.tiles.lookup import TileEngine, TileGrid


@dataclass(frozen=True, kw_only=True)
class Target:
    """What detections are assigned to, the same for all recordings: tiles, views, filters."""

    fingerprint: str
    tile_id: Integers
    road_height: Floats
    engine: TileEngine
    views: ViewBook
    filters: Filters
    settings: OccupancySettings


@dataclass(kw_only=True)
class RecordingPass:
    """What one pass over a recording gives beside its hits.

    Parameters
    ----------
    source : PlacedRecording
        What was read.
    log : SortedTableWriter
        One row a frame, on disk.
    runs : dict
        Steps with a frame, by view.
    poses : set of int
        Poses of the track that were in force at a frame.
    times : FrameTimes
        First and last frame, and the gaps between frames.
    ranges : RangeCounts
        Ranges of all detections.
    rows : int
        Rows read.
    hits : int
        Frames on tiles: how often a tile was hit by a frame.
    level : bool
        Whether the sensor measures no elevation.
    movement : dict
        What moves on the tiles, by the view that the sensor had first where it stood.
    """

    source: PlacedRecording
    log: SortedTableWriter
    runs: dict[str, list[Runs]] = field(default_factory=dict)
    poses: set[int] = field(default_factory=set)
    times: FrameTimes = field(default_factory=FrameTimes)
    ranges: RangeCounts = field(default_factory=RangeCounts)
    rows: int = 0
    hits: int = 0
    level: bool = False
    movement: dict[str, MovementCounter] = field(default_factory=dict)

    @cached_property
    def places(self) -> Integers:
        """For each pose of the track the first one where the sensor stood then."""
        return places_of(self.source.track.poses)

    def movement_at(self, index: int, target: Target) -> MovementCounter:
        """Return what counts movement where the sensor stood at a pose of its track."""
        first = self.source.views[self.places[index]]
        return self.movement.setdefault(
            first, MovementCounter(tiles=target.views.road, engine=target.engine)
        )

    def note(self, frames: Integers, target: Target) -> None:
        """Add frames that follow those so far: rows as of :class:`Counted`."""
        if len(frames) == 0:
            return
        seen = np.zeros(len(frames), np.int64)
        for index in np.unique(frames[:, POSE]).tolist():
            now, view = frames[:, POSE] == index, self.source.views[index]
            step = frames[now, TIME_US] // STEP_US
            self.runs.setdefault(view, []).append(union([Runs(first=step, last=step)]))
            self.poses.add(index)
            seen[now] = len(target.views.tiles[view])
        time_us, shift_us, detections, moving, wild, hit, checksum = frames.T[:POSE]
        sensor = np.zeros(len(frames), np.int64)
        self.log.add((time_us, sensor, detections, moving, wild, hit, seen, checksum, shift_us))
        self.hits += int(hit.sum())
        self.times.add(time_us)

    def frames(self) -> pd.DataFrame:
        """Return the runs of steps with a frame, by view."""
        sensor = self.source.track.sensor
        return pd.concat([frames_of(sensor, view, union(runs)) for view, runs in self.runs.items()])

    def record(self, target: Target) -> dict[str, Any]:
        """Return the entry of the manifest for this recording, with the poses that it met."""
        return {
            **self.source.record(self.rows, self.poses),
            "filters": asdict(target.filters),
            "settings": asdict(target.settings),
            "sight": describe_sight(target.views.scan),
            **({"elevation": False} if self.level else {}),
        }


def count_recording(found: RecordingPass, target: Target) -> Iterator[Counted]:
    """Count a recording by the compiled loop; add rows, ranges and movement to `found`.

    Parameters
    ----------
    found : RecordingPass
        Its source is read.
    target : Target
        Its engine is a TileGrid.

    Yields
    ------
    Counted
        Complete frames and steps.
    """
    for counted in _count(found, target):
        index, frames = np.unique(counted.frames[:, POSE], return_counts=True)
        for each, count in zip(index.tolist(), frames.tolist(), strict=True):
            found.movement_at(each, target).frames += count
        yield counted


def _count(found: RecordingPass, target: Target) -> Iterator[Counted]:
    counter = HitCounter(
        target.views.road, cast("TileGrid", target.engine), filters=target.filters,
        settings=target.settings, tile_id=target.tile_id, ranges=found.ranges,
    )  # fmt: skip
    placed: dict[int, PoseNumbers] = {}
    track = found.source.track
    for raw in read_raw(found.source.recording, rcs=target.filters.min_rcs is not None):
        time, shift_us = _corrected(raw, found.source)
        rows = rows_of_columns(
            time, raw.x, raw.y, raw.z, raw.range_rate, raw.rcs, shift_us=shift_us
        )
        for index, begin, end in track.runs(time):
            if index not in placed:
                road_m = target.views.road_m[track.sensor, found.source.views[index]]
                pose = track.poses[index]
                placed[index] = PoseNumbers.of(pose, road_m=road_m, number=index)
            movement = found.movement_at(index, target).count
            yield from counter.add(rows, begin, end, placed[index], movement=movement)
        found.level |= raw.level
        found.rows += len(raw)
    yield from counter.end()


def _corrected(raw: RawRows, source: PlacedRecording) -> tuple[Floats, Integers]:
    """Return times by the reference's clock, and the microseconds added to them, if any."""
    if source.clock is None:
        return raw.time, NO_TILES
    time = source.clock.corrected(raw.time)
    step_of(time[[0, -1]])  # refuses what is outside of the known years
    return time, np.rint((time - raw.time) * 1e6).astype(np.int64)
