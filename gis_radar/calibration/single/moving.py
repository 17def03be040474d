"""Read a sensor's moving detections: of the last frames of a recording, or until a given time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gis_radar.base import QUIET, InputError, Reporter
from gis_radar.calibration.registration.traces import MIN_SPEED_MPS, WINDOW_FRAMES, Moving
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.recordings import (
    Recording,
    RollingWindow,
    detection_keys,
    keys_in_common,
    open_recording,
)

_STAGE = "reading traces"
# Two sensors with so many detections have none in common but by chance.
_LEAST_EQUAL, _MOST_EQUAL = 100, 0.5
NO_OFFSET = SensorClock(offset_s=0.0)  # the clock of a sensor without an offset


class MovingWindow(RollingWindow):
    """Rolling window over the last frames of a stream that stores the moving detections."""

    def __init__(self) -> None:
        super().__init__(
            frames=WINDOW_FRAMES, keep=lambda batch: np.abs(batch.range_rate) > MIN_SPEED_MPS
        )

    def moving(self) -> Moving:
        """Return the moving detections of the window."""
        content = self.content()
        return Moving(
            time=content.time,
            points=content.points,
            range_rate=content.range_rate,
            frames=len(self),
            begin=self.begin,
            end=float(content.frame_times[-1]) if len(self) else float("nan"),
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
        reporter.progress(_STAGE, done, recording.rows)
    return window.moving()


@dataclass(frozen=True, kw_only=True)
class Span:
    """Time span of a recording.

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
        """Return the length of its overlap with another span, seconds."""
        return max(min(self.end, end) - max(self.begin, begin), 0.0)


def read_span(path: Path, clock: SensorClock = NO_OFFSET) -> Span:
    """Read the time span of a recording, corrected by the sensor's clock.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    begin, end = clock.corrected(np.array(recorded_between(open_recording(path)))).tolist()
    return Span(path=path, begin=begin, end=end)


def recorded_between(recording: Recording) -> tuple[float, float]:
    """Return the first and last time of a recording, UNIX seconds of its own clock.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    spans = None if recording.time_spans is None else recording.time_spans()
    spans = spans or [(float(rows.time[0]), float(rows.time[-1])) for rows in recording.read()]
    return spans[0][0], spans[-1][1]


def common_time(recordings: Sequence[Path]) -> float:
    """Return the end of the time span common to all recordings, UNIX seconds.

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
    """Return the end (UNIX seconds) of the first span with the longest sum of recorded time.

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
    """Return a sensor's moving detections in the last frames until a time, over its recordings.

    Parameters
    ----------
    spans : sequence of Span
        Recordings of the sensor.
    end : float
        UNIX seconds, corrected by the clock.
    clock : SensorClock
        Clock of the sensor.

    Raises
    ------
    InputError
        If a recording cannot be read.
    """
    window = MovingWindow()
    last = -np.inf
    for span in sorted(spans, key=lambda each: each.begin):
        for batch in open_recording(span.path).read():
            corrected = replace(batch, time=clock.corrected(batch.time))
            if corrected.time[0] > end:
                break
            new = corrected.take((corrected.time <= end) & (corrected.time > last))
            if len(new):
                window.push(new)
        last = max(last, span.end)
    return window.moving()


def refuse_equal(moving: Mapping[str, Moving]) -> None:
    """Refuse sensors of which one has the detections of another: they would confirm each other.

    Parameters
    ----------
    moving : mapping of str to Moving
        Moving detections by sensor.

    Raises
    ------
    InputError
        Naming two such sensors.
    """
    # with range rates: radars of coarse positions have many places in common on busy lanes
    keys = {name: detection_keys(each.points, each.range_rate) for name, each in moving.items()}
    for name, other, common in keys_in_common(keys):
        fewer = min(len(np.unique(keys[each])) for each in (name, other))
        if fewer >= _LEAST_EQUAL and len(common) > _MOST_EQUAL * fewer:
            raise InputError(
                "{} and {} have the same detections", name, other,
                hint="give each sensor its own recording",
            )  # fmt: skip
