"""The map of now: which tiles are hit at this moment, and how long they were lately."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Booleans, Integers
from gis_radar.live.windows import Seen
from gis_radar.measures.validity import valid_steps
from gis_radar.steps import iso_from_step


@dataclass(frozen=True, kw_only=True)
class MapState:
    """The map as it stands, to be looked at by other threads.

    Parameters
    ----------
    step : int
        The last step that counts.
    begin : int
        The step from which the cumulative counts run.
    hit, observed : (n,) bool arrays
        In that step, by position of the tiles.
    hit_steps, observed_steps : (n,) int64 arrays
        Steps since the begin.
    """

    step: int
    begin: int
    hit: Booleans
    observed: Booleans
    hit_steps: Integers
    observed_steps: Integers

    @property
    def time(self) -> str:
        """When the step begins, ISO 8601."""
        return iso_from_step(self.step)


class MapOfNow:
    """Counts closed windows; frames are valid in steps as in a dataset.

    Parameters
    ----------
    tiles : int
        How many there are.
    interval : int
        Steps over which the cumulative counts run; they begin anew at its multiples.
    """

    def __init__(self, tiles: int, *, interval: int) -> None:
        self.holds_s: dict[str, float] = {}
        self._tiles, self._interval = tiles, interval
        self._latest: dict[str, tuple[int, Seen]] = {}
        nowhere, never = np.zeros(tiles, np.bool_), np.zeros(tiles, np.int64)
        self._state = MapState(step=0, begin=0, hit=nowhere, observed=nowhere,
                               hit_steps=never, observed_steps=never)  # fmt: skip

    def take(self, step: int, frames: Mapping[str, Seen]) -> None:
        """Count a closed step; steps come in order, none left out, until a clock is set back.

        Parameters
        ----------
        step : int
            The step.
        frames : mapping
            What sensors that have a frame in it report.
        """
        last, begin = self._state, step - step % self._interval
        hit, observed = (np.zeros(self._tiles, np.bool_) for _ in range(2))
        set_back = step <= last.step
        if set_back:
            self._latest.clear()
        for sensor, seen in frames.items():
            self._latest[sensor] = (step, seen)
        for sensor, (since, seen) in self._latest.items():
            if step - since <= valid_steps(self.holds_s.get(sensor, 0.0)):
                hit[seen.tiles] = True
                observed[seen.in_sight] = True
        hit &= observed  # as a heat map: a hit beyond every view is none
        anew = set_back or begin != last.begin
        # whoever looks meanwhile has the last one: arrays of a state never change
        self._state = MapState(
            step=step, begin=begin, hit=hit, observed=observed,
            hit_steps=hit + (0 if anew else last.hit_steps),
            observed_steps=observed + (0 if anew else last.observed_steps),
        )  # fmt: skip

    @property
    def step(self) -> int:
        """The last step that counts."""
        return self._state.step

    def state(self) -> MapState:
        """Return the map as it stands."""
        return self._state
