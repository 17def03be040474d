"""Power and false alarms of a comparison of two hours, before and after a signal was changed.

    python bench/signal_change.py [--places 101-116] [--per-hour 1000]

SUMO drives hours at junctions drawn at random, with a fixed-time signal: two hours with a cycle of
60 s, two with 110 s. Lane measures follow from all true vehicles, so that only traffic differs from
hour to hour. Shown is how often any measure of any lane is significant between the two cycles, and
between hours of the same cycle; and how often the length of the cycle is found from 20 minutes of a
stop line with at least four begins of green.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

ROOT = Path(__file__).parents[1]
sys.path += [str(ROOT), str(ROOT / "bench" / "localization")]

from figures import table  # noqa: E402

from gis_radar.base import STEPS_PER_HOUR, STEPS_PER_SECOND  # noqa: E402
from gis_radar.measures import (  # noqa: E402
    FrontStates,
    LaneNetwork,
    StepGrid,
    TileSteps,
    TrackedLanes,
    VehicleTable,
    VisibleRuns,
    cycles,
    measure_lanes,
)
from gis_radar.measures.cycles import FEW  # noqa: E402
from gis_radar.products import NOT_TOLD  # noqa: E402
from gis_radar.products.comparison.rows import AlikeRows, compared_rows  # noqa: E402
from simulation.curves import arc_length  # noqa: E402
from simulation.demand import KINDS, random_flows, run_demand  # noqa: E402
from simulation.network import RoadNetwork, build_network, read_network  # noqa: E402
from simulation.street_plans import NO_TURNS, StreetPlan, junction  # noqa: E402

LENGTHS = {kind.name: kind.length_m for kind in KINDS}
TILE_M = 1.0  # length
WARM_UP_S = 300  # for which traffic builds up
STATE_STEPS = 4  # between two states, as in a dataset
BEGIN = 472_000 * STEPS_PER_HOUR  # step at which the hour begins
CYCLES_S = (60, 110)
PART_STEPS, RIGHT_S = 20 * 60 * STEPS_PER_SECOND, 2.0  # 20 minutes; error of a right cycle, at most
MINUTES = StepGrid(begin=BEGIN, steps=60 * STEPS_PER_SECOND, count=60)


@dataclass(frozen=True, kw_only=True)
class SignalHour:
    """An hour of true traffic at a junction.

    Parameters
    ----------
    network : LaneNetwork
        The lanes.
    states, vehicles, visible
        As for :func:`gis_radar.measures.measure_lanes`.
    """

    network: LaneNetwork
    states: FrontStates
    vehicles: VehicleTable
    visible: VisibleRuns

    def tiles(self, grid: StepGrid) -> TileSteps:
        """Return occupied steps of tiles: from front to rear, on the lane of the front alone."""
        network, states = self.network, self.states
        on = np.flatnonzero((states.step >= grid.begin) & (states.step < grid.end))
        lane, front = states.lane[on], states.along_m[on]
        rear = np.maximum(front - self.vehicles.length_m[states.vehicle[on]], 0.0)
        first, last = network.tile_at(lane, rear), network.tile_at(lane, front)
        count = last - first + 1
        row = np.repeat(np.arange(len(on)), count)
        within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        cell = (first[row] + within) * grid.count + grid.of(states.step[on])[row]
        size = len(network.tile_id) * grid.count
        whole = np.full(size, float(grid.steps))
        return TileSteps(
            tile_id=np.repeat(network.tile_id, grid.count),
            interval=np.tile(np.arange(grid.count), len(network.tile_id)), visible=whole,
            hidden=np.zeros(size),
            occupied=np.minimum(np.bincount(cell, minlength=size) * float(STATE_STEPS), whole),
            inferred=np.zeros(size), variance=np.zeros(size),
        )  # fmt: skip

    def tracked(self, grid: StepGrid) -> TrackedLanes:
        """Return what :func:`gis_radar.measures.measure_lanes` takes, for some intervals."""
        return TrackedLanes(
            network=self.network, grid=grid, states=self.states, vehicles=self.vehicles,
            visible=self.visible, observed=self.visible,
        )  # fmt: skip

    def traffic(self, grid: StepGrid = MINUTES) -> gpd.GeoDataFrame:
        """Return the lane measures as `Dataset.traffic` does."""
        found = measure_lanes(self.tracked(grid), self.tiles(grid))
        rows = pd.DataFrame(
            {name: values for name, values in found.lanes.items() if name != "speed_counts"}
        )
        length = self.network.length_m[rows["lane"]]
        begin = pd.Timestamp("2026-03-02T08:00Z") + pd.Timedelta(minutes=1) * rows["interval"]
        return gpd.GeoDataFrame(
            rows.assign(
                begin=begin, end=begin + pd.Timedelta(minutes=1), volume_veh_h=60 * rows["volume"],
                flow_veh_h=rows["flow"], density_veh_km=rows["density"],
            ),
            geometry=shapely.linestrings([[(0.0, 0.0), (each, 0.0)] for each in length]),
        )  # fmt: skip


def signal_hour(*, place: int, cycle_s: int, seed: int, per_hour: float) -> SignalHour:
    """Simulate an hour at the junction of seed `place`, with a fixed-time signal."""
    with tempfile.TemporaryDirectory() as name:
        net, trace = Path(name) / "net.xml", Path(name) / "trace.xml"
        plan = _plan(place)
        build_network(plan.nodes_xml, plan.edges_xml, NO_TURNS, net, cycle_s=cycle_s)
        roads = read_network(net)
        flows = random_flows(roads, per_hour=per_hour, rng=np.random.default_rng(place))
        run_demand(
            net, trace, flows=flows, kinds=KINDS, trace_from_s=WARM_UP_S,
            end_s=WARM_UP_S + 3600.0, seed=seed,
        )  # fmt: skip
        network, bands = _network(roads)
        states, kinds = _states(trace, roads, network, bands)
    lengths = np.array([LENGTHS[kind] for kind in kinds])
    tiles = network.tile_id
    return SignalHour(
        network=network, states=states,
        vehicles=VehicleTable(
            vehicle=np.arange(len(lengths)), length_m=lengths, p_heavy=np.zeros(len(lengths)),
            p_exists=np.full(len(lengths), np.nan),
        ),
        visible=VisibleRuns(
            tile_id=tiles, first=np.full(len(tiles), BEGIN),
            last=np.full(len(tiles), BEGIN + STEPS_PER_HOUR - 1),
        ),
    )  # fmt: skip


def _plan(place: int) -> StreetPlan:
    """Draw junctions until one has a signal; return it."""
    rng = np.random.default_rng(place)
    while True:
        plan = junction(rng)
        if "traffic_light" in plan.nodes_xml:
            return plan


def _network(roads: RoadNetwork) -> tuple[LaneNetwork, dict[str, int]]:
    """Return lanes and turns as a lane network, and the row of each by SUMO's id."""
    bands = list(roads.bands)
    at = {name: k for k, name in enumerate(bands)}
    length = np.array([arc_length(band.centre)[-1] for band in roads.bands.values()])
    signal = {each.source for each in roads.turns.values() if each.signal}
    stop = np.array([name in signal for name in bands])
    after: list[tuple[int, ...]] = [()] * len(bands)
    for name, turn in roads.turns.items():
        after[at[turn.source]] += (at[name],)
        after[at[name]] += (at[turn.target],)
    tiles = [np.arange(0.0, each, TILE_M) for each in length]
    lane = np.repeat(np.arange(len(bands)), [len(each) for each in tiles])
    ids = np.arange(len(bands), dtype=np.int64)
    network = LaneNetwork(
        lane=ids, length_m=length, line_m=np.where(stop, length, length / 2.0), has_stop_line=stop,
        queue_line_m=np.where(stop, length, np.nan),
        free_speed=np.array([band.speed_limit for band in roads.bands.values()]),
        lanelet_id=ids, lanelet_lane=ids, offset_m=np.zeros(len(bands)),
        tile_id=np.arange(len(lane), dtype=np.int64), tile_lane=lane,
        tile_m=np.concatenate(tiles), tile_length_m=np.full(len(lane), TILE_M), after=after,
    )  # fmt: skip
    return network, at


def _states(
    trace: Path, roads: RoadNetwork, network: LaneNetwork, bands: dict[str, int]
) -> tuple[FrontStates, list[str]]:
    """Return the states in SUMO's floating-car data, and the kinds of the vehicles."""
    numbers: dict[str, int] = {}
    kinds: list[str] = []
    rows = []
    for step, entry in _entries(trace):
        if entry["id"] not in numbers:
            numbers[entry["id"]] = len(numbers)
            kinds.append(entry["type"])
        band, begin, end = roads.spans[entry["lane"]]
        share = begin + (end - begin) * float(entry["pos"]) / roads.lengths[entry["lane"]]
        rows.append((numbers[entry["id"]], step, bands[band], share, float(entry["speed"])))
    vehicle, step_at, lane, share_at, speed = (np.array(each) for each in zip(*rows, strict=True))
    order = np.lexsort((step_at, vehicle))
    lane = lane[order]
    along = np.clip(share_at[order], 0.0, 1.0) * network.length_m[lane]
    return FrontStates(
        vehicle=vehicle[order], step=BEGIN + step_at[order], lane=lane, along_m=along,
        speed=speed[order], seen=np.ones(len(order), np.bool_),
    ), kinds  # fmt: skip


def _entries(trace: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield step (from the hour's begin) and attributes of every fourth state of vehicles."""
    step = 0
    for event, element in ET.iterparse(trace, events=("start", "end")):  # noqa: S314
        if element.tag == "timestep" and event == "start":
            step = round((float(element.attrib["time"]) - WARM_UP_S) * STEPS_PER_SECOND)
        elif event == "end":
            if element.tag == "vehicle" and step % STATE_STEPS == 0 and step < STEPS_PER_HOUR:
                yield step, dict(element.attrib)
            element.clear()


def told(before: gpd.GeoDataFrame, after: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return the significant differences between two hours."""
    lanes = {
        lane: AlikeRows(rows, after[after["lane"] == lane])
        for lane, rows in before.groupby("lane")
    }  # fmt: skip
    found = compared_rows(lanes)
    return found[found["verdict"] != NOT_TOLD]


def cycles_told(hour: SignalHour, cycle_s: int) -> list[tuple[bool, bool]]:
    """Return by stop line and 20 minutes whether a cycle is found, and whether it is right."""
    found = []
    for k in range(3):
        grid = StepGrid(begin=BEGIN + k * PART_STEPS, steps=PART_STEPS, count=1)
        told_by = {each.lane: each for each in cycles(hour.tracked(grid))}
        found += [
            (np.isfinite(each.cycle_s), abs(each.cycle_s - cycle_s) <= RIGHT_S)
            for each in told_by.values()
            if each.reason != FEW
        ]
    return found


def main() -> None:
    """Compare hours at all places; print both tables."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--places", default="101-116")
    words.add_argument("--per-hour", type=float, default=1000.0)
    given = words.parse_args()
    first, last = map(int, given.places.split("-"))
    kinds: dict[str, list[pd.DataFrame]] = {"60 to 110 s": [], "60 s twice": [], "110 s twice": []}
    lengths: dict[int, list[tuple[bool, bool]]] = {cycle_s: [] for cycle_s in CYCLES_S}
    for place in range(first, last + 1):
        rows = []
        for cycle_s, seed in product(CYCLES_S, range(2)):
            hour = signal_hour(
                place=place, cycle_s=cycle_s, seed=cycle_s + seed, per_hour=given.per_hour
            )
            rows.append(hour.traffic())
            lengths[cycle_s] += cycles_told(hour, cycle_s)
        b1, b2, a1, a2 = rows
        pairs = ((b1, a1), (b2, a2)), ((b1, b2),), ((a1, a2),)
        for kept, each in zip(kinds.values(), pairs, strict=True):
            kept += [told(*pair) for pair in each]
        print(place, *(sum(len(each) > 0 for each in kept) for kept in kinds.values()), flush=True)
    shown = [
        [kind, f"{len(kept)}", f"{np.mean([len(each) > 0 for each in kept]):.0%}",
         f"{np.mean([each['lane'].isna().any() for each in kept]):.0%}",
         f"{np.mean([len(each) for each in kept]):.1f}"]
        for kind, kept in kinds.items()
    ]  # fmt: skip
    heads = ["signal", "pairs of hours", "anything told", "of all stop lines", "rows told, mean"]
    print(table(heads, shown))
    shown = [
        [f"{cycle_s} s", f"{len(found)}", *(f"{each:.0%}" for each in np.mean(found, axis=0))]
        for cycle_s, found in lengths.items()
    ]
    print(table(["cycle", "stop lines and 20 min", "told", "right within 2 s"], shown))


if __name__ == "__main__":
    main()
