"""Lanelet2 maps as in some data sets: wide lanelets that overlap and share no nodes."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import shapely
from pyproj import CRS

import gis_radar as gr
from gis_radar.base import Floats, transformer

WIDER_M = 0.6  # to each side
ROAD = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}


def widen(path: Path) -> None:
    """Write a Lanelet2 map again, each lanelet with own bounds, 0.6 m farther out."""
    roads = gr.read_map(path)
    to_degrees = transformer(roads.crs, CRS.from_epsg(4326))
    root = ET.Element("osm", version="0.6")
    ways, relations, last = [], [], 10**6
    table = roads.lanelets
    for number, left, right in zip(table["lanelet_id"], table["left"], table["right"], strict=True):
        relation = _element("relation", int(number))
        for role, line in zip(("left", "right"), _widened(left, right), strict=True):
            way = _element("way", last := last + 1)
            for east, north, height in line:
                lon, lat = to_degrees.transform(east, north)
                node = _element("node", last := last + 1, lat=f"{lat:.11f}", lon=f"{lon:.11f}")
                ET.SubElement(node, "tag", k="ele", v=f"{height:.3f}")
                root.append(node)
                ET.SubElement(way, "nd", ref=node.get("id", ""))
            ET.SubElement(relation, "member", type="way", ref=way.get("id", ""), role=role)
            ways.append(way)
        for key, value in ROAD.items():
            ET.SubElement(relation, "tag", k=key, v=value)
        relations.append(relation)
    root.extend([*ways, *relations])
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _element(kind: str, number: int, **more: str) -> ET.Element:
    return ET.Element(kind, {"id": str(number), "version": "1", "visible": "true", **more})


def _widened(left: shapely.LineString, right: shapely.LineString) -> tuple[Floats, Floats]:
    """Return the points of both bounds, each moved away from the other."""
    lines = [shapely.get_coordinates(line, include_z=True) for line in (left, right)]
    made = []
    for line, other in ((lines[0], right), (lines[1], left)):
        points = shapely.points(line[:, :2])
        across = shapely.get_coordinates(shapely.shortest_line(points, other)).reshape(-1, 2, 2)
        away = across[:, 0] - across[:, 1]
        away /= np.maximum(np.hypot(*away.T), 1e-6)[:, None]
        made.append(np.column_stack([line[:, :2] + WIDER_M * away, line[:, 2]]))
    return made[0], made[1]
