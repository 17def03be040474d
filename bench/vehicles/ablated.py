"""Parts of the tracker by name, with the patches that switch each off."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from gis_radar.tracking import motion
from gis_radar.tracking import posterior as posterior_module
from gis_radar.tracking import tracker as tracker_module
from gis_radar.tracking.posterior import cuts, ends, neighbours, sizes
from gis_radar.tracking.posterior import estimate as estimate_module
from gis_radar.tracking.posterior.background import Background
from gis_radar.tracking.size import Size
from gis_radar.tracking.start import bodies, passes, track_management
from gis_radar.tracking.start.detectability import Detectability

# as Any: the names that these modules import are patched in them, too
moves: Any = posterior_module
estimate: Any = estimate_module
tracker: Any = tracker_module
# Functions that each return a context; within all of them the part is off.
Part = tuple[Callable[[], AbstractContextManager[Any]], ...]


def _off(*named: tuple[Any, str, Any]) -> Part:
    return tuple(lambda e=each: patch.object(*e) for each in named)


def _same(posterior: Any, *_: Any) -> Any:
    return list(posterior.motions)


def _placed(posterior: Any, motions: Any, _: Any) -> Any:
    posterior.set_vehicles(motions)
    return list(motions)


def _without_heights(motions: Any, detections: Any, *rest: Any) -> Any:
    flat = replace(detections, height_m=np.full(len(detections), np.nan))
    return moves.improve(motions, flat, *rest)


def _straight(*given: Any) -> Any:
    shape = _bent(*given)
    shape[:, 7:9] = 0.0
    return shape


_bent = estimate.motion_shapes


def _forward_alone(detections: Any, graph: Any) -> Any:
    numbers, both = tracker.follow_both_ways(detections, graph)
    return numbers[0], both[0]


def _as_it_is(detections: Any, rows: Any, states: Any) -> Any:
    return [motion.fit_motion(detections, rows, states)]


class _Persons:
    """Test of persons that finds none in the first (1) or last (0) of the two calls of a block."""

    def __init__(self, off: int) -> None:
        self.calls, self.off = 0, off

    def __call__(self, detections: Any, motions: Any) -> Any:
        self.calls += 1
        if self.calls % 2 == self.off:
            return [False] * len(motions)
        return bodies.is_person(detections, motions)


def _persons(off: int) -> Part:
    return (lambda: patch.object(tracker, "is_person", _Persons(off)),)


PARTS: dict[str, Part] = {
    "as-is": (),
    "no-posterior": _off((tracker, "improve", lambda found, *_: list(found))),
    "one-round": _off((moves, "_SPLIT_IN_ROUNDS", (True,))),
    "two-rounds": _off((moves, "_SPLIT_IN_ROUNDS", (True, True))),
    # moves
    "no-resize": _off((moves, "resize", _same)),
    "no-split-long": _off((moves, "split_long", _same)),
    "no-join-neighbours": _off((moves, "join_neighbours", _same)),
    "no-cut": _off((moves, "cut", _same)),
    "no-lengthen": _off((moves, "lengthen", _same)),
    "no-reassign": _off((moves, "reassociate", _same)),
    "no-refit": _off((moves, "refit", _same)),
    "no-undetected-ends": _off((moves, "with_undetected_ends", _placed)),
    "no-stood-on": _off((ends, "_held_at_rest", lambda motion, _: motion)),
    "no-driven-as-one": _off((neighbours, "_driven_as_one_odds", lambda *_: -np.inf)),
    "no-alone": _off((neighbours, "_outside", lambda *_: [])),
    # terms
    "no-hiding": _off((estimate, "fill_visible_share", lambda *_: None)),
    "poisson": _off((estimate, "ALPHA_BOUNDS", (50.0, 50.0))),
    "no-cells": _off((estimate, "CELL_PRIOR", 1e12)),
    "no-kinds": _off((estimate, "CLASS_PRIOR", 1e12)),
    "no-still": _off((Background, "learn_fixed", lambda *_: None)),
    "no-heights": _off((tracker, "improve", _without_heights)),
    "no-bends": _off((estimate, "motion_shapes", _straight)),
    "no-exists": _off(*((each, "VEHICLE_COST", 0.0) for each in (cuts, neighbours))),
    "no-end-cost": _off((cuts, "MOST_END_COST", 0.0)),
    "no-partly": _off((cuts, "PARTLY_COST", 0.0)),
    "no-overlap": _off((cuts, "PARTLY_COST", 0.0), (cuts, "MOSTLY_COST", 0.0)),
    "one-sweep": _off((cuts, "SWEEPS", 1)),
    "untempered": _off((neighbours, "EVIDENCE_SHARE", 1.0)),
    "no-gap-prior": _off((neighbours, "_log_gap_prior", lambda *_: 0.0)),
    "no-length-prior": _off(
        *((each, "log_prior", lambda _: 0.0) for each in (neighbours, sizes)),
        (sizes, "_LOG_PRIORS", [0.0] * 11),
    ),
    "all-windows": _off((sizes, "MOST_WINDOWS", 10**6)),
    "middle-stays": _off((sizes, "FIXED_POINTS", (0.0,))),
    "coarse-join": _off((neighbours, "LENGTH_CHANGES_M", (2.0,))),
    "one-way-on": _off((ends, "MOST_LINES", 1)),
    "no-persons-last": _persons(0),
    # before the posterior
    "no-backwards": _off((tracker, "_tracks", _forward_alone)),
    "no-persons-first": _persons(1),
    "no-faint-ends": _off((tracker, "without_faint_ends", lambda _, m, *__: m)),
    "no-absorb": _off((bodies, "log_odds", lambda *_: -np.inf)),
    "no-purify": _off((bodies, "purified", _as_it_is)),
    "no-tall": _off((bodies, "tall_odds", lambda *_: 0.0)),
    "no-size": _off((motion, "size_of", lambda *_: (Size(), 0.0))),
    "no-split-at-drives": _off((track_management, "split_at_drives", lambda m, *_: [m])),
    "no-rest": _off((track_management, "with_rest", lambda _, m, *__: m)),
    "no-stationary": _off((track_management, "find_stationary", lambda *_: [])),
    "no-not-built": _off((track_management, "without_fixed", lambda _, free, *__: free)),
    "no-links": _off(
        (track_management, "chains", lambda parts, *_: [[k] for k in range(len(parts))])
    ),
    "no-expected": _off((Detectability, "expected", lambda *_: 0.0)),
    "no-passes": _off((passes.Passes, "after", lambda *_: np.inf)),
    "no-drove": _off((track_management, "_drove", lambda *_: True)),
}
