"""Scenes: objects beside the road as simple shapes in the map frame (metres)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import shapely

from gis_radar.base import Floats
from simulation.network import RoadNetwork
from simulation.terrain import Terrain


@dataclass(frozen=True, kw_only=True)
class Building:
    """A building with upright walls and a flat roof.

    Parameters
    ----------
    outline : Floats
        Corners, ``(n, 2)``, the last not repeated.
    height_m : float
        Height of the roof over the ground at the first corner.
    """

    outline: Floats
    height_m: float


@dataclass(frozen=True, kw_only=True)
class Tree:
    """A tree: a spherical crown on a trunk.

    Parameters
    ----------
    place : tuple of float
        Easting and northing of the trunk.
    crown_m : float
        Radius of the crown.
    crown_height_m : float
        Height of the crown's middle over the ground.
    trunk_m : float
        Radius of the trunk.
    """

    place: tuple[float, float]
    crown_m: float
    crown_height_m: float
    trunk_m: float = 0.2


@dataclass(frozen=True, kw_only=True)
class ParkedCar:
    """A parked car, which never moves.

    Parameters
    ----------
    place : tuple of float
        Easting and northing of its middle.
    heading_rad : float
        Counter-clockwise from grid east.
    size : tuple of float
        Length, width and height.
    """

    place: tuple[float, float]
    heading_rad: float
    size: tuple[float, float, float] = (4.5, 1.8, 1.5)


@dataclass(frozen=True, kw_only=True)
class Post:
    """A sign, lamp or signal post.

    Parameters
    ----------
    place : tuple of float
        Easting and northing.
    height_m : float
        Over the ground.
    """

    place: tuple[float, float]
    height_m: float


@dataclass(frozen=True, kw_only=True)
class Rail:
    """A guard rail or a metal fence.

    Parameters
    ----------
    line : Floats
        Its line, ``(n, 2)``.
    height_m : float
        Height of the metal over the ground.
    """

    line: Floats
    height_m: float = 0.6


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Ground, roads and all fixed objects.

    Parameters
    ----------
    terrain : Terrain
        Height of the road surface.
    road : Polygon or MultiPolygon
        Area of the road; beside it the ground is higher by the kerb.
    kerb_m : float
        Height of the kerb.
    buildings, trees, cars, posts, rails : tuples
        Fixed objects.
    """

    terrain: Terrain
    road: shapely.Polygon | shapely.MultiPolygon = field(repr=False)
    kerb_m: float = 0.12
    buildings: tuple[Building, ...] = field(default=(), repr=False)
    trees: tuple[Tree, ...] = field(default=(), repr=False)
    cars: tuple[ParkedCar, ...] = field(default=(), repr=False)
    posts: tuple[Post, ...] = field(default=(), repr=False)
    rails: tuple[Rail, ...] = field(default=(), repr=False)

    def near(self, place: Floats, reach_m: float) -> Scene:
        """Return the scene with only the objects within `reach_m` of a place."""

        def close(points: Floats) -> bool:
            return bool((np.hypot(*(np.atleast_2d(points) - place[:2]).T) < reach_m).any())

        return replace(
            self,
            buildings=tuple(b for b in self.buildings if close(b.outline)),
            trees=tuple(t for t in self.trees if close(np.array(t.place))),
            cars=tuple(c for c in self.cars if close(np.array(c.place))),
            posts=tuple(p for p in self.posts if close(np.array(p.place))),
            rails=tuple(r for r in self.rails if close(r.line)),
        )

    def ground(self, points: Floats) -> Floats:
        """Return the height of the ground at ``(n, 2)`` points, kerbs included."""
        shapely.prepare(self.road)
        on_road = shapely.contains_xy(self.road, points[:, 0], points[:, 1])
        return np.asarray(self.terrain.height(points) + np.where(on_road, 0.0, self.kerb_m))


def road_surface(network: RoadNetwork) -> shapely.Polygon | shapely.MultiPolygon:
    """Return the area of all lanes and turns, with the slits between them closed."""
    areas = [
        shapely.Polygon(np.vstack([band.left, band.right[::-1]])).buffer(0.05)
        for band in network.bands.values()
    ]
    surface = shapely.union_all(areas).buffer(0.25, join_style="mitre")
    whole = surface.buffer(-0.3, join_style="mitre")
    if not isinstance(whole, shapely.Polygon | shapely.MultiPolygon):
        raise TypeError(f"the road surface is a {whole.geom_type}, expected polygons")
    return whole
