"""Probability that each vehicle exists, by the gain of its detections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.estimate import Posterior

# Logistic regression of the existence of 546 vehicles of five simulated scenes on their mean gain
# per detection (bench/vehicles/existence.py), cross-validated by scene: log odds without a gain,
# and per nat. The errors of one body's detections are correlated: all of them together are evidence
# of a third of what a single one would be.
LOG_ODDS_AT_0, LOG_ODDS_PER_NAT = 0.26, 0.32
MOST_NATS = 10.0  # largest gain per detection: that of a standing vehicle on bare road


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
    nats = min(max(gain / max(detections, 1), 0.0), MOST_NATS)
    return 1.0 / (1.0 + math.exp(-LOG_ODDS_AT_0 - LOG_ODDS_PER_NAT * nats))
