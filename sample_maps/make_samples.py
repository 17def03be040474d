"""Make the sample site: one signalised junction, its map, scan, recordings and true traffic.

Example: ``python sample_maps/make_samples.py`` (needs Eclipse SUMO: pip install eclipse-sumo).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
import street_plan
from pyproj import CRS

from gis_radar.poses import Pose, View
from simulation.curves import arc_length, points_at
from simulation.demand import KINDS, LONG_KINDS, Flow
from simulation.lanelet_writer import Crosswalk, write_lanelets
from simulation.movement import Traffic
from simulation.network import RoadNetwork, build_network, read_network
from simulation.people import People, simulate_people
from simulation.presets import RADARS
from simulation.radar import place_radar
from simulation.recording import frame_times, simulate_recording, write_packed, write_recording
from simulation.roadside import furnish
from simulation.scan import fly, write_scan
from simulation.scene import ParkedCar, Rail, Scene
from simulation.terrain import Terrain
from simulation.traffic import simulate_traffic

HERE = Path(__file__).parent
CRS_OF_SITE = CRS.from_epsg(25832)
ORIGIN = (690_400.0, 5_336_200.0)
START = 1_749_713_400.0  # 2025-06-12T07:30:00Z
DURATION_S = 100.0
CYCLE_S = 56
SEED = 20250612
TRAFFIC_SEED = 3
TERRAIN = Terrain(
    origin=ORIGIN, height_m=515.0, slope=(0.012, -0.008), wave_m=0.4, wave_length_m=260.0
)
VIEW = View(azimuth_deg=120.0, elevation_deg=30.0, min_range_m=1.0, max_range_m=200.0)

# vehicles an hour from arm to arm; the right turn from the south is the busy one
PER_HOUR = {
    "WE": 560, "WN": 170, "WS": 110, "EW": 560, "ES": 200, "EN": 120,
    "SE": 520, "SN": 110, "SW": 70, "NS": 120, "NE": 110, "NW": 80,
}  # fmt: skip


# of trucks those with a trailer
DRIVEN = (
    *(kind for kind in KINDS if kind.name != "truck"),
    *(kind for kind in LONG_KINDS if kind.name == "articulated"),
)
PEOPLE = People(walkers=12, cyclists=4, crossing=0.5, reach_m=60.0)


@dataclass(frozen=True, kw_only=True)
class Mast:
    """Where a radar stands on the plan, and how its frames come.

    Parameters
    ----------
    sensor, arm : str
        Its name, and the arm it stands at.
    from_middle_m, lateral_m, over_m : float
        Along the arm, beside its axis, and over the ground.
    yaw, pitch, roll : float
        Degrees, as in a pose.
    radar : str
        A preset's name.
    begins_s, dropped, doubled : float
        Its frames.
    blank_frames : int
        Frames without a detection.
    """

    sensor: str
    arm: str
    from_middle_m: float
    lateral_m: float
    over_m: float
    yaw: float
    pitch: float
    roll: float
    radar: str
    begins_s: float
    dropped: float
    doubled: float
    blank_frames: int

    def pose(self) -> Pose:
        """Return the true pose."""
        arm = street_plan.ARMS[self.arm]
        place = arm.along(0.0, self.from_middle_m, self.lateral_m)[-1] + ORIGIN
        east, north = (round(float(v), 3) for v in place)
        return Pose(
            sensor=self.sensor,
            crs=CRS_OF_SITE,
            easting=east,
            northing=north,
            height=round(float(TERRAIN.height(np.array([east, north]))) + self.over_m, 3),
            yaw=self.yaw,
            pitch=self.pitch,
            roll=self.roll,
            view=VIEW,
        )


MASTS = (
    Mast(
        sensor="R1", arm="W", from_middle_m=44.0, lateral_m=11.6, over_m=5.6,
        yaw=21.7, pitch=3.2, roll=-0.8,
        radar="as recorded", begins_s=0.0, dropped=0.0, doubled=0.0, blank_frames=1,
    ),
    Mast(
        sensor="R2", arm="N", from_middle_m=38.0, lateral_m=9.2, over_m=6.3,
        yaw=-66.4, pitch=2.6, roll=1.1,
        radar="as recorded, side", begins_s=0.017, dropped=0.01, doubled=0.01, blank_frames=2,
    ),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Site:
    """The simulated place and its traffic.

    Parameters
    ----------
    network : RoadNetwork
        Its lanes.
    scene : Scene
        What stands there.
    traffic : Traffic
        What drives there.
    """

    network: RoadNetwork
    scene: Scene
    traffic: Traffic


def make_site(duration_s: float = DURATION_S) -> Site:
    """Return the sample site with its traffic of the first `duration_s` seconds."""
    with tempfile.TemporaryDirectory() as folder:
        net = Path(folder) / "junction.net.xml"
        build_network(
            street_plan.nodes_xml(),
            street_plan.edges_xml(),
            street_plan.connections_xml(),
            net,
            cycle_s=CYCLE_S,
        )
        network = read_network(net, origin=ORIGIN)
        traffic = simulate_traffic(
            net,
            network,
            flows=[
                Flow(source=f"{pair[0]}_far", sink=f"{pair[1]}_out", per_hour=rate)
                for pair, rate in PER_HOUR.items()
            ],
            kinds=DRIVEN,
            start=START,
            duration_s=duration_s,
            seed=TRAFFIC_SEED,
        )
    bend = street_plan.ARMS["S"].along(95.0, 165.0, 4.2) + ORIGIN
    scene = furnish(network, TERRAIN, rng=np.random.default_rng(SEED), rails=(Rail(line=bend),))
    people = simulate_people(network, scene.road, traffic, PEOPLE, seed=SEED)
    traffic = traffic.joined(people)
    return Site(network=network, scene=scene, traffic=traffic)


def crosswalks() -> tuple[Crosswalk, ...]:
    """Return the crossings of the southern and the western arm."""
    south, west = street_plan.ARMS["S"], street_plan.ARMS["W"]
    walks = ((south, 14.0, 17.5, -5.0, 8.0), (west, 12.5, 16.0, -10.0, 9.8))
    return tuple(
        Crosswalk(
            left=np.array([arm.along(0.0, near, side)[-1] for side in (right, left)]) + ORIGIN,
            right=np.array([arm.along(0.0, far, side)[-1] for side in (right, left)]) + ORIGIN,
        )
        for arm, near, far, right, left in walks
    )


def scanned_scene(site: Site) -> Scene:
    """Return the scene on the day of the scan, when a few cars waited at the lights."""
    waiting = []
    for lane, count in (("E_near_0", 4), ("S_near_0", 3), ("W_near_2", 2)):
        centre = site.network.lanes[lane].centre
        s = arc_length(centre)[-1] - 3.5 - 7.0 * np.arange(count)
        here, ahead = points_at(centre, s), points_at(centre, s + 1.0)
        for place, way in zip(here, ahead - here, strict=True):
            heading = float(np.arctan2(way[1], way[0]))
            waiting.append(ParkedCar(place=(float(place[0]), float(place[1])), heading_rad=heading))
    return replace(site.scene, cars=(*site.scene.cars, *waiting))


def write_recordings(site: Site, folder: Path, duration_s: float) -> None:
    """Write what each radar records, and its true pose."""
    for number, mast in enumerate(MASTS):
        place, times, noise = np.random.default_rng([SEED, number]).spawn(3)
        model = RADARS[mast.radar]
        radar = place_radar(mast.pose(), site.scene, rng=place, model=model)
        moments = frame_times(
            START + mast.begins_s,
            duration_s - mast.begins_s,
            rng=times,
            cycle_s=model.cycle_s,
            jitter_s=model.jitter_s,
            dropped=mast.dropped,
            doubled=mast.doubled,
        )
        recording = simulate_recording(
            radar, site.traffic, moments, rng=noise, blank_frames=mast.blank_frames
        )
        write_recording(recording, folder / f"{mast.sensor}.parquet")
        mast.pose().write(folder / f"{mast.sensor}.json")


def make_samples(folder: Path, duration_s: float = DURATION_S) -> None:
    """Write all files of the sample site into a folder."""
    site = make_site(duration_s)
    write_lanelets(
        site.network,
        folder / "junction.osm",
        terrain=TERRAIN,
        crs=CRS_OF_SITE,
        crosswalks=crosswalks(),
    )
    scan = fly(scanned_scene(site), rng=np.random.default_rng([SEED, 99]))
    write_scan(scan, folder / "scan.laz", crs=CRS_OF_SITE, flown=date(2024, 3, 14))
    write_recordings(site, folder, duration_s)
    write_packed(
        site.traffic.table(TERRAIN), folder / "vehicles.parquet", repeated=("t", "id", "kind")
    )


def main() -> None:
    """Make the samples and say how large they are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=HERE, help="folder")
    parser.add_argument("--duration", type=float, default=DURATION_S, help="seconds")
    options = parser.parse_args()
    make_samples(options.output, options.duration)
    for path in sorted(options.output.iterdir()):
        print(f"{path.stat().st_size / 1e6:8.3f} MB  {path.name}")


if __name__ == "__main__":
    main()
