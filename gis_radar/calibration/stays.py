"""What stands around a sensor stays: where it does not, from some moment on the sensor is another.

Walls, posts and signs return in second after second at one place, whatever the traffic does and
wherever lanes are. So it is noticed at night, too, that data are another sensor's from some moment
on, or that a mast was turned whose pose was not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers

STILL_MPS = 0.15  # up to here nothing moves: the Doppler threshold of the comparison with scans
CELL_M = 2.0  # side of a cell: targets wander by decimetres, poses of a track are corrected by less
PART_S = 10.0  # two in a piece of an excerpt
LEAST_PART_S = 5  # seconds with detections, under which a part tells nothing
# Share of the seconds in which what stands is detected: parked cars and walls are in 46 to 84 % of
# the frames, who waits or walks by is gone sooner.
STANDS = 0.4
LEAST_CELLS = 30  # fewer may be a queue
LEAST_PARTS = 2  # on either side, which must be alike
# Of eleven sensors of four junctions 70 to 95 % of what stands in one part does in another, and 5
# to 20 % of it is where something stands around another sensor. From a half of the usual share on
# it is the same sensor.
STAYS, ALIKE = 0.5, 0.5


@dataclass(frozen=True, kw_only=True)
class Stays:
    """Whether what stands around a sensor stays where it is.

    Parameters
    ----------
    until : float or None
        The moment from which on nearly nothing does, UNIX seconds, to ten seconds; None where it
        stays all along.
    share : float
        Share of what stands that is where something stood before the moment, or at other times.
    usual : float
        The same share between times on one side of the moment.
    """

    until: float | None
    share: float
    usual: float


def compare_standing(time: Floats, places: Floats, range_rate: Floats) -> Stays | None:
    """Return whether what stands stays where it is; None where too little stands to tell.

    Parameters
    ----------
    time : (n,) array
        Of detections, UNIX seconds, in order.
    places : (n, 2) array
        Where they are in the map, by the poses in force; rows that are not finite are left out.
    range_rate : (n,) array
        Of them, m/s.
    """
    still = np.flatnonzero(np.isfinite(places).all(axis=1) & (np.abs(range_rate) <= STILL_MPS))
    if len(still) == 0:
        return None
    part, stands = _standing(time[still], places[still])
    if len(part) < 2 * LEAST_PARTS:
        return None
    alike = _shares(stands)
    best: Stays | None = None
    for first in range(LEAST_PARTS, len(part) - LEAST_PARTS + 1):
        for mixed in (0, 1):  # a part may lie on both sides
            begin = first + mixed
            if len(part) - begin < LEAST_PARTS:
                continue
            share = float(alike[:first, begin:].mean())
            usual = min(_usual(alike[:first, :first]), _usual(alike[begin:, begin:]))
            if usual >= ALIKE and share < min(STAYS * usual, best.share if best else 1.0):
                moment = float(part[first]) * PART_S + float(time[still[0]])
                best = Stays(until=moment, share=share, usual=usual)
    return best or Stays(until=None, share=_usual(alike), usual=_usual(alike))


def _standing(time: Floats, places: Floats) -> tuple[Integers, Booleans]:
    """Return numbers of the parts of the time, and in which cells something stands in each."""
    second = np.floor(time - time[0]).astype(np.int64)
    cells = np.floor(places / CELL_M).astype(np.int64)
    # a number for each: rows are sorted ten times as slowly
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
    """Return by pair of parts which share of what stands does in both: the larger of two shares.

    So a lorry that stands before the sensor, and hides what does, changes nothing.
    """
    flags = stands.astype(np.float64)
    count = flags.sum(axis=1)
    return np.asarray(flags @ flags.T / np.minimum(count[:, None], count[None, :]))


def _usual(alike: Floats) -> float:
    return float(alike[np.triu_indices(len(alike), 1)].mean())
