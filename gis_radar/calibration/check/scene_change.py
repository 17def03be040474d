"""Detect a change of the static surroundings of a sensor.

Walls, posts and signs return second after second at one place, whatever traffic and lanes are. So
it shows, at night, too, if data are another sensor's from some moment on, or if a mast was turned
without a new pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers

STILL_MPS = 0.15  # up to here nothing moves: the Doppler threshold of the comparison with scans
CELL_M = 2.0  # side of a cell: targets wander by decimetres, poses of a track are corrected by less
PART_S = 10.0  # length of a part of the time: two in a piece of an excerpt
LEAST_PART_S = 5  # least seconds with detections of a part that is compared
# Least share of the seconds of a part in which a standing cell is detected: parked cars and walls
# are in 46 to 84 % of the frames, people who wait or walk by are gone sooner.
STANDS = 0.4
LEAST_CELLS = 30  # fewer standing cells may be a queue
LEAST_PARTS = 2  # least parts on either side of a change, which must be alike
# Of eleven sensors of four junctions 70 to 95 % of what stands in one part stands in another, and 5
# to 20 % of it is where something stands around another sensor. Below STAYS of the usual share
# the surroundings have changed.
STAYS, ALIKE = 0.5, 0.5


@dataclass(frozen=True, kw_only=True)
class SceneChange:
    """A change of the static surroundings of a sensor, or that there is none.

    Parameters
    ----------
    time : float or None
        UNIX seconds, to ten seconds, of the change; None where there is none.
    share : float
        Share of standing cells that are the same before and after, or at different times.
    usual : float
        The same share between times on one side of the moment.
    """

    time: float | None
    share: float
    usual: float


def detect_scene_change(time: Floats, places: Floats, range_rate: Floats) -> SceneChange | None:
    """Compare the static surroundings at different times; None where too little stands.

    Parameters
    ----------
    time : (n,) array
        Times of detections, UNIX seconds, ascending.
    places : (n, 2) array
        Their places in the map by the poses in force, metres; rows not finite are left out.
    range_rate : (n,) array
        Their range rates, m/s.
    """
    still = np.flatnonzero(np.isfinite(places).all(axis=1) & (np.abs(range_rate) <= STILL_MPS))
    if len(still) == 0:
        return None
    part, stands = _standing(time[still], places[still])
    if len(part) < 2 * LEAST_PARTS:
        return None
    alike = _shares(stands)
    best: SceneChange | None = None
    for first in range(LEAST_PARTS, len(part) - LEAST_PARTS + 1):
        for mixed in (0, 1):  # a part may lie on both sides
            begin = first + mixed
            if len(part) - begin < LEAST_PARTS:
                continue
            share = float(alike[:first, begin:].mean())
            usual = min(_usual(alike[:first, :first]), _usual(alike[begin:, begin:]))
            if usual >= ALIKE and share < min(STAYS * usual, best.share if best else 1.0):
                moment = float(part[first]) * PART_S + float(time[still[0]])
                best = SceneChange(time=moment, share=share, usual=usual)
    return best or SceneChange(time=None, share=_usual(alike), usual=_usual(alike))


def _standing(time: Floats, places: Floats) -> tuple[Integers, Booleans]:
    """Return the numbers of the time's parts, and for each the cells where something stands."""
    second = np.floor(time - time[0]).astype(np.int64)
    cells = np.floor(places / CELL_M).astype(np.int64)
    # one number for each cell: sorting rows of two takes ten times as long
    east, north = (cells - cells.min(axis=0)).T
    cell = np.unique(east * (int(north.max()) + 1) + north, return_inverse=True)[1]
    count = int(cell.max()) + 1
    seen, there = np.divmod(np.unique(second * count + cell), count)
    part, of_second = np.unique(seen // int(PART_S), return_inverse=True)
    hits = np.bincount(of_second * count + there, minlength=len(part) * count)
    hits = hits.reshape(len(part), count)
    seconds = np.bincount(np.searchsorted(part, np.unique(seen) // int(PART_S)))
    stands = hits >= STANDS * seconds[:, None]
    kept = (seconds >= LEAST_PART_S) & (stands.sum(axis=1) >= LEAST_CELLS)
    return part[kept], stands[kept]


def _shares(stands: Booleans) -> Floats:
    """Return for each pair of parts the share of standing cells in common, the larger of the two.

    So a lorry that stops before the sensor, and hides what stands, changes nothing.
    """
    flags = stands.astype(np.float64)
    count = flags.sum(axis=1)
    return np.asarray(flags @ flags.T / np.minimum(count[:, None], count[None, :]))


def _usual(alike: Floats) -> float:
    return float(alike[np.triu_indices(len(alike), 1)].mean())
