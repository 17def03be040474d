"""Airborne laser scans of a scene: strips of pulses that end at ground, roofs, crowns and cars."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import shapely
from pyproj import CRS
from scipy.spatial import cKDTree

from gis_radar.base import Floats, Integers, atomic_write
from simulation.scene import Building, ParkedCar, Scene, Tree
from simulation.terrain import Terrain

UNCLASSIFIED, GROUND, LOW, HIGH, BUILDING = 1, 2, 3, 5, 6  # ASPRS classes; vegetation low and high
_WALL_STEPS = 14  # heights of a building at which it is tested whether pulses meet it
_BONNET_SHARE = 0.65  # height of bonnet and boot as a share of a car's
_CAR_HEIGHT_SHARES = (0.05, 0.2, 0.4, _BONNET_SHARE, 0.8, 1.0)  # tested likewise
_BOX_CAR_M = 2.0  # higher vehicles are boxes, without bonnet and boot


@dataclass(frozen=True, kw_only=True)
class Strip:
    """One flight line.

    Parameters
    ----------
    heading_deg : float
        Direction of flight, counter-clockwise from grid east.
    slant : float
        Tangent of the angle at which pulses come in from the right of the flight.
    along_m, across_m : float
        Distance between scan lines, and between the pulses of a line.
    """

    heading_deg: float
    slant: float
    along_m: float = 0.46
    across_m: float = 0.46


@dataclass(frozen=True, kw_only=True)
class ScanModel:
    """Settings of a scan.

    Parameters
    ----------
    strips : tuple of Strip
        Flight lines, each over the whole area.
    reach_m, full_m : float
        Distances from the road at which the scan ends, and from which on half of it is left out.
    noise_m : float
        Standard deviation of every coordinate.
    leaf_path_m : float
        Mean length of a pulse's path through leaves.
    second_share : float
        Share of the pulses from a crown that have a second return, from below it.
    """

    strips: tuple[Strip, ...] = (
        Strip(heading_deg=24.0, slant=0.16),
        Strip(heading_deg=208.0, slant=0.1),
    )
    reach_m: float = 24.0
    full_m: float = 9.0
    noise_m: float = 0.03
    leaf_path_m: float = 3.0
    second_share: float = 0.35


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Points of a scan, one row each.

    Parameters
    ----------
    point : Floats
        Map coordinates, ``(n, 3)``, metres.
    category : Integers
        ASPRS class.
    intensity : Integers
        Brightness.
    return_number, number_of_returns : Integers
        Number of the return, and of returns of its pulse.
    strip : Integers
        Flight line, from 1.
    """

    point: Floats = field(repr=False)
    category: Integers = field(repr=False)
    intensity: Integers = field(repr=False)
    return_number: Integers = field(repr=False)
    number_of_returns: Integers = field(repr=False)
    strip: Integers = field(repr=False)


@dataclass(kw_only=True)
class _Pulses:
    """Pulses of a strip: where each aims at the ground, and the height where it ends so far."""

    aim: Floats
    lean: Floats
    over: Floats
    category: Integers
    tree: cKDTree

    def near(self, place: Floats, reach_m: float) -> Integers:
        """Return the pulses that aim within `reach_m` of a place."""
        return np.array(self.tree.query_ball_point(place, reach_m), dtype=np.int64)

    def hit(self, rows: Integers, over: Floats, category: int) -> None:
        """Let pulses end at a height over the ground, unless they ended higher up."""
        first = over > self.over[rows]
        self.over[rows[first]] = over[first]
        self.category[rows[first]] = category


def fly(scene: Scene, *, rng: np.random.Generator, model: ScanModel | None = None) -> Scan:
    """Scan a scene from the air.

    Parameters
    ----------
    scene : Scene
        The scene, with the cars that are parked at the time of the scan.
    rng : Generator
        Random numbers.
    model : ScanModel, optional
        Settings of the scan.
    """
    model = model or ScanModel()
    parts = [_fly_strip(scene, strip, model, rng) for strip in model.strips]
    number = [np.full(len(p.category), k, dtype=np.int64) for k, p in enumerate(parts, start=1)]
    return Scan(
        point=np.vstack([p.point for p in parts]),
        category=np.concatenate([p.category for p in parts]),
        intensity=np.concatenate([p.intensity for p in parts]),
        return_number=np.concatenate([p.return_number for p in parts]),
        number_of_returns=np.concatenate([p.number_of_returns for p in parts]),
        strip=np.concatenate(number),
    )


def _fly_strip(scene: Scene, strip: Strip, model: ScanModel, rng: np.random.Generator) -> Scan:
    aim = _aims(scene, strip, model, rng)
    ahead = np.radians(strip.heading_deg)
    lean = strip.slant * np.array([np.sin(ahead), -np.cos(ahead)])
    pulses = _Pulses(
        aim=aim,
        lean=lean,
        over=np.zeros(len(aim)),
        category=np.full(len(aim), GROUND, dtype=np.int64),
        tree=cKDTree(aim),
    )
    for building in scene.buildings:
        _hit_building(pulses, building, scene.terrain)
    for car in scene.cars:
        _hit_car(pulses, car)
    bare = pulses.over.copy(), pulses.category.copy()
    for tree in scene.trees:
        _hit_tree(pulses, tree, model.leaf_path_m, rng)
    second = (pulses.category == HIGH) & (rng.random(len(aim)) < model.second_share)
    first = _points(scene, pulses, np.arange(len(aim)), rng)
    pulses.over, pulses.category = bare
    last = _points(scene, pulses, np.flatnonzero(second), rng)
    order = np.argsort(np.concatenate([np.arange(len(aim)), np.flatnonzero(second)]), kind="stable")
    point, category, intensity = (
        np.concatenate(pair)[order] for pair in zip(first, last, strict=True)
    )
    ones = np.ones(len(aim), dtype=np.int64)
    twos = np.full(int(second.sum()), 2, dtype=np.int64)
    return Scan(
        point=point + rng.normal(0.0, model.noise_m, point.shape),
        category=category,
        intensity=intensity,
        return_number=np.concatenate([ones, twos])[order],
        number_of_returns=np.concatenate([ones + second, twos])[order],
        strip=np.empty(0, dtype=np.int64),
    )


def _aims(scene: Scene, strip: Strip, model: ScanModel, rng: np.random.Generator) -> Floats:
    """Draw where the pulses of a strip aim at the ground, line by line."""
    west, south, east, north = scene.road.buffer(model.reach_m).bounds
    middle = np.array([west + east, south + north]) / 2.0
    radius = np.hypot(east - west, north - south) / 2.0
    along = np.arange(-radius, radius, strip.along_m)
    across = np.arange(-radius, radius, strip.across_m)
    u, v = np.meshgrid(along, across, indexing="ij")
    # the aircraft flies on while the mirror sweeps: scan lines are oblique, in a zigzag
    u = u + strip.along_m * np.where(np.arange(len(along)) % 2, 0.5, -0.5)[:, None] * v / radius
    u, v = (w.ravel() + rng.normal(0.0, 0.05, w.size) for w in (u, v))
    cos, sin = np.cos(np.radians(strip.heading_deg)), np.sin(np.radians(strip.heading_deg))
    aim = middle + np.column_stack([cos * u - sin * v, sin * u + cos * v])
    wide, near = scene.road.buffer(model.reach_m), scene.road.buffer(model.full_m)
    shapely.prepare([wide, near])
    aim = aim[shapely.contains_xy(wide, aim[:, 0], aim[:, 1])]
    kept = shapely.contains_xy(near, aim[:, 0], aim[:, 1]) | (rng.random(len(aim)) < 0.5)
    return np.asarray(aim[kept])


def _hit_building(pulses: _Pulses, building: Building, terrain: Terrain) -> None:
    """Let pulses end on the roof, or on a wall where they come in from the side."""
    shape = shapely.Polygon(building.outline)
    shapely.prepare(shape)
    middle = building.outline.mean(axis=0)
    reach = float(np.hypot(*(building.outline - middle).T).max()) + 0.3 * building.height_m
    rows = pulses.near(middle, reach)
    over = np.zeros(len(rows))
    floor = float(terrain.height(building.outline[0]))
    for share in np.linspace(0.0, 1.0, _WALL_STEPS):
        place = pulses.aim[rows] + share * building.height_m * pulses.lean
        inside = shapely.contains_xy(shape, place[:, 0], place[:, 1])
        # the roof is level, whatever the ground does
        top = floor + share * building.height_m - terrain.height(place)
        over[inside] = top[inside]
    inside = over > 0.0
    pulses.hit(rows[inside], over[inside], BUILDING)


def _hit_car(pulses: _Pulses, car: ParkedCar) -> None:
    """Let pulses end on a car: bonnet and boot are lower than the roof."""
    length, width, height = car.size
    rows = pulses.near(np.array(car.place), length)
    cos, sin = np.cos(car.heading_rad), np.sin(car.heading_rad)
    over = np.zeros(len(rows))
    for share in _CAR_HEIGHT_SHARES:
        local = pulses.aim[rows] + share * height * pulses.lean - np.array(car.place)
        u = cos * local[:, 0] + sin * local[:, 1]
        v = cos * local[:, 1] - sin * local[:, 0]
        inside = (np.abs(u) < length / 2.0) & (np.abs(v) < width / 2.0)
        low = (np.abs(u + 0.05 * length) > 0.28 * length) & (height < _BOX_CAR_M)
        over[inside & (share <= np.where(low, _BONNET_SHARE, 1.0))] = share * height
    hit = over > 0.0
    pulses.hit(rows[hit], over[hit], UNCLASSIFIED)


def _hit_tree(pulses: _Pulses, tree: Tree, path_m: float, rng: np.random.Generator) -> None:
    """Let pulses end in a crown, the more likely the longer their way through it."""
    rows = pulses.near(np.array(tree.place), tree.crown_m + 0.3 * tree.crown_height_m)
    gap = pulses.aim[rows] - np.array(tree.place)
    steep = 1.0 + pulses.lean @ pulses.lean
    middle = (tree.crown_height_m - gap @ pulses.lean) / steep
    off = np.sum((gap + middle[:, None] * pulses.lean) ** 2, axis=1)
    off += (middle - tree.crown_height_m) ** 2
    half = np.sqrt(np.maximum(tree.crown_m**2 - off, 0.0))
    depth = rng.exponential(path_m, len(rows))
    caught = depth < 2.0 * half
    pulses.hit(rows[caught], (middle + half - depth)[caught], HIGH)


def _points(
    scene: Scene, pulses: _Pulses, rows: Integers, rng: np.random.Generator
) -> tuple[Floats, Integers, Integers]:
    """Return points, classes and intensities where pulses end; some beside the road are grass."""
    plane = pulses.aim[rows] + pulses.over[rows, None] * pulses.lean
    category = pulses.category[rows].copy()
    base = np.where(category == GROUND, scene.ground(plane), scene.terrain.height(plane))
    on_road = shapely.contains_xy(scene.road, plane[:, 0], plane[:, 1])
    grass = (category == GROUND) & ~on_road & (rng.random(len(rows)) < 0.05)
    category[grass] = LOW
    over = pulses.over[rows] + np.where(grass, 0.1 + rng.exponential(0.15, len(rows)), 0.0)
    bright = np.where(on_road & (category == GROUND), 12, 40) + 8 * (category == BUILDING)
    intensity = np.maximum(bright + np.rint(rng.normal(0.0, 2.0, len(rows))), 1).astype(np.int64)
    return np.column_stack([plane, base + over]), category, intensity


def write_scan(scan: Scan, path: Path, *, crs: CRS, flown: date) -> None:
    """Write a scan as LAZ 1.4 with its coordinate system, to the centimetre.

    Parameters
    ----------
    scan : Scan
        The points.
    path : Path
        The ``.laz`` file.
    crs : CRS
        Of the points.
    flown : date
        Written into the header.
    """
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.01)
    header.offsets = np.floor(scan.point.min(axis=0) / 100.0) * 100.0
    header.creation_date = flown
    header.add_crs(crs)
    las = laspy.LasData(header)
    las.xyz = scan.point
    las.classification = scan.category.astype(np.uint8)
    las.intensity = scan.intensity.astype(np.uint16)
    las.return_number = scan.return_number.astype(np.uint8)
    las.number_of_returns = scan.number_of_returns.astype(np.uint8)
    las.point_source_id = scan.strip.astype(np.uint16)
    with atomic_write(path) as part:
        las.write(part)
