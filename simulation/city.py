"""Sites of a simulated city, each with map, scan, radars and recordings.

The recordings of a site are short: a few minutes at each of some levels of demand, in different
hours.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from gis_radar.base import atomic_write
from gis_radar.poses import Pose, PoseTrack, View
from simulation.city_plan import ORIGIN, Crossing, plan_city
from simulation.demand import ALL_KINDS, random_flows
from simulation.lanelet_writer import write_lanelets
from simulation.movement import Traffic
from simulation.network import RoadNetwork, build_network, read_network
from simulation.presets import AS_RECORDED, DRIVERS_AS_RECORDED
from simulation.radar import place_radar
from simulation.recording import frame_times, simulate_recording, write_recording
from simulation.roadside import furnish, roadside_stand
from simulation.scan import fly, write_scan
from simulation.scene import Scene
from simulation.street_plans import NO_TURNS
from simulation.terrain import Terrain
from simulation.traffic import simulate_traffic

CITY = "Simstadt"
TIMEZONE = "Europe/Berlin"
UTM = CRS.from_epsg(25832)
TERRAIN = Terrain(
    origin=ORIGIN, height_m=374.0, slope=(0.006, 0.009), wave_m=0.5, wave_length_m=310.0
)
MEASURED_DAY = datetime(2026, 11, 2, tzinfo=UTC)  # a Monday
KNOCKED_AT = datetime(2026, 10, 19, 4, 20, tzinfo=UTC)  # a radar is turned by a knock
KNOCKED_DEG = 4.0  # change of its yaw
_BUSY_PER_HOUR = {True: 2000.0, False: 1200.0}  # vehicles, with and without a main street
_RADARS = (1, 1, 2, 1, 2)  # numbers of radars at the first sites, where events happen
_RADAR_SHARES = {1: 0.45, 2: 0.4, 3: 0.15}  # shares of the other sites by number of radars

SITE = """\
title = "{title}"
timezone = "{timezone}"
attribution = ["Simulated, nothing of it was recorded"]

[map]
file = "map.osm"
crs = "EPSG:25832"

[scan]
files = ["scan.laz"]
engine = "laspy"
"""
SENSOR = """
[[sensor]]
name = "{name}"
recordings = ["{name}_*.parquet"]
pose = "{pose}"
"""


@dataclass(frozen=True, kw_only=True)
class Level:
    """A level of demand that is recorded.

    Parameters
    ----------
    name : str
        Its name.
    demand : float
        Vehicles an hour as a share of those of a busy hour.
    hour : int
        Hour of the measured day, UTC.
    warm_up_s : float
        Time for which traffic builds up before.
    blocked : bool
        Whether cars have broken down on the way out of the crossing.
    """

    name: str
    demand: float
    hour: int
    warm_up_s: float = 120.0
    blocked: bool = False

    @property
    def begin(self) -> float:
        """Begin of its recordings, UNIX seconds."""
        return MEASURED_DAY.replace(hour=self.hour).timestamp()


LEVELS = (
    Level(name="light", demand=0.06, hour=3),
    Level(name="usual", demand=0.5, hour=10),
    Level(name="busy", demand=1.0, hour=16),
)
JAM = Level(name="jam", demand=1.01, hour=13, warm_up_s=200.0, blocked=True)


@dataclass(frozen=True, kw_only=True)
class CitySite:
    """Files of a site of the city.

    Parameters
    ----------
    crossing : Crossing
        The crossing.
    folder : Path
        Folder of the files.
    levels : tuple of Level
        Levels of demand that are recorded.
    sensors : tuple of str
        Names of the radars.
    knocked : str
        Name of the radar that is turned by a knock; empty: none.
    """

    crossing: Crossing
    folder: Path
    levels: tuple[Level, ...]
    sensors: tuple[str, ...]
    knocked: str = ""

    @property
    def name(self) -> str:
        """Name of the site."""
        return self.crossing.name

    @property
    def site_file(self) -> Path:
        """Its `SITE.toml`."""
        return self.folder / "SITE.toml"

    def recording(self, sensor: str, level: Level) -> Path:
        """Return the recording of a radar at a level of demand."""
        return self.folder / f"{sensor}_{level.name}.parquet"

    def pose_file(self, sensor: str) -> Path:
        """Return the pose of a radar, a pose track where it was knocked."""
        return self.folder / (f"{sensor}.csv" if sensor == self.knocked else f"{sensor}.json")


def city_sites(folder: Path, sites: int, *, seed: int = 1) -> list[CitySite]:
    """Return the sites of a city, without files; the first has a jam, the third a knocked radar."""
    rng = np.random.default_rng([seed, 2])
    counts, shares = [*_RADAR_SHARES], [*_RADAR_SHARES.values()]
    found = []
    for k, crossing in enumerate(plan_city(sites, seed=seed)):
        drawn = int(rng.choice(counts, p=shares))
        radars = _RADARS[k] if k < len(_RADARS) else drawn
        found.append(
            CitySite(
                crossing=crossing, folder=folder / "sites" / crossing.name,
                levels=(*LEVELS, JAM) if k == 0 else LEVELS,
                sensors=tuple(f"R{n}" for n in range(1, radars + 1)),
                knocked="R1" if k == 2 else "",
            )
        )  # fmt: skip
    return found


def write_city_file(folder: Path, sites: Sequence[CitySite]) -> Path:
    """Write `CITY.toml`, which names the sites."""
    lines = [f'title = "{CITY}"', f'timezone = "{TIMEZONE}"']
    for site in sites:
        place = site.site_file.relative_to(folder).as_posix()
        lines += ["", "[[site]]", f'name = "{site.name}"', f'file = "{place}"']
    path = folder / "CITY.toml"
    with atomic_write(path) as part:
        part.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def make_site(site: CitySite, *, minutes: float, seed: int) -> None:
    """Write the files of a site; `SITE.toml` comes last.

    Parameters
    ----------
    site : CitySite
        The site.
    minutes : float
        Length of each recording.
    seed : int
        Seed of traffic, surroundings and radars.
    """
    site.folder.mkdir(parents=True, exist_ok=True)
    plan, names = site.crossing.plan()
    furniture, masts, flight = np.random.default_rng([seed, 4]).spawn(3)
    with tempfile.TemporaryDirectory() as scratch:
        net = Path(scratch) / "streets.net.xml"
        build_network(plan.nodes_xml, plan.edges_xml, NO_TURNS, net)
        network = read_network(net, origin=site.crossing.place)
        traffics = [
            _traffic(net, network, site, level, minutes=minutes, seed=seed) for level in site.levels
        ]
    scene = furnish(network, TERRAIN, rng=furniture)
    write_lanelets(network, site.folder / "map.osm", terrain=TERRAIN, crs=UTM, streets=names)
    scan = fly(scene, rng=flight)
    write_scan(scan, site.folder / "scan.laz", crs=UTM, flown=date(2026, 3, 14))
    tables = ""
    for number, sensor in enumerate(site.sensors):
        pose = _mast(sensor, number / len(site.sensors), site, scene, masts)
        _write_pose(pose, site)
        for level, traffic in zip(site.levels, traffics, strict=True):
            stand, times, noise = np.random.default_rng([seed, number, level.hour]).spawn(3)
            radar = place_radar(pose, scene, rng=stand, model=AS_RECORDED)
            moments = frame_times(
                level.begin, minutes * 60.0, rng=times, cycle_s=AS_RECORDED.cycle_s,
                jitter_s=AS_RECORDED.jitter_s,
            )  # fmt: skip
            recorded = simulate_recording(radar, traffic, moments, rng=noise)
            write_recording(recorded, site.recording(sensor, level))
        tables += SENSOR.format(name=sensor, pose=site.pose_file(sensor).name)
    text = SITE.format(title=site.crossing.title, timezone=TIMEZONE) + tables
    with atomic_write(site.site_file) as part:
        part.write_text(text, encoding="utf-8")


def _traffic(
    net: Path, network: RoadNetwork, site: CitySite, level: Level, *, minutes: float, seed: int
) -> Traffic:
    """Return the traffic of a level of demand; the shares of its flows are the same at each."""
    rng = np.random.default_rng([seed, 5])
    busy = _BUSY_PER_HOUR[any(street.main for street in site.crossing.streets)]
    exits = network.sinks()[:1] if level.blocked else ()
    return simulate_traffic(
        net, network, flows=random_flows(network, per_hour=busy * level.demand, rng=rng),
        kinds=ALL_KINDS, start=level.begin, duration_s=minutes * 60.0, warm_up_s=level.warm_up_s,
        seed=seed + level.hour, keeping=DRIVERS_AS_RECORDED, blocked=exits,
    )  # fmt: skip


def _mast(sensor: str, turn: float, site: CitySite, scene: Scene, rng: np.random.Generator) -> Pose:
    """Return the pose of a radar beside a kerb that looks at the crossing."""
    place = roadside_stand(
        scene, site.crossing.place, rng, within_m=(14.0, 40.0),
        turns_rad=(2.0 * np.pi * turn, 2.0 * np.pi * (turn + 0.25)),
    )  # fmt: skip
    east, north = site.crossing.place - place
    yaw = float(np.degrees(np.arctan2(north, east))) + float(rng.normal(0.0, 15.0))
    fields: dict[str, Any] = {
        "easting": float(place[0]), "northing": float(place[1]),
        "height": float(TERRAIN.height(place)) + float(rng.uniform(5.0, 8.0)),
        "yaw": (yaw + 180.0) % 360.0 - 180.0, "pitch": float(rng.uniform(1.0, 5.0)),
        "roll": float(rng.normal(0.0, 1.5)),
    }  # fmt: skip
    fields = {name: round(value, 3) for name, value in fields.items()}
    return Pose(sensor=sensor, crs=UTM, view=View(max_range_m=200.0), **fields)


def _write_pose(pose: Pose, site: CitySite) -> None:
    """Write the true pose; of a knocked radar a pose track with that before, too."""
    if pose.sensor != site.knocked:
        pose.write(site.pose_file(pose.sensor))
        return
    before = replace(pose, yaw=round((pose.yaw - KNOCKED_DEG + 180.0) % 360.0 - 180.0, 3))
    since = np.array([datetime(2026, 8, 1, tzinfo=UTC).timestamp(), KNOCKED_AT.timestamp()])
    moved = replace(pose, evidence={"event": "moved"})
    PoseTrack(poses=(before, moved), since=since).write(site.pose_file(pose.sensor))
