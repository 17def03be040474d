"""Scatter points on vehicles: their places, velocities and cross sections; multipath ghosts."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from gis_radar.base import Booleans, Floats, Integers
from simulation.movement import Vehicles
from simulation.scene import Scene
from simulation.sight import Walls

_TALL_VEHICLE_M = 2.4  # higher vehicles have more points high up
_WHEEL_SHARE = 0.16  # of the points on a long side
_MEAN_DEPTH_M = 0.08  # of points behind the face
SPOT_DB = 5.5  # standard deviation of cross sections of a vehicle's points


@dataclass(frozen=True, kw_only=True)
class Scatterers:
    """Scatter points of one moment, one row each.

    Parameters
    ----------
    point : Floats
        Place in the map, ``(n, 3)``, metres.
    velocity : Floats
        Velocity, ``(n, 3)``, m/s.
    rcs : Floats
        Radar cross section, dBm2.
    owner : Integers
        Row of the vehicle that it is on; -1: none.
    target : Integers
        Number of its lasting target (`simulation.targets`); -1: none.
    """

    point: Floats
    velocity: Floats
    rcs: Floats
    owner: Integers
    target: Integers

    def where(self, keep: Booleans) -> Scatterers:
        """Return the scatterers for which `keep` is true."""
        return Scatterers(
            point=self.point[keep],
            velocity=self.velocity[keep],
            rcs=self.rcs[keep],
            owner=self.owner[keep],
            target=self.target[keep],
        )

    def of(self, target: Integers) -> Scatterers:
        """Return the same scatterers with the numbers of lasting targets."""
        return replace(self, target=target)

    def range_rate(self, eye: Floats) -> Floats:
        """Return how fast each point recedes from `eye`, m/s."""
        sight = self.point - eye
        away = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-6)[:, None]
        return np.asarray(np.sum(away * self.velocity, axis=1))


def join_scatterers(parts: list[Scatterers]) -> Scatterers:
    """Return the scatterers of several sources as one."""
    return Scatterers(
        point=np.vstack([p.point for p in parts]),
        velocity=np.vstack([p.velocity for p in parts]),
        rcs=np.concatenate([p.rcs for p in parts]),
        owner=np.concatenate([p.owner for p in parts]),
        target=np.concatenate([p.target for p in parts]),
    )


def vehicle_scatterers(
    vehicles: Vehicles, scene: Scene, eye: Floats, *, density: float, rng: np.random.Generator
) -> Scatterers:
    """Draw the scatter points of vehicles on the faces turned to the sensor.

    Parameters
    ----------
    vehicles : Vehicles
        The vehicles.
    scene : Scene
        Gives the road's height.
    eye : (3,) array
        Position of the sensor in the map.
    density : float
        Mean number of scatter points of a car's front seen straight on.
    rng : Generator
        Random numbers.
    """
    rates, signs = face_rates(vehicles, eye, density)
    face = np.repeat(np.arange(rates.size), rng.poisson(rates.ravel()))
    owner, side = face % rates.shape[1], face >= rates.shape[1]
    spots = draw_spots(side, rng)
    spin = rng.uniform(0.0, 2.0 * np.pi, len(owner))
    rcs = rng.normal(0.0, SPOT_DB, len(owner))
    outward = signs[side.astype(int), owner]
    return place_spots(vehicles, scene, owner, outward, spots, spin=spin, rcs=rcs)


def face_rates(vehicles: Vehicles, eye: Floats, density: float) -> tuple[Floats, Floats]:
    """Return the mean numbers of scatter points on the two visible faces of each vehicle.

    Returns
    -------
    rates : (2, n) array
        Mean number on the end and on the side that are turned to `eye`.
    signs : (2, n) array
        1 for front and left side, -1 for rear and right side.
    """
    to_eye = eye[:2] - vehicles.centre
    cos, sin = np.cos(vehicles.heading), np.sin(vehicles.heading)
    length, width, height = vehicles.size.T
    local = np.stack(
        [cos * to_eye[:, 0] + sin * to_eye[:, 1], cos * to_eye[:, 1] - sin * to_eye[:, 0]]
    )
    outside = np.abs(local) - np.stack([length, width]) / 2.0
    aspect = np.maximum(outside, 0.0) / np.hypot(*to_eye.T)
    tall = np.sqrt(height / 1.5)
    ends = density * (width / 1.8) * tall * aspect[0] ** 0.7
    sides = density * (length / 4.5) ** 0.8 * tall * aspect[1] ** 0.8
    return np.stack([ends, sides]), np.sign(local)


@dataclass(frozen=True, kw_only=True)
class Spots:
    """Places of scatter points on a face, one row each.

    Parameters
    ----------
    side : Booleans
        Whether the face is a long side.
    wheel : Booleans
        Whether it is on a wheel.
    across : Floats
        Place along the face, -1 to 1.
    inside_m : Floats
        Depth behind the face.
    low_m, high : Floats
        Height over the road of a low point; share of the vehicle's height of a high one.
    pick : Floats
        Random number, 0 to 1, that decides between both: small ones are high points.
    """

    side: Booleans
    wheel: Booleans
    across: Floats
    inside_m: Floats
    low_m: Floats
    high: Floats
    pick: Floats

    def where(self, rows: Integers) -> Spots:
        """Return some rows."""
        return Spots(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def draw_spots(side: Booleans, rng: np.random.Generator) -> Spots:
    """Draw scatter points on long sides and on ends: bumpers and sills, and up to the roof."""
    count = len(side)
    across = _draw_across(side, rng)
    wheel = side & (rng.random(count) < _WHEEL_SHARE)
    across[wheel] = np.sign(across[wheel]) * rng.normal(0.62, 0.04, int(wheel.sum()))
    return Spots(
        side=side,
        wheel=wheel,
        across=across,
        inside_m=rng.exponential(_MEAN_DEPTH_M, count),
        low_m=rng.uniform(0.3, 0.9, count),
        high=rng.uniform(0.3, 0.95, count),
        pick=rng.random(count),
    )


def _draw_across(side: Booleans, rng: np.random.Generator) -> Floats:
    """Draw the place on a face, -1 to 1: corners and wheel houses scatter best."""
    count = len(side)
    sign = rng.choice([-1.0, 1.0], count)
    corner = sign * (1.0 - np.abs(rng.normal(0.0, 0.1, count)))
    house = sign * rng.normal(0.62, 0.07, count)
    plain = rng.uniform(-1.0, 1.0, count)
    pick = rng.random(count)
    special = np.where(side & (pick > 0.3), house, corner)
    return np.asarray(np.where(pick < 0.55, special, plain))


def place_spots(
    vehicles: Vehicles, scene: Scene, owner: Integers, outward: Floats, spots: Spots, *,
    spin: Floats, rcs: Floats,
) -> Scatterers:  # fmt: skip
    """Return the scatterers of points on faces of vehicles.

    Parameters
    ----------
    vehicles : Vehicles
        The vehicles.
    scene : Scene
        Gives the road's height.
    owner : (n,) int array
        Row of the vehicle that each point is on.
    outward : (n,) array
        1 on front and left side, -1 on rear and right side.
    spots : Spots
        Places on the faces.
    spin : (n,) array
        Angle on the wheel of a point of a wheel, rad.
    rcs : (n,) array
        Cross section relative to the vehicle's mean, dB.
    """
    side, wheel, size = spots.side, spots.wheel, vehicles.size[owner]
    half, height = size[:, :2] / 2.0, size[:, 2]
    depth = 1.0 - np.minimum(spots.inside_m / half.min(axis=1), 1.0)
    lengthwise = np.where(side, spots.across, outward * depth) * half[:, 0]
    sidewise = np.where(side, outward * depth, spots.across) * half[:, 1]
    tall = spots.pick < np.where(height > _TALL_VEHICLE_M, 0.5, 0.25)
    over = np.where(wheel, 0.35, np.where(tall, spots.high * height, spots.low_m))
    heading, speed = vehicles.heading[owner], vehicles.speed[owner]
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    arm = lengthwise[:, None] * ahead + sidewise[:, None] * left
    plane = vehicles.centre[owner] + arm
    # a wheel's top moves at twice the vehicle's speed, its lowest point stands
    roll = np.where(wheel, 1.0 + np.cos(spin), 1.0)
    turning = vehicles.yaw_rate[owner][:, None] * np.column_stack([-arm[:, 1], arm[:, 0]])
    flat = (speed * roll)[:, None] * ahead + turning
    rise = np.sum(scene.terrain.gradient(plane) * flat, axis=1)
    base = 8.0 * np.log10(size[:, 0] * size[:, 2] / 6.5)
    return Scatterers(
        point=np.column_stack([plane, scene.terrain.height(plane) + over]),
        velocity=np.column_stack([flat, rise]),
        rcs=base + np.where(wheel, -8.0, 1.0) + rcs,
        owner=owner,
        target=np.full(len(owner), -1),
    )


def ghosts(
    scatterers: Scatterers, eye: Floats, walls: Walls, *, share: float, rng: np.random.Generator
) -> Scatterers:
    """Draw multipath ghosts of some scatterers.

    Where a wall mirrors the vehicle to the sensor, the ghost is its mirror image, with mirrored
    motion; else it is behind its origin, as after a longer path.

    Parameters
    ----------
    scatterers : Scatterers
        Scatterers in sight.
    eye : (3,) array
        Position of the sensor in the map.
    walls : Walls
        Walls that mirror.
    share : float
        Ghosts per scatterer.
    rng : Generator
        Random numbers.
    """
    chosen = scatterers.where(rng.random(len(scatterers.rcs)) < share)
    sight = chosen.point - eye
    reach = np.linalg.norm(sight, axis=1)
    longer = 1.0 + rng.uniform(1.5, 25.0, len(reach)) / np.maximum(reach, 1.0)
    point = eye + sight * longer[:, None]
    velocity = chosen.velocity * rng.uniform(0.85, 1.15, len(reach))[:, None]
    for row in range(len(reach)):
        image = _image(chosen.point[row], chosen.velocity[row], eye, walls, rng)
        if image is not None:
            point[row], velocity[row] = image
    loss = rng.uniform(4.0, 12.0, len(reach))
    none = np.full(len(reach), -1)
    rcs = chosen.rcs - loss
    return Scatterers(point=point, velocity=velocity, rcs=rcs, owner=none, target=none)


def _image(
    point: Floats, velocity: Floats, eye: Floats, walls: Walls, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Return place and velocity of a mirror image that the sensor sees in a wall, or None."""
    along = walls.end - walls.begin
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    normal = normal / np.maximum(np.hypot(*normal.T), 1e-9)[:, None]
    depth = np.sum((point[:2] - walls.begin) * normal, axis=1)
    images = np.column_stack(
        [point[:2] - 2.0 * depth[:, None] * normal, np.full(len(normal), point[2])]
    )
    seen = np.isfinite(np.diagonal(walls.crossing(eye, images)))
    if not seen.any() or rng.random() < 0.5:
        return None
    # the nearest wall hides the others
    wall = int(np.argmin(np.where(seen, np.linalg.norm(images - eye, axis=1), np.inf)))
    flat = velocity[:2] - 2.0 * (velocity[:2] @ normal[wall]) * normal[wall]
    return images[wall], np.array([flat[0], flat[1], velocity[2]])
