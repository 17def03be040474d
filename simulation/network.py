"""Road networks: lanes of a SUMO network, and smooth turns between them.

SUMO draws the lanes inside a junction as coarse polylines. Here each becomes a smooth curve between
the lanes it joins, on which vehicles are placed, too.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gis_radar.base import Floats
from simulation import sumo
from simulation.curves import arc_length, offset, points_at, tangents, turn

_LANE_SPACING_M, _TURN_SPACING_M = 4.0, 1.0  # of vertices
_SUMO_WIDTH_M = 3.2  # SUMO's default width of lanes
_SAME_BOUND_M = 0.3  # bounds of neighbours that are nearer become one
SIDES = ("centre", "left", "right")


@dataclass(frozen=True, kw_only=True)
class Band:
    """A lane, or a turn that joins two lanes: three polylines in the map frame (metres).

    Parameters
    ----------
    id : str
        SUMO's lane id; of a turn: the id of its first internal lane.
    centre : Floats
        Centre line, ``(n, 2)``.
    left : Floats
        Left bound, ``(n, 2)``.
    right : Floats
        Right bound, ``(n, 2)``.
    speed_limit : float
        Speed limit in m/s.
    """

    id: str
    centre: Floats
    left: Floats
    right: Floats
    speed_limit: float


@dataclass(frozen=True, kw_only=True)
class Lane(Band):
    """A lane outside the junctions.

    Parameters
    ----------
    edge : str
        Id of the edge (the lanes of one direction between two nodes).
    index : int
        0 is the rightmost lane of the edge.
    """

    edge: str
    index: int


@dataclass(frozen=True, kw_only=True)
class Turn(Band):
    """A way through a junction, from the end of one lane to the start of another.

    Parameters
    ----------
    source : str
        Id of the lane it leaves.
    target : str
        Id of the lane it enters.
    signal : str
        Id of the traffic light, empty where there is none.
    direction : str
        SUMO's word for it: ``s`` straight, ``l`` left, ``r`` right, ``t`` back.
    """

    source: str
    target: str
    signal: str
    direction: str


@dataclass(frozen=True, kw_only=True)
class RoadNetwork:
    """Lanes and turns, and SUMO's lane positions on them.

    Parameters
    ----------
    lanes : dict[str, Lane]
        Lanes by id.
    turns : dict[str, Turn]
        Turns by id.
    spans : dict[str, tuple[str, float, float]]
        Of every SUMO lane: the band it is part of, and the shares of it where it begins and ends.
    lengths : dict[str, float]
        SUMO's own lane lengths in metres.
    """

    lanes: dict[str, Lane]
    turns: dict[str, Turn]
    spans: dict[str, tuple[str, float, float]] = field(repr=False)
    lengths: dict[str, float] = field(repr=False)

    @property
    def bands(self) -> dict[str, Band]:
        """Lanes and turns by id."""
        return {**self.lanes, **self.turns}

    def locate(self, lane: str, position_m: Floats) -> tuple[Floats, Floats]:
        """Return points and unit tangents on the centre line at SUMO's positions on a lane."""
        band_id, begin, end = self.spans[lane]
        centre = self.bands[band_id].centre
        share = begin + (end - begin) * np.asarray(position_m) / self.lengths[lane]
        along = arc_length(centre)
        s_m = np.clip(share, 0.0, 1.0) * along[-1]
        slopes = tangents(centre)
        direction = np.column_stack([np.interp(s_m, along, slopes[:, k]) for k in (0, 1)])
        return points_at(centre, s_m), direction / np.hypot(*direction.T)[:, None]

    def sources(self) -> list[str]:
        """Return the edges that no turn enters: where traffic comes from."""
        entered = {self.lanes[t.target].edge for t in self.turns.values()}
        return sorted({lane.edge for lane in self.lanes.values()} - entered)

    def sinks(self) -> list[str]:
        """Return the edges that no turn leaves: where traffic goes to."""
        left = {self.lanes[t.source].edge for t in self.turns.values()}
        return sorted({lane.edge for lane in self.lanes.values()} - left)


def build_network(
    nodes: str, edges: str, connections: str, path: Path, *, cycle_s: int = 60
) -> None:
    """Make a SUMO network file from plain XML texts.

    Parameters
    ----------
    nodes, edges, connections : str
        SUMO's plain XML, each with its root element; metres in a local frame.
    path : Path
        The ``.net.xml`` to write.
    cycle_s : int
        Cycle of the traffic lights, in seconds.
    """
    texts = {"nod": nodes, "edg": edges, "con": connections}
    files = {kind: path.with_name(f"{path.name}.{kind}.xml") for kind in texts}
    for kind, file in files.items():
        file.write_text(texts[kind], encoding="utf-8")
    inputs = [
        f"--node-files={files['nod']}",
        f"--edge-files={files['edg']}",
        f"--connection-files={files['con']}",
    ]
    options = ["--offset.disable-normalization=true", "--no-turnarounds=true", "--precision=4"]
    sumo.run(
        "netconvert", [*inputs, *options, f"--tls.cycle.time={cycle_s}", f"--output-file={path}"]
    )


def read_network(path: Path, *, origin: tuple[float, float] = (0.0, 0.0)) -> RoadNetwork:
    """Read a SUMO network.

    Parameters
    ----------
    path : Path
        A ``.net.xml`` file.
    origin : tuple of float
        Easting and northing of the network's (0, 0), in metres.
    """
    root = ET.parse(path).getroot()  # noqa: S314
    edges = [
        edge
        for edge in root.iter("edge")
        if edge.get("function", "normal") in {"normal", "internal"}
    ]
    elements = {lane.attrib["id"]: lane for edge in edges for lane in edge.iter("lane")}
    lengths = {name: float(lane.attrib["length"]) for name, lane in elements.items()}
    lanes = {
        lane.id: lane
        for edge in edges
        if edge.get("function") is None
        for lane in _read_lanes(edge, origin)
    }
    spans = {name: (name, 0.0, 1.0) for name in lanes}
    turns: dict[str, Turn] = {}
    joins = _joins(root)
    for name, source in lanes.items():
        for link in joins[name]:
            parts, target = _follow(link, joins)
            if parts and target in lanes:
                made = _join(parts[0], source, lanes[target], link)
                turns[made.id] = made
                spans.update(_part_spans(parts, lengths))
    return RoadNetwork(lanes=lanes, turns=turns, spans=spans, lengths=lengths)


def _read_lanes(edge: ET.Element, origin: tuple[float, float]) -> list[Lane]:
    """Return the lanes of an edge that vehicles may use; neighbours get one common bound."""
    elements = [e for e in edge.iter("lane") if "pedestrian" not in e.get("allow", "").split()]
    shapes = [_shape(element) + np.array(origin) for element in elements]
    longest = max((arc_length(shape)[-1] for shape in shapes), default=0.0)
    count = 1 + max(1, int(np.ceil(longest / _LANE_SPACING_M)))
    lanes: list[Lane] = []
    for element, shape in zip(elements, shapes, strict=True):
        centre = _evenly(shape, count)
        half = float(element.get("width", _SUMO_WIDTH_M)) / 2.0
        right = offset(centre, -half)
        if lanes and np.abs(lanes[-1].left - right).max() < _SAME_BOUND_M:
            right = lanes[-1].left
        lanes.append(
            Lane(
                id=element.attrib["id"],
                edge=edge.attrib["id"],
                index=int(element.attrib["index"]),
                centre=centre,
                left=offset(centre, half),
                right=right,
                speed_limit=float(element.attrib["speed"]),
            )
        )
    return lanes


def _shape(lane: ET.Element) -> Floats:
    """Return the polyline of a lane as SUMO draws it."""
    return np.array([p.split(",")[:2] for p in lane.attrib["shape"].split()], dtype=np.float64)


def _joins(root: ET.Element) -> dict[str, list[ET.Element]]:
    """Return SUMO's connections by the id of the lane they leave."""
    joins: dict[str, list[ET.Element]] = defaultdict(list)
    for link in root.iter("connection"):
        joins[f"{link.attrib['from']}_{link.attrib['fromLane']}"].append(link)
    return joins


def _follow(link: ET.Element, joins: dict[str, list[ET.Element]]) -> tuple[list[str], str]:
    """Return the internal lanes of a way through a junction, and the lane that it enters."""
    parts: list[str] = []
    via = link.get("via")
    while via is not None:
        parts.append(via)
        link = joins[via][0]
        via = link.get("via")
    return parts, f"{link.attrib['to']}_{link.attrib['toLane']}"


def _part_spans(parts: list[str], lengths: dict[str, float]) -> dict[str, tuple[str, float, float]]:
    """Return where each internal lane begins and ends on the turn they make together."""
    along = np.concatenate([[0.0], np.cumsum([lengths[part] for part in parts])])
    shares = (along / along[-1]).tolist()
    return {part: (parts[0], shares[k], shares[k + 1]) for k, part in enumerate(parts)}


def _join(name: str, source: Lane, target: Lane, link: ET.Element) -> Turn:
    """Return the turn between two lanes; its bounds join the lanes' own end points."""
    leave, enter = tangents(source.centre)[-1], tangents(target.centre)[0]
    ends = [(getattr(source, side)[-1], getattr(target, side)[0]) for side in SIDES]
    curves = [turn(begin, leave, end, enter) for begin, end in ends]
    longest = max(arc_length(curve)[-1] for curve in curves)
    # in whole tens, so that turns side by side have their vertices at the same places
    count = 1 + 10 * max(1, round(longest / (10.0 * _TURN_SPACING_M)))
    centre, left, right = (_evenly(curve, count) for curve in curves)
    return Turn(
        id=name,
        source=source.id,
        target=target.id,
        signal=link.get("tl", ""),
        direction=link.get("dir", "s").lower(),
        centre=centre,
        left=left,
        right=right,
        speed_limit=min(source.speed_limit, target.speed_limit),
    )


def _evenly(curve: Floats, count: int) -> Floats:
    """Return the curve with `count` evenly spaced vertices; its ends stay exactly."""
    result = points_at(curve, np.linspace(0.0, arc_length(curve)[-1], count))
    result[0], result[-1] = curve[0], curve[-1]
    return result
