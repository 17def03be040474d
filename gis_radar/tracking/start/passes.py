"""Passes: when vehicles drove over places of the lanes, so that no vehicle stood there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gis_radar.base import STEPS_PER_SECOND, Floats, nearest
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.start.strips import Strips

CELLS = 100_000  # most cells of a strip, more than the longest has
TWO_CELLS_M = 0.5  # length of two cells, whose size is that of the cells in `stationary`
# A vehicle drives over a place if it is at least so fast, was detected within this time of the
# moment, and its middle comes so near to the place, or to the middle of the lane: half the width of
# two cars and the error of their places. With 0.7 and 1.3 m the occupancies of towns change by less
# than 0.3 %.
PASS_MPS, PASS_SEEN_S, PASS_NEAR_M = 1.5, 0.75, 1.0
FAST_MPS = 4.0  # just before and after a pass at this speed, no vehicle stands at the place


@dataclass(frozen=True, kw_only=True)
class Passes:
    """Times at which vehicles drove over half-metre cells of strips, and over any place.

    Parameters
    ----------
    strips : Strips
        The strips.
    tree, when : cKDTree, (n,) array
        Places (n, 2) of the middles of driving vehicles, and their times, UNIX seconds.
    times : dict
        By cell, the times of passes, ascending UNIX seconds.
    fast : dict
        As `times`, of passes faster than `FAST_MPS` only.
    """

    strips: Strips
    tree: cKDTree
    when: Floats
    times: dict[int, Floats]
    fast: dict[int, Floats]

    @classmethod
    def of(cls, motions: Sequence[Motion], detections: MapDetections, strips: Strips) -> Passes:
        """Collect the middles of moving vehicles while they are detected."""
        places, when, pace = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0)]
        for motion in motions:
            time = (motion.first_step + np.arange(len(motion.s_m))) / STEPS_PER_SECOND
            seen = detections.time[motion.rows]
            near = np.abs(time - seen[nearest(seen, time)])
            drives = (motion.speed > PASS_MPS) & (near < PASS_SEEN_S)
            if drives.sum() >= 3:
                places.append(motion.places[0][drives])
                when.append(time[drives])
                pace.append(motion.speed[drives])
        every = np.concatenate(when)
        at = strips.lay(np.vstack(places), PASS_NEAR_M)
        times: dict[int, list[float]] = {}
        fast: dict[int, list[float]] = {}
        for strip, s, moment, speed in zip(
            at.strip.tolist(), at.s_m.tolist(), every[at.row].tolist(),
            np.concatenate(pace)[at.row].tolist(), strict=True,
        ):  # fmt: skip
            for cell in range(int((s - 0.5) / TWO_CELLS_M), int((s + 0.5) / TWO_CELLS_M) + 1):
                times.setdefault(strip * CELLS + cell, []).append(moment)
                if speed > FAST_MPS:
                    fast.setdefault(strip * CELLS + cell, []).append(moment)
        return cls(
            strips=strips, tree=cKDTree(np.vstack(places)), when=every,
            times=_sorted(times), fast=_sorted(fast),
        )  # fmt: skip

    def after(self, body: Floats, time: float) -> float:
        """Return the next pass over points of a body, (k, 2), a second or more after a time."""
        known = self._over(body)
        k = int(np.searchsorted(known, time + 1.0))
        return float(known[k]) if k < len(known) else np.inf

    def before(self, body: Floats, time: float) -> float:
        """Return the time of the last pass over points of a body, a second before or more."""
        known = self._over(body)
        k = int(np.searchsorted(known, time - 1.0)) - 1
        return float(known[k]) if k >= 0 else -np.inf

    def _over(self, body: Floats) -> Floats:
        """Return the times of passes over points."""
        near = self.tree.query_ball_point(np.atleast_2d(body), PASS_NEAR_M)
        rows = np.unique(np.concatenate([np.zeros(0), *near])).astype(np.int64)
        return np.sort(self.when[rows])


def _sorted(times: dict[int, list[float]]) -> dict[int, Floats]:
    return {cell: np.sort(np.array(each)) for cell, each in times.items()}
