"""Traffic: vehicles that SUMO drives, laid on the smooth lanes of a network."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.steps import STEP_S
from simulation.curves import arc_length
from simulation.demand import Flow, VehicleKind, run_demand
from simulation.driving import DrivenRoads, LaneKeeping, eased
from simulation.movement import Traffic
from simulation.network import RoadNetwork

_LANE_CHANGE_M = 22.0
_LANE_JUMP_M = 0.5
_WANDER_LENGTH_M = 14.0
_RUN_UP_S = 40.0


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
) -> Traffic:
    """Simulate traffic with SUMO and lay it on the network's smooth lanes.

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
        How long to record, and how long traffic builds up before.
    seed : int
        Same seed, same traffic.
    keeping : LaneKeeping, optional
        Where in their lanes drivers keep.
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
        )
        runs = _read_trace(trace, np.random.default_rng(seed), keeping)
    steps = round(duration_s / STEP_S) + 1
    roads = keeping.on(network, seed=seed)
    return _lay(runs, roads, {k.name: k for k in kinds}, start, steps, round(warm_up_s / STEP_S))


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One vehicle's way in the output of SUMO: the front bumper's lane and position at each step.

    SUMO drives on the middle of the lane to the millimetre; `habit` (metres to the left),
    `wander` and `phase` make each driver keep a line of his own.
    """

    kind: str
    step: Integers
    lane: tuple[str, ...]
    position: Floats
    speed: Floats
    habit: float
    wander: float
    phase: float


def _read_trace(path: Path, rng: np.random.Generator, keeping: LaneKeeping) -> list[_Run]:
    """Return the runs of a floating-car file, in the order of first appearance."""
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
    runs, spread = [], keeping.driver_m
    for name, steps in rows.items():
        when, lane, position, speed = zip(*steps, strict=True)
        runs.append(
            _Run(
                kind=kinds[name],
                step=np.array(when),
                lane=lane,
                position=np.array(position),
                speed=np.array(speed),
                habit=float(np.clip(rng.normal(0.0, spread), -2 * spread, 2 * spread)),
                wander=keeping.wander_m,
                phase=float(rng.uniform(0.0, 2.0 * np.pi)),
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
    """Return the traffic of the runs that overlap the recorded time."""
    runs = [r for r in runs if r.step[-1] >= first_step and len(r.step) > 2]
    sizes = [(k.length_m, k.width_m, k.height_m) for k in (kinds[r.kind] for r in runs)]
    poses = np.full((4, steps, len(runs)), np.nan)
    speed = np.full((steps, len(runs)), np.nan)
    for column, run in enumerate(runs):
        inside = (run.step >= first_step) & (run.step < first_step + steps)
        rows = run.step[inside] - first_step
        poses[:, rows, column] = _drive(run, roads, sizes[column][0])[:, inside]
        speed[rows, column] = run.speed[inside]
    return Traffic(
        start=start,
        centre=np.moveaxis(poses[:2], 0, -1),
        heading=poses[2],
        speed=speed,
        yaw_rate=poses[3],
        size=np.array(sizes).reshape(-1, 3),
        kind=tuple(r.kind for r in runs),
    )


def _drive(run: _Run, roads: DrivenRoads, length_m: float) -> Floats:
    """Return easting, northing, heading and yaw rate at each step of a run.

    The rear bumper follows the way of the front one, the vehicle's length behind it.
    """
    front = _front(run, roads)
    s = arc_length(front)
    first = front[min(int(np.searchsorted(s, 0.5)), len(s) - 1)] - front[0]
    ahead = first / np.hypot(*first) if np.hypot(*first) > 0 else np.array([1.0, 0.0])
    path = np.vstack([front[0] - (length_m + 1.0) * ahead, front])
    along = np.concatenate([[-length_m - 1.0], s])
    rear = np.column_stack([np.interp(s - length_m, along, path[:, k]) for k in (0, 1)])
    heading = np.unwrap(np.arctan2(*(front - rear).T[::-1]))
    return np.vstack([((front + rear) / 2.0).T, heading, np.gradient(heading, STEP_S)])


def _front(run: _Run, roads: DrivenRoads) -> Floats:
    """Return the front bumper's way, with SUMO's sudden lane changes drawn out."""
    names = np.array(run.lane)
    point, ahead = np.empty((len(names), 2)), np.empty((len(names), 2))
    street = np.empty(len(names))
    for lane in dict.fromkeys(run.lane):
        on = names == lane
        point[on], ahead[on] = roads.network.locate(lane, run.position[on])
        street[on] = roads.aside(lane)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    driven = np.concatenate([[0.0], np.cumsum(run.speed[1:] * STEP_S)])
    jump = np.sum((point[:-1] - point[1:]) * left[1:], axis=1)
    aside = run.habit + run.wander * np.sin(driven / _WANDER_LENGTH_M + run.phase)
    aside += eased(street, driven)
    for k in np.flatnonzero(np.abs(jump) > _LANE_JUMP_M):
        share = np.clip((driven[k + 1 :] - driven[k + 1]) / _LANE_CHANGE_M, 0.0, 1.0)
        aside[k + 1 :] += jump[k] * (1.0 - share**2 * (3.0 - 2.0 * share))
    return point + aside[:, None] * left
