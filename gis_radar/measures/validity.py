"""Validity of frames, and sets of steps kept as runs.

A frame is valid in its own step and the following ones up to its sensor's next frame, at most
`validity / 50 ms` of them, rounded down. All frames of a sensor in one step count as one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gis_radar.base import (
    CYCLE_HINT,
    LONGEST_CYCLE_S,
    SHORTEST_CYCLE_S,
    STEP_US,
    Integers,
    UsageError,
)

# Validity without a stated cycle: two cycles of 50 ms, so that one lost frame leaves no gap.
VALIDITY_S = 0.1
# Validity with a stated cycle, in cycles: more than any jitter, and less than two, so that time
# without frames is not observed.
CYCLES_VALID = 1.5
_GAP_US = 100  # resolution of the histogram of gaps: finer than jitter
_MOST_GAPS = round(LONGEST_CYCLE_S * 1e6) // _GAP_US  # classes of the histogram


def validity_of(cycles: Mapping[str, float] | None, sensors: Sequence[str]) -> dict[str, float]:
    """Return the validity of the frames of each sensor, seconds.

    Parameters
    ----------
    cycles : mapping, optional
        The stated time from frame to frame of some sensors, seconds.
    sensors : sequence of str
        All sensors.

    Raises
    ------
    UsageError
        If a cycle is no duration of 1 ms to 2 s, or of a sensor that is not there.
    """
    if isinstance(cycles, str):
        raise UsageError("cycles is {}, expected seconds by sensor", repr(cycles), hint=CYCLE_HINT)
    validity = dict.fromkeys(sensors, VALIDITY_S)
    for sensor, cycle_s in (cycles or {}).items():
        if sensor not in validity:
            others = ", ".join(validity)
            raise UsageError("a cycle is given for {}, but the poses are of {}", sensor, others)
        if not SHORTEST_CYCLE_S <= cycle_s <= LONGEST_CYCLE_S:
            raise UsageError(
                "the cycle of {} is {} s, expected {:g} to {:g}",
                sensor,
                cycle_s,
                SHORTEST_CYCLE_S,
                LONGEST_CYCLE_S,
                hint="the time from one of its frames to the next, such as 150ms",
            )
        validity[sensor] = round(CYCLES_VALID * cycle_s, 6)
    return validity


def valid_steps(validity_s: float) -> int:
    """Return the greatest number of steps after its own in which a frame is valid."""
    return round(validity_s * 1e6) // STEP_US


@dataclass(kw_only=True)
class FrameTimes:
    """Times of the frames of a sensor: the first, the last, and a histogram of the gaps.

    Parameters
    ----------
    frames : int
        Number of frames so far.
    first_us, last_us : int
        Time of the first and of the last one, microseconds since the UNIX epoch.
    gaps, sums_us : (m,) int64 arrays
        Number of gaps between frames by their length in `_GAP_US`, and the sum of their lengths.
    """

    frames: int = 0
    first_us: int = 0
    last_us: int = 0
    gaps: Integers = field(default_factory=lambda: np.zeros(_MOST_GAPS, np.int64))
    sums_us: Integers = field(default_factory=lambda: np.zeros(_MOST_GAPS, np.int64))

    def add(self, time_us: Integers) -> None:
        """Add frames that follow those so far."""
        if self.frames == 0:
            self.first_us = self.last_us = int(time_us[0])
        gap_us = np.diff(time_us, prepend=self.last_us)
        gap_us = gap_us[(gap_us > 0) & (gap_us < _MOST_GAPS * _GAP_US)]
        self.gaps += np.bincount(gap_us // _GAP_US, minlength=_MOST_GAPS)
        self.sums_us += np.bincount(gap_us // _GAP_US, gap_us, _MOST_GAPS).astype(np.int64)
        self.last_us = int(time_us[-1])
        self.frames += len(time_us)

    def join(self, later: FrameTimes) -> None:
        """Add the frames of another period."""
        if later.frames == 0:
            return
        known = self.frames > 0
        self.first_us = min(self.first_us, later.first_us) if known else later.first_us
        self.last_us = max(self.last_us, later.last_us) if known else later.last_us
        self.frames += later.frames
        self.gaps = self.gaps + later.gaps
        self.sums_us = self.sums_us + later.sums_us

    @property
    def cycle_us(self) -> float:
        """Median time from frame to frame, microseconds; infinite for a single frame."""
        done = np.cumsum(self.gaps)
        if done[-1] == 0:
            return np.inf
        middle = int(np.searchsorted(done, done[-1] / 2))
        return float(self.sums_us[middle] / self.gaps[middle])


@dataclass(frozen=True, kw_only=True)
class Runs:
    """A set of steps, as ascending runs that do not touch.

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
        """Return the number of steps of the set before each of the given steps."""
        length = self.last - self.first + 1
        done = np.concatenate([[0], np.cumsum(length)])
        run = np.searchsorted(self.first, step) - 1
        begun = run >= 0
        inside = np.minimum(step - self.first[run], length[run]) if len(self) else 0
        return np.where(begun, done[np.maximum(run, 0)] + inside, 0)

    def within(self, first: int, last: int) -> Runs:
        """Return the part of the set from step `first` to step `last`, inclusive."""
        inside = (self.last >= first) & (self.first <= last)
        return Runs(
            first=np.maximum(self.first[inside], first), last=np.minimum(self.last[inside], last)
        )

    def nearest(self, step: int) -> int:
        """Return the step of the set nearest to `step`."""
        inside = np.clip(step, self.first, self.last)
        return int(inside[np.argmin(np.abs(inside - step))])


def union_of_runs(parts: Sequence[Runs]) -> Runs:
    """Return the steps that are in any of the sets, each of them once."""
    first = np.concatenate([part.first for part in parts])
    order = np.argsort(first, kind="stable")
    first = first[order]
    reached = np.maximum.accumulate(np.concatenate([part.last for part in parts])[order])
    apart = first[1:] > reached[:-1] + 1
    begins, ends = np.ones(len(first), np.bool_), np.ones(len(first), np.bool_)
    begins[1:] = ends[:-1] = apart
    return Runs(first=first[begins], last=reached[ends])
