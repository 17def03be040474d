"""Refits: associate detections with vehicles anew, and smooth their motions over these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.sizes import with_size

_LEAST_ROWS = 8  # least detections of a vehicle whose motion is fitted anew
MOVES_MPS = 1.0  # least largest speed of such a vehicle
_LEAST_GAIN = 2.0  # least gain of a new motion over the old one, nats
SHORTER_STEPS = 10  # steps by which the new motion may be shorter at either end


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
    early = new.first_step > motion.first_step + SHORTER_STEPS
    if early or new.last_step < motion.last_step - SHORTER_STEPS:
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
