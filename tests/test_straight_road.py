"""A straight road that the sensor looks along: the place along it must not be claimed."""

import contextlib

import numpy as np
import pytest
from pyproj import CRS

import gis_radar as gr
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.single.icp import pose_information, voxels
from gis_radar.calibration.single.moving import read_moving
from simulation.lanelet_writer import write_lanelets
from simulation.network import Lane, RoadNetwork
from simulation.radar import RadarModel, place_radar
from simulation.recording import frame_times, simulate_recording
from simulation.scene import Scene, road_surface
from simulation.terrain import Terrain
from simulation.traffic import Traffic

UTM = CRS.from_epsg(25832)
MIDDLE = np.array([678_000.0, 5_403_600.0])
HEADING = np.radians(27.0)
ALONG = np.array([np.cos(HEADING), np.sin(HEADING)])
ACROSS = np.array([-ALONG[1], ALONG[0]])
HALF_M, WIDTH_M, STEPS = 420.0, 3.25, 1001
START = 1_780_300_800.0
TERRAIN = Terrain(origin=(678_000.0, 5_403_600.0), height_m=370.0)


def straight(name, aside_m, way):
    """A lane of the whole length, `aside_m` to the left of the axis, driven along it or back."""
    s = np.linspace(-HALF_M, HALF_M, 211)[:: int(way), None] * ALONG
    centre = MIDDLE + s + aside_m * ACROSS
    left = way * ACROSS * WIDTH_M / 2
    return Lane(
        id=f"{name}_0", edge=name, index=0, centre=centre, left=centre + left,
        right=centre - left, speed_limit=13.89,
    )  # fmt: skip


def traffic(lanes, rng):
    """Cars that pass at speeds of their own, each a little beside the middle of its lane."""
    time = np.arange(STEPS) * 0.05
    centre, heading, speed, size = [], [], [], []
    for lane in lanes:
        way = (lane.centre[-1] - lane.centre[0]) / (2 * HALF_M)
        for begin in np.arange(-700.0, 2 * HALF_M, 38.0):
            pace = rng.uniform(10.0, 14.0)
            s = begin + rng.uniform(0.0, 12.0) + pace * time
            beside = rng.normal(0.0, 0.15) * np.array([-way[1], way[0]])
            there = (s > 0.0) & (s < 2 * HALF_M)
            place = lane.centre[0] + s[:, None] * way + beside
            centre.append(np.where(there[:, None], place, np.nan))
            heading.append(np.full(STEPS, np.arctan2(way[1], way[0])))
            speed.append(np.where(there, pace, np.nan))
            size.append((rng.uniform(3.9, 4.8), rng.uniform(1.7, 1.9), rng.uniform(1.45, 1.7)))
    return Traffic(
        start=START,
        centre=np.stack(centre, axis=1),
        heading=np.stack(heading, axis=1),
        speed=np.stack(speed, axis=1),
        yaw_rate=np.zeros((STEPS, len(size))),
        size=np.array(size),
        kind=("car",) * len(size),
    )


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """The map, the road's points, the true pose, and the recording of a sensor beside the road."""
    folder = tmp_path_factory.mktemp("straight")
    rng = np.random.default_rng(5)
    lanes = [straight("out", -WIDTH_M / 2, 1.0), straight("back", WIDTH_M / 2, -1.0)]
    network = RoadNetwork(lanes={lane.id: lane for lane in lanes}, turns={}, spans={}, lengths={})
    write_lanelets(network, folder / "map.osm", terrain=TERRAIN, crs=UTM)
    scene = Scene(terrain=TERRAIN, road=road_surface(network))
    east, north = MIDDLE - 8.0 * ACROSS
    pose = gr.Pose(
        sensor="R1", crs=UTM, easting=east, northing=north, height=376.0, yaw=32.0, pitch=3.0,
        roll=0.0, view=gr.View(max_range_m=200.0),
    )  # fmt: skip
    model = RadarModel(static_per_frame=20.0)
    radar = place_radar(pose, scene, rng=rng, model=model)
    times = frame_times(START, 50.0, rng=rng)
    recording = simulate_recording(radar, traffic(lanes, rng), times, rng=rng)
    recording.to_parquet(folder / "R1.parquet", index=False)
    s, v = rng.uniform(-HALF_M, HALF_M, (20_000, 1)), rng.uniform(-3.2, 3.2, (20_000, 1))
    plan = MIDDLE + s * ALONG + v * ACROSS
    road = np.column_stack([plan, TERRAIN.height(plan) + rng.normal(0.0, 0.02, len(plan))])
    return gr.read_map(folder / "map.osm"), road, pose, folder / "R1.parquet"


@pytest.mark.parametrize(
    ("ahead_m", "heading_off"), [(-7.0, 12.0), (0.0, None)], ids=["heading", "no heading"]
)
def test_the_place_along_a_straight_road_is_not_claimed(street, ahead_m, heading_off):
    roads, road, pose, recording = street
    guess = pose.position[:2] + ahead_m * ALONG + 2.0 * ACROSS
    heading = None if heading_off is None else pose.yaw + heading_off
    if heading is None:
        # the other side of the road, turned round, fits as well: no answer is honest too
        with contextlib.suppress(gr.NoAnswerError):
            assert not gr.localize(recording, roads, road, guess=tuple(guess)).observable
        return
    found = gr.localize(recording, roads, road, guess=tuple(guess), heading=heading)
    assert not found.observable
    assert found.pose.evidence["observable"] is False
    covariance = np.array(found.pose.evidence["covariance"])[:2, :2]
    assert np.sqrt(ALONG @ covariance @ ALONG) > 2.0
    assert np.sqrt(ACROSS @ covariance @ ACROSS) < 0.6
    off = found.pose.position[:2] - pose.position[:2]
    assert abs(off @ ACROSS) < 0.6
    assert abs(off @ ALONG) < 3.0 * np.sqrt(ALONG @ covariance @ ALONG)


def test_icp_does_not_claim_the_place_along_a_straight_road(street):
    pytest.importorskip("open3d", reason="needs the extra localize", exc_type=ImportError)
    roads, road, pose, recording = street
    guess = (*(pose.position[:2] + 3.0 * ALONG), pose.height)
    found = gr.localize(recording, roads, road, guess=guess, heading=pose.yaw + 4.0, method="icp")
    assert not found.observable
    assert found.pose.evidence["observable"] is False
    assert found.eigenvalues[0] < found.eigenvalues[-1] / 100.0


def test_the_road_fixes_traces_across_it_but_not_along_it(street):
    _, road, pose, recording = street
    source = voxels(read_moving(recording).points, 0.5)
    local = voxels(road - [*MIDDLE, 0.0], 0.5)
    state = State(
        position=pose.position - [*MIDDLE, 0.0], R_map_sensor=pose.R_map_sensor, reflection=0.0
    )
    information = pose_information(source, local, state)[:2, :2]
    assert ALONG @ information @ ALONG < 1.0 < ACROSS @ information @ ACROSS
