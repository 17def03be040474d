"""Detect a change of the static surroundings of a sensor.

Walls, posts and signs are detected at one place for the whole recording. Where they are elsewhere
from a moment on, the data are another sensor's, or the mast was turned without a new pose. This
needs no traffic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers

_STATIC_MPS = 0.15  # largest range rate of static targets, as in the comparison with scans
# side of a cell: positions of a target and corrections of a pose vary by decimetres
_SCENE_CELL_M = 2.0
_PERIOD_S = 10.0  # length of a period: two in a segment of an excerpt
_LEAST_PERIOD_S = 5  # least number of seconds with detections in a period that is compared
# Least share of the seconds of a period in which a static cell is detected: parked cars and walls
# are in 46 to 84 % of the frames, people who wait or walk by leave sooner.
_STANDING_SHARE = 0.4
_LEAST_CELLS = 30  # fewer static cells may be a queue of vehicles
_LEAST_PERIODS = 2  # least number of periods on either side of a change
# Of the static cells of one period, another period of the same sensor has 70 to 95 %, another
# sensor 5 to 20 % (eleven sensors of four junctions). On either side of a change periods share at
# least ALIKE of their cells; across it less than STAYING times that.
_STAYING, _ALIKE = 0.5, 0.5


@dataclass(frozen=True, kw_only=True)
class SceneChange:
    """Result of the search for a change of the static surroundings of a sensor.

    Parameters
    ----------
    time : float or None
        Time of the change, UNIX seconds, to ten seconds; None where there is none.
    share : float
        Mean share of static cells in common of periods before and after the change; of all
        periods where there is none.
    usual : float
        Mean share of static cells in common of periods on the same side of the change.
    """

    time: float | None
    share: float
    usual: float


def detect_scene_change(time: Floats, places: Floats, range_rate: Floats) -> SceneChange | None:
    """Compare the static surroundings of periods; None where too few have enough static cells.

    Parameters
    ----------
    time : (n,) array
        Times of detections, UNIX seconds, ascending.
    places : (n, 2) array
        Positions of the detections in the map, metres; rows not finite are left out.
    range_rate : (n,) array
        Range rates of the detections, m/s.
    """
    still = np.flatnonzero(np.isfinite(places).all(axis=1) & (np.abs(range_rate) <= _STATIC_MPS))
    if len(still) == 0:
        return None
    periods, stands = _standing_cells(time[still], places[still])
    if len(periods) < 2 * _LEAST_PERIODS:
        return None
    common = _common_shares(stands)
    best: SceneChange | None = None
    for first in range(_LEAST_PERIODS, len(periods) - _LEAST_PERIODS + 1):
        for gap in (0, 1):  # the change may lie within a period, which is then left out
            begin = first + gap
            if len(periods) - begin < _LEAST_PERIODS:
                continue
            share = float(common[:first, begin:].mean())
            usual = min(_mean_share(common[:first, :first]), _mean_share(common[begin:, begin:]))
            if usual >= _ALIKE and share < min(_STAYING * usual, best.share if best else 1.0):
                moment = float(periods[first]) * _PERIOD_S + float(time[still[0]])
                best = SceneChange(time=moment, share=share, usual=usual)
    return best or SceneChange(time=None, share=_mean_share(common), usual=_mean_share(common))


def _standing_cells(time: Floats, places: Floats) -> tuple[Integers, Booleans]:
    """Return the numbers of usable periods, and for each which cells are static."""
    second = np.floor(time - time[0]).astype(np.int64)
    cells = np.floor(places / _SCENE_CELL_M).astype(np.int64)
    # one number for each cell: sorting rows of two takes ten times as long
    east, north = (cells - cells.min(axis=0)).T
    cell = np.unique(east * (int(north.max()) + 1) + north, return_inverse=True)[1]
    count = int(cell.max()) + 1
    seen, cell_of = np.divmod(np.unique(second * count + cell), count)
    periods, period_of = np.unique(seen // int(_PERIOD_S), return_inverse=True)
    hits = np.bincount(period_of * count + cell_of, minlength=len(periods) * count)
    hits = hits.reshape(len(periods), count)
    seconds = np.bincount(np.searchsorted(periods, np.unique(seen) // int(_PERIOD_S)))
    stands = hits >= _STANDING_SHARE * seconds[:, None]
    usable = (seconds >= _LEAST_PERIOD_S) & (stands.sum(axis=1) >= _LEAST_CELLS)
    return periods[usable], stands[usable]


def _common_shares(stands: Booleans) -> Floats:
    """Return for each pair of periods the share of static cells in common, of the one with fewer.

    Of the one with fewer, as a lorry that stops before the sensor hides static targets.
    """
    flags = stands.astype(np.float64)
    count = flags.sum(axis=1)
    return np.asarray(flags @ flags.T / np.minimum(count[:, None], count[None, :]))


def _mean_share(shares: Floats) -> float:
    """Return the mean over all pairs of different periods."""
    return float(shares[np.triu_indices(len(shares), 1)].mean())
