"""A rolling window over the last frames of a recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats
from gis_radar.recordings.recording import Detections


@dataclass(frozen=True, kw_only=True)
class Window:
    """Content of a rolling window: its frames' times and the kept detections.

    Parameters
    ----------
    frame_times : (f,) array
        UNIX seconds of all its frames, ascending.
    time, range_rate : (n,) array
        Of each kept detection: UNIX seconds; m/s, positive when receding.
    points : (n, 3) array
        Positions of the kept detections, sensor frame, metres.
    """

    frame_times: Floats
    time: Floats
    points: Floats
    range_rate: Floats


class RollingWindow:
    """The last frames of a stream of detections.

    Parameters
    ----------
    frames : int
        Length of the window, frames.
    keep : callable
        Returns which detections of a batch are kept.
    """

    def __init__(self, *, frames: int, keep: Callable[[Detections], Booleans]) -> None:
        self._keep = keep
        self._times: deque[float] = deque(maxlen=frames)
        self._batches: deque[tuple[Floats, Floats, Floats]] = deque()

    def push(self, batch: Detections) -> None:
        """Take the next detections; a frame may have begun in the batch before."""
        stamps = np.unique(batch.time)
        if self._times and self._times[-1] == stamps[0]:
            stamps = stamps[1:]
        self._times.extend(stamps.tolist())
        keep = batch.present & self._keep(batch)
        self._batches.append((batch.time[keep], batch.points[keep], batch.range_rate[keep]))
        while self._batches and (
            self._batches[0][0].size == 0 or self._batches[0][0][-1] < self._times[0]
        ):
            self._batches.popleft()

    def forget(self, before: float) -> None:
        """Drop the frames before a time (UNIX seconds)."""
        while self._times and self._times[0] < before:
            self._times.popleft()

    @property
    def full(self) -> bool:
        """Whether the window has its whole length."""
        return len(self._times) == self._times.maxlen

    @property
    def begin(self) -> float:
        """UNIX seconds of the first frame; NaN where there is none."""
        return self._times[0] if self._times else float("nan")

    def __len__(self) -> int:
        return len(self._times)

    def content(self) -> Window:
        """Return what is in the window."""
        none = (np.empty(0), np.empty((0, 3)), np.empty(0))
        time, points, rate = (
            np.concatenate(parts) for parts in zip(none, *self._batches, strict=True)
        )
        inside = time >= self._times[0] if self._times else np.zeros(0, dtype=bool)
        return Window(
            frame_times=np.asarray(self._times, dtype=np.float64),
            time=time[inside],
            points=points[inside],
            range_rate=rate[inside],
        )
