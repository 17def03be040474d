"""The simulator: geometry, sight, scatterers, frames, scans, maps, each against a plain truth."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import shapely
from pyproj import CRS

from gis_radar.poses import Pose, View
from simulation import sumo
from simulation.clutter import draw_clutter
from simulation.curves import arc_length, offset, points_at, tangents, turn
from simulation.demand import KINDS, random_flows
from simulation.lanelet_writer import Crosswalk, write_lanelets
from simulation.movement import Traffic, Vehicles
from simulation.network import Lane, RoadNetwork, Turn, read_network
from simulation.radar import Radar, RadarModel, place_radar
from simulation.recording import COLUMNS, frame_times, simulate_recording, write_recording
from simulation.roadside import furnish
from simulation.scan import BUILDING, GROUND, HIGH, Scan, fly, write_scan
from simulation.scatterers import ghosts, vehicle_scatterers
from simulation.scene import Building, ParkedCar, Post, Scene, Tree
from simulation.sight import Boxes, Walls, building_walls, parked_boxes
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


def test_offset_keeps_the_distance_on_a_bend():
    angle = np.linspace(0.0, 2.0, 60)
    circle = 50.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert np.hypot(*offset(circle, 3.0).T) == pytest.approx(47.0, abs=0.02)
    assert np.hypot(*offset(circle, -3.0).T) == pytest.approx(53.0, abs=0.02)


@pytest.mark.parametrize(
    ("end", "end_dir"),
    [
        ((20, 20), (0, 1)),
        ((12, -12), (0, -1)),
        ((30, 3), (1, 0)),
        ((20, 0), (1, 0)),
        ((0, 9), (-1, 0)),
    ],
)
def test_turns_arrive_in_the_right_direction_and_never_fold_back(end, end_dir):
    curve = turn(np.zeros(2), np.array([1.0, 0.0]), np.array(end, float), np.array(end_dir, float))
    assert curve[0] == pytest.approx([0, 0])
    assert curve[-1] == pytest.approx(end)
    bends = np.diff(np.unwrap(np.arctan2(*tangents(curve).T[::-1])))
    assert np.abs(bends).max() < np.radians(35.0)
    steps = np.diff(curve, axis=0)
    assert (np.sum(steps[1:] * steps[:-1], axis=1) > 0.0).all()


def test_a_quarter_turn_is_nearly_a_circle():
    curve = turn(np.zeros(2), np.array([1.0, 0.0]), np.array([20.0, 20.0]), np.array([0.0, 1.0]))
    assert np.hypot(*(curve - (0.0, 20.0)).T) == pytest.approx(20.0, abs=0.02)


def test_points_along_a_line():
    line = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)])
    assert arc_length(line).tolist() == [0.0, 3.0, 7.0]
    assert points_at(line, np.array([1.0, 5.0, 99.0])).tolist() == [[1, 0], [3, 2], [3, 4]]


# sight


def box(east: float, size=(10.0, 2.5, 3.5)) -> Boxes:
    return Boxes(
        centre=np.array([[*(ORIGIN + (east, 0.0)), 100.0]]),
        heading=np.zeros(1),
        size=np.array([size]),
    )


def test_a_truck_hides_a_car_behind_but_not_beside_before_or_above():
    points = np.array([(32, 0, 100.7), (32, 6, 100.7), (12, 0, 100.7), (32, 0, 105.0)])
    points[:, :2] += ORIGIN
    hidden = box(20.0).hide(EYE, points, np.full(4, -1))
    assert hidden.tolist() == [True, False, False, False]


def test_a_radar_looks_over_a_low_car_that_would_hide_from_a_low_one():
    point = np.array([[*(ORIGIN + (32.0, 0.0)), 101.2]])
    car = box(20.0, (4.5, 1.8, 1.4))
    assert not car.hide(EYE, point, np.array([-1]))[0]
    assert car.hide(EYE - (0, 0, 5.0), point, np.array([-1]))[0]


def test_a_vehicle_does_not_hide_itself():
    point = np.array([[*(ORIGIN + (24.9, 0.0)), 100.5]])
    assert box(20.0).hide(EYE, point, np.array([-1]))[0]
    assert not box(20.0).hide(EYE, point, np.array([0]))[0]


def test_no_boxes_and_no_walls_hide_nothing():
    bare = Scene(terrain=TERRAIN, road=shapely.box(0, 0, 1, 1))
    points = np.array([[*(ORIGIN + (10.0, 0.0)), 100.0]])
    assert not parked_boxes(bare).hide(EYE, points, np.array([-1])).any()
    assert not building_walls(bare).hide(EYE, points).any()


def test_a_scene_can_be_cut_to_a_neighbourhood(scene):
    assert scene.near(EYE, 500.0) == scene
    west = scene.near(EYE, 28.0)
    assert len(west.cars) == 1
    assert not west.buildings
    assert not west.trees
    assert not west.posts


def test_a_house_hides_what_is_behind_it_below_the_line_over_its_roof(scene):
    points = np.array([(75.0, 25.0, 101.0), (75.0, 25.0, 115.0), (30.0, 10.0, 101.0)])
    points[:, :2] += ORIGIN
    assert building_walls(scene).hide(EYE, points).tolist() == [True, False, False]


# scatterers


def test_only_the_faces_turned_to_the_sensor_scatter(scene):
    car = vehicles((40.0, 0.0, 0.0, 8.0))
    scatterers = vehicle_scatterers(car, scene, EYE, density=400.0, rng=rng())
    along = scatterers.point[:, 0] - ORIGIN[0] - 40.0
    assert len(along) > 200
    assert along.max() < 0.0  # the rear of a car that drives away, seen square from behind
    assert along.min() >= -2.251
    height = scatterers.point[:, 2] - TERRAIN.height(scatterers.point)
    assert height.min() > 0.29
    assert height.max() < 1.5
    assert np.mean((height > 0.29) & (height < 0.91)) > 0.7


def test_wheels_turn_between_zero_and_twice_the_speed(scene):
    car = vehicles((20.0, 20.0, 0.0, 10.0))
    scatterers = vehicle_scatterers(car, scene, EYE, density=500.0, rng=rng())
    speed = scatterers.velocity[:, 0]
    wheel = np.abs(speed - 10.0) > 1e-6
    assert 0.02 < wheel.mean() < 0.3
    assert speed.min() >= -1e-9
    assert speed.max() <= 20.0 + 1e-9
    assert speed[wheel].mean() == pytest.approx(10.0, abs=2.0)


def test_range_rate_is_positive_when_receding_and_zero_when_standing(scene):
    there = vehicles((40.0, 0.0, 0.0, 8.0), (40.0, 3.0, 180.0, 8.0), (40.0, -3.0, 0.0, 0.0))
    scatterers = vehicle_scatterers(there, scene, EYE, density=60.0, rng=rng())
    rate = scatterers.range_rate(EYE)
    assert np.median(rate[scatterers.owner == 0]) == pytest.approx(8.0, abs=0.2)
    assert np.median(rate[scatterers.owner == 1]) == pytest.approx(-8.0, abs=0.2)
    assert np.abs(rate[scatterers.owner == 2]).max() == 0.0


def test_a_turning_vehicle_moves_faster_outside_than_inside(scene):
    bus = vehicles((30.0, 0.0, 90.0, 5.0), size=(12.0, 2.5, 3.0))
    turning = replace(bus, yaw_rate=np.array([0.5]))
    scatterers = vehicle_scatterers(turning, scene, EYE, density=80.0, rng=rng())
    east = scatterers.velocity[:, 0]
    ahead = scatterers.point[:, 1] - ORIGIN[1]
    assert east == pytest.approx(-0.5 * ahead, abs=1e-6)


def test_ghosts_lie_farther_than_their_origin_or_behind_a_mirror(scene):
    car = vehicles((92.0, 0.0, 0.0, 8.0))
    scatterers = vehicle_scatterers(car, scene, EYE, density=100.0, rng=rng())
    images = ghosts(scatterers, EYE, building_walls(scene), share=1.0, rng=rng(2))
    assert len(images.rcs) == len(scatterers.rcs)
    far = np.linalg.norm(images.point - EYE, axis=1) - np.linalg.norm(
        scatterers.point - EYE, axis=1
    )
    assert (far > 0.5).all()
    assert (images.owner == -1).all()
    mirrored = images.point[:, 1] > ORIGIN[1] + 12.0
    assert 0 < mirrored.sum() < len(mirrored)


def test_a_mirror_turns_the_motion_too():
    wall = Walls(begin=np.array([[0.0, 10.0]]), end=np.array([[40.0, 10.0]]), top=np.array([20.0]))
    scene = Scene(terrain=Terrain(origin=(0.0, 0.0)), road=shapely.box(0, -5, 50, 5))
    car = replace(vehicles((0, 0, 90.0, 6.0)), centre=np.array([[30.0, 0.0]]))
    eye = np.array([0.0, 0.0, 5.0])
    scatterers = vehicle_scatterers(car, scene, eye, density=200.0, rng=rng())
    images = ghosts(scatterers, eye, wall, share=1.0, rng=rng(1))
    mirrored = images.point[:, 1] > 12.0
    assert mirrored.any()
    assert (images.velocity[mirrored, 1] <= 0.0).all()


def test_clutter_is_seen_from_the_sensor_and_only_leaves_stir(scene):
    clutter = draw_clutter(scene, EYE, rng())
    assert not building_walls(scene).hide(EYE, clutter.point).any()
    stirs = clutter.wobble > 0.0
    assert np.hypot(*(clutter.point[stirs, :2] - ORIGIN - (30, -8)).T).max() < 3.01
    assert 0.005 < clutter.wobble[stirs].mean() < 0.1


# frames


def test_frames_obey_the_view_and_the_limit(radar, traffic):
    frame = radar.frame(traffic.at(1001.0), rng())
    assert frame.shape[1] == len(COLUMNS)
    assert radar.view.sees(frame[:, :3]).all()
    few = replace(radar, model=replace(radar.model, most=50))
    assert 0 < len(few.frame(traffic.at(1001.0), rng())) <= 50


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


def test_a_standing_vehicle_still_returns(radar, traffic):
    gone = replace(traffic, centre=np.where([[[0], [1]]], np.nan, traffic.centre))
    hits = []
    for scenery in (traffic, gone):
        noise, count = rng(4), 0
        for time in np.arange(1000.0, 1004.0, 0.05):
            frame = radar.frame(scenery.at(time), noise)
            off = np.abs(radar.pose.to_map(frame[:, :3])[:, :2] - ORIGIN - (30.0, 2.0))
            still = np.abs(frame[:, 3]) < 0.15
            count += int(((off[:, 0] < 2.5) & (off[:, 1] < 1.2) & still).sum())
        hits.append(count)
    assert hits[0] > hits[1] + 50


def test_returns_thin_out_with_range(scene, radar):
    noise = rng(5)
    seen = {}
    for distance in (25.0, 110.0):
        there = vehicles((distance, 0.0, 0.0, 9.0))
        frames = [radar.frame(there, noise) for _ in range(150)]
        seen[distance] = sum(int((frame[:, 3] > 6.0).sum()) for frame in frames)
    assert seen[25.0] > 2 * seen[110.0] > 0


def test_traffic_between_two_steps_is_interpolated(traffic):
    assert traffic.at(1000.025).centre[0] == pytest.approx(ORIGIN + (40.25, -2.0))
    assert len(traffic.at(1000.0).speed) == 2


def test_times_ascend_jitter_drop_and_double():
    times = frame_times(
        1e9, 100.0, rng=rng(), cycle_s=(0.057,), jitter_s=0.001, dropped=0.02, doubled=0.02
    )
    gaps = np.diff(times)
    assert (gaps > 0).all()
    assert times[0] == 1e9
    assert times[-1] < 1e9 + 100.0
    assert np.median(gaps) == pytest.approx(0.057, abs=0.0005)
    assert 10 < (gaps > 0.1).sum() < 80
    assert 10 < (gaps < 0.016).sum() < 80
    assert np.array_equal(times, np.round(times, 6))


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


def test_another_seed_gives_another_recording(radar, traffic):
    times = frame_times(1000.0, 0.5, rng=rng())
    one, other = (simulate_recording(radar, traffic, times, rng=rng(k)) for k in (1, 2))
    assert len(one) != len(other) or not one.equals(other)


# scan


@pytest.fixture(scope="module")
def scan(scene) -> Scan:
    return fly(scene, rng=rng(8))


def test_the_scan_has_ground_roof_and_crown_where_they_are(scene, scan):
    local = scan.point[:, :2] - ORIGIN
    ground = scan.category == GROUND
    error = scan.point[ground, 2] - scene.ground(scan.point[ground, :2])
    assert np.median(np.abs(error)) < 0.03
    roof = scan.category == BUILDING
    inside = (local[:, 0] > 41) & (local[:, 0] < 59) & (local[:, 1] > 13) & (local[:, 1] < 21)
    floor = float(TERRAIN.height(scene.buildings[0].outline[0]))
    assert scan.point[inside & roof, 2] == pytest.approx(floor + 8.0, abs=0.2)
    assert not (inside & ground).any()
    crown = scan.category == HIGH
    off = np.hypot(*(local[crown] - (30, -8)).T)
    assert off.max() < 3.2
    below = ground & (np.hypot(*(local - (30, -8)).T) < 1.5)
    assert below.sum() > 5  # some pulses get through


def test_the_scan_is_dense_and_has_the_parked_car(scene, scan):
    local = scan.point[:, :2] - ORIGIN
    road = (np.abs(local[:, 1]) < 5.0) & (local[:, 0] > 40.0) & (local[:, 0] < 140.0)
    assert 8.0 < road.sum() / 1000.0 < 11.0
    car = (np.abs(local[:, 0] - 25.0) < 2.0) & (np.abs(local[:, 1] - 8.0) < 0.8)
    assert set(scan.category[car]) == {1}


def test_the_scan_file_says_its_system_and_returns(scan, tmp_path):
    write_scan(scan, tmp_path / "s.laz", crs=UTM, flown=date(2024, 3, 1))
    las = laspy.read(tmp_path / "s.laz")
    assert str(las.header.version) == "1.4"
    assert las.header.parse_crs() == UTM
    assert np.abs(las.xyz - scan.point).max() < 0.0051
    assert (np.array(las.return_number) <= np.array(las.number_of_returns)).all()
    assert (np.array(las.number_of_returns) == 2).any()


# maps and networks


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    """Two lanes side by side, each followed by a turn into one of two lanes."""
    lanes = {}
    for edge, begin, end in (("a", 0.0, 40.0), ("b", 60.0, 100.0)):
        for index, y in ((0, 0.0), (1, 3.0)):
            x = np.linspace(begin, end, 11)
            centre = np.column_stack([x, np.full(11, y)]) + ORIGIN
            lanes[f"{edge}_{index}"] = Lane(
                id=f"{edge}_{index}", edge=edge, index=index, centre=centre,
                left=offset(centre, 1.5), right=offset(centre, -1.5), speed_limit=13.89,
            )  # fmt: skip
    turns = {}
    for index in (0, 1):
        source, target = lanes[f"a_{index}"], lanes[f"b_{index}"]
        sides = {
            side: np.linspace(getattr(source, side)[-1], getattr(target, side)[0], 21)
            for side in ("centre", "left", "right")
        }
        turns[f"t_{index}"] = Turn(
            id=f"t_{index}", source=source.id, target=target.id, signal="C", direction="s",
            speed_limit=13.89, **sides,
        )  # fmt: skip
    names = [*lanes, *turns]
    return RoadNetwork(
        lanes=lanes,
        turns=turns,
        spans={name: (name, 0.0, 1.0) for name in names},
        lengths={name: 20.0 if name in turns else 40.0 for name in names},
    )


def test_places_on_lanes_follow_the_share_of_sumos_length(network):
    place, ahead = network.locate("t_0", np.array([0.0, 10.0]))
    assert place == pytest.approx(np.array([(40.0, 0.0), (50.0, 0.0)]) + ORIGIN)
    assert ahead == pytest.approx(np.array([(1.0, 0.0), (1.0, 0.0)]))
    assert network.sources() == ["a"]
    assert network.sinks() == ["b"]


def test_the_map_shares_bounds_and_end_nodes(network, tmp_path):
    walk = np.array([(45.0, -3.0), (45.0, 6.0)]) + ORIGIN
    write_lanelets(
        network, tmp_path / "m.osm", terrain=TERRAIN, crs=UTM,
        crosswalks=(Crosswalk(left=walk, right=walk + (3.0, 0.0)),),
    )  # fmt: skip
    root = ET.parse(tmp_path / "m.osm").getroot()  # noqa: S314 - our own file
    tags = {r: {t.get("k"): t.get("v") for t in r.iter("tag")} for r in root.iter("relation")}
    lanelets = [r for r, t in tags.items() if t["type"] == "lanelet" and t["subtype"] == "road"]
    assert len(lanelets) == 6
    assert [t["subtype"] for t in tags.values() if t.get("participant:pedestrian")] == ["crosswalk"]
    sides = [m.get("ref") for r in lanelets for m in r.iter("member") if m.get("type") == "way"]
    assert len(sides) - len(set(sides)) == 3  # one bound in common for each pair
    assert all(n.find("tag").get("k") == "ele" for n in root.iter("node"))
    assert len(root.findall("node")) == len(
        {(n.get("lat"), n.get("lon"), n[0].get("v")) for n in root.iter("node")}
    )
    lights = [t for t in tags.values() if t["type"] == "regulatory_element"]
    assert len(lights) == 1
    kinds = {t.get("v") for w in root.iter("way") for t in w.iter("tag") if t.get("k") == "type"}
    assert kinds >= {"stop_line", "traffic_light", "virtual", "curbstone", "line_thin"}
    ids = [int(e.get("id")) for e in root]
    assert min(ids) > 0
    assert len(set(ids)) == len(ids)


def test_furniture_keeps_off_the_road(network):
    made = furnish(network, TERRAIN, rng=rng(9))
    again = furnish(network, TERRAIN, rng=rng(9))
    assert made.trees == again.trees
    assert made.trees
    assert made.buildings
    assert not any(made.road.intersects(shapely.Polygon(b.outline)) for b in made.buildings)
    assert not any(made.road.contains(shapely.Point(t.place)) for t in made.trees)
    assert any(made.road.intersects(shapely.Point(t.place).buffer(t.crown_m)) for t in made.trees)


def test_without_sumo_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ModuleNotFoundError, match="pip install eclipse-sumo"):
        sumo.run("sumo", [])


@pytest.mark.usefixtures("sumo_installed")
def test_a_failing_program_is_quoted():
    with pytest.raises(RuntimeError, match="netconvert failed"):
        sumo.run("netconvert", ["--node-files=nowhere.xml"])


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
