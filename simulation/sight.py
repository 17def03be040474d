"""Lines of sight: what boxes and walls hide from a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from simulation.movement import Vehicles
from simulation.scene import Scene

# points this near to a face that looks at the sensor count as being on it
_SKIN_M = 0.4


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Boxes that stand on the ground.

    Parameters
    ----------
    centre : Floats
        Middle of the floor in the map, ``(n, 3)``, metres.
    heading : Floats
        Radians, counter-clockwise from grid east.
    size : Floats
        Length, width and height, ``(n, 3)``, metres.
    """

    centre: Floats
    heading: Floats
    size: Floats

    def hide(self, eye: Floats, points: Floats, own: Integers) -> Booleans:
        """Tell which points a box hides from `eye`.

        Parameters
        ----------
        eye : (3,) array
        points : (n, 3) array
        own : (n,) int array
            The box that a point belongs to, which does not hide it; -1 for none.
        """
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        start = self._turn(eye - self.centre, cos, sin)
        way = self._turn(points[:, None] - eye, cos, sin)
        half = self.size * np.array([0.5, 0.5, 1.0]) * 0.94
        low = np.column_stack([-half[:, :2], np.zeros(len(half))])
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (low - start) / way, (half - start) / way
        enter = np.fmax.reduce(np.minimum(one, other), axis=-1)
        leave = np.fmin.reduce(np.maximum(one, other), axis=-1)
        before = 1.0 - _SKIN_M / np.maximum(np.linalg.norm(points - eye, axis=1), 1.0)
        hidden = (enter < leave) & (leave > 0.0) & (enter < before[:, None])
        hidden[own >= 0, own[own >= 0]] = False
        return np.asarray(hidden.any(axis=1))

    @staticmethod
    def _turn(vectors: Floats, cos: Floats, sin: Floats) -> Floats:
        """Return map vectors in each box's own axes."""
        x, y, z = np.moveaxis(vectors, -1, 0)
        turned = np.broadcast_arrays(cos * x + sin * y, cos * y - sin * x, z)
        return np.stack(turned, axis=-1)


@dataclass(frozen=True, kw_only=True)
class Walls:
    """Upright walls.

    Parameters
    ----------
    begin, end : Floats
        Feet of the walls, ``(n, 2)``, metres.
    top : Floats
        Height of the upper edges in the map, ``(n,)``, metres.
    """

    begin: Floats
    end: Floats
    top: Floats

    def hide(self, eye: Floats, points: Floats) -> Booleans:
        """Tell which ``(n, 3)`` points a wall hides from `eye`."""
        share = self.crossing(eye, points)
        height = eye[2] + share * (points[:, 2] - eye[2])[:, None]
        return np.asarray((np.isfinite(share) & (height < self.top)).any(axis=1))

    def crossing(self, eye: Floats, points: Floats) -> Floats:
        """Return where each line of sight crosses each wall, as its share; NaN where not."""
        way = points[:, None, :2] - eye[:2]
        along = self.end - self.begin
        gap = self.begin - eye[:2]
        cross = way[..., 0] * along[:, 1] - way[..., 1] * along[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (gap[:, 0] * along[:, 1] - gap[:, 1] * along[:, 0]) / cross
            place = (gap[:, 0] * way[..., 1] - gap[:, 1] * way[..., 0]) / cross
        hit = (share > 0.0) & (share < 0.995) & (place >= 0.0) & (place <= 1.0)
        return np.where(hit, share, np.nan)


def vehicle_boxes(vehicles: Vehicles, scene: Scene) -> Boxes:
    """Return the boxes of vehicles on the road."""
    floor = scene.terrain.height(vehicles.centre)
    return Boxes(
        centre=np.column_stack([vehicles.centre, floor]),
        heading=vehicles.heading,
        size=vehicles.size,
    )


def parked_boxes(scene: Scene) -> Boxes:
    """Return the boxes of the parked cars."""
    places = np.array([car.place for car in scene.cars]).reshape(-1, 2)
    return Boxes(
        centre=np.column_stack([places, scene.terrain.height(places)]),
        heading=np.array([car.heading_rad for car in scene.cars]),
        size=np.array([car.size for car in scene.cars]).reshape(-1, 3),
    )


def both(first: Boxes, second: Boxes) -> Boxes:
    """Return the boxes of `first`, then those of `second`."""
    return Boxes(
        centre=np.vstack([first.centre, second.centre]),
        heading=np.concatenate([first.heading, second.heading]),
        size=np.vstack([first.size, second.size]),
    )


def building_walls(scene: Scene) -> Walls:
    """Return the walls of all buildings."""
    begin = [b.outline for b in scene.buildings]
    end = [np.roll(b.outline, -1, axis=0) for b in scene.buildings]
    top = [
        np.full(len(b.outline), float(scene.terrain.height(b.outline[0])) + b.height_m)
        for b in scene.buildings
    ]
    return Walls(
        begin=np.vstack([np.empty((0, 2)), *begin]),
        end=np.vstack([np.empty((0, 2)), *end]),
        top=np.concatenate([np.empty(0), *top]),
    )
