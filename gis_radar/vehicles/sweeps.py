"""Sweeps: when vehicles drove over which place of the lanes, so that nobody stood there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats, nearest
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.life_settings import StandingSettings
from gis_radar.vehicles.motion import Motion
from gis_radar.vehicles.strips import Strips

CELLS = 100_000  # of a strip, more than the longest has


@dataclass(frozen=True, kw_only=True)
class Sweeps:
    """When vehicles drove over half-metre cells of strips.

    Parameters
    ----------
    strips : Strips
        The strips.
    times : dict
        By cell, ascending UNIX seconds.
    cell_m : float
        Length of a cell.
    fast : dict
        As `times`, of those only that nobody who stands would follow at once.
    """

    strips: Strips
    times: dict[int, Floats]
    cell_m: float
    fast: dict[int, Floats]

    @classmethod
    def of(
        cls, motions: Sequence[Motion], echoes: Echoes, strips: Strips, settings: StandingSettings
    ) -> Sweeps:
        """Take the middles of vehicles that drive, while they are seen."""
        places, when, pace = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0)]
        for motion in motions:
            every = np.arange(0, len(motion.s_m), 2)
            time = (motion.first_step + every) / STEPS_PER_SECOND
            seen = echoes.time[motion.rows]
            near = np.abs(time - seen[nearest(seen, time)])
            drives = (motion.speed[every] > settings.sweep_mps) & (near < settings.sweep_seen_s)
            if drives.sum() >= 3:
                places.append(motion.places[0][every[drives]])
                when.append(time[drives])
                pace.append(motion.speed[every[drives]])
        at = strips.lay(np.vstack(places))
        cell_m = 2.0 * settings.cell_m
        times: dict[int, list[float]] = {}
        fast: dict[int, list[float]] = {}
        inside = at.edge_m > settings.sweep_edge_m
        rows = at.row[inside]
        for strip, s, moment, speed in zip(
            at.strip[inside].tolist(), at.s_m[inside].tolist(),
            np.concatenate(when)[rows].tolist(), np.concatenate(pace)[rows].tolist(), strict=True,
        ):  # fmt: skip
            for cell in range(int((s - 0.5) / cell_m), int((s + 0.5) / cell_m) + 1):
                times.setdefault(strip * CELLS + cell, []).append(moment)
                if speed > settings.fast_mps:
                    fast.setdefault(strip * CELLS + cell, []).append(moment)
        return cls(strips=strips, times=_sorted(times), cell_m=cell_m, fast=_sorted(fast))

    def after(self, place: Floats, time: float) -> float:
        """Return when a place is driven over next, a second after a time at the soonest."""
        known = self._over(place)
        k = int(np.searchsorted(known, time + 1.0))
        return float(known[k]) if k < len(known) else np.inf

    def before(self, place: Floats, time: float) -> float:
        """Return when a place was driven over last, a second before a time at the latest."""
        known = self._over(place)
        k = int(np.searchsorted(known, time - 1.0)) - 1
        return float(known[k]) if k >= 0 else -np.inf

    def _over(self, place: Floats) -> Floats:
        """Return when a place is driven over."""
        at = self.strips.lay(place[None])
        if len(at.row) == 0:
            return np.zeros(0)
        cell = int(at.strip[0]) * CELLS + int(at.s_m[0] / self.cell_m)
        return self.times.get(cell, np.zeros(0))


def _sorted(times: dict[int, list[float]]) -> dict[int, Floats]:
    return {cell: np.sort(np.array(each)) for cell, each in times.items()}
