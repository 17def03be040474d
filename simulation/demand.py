"""Demand: kinds of vehicles and flows between the edges of a network, as input of SUMO."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simulation import sumo
from simulation.network import RoadNetwork

_STOPPED_M = 35.0  # from the begin of an edge to a broken-down car


@dataclass(frozen=True, kw_only=True)
class VehicleKind:
    """A kind of vehicle.

    Parameters
    ----------
    name : str
        Its name.
    sumo_class : str
        SUMO's vehicle class, which decides how it accelerates and where it may drive.
    length_m, width_m, height_m : float
        Size of the box around it.
    share : float
        Share of the traffic; shares need not add up to one.
    parts_m : tuple of (float, float)
        Bodies of an articulated vehicle: how far behind the front bumper each begins, and its
        length. Empty for a vehicle of one body.
    """

    name: str
    sumo_class: str
    length_m: float
    width_m: float
    height_m: float
    share: float
    parts_m: tuple[tuple[float, float], ...] = ()

    @property
    def bodies_m(self) -> tuple[tuple[float, float], ...]:
        """Bodies as in `parts_m`, also of a vehicle of one body."""
        return self.parts_m or ((0.0, self.length_m),)


@dataclass(frozen=True, kw_only=True)
class Flow:
    """Vehicles that enter at random (exponential gaps) on one edge and leave on another.

    Parameters
    ----------
    source, sink : str
        Edge ids.
    per_hour : float
        Vehicles an hour.
    """

    source: str
    sink: str
    per_hour: float


KINDS = (
    VehicleKind(
        name="small", sumo_class="passenger", length_m=3.8, width_m=1.7, height_m=1.5, share=0.18
    ),
    VehicleKind(
        name="car", sumo_class="passenger", length_m=4.5, width_m=1.82, height_m=1.47, share=0.36
    ),
    VehicleKind(
        name="suv", sumo_class="passenger", length_m=4.7, width_m=1.9, height_m=1.7, share=0.2
    ),
    VehicleKind(
        name="van", sumo_class="delivery", length_m=5.9, width_m=2.05, height_m=2.6, share=0.1
    ),
    VehicleKind(
        name="lorry", sumo_class="truck", length_m=8.5, width_m=2.5, height_m=3.4, share=0.06
    ),
    VehicleKind(
        name="truck", sumo_class="truck", length_m=11.8, width_m=2.55, height_m=3.9, share=0.03
    ),
    VehicleKind(
        name="bus", sumo_class="bus", length_m=12.0, width_m=2.55, height_m=3.1, share=0.04
    ),
    VehicleKind(
        name="motorcycle",
        sumo_class="motorcycle",
        length_m=2.2,
        width_m=0.8,
        height_m=1.4,
        share=0.03,
    ),
)

# the longest that may drive everywhere in Europe (directive 96/53/EC): 16.5 m and 18.75 m
LONG_KINDS = (
    VehicleKind(
        name="articulated", sumo_class="truck", length_m=16.5, width_m=2.55, height_m=3.9,
        share=0.03, parts_m=((0.0, 6.0), (2.9, 13.6)),
    ),
    VehicleKind(
        name="road_train", sumo_class="truck", length_m=18.0, width_m=2.55, height_m=3.9,
        share=0.015, parts_m=((0.0, 9.3), (10.5, 7.5)),
    ),
)  # fmt: skip
ALL_KINDS = (*KINDS, *LONG_KINDS)


def random_flows(
    network: RoadNetwork, *, per_hour: float, rng: np.random.Generator
) -> tuple[Flow, ...]:
    """Draw a flow from every entry to every exit that it leads to; their sum is `per_hour`."""
    sinks = set(network.sinks())
    pairs = [(a, b) for a in network.sources() for b in sorted(_reached(network, a) & sinks)]
    weights = rng.dirichlet(np.full(len(pairs), 2.0))
    return tuple(
        Flow(source=a, sink=b, per_hour=per_hour * float(weight))
        for (a, b), weight in zip(pairs, weights, strict=True)
    )


def _reached(network: RoadNetwork, edge: str) -> set[str]:
    """Return an edge and those that a vehicle can drive to from it."""
    lanes = network.lanes
    ways = [(lanes[t.source].edge, lanes[t.target].edge) for t in network.turns.values()]
    reached, before = {edge}, set[str]()
    while reached != before:
        before = set(reached)
        reached |= {b for a, b in ways if a in reached}
    return reached


def run_demand(
    net: Path,
    trace: Path,
    *,
    flows: Sequence[Flow],
    kinds: Sequence[VehicleKind],
    trace_from_s: float,
    end_s: float,
    seed: int,
    blocked: Sequence[str] = (),
) -> None:
    """Simulate the demand on a SUMO network at 20 Hz.

    Parameters
    ----------
    net : Path
        The ``.net.xml``.
    trace : Path
        SUMO's floating-car data, written here.
    flows, kinds : sequence
        The demand.
    trace_from_s, end_s : float
        Begin of what is written, and end, seconds of simulation.
    seed : int
        Seed of SUMO.
    blocked : sequence of str
        Edges with a broken-down car on each lane, near the begin.
    """
    routes = trace.with_name(f"{trace.name}.rou.xml")
    lanes = _lanes_of(net, blocked)
    routes.write_text(_routes_xml(flows, kinds, end_s, lanes), encoding="utf-8")
    sumo.run(
        "sumo",
        [
            f"--net-file={net}",
            f"--route-files={routes}",
            f"--fcd-output={trace}",
            f"--device.fcd.begin={trace_from_s}",
            f"--end={end_s}",
            f"--seed={seed}",
            "--step-length=0.05",
            "--precision=4",
            "--no-step-log=true",
            "--ignore-route-errors=true",
            "--time-to-teleport=-1",
        ],
    )


def _lanes_of(net: Path, edges: Sequence[str]) -> list[tuple[str, int]]:
    """Return edge and number of each lane of some edges."""
    root = ET.parse(net).getroot() if edges else ET.Element("net")  # noqa: S314
    found = [edge for edge in root.iter("edge") if edge.attrib["id"] in edges]
    return [(edge.attrib["id"], k) for edge in found for k in range(len(edge.findall("lane")))]


def _routes_xml(
    flows: Sequence[Flow],
    kinds: Sequence[VehicleKind],
    end_s: float,
    blocked: Sequence[tuple[str, int]] = (),
) -> str:
    types = "".join(
        f'<vType id="{k.name}" vClass="{k.sumo_class}" length="{k.length_m}" '
        f'width="{k.width_m}" height="{k.height_m}" probability="{k.share}"/>'
        for k in kinds
    )
    rows = "".join(
        f'<flow id="f{i}" type="mix" begin="0" end="{end_s}" from="{f.source}" to="{f.sink}" '
        f'period="exp({f.per_hour / 3600.0:.6f})" departLane="best" departSpeed="max"/>'
        for i, f in enumerate(flows)
        if f.per_hour > 0.0
    )
    stopped = "".join(
        f'<trip id="stopped{k}" type="{kinds[0].name}" depart="0" from="{edge}" to="{edge}" '
        f'departLane="{lane}" departPos="{_STOPPED_M}" departSpeed="0">'
        f'<stop lane="{edge}_{lane}" endPos="{_STOPPED_M + 5.0}" duration="{end_s}"/></trip>'
        for k, (edge, lane) in enumerate(blocked)
    )
    mix = f'<vTypeDistribution id="mix">{types}</vTypeDistribution>'
    return f"<routes>{mix}{stopped}{rows}</routes>"
