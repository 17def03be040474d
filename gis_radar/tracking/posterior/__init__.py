"""Joint estimate of all vehicles: the posterior of their tracks, and moves that raise it.

Detections are a superposition of Poisson processes, one a vehicle and one of the background (Khan
et al. 2005, Oh et al. 2009: moves of tracks; Meyer and Williams 2021: extended objects).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.posterior.cuts import cut
from gis_radar.tracking.posterior.ends import lengthen, with_undetected_ends
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.neighbours import join_neighbours, split_long
from gis_radar.tracking.posterior.sizes import resize, with_size

__all__ = ["Posterior", "improve"]

# Whether long vehicles are split in each round. Not in the last one: halves of a body that was
# merged by its motion drive alike, and would stay two.
_SPLIT_IN_ROUNDS = (True, True, False)
_LEAST_ROWS = 8  # least detections of a vehicle whose motion is fitted anew
MOVES_MPS = 1.0  # least largest speed of such a vehicle
_LEAST_GAIN = 2.0  # least gain of a new motion over the old one, nats
_SHORTER_STEPS = 10  # steps by which the new motion may be shorter at either end
# Logistic regression of the existence of 546 vehicles of five simulated scenes on their mean gain
# per detection (bench/vehicles/existence.py), cross-validated by scene: log odds without a gain,
# and per nat. The errors of one body's detections are correlated: all of them together are evidence
# of a third of what a single one would be.
_LOG_ODDS_AT_0, _LOG_ODDS_PER_NAT = 0.26, 0.32
_MOST_NATS = 10.0  # largest gain per detection: that of a standing vehicle on bare road


def improve(motions: Sequence[Motion], detections: MapDetections, graph: LaneGraph) -> list[Motion]:
    """Return vehicles with a higher posterior than those to begin with.

    Moves that raise the posterior are made in turn: change lengths, split long vehicles, merge
    neighbours, cut stretches without support, lengthen tracks along the lanes, associate detections
    anew and smooth motions over them. There are three rounds, since what one vehicle loses another
    one gains. At the end lengths, merges and cuts are made once more, tracks are extended where few
    detections are expected, and the probability that each vehicle exists is computed.

    Parameters
    ----------
    motions : sequence of Motion
        The vehicles to begin with.
    detections : MapDetections
        All detections.
    graph : LaneGraph
        The lanes.
    """
    if not motions:
        return []
    posterior = Posterior(detections, motions)
    del motions  # better ones take their place
    for number, split in enumerate(_SPLIT_IN_ROUNDS):
        if number > 0:
            posterior.set_vehicles(refit(posterior))
        posterior.learn(_sized_and_cut(posterior, split=split))
        posterior.set_vehicles(lengthen(posterior, graph))
        posterior.motions = reassociate(posterior)
    found = with_undetected_ends(posterior, _sized_and_cut(posterior, split=False), graph)
    return with_existence(posterior, found)


def _sized_and_cut(posterior: Posterior, *, split: bool) -> list[Motion]:
    """Return the vehicles after changing lengths, splitting (if asked), merging and cutting."""
    posterior.set_vehicles(resize(posterior))
    if split:
        posterior.set_vehicles(split_long(posterior))
    posterior.set_vehicles(join_neighbours(posterior))
    return cut(posterior)


def refit(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with motions smoothed anew, where that raises the posterior.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; it does not change.
    """
    # working memory; each fit fills in the rows of its detections
    states = np.zeros((len(posterior.detections), 6))
    count = len(posterior.motions)
    return [_refitted(posterior, k, states) for k in range(count)]


def _refitted(posterior: Posterior, vehicle: int, states: Floats) -> Motion:
    """Return a vehicle's motion smoothed over its detections, or as it is if that is better."""
    motion, detections = posterior.motions[vehicle], posterior.detections
    rows = posterior.associated_rows(vehicle)
    if len(rows) < _LEAST_ROWS or motion.speed.max() < MOVES_MPS:
        return motion
    s_m, speed = motion.at(detections.time[rows])
    states[rows, :2], states[rows, 2] = motion.path.at(s_m)
    states[rows, 3] = speed
    new = fit_motion(detections, rows, states)
    early = new.first_step > motion.first_step + _SHORTER_STEPS
    if early or new.last_step < motion.last_step - _SHORTER_STEPS:
        return motion
    span = ((new.first_step - 0.5) * STEP_S, (new.last_step + 0.5) * STEP_S)
    posterior.exclude(vehicle)
    best, gain = motion, posterior.gain(motion, within=span) + _LEAST_GAIN
    for each in (new, with_size(new, motion.length_m, 0.0)):
        found = posterior.gain(each, within=span)
        if found > gain:
            best, gain = each, found
    posterior.include(vehicle)
    return best


def reassociate(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with the detections for which their responsibility is over a half.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the vehicles; it does not change.
    """
    return [
        _with_rows(posterior, k, posterior.associated_rows(k))
        for k in range(len(posterior.motions))
    ]


def _with_rows(posterior: Posterior, vehicle: int, rows: Integers) -> Motion:
    """Return the motion of a vehicle with these detections, or as it is if there are none."""
    motion = posterior.motions[vehicle]
    if len(rows) == 0:
        return motion
    along, left, *_ = motion.frame(posterior.detections, rows)
    return replace(motion, rows=rows, along_m=along, left_m=left)


def with_existence(posterior: Posterior, motions: Sequence[Motion]) -> list[Motion]:
    """Return the vehicles with the probability that each exists.

    That is the expected share of its time in which there is a vehicle at its place, other than all
    others in the list. It follows from its gain: the log likelihood that is lost if it is deleted,
    and the others explain its detections.

    Parameters
    ----------
    posterior : Posterior
        Posterior of these vehicles, in this order; they may be longer in it.
    motions : sequence of Motion
        The vehicles.
    """
    return [
        replace(
            each, p_exists=probability(float(posterior.own_gains(k)[:, 0].sum()), len(each.rows))
        )
        for k, each in enumerate(motions)
    ]


def probability(gain: float, detections: int) -> float:
    """Return the probability that a vehicle exists.

    Parameters
    ----------
    gain : float
        Its gain, nats.
    detections : int
        Number of its detections.
    """
    nats = min(max(gain / max(detections, 1), 0.0), _MOST_NATS)
    return 1.0 / (1.0 + math.exp(-_LOG_ODDS_AT_0 - _LOG_ODDS_PER_NAT * nats))
