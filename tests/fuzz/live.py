"""Inputs of the live system for the fuzzer (messages, buffer, stores, files), and readers."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from driven import drive
from gis_radar.live.hits_folder.folder import read_stored_hits, runs_of_frames
from gis_radar.live.hits_folder.tile_sets import pack_tiles, unpack_tiles
from gis_radar.live.hours import HOUR_STEPS
from gis_radar.live.journal import Journal
from gis_radar.live.store import Store
from gis_radar.live.vehicles.clocks import SensorFrame
from gis_radar.live.vehicles.follower import FollowedSite, VehicleFollower
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.live.vehicles.store import FollowedPose, StoredBatch, VehicleStore
from maps import EAST, NORTH

import gis_radar as gr
from gis_radar.lanelets.graph import lane_graph
from gis_radar.live.broker import BrokerAddress, Link, Received, SensorTopics
from gis_radar.live.buffer import DiskBuffer
from gis_radar.live.detections import FrameDetections, pack_detections, unpack_detections
from gis_radar.live.edge import Edge
from gis_radar.live.health import prometheus_text
from gis_radar.live.intake import Intake
from gis_radar.live.map_of_now import MapOfNow
from gis_radar.live.outbox import ONLINE, Outbox, status_message
from gis_radar.live.payload import (
    DETECTIONS,
    HITS,
    POSE,
    Acknowledgement,
    Envelope,
    PoseContent,
    pack_hits,
    pack_message,
    unpack_hits,
)
from gis_radar.live.settings import read_edge_file, read_live_site
from gis_radar.live.windows import Windows
from gis_radar.measures.hit_counter import CountedFrame
from gis_radar.measures.validity import Runs
from gis_radar.measures.views import ViewBook, name_of_view
from gis_radar.sight import SightTiles
from gis_radar.sight.layers import SightFile, write_sights
from gis_radar.sight.sight import find_sight
from gis_radar.steps import STEP_US
from gis_radar.tracking.batches import BlockEdge, VehicleBatch
from gis_radar.tracking.map_check import map_of_tiles
from gis_radar.tracking.visibility import SensorView

STREAM, BEGIN_US = b"abcd", 1_700_000_000_000_000
MESSAGES = ("status", "pose", "hits", "detections")  # in the order in which they come
SENSOR = f"""sensor = "R1"
site = "junction"
tiles = "tiles.gpkg"
guess = [{EAST:.1f}, {NORTH:.1f}]
heading = 10.0
road = "road.laz"
[source]
address = "udp://224.0.2.2:42102"
[broker]
address = "mqtts://broker.example:8883"
password_file = "password"
[map]
file = "map.osm"
crs = "EPSG:25832"
[view]
max_range_m = 60.0
[measure]
min_speed = 1.0
[buffer]
megabytes = 400.0
"""
LIVE = """[live]
site = "junction"
tiles = "tiles.gpkg"
lateness = "200ms"
interval = "15min"
broker = { address = "mqtt://127.0.0.1:1883", password_file = "password" }
health = "127.0.0.1:9464"
[live.page]
address = "127.0.0.1:8080"
names = ["traffic.example"]
"""


def build(folder: Path) -> None:
    """Write sound inputs of the live system beside those of the other kinds."""
    place = folder / "live"
    place.mkdir()
    road, pose = _road(folder), gr.read_pose(folder / "R1.json")
    content = PoseContent(pose=pose.as_dict(), since_step=0, fingerprint=road.fingerprint)
    frames = [
        CountedFrame(time_us=BEGIN_US + 50_000 * k, detections=9, moving=5, wild=1,
                     checksum=12345 + k, tiles=np.array([0, 1, k + 2], np.int64))
        for k in range(3)
    ]  # fmt: skip
    points = np.array([[600, 150, -400], [700, -150, -400]], np.int64)
    detections = [
        FrameDetections(
            time_us=each.time_us, points=points, rates=points[:, 0], rcs_db=points[:, 1] // 10
        )
        for each in frames
    ]
    hits = pack_hits(frames, pose=1, fingerprint=road.fingerprint)
    status = status_message(ONLINE, stream=STREAM.hex(), lost=0, fingerprint=road.fingerprint)
    (place / "status").write_bytes(status)
    contents = {POSE: content.pack(), HITS: hits, DETECTIONS: pack_detections(detections, pose=1)}
    for number, (kind, name) in enumerate(zip(contents, MESSAGES[1:], strict=True), 1):
        envelope = Envelope(kind=kind, stream=STREAM, number=number, previous=number - 1)
        (place / name).write_bytes(pack_message(envelope, contents[kind]))
    ack = Acknowledgement(stream=STREAM.hex(), stored=2, session="12345678")
    (place / "ack").write_bytes(ack.pack())
    (place / "tiles").write_bytes(pack_tiles(np.array([5, 6, 7, 310, 70_000])))
    with DiskBuffer(place / "buffer", most_bytes=1 << 30, fingerprint=road.fingerprint) as buffer:
        for kind, each in contents.items():
            buffer.append(kind, each)
    with Journal(place / "journal", fingerprint=road.fingerprint) as journal:
        _deliver(_intake(folder, journal), folder)
        journal.commit()
    _build_vehicles(folder, detections)
    (folder / "password").write_text("secret\n")
    (folder / "SENSOR.toml").write_text(SENSOR)
    (folder / "LIVE.toml").write_text((folder / "SITE.toml").read_text() + LIVE)
    tiles = gr.read_tiles(folder / "tiles.gpkg")
    write_sights([find_sight(pose, road)], tiles, folder / "sight.gpkg")


def _build_vehicles(folder: Path, detections: list[FrameDetections]) -> None:
    """Write a store of vehicles: a block in which one drives, and frames after it."""
    road, pose = _road(folder), gr.read_pose(folder / "R1.json")
    tiles = gr.read_tiles(folder / "tiles.gpkg")
    last = BEGIN_US // STEP_US - 1
    tracks = drive(1, last - 19, EAST + np.arange(20) * 0.5, lanelet_id=tiles["lanelet_id"].iloc[0])
    tracks["northing"] = NORTH
    store = VehicleStore(folder / "live" / "followed", fingerprint=road.fingerprint)
    view, position = name_of_view(road.tile_id), pose.position
    store.add_view(SensorView(sensor="R1", view=view, tile_id=road.tile_id, position=position), 0.0)
    row = store.add_pose(
        FollowedPose(sensor="R1", view=view, validity_s=0.1, content=pose.as_dict())
    )
    steps = np.array([last - 19]), np.array([last])
    row_of_vehicle = {
        "vehicle": 1, "first_step": last - 19, "last_step": last, "length_m": 4.5, "width_m": 1.8,
        "length_sigma_m": 0.3, "p_heavy": 0.0, "lanelets": [int(tracks["lanelet_id"].iloc[0])],
        "continues": False,
    }  # fmt: skip
    batch = VehicleBatch(
        first_step=last - 19, last_step=last, tracks=tracks,
        vehicles=pd.DataFrame([row_of_vehicle]),
        frames=runs_of_frames("R1", view, Runs(first=steps[0], last=steps[1])),
    )  # fmt: skip
    table = pd.DataFrame([(0, BEGIN_US / 1e6, 3.0, 1)], columns=[*BlockEdge.COLUMNS])
    store.add_batch(
        StoredBatch(batch=batch, poses=(row,)), BlockEdge(step=last, found=2, table=table),
        needed_us=0, kept_step=0,
    )  # fmt: skip
    store.add_frames([SensorFrame("R1", row, each).row() for each in detections])
    store.close()


@cache
def _tiles(path: Path, changed: int) -> SightTiles:
    table: gpd.GeoDataFrame = gr.read_tiles(path)
    return SightTiles.of(table)


def _road(folder: Path) -> SightTiles:
    path = folder / "tiles.gpkg"
    return _tiles(path, path.stat().st_mtime_ns)


def _intake(folder: Path, journal: Journal) -> Intake:
    road = _road(folder)
    return Intake(
        ["R1"], site="junction", book=ViewBook(road=road), journal=journal, windows=Windows(0.2),
        current=MapOfNow(len(road.tile_id), interval=18_000),
    )  # fmt: skip


def _deliver(intake: Intake, folder: Path) -> None:
    for name in MESSAGES:
        payload = (folder / "live" / name).read_bytes()
        topic = f"v1/junction/R1/{name}"
        intake.handle(Received(topic, payload, BEGIN_US / 1e6, retained=False))


@contextmanager
def _copied(folder: Path, name: str) -> Iterator[Path]:
    """Copy a database to a place of its own, as it grows files beside it."""
    place = folder / "live" / "opened"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    yield Path(shutil.copy(folder / "live" / name, place))
    shutil.rmtree(place)


def tile_set(folder: Path) -> None:
    """Read a set of tiles; it has one form only."""
    data = (folder / "live" / "tiles").read_bytes()
    assert pack_tiles(unpack_tiles(data)) == data


def hits(folder: Path) -> None:
    """Read frames, and again as they were written."""
    content = (folder / "live" / "hits").read_bytes()[8:]
    found = unpack_hits(content, tiles=40)
    again = unpack_hits(
        pack_hits(found.frames, pose=found.pose, fingerprint=found.tiles_begin), tiles=40
    )
    assert (again.pose, again.tiles_begin) == (found.pose, found.tiles_begin)
    for one, other in zip(found.frames, again.frames, strict=True):
        assert one.tiles.tolist() == other.tiles.tolist()
        assert one.time_us == other.time_us


def detections(folder: Path) -> None:
    """Read returns, and again as they were written."""
    pose, found = unpack_detections((folder / "live" / "detections").read_bytes()[8:])
    again = unpack_detections(pack_detections(found, pose=pose))[1]
    for one, other in zip(found, again, strict=True):
        assert one.time_us == other.time_us
        for name in ("points", "rates", "rcs_db"):
            assert getattr(one, name).tolist() == getattr(other, name).tolist()
        one.as_rows()


def messages(folder: Path) -> None:
    """Take what a sensor sends."""
    with Journal(Path(":memory:"), fingerprint=_road(folder).fingerprint) as journal:
        _taken(folder, journal)


def hour(folder: Path) -> None:
    """Take what a sensor sends, and write its hour."""
    with Journal(Path(":memory:"), fingerprint=_road(folder).fingerprint) as journal:
        _write(folder, _taken(folder, journal), journal)


def _taken(folder: Path, journal: Journal) -> Intake:
    """Return an intake after what a sensor sends, and bring it to the disk."""
    intake = _intake(folder, journal)
    list(intake.resume(BEGIN_US, BEGIN_US + 10_000_000))
    _deliver(intake, folder)
    journal.commit()
    health = [each.health for each in intake.sensors.values()]
    prometheus_text(health, {})
    for each in health:
        assert all(len(text.splitlines()) == 1 for text in each.alarms.values()), each.alarms
    return intake


def kept_journal(folder: Path) -> None:
    """Go on from a journal."""
    road = _road(folder)
    with (
        _copied(folder, "journal") as path,
        Journal(path, fingerprint=road.fingerprint) as journal,
    ):
        _write(folder, _taken(folder, journal), journal)


def kept_vehicles(folder: Path) -> None:
    """Go on from a store of vehicles, follow what waits in it, and write its hours."""
    roads, described = _lanes(folder / "map.osm", folder / "tiles.gpkg")
    tiles, road = gr.read_tiles(folder / "tiles.gpkg"), _road(folder)
    with _copied(folder, "followed") as path:
        site = FollowedSite(
            sensors=["R1"], tiles=tiles, fingerprint=road.fingerprint, graph=roads, map=described,
            sight="view only", folder=path.parent,
        )  # fmt: skip
        store = VehicleStore(path, fingerprint=road.fingerprint)
        follower = VehicleFollower(site=site, store=store, settings=DEFAULTS)
        follower.resume()
        list(follower.again(0))
        while (span := follower.due(everything=True)) is not None:
            follower.finish(*follower.begin(span))
        for number in store.batch_hours(HOUR_STEPS):
            follower.write_hour(number)
        store.close()


@cache
def _lanes(map_path: Path, tiles: Path) -> tuple[Any, dict[str, Any]]:
    roads, described = map_of_tiles(map_path, gr.read_tiles(tiles))
    return lane_graph(roads.lanelets), described


def _write(folder: Path, intake: Intake, journal: Journal) -> None:
    """Write the hours of what was taken, and read them."""
    road, made = _road(folder), folder / "live" / "hours"
    shutil.rmtree(made, ignore_errors=True)
    store = Store(
        folder=made, fingerprint=road.fingerprint, tile_id=road.tile_id, sight="view only"
    )
    for number in list(intake.touched):
        path = store.write_hour(number, journal, intake.poses, intake._book.tiles, ["R1"])
        if path is not None:
            found = read_stored_hits(path)
            list(found.hits_by_sensor(found.sensors))
            list(found.frame_log(found.sensors))
    shutil.rmtree(made, ignore_errors=True)


def buffer(folder: Path) -> None:
    """Send what waits in a disk buffer, add to it, and drop what is stored."""
    with (
        _copied(folder, "buffer") as path,
        DiskBuffer(path, most_bytes=1 << 30, fingerprint=_road(folder).fingerprint) as found,
    ):
        outbox = _outbox(found)
        outbox._send()
        outbox.put(HITS, b"more")
        outbox._send()
        found.acknowledge(2)
        assert len(found) <= found.last


def acknowledgement(folder: Path) -> None:
    """Hear what fusion says."""
    from paho.mqtt.client import MQTTMessage

    with DiskBuffer(Path(":memory:"), most_bytes=1 << 30, fingerprint="00") as found:
        for _ in range(3):
            found.append(HITS, b"0")
        found.stream = STREAM
        outbox = _outbox(found)
        message = MQTTMessage(topic=b"v1/junction/R1/ack")
        message.payload = (folder / "live" / "ack").read_bytes()
        outbox._link._on_message(None, None, message)
        outbox.pump()
        outbox._send()
        assert 0 <= outbox.stored <= found.last


def _outbox(found: DiskBuffer) -> Outbox:
    link = Link(BrokerAddress.of("mqtt://127.0.0.1:1883"), name="junction-R1")
    return Outbox(found, link, SensorTopics("junction", "R1"), figures=dict)


def sensor_file(folder: Path) -> None:
    """Read the file of a sensor and what it names."""
    file = read_edge_file(folder / "SENSOR.toml")
    file.address()
    Edge(file)


def live_site(folder: Path) -> None:
    """Read the file of a live site."""
    read_live_site(folder / "LIVE.toml").address()


def sight(folder: Path) -> None:
    """Read a file of sight."""
    found = SightFile(folder / "sight.gpkg", _road(folder))
    found.read([gr.read_pose(folder / "R1.json")])
    assert found.digest
