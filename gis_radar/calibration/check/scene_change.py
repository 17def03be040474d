"""Detect a change of the static surroundings of a sensor.

Walls, posts and signs are detected at one place for the whole recording. Where they are elsewhere
from a moment on, the data are another sensor's, or the mast was turned without a new pose. This
needs no traffic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers

STILL_MPS = 0.15  # largest range rate of static targets, as in the comparison with scans
CELL_M = 2.0  # side of a cell: positions of a target and corrections of a pose vary by decimetres
PERIOD_S = 10.0  # length of a period: two in a segment of an excerpt
LEAST_PERIOD_S = 5  # least number of seconds with detections in a period that is compared
# Least share of the seconds of a period in which a static cell is detected: parked cars and walls
# are in 46 to 84 % of the frames, people who wait or walk by leave sooner.
STANDING_SHARE = 0.4
LEAST_CELLS = 30  # fewer static cells may be a queue of vehicles
LEAST_PERIODS = 2  # least number of periods on either side of a change
# Of the static cells of one period, another period of the same sensor has 70 to 95 %, another
# sensor 5 to 20 % (eleven sensors of four junctions). On either side of a change periods share at
# least ALIKE of their cells; across it less than STAYING times that.
STAYING, ALIKE = 0.5, 0.5
# Of frames that may be of two sensors in turn: most and least number that is compared, least share
# of them in which a cell is detected, and least share at which the kind changes.
MOST_FRAMES, LEAST_FRAMES, LEAST_DETECTED, ALTERNATING = 400, 100, 0.1, 0.2
SECTOR = 20.0, 10.0  # metres of range, degrees of azimuth


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
    still = np.flatnonzero(np.isfinite(places).all(axis=1) & (np.abs(range_rate) <= STILL_MPS))
    if len(still) == 0:
        return None
    periods, stands = _standing_cells(time[still], places[still])
    if len(periods) < 2 * LEAST_PERIODS:
        return None
    common = _common_shares(stands)
    best: SceneChange | None = None
    for first in range(LEAST_PERIODS, len(periods) - LEAST_PERIODS + 1):
        for gap in (0, 1):  # the change may lie within a period, which is then left out
            begin = first + gap
            if len(periods) - begin < LEAST_PERIODS:
                continue
            share = float(common[:first, begin:].mean())
            usual = min(_mean_share(common[:first, :first]), _mean_share(common[begin:, begin:]))
            if usual >= ALIKE and share < min(STAYING * usual, best.share if best else 1.0):
                moment = float(periods[first]) * PERIOD_S + float(time[still[0]])
                best = SceneChange(time=moment, share=share, usual=usual)
    return best or SceneChange(time=None, share=_mean_share(common), usual=_mean_share(common))


def _standing_cells(time: Floats, places: Floats) -> tuple[Integers, Booleans]:
    """Return the numbers of usable periods, and for each which cells are static."""
    second = np.floor(time - time[0]).astype(np.int64)
    cells = np.floor(places / CELL_M).astype(np.int64)
    # one number for each cell: sorting rows of two takes ten times as long
    east, north = (cells - cells.min(axis=0)).T
    cell = np.unique(east * (int(north.max()) + 1) + north, return_inverse=True)[1]
    count = int(cell.max()) + 1
    seen, cell_of = np.divmod(np.unique(second * count + cell), count)
    periods, period_of = np.unique(seen // int(PERIOD_S), return_inverse=True)
    hits = np.bincount(period_of * count + cell_of, minlength=len(periods) * count)
    hits = hits.reshape(len(periods), count)
    seconds = np.bincount(np.searchsorted(periods, np.unique(seen) // int(PERIOD_S)))
    stands = hits >= STANDING_SHARE * seconds[:, None]
    usable = (seconds >= LEAST_PERIOD_S) & (stands.sum(axis=1) >= LEAST_CELLS)
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


def share_of_alternating_scenes(time: Floats, points: Floats, range_rate: Floats) -> float:
    """Return how much two kinds of frames have in common that alternate; 1 where none do.

    Frames are divided by the first principal component of which static cells they detect. Of one
    sensor both kinds detect the same cells about as often; frames of two sensors that were joined
    in one table do not. A radar that scans near and far in turn has two kinds of frames, too: only
    ranges, azimuths and sectors in which both kinds detect something are compared.

    Parameters
    ----------
    time : (n,) array
        Times of detections, UNIX seconds, ascending.
    points : (n, 3) array
        Their positions in the sensor frame, metres.
    range_rate : (n,) array
        Their range rates, m/s.
    """
    still = np.isfinite(points[:, :2]).all(axis=1) & (np.abs(range_rate) <= STILL_MPS)
    frame = np.unique(time[still], return_inverse=True)[1]
    early = frame < MOST_FRAMES
    places, cell = np.unique(
        np.floor(points[still][early, :2] / CELL_M), axis=0, return_inverse=True
    )
    frame = frame[early]
    if len(frame) == 0 or frame[-1] + 1 < LEAST_FRAMES:
        return 1.0
    detected = np.zeros((int(frame[-1]) + 1, len(places)))
    detected[frame, cell.ravel()] = 1.0
    often = detected.mean(axis=0) >= LEAST_DETECTED
    detected, places = detected[:, often], places[often] * CELL_M
    if len(places) < LEAST_CELLS:
        return 1.0
    component = np.linalg.svd(detected - detected.mean(axis=0), full_matrices=False)[0][:, 0]
    first: Booleans = np.asarray(component > 0.0)
    if np.count_nonzero(np.diff(first)) < ALTERNATING * len(first):
        return 1.0  # of a change at one moment
    return _common_share(
        np.array([detected[first].mean(axis=0), detected[~first].mean(axis=0)]), places
    )


def _common_share(kinds: Floats, places: Floats) -> float:
    """Return how much two kinds of frames have in common where both see; 1 with too few cells.

    Only what each kind detects more often than elsewhere in a sector counts, as one may be less
    sensitive there.

    Parameters
    ----------
    kinds : (2, n) array
        Share of the frames of either kind in which a cell is detected.
    places : (n, 2) array
        The cells, metres.
    """
    polar = np.column_stack([np.hypot(*places.T), np.degrees(np.arctan2(*places.T[::-1]))])
    views = [polar[kind >= LEAST_DETECTED] for kind in kinds]
    low = np.max([view.min(axis=0, initial=np.inf) for view in views], axis=0)
    high = np.min([view.max(axis=0, initial=-np.inf) for view in views], axis=0)
    in_views: Booleans = np.asarray(((polar >= low) & (polar <= high)).all(axis=1))
    polar, kinds = polar[in_views], kinds[:, in_views]
    sector = np.unique(np.floor(polar / SECTOR), axis=0, return_inverse=True)[1].ravel()
    most = np.zeros((2, sector.max(initial=-1) + 1))
    for kind, shares in zip(most, kinds, strict=True):
        np.maximum.at(kind, sector, shares)
    both: Booleans = np.asarray((most >= LEAST_DETECTED).all(axis=0))[sector]
    if np.count_nonzero(both) < LEAST_CELLS:
        return 1.0
    sector, kinds = sector[both], kinds[:, both]
    relative = kinds / np.array([np.bincount(sector, kind)[sector] for kind in kinds])
    return float(relative.min(axis=0).sum() / relative.max(axis=0).sum())
