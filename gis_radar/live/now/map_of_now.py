"""Map of now: windows of 50 ms that all sensors fill, and the tiles hit in the last closed one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gis_radar.base import STEP_US, Booleans, Integers, iso_from_step
from gis_radar.measures import valid_steps

MOST_STEPS = 1_200  # most steps closed at once: after a longer pause the map starts from zero
_BACK_STEPS = 40  # clocks set back by more, 2 s, make the map start from zero


class SensorReport(NamedTuple):
    """Tiles that a sensor hits and has in sight in a step.

    Parameters
    ----------
    tiles : (k,) int64 array
        Positions of the tiles that the sensor hit.
    in_sight : (n,) int64 array
        Positions of the tiles in the sensor's sight.
    """

    tiles: Integers
    in_sight: Integers


class Windows:
    """Windows: steps that are open for frames on their way.

    A step is closed `lateness_s` after its end; a frame that arrives later is stored like any
    other, but left out of the map of now.

    Parameters
    ----------
    lateness_s : float
        How long after its end a step stays open, seconds.
    """

    def __init__(self, lateness_s: float) -> None:
        self._lateness_us = round(lateness_s * 1e6)
        self._open: dict[int, dict[str, SensorReport]] = {}
        self._closed: int | None = None  # the last closed step

    def add(self, sensor: str, step: int, seen: SensorReport) -> bool:
        """Add a frame; return whether its step was still open."""
        if self._closed is not None and step <= self._closed:
            return False
        sensors = self._open.setdefault(step, {})
        if (other := sensors.get(sensor)) is not None:
            seen = SensorReport(np.union1d(other.tiles, seen.tiles), seen.in_sight)
        sensors[sensor] = seen
        return True

    def close(self, now_us: int) -> Iterator[tuple[int, dict[str, SensorReport]]]:
        """Close the steps that are over, in order; yield each with the reports by sensor.

        Parameters
        ----------
        now_us : int
            Microseconds since 1970.
        """
        last = (now_us - self._lateness_us) // STEP_US - 1
        if self._closed is None:
            self._closed = min(self._open, default=last + 1) - 1
        if last < self._closed - _BACK_STEPS:
            # else no step would be closed until it is as late again
            self._closed = last - 1
            self._open = {step: seen for step, seen in self._open.items() if step >= last}
        if last - self._closed > MOST_STEPS:
            self._closed = last - MOST_STEPS
            self._open = {step: seen for step, seen in self._open.items() if step > self._closed}
        while self._closed < last:
            self._closed += 1
            yield self._closed, self._open.pop(self._closed, {})


@dataclass(frozen=True, kw_only=True)
class MapState:
    """Immutable state of the map, for other threads.

    Parameters
    ----------
    step : int
        The last closed step.
    hit, observed : (n,) bool arrays
        Whether each tile is hit and observed in that step, by position.
    """

    step: int
    hit: Booleans
    observed: Booleans

    @property
    def time(self) -> str:
        """Begin of the step, ISO 8601."""
        return iso_from_step(self.step)


class MapOfNow:
    """Map of the tiles hit in the last closed window; frames are valid as in a dataset.

    Parameters
    ----------
    tiles : int
        Number of tiles.

    Attributes
    ----------
    validity_s : dict
        How long a frame is valid, seconds, by sensor; 0 for sensors that it does not name.
    """

    def __init__(self, tiles: int) -> None:
        self.validity_s: dict[str, float] = {}
        self._tiles = tiles
        self._latest: dict[str, tuple[int, SensorReport]] = {}
        nowhere = np.zeros(tiles, np.bool_)
        self._state = MapState(step=0, hit=nowhere, observed=nowhere)

    def take(self, step: int, frames: Mapping[str, SensorReport]) -> MapState:
        """Process a closed step, and return the map of it.

        Parameters
        ----------
        step : int
            The step; steps come in order, without gaps, until a clock is set back.
        frames : mapping
            Reports of the sensors that have a frame in it.
        """
        hit, observed = (np.zeros(self._tiles, np.bool_) for _ in range(2))
        if step <= self._state.step:
            self._latest.clear()
        for sensor, seen in frames.items():
            self._latest[sensor] = (step, seen)
        for sensor, (since, seen) in self._latest.items():
            if step - since <= valid_steps(self.validity_s.get(sensor, 0.0)):
                hit[seen.tiles] = True
                observed[seen.in_sight] = True
        hit &= observed  # as in a heat map, a hit outside every sight does not count
        # a new state, as other threads may still read the last one
        self._state = MapState(step=step, hit=hit, observed=observed)
        return self._state

    def state(self) -> MapState:
        """Return the present state of the map."""
        return self._state
