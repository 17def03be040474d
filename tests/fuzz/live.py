"""Inputs of the live system for the fuzzer (messages, buffer, spool, files), and readers."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import geopandas as gpd
import numpy as np

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.live import (
    Acknowledgement,
    BrokerAddress,
    DiskBuffer,
    Edge,
    Envelope,
    FrameDetections,
    Intake,
    Link,
    Outbox,
    PoseContent,
    Received,
    SensorTopics,
    Spool,
    SpoolFile,
    Windows,
    check_of,
    join_parts,
    key_of_pose,
    make_parts,
    pack_detections,
    pack_message,
    prometheus_text,
    read_edge_file,
    read_live_site,
    unpack_detections,
    waiting_hours,
)
from gis_radar.live.wire.outbox import ONLINE_STATUS, status_message
from gis_radar.measures import FrameCounter
from gis_radar.scans import SightTiles

STREAM, BEGIN_US = b"abcd", 1_700_000_000_000_000
MESSAGES = ("status", "pose", "detections")  # in the order in which they come
SENSOR = """sensor = "R1"
site = "junction"
tiles = "tiles.gpkg"
pose = "R1.json"
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
[buffer]
megabytes = 400.0
"""
LIVE = """[live]
site = "junction"
tiles = "tiles.gpkg"
lateness = "200ms"
interval = "15min"
broker = { address = "mqtt://127.0.0.1:1883", password_file = "password" }
[live.page]
address = "127.0.0.1:8080"
names = ["traffic.example"]
"""


def build(folder: Path) -> None:
    """Write sound inputs of the live system beside those of the other kinds."""
    place = folder / "live"
    place.mkdir()
    road, pose = _road(folder), gr.read_pose(folder / "R1.json")
    message = PoseContent(pose=pose.as_dict(), fingerprint=road.fingerprint).pack()
    points = np.array([[600, 150, -400], [700, -150, -400]], np.int64)
    frames = [
        FrameDetections(
            time_us=BEGIN_US + 50_000 * k, points=points, rates=points[:, 0],
            rcs_db=points[:, 1] // 10,
        )
        for k in range(3)
    ]  # fmt: skip
    content = pack_detections(frames, pose=key_of_pose(message))
    envelope = Envelope(stream=STREAM, number=1, first=True)
    status = status_message(
        ONLINE_STATUS, stream=STREAM.hex(), lost=0, fingerprint=road.fingerprint
    )
    (place / "status").write_bytes(status)
    (place / "pose").write_bytes(message)
    (place / "detections").write_bytes(pack_message(envelope, content))
    ack = Acknowledgement(stream=STREAM.hex(), stored=2, check=check_of(b"0"), session="12345678")
    (place / "ack").write_bytes(ack.pack())
    with DiskBuffer(place / "buffer", most_bytes=1 << 30, fingerprint=road.fingerprint) as buffer:
        buffer.add_pose(message)
        for _ in range(3):
            buffer.append(content)
    spool = Spool(place / "made")
    intake = _intake(folder, spool)
    spool.rotate()
    _deliver(intake, folder)
    spool.collect()
    spool.write()
    spool.rotate()
    shutil.move(spool.closed[0], place / "spool")
    spool.close()
    shutil.rmtree(place / "made")
    (folder / "password").write_text("secret\n")
    (folder / "SENSOR.toml").write_text(SENSOR)
    (folder / "LIVE.toml").write_text((folder / "SITE.toml").read_text() + LIVE)


@cache
def _tiles(path: Path, changed: int) -> SightTiles:
    table: gpd.GeoDataFrame = gr.read_tiles(path)
    return SightTiles.of(table)


def _road(folder: Path) -> SightTiles:
    path = folder / "tiles.gpkg"
    return _tiles(path, path.stat().st_mtime_ns)


def _intake(folder: Path, spool: Spool, windows: Windows | None = None) -> Intake:
    road = _road(folder)
    return Intake(
        ["R1"], spool=spool, road=road,
        counter=FrameCounter(road), windows=windows or Windows(0.2),
        oldest_s=1e6,
    )  # fmt: skip


def _deliver(intake: Intake, folder: Path) -> None:
    for name in MESSAGES:
        payload = (folder / "live" / name).read_bytes()
        topic = f"v1/junction/R1/{name}"
        intake.handle(Received(topic, payload, BEGIN_US / 1e6, retained=False))


@contextmanager
def _copied(folder: Path, name: str) -> Iterator[Path]:
    """Copy a file to a place of its own, as it grows files beside it."""
    place = folder / "live" / "opened"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    yield Path(shutil.copy(folder / "live" / name, place))
    shutil.rmtree(place)


def detections(folder: Path) -> None:
    """Read returns, and again as they were written."""
    pose, found = unpack_detections((folder / "live" / "detections").read_bytes()[7:])
    again = unpack_detections(pack_detections(found, pose=pose))[1]
    for one, other in zip(found, again, strict=True):
        assert one.time_us == other.time_us
        for name in ("points", "rates", "rcs_db"):
            assert getattr(one, name).tolist() == getattr(other, name).tolist()
        one.as_rows()


def messages(folder: Path) -> None:
    """Take what a sensor sends, and make its recordings."""
    place = folder / "live" / "taken"
    shutil.rmtree(place, ignore_errors=True)
    spool = Spool(place / "spool")
    windows = Windows(0.2)
    intake = _intake(folder, spool, windows)
    spool.rotate()
    _deliver(intake, folder)
    list(windows.close(BEGIN_US + 10_000_000))
    health = [each.health for each in intake.sensors.values()]
    prometheus_text(health, {})
    for each in health:
        assert all(len(text.splitlines()) == 1 for text in each.alarms.values()), each.alarms
    spool.collect()
    spool.write()
    spool.rotate()
    spool.close()
    _recorded(place, spool.closed[0])
    shutil.rmtree(place)


def kept_spool(folder: Path) -> None:
    """Go on from a file of the spool, and make its recordings."""
    with _copied(folder, "spool") as path:
        spool = Spool(path.parent / "more")
        intake = _intake(folder, spool)
        intake.resume([SpoolFile(path)])
        spool.rotate()
        _deliver(intake, folder)
        spool.close()
        _recorded(path.parent, path)


def _recorded(folder: Path, spooled: Path) -> None:
    make_parts(folder, spooled)
    for hour in waiting_hours(folder):
        path = join_parts(folder, "R1", hour, QUIET)
        if path is not None:
            assert list(gr.open_recording(path).read())
            gr.read_track(next(path.parent.glob(f"{path.stem}.[jc]s*")))


def buffer(folder: Path) -> None:
    """Send what waits in a disk buffer, add to it, and drop what is stored."""
    with (
        _copied(folder, "buffer") as path,
        DiskBuffer(path, most_bytes=1 << 30, fingerprint=_road(folder).fingerprint) as found,
    ):
        outbox = _outbox(found, _Linked())
        outbox.pump()
        outbox.put(b"more")
        outbox.pump()
        found.acknowledge(2)
        assert len(found) <= found.last


def acknowledgement(folder: Path) -> None:
    """Hear what fusion says."""
    with DiskBuffer(Path(":memory:"), most_bytes=1 << 30, fingerprint="00") as found:
        for _ in range(3):
            found.append(b"0")
        found.stream = STREAM
        link = _Linked()
        outbox = _outbox(found, link)
        payload = (folder / "live" / "ack").read_bytes()
        link.received.append(Received("v1/junction/R1/ack", payload, 1.0, retained=False))
        outbox.pump()
        assert 0 <= outbox.stored <= found.last


class _Linked(Link):
    """A link that is there, and brings what is put into it."""

    connected = True

    def __init__(self) -> None:
        super().__init__(BrokerAddress.of("mqtt://127.0.0.1:1883"), name="junction-R1")
        self.received: list[Received] = []

    def take(self, _timeout_s: float) -> Received | None:
        return self.received.pop(0) if self.received else None


def _outbox(found: DiskBuffer, link: Link) -> Outbox:
    return Outbox(found, link, SensorTopics("junction", "R1"), figures=dict)


def sensor_file(folder: Path) -> None:
    """Read the file of a sensor and what it names."""
    file = read_edge_file(folder / "SENSOR.toml")
    file.address()
    Edge(file)


def live_site(folder: Path) -> None:
    """Read the file of a live site."""
    read_live_site(folder / "LIVE.toml").address()
