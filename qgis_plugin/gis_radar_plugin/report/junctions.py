"""Find junctions where the lanes of a heat map cross: a report needs no layer of places."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

from qgis.core import (
    QgsFeatureRequest,
    QgsGeometry,
    QgsPointXY,
    QgsRectangle,
    QgsSpatialIndex,
    QgsVectorLayer,
)

NEAR_M = 1.5  # between the middles of overlapping tiles
LEAST_TURN_DEG = 25.0  # lanes that merge, or run side by side, do not cross
FLOOR_M = 3.0  # a bridge crosses nothing
APART_M = 25.0  # crossings nearer to each other than this are one junction


@dataclass(frozen=True)
class Tile:
    """A tile as a point on its lane.

    Parameters
    ----------
    lanelet : int
        Whose.
    x, y : float
        Its middle, metres.
    height : float or None
        Of the road there, metres.
    heading : float
        Of the lane, degrees, either way along it.
    """

    lanelet: int
    x: float
    y: float
    height: float | None
    heading: float


def junctions_of(layer: QgsVectorLayer) -> list[QgsRectangle]:
    """Return the boxes of the junctions, from north to south.

    Parameters
    ----------
    layer : QgsVectorLayer
        The tiles of a heat map; what no radar observed does not count.
    """
    crossings = list(_crossings(list(_tiles(layer))))
    near = QgsGeometry.fromMultiPointXY(crossings).buffer(APART_M / 2, 5)
    parts = near.asGeometryCollection() if crossings else []
    boxes = [part.boundingBox().buffered(-APART_M / 2) for part in parts]
    return sorted(boxes, key=lambda box: (-box.center().y(), box.center().x()))


def _tiles(layer: QgsVectorLayer) -> Iterator[Tile]:
    """Yield the observed tiles of each lanelet along it; their headings are to the next one."""
    request = QgsFeatureRequest().setFilterExpression('"observed_s" > 0')
    columns = [layer.fields().lookupField(name) for name in ("lanelet_id", "index", "height_m")]
    if min(columns) < 0:
        return
    request.setSubsetOfAttributes(columns)
    lanes: dict[int, list[tuple[int, float, float, float | None]]] = defaultdict(list)
    for row in layer.getFeatures(request):
        middle = row.geometry().boundingBox().center()
        height = row["height_m"] if isinstance(row["height_m"], float) else None
        lanes[row["lanelet_id"]].append((row["index"], middle.x(), middle.y(), height))
    for lanelet, points in lanes.items():
        points.sort()
        for here, there in zip(points, points[1:]):
            heading = math.degrees(math.atan2(there[2] - here[2], there[1] - here[1]))
            yield Tile(lanelet, here[1], here[2], here[3], heading)


def _crossings(tiles: list[Tile]) -> Iterator[QgsPointXY]:
    """Yield the middles of tiles that another lane's tile crosses."""
    index = QgsSpatialIndex()
    for number, tile in enumerate(tiles):
        here = QgsPointXY(tile.x, tile.y)
        near = index.intersects(QgsRectangle.fromCenterAndSize(here, 2 * NEAR_M, 2 * NEAR_M))
        if any(_cross(tile, tiles[other]) for other in near):
            yield here
        index.addFeature(number, QgsRectangle(here, here))


def _cross(one: Tile, other: Tile) -> bool:
    if one.lanelet == other.lanelet or math.hypot(one.x - other.x, one.y - other.y) > NEAR_M:
        return False
    if _apart_m(one.height, other.height) > FLOOR_M:
        return False
    turn = abs(one.heading - other.heading) % 180.0
    return LEAST_TURN_DEG <= turn <= 180.0 - LEAST_TURN_DEG


def _apart_m(one: float | None, other: float | None) -> float:
    """Return how far heights are apart; heights that are not known are taken for the same."""
    return 0.0 if one is None or other is None else abs(one - other)
