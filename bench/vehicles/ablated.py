"""Parts of the search for vehicles, how each is switched off from outside, and scenes for it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
from scenes import RECIPES, Recipe

from gis_radar.tracking import bodies, motion, passes, track_management
from gis_radar.tracking import detectability as due
from gis_radar.tracking import posterior as posterior_module
from gis_radar.tracking import tracker as tracker_module
from gis_radar.tracking.posterior import cuts, ends, neighbours, sizes
from gis_radar.tracking.posterior import estimate as estimate_module
from gis_radar.tracking.posterior.background import Background
from gis_radar.tracking.size import Size

FRESH = {
    "town-781": Recipe(plan="town", seed=781, per_hour=2400, radars=("R1", "R3", "R5")),
    "roundabout-782": Recipe(plan="roundabout", seed=782, per_hour=1100, radars=2),
    "tee-783": Recipe(plan="tee", seed=783, per_hour=1600, radars=1, minutes=3.0),
    "harsh-784": Recipe(
        plan="junction", seed=784, per_hour=1500, radars=2, conditions="harsh"
    ),
    "gridlock-785": Recipe(
        plan="junction", seed=785, per_hour=4200, radars=2, warm_up_s=600.0
    ),
    "arterial-786": Recipe(plan="arterial", seed=786, per_hour=2400, radars=2),
    "town-787": Recipe(plan="town", seed=787, per_hour=2600, radars=("R2", "R4", "R6")),
    "gridlock-788": Recipe(
        plan="town", seed=788, per_hour=9000, radars=("R1", "R3"), warm_up_s=900.0, free=False
    ),
    "junction-789": Recipe(plan="junction", seed=789, per_hour=1500, radars=2),
    "roundabout-790": Recipe(plan="roundabout", seed=790, per_hour=1100, radars=1, minutes=3.0),
    "town-901": Recipe(
        plan="town", seed=901, per_hour=2500, radars=("R1", "R3", "R5"), minutes=3.0
    ),
    "tee-902": Recipe(plan="tee", seed=902, per_hour=1600, radars=1, minutes=3.0),
    "arterial-903": Recipe(plan="arterial", seed=903, per_hour=2400, radars=2, minutes=3.0),
    "gridlock-904": Recipe(
        plan="junction", seed=904, per_hour=4200, radars=2, minutes=3.0, warm_up_s=600.0
    ),
    "town-911": Recipe(
        plan="town", seed=911, per_hour=2500, radars=("R2", "R4", "R6"), minutes=3.0
    ),
    "tee-912": Recipe(plan="tee", seed=912, per_hour=1600, radars=1, minutes=3.0),
    "arterial-913": Recipe(plan="arterial", seed=913, per_hour=2400, radars=2, minutes=3.0),
    "gridlock-914": Recipe(
        plan="junction", seed=914, per_hour=4200, radars=2, minutes=3.0, warm_up_s=600.0
    ),
    "town-921": Recipe(
        plan="town", seed=921, per_hour=2500, radars=("R1", "R3", "R5"), minutes=3.0
    ),
    "tee-922": Recipe(plan="tee", seed=922, per_hour=1600, radars=1, minutes=3.0),
    "arterial-923": Recipe(plan="arterial", seed=923, per_hour=2400, radars=2, minutes=3.0),
    "gridlock-924": Recipe(
        plan="junction", seed=924, per_hour=4200, radars=2, minutes=3.0, warm_up_s=600.0
    ),
    "roundabout-925": Recipe(plan="roundabout", seed=925, per_hour=1100, radars=2, minutes=3.0),
    "junction-926": Recipe(plan="junction", seed=926, per_hour=1500, radars=2, minutes=3.0),
    "town-931": Recipe(
        plan="town", seed=931, per_hour=2500, radars=("R2", "R4", "R6"), minutes=10.0
    ),
    "tee-932": Recipe(plan="tee", seed=932, per_hour=1600, radars=1, minutes=10.0),
    "arterial-933": Recipe(plan="arterial", seed=933, per_hour=2400, radars=2, minutes=10.0),
    "gridlock-934": Recipe(
        plan="junction", seed=934, per_hour=4200, radars=2, minutes=10.0, warm_up_s=600.0
    ),
}  # fmt: skip
RECIPES.update(FRESH)  # type: ignore[attr-defined]
# what they import counts as theirs here
moves: Any = posterior_module
estimate: Any = estimate_module
tracker: Any = tracker_module
Change = Callable[[], AbstractContextManager[Any]]


@dataclass(frozen=True)
class Part:
    """A part of the search.

    Parameters
    ----------
    changes : tuple of callables
        Each gives a context in which something is off.
    after_start : bool
        Whether only what comes after the first guess of the vehicles changes.
    """

    changes: tuple[Change, ...]
    after_start: bool = True


def _off(*named: tuple[Any, str, Any]) -> Part:
    return Part(tuple(lambda e=each: patch.object(*e) for each in named))  # type: ignore[misc]


def _early(*named: tuple[Any, str, Any]) -> Part:
    return replace(_off(*named), after_start=False)


def _same(posterior: Any, *_: Any) -> Any:
    return list(posterior.motions)


def _once(motions: Any, detections: Any, graph: Any) -> Any:
    if not motions:
        return []
    posterior = estimate.Posterior(detections, motions)
    posterior.learn(moves._sized_and_cut(posterior))  # noqa: SLF001
    posterior.place(moves.lengthen(posterior, graph))
    posterior.motions = moves.reassign(posterior)
    posterior.place(moves.refit(posterior))
    return moves.with_undetected_ends(posterior, moves._sized_and_cut(posterior), graph)  # noqa: SLF001


def _without_heights(motions: Any, detections: Any, *rest: Any) -> Any:
    flat = replace(detections, height_m=np.full(len(detections), np.nan))
    return moves.improve(motions, flat, *rest)


def _straight(*given: Any) -> Any:
    frame, shape = _bent(*given)
    shape[:, 7:9] = 0.0
    return frame, shape


_bent = estimate.motion_states


def _forward_alone(detections: Any, graph: Any) -> Any:
    numbers, both = tracker.follow_both_ways(detections, graph)
    return numbers[0], both[0]


def _as_it_is(detections: Any, rows: Any, states: Any) -> Any:
    return [motion.fit_motion(detections, rows, states)]


class _Persons:
    """Tells persons in all calls, or in none: the first call of a block comes before the start."""

    def __init__(self, off: int) -> None:
        self.calls, self.off = 0, off

    def __call__(self, detections: Any, motions: Any) -> Any:
        self.calls += 1
        if self.calls % 2 == self.off:
            return [False] * len(motions)
        return bodies.is_person(detections, motions)


def _last_persons() -> AbstractContextManager[Any]:
    return patch.object(tracker, "is_person", lambda _, motions: [False] * len(motions))


def _first_persons() -> AbstractContextManager[Any]:
    return patch.object(tracker, "is_person", _Persons(1))


PARTS: dict[str, Part] = {
    "as-is": Part(()),
    "no-posterior": _off((tracker, "improve", lambda found, *_: list(found))),
    "one-round": _off((tracker, "improve", _once)),
    # moves
    "no-resize": _off((moves, "resize", _same)),
    "no-split-long": _off((moves, "split_long", _same)),
    "no-join-neighbours": _off((moves, "join_neighbours", _same)),
    "no-cut": _off((moves, "cut", _same)),
    "no-lengthen": _off((moves, "lengthen", _same)),
    "no-reassign": _off((moves, "reassign", _same)),
    "no-refit": _off((moves, "refit", _same)),
    "no-undetected-ends": _off((moves, "with_undetected_ends", lambda _, m, __: list(m))),
    "no-driven-as-one": _off((neighbours, "_driven_as_one", lambda *_: -np.inf)),
    "no-alone": _off((neighbours, "_alone", lambda *_: [])),
    # terms
    "no-hiding": _off((estimate, "hide", lambda *_: None)),
    "poisson": _off((estimate, "ALPHAS", (50.0, 50.0))),
    "no-cells": _off((estimate, "CELL_FEW", 1e12)),
    "no-kinds": _off((estimate, "KIND_FEW", 1e12)),
    "no-still": _off((Background, "watch", lambda *_: None)),
    "no-heights": _off((tracker, "improve", _without_heights)),
    "no-bends": _off((estimate, "motion_states", _straight)),
    "no-exists": _off(*((each, "EXISTS", 0.0) for each in (cuts, neighbours))),
    "no-end-cost": _off((cuts, "END_MOST", 0.0)),
    "no-partly": _off((cuts, "PARTLY_COSTS", 0.0)),
    "no-overlap": _off((cuts, "PARTLY_COSTS", 0.0), (cuts, "MOSTLY_COSTS", 0.0)),
    "one-sweep": _off((cuts, "SWEEPS", 1)),
    "told-whole": _off((neighbours, "TOLD", 1.0)),
    "no-gap-prior": _off((neighbours, "_gap_prior", lambda *_: 0.0)),
    "no-length-prior": _off((sizes, "prior", lambda _: 0.0), (sizes, "_PRIORS", [0.0] * 11)),
    "all-windows": _off((sizes, "MOST_WINDOWS", 10**6)),
    "middle-stays": _off((sizes, "STAYS", (0.0,))),
    "coarse-join": _off((neighbours, "LENGTH_CHANGES_M", (2.0,))),
    "one-way-on": _off((ends, "MOST_WAYS", 1)),
    "no-persons-last": Part((_last_persons,)),
    # before the posterior
    "no-backwards": _early((tracker, "_followed", _forward_alone)),
    "no-persons-first": Part((_first_persons,), after_start=False),
    "no-faint-ends": _early((tracker, "without_faint_ends", lambda _, m, *__: m)),
    "no-absorb": _early((bodies, "log_odds", lambda *_: -np.inf)),
    "no-purify": _early((bodies, "purified", _as_it_is)),
    "no-tall": _early((bodies, "tall_odds", lambda *_: 0.0)),
    "no-size": _early((motion, "size_of", lambda *_: (Size(), 0.0))),
    "no-split-at-drives": _early((track_management, "split_at_drives", lambda m, *_: [m])),
    "no-rest": _early((track_management, "with_rest", lambda _, m, *__: m)),
    "no-stationary": _early((track_management, "find_stationary", lambda *_: [])),
    "no-not-built": _early((track_management, "not_built", lambda _, free, *__: free)),
    "no-links": _early(
        (track_management, "chains", lambda parts, *_: [[k] for k in range(len(parts))])
    ),
    "no-due": _early((due.Detectability, "due", lambda *_: 0.0)),
    "no-passes": _early((passes.Passes, "after", lambda *_: np.inf)),
    "no-drove": _early((track_management, "_drove", lambda *_: True)),
}
