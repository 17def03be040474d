"""Sources of a sensor's frames: the radar itself, a capture, or a recording that is replayed.

Each is an iterator over whole frames in order of time; it yields None while there is no frame, so
that the reader can do other work meanwhile.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, Queue
from threading import Thread

import numpy as np

from gis_radar.base import QUIET, NoAnswerError, Reporter
from gis_radar.measures import NO_FURTHER, FrameIndex, rows_of, whole_frames
from gis_radar.recordings import (
    AGREEING_S,
    Detections,
    Frame,
    ReaderContext,
    format_of,
    open_recording,
)

IDLE_S = 0.02  # between two looks while there is no frame
_SET_BACK_S = 0.5  # a frame earlier by less came out of order; by more, the clock was set back
_WAITING_FRAMES = 1_000  # most frames of a radar that wait to be processed: 50 s
Frames = Iterator[Detections | None]


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Replay of a recording.

    Parameters
    ----------
    path : Path
        The recording.
    speed : float
        1 as it was recorded, 2 twice as fast; 0 as fast as possible.
    loop_s : float, optional
        Period in seconds with which the frames are repeated, for ever, with present times: the same
        for all replays with this period, whenever each was started. By default frames come once,
        with the recorded times.
    """

    path: Path
    speed: float = 1.0
    loop_s: float | None = None

    def frames(self) -> Frames:
        """Yield the frames when they are due."""
        if self.loop_s is None:
            yield from self._once()
            return
        length_us = round(self.loop_s * 1e6)
        first = next(frames_of_recording(self.path))
        loop_number = int(time.time() * 1e6 - first.time[0] * 1e6) // length_us
        while True:
            for frame in frames_of_recording(self.path):
                time_us = int(np.rint(frame.time[0] * 1e6))
                if time_us - first.time[0] * 1e6 >= length_us:
                    break
                due_s = (time_us + loop_number * length_us) / 1e6
                if due_s < time.time() - 1.0:
                    continue  # the replay began in the middle of a loop
                yield from _until(due_s - time.time())
                yield replace(frame, time=np.full(len(frame), due_s))
            loop_number += 1

    def _once(self) -> Frames:
        """Yield the recorded frames once, at the chosen speed."""
        start, first = time.monotonic(), None
        for frame in frames_of_recording(self.path):
            first = float(frame.time[0]) if first is None else first
            if self.speed > 0.0:
                due_s = start + (float(frame.time[0]) - first) / self.speed
                yield from _until(due_s - time.monotonic())
            yield frame


def _until(wait_s: float) -> Frames:
    """Yield None until a time has passed."""
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(left, IDLE_S))
        yield None


def frames_of_recording(path: Path) -> Iterator[Detections]:
    """Yield the frames of a recording one by one."""
    for batch in whole_frames(open_recording(path).read()):
        begins = FrameIndex.of(batch.time).begins
        for begin, end in zip(begins, [*begins[1:], len(batch)], strict=True):
            yield rows_of(batch, slice(int(begin), int(end)))


@dataclass(kw_only=True)
class Radar:
    """A radar's frames, from its address or from a capture.

    Parameters
    ----------
    source : str
        Such as `udp://224.0.2.2:42102`, or a file that `gis-radar convert` takes.
    sensor : str, optional
        Name of the sensor, where there are several.
    reporter : Reporter
        Receives remarks.
    read : callable, optional
        Yields its frames; by default chosen by the address or file name.

    Attributes
    ----------
    counts : Counter
        Number of things left out, by kind.
    """

    source: str
    sensor: str | None = None
    reporter: Reporter = QUIET
    read: Callable[[str, ReaderContext], Iterable[Frame]] | None = None

    def __post_init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._last_us = 0
        self._by_recorder = False

    def frames(self) -> Frames:
        """Yield the frames as they come; those of a capture at once.

        Raises
        ------
        InputError
            If the source cannot be read.
        """
        frames = self.read or format_of(self.source).frames
        context = ReaderContext(sensor=self.sensor, reporter=self.reporter, counts=self.counts)
        waiting: Queue[Frame | Exception | None] = Queue(_WAITING_FRAMES)

        def read() -> None:
            try:
                for frame in frames(self.source, context):
                    waiting.put(frame)
            except Exception as error:  # noqa: BLE001 - raised where frames are read
                waiting.put(error)
            else:
                waiting.put(None)

        Thread(target=read, daemon=True, name="radar").start()
        while True:
            try:
                item = waiting.get(timeout=IDLE_S)
            except Empty:
                yield None
                continue
            if item is None:
                return
            if isinstance(item, Exception):
                raise item
            if (found := self._detections(item)) is not None:
                yield found

    def _detections(self, frame: Frame) -> Detections | None:
        """Return a frame as rows of a recording; None where it came out of order."""
        usable = frame.without_unusable(self.counts)
        time_us = round(self._time(usable) * 1e6)
        back_s = (self._last_us - time_us) / 1e6
        if 0.0 <= back_s < _SET_BACK_S:
            self.counts["frames_out_of_order"] += 1
            return None
        if back_s > 0.0:  # else all would be left out until it is as late again
            self.counts["clock_set_back"] += 1
            self.reporter.warn("{}: the clock was set back by {:.1f} s", self.source, back_s)
        self._last_us = time_us
        points = usable.points.astype(np.float64)
        if len(points) == 0:
            points = np.full((1, 3), np.nan)
        rate, rcs = (
            column.astype(np.float64) if len(usable) else np.full(1, np.nan)
            for column in (usable.range_rate, usable.rcs)
        )
        rows = np.full(len(points), time_us / 1e6)
        return Detections(time=rows, points=points, range_rate=rate, rcs=rcs, further=NO_FURTHER)

    def _time(self, frame: Frame) -> float:
        """Return the sensor's time, or from its first wrong one on the time of arrival."""
        sensor_s, arrival_s = frame.sensor_time, frame.recorder_time
        if arrival_s is None or (self._by_recorder is False and _is_right(frame)):
            if sensor_s is None:
                raise NoAnswerError("{}: frames without any time", self.source)
            return sensor_s
        if not self._by_recorder:
            self._by_recorder = True
            self.reporter.warn(
                "{}: the sensor's clock is not set: times are those of arrival",
                self.source,
            )
        return arrival_s


def _is_right(frame: Frame) -> bool:
    """Return whether the sensor's clock is synchronised and agrees with that of the arrival."""
    sensor_s, arrival_s = frame.sensor_time, frame.recorder_time
    if sensor_s is None or arrival_s is None or not frame.synchronised:
        return False
    return abs(sensor_s - arrival_s) <= AGREEING_S
