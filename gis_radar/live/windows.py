"""Windows of 50 ms: what all sensors report of a step, complete a stated time after its end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gis_radar.arrays import Integers
from gis_radar.steps import STEP_US

MOST_STEPS = 1_200  # that are closed at once: after a longer standstill the map begins anew
BACK_STEPS = 40  # a clock that is set back by more begins anew: 2 s
AHEAD_STEPS = 200  # a frame further in the future is of a wrong clock: 10 s


class Seen(NamedTuple):
    """What a sensor reports of a step.

    Parameters
    ----------
    tiles : (k,) int64 array
        Positions of the tiles that it hit.
    in_sight : (n,) int64 array
        Positions of the tiles that it sees.
    """

    tiles: Integers
    in_sight: Integers


class Windows:
    """Steps that are open: frames may still come.

    A step is closed once its end is `lateness_s` ago; a frame that comes later is stored like any
    other, and left out of the map of now.

    Parameters
    ----------
    lateness_s : float
        How long after its end a step stays open, seconds.

    Attributes
    ----------
    late, early : int
        Frames of steps that were closed, and of steps too far ahead.
    """

    def __init__(self, lateness_s: float) -> None:
        self.late = self.early = 0
        self._lateness_us = round(lateness_s * 1e6)
        self._open: dict[int, dict[str, Seen]] = {}
        self._closed: int | None = None  # the last step

    def add(self, sensor: str, step: int, seen: Seen) -> bool:
        """Take a frame; return whether its step was still open."""
        if self._closed is not None and step <= self._closed:
            self.late += 1
            return False
        if self._closed is not None and step > self._closed + AHEAD_STEPS + self._waiting:
            self.early += 1
            return False
        sensors = self._open.setdefault(step, {})
        if (other := sensors.get(sensor)) is not None:
            seen = Seen(np.union1d(other.tiles, seen.tiles), seen.in_sight)
        sensors[sensor] = seen
        return True

    @property
    def _waiting(self) -> int:
        return self._lateness_us // STEP_US + 1

    def close(
        self, now_us: int, *, most: int = MOST_STEPS
    ) -> Iterator[tuple[int, dict[str, Seen]]]:
        """Close the steps that are over, in order; yield each with what was seen by sensor.

        Parameters
        ----------
        now_us : int
            Microseconds since 1970.
        most : int
            How many are closed at most; of more, the earliest are left out.
        """
        last = (now_us - self._lateness_us) // STEP_US - 1
        if self._closed is None:
            self._closed = min(self._open, default=last + 1) - 1
        if (
            last < self._closed - BACK_STEPS
        ):  # else no step would be closed until it is as late again
            self._closed = last - 1
            self._open = {step: seen for step, seen in self._open.items() if step >= last}
        if last - self._closed > most:
            self._closed = last - most
            for step in [step for step in self._open if step <= self._closed]:
                self.late += len(self._open.pop(step))
        while self._closed < last:
            self._closed += 1
            yield self._closed, self._open.pop(self._closed, {})
