"""Changes: whether a sensor has moved, since when, and whether it only shook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from gis_radar.registration import State
from gis_radar.registration.solver import SCALES_M
from gis_radar.tracking.filter import Estimate, innovation, predicted
from gis_radar.tracking.registering import Ground, Scene, Sighting

GATE, SURE = (float(chi2.ppf(1.0 - chance, 6)) for chance in (1e-5, 1e-3))
# Newest parts that are held against the pose: a short one soon shows a blow, but holds few
# vehicles, whose errors have long tails; a long one shows a shift of some decimetres.
TESTS = ((20.0, GATE), (60.0, SURE))
NEWEST_TRACKS = 8
MATURE_S = 30.0
SETTLED_S = 15.0  # what lasts no longer is a shake
LATEST_S = 8.0  # in which the new pose must still be the better one
SLICE_S = 1.0
BACK_S = 75.0  # how far before now a change is looked for
ROUNDS = 2
# how far a blow moves a sensor that is still in use, 1 sigma
KNOCK = np.array([0.7, 0.7, 0.4, *np.radians([3.0, 3.0, 4.0])])


@dataclass(frozen=True, kw_only=True)
class Change:
    """A sensor that has moved.

    Parameters
    ----------
    time : float
        UNIX seconds of the move.
    sighting : Sighting
        The pose since then.
    chi2 : float
        By how much it contradicts the pose before.
    """

    time: float
    sighting: Sighting
    chi2: float


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """The newest part of a window that contradicts the pose.

    Parameters
    ----------
    change : Change or None
        The lasting change behind it, where there is one already.
    """

    change: Change | None


def newest(scene: Scene, now: float, length_s: float) -> Scene:
    """Return the newest part of a scene; a longer one where there is little traffic.

    Parameters
    ----------
    scene : Scene
        Of the window.
    now : float
        UNIX seconds at which it ends.
    length_s : float
        How much.
    """
    part = scene.between(now - length_s, np.inf)
    while part.tracks < NEWEST_TRACKS and now - length_s > scene.moving.begin:
        length_s *= 1.5
        part = scene.between(now - length_s, np.inf)
    return part


def doubt(
    ground: Ground,
    scene: Scene,
    now: float,
    before: Callable[[float], Estimate],
    like: State,
) -> Doubt | None:
    """Return whether the newest data contradict the pose, and the change that explains it.

    Parameters
    ----------
    ground : Ground
        The lanes.
    scene : Scene
        The window.
    now : float
        UNIX seconds at which it ends.
    before : callable
        Gives the estimate from data before a time.
    like : State
        How vehicles reflected so far.
    """
    for length_s, gate in TESTS:
        part = newest(scene, now, length_s)
        if part.moving.begin - scene.moving.begin < MATURE_S:
            break  # what is known from so little data is corrected by the next windows anyway
        held = predicted(before(part.moving.begin), now)
        seen = ground.register(part, held, like, near=KNOCK, scales_m=SCALES_M)
        if seen is None or (seen.trusted and innovation(held, seen.measurement).chi2 < gate):
            continue
        if not seen.trusted:
            seen = ground.find(part, held, like, near=KNOCK)
        return Doubt(change=None if seen is None else _change(ground, scene, now, held, seen))
    return None


def _change(
    ground: Ground, scene: Scene, now: float, held: Estimate, seen: Sighting
) -> Change | None:
    """Return the change that the newest data show, if it lasts."""
    since, old = now, held.state(seen.fit.state)
    for _ in range(ROUNDS):
        new = seen.fit.state
        since = change_time(ground, scene, now, replace(old, reflection=new.reflection), new)
        part = scene.between(since, np.inf)
        again = ground.register(part, held, new, near=KNOCK, start=new)
        if now - since < SETTLED_S or again is None or not again.trusted:
            return None
        seen = again
    latest = scene.between(now - LATEST_S, np.inf).samples()
    if len(latest) and ground.cost(latest, seen.fit.state) > ground.cost(latest, old):
        return None
    contradiction = innovation(held, seen.measurement).chi2
    if contradiction < SURE:
        return None
    return Change(time=since, sighting=seen, chi2=contradiction)


def change_time(ground: Ground, scene: Scene, now: float, old: State, new: State) -> float:
    """Return since when the new pose explains the data better than the old one.

    The likeliest time of one change: the sum over all later slices of time of what the old pose
    costs more than the new one is greatest there. Where no vehicle tells it is the latest such
    time.

    Parameters
    ----------
    ground : Ground
        The lanes.
    scene : Scene
        The window.
    now : float
        UNIX seconds at which it ends.
    old, new : State
        The two poses.
    """
    begin = max(now - BACK_S, scene.moving.begin)
    edges = begin + SLICE_S * np.arange(max(int(np.ceil((now - begin) / SLICE_S)), 1))
    gains = np.zeros(len(edges))
    for i, edge in enumerate(edges):
        samples = scene.between(edge, edge + SLICE_S).samples()
        if len(samples):
            gains[i] = ground.cost(samples, old) - ground.cost(samples, new)
    later = np.cumsum(gains[::-1])[::-1]
    return float(edges[len(later) - 1 - int(np.argmax(later[::-1]))])
