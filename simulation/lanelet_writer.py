"""Writer of Lanelet2 maps of simulated road networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pyproj import CRS

from gis_radar.base import Floats, atomic_write, transformer
from simulation.network import Lane, RoadNetwork, Turn
from simulation.terrain import Terrain

_SAME_NODE_M = 0.02  # points nearer to each other are one node
_REVERSED_EVERY = 5  # of kerbs and solid lines so many have one drawn backwards, as in real maps
_LAMP_OVER_M = 3.2  # height of lamps over the ground
_ROAD = {
    "type": "lanelet",
    "subtype": "road",
    "location": "urban",
    "one_way": "yes",
    "participant:vehicle": "yes",
}
_WALK = {
    "type": "lanelet",
    "subtype": "crosswalk",
    "location": "urban",
    "one_way": "no",
    "participant:pedestrian": "yes",
    "speed_limit": "6",
}
# Tags by kind of line. Where two lanelets share a line, the kind that is first here holds.
_LINES = {
    "stop": {"type": "stop_line"},
    "lamp": {"type": "traffic_light", "subtype": "red_yellow_green"},
    "zebra": {"type": "pedestrian_marking"},
    "dashed": {"type": "line_thin", "subtype": "dashed"},
    "solid": {"type": "line_thin", "subtype": "solid"},
    "kerb": {"type": "curbstone", "subtype": "high"},
    "virtual": {"type": "virtual"},
}
_RANK = list(_LINES)


@dataclass(frozen=True, kw_only=True)
class Crosswalk:
    """A way for pedestrians across a road.

    Parameters
    ----------
    left, right : Floats
        Its bounds in the map, ``(n, 2)``, metres.
    """

    left: Floats
    right: Floats


@dataclass(frozen=True, kw_only=True)
class _Relation:
    """A lanelet or a regulatory element: members as (type, role, id), and tags."""

    members: list[tuple[str, str, int]]
    tags: dict[str, str]


@dataclass(kw_only=True)
class _Drawing:
    """A map that is being drawn; equal nodes and ways are used again."""

    terrain: Terrain
    nodes: dict[int, Floats] = field(default_factory=dict)
    ways: dict[int, tuple[int, ...]] = field(default_factory=dict)
    lines: dict[int, str] = field(default_factory=dict)
    relations: dict[int, _Relation] = field(default_factory=dict)
    _cells: dict[tuple[int, int], int] = field(default_factory=dict)
    _known: dict[tuple[int, ...], int] = field(default_factory=dict)
    _last: int = 0

    def new_id(self) -> int:
        """Return the next free id."""
        self._last += 1
        return self._last

    def node(self, place: Floats) -> int:
        """Return the id of the node at a place on the ground."""
        column, row = (int(v) for v in np.floor(place / _SAME_NODE_M))
        for cell in ((column + i, row + j) for i in (0, -1, 1) for j in (0, -1, 1)):
            known = self._cells.get(cell)
            if known and np.hypot(*(self.nodes[known][:2] - place)) < _SAME_NODE_M:
                return known
        made = self.add_node(place, 0.0)
        self._cells[column, row] = made
        return made

    def add_node(self, place: Floats, over_m: float) -> int:
        """Return the id of a new node over the ground."""
        made = self.new_id()
        self.nodes[made] = np.array([*place, float(self.terrain.height(place)) + over_m])
        return made

    def way(self, points: Floats, line: str) -> int:
        """Return the id of the way along a line, in either direction."""
        return self.add_way(tuple(dict.fromkeys(self.node(p) for p in points)), line)

    def add_way(self, key: tuple[int, ...], line: str) -> int:
        """Return the id of the way through these nodes, which is added where it is missing."""
        made = self._known.get(key) or self._known.get(key[::-1])
        if made is None:
            made = self.new_id()
            reversed_way = line in {"kerb", "solid"} and made % _REVERSED_EVERY == 0
            self.ways[made] = key[::-1] if reversed_way else key
            self._known[key] = made
            self.lines[made] = line
        self.lines[made] = min(self.lines[made], line, key=_RANK.index)
        return made

    def relation(self, members: list[tuple[str, str, int]], tags: dict[str, str]) -> int:
        """Return the id of a new relation."""
        made = self.new_id()
        self.relations[made] = _Relation(members=members, tags=tags)
        return made


def write_lanelets(
    network: RoadNetwork,
    path: Path,
    *,
    terrain: Terrain,
    crs: CRS,
    crosswalks: tuple[Crosswalk, ...] = (),
    streets: Mapping[str, str] | None = None,
) -> None:
    """Write a network as a Lanelet2 map in WGS84.

    Every lane and every turn becomes a lanelet; neighbours share a bound, followers share end
    nodes. Approaches to a traffic light get a stop line and a regulatory element.

    Parameters
    ----------
    network : RoadNetwork
        Lanes and turns in the map frame.
    path : Path
        The ``.osm`` file.
    terrain : Terrain
        Gives ``ele``.
    crs : CRS
        The map frame.
    crosswalks : tuple of Crosswalk
        Drawn as lanelets for pedestrians.
    streets : mapping, optional
        Names of streets by edge.
    """
    names = streets or {}
    drawing = _Drawing(terrain=terrain)
    lights = _draw_lights(network, drawing)
    for lane in network.lanes.values():
        lines = _lane_lines(lane, network)
        street = {"street_name": names[lane.edge]} if lane.edge in names else {}
        _draw_lanelet(lane, lines, drawing, lights.get(lane.edge), street)
    for turn in network.turns.values():
        _draw_lanelet(turn, _turn_lines(turn, network), drawing, None, {})
    for walk in crosswalks:
        sides = (("left", walk.left), ("right", walk.right))
        drawing.relation([("way", s, drawing.way(p, "zebra")) for s, p in sides], _WALK)
    with atomic_write(path) as part:
        part.write_text(_xml(drawing, crs), encoding="utf-8")


def _draw_lights(network: RoadNetwork, drawing: _Drawing) -> dict[str, int]:
    """Draw stop lines and lamps; return the regulatory element of each edge that has a light."""
    lights = {}
    approaches = {network.lanes[t.source].edge for t in network.turns.values() if t.signal}
    for edge in sorted(approaches):
        lanes = sorted(_lanes_of(edge, network), key=lambda lane: lane.index)
        right, left = lanes[0].right[-1], lanes[-1].left[-1]
        stop = drawing.way(np.array([right, left]), "stop")
        out = (right - left) / np.hypot(*(right - left))
        ends = tuple(drawing.add_node(right + shift * out, _LAMP_OVER_M) for shift in (0.6, 1.0))
        lamp = drawing.add_way(ends, "lamp")
        lights[edge] = drawing.relation(
            [("way", "refers", lamp), ("way", "ref_line", stop)],
            {"type": "regulatory_element", "subtype": "traffic_light"},
        )
    return lights


def _lanes_of(edge: str, network: RoadNetwork) -> list[Lane]:
    return [lane for lane in network.lanes.values() if lane.edge == edge]


def _lane_lines(lane: Lane, network: RoadNetwork) -> tuple[str, str]:
    """Return the kinds of the left and the right bound of a lane."""
    outermost_left = lane.index == max(other.index for other in _lanes_of(lane.edge, network))
    return "solid" if outermost_left else "dashed", "kerb" if lane.index == 0 else "dashed"


def _turn_lines(turn: Turn, network: RoadNetwork) -> tuple[str, str]:
    """Return the kinds of a turn's bounds: virtual, or those of the lanes where these agree."""
    if turn.signal or turn.direction != "s":
        return "virtual", "virtual"
    before, after = (_lane_lines(network.lanes[k], network) for k in (turn.source, turn.target))
    left, right = (a if a == b else "virtual" for a, b in zip(before, after, strict=True))
    return left, right


def _draw_lanelet(
    band: Lane | Turn,
    lines: tuple[str, str],
    drawing: _Drawing,
    light: int | None,
    street: Mapping[str, str],
) -> None:
    left, right = drawing.way(band.left, lines[0]), drawing.way(band.right, lines[1])
    members = [("way", "left", left), ("way", "right", right)]
    if light is not None:
        members.append(("relation", "regulatory_element", light))
    limit = str(round(band.speed_limit * 3.6))
    drawing.relation(members, _ROAD | {"speed_limit": limit, **street})


def _xml(drawing: _Drawing, crs: CRS) -> str:
    """Return the drawing as OSM XML."""
    places = np.array(list(drawing.nodes.values()))
    lon, lat = transformer(crs, CRS.from_epsg(4326)).transform(places[:, 0], places[:, 1])
    rows = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="gis_radar">']
    for k, node in enumerate(drawing.nodes):
        rows.append(
            f'<node id="{node}" version="1" visible="true" lat="{lat[k]:.11f}" '
            f'lon="{lon[k]:.11f}"><tag k="ele" v="{places[k, 2]:.3f}"/></node>'
        )
    for way, nodes in drawing.ways.items():
        refs = "".join(f'<nd ref="{node}"/>' for node in nodes)
        tags = _tags(_LINES[drawing.lines[way]])
        rows.append(f'<way id="{way}" version="1" visible="true">{refs}{tags}</way>')
    for name, relation in drawing.relations.items():
        members = "".join(
            f'<member type="{kind}" ref="{ref}" role="{role}"/>'
            for kind, role, ref in relation.members
        )
        tags = _tags(relation.tags)
        rows.append(f'<relation id="{name}" version="1" visible="true">{members}{tags}</relation>')
    return "\n".join([*rows, "</osm>", ""])


def _tags(tags: dict[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
