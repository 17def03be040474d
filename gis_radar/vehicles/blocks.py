"""Recordings of all sensors, read side by side in blocks of time that overlap."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
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
ALWAYS = (-(2**62), 2**62)


@dataclass(frozen=True, kw_only=True)
class Block:
    """Detections around a span of steps, with the frames in it.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive: whole, but that the first block begins at the first frame and the last
        one ends at the last frame, where there are none on the other side of the edge.
    echoes : Echoes
        Of the span and so much before and after as vehicles need to be known by.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps with a frame, in the span.
    frames_before : DataFrame
        The same of the margin before it.
    begins, ends : bool
        Whether it is the first and the last block.
    """

    first_step: int
    last_step: int
    echoes: Echoes
    frames: pd.DataFrame
    frames_before: pd.DataFrame
    begins: bool
    ends: bool

    @property
    def margin(self) -> Block | None:
        """The margin before it as a block of its own; None where it has no frames."""
        before = self.frames_before
        if before.empty:
            return None
        first, last = int(before["first_step"].min()), self.first_step - 1
        return replace(
            self, first_step=first, last_step=last, frames=before, frames_before=before[:0]
        )


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
    span : (int, int)
        First and last step of what is asked for, at whole blocks; by default all.
    """

    def __init__(
        self,
        sources: Sequence[PlacedRecording],
        graph: LaneGraph,
        road_m: Mapping[tuple[str, str], float],
        settings: VehicleSettings,
        reporter: Reporter,
        span: tuple[int, int] = ALWAYS,
    ) -> None:
        margin = settings.blocks.margin_steps
        self._span, self._near = span, (span[0] - margin, span[1] + margin)
        self._road_m = road_m
        self._read = [_Read(source=source) for source in sources]
        self.sensors = sorted({source.track.sensor for source in sources})
        self._graph, self._settings, self._reporter = graph, settings, reporter
        known = [source.recording.rows for source in sources]
        whole = span == ALWAYS and None not in known
        self._total = sum(rows or 0 for rows in known) if whole else None

    def records(self) -> list[dict[str, Any]]:
        """Return the entries of the manifest, the same in whatever order recordings were given."""
        found = [each.source.record(each.rows, each.poses) for each in self._read]
        return sorted(found, key=partial(json.dumps, sort_keys=True))

    def warnings(self) -> list[str]:
        """Return what was noticed on the way, a line each."""
        return [
            f"{each.source.recording.path.name}: overlaps another recording of "
            f"{each.source.track.sensor}: of the time that both hold, that one counts"
            for each in self._read
            if each.unread
        ]

    def blocks(self) -> Iterator[Block]:
        """Read all recordings side by side, block by block."""
        streams = [_Stream(self._of_sensor(sensor)) for sensor in self.sensors]
        limits, (asked, last) = self._settings.blocks, self._span
        first = _next_step(streams, asked)
        begins = True
        while first is not None:
            begin = first // limits.steps * limits.steps
            end = begin + limits.steps
            for each in streams:
                each.forget(begin - limits.margin_steps)
                each.read_to(end + limits.margin_steps)
            later = _next_step(streams, end)
            first = later if later is not None and later <= last else None
            goes_on = first is not None or (later is not None and end == last + 1)
            yield _block(streams, begin, limits, begins=begins, ends=first is None, goes_on=goes_on)
            begins = False

    def _of_sensor(self, sensor: str) -> Iterator[_Piece]:
        """Read the recordings of one sensor, one after the other in the order of their begins."""
        opened: list[tuple[float, _Read]] = []
        for read in self._read:
            if read.source.track.sensor == sensor:
                begin, read.still_mps = self._begin(read.source)
                opened.append((begin, read))
        until = -np.inf
        for _, read in sorted(opened, key=itemgetter(0)):
            last = until
            for piece in self._asked(read.source):
                fresh = piece.time > until
                read.unread += int((~fresh).sum())
                read.rows += self._inside(read.source, piece)
                self._reporter.progress(STAGE, sum(x.rows for x in self._read), self._total)
                if fresh.any():
                    yield from self._in_map(read, piece if fresh.all() else rows_of(piece, fresh))
                last = max(last, float(piece.time[-1]))
            until = last
            read.refuse_without_rates()

    def _asked(self, source: PlacedRecording) -> Iterator[Detections]:
        """Read whole frames of a recording, of the span that is asked for and around it."""
        if self._span == ALWAYS:
            yield from whole_frames(source.recording.read())
            return
        begin, end = (
            source.right_clock.shown(np.array([(step + more) / STEPS_PER_SECOND]))[0]
            for step, more in zip(self._near, (-STEPS_PER_SECOND, STEPS_PER_SECOND), strict=True)
        )
        for piece in whole_frames(source.recording.read_between(float(begin), float(end))):
            step = step_of(source.right_clock.corrected(piece.time))
            near = (step >= self._near[0]) & (step <= self._near[1])
            if near.any():
                yield piece if near.all() else rows_of(piece, near)

    def _inside(self, source: PlacedRecording, piece: Detections) -> int:
        """Return how many rows are of the span that is asked for."""
        step = step_of(source.right_clock.corrected(piece.time))
        return int(((step >= self._span[0]) & (step <= self._span[1])).sum())

    def _begin(self, source: PlacedRecording) -> tuple[float, float]:
        """Return when a recording begins, and up to which range rate a return may be still.

        The latter is that of what stands, by the first seconds.
        """
        settings, rates = self._settings.echoes, []
        begin = np.inf
        for piece in source.recording.read():
            begin = min(begin, float(piece.time[0]))
            soon = piece.present & (piece.time < begin + settings.noise_s)
            rates.append(piece.range_rate[soon])
            if piece.time[-1] >= begin + settings.noise_s:
                break
        return begin, still_rate(np.concatenate(rates), settings)

    def _in_map(self, read: _Read, piece: Detections) -> Iterator[_Piece]:
        source, sensor = read.source, read.source.track.sensor
        time = source.right_clock.corrected(piece.time)
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
        self._pieces = pieces
        self._held: list[_Piece] = []
        self._reached = -np.inf

    def read_to(self, step: float) -> None:
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


def _next_step(streams: Sequence[_Stream], step: int) -> int | None:
    """Return the first step of a frame of any sensor from a step on; None where there is none."""
    later = [found for each in streams if (found := each.next_step(step)) is not None]
    return min(later, default=None)


def _block(
    streams: Sequence[_Stream], begin: int, limits: BlockSettings, *, begins: bool, ends: bool,
    goes_on: bool,
) -> Block:  # fmt: skip
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
    known = pd.concat([FRAMES.empty(), *(piece.frames for piece in held)], ignore_index=True)
    frames, before = (
        frames_within(known, begin, end),
        frames_within(known, begin - limits.margin_steps, begin),
    )
    return Block(
        first_step=int(frames["first_step"].min()) if begins and before.empty else begin,
        last_step=end - 1 if goes_on else int(frames["last_step"].max()),
        echoes=Echoes.join(parts), frames=frames, frames_before=before, begins=begins, ends=ends,
    )  # fmt: skip


def frames_within(frames: pd.DataFrame, begin: int, end: int) -> pd.DataFrame:
    """Return the runs of frames from a step to the one before another."""
    first, last = frames["first_step"].clip(lower=begin), frames["last_step"].clip(upper=end - 1)
    return frames_table(frames.assign(first_step=first, last_step=last)[first <= last])
