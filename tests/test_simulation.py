"""The simulator: geometry, sight, scatterers, frames, scans, maps, each against a plain truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import shapely
from pyproj import CRS

from gis_radar.poses import Pose, View
from simulation import sumo
from simulation.demand import KINDS, random_flows
from simulation.movement import Traffic, Vehicles
from simulation.network import read_network
from simulation.radar import Radar, RadarModel, place_radar
from simulation.recording import COLUMNS, frame_times, simulate_recording, write_recording
from simulation.roadside import furnish
from simulation.scatterers import vehicle_scatterers
from simulation.scene import Building, ParkedCar, Post, Scene, Tree
from simulation.terrain import Terrain
from simulation.traffic import simulate_traffic

UTM = CRS.from_epsg(25832)
ORIGIN = np.array([600_000.0, 5_400_000.0])
TERRAIN = Terrain(origin=(600_000.0, 5_400_000.0), height_m=100.0, slope=(0.01, -0.01))
MODEL = RadarModel(
    static_per_frame=120.0, false_alarms=0.0, false_doppler_share=0.0, ghost_share=0.0
)
EYE = np.array([600_000.0, 5_400_000.0, 106.0])


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def vehicles(*rows: tuple[float, float, float, float], size=(4.5, 1.8, 1.5)) -> Vehicles:
    """Vehicles as rows of (east, north, heading in degrees, speed) about the origin."""
    table = np.array(rows, dtype=np.float64)
    return Vehicles(
        time=0.0,
        number=np.arange(len(table)),
        kind=np.full(len(table), "car"),
        centre=table[:, :2] + ORIGIN,
        heading=np.radians(table[:, 2]),
        speed=table[:, 3],
        yaw_rate=np.zeros(len(table)),
        size=np.tile(size, (len(table), 1)).astype(np.float64),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A straight road to the east with a house, a tree, a post and a parked car."""
    road = shapely.box(*(ORIGIN + (-20, -6)), *(ORIGIN + (150, 6)))
    house = np.array([(40, 12), (60, 12), (60, 22), (40, 22)]) + ORIGIN
    return Scene(
        terrain=TERRAIN,
        road=road,
        buildings=(Building(outline=house, height_m=8.0),),
        trees=(Tree(place=tuple(ORIGIN + (30, -8)), crown_m=3.0, crown_height_m=6.0),),
        cars=(ParkedCar(place=tuple(ORIGIN + (25, 8)), heading_rad=0.0),),
        posts=(Post(place=tuple(ORIGIN + (35, 8)), height_m=4.0),),
    )


@pytest.fixture(scope="module")
def radar(scene: Scene) -> Radar:
    pose = Pose(
        sensor="R", crs=UTM, easting=EYE[0], northing=EYE[1], height=EYE[2],
        yaw=10.0, pitch=4.0, roll=1.0, view=View(max_range_m=150.0),
    )  # fmt: skip
    return place_radar(pose, scene, rng=rng(1), model=MODEL)


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    """Two cars: one drives off to the east at 10 m/s, one stands."""
    steps = 101
    centre = np.empty((steps, 2, 2))
    centre[:, 0] = ORIGIN + np.column_stack([40 + 0.5 * np.arange(steps), np.full(steps, -2.0)])
    centre[:, 1] = ORIGIN + (30.0, 2.0)
    speed = np.tile([10.0, 0.0], (steps, 1))
    still = np.zeros((steps, 2))
    return Traffic(
        start=1000.0, centre=centre, heading=still, speed=speed, yaw_rate=still,
        size=np.array([[4.5, 1.8, 1.5]] * 2), kind=("car", "car"),
    )  # fmt: skip


# curves


# sight


# scatterers


def test_range_rate_is_positive_when_receding_and_zero_when_standing(scene):
    there = vehicles((40.0, 0.0, 0.0, 8.0), (40.0, 3.0, 180.0, 8.0), (40.0, -3.0, 0.0, 0.0))
    scatterers = vehicle_scatterers(there, scene, EYE, density=60.0, rng=rng())
    rate = scatterers.range_rate(EYE)
    assert np.median(rate[scatterers.owner == 0]) == pytest.approx(8.0, abs=0.2)
    assert np.median(rate[scatterers.owner == 1]) == pytest.approx(-8.0, abs=0.2)
    assert np.abs(rate[scatterers.owner == 2]).max() == 0.0


# frames


def test_detections_of_a_car_lie_on_it_and_tell_its_range_rate(radar, traffic):
    noise = rng(3)
    close, rates = [], []
    for time in np.arange(1000.0, 1003.0, 0.05):
        frame = radar.frame(traffic.at(time), noise)
        place = radar.pose.to_map(frame[:, :3])[:, :2]
        car = traffic.at(time).centre[0]
        off = np.abs(place - car)
        moving = frame[:, 3] > 5.0
        close.append(((off[:, 0] < 3.0) & (off[:, 1] < 1.6))[moving])
        rates.append(frame[moving, 3])
    assert np.concatenate(close).mean() > 0.8
    assert np.median(np.concatenate(rates)) == pytest.approx(10.0, abs=0.2)


def test_a_recording_keeps_the_contract_and_the_seed(radar, traffic, tmp_path):
    times = frame_times(1000.0, 2.0, rng=rng())
    first, again = (
        simulate_recording(radar, traffic, times, rng=rng(7), blank_frames=2) for _ in range(2)
    )
    pd.testing.assert_frame_equal(first, again)
    assert list(first.columns) == ["time", *COLUMNS]
    assert first["time"].dtype == np.float64
    assert (first.dtypes[list(COLUMNS)] == np.float32).all()
    assert first["time"].is_monotonic_increasing
    assert first["time"].nunique() == len(times)
    blank = first[first["x"].isna()]
    assert len(blank) == 2
    assert blank[list(COLUMNS)].isna().all().all()
    assert (first.groupby("time").size()[blank["time"]] == 1).all()
    write_recording(first, tmp_path / "r.parquet")
    read = pq.read_table(tmp_path / "r.parquet", page_checksum_verification=True).to_pandas()
    pd.testing.assert_frame_equal(read, first)


# scan


# maps and networks


@pytest.mark.usefixtures("sumo_installed")
def test_any_network_can_be_driven_and_watched(tmp_path: Path):
    net = tmp_path / "grid.net.xml"
    sumo.run(
        "netgenerate",
        [
            "--grid", "--grid.number=2", "--grid.length=90", "--grid.attach-length=70",
            "-L2",
            "--default-junction-type=traffic_light", "--no-turnarounds=true",
            "--seed=4", f"-o={net}",
        ],
    )  # fmt: skip
    town = read_network(net, origin=(600_000.0, 5_400_000.0))
    assert len(town.sources()) == len(town.sinks()) == 8
    for band in town.bands.values():
        width = np.hypot(*(band.left - band.right).T)
        assert width.min() > 1.0
        assert width.max() < 5.0
    runs = [
        simulate_traffic(
            net, town, flows=random_flows(town, per_hour=1500.0, rng=rng(1)), kinds=KINDS,
            start=1000.0, duration_s=10.0, warm_up_s=60.0, seed=5,
        )
        for _ in range(2)
    ]  # fmt: skip
    assert np.array_equal(runs[0].centre, runs[1].centre, equal_nan=True)
    drive = runs[0]
    assert drive.centre.shape[1] > 10
    moved = np.hypot(*np.moveaxis(np.diff(drive.centre, axis=0), -1, 0)) / 0.05
    assert np.nanmax(np.abs(moved - drive.speed[1:])) < 3.0
    road = shapely.union_all(
        [shapely.Polygon(np.vstack([b.left, b.right[::-1]])) for b in town.bands.values()]
    ).buffer(1.0)
    places = drive.centre[np.isfinite(drive.speed)]
    inside = shapely.contains_xy(road, places[:, 0], places[:, 1])
    assert inside.mean() > 0.97  # the rest has its rear still outside the map
    spot = town.turns[next(iter(town.turns))].centre[0] + (6.0, 6.0)
    pose = Pose(
        sensor="X", crs=UTM, easting=spot[0], northing=spot[1],
        height=float(TERRAIN.height(spot)) + 6.0, yaw=45.0, pitch=3.0, roll=0.0,
    )  # fmt: skip
    watcher = place_radar(pose, furnish(town, TERRAIN, rng=rng(2)), rng=rng(3))
    recording = simulate_recording(watcher, drive, np.array([1001.0, 1001.05]), rng=rng(4))
    assert recording["time"].nunique() == 2
