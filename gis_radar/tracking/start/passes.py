"""Passes: times at which vehicles drove over places of lanes, so that no vehicle stood there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gis_radar.base import STEPS_PER_SECOND, Floats, nearest
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.start.strips import Strips

MOST_CELLS = 100_000  # most cells of a strip: numbers of cells of all strips are made with it
PAIR_M = 0.5  # length of a cell here: two cells of `stationary`
# A vehicle drives over a place if it is at least so fast, was detected within this time of the
# moment, and its middle comes so near to the place, or to the middle of the lane: half the width of
# two cars and the error of their places. With 0.7 and 1.3 m the occupancies of towns change by less
# than 0.3 %.
_PASS_MPS, _PASS_SEEN_S, _PASS_NEAR_M = 1.5, 0.75, 1.0
_FAST_MPS = 4.0  # just before and after a faster pass, no vehicle stands at the place


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
        By the number of a cell, the times of passes, ascending UNIX seconds.
    fast : dict
        As `times`, of passes faster than `_FAST_MPS` only.
    """

    strips: Strips
    tree: cKDTree
    when: Floats
    times: dict[int, Floats]
    fast: dict[int, Floats]

    @classmethod
    def of(cls, motions: Sequence[Motion], detections: MapDetections, strips: Strips) -> Passes:
        """Find the passes of motions while they are detected."""
        places, when, speeds = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0)]
        for motion in motions:
            time = (motion.first_step + np.arange(len(motion.s_m))) / STEPS_PER_SECOND
            seen = detections.time[motion.rows]
            since_s = np.abs(time - seen[nearest(seen, time)])
            drives = (motion.speed > _PASS_MPS) & (since_s < _PASS_SEEN_S)
            if drives.sum() >= 3:
                places.append(motion.places[0][drives])
                when.append(time[drives])
                speeds.append(motion.speed[drives])
        moments = np.concatenate(when)
        on_strips = strips.project(np.vstack(places), _PASS_NEAR_M)
        times: dict[int, list[float]] = {}
        fast: dict[int, list[float]] = {}
        for strip, s, moment, speed in zip(
            on_strips.strip.tolist(), on_strips.s_m.tolist(), moments[on_strips.row].tolist(),
            np.concatenate(speeds)[on_strips.row].tolist(), strict=True,
        ):  # fmt: skip
            for cell in range(int((s - 0.5) / PAIR_M), int((s + 0.5) / PAIR_M) + 1):
                times.setdefault(strip * MOST_CELLS + cell, []).append(moment)
                if speed > _FAST_MPS:
                    fast.setdefault(strip * MOST_CELLS + cell, []).append(moment)
        return cls(
            strips=strips, tree=cKDTree(np.vstack(places)), when=moments,
            times=_sorted(times), fast=_sorted(fast),
        )  # fmt: skip

    def after(self, points: Floats, time: float) -> float:
        """Return the time of the next pass over some points, a second or more after a time.

        Parameters
        ----------
        points : (k, 2) array
            Points in the map, metres.
        time : float
            UNIX seconds.
        """
        known = self._over(points)
        k = int(np.searchsorted(known, time + 1.0))
        return float(known[k]) if k < len(known) else np.inf

    def before(self, points: Floats, time: float) -> float:
        """Return the time of the last pass over some points, a second or more before a time."""
        known = self._over(points)
        k = int(np.searchsorted(known, time - 1.0)) - 1
        return float(known[k]) if k >= 0 else -np.inf

    def _over(self, points: Floats) -> Floats:
        """Return the times of passes over any of some points, ascending."""
        near = self.tree.query_ball_point(np.atleast_2d(points), _PASS_NEAR_M)
        rows = np.unique(np.concatenate([np.zeros(0), *near])).astype(np.int64)
        return np.sort(self.when[rows])


def _sorted(times: dict[int, list[float]]) -> dict[int, Floats]:
    """Return the times of each cell as a sorted array."""
    return {cell: np.sort(np.array(each)) for cell, each in times.items()}
