"""What each component of the tracker is worth: the figures of a scene with it turned off.

A component is turned off from outside: by the settings of `gis_radar.tracking`, or by a function or
constant of its modules that is replaced in this process. All run with true poses and on the same
detections, which are read once.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from found import found_in
from methods import Figures
from passages import score_passages
from scenes import SceneFiles
from score import score_occupancy
from tables import NOTHING, NOTHING_FIRST, SECOND
from tracks import compared, score_tracks
from true_occupancy import TrueOccupancy, true_occupancy

import gis_radar as gr
from gis_radar.arrays import Floats, Integers, compiled
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.measures.hour import HourWindow
from gis_radar.measures.sensor_reading import SensorHour
from gis_radar.tracking.blocks import Block
from gis_radar.tracking.bodies import rows_by_number
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.forward import ForwardFilter
from gis_radar.tracking.hour_blocks import blocks_of
from gis_radar.tracking.motion import Motion, fit_motion
from gis_radar.tracking.passes import Passes
from gis_radar.tracking.settings import ForwardSettings, VehicleSettings
from gis_radar.tracking.size import Size

ROOM = "gis_radar.tracking."
FAR = 1e9  # of any unit: what no value reaches


@dataclass(frozen=True, kw_only=True)
class Off:
    """How a component is turned off.

    Parameters
    ----------
    settings : mapping
        New values by their places in `VehicleSettings`, such as ``links.end_cost``.
    replaced : mapping
        New functions and constants by module and name, such as ``lives:find_stationary``.
    sensors : int or None
        Only so many sensors; all where None. Figures are then those of what these see.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    replaced: Mapping[str, Any] = field(default_factory=dict)
    sensors: int | None = None


def _as_time_runs(
    detections: MapDetections, graph: LaneGraph, settings: ForwardSettings, moving_mps: float
) -> tuple[tuple[Integers, Integers], tuple[Floats, Floats]]:
    """Follow vehicles as time runs only."""
    number, state = ForwardFilter(graph, settings, moving_mps=moving_mps).push(detections)
    return (number, np.full_like(number, NONE)), (state, state)


def _filter_alone(
    detections: MapDetections, graph: LaneGraph, settings: VehicleSettings
) -> list[Motion]:
    """Return the vehicles that the filter follows as time runs, as it follows them."""
    (number, _), (state, _) = _as_time_runs(
        detections, graph, settings.forward, settings.detections.moving_mps
    )
    return [
        fit_motion(detections, rows, state, settings.motion)
        for rows in rows_by_number(number)
        if len(rows) >= settings.bodies.least_rows
    ]


@compiled
def _no_look_back(
    mean: Floats, kept: Floats, ahead: Floats, wide: Floats
) -> None:  # pragma: no cover - compiled
    """Leave filtered states as they are."""


def _swept_without(**none: Any) -> Any:
    """Return a maker of passes of which some parts hold nothing."""
    made = Passes.of
    return classmethod(lambda _, *given: replace(made(*given), **none))


SMOOTHING = {"motion:_look_back": _no_look_back}
COMPONENTS: Mapping[str, Off] = {
    "all but the filter as time runs": Off(
        replaced={**SMOOTHING, "hour_vehicles:vehicles_in": _filter_alone}
    ),
    "filter against time": Off(replaced={"tracker:follow_both_ways": _as_time_runs}),
    "smoothing over later detections": Off(replaced=SMOOTHING),
    "range rates in the smoothing": Off(settings={"motion.range_rate_mps": FAR}),
    "branches at forks": Off(replaced={"forward:FORK_M": -1.0}),
    "three detections for a birth": Off(settings={"forward.births": 1}),
    "way and returns of one that drove": Off(
        settings={"management.least_moving": 0, "management.least_way_m": -1.0}
    ),
    "heights of detections": Off(settings={"detections.low_m": -FAR, "detections.high_m": FAR}),
    "joining parts of one body": Off(settings={"bodies.least_odds": FAR}),
    "splitting parts that do not fit": Off(settings={"bodies.least_pure": 0.0}),
    "walkers and cyclists told apart": Off(
        replaced={"tracker:is_person": lambda _, motions, __: [False] * len(motions)}
    ),
    "lengths of vehicles": Off(replaced={"motion:size_of": lambda *_: (Size(), 0.0)}),
    "two parts of one tall lorry": Off(settings={"tall.most_odds": 0.0}),
    "standing on before and after moving": Off(
        replaced={"resting:_in_span": lambda *_: np.zeros(0, np.int64)}
    ),
    "what a place returns while empty": Off(replaced={"resting:_rate_without": lambda *_: 0.0}),
    "standing vehicles on lanes": Off(replaced={"track_management:find_stationary": lambda *_: []}),
    "those that never move": Off(replaced={"track_management:_stationary_only": lambda *_: None}),
    "order in the lane: driven over": Off(
        replaced={"passes:Passes.of": _swept_without(times={}, near_m=-1.0)}
    ),
    "order in the lane: room in a queue": Off(
        settings={"stationary.gap_m": 0.0, "stationary.easy_m": 0.0, "stationary.tight": 0.0}
    ),
    "order in the lane: standing as before": Off(settings={"stationary.stick": 0.0}),
    "built into the road": Off(replaced={"passes:Passes.of": _swept_without(fast={})}),
    "hanging above the road": Off(settings={"stationary.high_m": FAR}),
    "inside of the lane only": Off(settings={"stationary.inside_m": 0.0}),
    "standing as often seen as others": Off(settings={"stationary.rate_share": 0.0}),
    "standing as strong as others": Off(settings={"management.weaker_db": FAR}),
    "hidden by other vehicles": Off(
        replaced={
            "detectability:Occluders.join": classmethod(
                lambda cls, _: cls(
                    half=np.zeros(0, np.int64), owner=np.zeros(0, np.int64), shape=np.zeros((0, 5))
                )
            )
        }
    ),
    "detections that are due": Off(replaced={"detectability:Detectability.due": lambda *_: 0.0}),
    "due while silent: a track ends": Off(
        replaced={"track_management:_at_silences": lambda _, motion, *__: [motion]}
    ),
    "due between parts: no link": Off(replaced={"links:_is_missed": lambda *_: False}),
    "links": Off(settings={"links.end_cost": 0.0}),
    "links of who waits": Off(settings={"links.waiting_mps": -1.0}),
    "links of who drives unseen": Off(settings={"links.unseen_s": -FAR}),
    "duplicates: stationary targets": Off(
        replaced={"track_management:distinct_targets": lambda stands, *_: list(range(len(stands)))}
    ),
    "duplicates: tracks": Off(
        replaced={"tracker:without_duplicates": lambda motions, *_: list(motions)}
    ),
    "lane changes: drift across the lane": Off(settings={"forward.sideways_mps": 0.0}),
    "lane changes: between lanelets": Off(settings={"routes.change": FAR}),
    "likeliest lanelets": Off(settings={"routes.change": 0.0, "routes.off_lane": FAR}),
    "a second beyond either end": Off(settings={"batches.unseen_steps": 0}),
    SECOND: Off(sensors=1),
}


def ablate(
    site: SceneFiles, names: Sequence[str] = tuple(COMPONENTS)
) -> Iterator[tuple[str, Figures]]:
    """Yield the name of each component and the figures without it; first those of the whole.

    Parameters
    ----------
    site : SceneFiles
        A scene.
    names : sequence of str
        Of `COMPONENTS`.
    """
    read = _ReadOnce()
    truth = site.truth()
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        yield NOTHING, _found(site, Off(), read, whole, truth)
        for number, name in enumerate(names):
            off = COMPONENTS[name]
            if off.sensors is None:
                yield name, _found(site, off, read, Path(folder) / str(number), truth)
            elif off.sensors < len(site.recordings):
                tiles, sensors = site.tiles(), site.sensors()[: off.sensors]
                seen = true_occupancy(tiles, sensors, site.traffic())
                yield NOTHING_FIRST, _figures(site, whole, seen, off.sensors)
                yield name, _found(site, off, read, Path(folder) / str(number), seen)


def _found(
    site: SceneFiles, off: Off, read: _ReadOnce, folder: Path, truth: TrueOccupancy
) -> Figures:
    """Find vehicles without a component, into a folder; return the figures."""
    settings, count = changed(VehicleSettings(), off.settings), off.sensors
    with replaced({**off.replaced, "hour_vehicles:blocks_of": read.blocks_of}):
        begin = time.process_time()
        gr.measure(
            site.recordings[:count], site.poses[:count], site.tiles(), site.map, folder,
            scans=[site.scan], settings=gr.MeasureSettings(vehicles=settings),
        )  # fmt: skip
        cpu_s = time.process_time() - begin
    return _figures(site, folder, truth, count) | {"cpu_s": cpu_s}


def _figures(site: SceneFiles, folder: Path, truth: TrueOccupancy, count: int | None) -> Figures:
    """Return the figures of occupancy, vehicles and passages."""
    tiles, traffic = site.tiles(), site.traffic()
    found = found_in(gr.open_dataset(folder), truth)
    scored = compared(tiles, truth, site.poses[:count], traffic, found.states)
    vehicles = score_tracks(scored, traffic.kinds)
    del vehicles["by"]
    passed = found.passages
    passed = passed[passed["lanelet_id"].isin(site.lanelets_in_sight())]
    return {
        "occupancy": asdict(score_occupancy(truth, found.occupancy)),
        "vehicles": vehicles,
        "passages": score_passages(site.passages(), passed) if count is None else {},
    }


def changed(settings: VehicleSettings, values: Mapping[str, Any]) -> VehicleSettings:
    """Return settings with new values, by their places in it."""
    for place, value in values.items():
        room, name = place.split(".")
        inner = replace(getattr(settings, room), **{name: value})
        settings = replace(settings, **{room: inner})
    return settings


@contextmanager
def replaced(values: Mapping[str, Any]) -> Iterator[None]:
    """Replace functions and constants of the room's modules by others for a while.

    Compiled functions of the modules are compiled anew, where they stand on what is replaced.
    """
    old = {place: _owner(place)[0].__dict__[_owner(place)[1]] for place in values}
    try:
        _put(values)
        yield
    finally:
        _put(old)


def _owner(place: str) -> tuple[Any, str]:
    """Return the module or class that holds a name, and the name in it."""
    module, _, path = place.partition(":")
    *within, name = path.split(".")
    owner = import_module(ROOM + module)
    for each in within:
        owner = getattr(owner, each)
    return owner, name


def _put(values: Mapping[str, Any]) -> None:
    for place, value in values.items():
        owner, name = _owner(place)
        setattr(owner, name, value)
        module = import_module(ROOM + place.partition(":")[0])
        for each in vars(module).values():
            if isinstance(each, type(_no_look_back)):
                vars(each).pop("machine_code", None)


class _ReadOnce:
    """Blocks of detections, kept: reading them takes longer than anything else."""

    def __init__(self) -> None:
        self._kept: dict[Any, list[tuple[tuple[int, int], Block]]] = {}

    def blocks_of(
        self, sensors: Sequence[SensorHour], window: HourWindow, graph: LaneGraph,
        road_m: Mapping[tuple[str, str], float], settings: VehicleSettings,
    ) -> Iterator[tuple[tuple[int, int], Block]]:  # fmt: skip
        """Stand for the function of `hour_blocks`."""
        key = (tuple(each.sensor for each in sensors), window.hour, settings.detections)
        if key not in self._kept:
            self._kept[key] = list(blocks_of(sensors, window, graph, road_m, settings))
        yield from self._kept[key]
