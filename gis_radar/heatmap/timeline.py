"""The intervals in which steps are counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Integers
from gis_radar.occupancy.runs import Runs


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Intervals that ascend and do not overlap.

    Parameters
    ----------
    begin, end : (n,) int64 arrays
        First step of each interval, and the step after its last.
    """

    begin: Integers
    end: Integers

    def __len__(self) -> int:
        return len(self.begin)

    def counts(self, runs: Runs) -> Integers:
        """Return how many steps of a set fall in each interval."""
        return runs.before(self.end) - runs.before(self.begin)

    def find(self, step: Integers) -> Integers:
        """Return the interval of each step, -1 where it lies in none."""
        interval = np.searchsorted(self.begin, step, side="right") - 1
        inside = (interval >= 0) & (step < self.end[interval])
        return np.where(inside, interval, -1)


def aligned(first: int, last: int, steps: int) -> Timeline:
    """Return all intervals from that of step `first` to that of step `last`.

    Parameters
    ----------
    first, last : int
        Steps.
    steps : int
        Length of an interval; intervals begin at multiples of it since the UNIX epoch.
    """
    begin = np.arange(first // steps, last // steps + 1, dtype=np.int64) * steps
    return Timeline(begin=begin, end=begin + steps)


def intervals_with(runs: Runs, steps: int) -> int:
    """Return how many aligned intervals hold a step of the set, without listing them."""
    low, high = runs.first // steps, runs.last // steps
    return int((high - low + 1).sum() - np.count_nonzero(low[1:] == high[:-1]))


def aligned_with(runs: Runs, steps: int) -> Timeline:
    """Return only those aligned intervals that hold a step of the set."""
    low, high = runs.first // steps, runs.last // steps
    low[1:] += low[1:] == high[:-1]  # counted with the run before
    length = high - low + 1
    offset = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    begin = (np.repeat(low, length) + offset) * steps
    return Timeline(begin=begin, end=begin + steps)


def those_with(timeline: Timeline, runs: Runs) -> Timeline:
    """Return only those intervals that hold a step of the set."""
    filled = timeline.counts(runs) > 0
    return Timeline(begin=timeline.begin[filled], end=timeline.end[filled])
