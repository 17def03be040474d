"""The map of now: which tiles are occupied at this moment, and how long they were lately."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Booleans, Integers
from gis_radar.live.windows import Seen
from gis_radar.occupancy.frame_steps import steps_held
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
    occupied, observed : (n,) bool arrays
        In that step, by position of the tiles.
    occupied_steps, observed_steps : (n,) int64 arrays
        Steps since the begin.
    """

    step: int
    begin: int
    occupied: Booleans
    observed: Booleans
    occupied_steps: Integers
    observed_steps: Integers

    @property
    def time(self) -> str:
        """When the step begins, ISO 8601."""
        return iso_from_step(self.step)


class MapOfNow:
    """Counts closed windows: a frame covers steps as in an occupancy that is read.

    Parameters
    ----------
    tiles : int
        How many there are.
    interval : int
        Steps over which the cumulative counts run; they begin anew at its multiples.
    """

    def __init__(self, tiles: int, *, interval: int) -> None:
        self.views: dict[str, Booleans] = {}
        self.holds_s: dict[str, float] = {}
        self._tiles, self._interval = tiles, interval
        self._latest: dict[str, tuple[int, Seen]] = {}
        self._begin = self._step = 0
        self._occupied, self._observed = (np.zeros(tiles, np.bool_) for _ in range(2))
        self._occupied_steps, self._observed_steps = (np.zeros(tiles, np.int64) for _ in range(2))

    def take(self, step: int, frames: Mapping[str, Seen]) -> None:
        """Count a closed step; steps come in order, none left out.

        Parameters
        ----------
        step : int
            The step.
        frames : mapping
            What sensors that have a frame in it report.
        """
        if (begin := step - step % self._interval) != self._begin:
            self._begin = begin
            self._occupied_steps[:] = self._observed_steps[:] = 0
        self._step = step
        self._occupied[:] = self._observed[:] = False
        for sensor, seen in frames.items():
            self._latest[sensor] = (step, seen)
        for sensor, (since, seen) in self._latest.items():
            if step - since <= steps_held(self.holds_s.get(sensor, 0.0)):
                self._occupied[seen.tiles] = True
                view = self.views.get(seen.view)
                if view is not None:
                    self._observed |= view
        self._occupied &= self._observed  # as a heat map: a hit beyond every view is none
        self._occupied_steps += self._occupied
        self._observed_steps += self._observed

    @property
    def step(self) -> int:
        """The last step that counts."""
        return self._step

    @property
    def now(self) -> tuple[Booleans, Booleans]:
        """Which tiles are occupied and observed in that step: to be looked at only."""
        return self._occupied, self._observed

    def state(self) -> MapState:
        """Return the map as it stands: a copy."""
        return MapState(
            step=self._step, begin=self._begin, occupied=self._occupied.copy(),
            observed=self._observed.copy(), occupied_steps=self._occupied_steps.copy(),
            observed_steps=self._observed_steps.copy(),
        )  # fmt: skip
