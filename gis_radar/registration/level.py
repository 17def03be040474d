"""Levelling: which way is up, from the road that the traces lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.traces import Samples

TILT = np.radians(6.0)  # 1 sigma of how far masts and roads lean
SPREAD_M = 0.5
ELEVATION = np.radians(0.6)
ROUNDS = 12


@dataclass(frozen=True, kw_only=True)
class Levelling:
    """The road plane as the sensor sees it.

    Parameters
    ----------
    R_level_sensor : (3, 3) array
        Turns the sensor frame so that the road's plane is level and below; the heading of the
        x axis stays.
    depth_m : float
        From the sensor down to the plane of the reflections.
    """

    R_level_sensor: Floats
    depth_m: float


def level(samples: Samples) -> Levelling:
    """Fit a plane to the traces, robustly; a sensor over which the road lies hangs upside down.

    Parameters
    ----------
    samples : Samples
        Traces.
    """
    x, y, z = samples.points.T
    rows = np.column_stack([x, y, np.ones(len(x))])
    sigma = np.hypot(SPREAD_M, ELEVATION * np.linalg.norm(samples.points, axis=1))
    prior = np.diag([TILT**-2, TILT**-2, 0.0])
    weight = sigma**-2
    plane = np.array([0.0, 0.0, float(np.median(z))])
    for _ in range(ROUNDS):
        weight = sigma**-2 / (1.0 + ((z - rows @ plane) / (2.0 * sigma)) ** 2) ** 2
        plane = np.linalg.solve(rows.T @ (weight[:, None] * rows) + prior, rows.T @ (weight * z))
    up = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1.0 + plane[0] ** 2 + plane[1] ** 2)
    depth = -plane[2] * up[2]
    if depth < 0.0:
        up, depth = -up, -depth
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    return Levelling(
        R_level_sensor=np.vstack([ahead, np.cross(up, ahead), up]), depth_m=float(depth)
    )
