"""Counts of the last 15 minutes by tile, and of the last day by lane and 15 minutes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from threading import Lock

import numpy as np
import pandas as pd

from gis_radar.base import STEP_S, Booleans, Floats, Integers, step_begin
from gis_radar.products import lane_totals

MINUTE = 1_200  # steps
MINUTES = 15  # of a moving sum, and of an interval
INTERVAL = MINUTES * MINUTE  # steps
KEPT = 96  # intervals: a day


class RecentCounts:
    """Counts steps in which tiles are hit and observed; safe to read from another thread.

    Parameters
    ----------
    lane_of_tile : (n,) int64 array
        Of each tile, the position of its lane.
    lanes : sequence of int
        Numbers of the lanes.
    """

    def __init__(self, lane_of_tile: Integers, lanes: Sequence[int]) -> None:
        self._lane_of_tile, self._lanes = lane_of_tile, list(lanes)
        self._tiles_of_lane = np.maximum(np.bincount(lane_of_tile, minlength=len(lanes)), 1)
        # a row a minute, in turn: hit, observed
        self._by_minute = np.zeros((2, MINUTES, len(lane_of_tile)), np.int64)
        self._interval = np.zeros((2, len(lane_of_tile)), np.int64)
        self._done: deque[tuple[int, Floats]] = deque(maxlen=KEPT)
        self._minute = self._number = -1
        self._lock = Lock()

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a step; steps ascend, until a clock is set back.

        Parameters
        ----------
        step : int
            The step.
        hit, observed : (n,) bool arrays
            Which tiles are, in it.
        """
        with self._lock:
            self._begin_anew(step)
            slot = self._by_minute[:, self._minute % MINUTES]
            for counts in (slot, self._interval):
                counts[0] += hit
                counts[1] += observed

    def _begin_anew(self, step: int) -> None:
        """Clear what is of an earlier minute or interval."""
        minute, number = step // MINUTE, step // INTERVAL
        if minute < self._minute:  # the clock was set back
            self._by_minute[:], self._minute = 0, minute
        if number < self._number:
            self._interval[:], self._number = 0, number
            self._done = deque((each for each in self._done if each[0] < number), maxlen=KEPT)
        if minute != self._minute:
            passed = range(max(self._minute + 1, minute - MINUTES + 1), minute + 1)
            self._by_minute[:, [each % MINUTES for each in passed]] = 0
            self._minute = minute
        if number != self._number:
            if self._number >= 0:
                self._done.append((self._number, self._by_lane()))
            self._interval[:] = 0
            self._number = number

    def last_minutes(self) -> tuple[Integers, Integers]:
        """Return the steps in which each tile was hit and observed: 14 to 15 minutes."""
        with self._lock:
            hit, observed = self._by_minute.sum(axis=1)
        return hit, observed

    def lane_intervals(self) -> pd.DataFrame:
        """Return `lane, begin, end` (UTC), `hit_s, observed_s`: means of a lane's tiles."""
        with self._lock:
            rows = [*self._done]
            if self._number >= 0:
                rows.append((self._number, self._by_lane()))
        tables = [
            pd.DataFrame(
                {
                    "lane": self._lanes,
                    "begin": step_begin(number * INTERVAL),
                    "end": step_begin((number + 1) * INTERVAL),
                    "hit_s": seconds[0],
                    "observed_s": seconds[1],
                }
            )
            for number, seconds in rows
        ]
        names = ["lane", "begin", "end", "hit_s", "observed_s"]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=names)

    def _by_lane(self) -> Floats:
        size = len(self._lanes)
        sums = [lane_totals(row.astype(float), self._lane_of_tile, size) for row in self._interval]
        return np.asarray(sums) / self._tiles_of_lane * STEP_S
