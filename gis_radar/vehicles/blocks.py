"""Recordings of all sensors, read side by side in blocks of time that overlap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from gis_radar.errors import InputError
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.occupancy.folder import frames_of, frames_table
from gis_radar.occupancy.frame_log import rows_of, whole_frames
from gis_radar.occupancy.frame_steps import Runs, union
from gis_radar.occupancy.views import PlacedRecording
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Detections
from gis_radar.steps import STEPS_PER_SECOND, step_of
from gis_radar.vehicles.echoes import Echoes, echoes_of, still_rate
from gis_radar.vehicles.settings import BlockSettings, VehicleSettings
from gis_radar.vehicles.tables import FRAMES

STAGE = "vehicles"


@dataclass(frozen=True, kw_only=True)
class Block:
    """Detections around a span of steps, with the frames in it.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive: whole, but that the first block begins at the first frame and the last
        one ends at the last frame.
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
    detections: int = 0
    rates: int = 0
    still_mps: float = 0.0

    def refuse_without_rates(self) -> None:
        """Refuse detections of which none has a range rate."""
        if self.detections and not self.rates:
            raise InputError(
                f"{self.source.recording.path}: has no range rates: without them nothing says "
                "what moves"
            )


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
        By sensor and view, the height of the road near the sensor: where one without elevation
        looks.
    settings : VehicleSettings
        Of echoes and blocks.
    reporter : Reporter
        Receives progress.
    """

    def __init__(
        self,
        sources: Sequence[PlacedRecording],
        graph: LaneGraph,
        road_m: Mapping[tuple[str, str], float],
        settings: VehicleSettings,
        reporter: Reporter,
    ) -> None:
        self._road_m = road_m
        self._read = [_Read(source=source) for source in sources]
        self.sensors = sorted({source.track.sensor for source in sources})
        self._graph, self._settings, self._reporter = graph, settings, reporter
        known = [source.recording.rows for source in sources]
        self._total = None if None in known else sum(rows for rows in known if rows is not None)

    def records(self) -> list[dict[str, Any]]:
        """Return the entries of the manifest."""
        return [each.source.record(each.rows, each.poses) for each in self._read]

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
        streams = [_Stream(self._of_sensor(sensor)) for sensor in self.sensors]
        limits = self._settings.blocks
        first: int | None = min(each.begin for each in streams)
        begins = True
        while first is not None:
            begin = first // limits.steps * limits.steps
            end = begin + limits.steps
            for each in streams:
                each.forget(begin - limits.margin_steps)
                each.read_to(end + limits.margin_steps)
            later = [step for each in streams if (step := each.next_step(end)) is not None]
            first = min(later, default=None)
            yield _block(streams, begin, limits, begins=begins, ends=first is None)
            begins = False

    def _of_sensor(self, sensor: str) -> Iterator[_Piece]:
        """Read the recordings of one sensor, one after the other in the order of their begins."""
        opened: list[tuple[float, _Read, Detections, Iterator[Detections]]] = []
        for read in self._read:
            if read.source.track.sensor == sensor:
                pieces = whole_frames(read.source.recording.read())
                first = next(pieces)  # a recording without rows is refused in there
                read.still_mps = self._still_rate(read.source)
                opened.append((float(first.time[0]), read, first, pieces))
        until = -np.inf
        for _, read, first, pieces in sorted(opened, key=itemgetter(0)):
            for piece in chain([first], pieces):
                fresh = piece.time > until
                read.unread += int((~fresh).sum())
                read.rows += len(piece)
                self._reporter.progress(STAGE, sum(x.rows for x in self._read), self._total)
                if fresh.any():
                    yield from self._in_map(read, piece if fresh.all() else rows_of(piece, fresh))
            until = max(until, float(piece.time[-1]))
            read.refuse_without_rates()

    def _still_rate(self, source: PlacedRecording) -> float:
        """Return up to which range rate a return may be of what stands, by the first seconds."""
        settings, rates = self._settings.echoes, []
        begin: float | None = None
        for piece in source.recording.read():
            begin = float(piece.time[0]) if begin is None else begin
            soon = piece.present & (piece.time < begin + settings.noise_s)
            rates.append(piece.range_rate[soon])
            if piece.time[-1] >= begin + settings.noise_s:
                break
        return still_rate(np.concatenate(rates), settings)

    def _in_map(self, read: _Read, piece: Detections) -> Iterator[_Piece]:
        source, sensor = read.source, read.source.track.sensor
        time = piece.time if source.clock is None else source.clock.corrected(piece.time)
        held = source.track.at(time)
        for index in np.unique(held).tolist():
            now = held == index
            read.poses.add(index)
            here = now & piece.present
            read.detections += int(here.sum())
            read.rates += int(np.isfinite(piece.range_rate[here]).sum())
            echoes = echoes_of(
                replace(rows_of(piece, here), time=time[here]), source.track.poses[index],
                self.sensors.index(sensor), self._graph, self._settings.echoes,
                road_m=self._road_m[sensor, source.views[index]], still_mps=read.still_mps,
            )  # fmt: skip
            steps = np.unique(step_of(time[now]))
            runs = union([Runs(first=steps, last=steps)])
            frames = frames_of(sensor, source.views[index], runs)
            yield _Piece(echoes=echoes, frames=frames, last_step=int(steps[-1]))


@dataclass(frozen=True, kw_only=True)
class _Piece:
    echoes: Echoes
    frames: pd.DataFrame
    last_step: int


class _Stream:
    """What one sensor saw, read as far as it is needed."""

    def __init__(self, pieces: Iterator[_Piece]) -> None:
        first = next(pieces)
        self._pieces = pieces
        self._held = [first]
        self._reached: float = first.last_step
        self.begin = int(first.frames["first_step"].min())

    def read_to(self, step: int) -> None:
        """Read until all before a step is held."""
        while self._reached < step:
            piece = next(self._pieces, None)
            self._reached = np.inf if piece is None else piece.last_step
            self._held += [] if piece is None else [piece]

    def next_step(self, step: int) -> int | None:
        """Return the first step of a frame from a step on; None where there is none."""
        self.read_to(step)
        for piece in self._held:
            late = piece.frames["last_step"].to_numpy() >= step
            if late.any():
                return max(step, int(piece.frames["first_step"].to_numpy()[late].min()))
        return None

    def forget(self, step: int) -> None:
        """Forget what is before a step."""
        self._held = [each for each in self._held if each.last_step >= step]

    def held(self) -> list[_Piece]:
        """Return what is held."""
        return self._held


def _block(
    streams: Sequence[_Stream], begin: int, limits: BlockSettings, *, begins: bool, ends: bool
) -> Block:
    """Return the block of the steps from `begin` on."""
    end = begin + limits.steps
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
    return Block(
        first_step=int(frames["first_step"].min()) if begins else begin,
        last_step=int(frames["last_step"].max()) if ends else end - 1,
        echoes=Echoes.join(parts), frames=frames, begins=begins, ends=ends,
    )  # fmt: skip
