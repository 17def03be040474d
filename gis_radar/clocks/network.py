"""From offsets between pairs of clocks to the offset of each from one reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.clocks.fine import Offset
from gis_radar.sensor_clocks import SensorClock

Edges = dict[tuple[str, str], Offset]
CONTRADICTION = 4.0  # standard deviations
DRIFT_TOLD = 3.0  # the same: a drift below would only carry noise over hours


@dataclass(frozen=True, kw_only=True)
class Network:
    """The clocks that hang together with the reference.

    Parameters
    ----------
    clocks : dict
        Each sensor's clock, the reference's own with offset 0.
    misfit : float
        The largest misfit of a pair, in its standard deviations; 0 without loops.
    """

    clocks: dict[str, SensorClock]
    misfit: float


def settle(edges: Edges, reference: str) -> Network:
    """Find all clocks by weighted least squares over the pairs.

    Parameters
    ----------
    edges : dict
        By (one, other): how far the clock of `other` is ahead of that of `one`.
    reference : str
        The sensor whose clock counts as right.
    """
    rough = _reached(edges, reference)
    names = [name for name in rough if name != reference]
    used = {pair: offset for pair, offset in edges.items() if pair[0] in rough}
    if not used:
        return Network(clocks={reference: SensorClock(offset_s=0.0)}, misfit=0.0)
    design = np.array([[(n == b) - (n == a) for n in names] for a, b in used], np.float64)
    found = list(used.values())
    # When each pair was compared, by the reference's clock.
    at = np.array([offset.at - rough[b] for (_, b), offset in used.items()])
    middle = float(np.median(at))
    drift, drift_sigma, _ = _least_squares(
        design, np.array([f.drift for f in found]), np.array([f.drift_sigma for f in found])
    )
    drift = np.where(np.abs(drift) > DRIFT_TOLD * drift_sigma, drift, 0.0)
    offset = np.array([f.offset_s for f in found]) - design @ drift * (at - middle)
    sigma = np.array([f.sigma_s for f in found])
    offset, offset_sigma, misfit = _least_squares(design, offset, sigma)
    clocks = {
        name: SensorClock(
            offset_s=float(offset[i]),
            sigma_s=float(offset_sigma[i]),
            drift_ppm=float(drift[i] * 1e6),
            drift_sigma_ppm=float(drift_sigma[i] * 1e6),
            at=middle + float(offset[i]),
        )
        for i, name in enumerate(names)
    }
    first = SensorClock(offset_s=0.0, sigma_s=0.0, drift_sigma_ppm=0.0, at=middle)
    return Network(clocks={reference: first} | clocks, misfit=misfit)


def best_linked(edges: Edges, sensors: list[str]) -> str:
    """Return the first of the sensors that pairs link with the most others."""
    return max(sensors, key=lambda sensor: len(_reached(edges, sensor)))


def _reached(edges: Edges, reference: str) -> dict[str, float]:
    """Return the sensors that pairs link with the reference, and how far they are ahead."""
    ahead = {reference: 0.0}
    waiting = [reference]
    while waiting:
        here = waiting.pop(0)
        for (one, other), offset in edges.items():
            if one == here and other not in ahead:
                ahead[other] = ahead[here] + offset.offset_s
                waiting.append(other)
            elif other == here and one not in ahead:
                ahead[one] = ahead[here] - offset.offset_s
                waiting.append(one)
    return ahead


def _least_squares(design: Floats, values: Floats, sigma: Floats) -> tuple[Floats, Floats, float]:
    """Return the solution, its standard deviations, and the largest misfit over its sigma."""
    scaled = design / sigma[:, None]
    covariance = np.linalg.inv(scaled.T @ scaled)
    solution = covariance @ scaled.T @ (values / sigma)
    misfit = float(np.max(np.abs(values - design @ solution) / sigma))
    return solution, np.sqrt(np.diag(covariance)), misfit
