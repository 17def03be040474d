"""Lines of sight: which points boxes and walls hide from a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, compiled
from simulation.movement import Vehicles
from simulation.scene import Scene

_SKIN_M = 0.4  # points so near behind the face of a box are not hidden by it


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
        """Return which points a box hides from `eye`.

        Parameters
        ----------
        eye : (3,) array
        points : (n, 3) array
        own : (n,) int array
            The box that a point is on, which does not hide it; -1: none.
        """
        half = self.size * np.array([0.5, 0.5, 1.0]) * 0.94
        before = 1.0 - _SKIN_M / np.maximum(np.linalg.norm(points - eye, axis=1), 1.0)
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return _behind_boxes(
            np.asarray(eye, np.float64), np.ascontiguousarray(points, np.float64), before,
            np.asarray(own, np.int64), self.centre, cos, sin, half,
        )  # fmt: skip


@compiled
def _behind_boxes(
    eye: Floats, points: Floats, before: Floats, own: Integers,
    centre: Floats, cos: Floats, sin: Floats, half: Floats,
) -> Booleans:  # fmt: skip
    """Return which points a box hides: the line of sight enters it before the point."""
    hidden = np.zeros(len(points), np.bool_)
    start, way = np.empty(3), np.empty(3)
    for j in range(len(centre)):
        x, y = eye[0] - centre[j, 0], eye[1] - centre[j, 1]
        start[0], start[1] = cos[j] * x + sin[j] * y, cos[j] * y - sin[j] * x
        start[2] = eye[2] - centre[j, 2]
        for i in range(len(points)):
            if hidden[i] or own[i] == j:
                continue
            x, y = points[i, 0] - eye[0], points[i, 1] - eye[1]
            way[0], way[1] = cos[j] * x + sin[j] * y, cos[j] * y - sin[j] * x
            way[2] = points[i, 2] - eye[2]
            enter, leave = -np.inf, np.inf
            for k in range(3):
                low, high = (0.0 if k == 2 else -half[j, k]) - start[k], half[j, k] - start[k]
                if way[k] != 0.0:
                    one, other = low / way[k], high / way[k]
                    enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
                elif low > 0.0 or high < 0.0:
                    leave = -np.inf  # beside the box, and along it
            hidden[i] = enter < leave and leave > 0.0 and enter < before[i]
    return hidden


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
        """Return which ``(n, 3)`` points a wall hides from `eye`."""
        share = self.crossing(eye, points)
        height = eye[2] + share * (points[:, 2] - eye[2])[:, None]
        return np.asarray((np.isfinite(share) & (height < self.top)).any(axis=1))

    def crossing(self, eye: Floats, points: Floats) -> Floats:
        """Return at which share of itself each line of sight crosses each wall; NaN: nowhere."""
        return _crossings(
            np.asarray(eye, np.float64), np.ascontiguousarray(points, np.float64),
            self.begin, self.end - self.begin,
        )  # fmt: skip


@compiled
def _crossings(eye: Floats, points: Floats, begin: Floats, along: Floats) -> Floats:
    """Return the result of :meth:`Walls.crossing`; `along` is from begin to end of the walls."""
    shares = np.full((len(points), len(begin)), np.nan)
    for i in range(len(points)):
        x, y = points[i, 0] - eye[0], points[i, 1] - eye[1]
        for j in range(len(begin)):
            cross = x * along[j, 1] - y * along[j, 0]
            if cross == 0.0:
                continue
            east, north = begin[j, 0] - eye[0], begin[j, 1] - eye[1]
            share = (east * along[j, 1] - north * along[j, 0]) / cross
            place = (east * y - north * x) / cross
            if 0.0 < share < 0.995 and 0.0 <= place <= 1.0:
                shares[i, j] = share
    return shares


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


def join_boxes(first: Boxes, second: Boxes) -> Boxes:
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
