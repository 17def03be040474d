"""Street plans as SUMO's plain XML, drawn at random: junction, tee, bend, roundabout, arterial.

Local frame: metres, x to grid east, y to grid north; the junction or bend is near (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gis_radar.base import Floats
from simulation.curves import offset

SPEED_LIMITS_MPS = (8.33, 13.89, 13.89, 16.67)  # 30, 50, 50, 60 km/h
VERTEX_GAP_M = 3.0  # of drawn lines
NO_TURNS = "<connections/>"  # without connections in the plan, SUMO makes them


@dataclass(kw_only=True)
class StreetPlan:
    """Streets of a place, added one by one.

    Parameters
    ----------
    name : str
        Kind of the place.
    lane_width_m, speed_mps : float
        Width and speed limit of all lanes.
    """

    name: str
    lane_width_m: float = 3.25
    speed_mps: float = 13.89
    _nodes: list[str] = field(default_factory=list)
    _edges: list[str] = field(default_factory=list)

    def node(self, name: str, place: Floats, kind: str = "priority", radius_m: float = 8.0) -> None:
        """Add a node; `kind` is SUMO's type of junction."""
        self._nodes.append(
            f'<node id="{name}" x="{place[0]:.3f}" y="{place[1]:.3f}" type="{kind}" '
            f'radius="{radius_m}"/>'
        )

    def one_way(
        self, name: str, ends: tuple[str, str], line: Floats, lanes: int, rank: int = 1
    ) -> None:
        """Add the lanes of one direction, right of a line drawn in that direction."""
        shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in line)
        self._edges.append(
            f'<edge id="{name}" from="{ends[0]}" to="{ends[1]}" numLanes="{lanes}" '
            f'width="{self.lane_width_m}" speed="{self.speed_mps}" spreadType="right" '
            f'priority="{rank}" shape="{shape}"/>'
        )

    def street(
        self, ends: tuple[str, str], axis: Floats, lanes: tuple[int, int] = (1, 1), *,
        median_m: float = 0.0, rank: int = 1,
    ) -> None:  # fmt: skip
        """Add a street: lanes along and against its axis, with a median between them."""
        a, b = ends
        there, back = offset(axis, -median_m / 2.0), offset(axis[::-1], -median_m / 2.0)
        self.one_way(f"{a}_{b}", (a, b), there, lanes[0], rank)
        self.one_way(f"{b}_{a}", (b, a), back, lanes[1], rank)

    def arm(
        self, name: str, at: str, axis: Floats, lanes: tuple[int, int] = (1, 1), *,
        median_m: float = 0.0, rank: int = 1,
    ) -> None:  # fmt: skip
        """Add a street that leaves the plan: lanes out of it and into it."""
        out, back = offset(axis, -median_m / 2.0), offset(axis[::-1], -median_m / 2.0)
        self.node(f"{name}_out", out[-1])
        self.node(f"{name}_in", back[0] + [0.0, 0.1])
        self.one_way(f"{at}_{name}", (at, f"{name}_out"), out, lanes[0], rank)
        self.one_way(f"{name}_{at}", (f"{name}_in", at), back, lanes[1], rank)

    def ring(self, headings_rad: Floats, radius_m: float) -> None:
        """Add the lane around a roundabout, through its nodes `R0`, `R1`, ... at these headings."""
        for k, begin in enumerate(headings_rad):
            after = (k + 1) % len(headings_rad)
            turn = np.linspace(begin, begin + (headings_rad[after] - begin) % (2.0 * np.pi), 24)
            line = radius_m * np.column_stack([np.cos(turn), np.sin(turn)])
            self.one_way(f"ring{k}", (f"R{k}", f"R{after}"), line, 1, rank=9)

    @property
    def nodes_xml(self) -> str:
        """Nodes as SUMO's plain XML."""
        return f"<nodes>{''.join(self._nodes)}</nodes>"

    @property
    def edges_xml(self) -> str:
        """Edges as SUMO's plain XML."""
        return f"<edges>{''.join(self._edges)}</edges>"


def axis(start: Floats, heading_deg: float, *parts: tuple[float, float]) -> Floats:
    """Return a line of parts (length m, curvature 1/m, positive to the left).

    Curvature changes over 15 m, as on real roads.
    """
    lengths = np.array([length for length, _ in parts])
    curvature = np.array([bend for _, bend in parts])
    s = np.linspace(0.0, lengths.sum(), 1 + max(4, round(lengths.sum())))
    begins = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    bend = curvature[np.searchsorted(begins, s, side="right") - 1]
    kernel = np.ones(15) / 15.0
    bend = np.convolve(np.pad(bend, 7, mode="edge"), kernel, mode="valid")
    step = np.diff(s)
    heading = np.radians(heading_deg) + np.concatenate([[0.0], np.cumsum(bend[1:] * step)])
    middle = (heading[1:] + heading[:-1]) / 2.0
    moves = step[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
    line = np.vstack([[0.0, 0.0], np.cumsum(moves, axis=0)]) + start
    every = max(1, round(VERTEX_GAP_M))
    return np.vstack([line[:-1:every], line[-1:]])


def _spread(rng: np.random.Generator, count: int, least_deg: float) -> Floats:
    """Draw headings around a circle, at least `least_deg` apart."""
    free = rng.dirichlet(np.full(count, 3.0)) * (360.0 - count * least_deg)
    return np.asarray(rng.uniform(0.0, 360.0) + np.cumsum(least_deg + free))


def _bent(rng: np.random.Generator, heading_deg: float, start: Floats) -> Floats:
    """Draw the line of an arm with a bend of random radius."""
    radius = float(rng.choice([60.0, 110.0, 250.0, 600.0, 5000.0])) * rng.uniform(0.8, 1.25)
    sign = float(rng.choice([-1.0, 1.0]))
    straight = rng.uniform(25.0, 70.0)
    bend = min(rng.uniform(40.0, 90.0), radius * 1.2)
    return axis(
        start, heading_deg, (straight, 0.0), (bend, sign / radius), (170.0 - straight - bend, 0.0)
    )


def _drawn(name: str, rng: np.random.Generator) -> StreetPlan:
    return StreetPlan(
        name=name,
        lane_width_m=round(float(rng.uniform(2.9, 3.6)), 2),
        speed_mps=float(rng.choice(SPEED_LIMITS_MPS)),
    )


def _meeting(name: str, arms: int, rng: np.random.Generator) -> StreetPlan:
    plan = _drawn(name, rng)
    kind = str(rng.choice(["priority", "traffic_light"]))
    plan.node("C", np.zeros(2), kind)
    wide = rng.integers(0, arms)
    for k, heading in enumerate(_spread(rng, arms, 55.0)):
        lanes = (2, 2) if k in {wide, (wide + arms // 2) % arms} and rng.random() < 0.5 else (1, 1)
        rank = 3 if k in {wide, (wide + arms // 2) % arms} else 1
        median = float(rng.choice([0.0, 0.0, 2.0]))
        line = _bent(rng, float(heading), np.zeros(2))
        plan.arm(f"A{k}", "C", line, lanes, median_m=median, rank=rank)
    return plan


def junction(rng: np.random.Generator) -> StreetPlan:
    """Draw four streets that meet at random angles."""
    return _meeting("junction", 4, rng)


def tee(rng: np.random.Generator) -> StreetPlan:
    """Draw three streets that meet."""
    return _meeting("tee", 3, rng)


def bend(rng: np.random.Generator) -> StreetPlan:
    """Draw a street with a bend, or with two in opposite directions."""
    plan = _drawn("bend", rng)
    radius = rng.uniform(35.0, 130.0)
    length = radius * np.radians(rng.uniform(45.0, 100.0))
    back = float(rng.choice([0.0, -0.6]))
    parts = ((120.0, 0.0), (length, 1.0 / radius), (30.0, 0.0), (60.0, back / radius), (70.0, 0.0))
    line = axis(np.zeros(2), rng.uniform(0.0, 360.0), *parts)
    line = line - line[np.searchsorted(np.arange(len(line)) * VERTEX_GAP_M, 120.0 + length / 2.0)]
    if rng.random() < 0.5:
        line = line * [1.0, -1.0]
    lanes = int(rng.choice([1, 1, 2]))
    plan.node("B", line[-1])
    plan.arm("A", "B", line[::-1], (lanes, lanes))
    half = line[-1] - line[-2]
    heading = float(np.degrees(np.arctan2(half[1], half[0])))
    plan.arm("C", "B", axis(line[-1], heading, (40.0, 0.0)), (lanes, lanes))
    return plan


def roundabout(rng: np.random.Generator) -> StreetPlan:
    """Draw a roundabout with three or four arms."""
    plan = _drawn("roundabout", rng)
    plan.speed_mps = 11.11
    arms = int(rng.integers(3, 5))
    radius = rng.uniform(15.0, 22.0)
    headings = np.radians(_spread(rng, arms, 70.0))
    for k, heading in enumerate(headings):
        place = radius * np.array([np.cos(heading), np.sin(heading)])
        plan.node(f"R{k}", place, radius_m=5.0)
        plan.arm(f"A{k}", f"R{k}", _bent(rng, float(np.degrees(heading)), place))
    plan.ring(headings, radius)
    return plan


def arterial(rng: np.random.Generator) -> StreetPlan:
    """Draw a main road of two or three lanes each way, and a street that joins it."""
    plan = _drawn("arterial", rng)
    plan.speed_mps = float(rng.choice([13.89, 16.67, 19.44]))
    lanes = int(rng.integers(2, 4))
    median = float(rng.choice([0.0, 2.0, 5.0]))
    heading = rng.uniform(0.0, 360.0)
    plan.node("C", np.zeros(2), str(rng.choice(["priority", "traffic_light"])), 10.0)
    radius = rng.uniform(250.0, 900.0) * float(rng.choice([-1.0, 1.0]))
    for k, way in enumerate((heading, heading + 180.0)):
        line = axis(np.zeros(2), way, (40.0, 0.0), (160.0, (1.0, -1.0)[k] / radius))
        plan.arm(f"M{k}", "C", line, (lanes, lanes), median_m=median, rank=5)
    plan.arm("S", "C", _bent(rng, heading + rng.uniform(65.0, 115.0), np.zeros(2)))
    return plan


PLANS: tuple[Callable[[np.random.Generator], StreetPlan], ...] = (
    junction, tee, bend, roundabout, arterial,
)  # fmt: skip
