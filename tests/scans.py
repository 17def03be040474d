"""Small airborne scans that tests write: a road, and what stands on, over and beside it."""

from __future__ import annotations

import laspy
import numpy as np
import shapely
from pyproj import CRS

from gis_radar.scans import Roads
from gis_radar.scans.roads import RoadLevel

UTM = CRS.from_epsg(25832)
EAST, NORTH = 678_000.0, 5_403_600.0
NOISE_M = 0.03


def strewn(box, density, rng):
    """Points of a box (west, south, east, north) in metres from (EAST, NORTH)."""
    west, south, east, north = box
    count = int((east - west) * (north - south) * density)
    return np.column_stack([rng.uniform(west, east, count), rng.uniform(south, north, count)])


def level(x, y):
    return np.full(np.shape(x), 100.0)


def ground(box, height, *, density=10.0, seed=0):
    """Points on a surface, with noise; `height` takes x and y."""
    rng = np.random.default_rng(seed)
    xy = strewn(box, density, rng)
    z = height(xy[:, 0], xy[:, 1]) + rng.normal(0.0, NOISE_M, len(xy))
    return np.column_stack([xy, z])


def hidden(points, box, top):
    """Let points in a box end higher up: on a car, a roof, a deck; `top` takes x and y."""
    x, y = points[:, 0], points[:, 1]
    west, south, east, north = box
    inside = (x > west) & (x < east) & (y > south) & (y < north)
    lifted = points.copy()
    lifted[inside, 2] = top(x[inside], y[inside])
    return lifted


def write_points(path, points, *, category=1, crs=UTM, version="1.4", point_format=6, **more):
    """Write points given in metres from (EAST, NORTH)."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.array([EAST, NORTH, 0.0])
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    for name in more.pop("extra", ()):
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=np.float32))
    las = laspy.LasData(header)
    las.xyz = points + [EAST, NORTH, 0.0]
    las.classification = np.broadcast_to(np.asarray(category, np.uint8), len(points))
    las.return_number = np.ones(len(points), np.uint8)
    las.number_of_returns = np.ones(len(points), np.uint8)
    for name, value in more.items():
        las[name] = value
    las.write(path)
    return path


def box_roads(*boxes, heights=None, crs=UTM):
    """Roads over boxes in metres from (EAST, NORTH); each box a level where heights are given."""
    shapes = [shapely.transform(shapely.box(*box), lambda xy: xy + [EAST, NORTH]) for box in boxes]
    area = shapely.union_all(shapes)
    if heights is None:
        levels = (RoadLevel(shapes=np.array(shapes)),)
    else:
        levels = tuple(
            RoadLevel(shapes=np.array([shape]), heights=sampled(box, height))
            for shape, box, height in zip(shapes, boxes, heights, strict=True)
        )
    parts = shapely.get_parts(area)
    return Roads(crs=crs, area=shapely.MultiPolygon(list(parts)), levels=levels, source="boxes")


def sampled(box, height):
    x, y = (side.ravel() for side in np.meshgrid(np.arange(box[0], box[2] + 1),
                                                 np.arange(box[1], box[3] + 1)))  # fmt: skip
    return np.column_stack([x + EAST, y + NORTH, height(x, y)])
