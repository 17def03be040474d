"""What breaks in the field, with a real broker and real programs: nothing is lost or doubled.

The cheapest run in `make test`, all in `make live-test`.
"""

import math
import sqlite3
import time
from contextlib import closing

import numpy as np
import pytest
from live_programs import (
    Cable,
    FullDisk,
    HeldEdge,
    Lines,
    Program,
    assert_same_tables,
    columns,
    measured,
    stored,
    takes_long,
)
from live_site import LONGEST_S, Background, LiveSite, needs_mosquitto, wait_for

import gis_radar as gr
from gis_radar.live.broker import BrokerAddress, Link, SensorTopics
from gis_radar.live.edge import Edge
from gis_radar.live.fusion import Fusion
from gis_radar.live.payload import HITS, MOST_BYTES, unpack_hits
from gis_radar.live.settings import read_edge_file, read_live_site

pytestmark = needs_mosquitto


@pytest.fixture
def site(tmp_path, once):
    """Give a live site of one sensor whose broker runs."""
    made = LiveSite(tmp_path, once, names=("R1",))
    made.broker.start()
    yield made
    made.broker.kill()


@pytest.fixture(scope="session")
def batch(once):
    """Give what the batch makes of the first sensor's recording."""
    return gr.open_dataset(once("live_batch_R1", measured(["R1"])))


def frames_on_disk(site):
    """Return the times (us) of frames in fusion's journal, read beside whoever writes it."""
    path = site.folder / "live" / "journal.sqlite"
    with closing(sqlite3.connect(path)) as database:
        return {time_us for (time_us,) in database.execute("SELECT time_us FROM frames")}


def frames_that_wait(buffer, tiles):
    """Return the times (us) of frames in a sensor's buffer, once its program is gone."""
    with closing(sqlite3.connect(buffer)) as database:
        rows = database.execute("SELECT content FROM messages WHERE kind = ?", (HITS,)).fetchall()
    return {f.time_us for (content,) in rows for f in unpack_hits(content, tiles=tiles).frames}


@takes_long
def test_sensor_and_fusion_that_are_killed_go_on_where_they_were(site, batch):
    """With -9, each in the midst of it: what the sensor's disk held is stored, and but once."""
    middle = Program(site.folder, "live", site.file)
    edge = Program(site.folder, "edge", site.edge("R1", source="speed = 25.0"))
    buffer = site.folder / "R1.buffer"
    wait_for(lambda: edge.told("linked") and middle.told("linked"))
    time.sleep(0.7)
    middle.kill()
    time.sleep(0.3)
    edge.kill()
    kept, waits = frames_on_disk(site), frames_that_wait(buffer, 10**6)
    assert waits, edge.said
    again = Program(site.folder, "live", site.file)
    wait_for(lambda: again.told("linked"))
    # it replays from the begin: what was sent comes again, under other numbers
    second = Program(site.folder, "edge", site.edge("R1", source="speed = 0.0"))
    second.wait()
    again.end()
    live = stored(site.folder)
    assert_same_tables(live, batch)
    (times, *_) = columns(live.frame_log(["R1"]))
    assert kept | waits <= set(times.tolist())


@takes_long
def test_killed_again_and_again_while_it_measures(site):
    """At the times of now, which come not again: nothing that reached the sensor's disk is lost."""
    source = 'speed = 1.0\nloop = "100s"'
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
            waited |= frames_that_wait(site.folder / "R1.buffer", 10**6)
        else:
            kept |= frames_on_disk(site)
        start(name)
    wait_for(lambda: all(each.told("linked") for each in programs.values()))
    time.sleep(5.0)
    programs["edge"].end()
    last = frames_that_wait(site.folder / "R1.buffer", 10**6)
    programs["live"].end()
    (times, *_) = columns(stored(site.folder).frame_log(["R1"]))
    assert len(set(times.tolist())) == len(times)
    assert waited | kept <= set(times.tolist()) | last
    holes = np.flatnonzero(np.diff(np.sort(times)) > 500_000)
    assert len(holes) <= 3  # one for each time that the sensor's program was dead


@pytest.mark.parametrize(
    ("speed", "silent"),
    [(0.0, False), pytest.param(100.0 / 64.0, True, marks=takes_long)],
    ids=["refused", "a minute without a word"],
)
def test_a_link_that_is_cut_loses_nothing(site, batch, speed, silent):
    cable = Cable(site.port)
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    edge = HeldEdge(read_edge_file(site.edge("R1", source=f"speed = {speed}", port=cable.port)))
    edge.until = 600
    work = Background(edge.run)
    counts = fusion.sensors["R1"].health.counts
    wait_for(lambda: counts["frames"] > 100)
    cable.cut(silent=silent)
    before = edge.frames
    edge.until = math.inf if silent else 1200
    wait_for(lambda: edge.frames > before)  # it measures on
    if silent:
        time.sleep(60.0)
    else:
        wait_for(lambda: edge.frames == 1200 and cable.refused)
    edge.until = math.inf
    cable.mend()
    work.join()
    work.end()
    middle.end()
    cable.close()
    assert_same_tables(stored(site.folder), batch)


def test_fusion_on_a_full_disk_acknowledges_nothing_and_goes_on_once_there_is_room(
    tmp_path, once, batch
):
    disk = FullDisk(tmp_path / "live", "400k")
    try:
        site = LiveSite(tmp_path, once, names=("R1",))
        site.broker.start()
        said = Lines()
        middle = Background(Fusion(read_live_site(site.file), reporter=said).run)
        edge = Edge(read_edge_file(site.edge("R1")))
        work = Background(edge.run)
        wait_for(lambda: said.told("the disk is full"))
        wait_for(lambda: edge.frames == 2000)
        time.sleep(1.0)
        assert not edge._outbox.empty
        assert said.told("nothing is acknowledged meanwhile")
        disk.grow("40m")
        work.join()
        work.end()
        middle.end()
        site.broker.kill()
        assert_same_tables(stored(site.folder), batch)
    finally:
        disk.close()


@takes_long
def test_a_sensor_on_a_full_disk_loses_what_is_new_and_says_so(tmp_path, once):
    """What waits stays; what is lost is counted; it goes on once there is room."""
    site = LiveSite(tmp_path, once, names=("R1",))
    disk = FullDisk(tmp_path / "small", "200k")
    try:
        path = site.edge("R1", source="speed = 20.0")
        path.write_text(path.read_text().replace('"R1.buffer"', '"small/R1.buffer"'))
        said = Lines()
        edge = Edge(read_edge_file(path), reporter=said)
        work = Background(edge.run)  # no broker, so nothing is acknowledged
        wait_for(lambda: edge.frames and edge._outbox.lost > 10)
        assert said.told("the disk is full")
        lost = edge._outbox.lost
        disk.grow("40m")
        site.broker.start()
        middle = Background(Fusion(read_live_site(site.file)).run)
        work.join()
        work.end()
        middle.end()
        site.broker.kill()
        (times, *_) = columns(stored(site.folder).frame_log(["R1"]))
        assert len(times) == edge.frames - edge._outbox.lost
        assert edge._outbox.lost < lost + 1000
    finally:
        disk.close()


class Stranger:
    """A client with a log-in that sends as R1, or hears what fusion may."""

    def __init__(self, site, user, *topics):
        self.said = Lines()
        site.let_in(
            user, *(f"topic read {each}" for each in topics), "topic write v1/junction/R1/#"
        )
        known = BrokerAddress.of(site.address, user=user, password=site.password(user))
        self.link = Link(known, name=user, topics=topics, reporter=self.said)
        self.link.open()
        wait_for(lambda: self.link.connected)

    def send(self, payload, kind="hits", sensor="R1"):
        self.link.publish(f"v1/junction/{sensor}/{kind}", payload)

    def hear(self, number):
        found = []
        while len(found) < number and (message := self.link.take(LONGEST_S)) is not None:
            found.append(message)
        return found


def test_noise_and_replays_at_the_broker_change_nothing(site, batch):
    """Damaged, oversized, replayed, doubled messages in a sensor's topics."""
    said = Lines()
    fusion = Fusion(read_live_site(site.file), reporter=said)
    middle = Background(fusion.run)
    health = fusion.sensors["R1"].health
    topics = SensorTopics("junction", "+")
    listener = Stranger(site, "listener", topics.of("hits"), topics.of("pose"))
    stranger = Stranger(site, "stranger")
    edge = Edge(read_edge_file(site.edge("R1")))
    work = Background(edge.run)
    heard = listener.hear(500)
    hits = [each for each in heard if each.topic.endswith("hits")]
    for each in hits[:200]:  # an attack by what went over the wire before
        stranger.send(each.payload)
    for noise in (b"", b"\x01", bytes(60_000), hits[0].payload[:20], hits[0].payload + b"\0"):
        stranger.send(noise)
        stranger.send(noise, kind="status")
        stranger.send(noise, kind="pose")
    work.join()
    stranger.send(bytes(MOST_BYTES + 5_000))  # cuts its sender off
    wait_for(lambda: stranger.said.told("is lost"))
    wait_for(lambda: health.counts["duplicates"] >= 190)
    assert health.counts["damaged"] >= 5
    work.end()
    middle.end()
    for each in (listener, stranger):
        each.link.close()
    assert_same_tables(stored(site.folder), batch)
    assert health.counts["frames"] == 2000


@takes_long
def test_two_sensors_with_one_name_are_noticed_and_nothing_counts_twice(site, batch):
    """Two programs, two buffers, one name: a line, an alarm, a turn for each, the same tables."""
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
    assert_same_tables(stored(site.folder), batch)
    assert [edge._outbox.empty for edge in edges] == [True, True]
