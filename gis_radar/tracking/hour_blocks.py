"""Blocks of an hour: spans of time with margins, in which vehicles are followed.

A block straddles each edge of the hour; the jobs of both hours make it from the same window. The
others lie between them, at the same places in every hour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gis_radar.base import STEP_S, STEP_US, STEPS_PER_SECOND, Integers, give_back_memory, step_of
from gis_radar.hdmap import LaneGraph
from gis_radar.measures import HourWindow, PlacedRecording, SensorHour, rows_of, whole_frames
from gis_radar.recordings import Detections
from gis_radar.tracking.detections import NOISE_S, MapDetections, map_detections, still_rate

BLOCK_STEPS = 6000  # length of a block, which begins at a multiple of it: five minutes
# Steps before and after a block whose detections are used, too: a stationary vehicle is undetected
# for 25 s on end in one case of ten.
BLOCK_MARGIN_STEPS = 1200


@dataclass(frozen=True, kw_only=True)
class Block:
    """The detections around a span of steps.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive. The first block begins at the first frame and the last one ends at the
        last frame, where there are no frames on the other side of the edge.
    detections : MapDetections
        Detections of the span and of the margins before and after it.
    """

    first_step: int
    last_step: int
    detections: MapDetections


@dataclass(frozen=True, kw_only=True)
class Section:
    """Section of an hour: blocks whose recordings are read in one pass.

    Parameters
    ----------
    first, after : int
        Steps that are read: the first one, and the one after the last.
    spans : list of (int, int)
        First step of each block, and the step after its last.
    """

    first: int
    after: int
    spans: list[tuple[int, int]]


def sections_of(window: HourWindow) -> list[Section]:
    """Return the sections of an hour: around its begin, within it, around its end."""
    margin = BLOCK_MARGIN_STEPS
    low, high = window.begin + margin, window.end - margin
    inner = range(window.begin, window.end, BLOCK_STEPS)
    edges = [low, *(step for step in inner if low < step < high), high]

    def around(edge: int) -> Section:
        return Section(
            first=edge - 2 * margin, after=edge + 2 * margin, spans=[(edge - margin, edge + margin)]
        )

    within = Section(first=window.begin, after=window.end, spans=list(pairwise(edges)))
    return [around(window.begin), within, around(window.end)]


def blocks_of(
    sensors: Sequence[SensorHour], window: HourWindow, graph: LaneGraph
) -> Iterator[tuple[tuple[int, int], Block]]:
    """Read the blocks of an hour that have frames, one after the other.

    Parameters
    ----------
    sensors : sequence of SensorHour
        What each sensor delivered in the window; their recordings are read again.
    window : HourWindow
        The hour.
    graph : LaneGraph
        The lanes.

    Yields
    ------
    (int, int)
        First step of the block, and the step after its last.
    Block
        The block there; it begins with the first and ends with the last frame where there are none
        on the other side of its edge.
    """
    margin = BLOCK_MARGIN_STEPS
    steps = [sensor.frames.time_us // STEP_US for sensor in sensors]
    known = np.unique(np.concatenate([np.empty(0, np.int64), *steps]))
    for section in sections_of(window):
        streams = [
            _Stream(_batches(sensor, number, section, graph))
            for number, sensor in enumerate(sensors)
        ]
        for begin, after in section.spans:
            before, inside, later = (
                _steps_between(known, *span)
                for span in ((begin - margin, begin), (begin, after), (after, after + margin))
            )
            if not len(inside):
                continue
            for each in streams:
                each.read_to(after + margin)
            batches = [batch for each in streams for batch in each.buffered]
            detections = _joined(batches, begin - margin, after + margin)
            del batches
            for each in streams:
                each.drop_before(after - margin)  # the next block's margin begins there
            give_back_memory()
            yield (
                (begin, after),
                Block(
                    first_step=begin if len(before) else int(inside[0]),
                    last_step=after - 1 if len(later) else int(inside[-1]),
                    detections=detections,
                ),
            )
            del detections
            give_back_memory()  # before the next block is read


def _steps_between(steps: Integers, first: int, after: int) -> Integers:
    """Return the steps, which ascend, from one to before another."""
    low, high = np.searchsorted(steps, [first, after])
    return steps[low:high]


def _joined(batches: Sequence[tuple[MapDetections, int]], first: int, after: int) -> MapDetections:
    """Return the detections from step `first` to before step `after`."""
    parts = []
    for detections, _ in batches:
        inside = (detections.time >= first / STEPS_PER_SECOND) & (
            detections.time < after / STEPS_PER_SECOND
        )
        if inside.all():
            parts.append(detections)
        elif inside.any():
            parts.append(detections.take(inside))
    return MapDetections.join(parts)


class _Stream:
    """Stream of the detections of one sensor, read as far as needed."""

    def __init__(self, batches: Iterator[tuple[MapDetections, int]]) -> None:
        self._batches = batches
        self._reached = -np.inf
        self.buffered: list[tuple[MapDetections, int]] = []

    def read_to(self, step: float) -> None:
        """Read until everything before a step is in memory."""
        while self._reached < step:
            batch = next(self._batches, None)
            self._reached = np.inf if batch is None else batch[1]
            self.buffered += [] if batch is None else [batch]

    def drop_before(self, step: int) -> None:
        """Drop everything before a step."""
        self.buffered = [each for each in self.buffered if each[1] >= step]


def _batches(
    sensor: SensorHour, number: int, section: Section, graph: LaneGraph
) -> Iterator[tuple[MapDetections, int]]:
    """Yield the detections on lanes of a sensor in a section, with the last step of each batch.

    The largest range rate of still detections is measured in the section's first seconds.
    """
    waiting: list[tuple[PlacedRecording, Detections]] = []
    still_mps: float | None = None
    for each in _frames_of(sensor, section):
        waiting.append(each)
        del each
        if waiting[-1][1].time[-1] < waiting[0][1].time[0] + NOISE_S and still_mps is None:
            continue
        if still_mps is None:
            still_mps = _still_rate(waiting)
        found = [part for each in waiting for part in _on_lanes(*each, number, graph, still_mps)]
        waiting.clear()
        yield from found
    still_mps = _still_rate(waiting) if still_mps is None else still_mps
    for each in waiting:
        yield from _on_lanes(*each, number, graph, still_mps)


def _frames_of(
    sensor: SensorHour, section: Section
) -> Iterator[tuple[PlacedRecording, Detections]]:
    """Read the whole frames of a sensor in a section, each once, with corrected times."""
    limits = np.array([section.first - 1, section.after + 1]) * STEP_S
    for number, source in enumerate(sensor.sources):
        own_us, clock = sensor.frames.time_us[sensor.source == number], source.right_clock
        if not len(own_us):
            continue
        begin, end = clock.shown(limits).tolist()
        for read in whole_frames(source.recording.read_between(begin, end)):
            time = clock.corrected(read.time)
            step = step_of(time)
            inside = (step >= section.first) & (step < section.after)
            inside &= np.rint(time * 1e6) >= own_us[0]  # before it, an earlier recording is used
            if inside.any():
                yield source, rows_of(replace(read, time=time), inside)


def _still_rate(batches: Sequence[tuple[PlacedRecording, Detections]]) -> float:
    """Return the largest range rate of still detections, by the first seconds."""
    rates = [np.empty(0)]
    for _, rows in batches:
        soon = rows.time < batches[0][1].time[0] + NOISE_S
        rates.append(rows.range_rate[rows.present & soon])
    return still_rate(np.concatenate(rates))


def _on_lanes(
    source: PlacedRecording, rows: Detections, number: int, graph: LaneGraph,
    still_mps: float,
) -> Iterator[tuple[MapDetections, int]]:  # fmt: skip
    """Yield the detections of a batch that lie on lanes, pose by pose."""
    pose = source.track.at(rows.time)
    for index in np.unique(pose).tolist():
        now = pose == index
        here = now & rows.present
        detections = map_detections(
            rows_of(rows, here), source.track.poses[index], number, graph,
            road_m=source.sights[index].road_m, still_mps=still_mps,
        )  # fmt: skip
        yield detections, int(step_of(rows.time[now][-1:])[0])
