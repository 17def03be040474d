"""Traffic: where every vehicle is and how it moves, at every 50 ms and in between."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.steps import STEP_S
from simulation.curves import arc_length
from simulation.demand import Flow, VehicleKind, run_demand
from simulation.driving import DrivenRoads, LaneKeeping, eased
from simulation.network import RoadNetwork
from simulation.terrain import Terrain

_LANE_CHANGE_M = 22.0
_LANE_JUMP_M = 0.5
_WANDER_LENGTH_M = 14.0
_RUN_UP_S = 40.0


@dataclass(frozen=True, kw_only=True)
class Vehicles:
    """The vehicles at one moment, one row each.

    Parameters
    ----------
    number : Integers
        Which vehicle, ``(n,)``.
    centre : Floats
        Middle of the vehicle in the map, ``(n, 2)``, metres.
    heading : Floats
        Radians, counter-clockwise from grid east.
    speed : Floats
        m/s.
    yaw_rate : Floats
        rad/s.
    size : Floats
        Length, width and height, ``(n, 3)``, metres.
    """

    number: Integers
    centre: Floats
    heading: Floats
    speed: Floats
    yaw_rate: Floats
    size: Floats


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """The movement of all vehicles on a time grid of 50 ms.

    Parameters
    ----------
    start : float
        UNIX seconds of the first row.
    centre : Floats
        ``(times, vehicles, 2)`` in the map, metres; NaN where the vehicle is not there.
    heading, speed, yaw_rate : Floats
        ``(times, vehicles)`` in rad (continuous), m/s, rad/s.
    size : Floats
        Length, width and height, ``(vehicles, 3)``, metres.
    kind : tuple of str
        Kind of every vehicle.
    """

    start: float
    centre: Floats = field(repr=False)
    heading: Floats = field(repr=False)
    speed: Floats = field(repr=False)
    yaw_rate: Floats = field(repr=False)
    size: Floats = field(repr=False)
    kind: tuple[str, ...] = field(repr=False)

    def at(self, time: float) -> Vehicles:
        """Return the vehicles at a time (UNIX seconds), between the grid's rows too."""
        place = np.clip((time - self.start) / STEP_S, 0.0, len(self.speed) - 1.0)
        low = min(int(place), len(self.speed) - 2)
        share = place - low

        def between(values: Floats) -> Floats:
            return np.asarray(values[low] * (1.0 - share) + values[low + 1] * share)

        centre = between(self.centre)
        there = np.flatnonzero(np.isfinite(centre[:, 0]))
        return Vehicles(
            number=there,
            centre=centre[there],
            heading=between(self.heading)[there],
            speed=between(self.speed)[there],
            yaw_rate=between(self.yaw_rate)[there],
            size=self.size[there],
        )

    def table(self, terrain: Terrain) -> pd.DataFrame:
        """Return the true traffic as a table, sorted by time and vehicle.

        Returns
        -------
        DataFrame
            ``t`` UNIX seconds; ``id``; ``easting northing height`` of the middle of the vehicle
            at road height, metres; ``heading`` degrees counter-clockwise from grid east;
            ``speed`` m/s; ``length width vehicle_height`` metres.
        """
        row, column = np.nonzero(np.isfinite(self.speed))
        centre = self.centre[row, column]
        turned = np.degrees(self.heading[row, column])
        length, width, height = self.size[column].T
        # 1/1024 m is fine enough, and such numbers pack well
        place = np.rint(np.column_stack([centre, terrain.height(centre)]) * 1024.0) / 1024.0
        return pd.DataFrame(
            {
                "t": np.round(self.start + row * STEP_S, 3),
                "id": column.astype(np.int32),
                "easting": place[:, 0],
                "northing": place[:, 1],
                "height": place[:, 2],
                "heading": (np.rint(turned * 64.0) / 64.0 + 180.0) % 360.0 - 180.0,
                "speed": np.rint(self.speed[row, column] * 256.0) / 256.0,
                "length": length,
                "width": width,
                "vehicle_height": height,
            }
        )


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
