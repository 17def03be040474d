"""Moving detections of a sensor, in the last frames of a recording or while several recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gis_radar.base import QUIET, InputError, Reporter
from gis_radar.calibration.registration.traces import FRAMES, MIN_SPEED_MPS, Moving
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.recordings import Recording, RollingWindow, open_recording

STAGE = "reading traces"
NO_OFFSET = SensorClock(offset_s=0.0)  # a clock that is right


class MovingWindow(RollingWindow):
    """Window of the last frames of a stream of detections, which keeps the moving ones."""

    def __init__(self) -> None:
        super().__init__(frames=FRAMES, keep=lambda batch: np.abs(batch.range_rate) > MIN_SPEED_MPS)

    def moving(self) -> Moving:
        """Return the moving detections of the window."""
        found = self.content()
        return Moving(
            time=found.time,
            points=found.points,
            range_rate=found.range_rate,
            frames=len(self),
            begin=self.begin,
            end=float(found.frame_times[-1]) if len(self) else float("nan"),
        )


def read_moving(path: str | Path, *, reporter: Reporter = QUIET) -> Moving:
    """Read the moving detections in the last frames of a recording, in bounded memory.

    Parameters
    ----------
    path : str or Path
        A recording.
    reporter : Reporter
        Receives progress.

    Raises
    ------
    InputError
        If the recording cannot be read.
    """
    recording, done = open_recording(path), 0
    window = MovingWindow()
    for batch in recording.read():
        window.push(batch)
        done += len(batch)
        reporter.progress(STAGE, done, recording.rows)
    return window.moving()


@dataclass(frozen=True, kw_only=True)
class Span:
    """Begin and end of a recording.

    Parameters
    ----------
    path : Path
        The recording.
    begin, end : float
        UNIX seconds, corrected by the sensor's clock.
    """

    path: Path
    begin: float
    end: float

    def shared_s(self, begin: float, end: float) -> float:
        """Return how many seconds between two times it recorded."""
        return max(min(self.end, end) - max(self.begin, begin), 0.0)


def read_span(path: Path, clock: SensorClock = NO_OFFSET) -> Span:
    """Read when a recording begins and ends.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    begin, end = clock.corrected(np.array(recorded_between(open_recording(path)))).tolist()
    return Span(path=path, begin=begin, end=end)


def recorded_between(recording: Recording) -> tuple[float, float]:
    """Return when a recording begins and ends, UNIX seconds of its own clock.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    parts = None if recording.time_spans is None else recording.time_spans()
    parts = parts or [(float(rows.time[0]), float(rows.time[-1])) for rows in recording.read()]
    return parts[0][0], parts[-1][1]


def common_time(recordings: Sequence[Path]) -> float:
    """Return the end of the time in which all recorded, UNIX seconds.

    Raises
    ------
    InputError
        If two of them have no time in common.
    """
    spans = [read_span(path) for path in recordings]
    last = max(spans, key=lambda each: each.begin)
    first = min(spans, key=lambda each: each.end)
    if last.begin >= first.end:
        raise InputError(
            "{} ends {:.0f} s before {} begins",
            first.path,
            last.begin - first.end,
            last.path,
            hint="give recordings of the same time",
        )
    return first.end


def best_end(spans: Mapping[str, Sequence[Span]], length_s: float) -> float:
    """Return the end (UNIX seconds) of the first span of a length in which sensors recorded most.

    Later recordings change it only where more sensors recorded then.

    Parameters
    ----------
    spans : mapping of str to sequence of Span
        The recordings of each sensor.
    length_s : float
        Length of the span, seconds.
    """

    def recorded(end: float) -> float:
        return sum(
            each.shared_s(end - length_s, end) for several in spans.values() for each in several
        )

    ends = sorted({each.end for several in spans.values() for each in several})
    return max(ends, key=lambda end: round(recorded(end)), default=0.0)


def read_until(spans: Sequence[Span], end: float, clock: SensorClock = NO_OFFSET) -> Moving:
    """Return a sensor's moving detections in the last frames until a time.

    Raises
    ------
    InputError
        If a recording cannot be read.
    """
    window = MovingWindow()
    last = -np.inf
    for span in sorted(spans, key=lambda each: each.begin):
        for batch in open_recording(span.path).read():
            right = replace(batch, time=clock.corrected(batch.time))
            if right.time[0] > end:
                break
            kept = right.take((right.time <= end) & (right.time > last))
            if len(kept):
                window.push(kept)
        last = max(last, span.end)
    return window.moving()
