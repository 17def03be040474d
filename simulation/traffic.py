"""Traffic: SUMO's vehicles on the smooth lanes of a network."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from simulation.curves import arc_length
from simulation.demand import Flow, VehicleKind, run_demand
from simulation.driving import DrivenRoads, Driver, LaneKeeping
from simulation.movement import Coupling, Traffic
from simulation.network import RoadNetwork

_LANE_CHANGE_M = 22.0  # way over which a lane change is drawn out
_LANE_JUMP_M = 0.5  # steps aside of more are lane changes
_RUN_UP_S = 40.0  # before the recorded time that is read, too: a trailer follows its front's path


def simulate_traffic(
    net: Path,
    network: RoadNetwork,
    *,
    flows: Sequence[Flow],
    kinds: Sequence[VehicleKind],
    start: float,
    duration_s: float,
    warm_up_s: float = 240.0,
    seed: int,
    keeping: LaneKeeping | None = None,
    blocked: Sequence[str] = (),
) -> Traffic:
    """Simulate traffic with SUMO and place it on the network's smooth lanes.

    Parameters
    ----------
    net : Path
        The ``.net.xml`` that `network` was read from.
    network : RoadNetwork
        Its lanes and turns.
    flows, kinds : sequence
        The demand.
    start : float
        UNIX seconds of the first row.
    duration_s, warm_up_s : float
        Length of the traffic, and time for which it builds up before.
    seed : int
        Seed of all random numbers.
    keeping : LaneKeeping, optional
        How drivers keep their lanes.
    blocked : sequence of str
        Edges with a broken-down car on each lane.
    """
    keeping = keeping or LaneKeeping()
    with tempfile.TemporaryDirectory() as folder:
        trace = Path(folder) / "trace.xml"
        run_demand(
            net,
            trace,
            flows=flows,
            kinds=kinds,
            trace_from_s=max(0.0, warm_up_s - _RUN_UP_S),
            end_s=warm_up_s + duration_s + 2 * STEP_S,
            seed=seed,
            blocked=blocked,
        )
        runs = _read_trace(trace, seed, keeping)
    steps = round(duration_s / STEP_S) + 1
    roads = keeping.on(network, seed=seed)
    return _lay(runs, roads, {k.name: k for k in kinds}, start, steps, round(warm_up_s / STEP_S))


@dataclass(frozen=True, kw_only=True)
class _Run:
    """A vehicle in the output of SUMO: lane and position of the front bumper at each step.

    SUMO drives exactly on the middle of the lane; `driver` adds the offset from it.
    """

    kind: str
    step: Integers
    lane: tuple[str, ...]
    position: Floats
    speed: Floats
    driver: Driver


def _read_trace(path: Path, seed: int, keeping: LaneKeeping) -> list[_Run]:
    """Return the vehicles of SUMO's floating-car data, in the order of first appearance."""
    rows: dict[str, list[tuple[int, str, float, float]]] = {}
    kinds: dict[str, str] = {}
    step = 0
    for event, element in ET.iterparse(path, events=("start", "end")):  # noqa: S314
        if element.tag == "timestep" and event == "start":
            step = round(float(element.attrib["time"]) / STEP_S)
        elif element.tag == "vehicle" and event == "end":
            entry = element.attrib
            row = (step, entry["lane"], float(entry["pos"]), float(entry["speed"]))
            rows.setdefault(entry["id"], []).append(row)
            kinds[entry["id"]] = entry["type"]
        elif event == "end":
            element.clear()
    runs, place, manner = [], np.random.default_rng(seed), np.random.default_rng([seed, 5])
    for name, steps in rows.items():
        when, lane, position, speed = zip(*steps, strict=True)
        runs.append(
            _Run(
                kind=kinds[name],
                step=np.array(when),
                lane=lane,
                position=np.array(position),
                speed=np.array(speed),
                driver=keeping.driver(place, manner),
            )
        )
    return runs


def _lay(
    runs: list[_Run],
    roads: DrivenRoads,
    kinds: dict[str, VehicleKind],
    start: float,
    steps: int,
    first_step: int,
) -> Traffic:
    """Return the traffic of the vehicles that are there in the recorded time."""
    runs = [r for r in runs if r.step[-1] >= first_step and len(r.step) > 2]
    bodies = [(run, part) for run in runs for part in kinds[run.kind].bodies_m]
    sizes = [(length, kinds[r.kind].width_m, kinds[r.kind].height_m) for r, (_, length) in bodies]
    poses = np.full((4, steps, len(bodies)), np.nan)
    speed = np.full((steps, len(bodies)), np.nan)
    couplings: dict[int, Coupling] = {}
    for column, (run, (behind_m, length_m)) in enumerate(bodies):
        inside = (run.step >= first_step) & (run.step < first_step + steps)
        rows = run.step[inside] - first_step
        poses[:, rows, column] = _drive(run, roads, behind_m, length_m)[:, inside]
        speed[rows, column] = run.speed[inside]
        if behind_m > 0.0:
            whole = kinds[run.kind].length_m
            couplings[column] = Coupling(drawn_by=column - 1, whole_m=whole)
    return Traffic(
        start=start,
        centre=np.moveaxis(poses[:2], 0, -1),
        heading=poses[2],
        speed=speed,
        yaw_rate=poses[3],
        size=np.array(sizes).reshape(-1, 3),
        kind=tuple(r.kind for r, _ in bodies),
        couplings=couplings,
    )


def _drive(run: _Run, roads: DrivenRoads, behind_m: float, length_m: float) -> Floats:
    """Return easting, northing, heading and yaw rate of a body at each step.

    Its ends follow the path of the front bumper, `behind_m` and that plus `length_m` behind.
    """
    front = _front(run, roads)
    s = arc_length(front)
    first = front[min(int(np.searchsorted(s, 0.5)), len(s) - 1)] - front[0]
    ahead = first / np.hypot(*first) if np.hypot(*first) > 0 else np.array([1.0, 0.0])
    most_m = behind_m + length_m + 1.0
    path = np.vstack([front[0] - most_m * ahead, front])
    along = np.concatenate([[-most_m], s])
    if behind_m > 0.0:
        front = _at(s - behind_m, along, path)
    rear = _at(s - behind_m - length_m, along, path)
    heading = np.unwrap(np.arctan2(*(front - rear).T[::-1]))
    return np.vstack([((front + rear) / 2.0).T, heading, np.gradient(heading, STEP_S)])


def _at(s_m: Floats, along: Floats, path: Floats) -> Floats:
    return np.column_stack([np.interp(s_m, along, path[:, k]) for k in (0, 1)])


def _front(run: _Run, roads: DrivenRoads) -> Floats:
    """Return the front bumper's path; SUMO's sudden lane changes are drawn out."""
    names = np.array(run.lane)
    point, ahead = np.empty((len(names), 2)), np.empty((len(names), 2))
    for lane in dict.fromkeys(run.lane):
        on = names == lane
        point[on], ahead[on] = roads.network.locate(lane, run.position[on])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    driven = np.concatenate([[0.0], np.cumsum(run.speed[1:] * STEP_S)])
    jump = np.sum((point[:-1] - point[1:]) * left[1:], axis=1)
    heading = np.unwrap(np.arctan2(*ahead.T[::-1]))
    aside = run.driver.aside(run.lane, heading, driven, roads)
    for k in np.flatnonzero(np.abs(jump) > _LANE_JUMP_M):
        share = np.clip((driven[k + 1 :] - driven[k + 1]) / _LANE_CHANGE_M, 0.0, 1.0)
        aside[k + 1 :] += jump[k] * (1.0 - share**2 * (3.0 - 2.0 * share))
    return point + aside[:, None] * left
