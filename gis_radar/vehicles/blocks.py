"""Recordings of all sensors, read side by side in blocks of time that overlap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from gis_radar.clocks import SensorClock
from gis_radar.errors import InputError
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.occupancy.folder import frames_of, frames_table
from gis_radar.occupancy.frame_log import rows_of, whole_frames
from gis_radar.occupancy.frame_steps import Runs, union
from gis_radar.poses.files import PoseTrack
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Detections, Recording
from gis_radar.steps import STEPS_PER_SECOND, step_of
from gis_radar.vehicles.echoes import Echoes, echoes_of
from gis_radar.vehicles.settings import BlockSettings, VehicleSettings
from gis_radar.vehicles.tables import FRAMES

STAGE = "vehicles"


@dataclass(frozen=True, kw_only=True)
class PlacedRecording:
    """A recording with what is known of its sensor.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        What is read, and where its sensor stood.
    views : sequence of str
        The view of each pose of the track.
    number : int
        Of the sensor.
    clock : SensorClock, optional
        How far the sensor's clock is ahead.
    """

    recording: Recording
    track: PoseTrack
    views: Sequence[str]
    number: int
    clock: SensorClock | None


@dataclass(frozen=True, kw_only=True)
class Block:
    """Detections around a span of steps, with the frames in it.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive.
    echoes : Echoes
        Of the span and so much before and after as vehicles need to be known by.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps with a frame, in the span.
    begins, ends : bool
        Whether it is the first and the last block.
    """

    first_step: int
    last_step: int
    echoes: Echoes
    frames: pd.DataFrame
    begins: bool
    ends: bool


@dataclass(kw_only=True)
class _Read:
    """What was read of one recording so far."""

    source: PlacedRecording
    rows: int = 0
    unread: int = 0
    poses: set[int] = field(default_factory=set)
    rates: int = 0

    def record(self) -> dict[str, Any]:
        """Return the entry of the manifest, with the poses that it met."""
        track, met = self.source.track, sorted(self.poses)
        poses = track.poses[met[0] : met[-1] + 1] if met else track.poses[:1]
        clock = self.source.clock
        return {
            "recording": self.source.recording.path.name,
            "rows": self.rows,
            "sensor": track.sensor,
            "poses": [pose.as_dict() for pose in poses],
            **({} if clock is None else {"clock": clock.as_dict()}),
        }


_Opened: TypeAlias = tuple[float, int, _Read, Detections, Iterator[Detections]]


class SourceReader:
    """All recordings, read in blocks.

    Parameters
    ----------
    sources : sequence of PlacedRecording
        In any order; those of one sensor are read as one, what two of them hold of the same time
        once.
    graph : LaneGraph
        The lanes.
    road_m : dict
        By view, the height of the road near the sensor: where one without elevation looks.
    settings : VehicleSettings
        Of echoes and blocks.
    reporter : Reporter
        Receives progress.
    """

    def __init__(
        self,
        sources: Sequence[PlacedRecording],
        graph: LaneGraph,
        road_m: Mapping[str, float],
        settings: VehicleSettings,
        reporter: Reporter,
    ) -> None:
        self._road_m = road_m
        self._read = [_Read(source=source) for source in sources]
        self._graph, self._settings, self._reporter = graph, settings, reporter
        known = [source.recording.rows for source in sources]
        self._total = None if None in known else sum(rows for rows in known if rows is not None)

    def records(self) -> list[dict[str, Any]]:
        """Return the entries of the manifest."""
        return [each.record() for each in self._read]

    def warnings(self) -> list[str]:
        """Return what was noticed on the way, a line each."""
        return [
            f"{each.source.recording.path.name}: {each.unread} rows are of a time that another "
            f"recording of {each.source.track.sensor} holds, and are left out"
            for each in self._read
            if each.unread
        ]

    def blocks(self) -> Iterator[Block]:
        """Read all recordings side by side, block by block."""
        streams = [_Stream(self._of_sensor(number)) for number in self._sensors()]
        limits = self._settings.blocks
        begins = True
        begin = int(min(each.begin for each in streams)) // limits.steps * limits.steps
        while True:
            end = begin + limits.steps
            for each in streams:
                each.read_to(end + limits.margin_steps)
            following = min(each.next_step(end) for each in streams)
            block = _block(streams, begin, end, limits)
            ends = following is None or following == np.inf
            yield replace(block, begins=begins, ends=bool(ends))
            if ends:
                return
            begins = False
            begin = max(end, int(following) // limits.steps * limits.steps)
            for each in streams:
                each.forget(begin - limits.margin_steps)

    def _sensors(self) -> list[int]:
        return sorted({each.source.number for each in self._read})

    def _of_sensor(self, number: int) -> Iterator[_Piece]:
        """Read the recordings of one sensor, one after the other in the order of their begins."""
        waiting: list[_Opened] = []
        for read in self._read:
            if read.source.number == number:
                pieces = whole_frames(read.source.recording.read())
                first = next(pieces, None)
                if first is not None and len(first):
                    waiting.append((float(first.time[0]), len(waiting), read, first, pieces))
        if not waiting:
            return
        until = -np.inf
        for _, _, read, first, pieces in sorted(waiting, key=lambda each: each[:2]):
            for piece in _chained(first, pieces):
                fresh = piece.time > until
                read.unread += int((~fresh).sum())
                read.rows += len(piece)
                self._reporter.progress(STAGE, sum(x.rows for x in self._read), self._total)
                if fresh.any():
                    yield from self._in_map(read, piece if fresh.all() else rows_of(piece, fresh))
            if len(piece):
                until = max(until, float(piece.time[-1]))
            if read.rates == 0:
                raise InputError(
                    f"{read.source.recording.path}: has no range rates: without them nothing says "
                    "what moves"
                )

    def _in_map(self, read: _Read, piece: Detections) -> Iterator[_Piece]:
        source = read.source
        time = piece.time if source.clock is None else source.clock.corrected(piece.time)
        held = source.track.at(time)
        for index in np.unique(held).tolist():
            now = held == index
            read.poses.add(index)
            read.rates += int(np.isfinite(piece.range_rate[now]).sum())
            pose = source.track.poses[index]
            here = rows_of(piece, now & piece.present)
            echoes = echoes_of(
                replace(here, time=time[now & piece.present]), pose, source.number, self._graph,
                self._settings.echoes, road_m=self._road_m[source.views[index]],
            )  # fmt: skip
            steps = np.unique(step_of(time[now]))
            frames = frames_of(
                source.track.sensor, source.views[index], union([Runs(first=steps, last=steps)])
            )
            yield _Piece(echoes=echoes, frames=frames, last_step=int(steps[-1]))


@dataclass(frozen=True, kw_only=True)
class _Piece:
    echoes: Echoes
    frames: pd.DataFrame
    last_step: int


def _chained(first: Detections, rest: Iterator[Detections]) -> Iterator[Detections]:
    yield first
    yield from rest


class _Stream:
    """What one sensor saw, read as far as it is needed."""

    def __init__(self, pieces: Iterator[_Piece]) -> None:
        self._pieces = pieces
        self._held: list[_Piece] = []
        self._reached: float = -np.inf
        self._fetch()
        begins = [int(each.frames["first_step"].min()) for each in self._held]
        self.begin: float = min(begins) if begins else np.inf

    def _fetch(self) -> None:
        piece = next(self._pieces, None)
        if piece is None:
            self._reached = np.inf
        else:
            self._held.append(piece)
            self._reached = piece.last_step

    def read_to(self, step: int) -> None:
        """Read until all before a step is held."""
        while self._reached < step:
            self._fetch()

    def next_step(self, step: int) -> float:
        """Return the first step of a frame from a step on, or infinity; that step if unknown."""
        for piece in self._held:
            late = piece.frames["last_step"].to_numpy() >= step
            if late.any():
                return max(step, int(piece.frames["first_step"].to_numpy()[late].min()))
        if self._reached < np.inf:
            self.read_to(step)
            return self.next_step(step)
        return np.inf

    def forget(self, step: int) -> None:
        """Forget what is before a step."""
        self._held = [each for each in self._held if each.last_step >= step]

    def held(self) -> list[_Piece]:
        """Return what is held."""
        return self._held


def _block(streams: Sequence[_Stream], begin: int, end: int, limits: BlockSettings) -> Block:
    """Return the block of the steps from `begin` to the one before `end`."""
    held = [piece for stream in streams for piece in stream.held()]
    from_s = (begin - limits.margin_steps) / STEPS_PER_SECOND
    to_s = (end + limits.margin_steps) / STEPS_PER_SECOND
    parts = []
    for piece in held:
        inside = (piece.echoes.time >= from_s) & (piece.echoes.time < to_s)
        if inside.any():
            parts.append(piece.echoes.take(inside))
    frames = pd.concat([FRAMES.empty(), *(piece.frames for piece in held)], ignore_index=True)
    frames["first_step"] = frames["first_step"].clip(lower=begin)
    frames["last_step"] = frames["last_step"].clip(upper=end - 1)
    frames = frames_table(frames[frames["first_step"] <= frames["last_step"]])
    last = int(frames["last_step"].max()) if len(frames) else end - 1
    first = int(frames["first_step"].min()) if len(frames) else begin
    return Block(
        first_step=first, last_step=last, echoes=Echoes.join(parts), frames=frames,
        begins=False, ends=False,
    )  # fmt: skip
