"""Vehicles of an hour: their tracks, the tiles that they occupy and hide, and their passages.

The first block straddles the hour's begin: its states before the hour give visibility and passages
their start values. All results are cut to the hour.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import Any, TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import TRACK_EVERY_STEPS, Integers, watch_parent, worker_pool
from gis_radar.hdmap import LaneGraph
from gis_radar.measures import HourWindow, PoseSight, SensorHour
from gis_radar.tracking.batches import BatchMaker, VehicleBatch, joined_rows
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.hour_blocks import Block, blocks_of
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.occupancy import OccupancyEngine
from gis_radar.tracking.tables import PASSAGES_KIND, TRACKS_KIND, VEHICLES_KIND
from gis_radar.tracking.tracker import vehicles_in

_NO_STATES, _NO_VEHICLES = TRACKS_KIND.empty(), VEHICLES_KIND.empty()
_NUMBERS_PER_HOUR = 1_000_000  # an hour's vehicles have numbers from so many times the hour on

_TimedBlock: TypeAlias = tuple[tuple[int, int], Block]


@dataclass(frozen=True, kw_only=True)
class HourVehicles:
    """The vehicles of an hour.

    Parameters
    ----------
    tracks : DataFrame
        `vehicle step easting northing heading speed lanelet_id s_m d_m seen`: every fourth step,
        and the first and the last of a vehicle; by vehicle and step.
    vehicles : DataFrame
        `vehicle first_step last_step length_m width_m length_sigma_m p_exists p_heavy lanelets`.
    continued : DataFrame
        `vehicle next`: numbers of a vehicle in the hour before and in this one.
    passages : DataFrame
        `vehicle lanelet_id step speed p_heavy`, by step, vehicle and lanelet.
    occupied, visible : DataFrame
        `tile_id first_step last_step seen`, by tile and step.
    on_lanes : list of DataFrame
        Places of vehicles by sensor, for :func:`gis_radar.tracking.batches.warn_of_poses`.
    """

    tracks: pd.DataFrame
    vehicles: pd.DataFrame
    continued: pd.DataFrame
    passages: pd.DataFrame
    occupied: pd.DataFrame
    visible: pd.DataFrame
    on_lanes: list[pd.DataFrame]


def vehicles_of_hour(
    sensors: Sequence[SensorHour],
    window: HourWindow,
    *,
    valid_runs: pd.DataFrame,
    tiles: gpd.GeoDataFrame,
    sights: Mapping[str, PoseSight],
    graph: LaneGraph,
    processes: int = 1,
) -> HourVehicles:
    """Follow the vehicles of an hour.

    Parameters
    ----------
    sensors : sequence of SensorHour
        What each sensor delivered in the window.
    window : HourWindow
        The hour.
    valid_runs : DataFrame
        `sight, first_step, last_step`: runs of the window in which frames are valid.
    tiles : GeoDataFrame
        All tiles.
    sights : mapping
        Sights of the sensors' poses, by name.
    graph : LaneGraph
        The lanes.
    processes : int
        Number of blocks in which vehicles are looked for in parallel.
    """
    engine = OccupancyEngine(tiles, sights)
    results = _HourResults(window=window, engine=engine, valid_runs=valid_runs)
    maker = BatchMaker(graph)
    blocks = blocks_of(sensors, window, graph)
    for begin, block, motions in _with_motions(blocks, graph, processes):
        results.advance(block.first_step)
        results.add(maker.batch(block, motions), maker.numbers)
        if begin < window.begin:
            maker.clear_lane_offsets()  # the job of the hour before checks poses by these
        del block, motions  # before the next block is read
    return results.finish(maker.on_lanes([each.sensor for each in sensors]))


def _with_motions(
    blocks: Iterator[_TimedBlock], graph: LaneGraph, processes: int
) -> Iterator[tuple[int, Block, list[Motion]]]:
    """Yield the first step of each block, the block, and the motions of its vehicles."""
    first = list(islice(blocks, 2)) if processes > 1 else []
    if len(first) < 2:
        for (begin, _), block in chain(first, blocks):
            yield begin, block, _motions(block.detections, graph)
            del block  # before the next one is read
        return
    waiting = deque[tuple[int, Block, "Future[list[Motion]]"]]()
    with worker_pool(processes, _start_worker, graph) as pool:
        for (start, _), read in chain(first, blocks):
            waiting.append((start, read, pool.submit(_motions_in_worker, read.detections)))
            if len(waiting) > processes:
                begin, block, found = waiting.popleft()
                yield begin, block, found.result()
        while waiting:
            begin, block, found = waiting.popleft()
            yield begin, block, found.result()


def _motions(detections: MapDetections, graph: LaneGraph) -> list[Motion]:
    """Return the motions of the vehicles of a block; its sensors may be some of the site's."""
    number = np.unique(detections.sensor, return_inverse=True)[1].astype(np.int64)
    return vehicles_in(replace(detections, sensor=number), graph)


_graph: LaneGraph | None = None  # lanes of this worker process


def _start_worker(graph: LaneGraph) -> None:
    global _graph  # noqa: PLW0603 - what all blocks of a worker have in common
    watch_parent()
    _graph = graph


def _motions_in_worker(detections: MapDetections) -> list[Motion]:
    assert _graph is not None  # noqa: S101 - set when the worker starts
    return _motions(detections, _graph)


@dataclass(kw_only=True)
class _HourResults:
    """Results of the blocks of an hour, in the order of time and cut to the hour."""

    window: HourWindow
    engine: OccupancyEngine
    valid_runs: pd.DataFrame
    reached: int | None = None  # the step to which the engine was advanced
    tracks: list[pd.DataFrame] = field(default_factory=list)
    passages: list[pd.DataFrame] = field(default_factory=list)
    vehicles: dict[int, dict[str, Any]] = field(default_factory=dict)
    over_begin: list[int] = field(default_factory=list)
    over_end: list[int] = field(default_factory=list)

    def add(self, batch: VehicleBatch, numbers: list[int]) -> None:
        """Add the vehicles of a block, after `advance` to its first step."""
        begin, end = self.window.begin, self.window.end
        states, vehicles = TRACKS_KIND.typed(batch.tracks), VEHICLES_KIND.typed(batch.vehicles)
        states = states[states["step"] <= end].reset_index(drop=True)
        self.advance(min(batch.last_step, end) + 1, states, vehicles)
        self.over_begin += _vehicles_over(begin, states, numbers)
        self.over_end += _vehicles_over(end, states, numbers)
        part = states[states["step"].between(begin, end - 1)]
        step, number = (part[name].to_numpy(np.int64) for name in ("step", "vehicle"))
        spans = part.groupby("vehicle", sort=True)["step"].agg(["min", "max"])
        first, last = (spans[name].reindex(number).to_numpy() for name in ("min", "max"))
        self.tracks.append(part[(step % TRACK_EVERY_STEPS == 0) | (step == first) | (step == last)])
        by_number = vehicles.set_index("vehicle", drop=False)
        lanelets = _lanelets(part)
        for n, (least, most) in zip(spans.index.tolist(), spans.to_numpy().tolist(), strict=True):
            row = {str(name): value for name, value in by_number.loc[n].items()}
            row |= {"first_step": least, "last_step": most, "lanelets": lanelets[n]}
            self.vehicles[n] = joined_rows(self.vehicles.get(n), row)

    def advance(
        self, to: int, states: pd.DataFrame = _NO_STATES, vehicles: pd.DataFrame = _NO_VEHICLES
    ) -> None:
        """Advance the engine to a step, with the states up to it; from the first block on."""
        if self.reached is not None and self.reached < to:
            span = self.reached, to
            self.passages.append(self.engine.advance(states, vehicles, self.valid_runs, span))
        self.reached = to

    def finish(self, on_lanes: list[pd.DataFrame]) -> HourVehicles:
        """Return all results, with final numbers of vehicles."""
        begin, end = self.window.begin, self.window.end
        self.advance(end + 1)
        occupied, visible = (_cut_to_hour(each, begin, end) for each in self.engine.flush())
        final = self._final_numbers()
        rows = [
            self.vehicles[n] | {"vehicle": final[n]} for n in sorted(final, key=final.__getitem__)
        ]
        vehicles = pd.DataFrame(rows, columns=[*VEHICLES_KIND.columns])
        tracks = pd.concat([TRACKS_KIND.empty(), *self.tracks], ignore_index=True)
        passages = pd.concat([PASSAGES_KIND.empty(), *self.passages], ignore_index=True)
        passages = passages[passages["step"].between(begin, end - 1)]
        heavy = passages["vehicle"].map({n: row["p_heavy"] for n, row in self.vehicles.items()})
        before = (self.window.hour - 1) * _NUMBERS_PER_HOUR
        continued = [(before + k, final[n]) for k, n in enumerate(self.over_begin)]
        return HourVehicles(
            tracks=_ends_and_fourths(_renumbered(tracks, final), vehicles),
            vehicles=vehicles,
            continued=pd.DataFrame(continued, columns=["vehicle", "next"]).astype(np.int64),
            passages=_renumbered(passages.assign(p_heavy=heavy), final, PASSAGES_KIND.order),
            occupied=occupied, visible=visible, on_lanes=on_lanes,
        )  # fmt: skip

    def _final_numbers(self) -> dict[int, int]:
        """Return the final number of each vehicle; those that go on over its end come first.

        The job of the next hour makes the block at that edge, too, and so knows their numbers.
        """
        rest = sorted(self.vehicles.keys() - set(self.over_end))
        rest.sort(key=lambda n: self.vehicles[n]["first_step"])
        base = self.window.hour * _NUMBERS_PER_HOUR
        return {n: base + k for k, n in enumerate([*self.over_end, *rest])}


def _vehicles_over(edge: int, states: pd.DataFrame, numbers: list[int]) -> list[int]:
    """Return which vehicles have states on both sides of an edge, in the order of the block."""
    step = states["step"].to_numpy(np.int64)
    sides = [set(states["vehicle"].to_numpy()[step == at].tolist()) for at in (edge - 1, edge)]
    return [n for n in numbers if n in sides[0] and n in sides[1]]


def _lanelets(states: pd.DataFrame) -> dict[int, Integers]:
    """Return the lanelets that each vehicle follows, in order."""
    on = states[states["lanelet_id"].notna()].sort_values(["vehicle", "step"])
    number, lanelet = on["vehicle"].to_numpy(np.int64), on["lanelet_id"].to_numpy(np.int64)
    new = np.ones(len(on), np.bool_)
    new[1:] = (np.diff(number) != 0) | (lanelet[1:] != lanelet[:-1])
    none = dict.fromkeys(states["vehicle"].unique().tolist(), np.empty(0, np.int64))
    ids, first = np.unique(number[new], return_index=True)
    found = np.split(lanelet[new], first[1:]) if len(ids) else []
    return none | dict(zip(ids.tolist(), found, strict=True))


def _cut_to_hour(runs: pd.DataFrame, begin: int, end: int) -> pd.DataFrame:
    """Return the parts of runs within the hour."""
    first, last = runs["first_step"].clip(lower=begin), runs["last_step"].clip(upper=end - 1)
    cut = runs.assign(first_step=first, last_step=last)
    return pd.DataFrame(cut[first <= last]).reset_index(drop=True)


def _renumbered(
    rows: pd.DataFrame, final: Mapping[int, int], order: Sequence[str] = ("vehicle", "step")
) -> pd.DataFrame:
    """Return rows with the final numbers of vehicles, sorted."""
    renamed = rows.assign(vehicle=rows["vehicle"].map(final).astype(np.int64))
    return renamed.sort_values([*order], ignore_index=True)


def _ends_and_fourths(tracks: pd.DataFrame, vehicles: pd.DataFrame) -> pd.DataFrame:
    """Keep every fourth step and the first and last of each vehicle, not those of its blocks."""
    known = vehicles.set_index("vehicle")
    first, last = (
        known[name].reindex(tracks["vehicle"]).to_numpy() for name in ("first_step", "last_step")
    )
    step = tracks["step"].to_numpy(np.int64)
    kept = (step % TRACK_EVERY_STEPS == 0) | (step == first) | (step == last)
    ends_and_fourths: pd.DataFrame = tracks[kept]
    return ends_and_fourths.reset_index(drop=True)
