"""Clutter: the fixed scatter points around a radar, drawn once for its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from gis_radar.base import Booleans, Floats, Integers
from simulation.curves import arc_length, points_at
from simulation.movement import Vehicles
from simulation.scatterers import vehicle_scatterers
from simulation.scene import Scene, Tree
from simulation.sight import building_walls, parked_boxes

_LEAF_MOTION_MPS = 0.02  # mean of the range rates' standard deviation
_KERB_REACH_M = 110.0  # from the radar
_GUTTER_M = 0.4  # from the edge of the lane to the kerb stone
_GROUND_REACH_M = 70.0  # from the radar
_GROUND_POINTS = 900
_ASPHALT_LOSS_DB = 14.0  # smooth asphalt reflects a grazing wave away, grass and gravel less
_POINTS_PER_CROWN = 40
_PARKED_DENSITY = 14.0  # as `RadarModel.density`, for parked cars


@dataclass(frozen=True, kw_only=True)
class Clutter:
    """Fixed scatter points.

    Parameters
    ----------
    point : Floats
        Place in the map, ``(n, 3)``, metres.
    rcs : Floats
        Mean radar cross section, dBm2.
    wobble : Floats
        Standard deviation of the range rate (leaves move), m/s.
    """

    point: Floats
    rcs: Floats
    wobble: Floats

    def where(self, keep: Booleans | Integers) -> Clutter:
        """Return the points for which `keep` is true, or of these rows."""
        return Clutter(point=self.point[keep], rcs=self.rcs[keep], wobble=self.wobble[keep])


def draw_clutter(scene: Scene, eye: Floats, rng: np.random.Generator) -> Clutter:
    """Draw the fixed scatter points that a sensor at `eye` can see, in every direction.

    Parameters
    ----------
    scene : Scene
        The surroundings.
    eye : (3,) array
        Position of the sensor in the map.
    rng : Generator
        Random numbers.
    """
    parts = [
        _kerbs(scene, eye, rng),
        _ground(scene, eye, rng),
        _facades(scene, eye, rng),
        _posts(scene, rng),
        _rails(scene, rng),
        _parked(scene, eye, rng),
        *(_tree(scene, tree, eye, rng) for tree in scene.trees),
    ]
    drawn = Clutter(
        point=np.vstack([p.point for p in parts]),
        rcs=np.concatenate([p.rcs for p in parts]),
        wobble=np.concatenate([p.wobble for p in parts]),
    )
    hidden = building_walls(scene).hide(eye, drawn.point)
    own = np.full(len(hidden), -1)
    if scene.cars:
        hidden |= parked_boxes(scene).hide(eye, drawn.point, own)
    return drawn.where(~hidden)


def _motionless(point: Floats, rcs: Floats) -> Clutter:
    return Clutter(point=point, rcs=rcs, wobble=np.zeros(len(rcs)))


def _on_ground(scene: Scene, plane: Floats, over: Floats) -> Floats:
    return np.column_stack([plane, scene.terrain.height(plane) + over])


def _spread(line: Floats, gap_m: float, rng: np.random.Generator) -> Floats:
    """Return points along a polyline, `gap_m` apart on average."""
    length = float(arc_length(line)[-1])
    return points_at(line, rng.uniform(0.0, length, int(length / gap_m)))


def _kerbs(scene: Scene, eye: Floats, rng: np.random.Generator) -> Clutter:
    rings = shapely.get_parts(shapely.boundary(scene.road.buffer(_GUTTER_M)))
    plane = np.vstack([_spread(shapely.get_coordinates(ring), 0.7, rng) for ring in rings])
    plane = plane[np.hypot(*(plane - eye[:2]).T) < _KERB_REACH_M]
    count = len(plane)
    over = rng.uniform(0.0, scene.kerb_m, count)
    return _motionless(_on_ground(scene, plane, over), rng.normal(-9.0, 4.0, count))


def _ground(scene: Scene, eye: Floats, rng: np.random.Generator) -> Clutter:
    reach = _GROUND_REACH_M * np.sqrt(rng.random(_GROUND_POINTS))
    turn = rng.uniform(0.0, 2.0 * np.pi, _GROUND_POINTS)
    plane = eye[:2] + np.column_stack([reach * np.cos(turn), reach * np.sin(turn)])
    point = np.column_stack([plane, scene.ground(plane)])
    asphalt = shapely.contains_xy(scene.road, plane)
    return _motionless(point, rng.normal(-15.0, 4.0, _GROUND_POINTS) - _ASPHALT_LOSS_DB * asphalt)


def _facades(scene: Scene, eye: Floats, rng: np.random.Generator) -> Clutter:
    """Draw points on walls that face the sensor; corners and perpendicular walls are brightest."""
    points, strengths = [np.empty((0, 3))], [np.empty(0)]
    for building in scene.buildings:
        floor = float(scene.terrain.height(building.outline[0]))
        ends = np.roll(building.outline, -1, axis=0)
        middle = building.outline.mean(axis=0)
        for begin, end in zip(building.outline, ends, strict=True):
            along = end - begin
            normal = np.array([along[1], -along[0]]) / np.hypot(*along)
            normal = normal * np.sign(normal @ (begin - middle))
            to_eye = eye[:2] - (begin + end) / 2.0
            aspect = float(normal @ to_eye) / np.hypot(*to_eye)
            if aspect <= 0.0:
                continue
            count = 10 + int(2.5 * np.hypot(*along))
            u = np.where(rng.random(count) < 0.25, rng.integers(0, 2, count), rng.random(count))
            z = floor + rng.uniform(0.3, building.height_m, count)
            plane = begin + u[:, None] * along + 0.05 * normal
            points.append(np.column_stack([plane, z]))
            strengths.append(rng.normal(-4.0 + 12.0 * aspect**4, 5.0, count))
    return _motionless(np.vstack(points), np.concatenate(strengths))


def _posts(scene: Scene, rng: np.random.Generator) -> Clutter:
    each = 5
    plane = np.repeat(np.array([p.place for p in scene.posts]).reshape(-1, 2), each, axis=0)
    tall = np.repeat(np.array([p.height_m for p in scene.posts]), each)
    over = tall * rng.random(len(tall))
    return _motionless(_on_ground(scene, plane, over), rng.normal(2.0, 4.0, len(tall)))


def _rails(scene: Scene, rng: np.random.Generator) -> Clutter:
    points = [np.empty((0, 3))]
    for rail in scene.rails:
        plane = _spread(rail.line, 0.8, rng)
        points.append(_on_ground(scene, plane, np.full(len(plane), rail.height_m)))
    point = np.vstack(points)
    return _motionless(point, rng.normal(-3.0, 4.0, len(point)))


def _parked(scene: Scene, eye: Floats, rng: np.random.Generator) -> Clutter:
    boxes = parked_boxes(scene)
    count = len(boxes.heading)
    standing = Vehicles(
        time=0.0,
        number=np.arange(count),
        kind=np.full(count, "car"),
        centre=boxes.centre[:, :2],
        heading=boxes.heading,
        speed=np.zeros(count),
        yaw_rate=np.zeros(count),
        size=boxes.size,
    )
    found = vehicle_scatterers(standing, scene, eye, density=_PARKED_DENSITY, rng=rng)
    return _motionless(found.point, found.rcs - 3.0)


def _tree(scene: Scene, tree: Tree, eye: Floats, rng: np.random.Generator) -> Clutter:
    """Draw points on the trunk, and on leaves of the near half of the crown, which move."""
    place = np.array(tree.place)
    floor = float(scene.terrain.height(place))
    middle = np.array([*place, floor + tree.crown_height_m])
    outward = rng.normal(size=(_POINTS_PER_CROWN, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    outward *= np.sign(outward @ (eye - middle))[:, None]
    depth = rng.uniform(0.6, 1.0, (_POINTS_PER_CROWN, 1))
    leaves = middle + tree.crown_m * depth * outward
    low = tree.crown_height_m - tree.crown_m
    bark = np.column_stack([np.tile(place, (6, 1)), floor + rng.uniform(0.2, low, 6)])
    stir = rng.gamma(2.0, _LEAF_MOTION_MPS / 2.0, _POINTS_PER_CROWN)
    return Clutter(
        point=np.vstack([bark, leaves]),
        rcs=np.concatenate([rng.normal(-4.0, 3.0, 6), rng.normal(-9.0, 4.0, _POINTS_PER_CROWN)]),
        wobble=np.concatenate([np.zeros(6), stir]),
    )
