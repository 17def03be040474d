"""What breaks in the field, with a real broker and real programs: nothing is lost or doubled.

The cheapest run in `make test`, all in `make live-test`.
"""

import json
import math
import os
import shutil
import time
import urllib.request
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from live_programs import (
    Cable,
    FullDisk,
    HeldEdge,
    Lines,
    Program,
    assert_all_recorded,
    assert_equal_to_batch,
    frames_on_disk,
    frames_that_wait,
    takes_long,
)
from live_site import (
    LONGEST_S,
    OF_THE_SAMPLE,
    SAMPLE,
    Background,
    LiveSite,
    free_port,
    needs_mosquitto,
    wait_for,
)

from gis_radar.live import (
    BrokerAddress,
    Edge,
    Fusion,
    Link,
    SensorTopics,
    read_edge_file,
    read_live_site,
)
from gis_radar.live.wire.payload import MOST_BYTES

pytestmark = [needs_mosquitto, pytest.mark.usefixtures("measured_in_a_thread")]


@pytest.fixture
def site(tmp_path, once):
    """Give a live site of one sensor whose broker runs."""
    made = LiveSite(tmp_path, once, names=("R1",))
    made.broker.start()
    yield made
    made.broker.kill()


@takes_long
def test_sensor_and_fusion_that_are_killed_go_on_where_they_were(site):
    """With -9, each in the midst of it: what the sensor's disk held is stored, and but once."""
    site.recordings = SAMPLE
    middle = Program(site.folder, "live", site.file)
    edge = Program(site.folder, "edge", site.edge("R1", source="speed = 25.0"))
    buffer = site.folder / "R1.buffer"
    wait_for(lambda: edge.told("linked") and middle.told("linked"))
    time.sleep(0.7)
    middle.kill()
    time.sleep(0.3)
    edge.kill()
    kept, waits = frames_on_disk(site.folder, "R1"), frames_that_wait(buffer)
    assert waits, edge.said
    again = Program(site.folder, "live", site.file)
    wait_for(lambda: again.told("linked"))
    # it replays from the begin: what was sent comes again, under other numbers
    second = Program(site.folder, "edge", site.edge("R1", source="speed = 0.0"))
    second.wait()
    again.end()
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])
    assert kept | waits <= frames_on_disk(site.folder, "R1")


@takes_long
def test_killed_again_and_again_while_it_measures(site):
    """At the times of now, which come not again: nothing that reached the sensor's disk is lost."""
    site.recordings, source = SAMPLE, 'speed = 1.0\nloop = "100s"'
    programs = {}

    def start(name):
        words = ("live", site.file) if name == "live" else ("edge", site.edge("R1", source=source))
        programs[name] = Program(site.folder, *words)

    start("live")
    start("edge")
    waited, kept = set(), set()
    rng = np.random.default_rng(7)
    for name in ("edge", "live", "edge", "live", "edge"):
        wait_for(lambda: all(each.told("linked") for each in programs.values()))
        time.sleep(rng.uniform(1.0, 5.0))
        programs[name].kill()
        if name == "edge":
            waited |= frames_that_wait(site.folder / "R1.buffer")
        else:
            kept |= frames_on_disk(site.folder, "R1")
        start(name)
    wait_for(lambda: all(each.told("linked") for each in programs.values()))
    time.sleep(5.0)
    programs["edge"].end()
    last = frames_that_wait(site.folder / "R1.buffer")
    programs["live"].end()
    found = frames_on_disk(site.folder, "R1")
    assert waited | kept <= found | last
    holes = np.flatnonzero(np.diff(sorted(found)) > 500_000)
    assert len(holes) <= 3  # one for each time that the sensor's program was dead


@pytest.mark.parametrize(
    ("speed", "silent"),
    [(0.0, False), pytest.param(100.0 / 64.0, True, marks=takes_long)],
    ids=["refused", "a minute without a word"],
)
def test_a_link_that_is_cut_loses_nothing(site, speed, silent):
    if silent:
        site.recordings = SAMPLE
    cable = Cable(site.port)
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    edge = HeldEdge(read_edge_file(site.edge("R1", source=f"speed = {speed}", port=cable.port)))
    edge.until = 200
    work = Background(edge.run)
    counts = fusion.sensors["R1"].health.counts
    wait_for(lambda: counts["frames"] > 100)
    cable.cut(silent=silent)
    before = edge.frames
    edge.until = math.inf if silent else 400
    wait_for(lambda: edge.frames > before)  # it measures on
    if silent:
        time.sleep(60.0)
    else:
        wait_for(lambda: edge.frames == 400 and cable.refused)
    edge.until = math.inf
    cable.mend()
    work.join()
    work.end()
    middle.end()
    cable.close()
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])


def test_fusion_on_a_full_disk_acknowledges_nothing_and_goes_on_once_there_is_room(tmp_path, once):
    disk = FullDisk(tmp_path / "live", "150k")
    try:
        site = LiveSite(tmp_path, once, names=("R1",))
        site.broker.start()
        said = Lines()
        middle = Background(Fusion(read_live_site(site.file), reporter=said).run)
        edge = Edge(read_edge_file(site.edge("R1")))
        work = Background(edge.run)
        wait_for(lambda: said.told("the disk is full"))
        wait_for(lambda: edge.frames == 600)
        time.sleep(1.0)
        assert not edge.outbox.empty
        disk.grow("40m")
        work.join()
        work.end()
        middle.end()
        site.broker.kill()
        assert_all_recorded(site, ["R1"])
        assert_equal_to_batch(site, ["R1"])
    finally:
        disk.close()


def test_nothing_is_acknowledged_while_the_disk_is_at_work(tmp_path, once, monkeypatch):
    """A loss of power at that time takes it."""
    site = LiveSite(tmp_path, once, names=("R1",))
    site.broker.start()
    sync, may_write = os.fsync, Event()
    fusion = Fusion(read_live_site(site.file))

    def slow(handle):
        if Path(f"/proc/self/fd/{handle}").resolve().suffix == ".spool":
            may_write.wait(60.0)
        sync(handle)

    monkeypatch.setattr(os, "fsync", slow)
    middle = Background(fusion.run)
    edge = Edge(read_edge_file(site.edge("R1")))
    work = Background(edge.run)
    try:
        wait_for(lambda: fusion.sensors["R1"].health.counts["frames"] > 0)
        time.sleep(3.0)  # commits are a second apart
        assert edge.outbox.stored == 0
    finally:
        may_write.set()
        work.join()
        work.end()
        middle.end()
        site.broker.kill()
    assert_all_recorded(site, ["R1"])


def test_fusion_on_a_disk_without_an_inode_goes_on_and_measures_once_there_is_one(
    tmp_path, once, monkeypatch
):
    disk = FullDisk(tmp_path / "live", "60m", files=300)
    try:
        site = LiveSite(tmp_path, once, names=("R1",), of_live=OF_THE_SAMPLE + '\nevery = "1s"')
        site.broker.start()
        said = Lines()
        monkeypatch.setattr("gis_radar.live.hours.jobs.SETTLE_S", 1.0)
        monkeypatch.setattr("gis_radar.live.hours.jobs.RETRY_S", 1.0)
        fusion = Fusion(read_live_site(site.file), reporter=said)
        middle = Background(fusion.run)
        wait_for(lambda: fusion.link is not None and fusion.link.connected)
        disk.fill()
        edge = Edge(read_edge_file(site.edge("R1")))
        work = Background(edge.run)
        work.join()
        work.end()  # all is acknowledged: the file that is open takes it
        wait_for(lambda: said.told("spool"))
        step = fusion.state().step
        wait_for(lambda: fusion.state().step > step + 40 and "hours_waiting" in fusion.metrics())
        errors = [line for line in said.lines if "cannot be written" in line]
        assert len(errors) == len(set(errors)) >= 1
        disk.free()
        dataset = site.folder / "live" / "dataset" / "hours"
        wait_for(lambda: list(dataset.glob("*/*.json")))
        middle.end()
        site.broker.kill()
        assert_all_recorded(site, ["R1"])
        assert_equal_to_batch(site, ["R1"])
    finally:
        disk.close()


@takes_long
def test_a_sensor_on_a_full_disk_loses_what_is_new_and_says_so(tmp_path, once):
    """What waits stays; what is lost is counted; it goes on once there is room."""
    site = LiveSite(tmp_path, once, names=("R1",), recordings=SAMPLE)
    disk = FullDisk(tmp_path / "small", "200k")
    try:
        path = site.edge("R1", source="speed = 20.0")
        path.write_text(path.read_text().replace('"R1.buffer"', '"small/R1.buffer"'))
        said = Lines()
        edge = Edge(read_edge_file(path), reporter=said)
        work = Background(edge.run)  # no broker, so nothing is acknowledged
        wait_for(lambda: edge.frames and edge.outbox.lost > 10)
        assert said.told("the disk is full")
        lost = edge.outbox.lost
        disk.grow("40m")
        site.broker.start()
        middle = Background(Fusion(read_live_site(site.file)).run)
        work.join()
        work.end()
        middle.end()
        site.broker.kill()
        assert len(frames_on_disk(site.folder, "R1")) == edge.frames - edge.outbox.lost
        assert edge.outbox.lost < lost + 1000
    finally:
        disk.close()


class Stranger:
    """A client that sends what it likes in the name of a sensor, or hears what fusion may."""

    def __init__(self, site, user):
        self.said = Lines()
        known = BrokerAddress.of(site.address, user=user, password=site.password(user))
        topics = tuple(SensorTopics("junction", "+").of(kind) for kind in ("detections", "pose"))
        self.link = Link(known, name=user, topics=topics if user == "observer" else (),
                         reporter=self.said)  # fmt: skip
        self.link.open()
        wait_for(lambda: self.link.connected)

    def send(self, payload, kind="detections", sensor="R1"):
        self.link.publish(f"v1/junction/{sensor}/{kind}", payload)

    def hear(self, number):
        found = []
        while len(found) < number and (message := self.link.take(LONGEST_S)) is not None:
            found.append(message)
        return found


def test_noise_and_replays_at_the_broker_change_nothing(tmp_path, once):
    """Damaged, oversized, replayed, doubled messages with the rights of the sensor."""
    site = LiveSite(tmp_path, once, names=("R1",))
    site.let_in("observer", "topic read v1/junction/#")
    site.let_in("stranger", "topic write v1/junction/R1/#")
    site.broker.start()
    said = Lines()
    fusion = Fusion(read_live_site(site.file), reporter=said)
    middle = Background(fusion.run)
    health = fusion.sensors["R1"].health
    listener, stranger = Stranger(site, "observer"), Stranger(site, "stranger")
    edge = Edge(read_edge_file(site.edge("R1")))
    work = Background(edge.run)
    heard = listener.hear(150)
    frames = [each for each in heard if each.topic.endswith("detections")]
    for each in frames[:100]:  # an attack by what went over the wire before
        stranger.send(each.payload)
    for noise in (b"", b"\x01", bytes(60_000), frames[0].payload[:20], frames[0].payload + b"\0"):
        stranger.send(noise)
        stranger.send(noise, kind="status")
        stranger.send(noise, kind="pose")
    work.join()
    stranger.send(bytes(MOST_BYTES + 5_000))  # cuts its sender off
    wait_for(lambda: stranger.said.told("is lost"))
    wait_for(lambda: health.counts["duplicates"] >= 90)
    assert health.counts["damaged"] >= 3
    work.end()
    middle.end()
    assert said.told("stopping: records what came")  # that may take minutes
    for each in (listener, stranger):
        each.link.close()
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])
    site.broker.kill()
    assert health.counts["frames"] == 600


@takes_long
def test_two_sensors_with_one_name_are_noticed_and_nothing_counts_twice(site):
    """Two programs, two buffers, one name: a line, an alarm, a turn for each, the same tables."""
    site.recordings = SAMPLE
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    health = fusion.sensors["R1"].health
    said = [Lines(), Lines()]
    files = [site.edge("R1", source="speed = 5.0", file=file) for file in ("R1", "R1-twin")]
    edges = [Edge(read_edge_file(file), reporter=lines)
             for file, lines in zip(files, said, strict=True)]  # fmt: skip
    work = [Background(each.run) for each in edges]
    alarms = set()

    def noticed():
        alarms.update(health.alarms)
        return "twins" in alarms and any(each.told("the same name") for each in said)

    wait_for(noticed)
    for each in work:
        each.join()
        each.end()
    middle.end()
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])
    assert [edge.outbox.empty for edge in edges] == [True, True]


def restored_broker(site, copy):
    """Kill the broker and start it with the disk that it had before."""
    site.broker.kill()
    shutil.copy(copy, site.folder / "disk" / "mosquitto.db")
    site.broker.start()


@pytest.mark.parametrize("what", ["broker", "edge"])
def test_an_older_copy_of_a_disk_that_is_put_back_loses_nothing(tmp_path, once, what):
    """What it acknowledged, or numbered, since then is not known to it; the page goes on."""
    page = f"127.0.0.1:{free_port()}"
    site = LiveSite(tmp_path, once, names=("R1",),
                    of_live=f'{OF_THE_SAMPLE}\n[live.page]\naddress = "{page}"')  # fmt: skip
    (tmp_path / "disk").mkdir()
    config = site.broker.config
    config.write_text(
        config.read_text().replace("persistence false", "persistence true")
        + f"persistence_location {tmp_path}/disk/\nautosave_interval 1\n"
    )
    site.broker.start()
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    health = fusion.sensors["R1"].health
    file = site.edge("R1")
    edge = HeldEdge(read_edge_file(file))
    edge.until = 200
    work = Background(edge.run)
    wait_for(lambda: health.counts["frames"] == 200 and edge.outbox.empty)
    disk = tmp_path / "disk" / "mosquitto.db" if what == "broker" else tmp_path / "R1.buffer"
    wait_for(disk.exists)
    time.sleep(1.5)  # it is written each second
    shutil.copy(disk, tmp_path / "copy")
    edge.until = 400
    wait_for(lambda: health.counts["frames"] == 400 and edge.outbox.empty)
    if what == "broker":
        restored_broker(site, tmp_path / "copy")
    else:
        work.end()
        for each in tmp_path.glob("R1.buffer*"):
            each.unlink()
        shutil.copy(tmp_path / "copy", disk)
        edge = HeldEdge(read_edge_file(file))
        work = Background(edge.run)
    edge.until = math.inf
    work.join()
    work.end()
    with urllib.request.urlopen(f"http://{page}/state.json") as answer:
        assert json.load(answer)["sensors"]["R1"]
    middle.end()
    site.broker.kill()
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])
