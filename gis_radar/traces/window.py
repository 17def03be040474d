"""The rolling window: the moving detections of the last frames of a recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.detections import Detections, open_recording
from gis_radar.progress import QUIET, Reporter

FRAMES = 2000  # n_f of the paper: 100 s at 20 Hz
MIN_SPEED = 0.15  # m/s, the paper's Doppler threshold
STAGE = "reading traces"


@dataclass(frozen=True, kw_only=True)
class Moving:
    """The moving detections of a window.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, ascending.
    points : (n, 3) array
        Sensor frame, metres.
    range_rate : (n,) array
        m/s, positive when receding.
    frames, detections : int
        How many frames and detections, still ones too, the window holds.
    begin, end : float
        UNIX seconds of its first and last frame.
    """

    time: Floats
    points: Floats
    range_rate: Floats
    frames: int
    detections: int
    begin: float
    end: float

    def __len__(self) -> int:
        return len(self.time)


class RollingWindow:
    """The last frames of a stream of detections, of which only the moving ones are kept.

    Parameters
    ----------
    frames : int
        Length of the window.
    min_speed : float
        Least absolute range rate of a moving detection, m/s.
    """

    def __init__(self, *, frames: int = FRAMES, min_speed: float = MIN_SPEED) -> None:
        self._frames = frames
        self._min_speed = min_speed
        self._times: deque[float] = deque(maxlen=frames)
        self._counts: deque[int] = deque(maxlen=frames)
        self._pieces: deque[tuple[Floats, Floats, Floats]] = deque()

    def push(self, piece: Detections) -> None:
        """Take the next detections; a frame may have begun in the piece before."""
        stamps, first = np.unique(piece.time, return_index=True)
        counts = np.add.reduceat(piece.present.astype(np.int64), first)
        if self._times and self._times[-1] == stamps[0]:
            self._counts[-1] += int(counts[0])
            stamps, counts = stamps[1:], counts[1:]
        self._times.extend(stamps.tolist())
        self._counts.extend(counts.tolist())
        keep = piece.present & (np.abs(piece.range_rate) > self._min_speed)
        self._pieces.append((piece.time[keep], piece.points[keep], piece.range_rate[keep]))
        while self._pieces[0][0].size == 0 or self._pieces[0][0][-1] < self._times[0]:
            self._pieces.popleft()
            if not self._pieces:
                break

    def forget(self, before: float) -> None:
        """Drop the frames before a time (UNIX seconds)."""
        while self._times and self._times[0] < before:
            self._times.popleft()
            self._counts.popleft()

    @property
    def begin(self) -> float:
        """UNIX seconds of the first frame; NaN where there is none."""
        return self._times[0] if self._times else float("nan")

    def __len__(self) -> int:
        return len(self._times)

    def moving(self) -> Moving:
        """Return what moved in the window."""
        none = (np.empty(0), np.empty((0, 3)), np.empty(0))
        time, points, rate = (
            np.concatenate(parts) for parts in zip(none, *self._pieces, strict=True)
        )
        inside = time >= self._times[0] if self._times else np.zeros(0, dtype=bool)
        return Moving(
            time=time[inside],
            points=points[inside],
            range_rate=rate[inside],
            frames=len(self._times),
            detections=sum(self._counts),
            begin=self.begin,
            end=self._times[-1] if self._times else float("nan"),
        )


def read_moving(
    path: str | Path,
    *,
    frames: int = FRAMES,
    min_speed: float = MIN_SPEED,
    reporter: Reporter = QUIET,
) -> Moving:
    """Read what moved in the last frames of a recording, in bounded memory.

    Parameters
    ----------
    path : str or Path
        A recording.
    frames : int
        Length of the window.
    min_speed : float
        Least absolute range rate, m/s.
    reporter : Reporter
        Told the progress.

    Raises
    ------
    InputError
        If the recording cannot be read.
    """
    window = RollingWindow(frames=frames, min_speed=min_speed)
    for piece in _reported(path, reporter):
        window.push(piece)
    return window.moving()


def _reported(path: str | Path, reporter: Reporter) -> Iterator[Detections]:
    recording = open_recording(path)
    done = 0
    for piece in recording.read():
        yield piece
        done += len(piece)
        reporter.progress(STAGE, done, recording.rows)


def voxels(points: Floats, size_m: float) -> Floats:
    """Return the centres of the cubes that hold a point, in a fixed order.

    Parameters
    ----------
    points : (n, d) array
        Metres.
    size_m : float
        Edge of a cube.
    """
    cells: Integers = np.floor(np.asarray(points) / size_m).astype(np.int64)
    return np.asarray((np.unique(cells, axis=0) + 0.5) * size_m, dtype=np.float64)
