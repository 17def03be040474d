"""Recent counts of steps in which tiles were hit and observed."""

from __future__ import annotations

from threading import Lock
from typing import TypeAlias

import numpy as np

from gis_radar.base import Booleans, Integers

MINUTE = 1_200  # steps
MINUTES = 15  # length of a moving sum
QUARTER, _QUARTERS = 15 * MINUTE, 5  # quarters kept until the dataset has them: an hour and more
EndedInterval: TypeAlias = tuple[int, Integers]
"""Number of an interval, and (2, n) steps in which tiles were hit and observed in it."""


class _Intervals:
    """Counts of the last intervals, in a ring of rows."""

    def __init__(self, tiles: int, steps: int, kept: int) -> None:
        self.steps, self.number = steps, -1
        self.rows = np.zeros((kept, 2, tiles), np.int32)

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a step."""
        number, kept = step // self.steps, len(self.rows)
        if number != self.number:
            passed = range(max(self.number, number - kept) + 1, number + 1)
            self.rows[[each % kept for each in passed]] = 0
            self.number = number
        self.rows[number % kept] += [hit, observed]


class RecentCounts:
    """Counter of steps in which tiles are hit and observed; safe to read from another thread.

    Parameters
    ----------
    tiles : int
        Number of tiles.
    interval : int
        Length of the intervals of the cumulative map, steps; they begin at multiples of it.
    """

    def __init__(self, tiles: int, *, interval: int = QUARTER) -> None:
        self._kinds = {
            "minutes": _Intervals(tiles, MINUTE, MINUTES),
            "quarters": _Intervals(tiles, QUARTER, _QUARTERS),
            "interval": _Intervals(tiles, interval, 1),
        }
        self.step = -1
        self._lock = Lock()

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a step.

        Parameters
        ----------
        step : int
            The step; steps ascend, until a clock is set back.
        hit, observed : (n,) bool arrays
            Whether each tile is hit and observed in it.
        """
        with self._lock:
            if step <= self.step:  # the clock was set back: start from zero
                for each in self._kinds.values():
                    each.number, each.rows[:] = -1, 0
            self.step = step
            for each in self._kinds.values():
                each.take(step, hit, observed)

    def last_minutes(self) -> tuple[Integers, Integers]:
        """Return the steps of the last 14 to 15 min in which each tile was hit and observed."""
        return self._sums("minutes")

    def since_begin(self) -> tuple[Integers, Integers]:
        """Return the same for the present interval of the cumulative map."""
        return self._sums("interval")

    def _sums(self, kind: str) -> tuple[Integers, Integers]:
        with self._lock:
            hit, observed = self._kinds[kind].rows.sum(axis=0, dtype=np.int64)
        return hit, observed

    def quarters(self) -> list[EndedInterval]:
        """Return the last quarters of an hour of which a tile was observed, in order."""
        found = self._kinds["quarters"]
        with self._lock:
            numbers = range(max(found.number - _QUARTERS + 1, 0), found.number + 1)
            rows = [(each, found.rows[each % _QUARTERS].copy()) for each in numbers]
        return [(number, counts) for number, counts in rows if counts[1].any()]
