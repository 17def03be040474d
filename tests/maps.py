"""Tiny Lanelet2 maps that tests write themselves, and the shared real ones."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest
import shapely
from pyproj import CRS, Transformer

from gis_radar.base import InputError, Reporter
from gis_radar.hdmap import read_map

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SHARED_MAPS = tuple(sorted([*SHARED.glob("maps/*.osm"), *SHARED.glob("town0*/map.osm")]))
UTM = CRS.from_epsg(25832)
EAST, NORTH = 678_000.0, 5_403_600.0
_TO_DEGREES = Transformer.from_crs(UTM, CRS.from_epsg(4326), always_xy=True)

LEFT = [(0.0, 3.0), (20.0, 3.0)]
RIGHT = [(0.0, 0.0), (20.0, 0.0)]

needs_shared_maps = pytest.mark.skipif(not SHARED_MAPS, reason="shared data absent: maps")


class Listener(Reporter):
    """Keeps what it is told."""

    def __init__(self):
        self.stages, self.messages = [], []

    def progress(self, stage, done, total):
        self.stages.append((stage, done, total))

    def log(self, message, level="info"):
        self.messages.append((level, message))

    @property
    def lines(self):
        return [message for _, message in self.messages]

    @property
    def text(self):
        return "\n".join(f"{level}: {message}" for level, message in self.messages)


def one(path, **options):
    """Read the first lanelet of a map."""
    return read_map(path, **options).lanelets.iloc[0]


def refused(path, error=InputError, **options):
    """Read a map that must be refused in one line, and return the error."""
    with pytest.raises(error) as caught:
        read_map(path, **options)
    assert "\n" not in caught.value.message
    return caught.value


def metres(line):
    """Coordinates of a line, in metres from (EAST, NORTH)."""
    return shapely.get_coordinates(line) - (EAST, NORTH)


def map_name(path):
    """Name a shared map for the test report."""
    return path.parent.name if path.stem == "map" else path.stem


def degrees(x, y):
    """Longitude and latitude of metres east and north of (EAST, NORTH) in UTM 32N."""
    return _TO_DEGREES.transform(EAST + x, NORTH + y)


def write_osm(path, nodes, ways, lanelets, regulatory=None, *, local=False, extra=""):
    """Write a map.

    nodes: id -> (x, y) or (x, y, height) in metres from (EAST, NORTH), or a dict of raw
    attributes, among them `tags`. ways: id -> node ids, or (node ids, tags). lanelets: id ->
    (left, right) or (left, right, tags); a bound is a way id or a list of them. regulatory:
    id -> (tags, [(kind, ref, role), ...]). With `local`, metres go into local_x and local_y and
    lat and lon stay empty.
    """
    parts = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6">']
    parts += [_node(ref, node, local=local) for ref, node in nodes.items()]
    for ref, way in ways.items():
        refs, tags = way if isinstance(way, tuple) else (way, {})
        inner = "".join(f'<nd ref="{node}"/>' for node in refs)
        parts.append(f'<way id="{ref}">{inner}{_tags(tags)}</way>')
    for ref, lanelet in lanelets.items():
        left, right, *rest = lanelet
        members = [("way", way, "left") for way in _listed(left)]
        members += [("way", way, "right") for way in _listed(right)]
        tags = dict(rest[0]) if rest else {"subtype": "road", "location": "urban"}
        members += [("relation", rule, "regulatory_element") for rule in tags.pop("rules", [])]
        parts.append(_relation(ref, members, {"type": "lanelet", **tags}))
    for ref, (tags, members) in (regulatory or {}).items():
        parts.append(_relation(ref, members, {"type": "regulatory_element", **tags}))
    Path(path).write_text("\n".join([*parts, extra, "</osm>"]), encoding="utf-8")
    return path


def write_lanelet(path, left, right, tags=None, **options):
    """Write a map of one lanelet, id 1000, from the points of its bounds as drawn."""
    points = [*left, *right]
    nodes = dict(enumerate(points, start=1))
    ways = {501: list(range(1, len(left) + 1)), 502: list(range(len(left) + 1, len(points) + 1))}
    lanelet = (501, 502) if tags is None else (501, 502, tags)
    return write_osm(path, nodes, ways, {1000: lanelet}, **options)


def write_road(path, tags=None, *, pieces=2, rules=None, **options):
    """Write a straight road of pieces of 10 m and 3 m width, ids 1000, 1001, ..."""
    nodes = {}
    for i in range(pieces + 1):
        nodes[10 + i], nodes[110 + i] = (10.0 * i, 3.0), (10.0 * i, 0.0)
    ways, lanelets = {}, {}
    for i in range(pieces):
        ways[500 + i], ways[600 + i] = [10 + i, 11 + i], [110 + i, 111 + i]
        lanelets[1000 + i] = (500 + i, 600 + i) if tags is None else (500 + i, 600 + i, tags)
    return write_osm(path, nodes, ways, lanelets, rules, **options)


def _listed(ways):
    return ways if isinstance(ways, (list, tuple)) else [ways]


def _node(ref, node, *, local):
    if isinstance(node, dict):
        raw = dict(node)
        tags = raw.pop("tags", {})
    else:
        x, y, *height = node
        lon, lat = degrees(x, y)
        raw = {"lat": "", "lon": ""} if local else {"lat": f"{lat:.12f}", "lon": f"{lon:.12f}"}
        tags = {"local_x": x, "local_y": y} if local else {}
        tags |= {"ele": height[0]} if height else {}
    attributes = "".join(f" {name}={quoteattr(str(value))}" for name, value in raw.items())
    return f'<node id="{ref}"{attributes}>{_tags(tags)}</node>'


def _tags(tags):
    pairs = ((quoteattr(str(key)), quoteattr(str(value))) for key, value in tags.items())
    return "".join(f"<tag k={key} v={value}/>" for key, value in pairs)


def _relation(ref, members, tags):
    inner = "".join(f'<member type="{k}" ref="{r}" role="{role}"/>' for k, r, role in members)
    return f'<relation id="{ref}">{inner}{_tags(tags)}</relation>'
