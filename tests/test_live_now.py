"""The vehicles of now: where the batch has them, by a process that may be killed."""

import itertools
import json
import multiprocessing
import time
import urllib.request

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from live_hours import SAMPLE, selected_frames
from live_programs import Lines
from live_site import Background, LiveSite, free_port, is_open, needs_mosquitto, wait_for

import gis_radar as gr
from gis_radar.base import STEPS_PER_SECOND
from gis_radar.dataset.files.tables import TRACKS
from gis_radar.hdmap import lane_graph
from gis_radar.live import (
    Edge,
    Fusion,
    pack_detections,
    read_edge_file,
    read_live_site,
)
from gis_radar.live.now.vehicles_now import (
    MOST_WAITING,
    LiveVehicles,
    PlacedMessage,
    VehicleFollower,
    layer_of,
)

pytestmark = pytest.mark.usefixtures("ready_workers")
NAMES, KEY, EVERY = ("R1", "R2"), b"pose", 4
SECONDS = 40.0  # of the sample's hundred, as `selected_frames` has them
MEASURED_S = 61.0  # as of notebooks, which share the dataset
POSES = {name: gr.read_pose(SAMPLE / f"{name}.json") for name in NAMES}


@pytest.fixture(scope="module")
def graph():
    return lane_graph(gr.read_map(SAMPLE / "junction.osm").lanelets)


@pytest.fixture(scope="module")
def batch(measure_once, first_seconds):
    """Give the states of vehicles that the batch finds, metres."""
    roads = SAMPLE / "junction.osm"
    recordings = [first_seconds(SAMPLE / f"{name}.parquet", MEASURED_S) for name in NAMES]
    tiles, clearance = gr.make_tiles(gr.read_map(roads)), gr.Filters(clearance=(-0.5, 4.5))
    made = measure_once(recordings, list(POSES.values()), tiles, roads, filters=clearance)
    dataset = gr.open_dataset(made)
    rows = pd.concat([part.to_pandas() for part in dataset.batches(TRACKS)], ignore_index=True)
    east, north = dataset.manifest.origin
    return rows.assign(easting=0.01 * rows["x_cm"] + east, northing=0.01 * rows["y_cm"] + north)


def messages():
    """Return what the sensors of the sample send, by time, with their poses."""
    sent = [(each.time_us, name, pack_detections([each], pose=KEY))
            for name in NAMES for each in selected_frames(name)]  # fmt: skip
    return [(name, content, POSES[name], np.nan) for _, name, content in sorted(sent)]


def test_vehicles_of_now_are_where_the_batch_has_them(graph, batch):
    """The filter alone, a third of a second late: most vehicles, within some metres."""
    following, sent = VehicleFollower(graph), messages()[: round(20 * SECONDS) * len(NAMES)]
    sent = [PlacedMessage(NAMES.index(name), pose, road_m, content)
            for name, content, pose, road_m in sent]  # fmt: skip
    true = found = shown = 0
    for begin in range(0, len(sent), 20):
        now, late = following.advance(sent[begin : begin + 20])
        assert late == 0
        step = round(now.time * STEPS_PER_SECOND) // EVERY * EVERY
        rows = batch[(batch["step"] == step) & batch["seen"]]
        if begin < 400:
            continue
        true, shown = true + len(rows), shown + len(now)
        assert len(set(now.vehicle.tolist())) == len(now)
        if len(rows) and len(now):
            states = rows[["easting", "northing"]].to_numpy()
            apart = np.hypot(*np.moveaxis(states[:, None] - now.place, -1, 0))
            found += int((apart.min(axis=1) < 4.0).sum())
    assert found > 0.8 * true > 500
    assert shown < 1.4 * true


def test_a_process_that_ends_is_started_anew_and_old_vehicles_are_none(graph):
    said = Lines()
    vehicles = LiveVehicles(graph, NAMES, again_s=0.1, reporter=said)
    vehicles.make_ready().result()
    sent = itertools.cycle(messages())

    def follows():
        for _ in range(40):
            vehicles.take(*next(sent))
        vehicles.poll()
        return len(vehicles.now())

    wait_for(follows)
    assert len(layer_of(vehicles.now(), "EPSG:25832")) == len(vehicles.now())
    for each in multiprocessing.active_children():
        each.kill()
    wait_for(lambda: follows() is None or vehicles.restarts)
    assert said.told("a new one begins anew")
    assert vehicles.figures()["vehicles_dropped_messages"] >= 40  # which the process had
    assert len(vehicles.now()) == 0
    wait_for(follows)
    wait_for(lambda: len(vehicles.now()) == 0)  # nothing came for 5 s
    vehicles.close()
    assert multiprocessing.active_children() == []


def test_what_a_busy_process_cannot_take_is_dropped_and_counted(graph):
    vehicles = LiveVehicles(graph, NAMES)
    for _ in range(MOST_WAITING + 2):
        vehicles.take("R1", b"", POSES["R1"], np.nan)
    assert vehicles.dropped == 2


def test_what_the_process_leaves_out_is_counted(graph):
    vehicles = LiveVehicles(graph, NAMES)
    vehicles.make_ready().result()
    mine = [each for each in messages() if each[0] == "R1"]

    def counted(*rows):
        for row in rows:
            vehicles.take(*row)
        vehicles.poll()
        found = vehicles.figures()
        return found["vehicles_dropped_messages"], found["vehicles_late_frames"]

    counted(*mine[100:200])
    wait_for(lambda: counted() and len(vehicles.now()))
    old = [each for each in selected_frames("R1")[:100] if len(each.points)]
    counted(*mine[:100])
    wait_for(lambda: counted() == (0, len(old)))
    vehicles.close()


def asked(page, path):
    with urllib.request.urlopen(f"http://{page}/{path}") as answer:
        return json.load(answer)


@needs_mosquitto
def test_a_live_site_shows_vehicles_and_measures_the_hour(tmp_path, once):
    """At the times of now: map, page and vehicles on the way, the recordings at the end."""
    page = f"127.0.0.1:{free_port()}"
    site = LiveSite(tmp_path, once, recordings=SAMPLE, vehicles="true",
                    of_live=f'every = "1s"\n[live.page]\naddress = "{page}"')  # fmt: skip
    site.broker.start()
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    wait_for(lambda: fusion.link is not None and fusion.link.connected)
    source = 'speed = 1.0\nloop = "100s"'
    work = [Background(Edge(read_edge_file(site.edge(name, source=source))).run) for name in NAMES]
    try:
        wait_for(lambda: len(fusion.vehicles.now()) > 3 and fusion.state().hit.any())
        begin = time.monotonic()
        wait_for(lambda: time.monotonic() > begin + 3.0)
        assert abs(fusion.state().step / STEPS_PER_SECOND - time.time()) < 2.0
        assert "gis_radar_vehicles_now" in fusion.metrics()
        assert all(not each.health.alarms.keys() - {"clock"} for each in fusion.sensors.values())
        state = asked(page, "state.json")
        assert [state["sensors"][name]["online"] for name in NAMES] == [True, True]
        assert state["sensors"]["R1"]["at"] == pytest.approx((11.561, 48.150), abs=0.002)
        assert {state["classes"][str(tile)] for tile in state["hit"]} <= set(range(1, 9))
        lanes = asked(page, "ogc/collections/intervals/items")["features"]
        assert any(each["properties"]["hit_s"] > 0 for each in lanes)
    finally:
        for each in work:
            each.end()
        middle.end()
        site.broker.kill()
    assert not is_open(int(page.rpartition(":")[2]))
    layer = gpd.read_file(site.folder / "live" / "now.gpkg", layer="vehicles")
    assert {"vehicle", "speed", "heading"} <= {*layer.columns}
    parts = list((site.folder / "live" / "parts").glob("R?/*.parquet"))
    assert {path.parent.name for path in parts} == {*NAMES}
    assert multiprocessing.active_children() == []
