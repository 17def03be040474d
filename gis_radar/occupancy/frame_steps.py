"""Steps that frames cover: how many one frame covers, and sets of steps, kept as runs.

A frame covers the step of its time stamp. With a stated cycle it also covers each later step that
ends within one cycle of its time stamp: it holds for [time, time + cycle), and what holds at the
end of a step stands for it. A cycle of 50 ms gives the frame's own step and no other, whatever the
phase; a frame of a longer one covers cycle / 50 ms steps on average. A missing frame leaves its
steps empty: a cycle is a property of the sensor, and no frame depends on the next one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers, ranges
from gis_radar.errors import UsageError
from gis_radar.occupancy.hits import Hits
from gis_radar.occupancy.settings import DEFAULTS
from gis_radar.recordings.recording import Recording
from gis_radar.steps import STEP_US, step_of

SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 0.001, 2.0  # of any radar; beyond, a unit is mistaken
GAP_US = 100  # resolution of measured cycles: jitter is larger
MOST_GAPS = round(LONGEST_CYCLE_S * 1e6) // GAP_US
AUTO: Literal["auto"] = "auto"
Cycles = Mapping[str, float] | Literal["auto"]


def last_step_covered(time: Floats, cycle_us: int) -> Integers:
    """Return the last step that a frame at each time covers.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds.
    cycle_us : int
        The sensor's cycle, microseconds; up to 50 000 the answer is the step of the time.
    """
    reached = (np.rint(np.asarray(time) * 1e6).astype(np.int64) + cycle_us) // STEP_US - 1
    return np.maximum(step_of(time), reached)


def spread_hits(frames: Iterator[tuple[Integers, Integers, Integers, int]]) -> Iterator[Hits]:
    """Repeat the hits of frames in each step that the frames cover, in order.

    Parameters
    ----------
    frames : iterator of (first, last, tile, until)
        (k,) int64 arrays: first and last step that the frame of each hit covers, and its tile; and
        the last step of the frames read so far. Hits in later steps wait, so that what comes out
        ascends.

    Yields
    ------
    step, tile : (k,) int64 arrays
    """
    steps = tiles = np.empty(0, np.int64)
    for first, last, tile, until in frames:
        if len(steps) == 0 and np.array_equal(first, last):
            yield first, tile
            continue
        length = last - first + 1
        steps = np.concatenate([steps, ranges(first, length)])
        tiles = np.concatenate([tiles, np.repeat(tile, length)])
        order = np.argsort(steps, kind="stable")
        steps, tiles = steps[order], tiles[order]
        cut = int(np.searchsorted(steps, until, side="right"))
        yield steps[:cut], tiles[:cut]
        steps, tiles = steps[cut:], tiles[cut:]
    yield steps, tiles


@dataclass(kw_only=True)
class FrameTimes:
    """When the frames of a sensor came: the first, the last, and a histogram of the gaps.

    Parameters
    ----------
    frames : int
        Frames so far.
    first_us, last_us : int
        Time of the first and of the last one, microseconds since the UNIX epoch.
    gaps, sums_us : (m,) int64 arrays
        Gaps between frames by their length in `GAP_US`: how many, and their sum.
    """

    frames: int = 0
    first_us: int = 0
    last_us: int = 0
    gaps: Integers = field(default_factory=lambda: np.zeros(MOST_GAPS, np.int64))
    sums_us: Integers = field(default_factory=lambda: np.zeros(MOST_GAPS, np.int64))

    def add(self, time_us: Integers) -> None:
        """Add frames that follow those so far."""
        if self.frames == 0:
            self.first_us = self.last_us = int(time_us[0])
        gap_us = np.diff(time_us, prepend=self.last_us)
        gap_us = gap_us[(gap_us > 0) & (gap_us < MOST_GAPS * GAP_US)]
        self.gaps += np.bincount(gap_us // GAP_US, minlength=MOST_GAPS)
        self.sums_us += np.bincount(gap_us // GAP_US, gap_us, MOST_GAPS).astype(np.int64)
        self.last_us = int(time_us[-1])
        self.frames += len(time_us)

    @property
    def cycle_us(self) -> float:
        """The median time from one frame to the next; infinite where there is but one."""
        done = np.cumsum(self.gaps)
        if done[-1] == 0:
            return np.inf
        middle = int(np.searchsorted(done, done[-1] / 2))
        return float(self.sums_us[middle] / self.gaps[middle])


def cycles_us(
    cycles: Cycles | None, recordings: list[Recording], sensors: list[str],
    frames: int = DEFAULTS.cycle_frames,
) -> dict[str, int]:  # fmt: skip
    """Return the cycle of each sensor in microseconds; 50 ms where none is stated.

    Parameters
    ----------
    cycles : mapping, "auto" or None
        Seconds by sensor; or the median of the time from frame to frame, in whole milliseconds,
        over the first frames of the sensor's recordings.
    recordings, sensors : lists
        The recordings, and whose they are.
    frames : int
        How many first frames that median takes from each recording.

    Raises
    ------
    UsageError
        If a cycle is no duration of 1 ms to 2 s, or of a sensor that is not there.
    """
    found = dict.fromkeys(sensors, STEP_US)
    if cycles is None:
        return found
    if cycles == AUTO:
        return {sensor: _measured_us(recordings, sensors, sensor, frames) for sensor in found}
    for sensor, cycle_s in cycles.items():
        if sensor not in found:
            others = ", ".join(found)
            raise UsageError(f"a cycle is given for {sensor}, but the poses are of {others}")
        if not SHORTEST_CYCLE_S <= cycle_s <= LONGEST_CYCLE_S:
            raise UsageError(
                f"the cycle of {sensor} is {cycle_s} s, "
                f"expected {SHORTEST_CYCLE_S:g} to {LONGEST_CYCLE_S:g}",
                hint="the time from one of its frames to the next, such as 57ms",
            )
        found[sensor] = max(round(cycle_s * 1e6), STEP_US)
    return found


def _measured_us(recordings: list[Recording], sensors: list[str], sensor: str, frames: int) -> int:
    apart = [
        gaps
        for recording, owner in zip(recordings, sensors, strict=True)
        if owner == sensor
        for gaps in _gaps_s(recording, frames)
    ]
    if sum(map(len, apart)) == 0:  # a single frame
        return STEP_US
    cycle_s = float(np.median(np.concatenate(apart)))
    if cycle_s > LONGEST_CYCLE_S:
        raise UsageError(
            f"the frames of {sensor} lie {cycle_s:.3g} s apart: no cycle of a radar",
            hint=f"state its cycle, such as {sensor}=100ms",
        )
    return max(round(cycle_s * 1000) * 1000, STEP_US)


def _gaps_s(recording: Recording, frames: int) -> Iterator[Floats]:
    """Yield the times from frame to frame at the begin of a recording."""
    last, done = np.nan, 0
    for detections in recording.read():
        gaps = np.diff(detections.time, prepend=last)
        gaps = gaps[gaps > 0.0]
        yield gaps
        last, done = float(detections.time[-1]), done + len(gaps)
        if done >= frames:
            return


@dataclass(frozen=True, kw_only=True)
class Runs:
    """A set of steps: runs that ascend and do not touch.

    Parameters
    ----------
    first, last : (n,) int64 arrays
        First and last step of each run, inclusive.
    """

    first: Integers
    last: Integers

    def __len__(self) -> int:
        return len(self.first)

    @property
    def steps(self) -> int:
        """Number of steps in the set."""
        return int((self.last - self.first + 1).sum())

    def before(self, step: Integers) -> Integers:
        """Return how many steps of the set come before each of the given steps."""
        length = self.last - self.first + 1
        done = np.concatenate([[0], np.cumsum(length)])
        run = np.searchsorted(self.first, step) - 1
        begun = run >= 0
        inside = np.minimum(step - self.first[run], length[run]) if len(self) else 0
        return np.where(begun, done[np.maximum(run, 0)] + inside, 0)

    def within(self, first: int, last: int) -> Runs:
        """Return the part of the set from step `first` to step `last`, inclusive."""
        kept = (self.last >= first) & (self.first <= last)
        return Runs(
            first=np.maximum(self.first[kept], first), last=np.minimum(self.last[kept], last)
        )

    def nearest(self, step: int) -> int:
        """Return the step of the set nearest to `step`."""
        inside = np.clip(step, self.first, self.last)
        return int(inside[np.argmin(np.abs(inside - step))])


def union(parts: Sequence[Runs]) -> Runs:
    """Return the steps that are in any of the sets, each of them once."""
    first = np.concatenate([part.first for part in parts])
    order = np.argsort(first, kind="stable")
    first = first[order]
    reached = np.maximum.accumulate(np.concatenate([part.last for part in parts])[order])
    apart = first[1:] > reached[:-1] + 1
    begins, ends = np.ones(len(first), np.bool_), np.ones(len(first), np.bool_)
    begins[1:] = ends[:-1] = apart
    return Runs(first=first[begins], last=reached[ends])


def steps_in(frames: pd.DataFrame) -> Runs:
    """Return the steps in any row of a table of frames."""
    first, last = (frames[name].to_numpy(np.int64) for name in ("first_step", "last_step"))
    return union([Runs(first=first, last=last)])
