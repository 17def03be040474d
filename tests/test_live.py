"""The live system with a real broker: what it stores is what the batch counts, whatever breaks."""

import math
import time
from dataclasses import replace
from threading import Event

import numpy as np
import pytest
from live_programs import HeldEdge, Lines, assert_same_tables, measured, stored
from live_site import LONGEST_S, SAMPLE, Background, LiveSite, needs_mosquitto, wait_for

import gis_radar as gr
from gis_radar.errors import OutputError
from gis_radar.live.broker import BrokerAddress, Link, Received
from gis_radar.live.edge import Edge
from gis_radar.live.fusion import Fusion
from gis_radar.live.payload import (
    HITS,
    POSE,
    Envelope,
    PoseContent,
    pack_hits,
    pack_message,
)
from gis_radar.live.settings import read_edge_file, read_live_site
from gis_radar.measures.hit_counter import CountedFrame

NAMES = ("R1", "R2")
pytestmark = needs_mosquitto


@pytest.fixture
def site(tmp_path, once):
    """Give a live site whose broker runs."""
    made = LiveSite(tmp_path, once)
    made.broker.start()
    yield made
    made.broker.kill()


@pytest.fixture(scope="session")
def batch(once):
    """Give the dataset that the batch makes of the sample's recordings."""
    return gr.open_dataset(once("live_batch", measured(NAMES)))


def test_what_fusion_stores_equals_the_batch(site, batch):
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    edges = [Edge(read_edge_file(site.edge(name))) for name in NAMES]
    work = [Background(each.run) for each in edges]
    for each in work:
        each.join()
        each.end()
    middle.end()
    hours = sorted((site.folder / "live" / "hits").iterdir())
    assert [path.name for path in hours] == ["2025-06-12T07Z"]
    assert_same_tables(stored(site.folder), batch)
    assert [edge.frames for edge in edges] == [2000, 2002]


def test_a_broker_that_is_killed_and_a_fusion_that_begins_anew_lose_nothing(site, once):
    """Everything breaks in the midst of a replay; fusion is left without a word, as if killed."""
    middle = Fusion(read_live_site(site.file))
    first = Background(middle.run)
    edge = HeldEdge(read_edge_file(site.edge("R1")))
    edge.until = 600
    work = Background(edge.run)
    wait_for(lambda: middle.sensors["R1"].health.counts["frames"] > 200)
    site.broker.kill()
    edge.until = 1000
    wait_for(lambda: edge.frames == 1000)  # it goes on, on disk
    middle._finish = lambda: None  # what it has taken and not committed is gone
    first.end()
    site.broker.start()
    again = Fusion(read_live_site(site.file))
    second = Background(again.run)
    edge.until = math.inf
    work.join()
    work.end()
    second.end()
    assert again.sensors["R1"].health.counts["frames"] > 400
    batch = gr.open_dataset(once("live_batch_R1", measured(["R1"])))
    assert_same_tables(stored(site.folder), batch)


def test_nobody_gets_past_the_broker(site):
    """A wrong password is refused, and a sensor's neither reads nor writes what is another's."""
    said = Lines()
    address = BrokerAddress.of(f"mqtt://127.0.0.1:{site.port}", user="R1", password="wrong")  # noqa: S106
    stranger = Link(address, name="stranger", reporter=said)
    stranger.open()
    wait_for(lambda: said.told("refuses the link"))
    stranger.close()
    password = (site.folder / "broker" / "password_of_R1").read_text().strip()
    known = BrokerAddress.of(f"mqtt://127.0.0.1:{site.port}", user="R1", password=password)
    everything = ("v1/#", "v1/junction/R2/hits", "v1/junction/R1/ack")
    one = Link(known, name="junction-R1", topics=everything, reporter=said)
    one.open()
    wait_for(lambda: one.connected)
    one.publish("v1/junction/R2/hits", b"foreign")
    wait_for(lambda: said.told("does not take a message"))
    assert one.refused == 1
    one.publish("v1/junction/R1/hits", b"own")
    assert one.take(0.5) is None  # its own hits, and R2's, are not its to read
    twin = Link(known, name="junction-R1", reporter=said)
    twin.open()
    wait_for(lambda: said.told("the same name"))
    for each in (one, twin):
        each.close()


def test_a_sensor_that_takes_the_name_of_fusion_ends_nobodys_link(site):
    links = {}
    for user, name in {"fusion": "junction-fusion", "R1": "junction-R1"}.items():
        known = replace(read_live_site(site.file).address(), user=user,
                        password=site.password(user))  # fmt: skip
        links[user] = Link(known, name=name, topics=(f"v1/junction/{user}/ack",))
    thief = Link(links["R1"]._address, name="junction-fusion")
    links["fusion"].open()
    wait_for(lambda: links["fusion"].connected)
    thief.open()
    wait_for(lambda: thief.connected)
    time.sleep(3.0)
    assert thief.connected
    assert links["fusion"].connected
    assert links["fusion"].connections == 1
    for each in (thief, links["fusion"]):
        each.close()


def test_odd_messages_are_counted_and_the_rest_goes_on(site):
    """Other versions, tiles, sensors, noise and doubles: a line and a count each, no frame."""
    said = Lines()
    fusion = Fusion(read_live_site(site.file), reporter=said)
    fusion._link = None

    def send(payload, kind="hits", sensor="R1"):
        topic = f"v1/junction/{sensor}/{kind}"
        fusion.intake.handle(Received(topic, payload, 1.0, retained=False))

    stream, tiles = b"abcd", fusion._book.road.fingerprint
    state = fusion.sensors["R1"]

    def message(number, content, kind=HITS):
        envelope = Envelope(kind=kind, stream=stream, number=number, previous=number - 1)
        return pack_message(envelope, content)

    def pose(fingerprint=tiles):
        record = gr.read_pose(SAMPLE / "R1.json").as_dict()
        return PoseContent(pose=record, since_step=0, fingerprint=fingerprint).pack()

    frame = CountedFrame(
        time_us=1_749_713_400_000_000, detections=3, moving=1, wild=0, checksum=5,
        tiles=np.array([4, 9]),
    )  # fmt: skip
    hits = pack_hits([frame], pose=1, fingerprint=tiles)
    send(hits, sensor="R9")
    assert said.told("R9: no sensor of this site")
    send(message(1, pose("00" * 16), POSE))
    assert (state.received, "refused" in state.health.alarms) == (0, True)
    send(b"\x09" + message(1, pose(), POSE)[1:])
    assert state.refused == "a message of version 9, expected 1"
    send(message(1, pose(), POSE))
    assert (state.received, state.health.alarms) == (1, {})
    send(message(2, hits))
    send(message(2, hits))  # a double
    assert (state.received, state.health.counts["duplicates"]) == (2, 1)
    send(message(4, hits))  # 3 is missing
    assert (state.received, state.health.counts["gaps"], state.due) == (2, 1, True)
    send(message(3, pack_hits([frame], pose=1, fingerprint="11" * 16)))
    assert "expected" in state.refused
    send(message(3, hits[:-1]))  # damaged where it was made: passed over
    assert (state.received, state.health.counts["damaged"]) == (3, 1)
    for noise in (b"", b"\x01", bytes(70_000), b"\xff" * 50):
        send(noise)
        send(noise, kind="status")
    moved = gr.read_pose(SAMPLE / "R1.json").as_dict()
    lost = PoseContent(pose=moved, since_step=0, fingerprint=tiles, trusted=False).pack()
    send(message(4, lost, POSE))
    send(message(5, pack_hits([frame], pose=4, fingerprint=tiles)))
    assert (state.received, state.health.counts["not_counted"]) == (5, 1)
    assert "moved" in state.health.alarms
    assert state.health.counts["frames"] == 1
    fusion._commit(wait=True)
    assert state.stored == 5
    again = fusion._journal.mark("R1", stream.hex())
    assert again == (5, 5)
    assert fusion.metrics().count("gis_radar_not_counted_total") == 4
    fusion._journal.__exit__()


def test_a_disk_that_is_slow_or_full_holds_no_frame_up(site, monkeypatch):
    """Frames are taken while others go to the disk; acknowledged is what has come there."""
    said = Lines()
    fusion = Fusion(read_live_site(site.file), reporter=said)
    state, journal = fusion.sensors["R1"], fusion._journal
    fingerprint = fusion._book.road.fingerprint
    disk, full, write = Event(), [False], journal.write

    def slow():
        disk.wait(LONGEST_S)
        if full[0]:
            raise OutputError("the disk is full")
        write()

    monkeypatch.setattr(journal, "write", slow)

    def send(number):
        frame = CountedFrame(
            time_us=1_749_713_400_000_000 + 50_000 * number, detections=3, moving=1, wild=0,
            checksum=5, tiles=np.array([4, 9]),
        )  # fmt: skip
        content = pack_hits([frame], pose=1, fingerprint=fingerprint)
        if number == 1:
            record = gr.read_pose(SAMPLE / "R1.json").as_dict()
            content = PoseContent(pose=record, since_step=0, fingerprint=fingerprint).pack()
        kind = POSE if number == 1 else HITS
        envelope = Envelope(kind=kind, stream=b"abcd", number=number, previous=number - 1)
        payload = pack_message(envelope, content)
        topic = f"v1/junction/R1/{'pose' if number == 1 else 'hits'}"
        fusion.intake.handle(Received(topic, payload, 1.0, retained=False))

    for number in (1, 2):
        send(number)
    fusion._commit()
    send(3)
    fusion._commit()  # one at a time
    assert (state.received, state.stored) == (3, 0)
    disk.set()
    fusion._take_committed(wait=True)
    assert (state.stored, journal.mark("R1", b"abcd".hex())) == (2, (3, 2))
    full[0] = True
    for _ in range(3):
        fusion._commit(wait=True)
    send(4)
    assert len([line for line in said.lines if "the disk is full" in line]) == 1
    assert (state.stored, journal.mark("R1", b"abcd".hex())) == (2, (4, 2))
    full[0] = False
    fusion._commit(wait=True)
    assert (state.stored, journal.mark("R1", b"abcd".hex())) == (4, (4, 4))
    kept = [row.time_us for rows in journal.frames("R1", 0, 2**60) for row in rows]
    assert len(kept) == len({*kept}) == 3
    journal.__exit__()
