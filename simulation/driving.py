"""Driving: where in their lanes drivers keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats
from simulation.network import Lane, RoadNetwork, Turn

EASED_M = 12.0


@dataclass(frozen=True, kw_only=True)
class LaneKeeping:
    """How drivers keep their lanes; positive is left of the middle, metres.

    Parameters
    ----------
    mean_m : float
        What all drivers do everywhere.
    street_m : float
        Standard deviation, from street to street, of what all drivers do there: parked cars, kerbs
        and medians push them to one side.
    driver_m : float
        Standard deviation from driver to driver; none is more than two off.
    wander_m : float
        Amplitude of a driver's own slow wander.
    """

    mean_m: float = 0.0
    street_m: float = 0.0
    driver_m: float = 0.15
    wander_m: float = 0.08

    def on(self, network: RoadNetwork, *, seed: int) -> DrivenRoads:
        """Return a network with what all drivers do on each of its streets."""
        edges = sorted({lane.edge for lane in network.lanes.values()})
        rng = np.random.default_rng([seed, 1])
        drawn = self.mean_m + self.street_m * rng.normal(size=len(edges))
        return DrivenRoads(network=network, by_edge=dict(zip(edges, drawn.tolist(), strict=True)))


@dataclass(frozen=True, kw_only=True)
class DrivenRoads:
    """A network, and where in its lanes all drivers keep.

    Parameters
    ----------
    network : RoadNetwork
        The lanes.
    by_edge : dict[str, float]
        How far to the left of the middle the lanes of an edge are driven, metres.
    """

    network: RoadNetwork
    by_edge: dict[str, float]

    def aside(self, lane: str) -> float:
        """Return how far to the left one of SUMO's lanes is driven; a turn as where it leads."""
        band = self.network.bands[self.network.spans[lane][0]]
        into = self.network.lanes[band.target] if isinstance(band, Turn) else band
        return self.by_edge[into.edge] if isinstance(into, Lane) else 0.0


def eased(value: Floats, driven_m: Floats) -> Floats:
    """Return the running mean of `value` over the way driven, so that no driver jumps aside.

    Parameters
    ----------
    value : (n,) array
        At each step.
    driven_m : (n,) array
        How far the vehicle has come, ascending, metres.
    """
    sums = np.cumsum(value[1:] * np.diff(driven_m))
    reach = 2.0 * EASED_M
    total = np.concatenate([[-reach * value[0], 0.0], sums])
    total = np.append(total, total[-1] + reach * value[-1])
    way = np.concatenate([[driven_m[0] - reach], driven_m, [driven_m[-1] + reach]])
    ahead, behind = (np.interp(driven_m + d, way, total) for d in (EASED_M, -EASED_M))
    return np.asarray((ahead - behind) / (2.0 * EASED_M))
