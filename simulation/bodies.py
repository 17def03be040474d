"""Scatter points of walkers: on the trunk and on limbs that swing."""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats
from simulation.movement import Vehicles
from simulation.scatterers import Scatterers
from simulation.scene import Scene

_MEAN_POINTS = 6.0  # a frame; recordings have 4-5 detections of a walker near the radar
_LIMB_SHARE = 0.4  # of the points
_LIMB_SPEEDS = (0.0, 2.5)  # times the walker's: a foot stands, then overtakes
# -8 dBm2 of a walker, divided by the points: 1 detection a frame at 45 m, where a car has 1-2
_MEAN_RCS_DB, _RCS_SIGMA_DB = -8.0 - 10.0 * np.log10(_MEAN_POINTS), 4.0


def walker_scatterers(walkers: Vehicles, scene: Scene, rng: np.random.Generator) -> Scatterers:
    """Draw the scatter points of walkers for one frame; bodies change as they move.

    Parameters
    ----------
    walkers : Vehicles
        The walkers.
    scene : Scene
        Gives the ground's height.
    rng : Generator
        Random numbers.
    """
    owner = np.repeat(np.arange(len(walkers.speed)), rng.poisson(_MEAN_POINTS, len(walkers.speed)))
    count = len(owner)
    plane = walkers.centre[owner] + rng.normal(0.0, 0.12, (count, 2))
    limb = rng.random(count) < _LIMB_SHARE
    over = np.where(limb, rng.uniform(0.1, 1.0, count), rng.uniform(0.8, 1.7, count))
    share = np.where(limb, rng.uniform(*_LIMB_SPEEDS, count), rng.normal(1.0, 0.1, count))
    heading: Floats = walkers.heading[owner]
    ahead = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    return Scatterers(
        point=np.column_stack([plane, scene.ground(plane) + over]),
        velocity=(walkers.speed[owner] * share)[:, None] * ahead,
        rcs=rng.normal(_MEAN_RCS_DB, _RCS_SIGMA_DB, count),
        owner=owner,
        target=np.full(count, -1),
    )
