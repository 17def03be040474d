"""Simulated places: streets with houses and traffic, a map, a scanned road, and sensors."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from pyproj import CRS

import gis_radar as gr
from gis_radar.base import Floats
from gis_radar.scans import read_roads
from simulation.demand import KINDS, VehicleKind, random_flows
from simulation.driving import LaneKeeping
from simulation.lanelet_writer import write_lanelets
from simulation.movement import Traffic
from simulation.network import RoadNetwork, build_network, read_network
from simulation.people import People, simulate_people
from simulation.radar import RadarModel, place_radar
from simulation.recording import frame_times, simulate_recording
from simulation.roadside import Roadside, furnish
from simulation.scan import fly, write_scan
from simulation.scene import Scene
from simulation.street_plans import NO_TURNS, StreetPlan
from simulation.terrain import Terrain
from simulation.traffic import simulate_traffic

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "bench-localization"
UTM = CRS.from_epsg(25832)
ORIGIN = (678_000.0, 5_403_600.0)
START = 1_780_300_800.0  # UNIX seconds
WINDOW_S = 100.0  # 2000 frames at 20 Hz


@dataclass(frozen=True, kw_only=True)
class TrafficSettings:
    """Settings of simulated traffic.

    Parameters
    ----------
    per_hour : float
        Vehicles an hour, sum of all entries.
    kinds : tuple of VehicleKind
        Kinds of vehicles with their shares.
    keeping : LaneKeeping
        How drivers keep their lanes.
    people : People
        Walkers and cyclists.
    """

    per_hour: float = 1800.0
    kinds: tuple[VehicleKind, ...] = KINDS
    keeping: LaneKeeping = field(default_factory=LaneKeeping)
    people: People = field(default_factory=People)


@dataclass(frozen=True, kw_only=True)
class Place:
    """Streets with traffic.

    Parameters
    ----------
    network : RoadNetwork
        The lanes, in the map frame.
    scene : Scene
        The surroundings.
    traffic : Traffic
        The road users.
    """

    network: RoadNetwork
    scene: Scene
    traffic: Traffic

    def record(
        self, pose: gr.Pose, *, seed: int, model: RadarModel, begin_s: float = 0.0,
        duration_s: float = WINDOW_S,
    ) -> pd.DataFrame:  # fmt: skip
        """Return the recording of a radar, from `begin_s` after the traffic's begin."""
        stand, times, noise = np.random.default_rng([seed, 2]).spawn(3)
        radar = place_radar(pose, self.scene, rng=stand, model=model)
        moments = frame_times(
            START + begin_s, duration_s, rng=times, cycle_s=model.cycle_s, jitter_s=model.jitter_s
        )
        return simulate_recording(radar, self.traffic, moments, rng=noise)

    def write_truth(self, folder: Path) -> None:
        """Write `vehicles.parquet`: place, size and kind of every road user at every 50 ms."""
        write_moving(self.traffic.table(self.scene.terrain), folder / "vehicles.parquet")

    def write_ground(self, folder: Path, *, seed: int) -> None:
        """Write `map.osm`, and `road.npy`: the road in half-metre cells, masked from a scan."""
        write_lanelets(self.network, folder / "map.osm", terrain=self.scene.terrain, crs=UTM)
        scan = fly(self.scene, rng=np.random.default_rng([seed, 3]))
        with tempfile.TemporaryDirectory() as scratch:
            write_scan(scan, Path(scratch) / "scan.laz", crs=UTM, flown=date(2026, 3, 14))
            roads = read_roads(folder / "map.osm")
            mask = gr.mask_road([Path(scratch) / "scan.laz"], roads, engine="laspy")
        np.save(folder / "road.npy", mask.points)


def make_place(
    plan: StreetPlan, *, seed: int, terrain: Terrain, settings: TrafficSettings, duration_s: float,
    roadside: Roadside | None = None, warm_up_s: float = 120.0,
) -> Place:  # fmt: skip
    """Return a place of a street plan: SUMO's network, surroundings and traffic."""
    with tempfile.TemporaryDirectory() as folder:
        net = Path(folder) / "streets.net.xml"
        build_network(plan.nodes_xml, plan.edges_xml, NO_TURNS, net)
        network = read_network(net, origin=ORIGIN)
        flows, furniture = np.random.default_rng([seed, 4]).spawn(2)
        traffic = simulate_traffic(
            net,
            network,
            flows=random_flows(network, per_hour=settings.per_hour, rng=flows),
            kinds=settings.kinds,
            start=START,
            duration_s=duration_s,
            warm_up_s=warm_up_s,
            seed=seed,
            keeping=settings.keeping,
        )
    scene = furnish(network, terrain, rng=furniture, roadside=roadside)
    traffic = traffic.joined(
        simulate_people(network, scene.road, traffic, settings.people, seed=seed)
    )
    return Place(network=network, scene=scene, traffic=traffic)


def write_moving(recording: pd.DataFrame, path: Path) -> None:
    """Write a table as Parquet that is fast to write; such files are many and temporary."""
    recording.to_parquet(path, index=False, compression="snappy")


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Map and road of a place, read from its files."""

    roads: gr.LaneletMap
    road: Floats


def read_ground(folder: Path) -> Ground:
    """Read the files of :meth:`Place.write_ground`."""
    return Ground(roads=gr.read_map(folder / "map.osm"), road=np.load(folder / "road.npy"))


def up_to_date(folder: Path, make: Callable[[], None], *modules: str, settings: str = "") -> Path:
    """Return a folder, made again where simulator, `modules` beside this one, or settings changed.

    `made.txt` in it has the digest of what it was made by.
    """
    code = [Path(__file__).parent / f"{name}.py" for name in modules]
    code += sorted((ROOT / "simulation").glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in code)).hexdigest()
    recipe = f"{digest} {settings}".strip()
    stamp = folder / "made.txt"
    if not (stamp.exists() and stamp.read_text() == recipe):
        folder.mkdir(parents=True, exist_ok=True)
        stamp.unlink(missing_ok=True)
        make()
        stamp.write_text(recipe)
    return folder


def link(source: Path, target: Path) -> None:
    """Make `target` a symbolic link to a file."""
    target.unlink(missing_ok=True)
    target.symlink_to(source.resolve())


def errors(found: gr.Pose, true: gr.Pose) -> Floats:
    """Return east, north, height (m) and roll, pitch, yaw (degrees): found minus true."""
    turns = [getattr(found, a) - getattr(true, a) for a in ("roll", "pitch", "yaw")]
    wrapped = (np.array(turns) + 180.0) % 360.0 - 180.0
    return np.concatenate([found.position - true.position, wrapped])


def disc_offsets(rng: np.random.Generator, count: int, within_m: float) -> Floats:
    """Draw offsets spread evenly over a disc, (n, 2) metres."""
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    reach = within_m * np.sqrt(rng.random(count))
    return np.column_stack([reach * np.cos(turn), reach * np.sin(turn)])


def vary_kinds(kinds: Sequence[VehicleKind], rng: np.random.Generator) -> tuple[VehicleKind, ...]:
    """Return the kinds with randomly changed shares, and sizes changed by up to 6 %."""
    made = []
    for kind in kinds:
        length, width, height = 1.0 + rng.uniform(-0.06, 0.06, 3)
        made.append(
            VehicleKind(
                name=kind.name,
                sumo_class=kind.sumo_class,
                length_m=round(kind.length_m * float(length), 2),
                width_m=round(kind.width_m * float(width), 2),
                height_m=round(kind.height_m * float(height), 2),
                share=round(kind.share * float(np.exp(rng.normal(0.0, 0.5))), 4),
                parts_m=tuple((a * float(length), b * float(length)) for a, b in kind.parts_m),
            )
        )
    return tuple(made)
