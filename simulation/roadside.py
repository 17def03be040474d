"""Roadsides: trees, houses, parked cars and posts set along the roads of any network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely

from gis_radar.base import Floats
from simulation.network import RoadNetwork
from simulation.scene import Building, ParkedCar, Post, Rail, Scene, Tree, road_surface
from simulation.terrain import Terrain

_BLOCK_M2 = 1500.0  # areas enclosed by roads that are larger are lined inside: no traffic islands


@dataclass(frozen=True, kw_only=True)
class Roadside:
    """Distances of trees, houses, parked cars and posts along roads.

    Parameters
    ----------
    tree_gap_m, tree_setback_m : float
        Distance between trees, and from the kerb to the trunks.
    house_gap_m, house_setback_m : float
        Distance between middles of houses, and from the kerb to their fronts.
    car_gap_m, car_share : float
        Distance between parking places, and share of these with a car.
    no_parking_m : float
        Least distance of parked cars from where a turn begins or ends.
    post_gap_m : float
        Distance between lamps and signs.
    open_end_m : float
        Least distance of all from the ends of the network.
    """

    tree_gap_m: float = 13.0
    tree_setback_m: float = 2.0
    house_gap_m: float = 31.0
    house_setback_m: float = 12.0
    car_gap_m: float = 6.2
    car_share: float = 0.18
    no_parking_m: float = 18.0
    post_gap_m: float = 27.0
    open_end_m: float = 14.0


def furnish(
    network: RoadNetwork,
    terrain: Terrain,
    *,
    rng: np.random.Generator,
    roadside: Roadside | None = None,
    rails: tuple[Rail, ...] = (),
) -> Scene:
    """Return a scene with trees, houses, parked cars and posts along every kerb.

    Parameters
    ----------
    network : RoadNetwork
        The roads.
    terrain : Terrain
        Height of the ground.
    rng : Generator
        Random numbers.
    roadside : Roadside, optional
        Distances along the roads.
    rails : tuple of Rail
        Guard rails, which are not drawn at random.
    """
    plan = roadside or Roadside()
    road = road_surface(network)
    ends = _ends(network).buffer(plan.open_end_m)
    shapely.prepare(ends)
    crossing = [shapely.Point(turn.centre[k]) for turn in network.turns.values() for k in (0, -1)]
    places = _Places(road=road, ends=ends, rng=rng)
    no_parking = shapely.MultiPoint(crossing).buffer(plan.no_parking_m)
    return Scene(
        terrain=terrain,
        road=road,
        buildings=_houses(places, plan),
        trees=_trees(places, plan),
        cars=_cars(places, plan, no_parking),
        posts=tuple(
            Post(place=(float(p[0]), float(p[1])), height_m=float(rng.choice([2.6, 3.4, 7.0])))
            for p, _ in places.along(0.8, plan.post_gap_m)
        ),
        rails=rails,
    )


def roadside_stand(
    scene: Scene,
    middle: tuple[float, float],
    rng: np.random.Generator,
    *,
    within_m: tuple[float, float],
    turns_rad: tuple[float, float] = (0.0, 2.0 * np.pi),
) -> Floats:
    """Draw a place for a mast: beside a kerb, in no house, at a distance from a middle.

    Parameters
    ----------
    scene : Scene
        The surroundings.
    middle : (float, float)
        Easting and northing.
    rng : Generator
        Random numbers.
    within_m : tuple of float
        Least and greatest distance from the middle.
    turns_rad : tuple of float
        Least and greatest direction from the middle, counter-clockwise from grid east.
    """
    houses = [shapely.Polygon(b.outline).buffer(1.0) for b in scene.buildings]
    taken = shapely.union_all([*houses, scene.road.buffer(1.5)])
    near = scene.road.buffer(7.0).difference(taken)
    shapely.prepare(near)
    while True:
        reach, turn = rng.uniform(*within_m), rng.uniform(*turns_rad)
        place = middle + reach * np.array([np.cos(turn), np.sin(turn)])
        if shapely.contains_xy(near, *place):
            return np.asarray(place)


@dataclass(frozen=True, kw_only=True)
class _Places:
    """Places beside the road, away from its open ends."""

    road: shapely.Polygon | shapely.MultiPolygon
    ends: shapely.Geometry
    rng: np.random.Generator

    def along(self, setback_m: float, gap_m: float) -> Iterator[tuple[Floats, float]]:
        """Draw points about every `gap_m` at a distance from the kerb; yield also the heading."""
        outer = self.road.buffer(setback_m)
        parts = getattr(outer, "geoms", [outer])
        inner = [r for part in parts for r in part.interiors if shapely.Polygon(r).area > _BLOCK_M2]
        for ring in [*(part.exterior for part in parts), *inner]:
            count = max(1, int(ring.length / gap_m))
            jitter = self.rng.uniform(-0.3, 0.3, count)
            for s in (np.arange(count) + 0.5 + jitter) * gap_m:
                point, ahead = (np.array(ring.interpolate(d).coords[0]) for d in (s, s + 0.5))
                if not shapely.contains_xy(self.ends, *point):
                    yield point, float(np.arctan2(*(ahead - point)[::-1]))


def _ends(network: RoadNetwork) -> shapely.MultiPoint:
    """Return the points where roads begin and end at the rim of the network."""
    sources, sinks = network.sources(), network.sinks()
    lanes = network.lanes.values()
    points = [lane.centre[0] for lane in lanes if lane.edge in sources]
    points += [lane.centre[-1] for lane in lanes if lane.edge in sinks]
    return shapely.MultiPoint(np.array(points).reshape(-1, 2))


def _trees(places: _Places, plan: Roadside) -> tuple[Tree, ...]:
    rng = places.rng
    trees = []
    for point, _ in places.along(plan.tree_setback_m, plan.tree_gap_m):
        crown = float(rng.uniform(2.2, 3.6))
        over = float(rng.uniform(2.6, 3.6))
        trees.append(
            Tree(
                place=(float(point[0]), float(point[1])),
                crown_m=crown,
                crown_height_m=over + crown,
                trunk_m=float(rng.uniform(0.12, 0.3)),
            )
        )
    return tuple(trees)


def _houses(places: _Places, plan: Roadside) -> tuple[Building, ...]:
    rng = places.rng
    clear = places.road.buffer(plan.house_setback_m * 0.7)
    houses: list[Building] = []
    taken: shapely.Geometry = shapely.Polygon()
    for point, heading in places.along(plan.house_setback_m + 5.0, plan.house_gap_m):
        half = np.array([rng.uniform(7.0, 12.0), rng.uniform(4.5, 6.0)])
        ahead = np.array([np.cos(heading), np.sin(heading)])
        aside = np.array([-ahead[1], ahead[0]])
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
        outline = point + signs[:, :1] * ahead + signs[:, 1:] * aside
        height = float(rng.uniform(5.5, 13.0))
        shape = shapely.Polygon(outline)
        if shape.intersects(clear) or shape.buffer(2.0).intersects(taken):
            continue
        taken = shapely.union(taken, shape)
        houses.append(Building(outline=outline, height_m=height))
    return tuple(houses)


def _cars(places: _Places, plan: Roadside, no_parking: shapely.Geometry) -> tuple[ParkedCar, ...]:
    rng = places.rng
    sizes = ((3.8, 1.7, 1.5), (4.5, 1.82, 1.47), (4.7, 1.9, 1.7), (5.9, 2.05, 2.6))
    cars = []
    for point, heading in places.along(1.3, plan.car_gap_m):
        if rng.random() < plan.car_share and not shapely.contains_xy(no_parking, *point):
            size = sizes[int(rng.integers(len(sizes)))]
            turned = heading + float(rng.normal(0.0, 0.02))
            place = (float(point[0]), float(point[1]))
            cars.append(ParkedCar(place=place, heading_rad=turned, size=size))
    return tuple(cars)
