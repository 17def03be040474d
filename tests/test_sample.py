"""The sample site: what its files promise, and that they fit together."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import shapely
from pyproj import CRS, Transformer
from scipy.spatial import cKDTree

from gis_radar.poses import read_pose

SAMPLE = Path(__file__).parents[1] / "sample_maps"
START = 1_749_713_400.0
COLUMNS = ["x", "y", "z", "range_rate", "rcs"]
SENSORS = ("R1", "R2")
PEOPLE = ("walker", "cyclist")


@pytest.fixture(scope="module")
def recordings() -> dict[str, pd.DataFrame]:
    return {s: pq.read_table(SAMPLE / f"{s}.parquet").to_pandas() for s in SENSORS}


@pytest.fixture(scope="module")
def vehicles() -> pd.DataFrame:
    return pq.read_table(SAMPLE / "vehicles.parquet").to_pandas()


@pytest.fixture(scope="module")
def lanelet_map():
    lanelet2 = pytest.importorskip("lanelet2")
    origin = Transformer.from_crs(25832, 4326, always_xy=True).transform(690_400.0, 5_336_200.0)
    projector = lanelet2.projection.UtmProjector(
        lanelet2.io.Origin(origin[1], origin[0]), True, False
    )
    loaded, errors = lanelet2.io.loadRobust(str(SAMPLE / "junction.osm"), projector)
    assert not list(errors)
    return loaded


def lane_polygons(lanelet_map) -> dict[int, shapely.Polygon]:
    """Road lanelets in the map frame; the projector's frame begins at the junction's middle."""
    roads = [ll for ll in lanelet_map.laneletLayer if ll.attributes["subtype"] == "road"]
    return {
        ll.id: shapely.Polygon(
            [(p.x + 690_400.0, p.y + 5_336_200.0) for p in (*ll.leftBound, *ll.rightBound.invert())]
        )
        for ll in roads
    }


def test_the_sample_is_small():
    assert sum(p.stat().st_size for p in SAMPLE.iterdir() if p.is_file()) < 14e6


@pytest.mark.parametrize("sensor", SENSORS)
def test_recordings_keep_the_contract(recordings, sensor):
    table = recordings[sensor]
    assert list(table.columns) == ["time", *COLUMNS]
    assert table["time"].dtype == np.float64
    assert (table.dtypes[COLUMNS] == np.float32).all()
    assert table["time"].is_monotonic_increasing
    begins = START + 0.017 * (sensor == "R2")
    assert 0.0 <= table["time"].iloc[0] - begins < 0.06  # a cycle may begin at any moment of it
    assert 99.9 < table["time"].iloc[-1] - START < 100.0
    size = table.groupby("time").size()
    assert 70 < size.mean() < 100  # a recorded ARS548 gives 50-100
    assert size.max() < 150
    nothing = table[table["x"].isna()]
    assert len(nothing) >= 1
    assert (size[nothing["time"]] == 1).all()
    assert table["range_rate"].isna().sum() == len(nothing)


def test_pages_have_checksums():
    for sensor in SENSORS:
        pq.read_table(SAMPLE / f"{sensor}.parquet", page_checksum_verification=True)


def test_frames_come_in_turn_and_r2_loses_and_doubles_some(recordings):
    first, second = (np.diff(recordings[s]["time"].unique()) for s in SENSORS)
    in_turn = np.sort(np.median(first[: len(first) // 3 * 3].reshape(-1, 3), axis=0))
    assert in_turn == pytest.approx([0.0413, 0.0515, 0.0572], abs=2e-4)
    assert first.mean() == pytest.approx(0.05, abs=1e-4)
    assert np.median(second) == pytest.approx(0.051, abs=0.001)
    assert (second > 0.09).sum() >= 5
    assert ((second > 0.004) & (second < 0.016)).sum() >= 5


@pytest.mark.parametrize("sensor", SENSORS)
def test_most_returns_stand_still(recordings, sensor):
    moving = (recordings[sensor]["range_rate"].abs() > 0.15).mean()
    assert 0.15 < moving < 0.3


@pytest.mark.parametrize("sensor", SENSORS)
def test_poses_are_whole(sensor):
    pose = read_pose(SAMPLE / f"{sensor}.json")
    assert json.loads((SAMPLE / f"{sensor}.json").read_text())["quaternion"]
    assert pose.sensor == sensor
    assert pose.crs == CRS.from_epsg(25832)
    assert pose.view is not None
    assert (pose.view.azimuth_deg, pose.view.elevation_deg) == (120.0, 30.0)
    assert (pose.view.min_range_m, pose.view.max_range_m) == (1.0, 200.0)
    assert pose.pitch > 1.0
    assert pose.roll != 0.0


@pytest.mark.parametrize("sensor", SENSORS)
def test_moving_returns_lie_on_vehicles(recordings, vehicles, sensor):
    pose = read_pose(SAMPLE / f"{sensor}.json")
    table = recordings[sensor].dropna()
    table = table[(table["range_rate"].abs() > 1.0) & (np.hypot(table["x"], table["y"]) < 100.0)]
    step = np.rint((table["time"].to_numpy() - START) / 0.05).astype(int)
    place = pose.to_map(table[["x", "y", "z"]].to_numpy())
    truth = dict(tuple(vehicles.groupby(np.rint((vehicles["t"] - START) / 0.05).astype(int))))
    on = []
    for k in range(0, 2000, 40):
        here, cars = place[step == k], truth[k]
        gap = here[:, None, :2] - cars[["easting", "northing"]].to_numpy()
        turn = np.radians(cars["heading"].to_numpy())
        ahead = np.abs(gap[..., 0] * np.cos(turn) + gap[..., 1] * np.sin(turn))
        aside = np.abs(gap[..., 1] * np.cos(turn) - gap[..., 0] * np.sin(turn))
        half = cars[["length", "width"]].to_numpy() / 2.0
        on.append(((ahead < half[:, 0] + 0.6) & (aside < half[:, 1] + 0.6)).any(axis=1))
    assert np.concatenate(on).mean() > 0.8


def test_vehicles_drive_on_the_lanes_and_queue(vehicles, lanelet_map):
    assert vehicles["t"].nunique() == 2001
    lanes = lane_polygons(lanelet_map)
    road = shapely.union_all([lane.buffer(0.05) for lane in lanes.values()])
    west, south, east, north = np.array(road.bounds) + (12, 12, -12, -12)
    vehicles = vehicles[~vehicles["kind"].isin(PEOPLE)]
    inner = vehicles[
        vehicles["easting"].between(west, east) & vehicles["northing"].between(south, north)
    ]
    assert shapely.contains_xy(road, inner["easting"], inner["northing"]).mean() > 0.995
    longest = 0
    for time in START + np.arange(0.0, 100.0, 5.0):
        now = vehicles[(vehicles["t"] - time).abs() < 0.01]
        still = now[now["speed"] < 0.3]
        counts = [
            shapely.contains_xy(lane, still["easting"], still["northing"]).sum()
            for lane in lanes.values()
        ]
        longest = max(longest, *counts)
    assert longest >= 5


def test_people_and_a_truck_with_a_trailer_are_there(vehicles):
    kind = vehicles.groupby("t")["kind"]
    assert kind.agg(lambda here: (here == "walker").sum()).eq(12).all()
    assert kind.agg(lambda here: (here == "cyclist").sum()).eq(4).all()
    truck = vehicles[vehicles["kind"] == "articulated"]
    assert len(set(truck["id"])) == 1
    assert set(truck["part"]) == {0, 1}
    assert set(vehicles.loc[vehicles["part"] == 1, "kind"]) == {"articulated"}
    assert (truck["whole_length"] == truck["whole_length"].iloc[0]).all()
    assert truck["whole_length"].iloc[0] > truck["length"].max()


def test_the_map_can_be_routed(lanelet_map):
    lanelet2 = pytest.importorskip("lanelet2")
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(lanelet_map, rules)
    assert not list(graph.checkValidity(throwOnError=False))
    roads = [ll for ll in lanelet_map.laneletLayer if ll.attributes["subtype"] == "road"]
    following = {ll.id: len(graph.following(ll)) for ll in roads}
    ends = [name for name, count in following.items() if count == 0]
    assert len(ends) == 6  # the lanes that leave the map
    assert max(following.values()) >= 2
    assert any(graph.left(ll) or graph.adjacentLeft(ll) for ll in roads)
    lit = [ll for ll in roads if ll.trafficLights()]
    assert len(lit) == 10
    assert all(light.stopLine is not None for ll in lit for light in ll.trafficLights())
    walks = [ll for ll in lanelet_map.laneletLayer if ll.attributes["subtype"] == "crosswalk"]
    assert len(walks) == 2


def test_lanelets_have_lane_width_and_do_not_fold(lanelet_map):
    for polygon in lane_polygons(lanelet_map).values():
        assert polygon.is_valid
        assert 2.7 < 2.0 * polygon.area / (polygon.length - 6.5) < 3.6


def test_the_scan_covers_the_map_at_its_heights(lanelet_map):
    las = laspy.read(SAMPLE / "scan.laz")
    assert str(las.header.version) == "1.4"
    assert las.header.parse_crs().to_epsg() == 25832
    category = np.array(las.classification)
    assert set(np.unique(category)) == {1, 2, 3, 5, 6}
    assert (category == 1).sum() > 500
    ground = las.xyz[category == 2]
    tree = cKDTree(ground[:, :2])
    nodes = np.array(
        [
            (p.x + 690_400.0, p.y + 5_336_200.0, p.z)
            for ll in lanelet_map.laneletLayer
            for p in ll.centerline
        ]
    )
    distance, nearest = tree.query(nodes[:, :2])
    assert np.percentile(distance, 98) < 1.5
    assert np.median(np.abs(ground[nearest, 2] - nodes[:, 2])) < 0.05


@pytest.mark.usefixtures("sumo_installed")
def test_the_sample_is_made_again_alike(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(SAMPLE))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # the folder goes into the wheel
    make_samples = importlib.import_module("make_samples")
    made = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        make_samples.make_samples(folder, duration_s=1.0)
        made.append(folder)
    for path in made[0].iterdir():
        assert path.read_bytes() == (made[1] / path.name).read_bytes(), path.name
