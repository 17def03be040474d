"""Better placed vehicles: their motion fitted to the detections that are more likely theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.sizes import with_size

LEAST_ROWS = 8  # detections, fewer tell no motion
MOVES_MPS = 1.0
LEAST_GAIN = 2.0  # of the log-probability
SHORTER_STEPS = 10  # by which a fitted motion may be shorter at either end


def refit(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with motions fitted again, where that raises the posterior.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    states = np.zeros((len(posterior.given), 6))  # of which each fit fills in its own rows
    count = len(posterior.motions)
    return [_refitted(posterior, k, states) for k in range(count)]


def _refitted(posterior: Posterior, vehicle: int, states: Floats) -> Motion:
    motion, detections = posterior.motions[vehicle], posterior.given
    rows = posterior.explained(vehicle)
    if len(rows) < LEAST_ROWS or motion.speed.max() < MOVES_MPS:
        return motion
    s_m, speed = motion.at(detections.time[rows])
    states[rows, :2], states[rows, 2] = motion.path.at(s_m)
    states[rows, 3] = speed
    new = fit_motion(detections, rows, states)
    early = new.first_step > motion.first_step + SHORTER_STEPS
    if early or new.last_step < motion.last_step - SHORTER_STEPS:
        return motion
    span = ((new.first_step - 0.5) * STEP_S, (new.last_step + 0.5) * STEP_S)
    posterior.lift(vehicle)
    best, gain = motion, posterior.gain(motion, within=span) + LEAST_GAIN
    for each in (new, with_size(new, motion.length_m, 0.0)):
        found = posterior.gain(each, within=span)
        if found > gain:
            best, gain = each, found
    posterior.lift(vehicle, 1.0)
    return best


def reassign(posterior: Posterior) -> list[Motion]:
    """Return the vehicles with the detections that are more likely theirs.

    Parameters
    ----------
    posterior : Posterior
        With the vehicles; it is left as it is.
    """
    return [_with_rows(posterior, k, posterior.explained(k)) for k in range(len(posterior.motions))]


def _with_rows(posterior: Posterior, vehicle: int, rows: Integers) -> Motion:
    motion = posterior.motions[vehicle]
    if len(rows) == 0:
        return motion
    along, left, _ = motion.frame(posterior.given, rows)
    return replace(motion, rows=rows, along_m=along, left_m=left)
