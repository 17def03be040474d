"""Changes: whether a sensor has moved, since when, and whether it only shook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from gis_radar.arrays import Floats
from gis_radar.localization.settings import DEFAULTS
from gis_radar.localization.state import State
from gis_radar.tracking.filter import (
    HOUR_S,
    Estimate,
    Innovation,
    innovation,
    likeliest_move,
    predicted,
)
from gis_radar.tracking.windows import WindowFit, WindowFitter, WindowTraffic

CYCLE_S = 5.0  # the paper's
# Newest parts that are held against the pose: a short one soon shows a blow, but holds few
# vehicles; a long one shows a shift of some decimetres.
LENGTHS_S = (20.0, 60.0)
FALSE_ALARMS = 0.01  # an hour; at most, as if no test had data in common with another
_TESTS = HOUR_S / CYCLE_S * len(LENGTHS_S)  # an hour
GATE = float(chi2.ppf(1.0 - FALSE_ALARMS / _TESTS, 6))
SUSPECT = float(chi2.ppf(0.95, 6))  # a change is looked for, and the pose less certain
NEWEST_TRACKS = 8
MATURE_S = 30.0
SETTLED_S = 15.0  # what lasts no longer is a shake
LATEST_S = 8.0  # in which the new pose must still be the better one
SLICE_S = 1.0
BACK_S = 75.0  # how far before now a change is looked for
ROUNDS = 2
FAR = replace(DEFAULTS.solver.far, rounds=12)  # registration after a suspected move
# how far a blow moves a sensor that is still in use, 1 sigma
KNOCK = np.array([0.7, 0.7, 0.4, *np.radians([3.0, 3.0, 4.0])])


@dataclass(frozen=True, kw_only=True)
class Change:
    """A sensor that has moved.

    Parameters
    ----------
    time : float
        UNIX seconds of the move.
    found : WindowFit
        The pose since then.
    chi2 : float
        By how much it contradicts the pose before.
    """

    time: float
    found: WindowFit
    chi2: float


@dataclass(frozen=True, kw_only=True)
class SuspectedMove:
    """The newest part of a window that casts doubt on the pose.

    Parameters
    ----------
    certain : bool
        Whether it contradicts the pose beyond chance.
    move : (6,) array
        The likeliest move behind it, metres and a turn about the map's axes in radians; zeros
        where the data fit no pose.
    change : Change or None
        The lasting change behind it, where there is one already.
    """

    certain: bool
    move: Floats
    change: Change | None = None


def newest(traffic: WindowTraffic, now: float, length_s: float) -> WindowTraffic:
    """Return the newest part of a traffic; a longer one where there is little traffic.

    Parameters
    ----------
    traffic : WindowTraffic
        Of the window.
    now : float
        UNIX seconds at which it ends.
    length_s : float
        How much.
    """
    part = traffic.between(now - length_s, np.inf)
    while part.tracks < NEWEST_TRACKS and now - length_s > traffic.moving.begin:
        length_s *= 1.5
        part = traffic.between(now - length_s, np.inf)
    return part


def suspect_move(
    fitter: WindowFitter,
    traffic: WindowTraffic,
    now: float,
    before: Callable[[float], Estimate],
    like: State,
) -> SuspectedMove | None:
    """Return whether the newest data cast doubt on the pose, and the change that explains it.

    What all windows have in common is the same before and after: a move is held against the noise
    of the vehicles alone (:func:`gis_radar.tracking.filter.innovation`).

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    traffic : WindowTraffic
        The window.
    now : float
        UNIX seconds at which it ends.
    before : callable
        Gives the estimate from data before a time.
    like : State
        How vehicles reflected so far.
    """
    suspected = None
    for length_s in LENGTHS_S:
        part = newest(traffic, now, length_s)
        if part.moving.begin - traffic.moving.begin < MATURE_S:
            break  # what is known from so little data is corrected by the next windows anyway
        held = predicted(before(part.moving.begin), now)
        seen = fitter.fit(part, held, like, near=KNOCK, schedule=FAR)
        if seen is None:
            continue
        if not seen.trusted:
            found = fitter.find(part, held, like, near=KNOCK)
            if found is None and seen.on_lanes:
                continue  # a fit of few vehicles that came to no rest contradicts nothing
            if found is None:
                return SuspectedMove(certain=True, move=np.zeros(6))
            seen = found
        gap = innovation(held, seen.measurement)
        if gap.chi2 < SUSPECT:
            continue
        change = _change(fitter, traffic, now, before, held, seen)
        suspected = _suspicion(gap, change)
        if change is not None or suspected.certain:
            return suspected
    return suspected


def _suspicion(found: Innovation, change: Change | None) -> SuspectedMove:
    move = likeliest_move(found, KNOCK)
    return SuspectedMove(certain=found.chi2 >= GATE, move=move, change=change)


def _change(
    fitter: WindowFitter,
    traffic: WindowTraffic,
    now: float,
    before: Callable[[float], Estimate],
    held: Estimate,
    seen: WindowFit,
) -> Change | None:
    """Return the change that the newest data show, if it lasts and is certain."""
    since, old = now, held.state(seen.fit.state)
    for _ in range(ROUNDS):
        new, old = seen.fit.state, held.state(seen.fit.state)
        since = change_time(fitter, traffic, now, replace(old, reflection=new.reflection), new)
        part = traffic.between(since, np.inf)
        held = predicted(before(since), now)  # all data since then speak of the new pose
        again = fitter.fit(part, held, new, near=KNOCK, start=new)
        if now - since < SETTLED_S or again is None or not again.trusted:
            return None
        seen = again
    latest = traffic.between(now - LATEST_S, np.inf).samples()
    if len(latest) and fitter.cost(latest, seen.fit.state) > fitter.cost(latest, old):
        return None
    contradiction = innovation(held, seen.measurement).chi2
    if contradiction < GATE:
        return None
    return Change(time=since, found=seen, chi2=contradiction)


def change_time(
    fitter: WindowFitter, traffic: WindowTraffic, now: float, old: State, new: State
) -> float:
    """Return since when the new pose explains the data better than the old one.

    The likeliest time of one change: the sum over all later slices of time of what the old pose
    costs more than the new one is greatest there. Where no vehicle tells it is the latest such
    time.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    traffic : WindowTraffic
        The window.
    now : float
        UNIX seconds at which it ends.
    old, new : State
        The two poses.
    """
    begin = max(now - BACK_S, traffic.moving.begin)
    edges = begin + SLICE_S * np.arange(max(int(np.ceil((now - begin) / SLICE_S)), 1))
    gains = np.zeros(len(edges))
    for i, edge in enumerate(edges):
        samples = traffic.between(edge, edge + SLICE_S).samples()
        if len(samples):
            gains[i] = fitter.cost(samples, old) - fitter.cost(samples, new)
    later = np.cumsum(gains[::-1])[::-1]
    return float(edges[len(later) - 1 - int(np.argmax(later[::-1]))])
