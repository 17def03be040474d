"""How likely it is that each vehicle exists: by what its detections lose without it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.estimate import Posterior

# Detections of one body are off alike, from frame to frame: however many there are, together they
# tell a third of what a single one would. Log odds of who gains nothing, and per nat and detection,
# by 546 vehicles of five simulated scenes (bench/vehicles/existence.py), held against others.
AT_NOTHING, A_NAT = 0.26, 0.32
MOST_NATS = 10.0  # a detection of what stands on bare road has no more: its density has a bound


def with_existence(posterior: Posterior, motions: Sequence[Motion]) -> list[Motion]:
    """Return the vehicles with the probability that each exists.

    That is the share of its time in which there is a vehicle that no other one in the list stands
    for. What a vehicle gains over all else is the log-probability that is lost if it is deleted, or
    merged with a neighbour that explains its detections, too.

    Parameters
    ----------
    posterior : Posterior
        With these vehicles, in this order, or longer ones.
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
        Of the log-probability, over all else.
    detections : int
        How many are more likely its own than all else's.
    """
    nats = min(max(gain / max(detections, 1), 0.0), MOST_NATS)
    return 1.0 / (1.0 + math.exp(-AT_NOTHING - A_NAT * nats))
