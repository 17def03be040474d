"""What may go wrong at a sensor, without a network: what waits there is never lost in silence."""

import shutil
import sqlite3
import threading
from functools import partial
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from live_programs import Lines
from live_site import LONGEST_S, SAMPLE, wait_for

import gis_radar as gr
from gis_radar.base import NoAnswerError
from gis_radar.live import (
    Acknowledgement,
    DiskBuffer,
    Envelope,
    FrameDetections,
    Outbox,
    Radar,
    Received,
    SensorTopics,
    check_of,
    frames_of_recording,
    pack_detections,
    pack_message,
    unpack_detections,
    unpack_message,
)
from gis_radar.live.own_pose import WAITING_FRAMES, PoseFollower
from gis_radar.live.wire.payload import MOST_BYTES, MOST_CONTENT, in_parts

PRINT = "00112233445566778899aabbccddeeff"
STREAM = b"abcd"


class Database(sqlite3.Connection):
    """A database whose disk is full for as long as `full` is set."""

    full = False

    def execute(self, query, *values):
        if Database.full and query.startswith(("INSERT", "DELETE")):
            raise sqlite3.OperationalError("database or disk is full")
        return super().execute(query, *values)


class NoLink:
    """A link that brings what a test puts into it."""

    def __init__(self, *received):
        self.received, self.connected, self.connections, self.sent = [*received], True, 1, []

    def take(self, _timeout_s):
        return self.received.pop(0) if self.received else None

    def publish(self, topic, payload, *, retain=False, qos=1):
        del qos
        self.sent.append((topic.rpartition("/")[2], payload, retain))

    def messages(self):
        """Return stream and number of the frames that were sent."""
        found = [unpack_message(data)[0] for kind, data, _ in self.sent if kind == "detections"]
        return [(each.stream, each.number) for each in found]


def outbox_of(buffer, link, reporter=None):
    return Outbox(buffer, link, SensorTopics("s", "R1"), figures=dict, reporter=reporter or Lines())


def ack(buffer, stored, content=None, *, stream=None):
    content = bytes([stored - 1]) * 9 if content is None else content
    found = Acknowledgement(
        stream=(stream or buffer.stream).hex(), stored=stored, check=check_of(content), session="a"
    )
    return Received("v1/s/R1/ack", found.pack(), 1.0, retained=True)


def filled(path, count=5):
    buffer = DiskBuffer(path, most_bytes=10**8, fingerprint=PRINT)
    buffer.add_pose(b"a pose")
    for k in range(count):
        buffer.append(bytes([k]) * 9)
    return buffer


def test_an_acknowledgement_on_a_full_disk_ends_no_edge(tmp_path, monkeypatch):
    connect = partial(sqlite3.connect, factory=Database)
    monkeypatch.setattr("gis_radar.live.wire.buffer.sqlite3.connect", connect)
    with filled(tmp_path / "b") as buffer:
        link, reporter = NoLink(), Lines()
        outbox = outbox_of(buffer, link, reporter)
        Database.full = True
        link.received = [ack(buffer, 2), ack(buffer, 3)]
        outbox.pump()
        assert not outbox.put(b"x")  # lost, and said
        assert (outbox.lost, len(buffer), outbox.stored) == (1, 5, 3)
        assert sum("the disk is full" in line for line in reporter.lines) == 2
        assert [number for _, number in link.messages()] == [4, 5]  # what fusion has goes not again
        Database.full = False
        link.connections += 1  # so that a status is due
        outbox.pump()
        assert len(buffer) == 2


def test_the_pose_goes_before_the_frames_that_name_it(tmp_path):
    with filled(tmp_path / "b", 0) as buffer:
        link = NoLink()
        outbox = outbox_of(buffer, link)
        for key, count in ((b"one.", 2), (b"two.", 1)):
            outbox.put_pose(key)
            for k in range(count):
                outbox.put(key + bytes([k]))
        outbox.pump()
        sent = [(kind, retain) for kind, _, retain in link.sent if kind != "status"]
        frames = ("detections", False)
        assert sent == [("pose", True), frames, frames, ("pose", True), frames]
        link.sent.clear()
        missing = Acknowledgement(
            stream=buffer.stream.hex(), stored=0, check=0, session="a", resend=1
        )
        link.received = [Received("v1/s/R1/ack", missing.pack(), 1.0, retained=True)]
        outbox.pump()  # fusion may have lost it: it comes again, too
        assert [kind for kind, *_ in link.sent][:2] == ["pose", "detections"]


def test_a_buffer_restored_from_an_older_copy_loses_nothing(tmp_path):
    """The copy reuses numbers: under a stream of its own, so that fusion takes them."""
    path = tmp_path / "b"
    with filled(path) as buffer:
        before = buffer.stream
        shutil.copy(path, tmp_path / "copy")
        log = tmp_path / "b-wal"
        if log.exists():
            shutil.copy(log, tmp_path / "copy-wal")
        for k in range(5, 40):
            buffer.append(bytes([k]) * 9)
        link = NoLink()
        outbox = outbox_of(buffer, link)
        link.received = [ack(buffer, 40)]
        outbox.pump()
        assert (len(buffer), outbox.stored) == (0, 40)
    with DiskBuffer(tmp_path / "copy", most_bytes=10**8, fingerprint=PRINT) as restored:
        for k in range(100, 110):
            restored.append(bytes([k]) * 9)
        link = NoLink(ack(restored, 40, stream=before))  # kept by the broker
        outbox = outbox_of(restored, link)
        outbox.pump()
        assert (len(restored), outbox.stored) == (15, 0)
        assert link.messages() == [(restored.stream, k) for k in range(1, 16)]
        assert restored.stream != before


@pytest.mark.parametrize("stored", [3, 5, 40], ids=["sent", "last", "beyond"])
def test_what_fusion_has_of_another_program_is_not_dropped_here(tmp_path, stored):
    """A machine restored while it runs, or a foreign message: numbers are the same, content not."""
    with filled(tmp_path / "b") as buffer:
        link, said, before = NoLink(), Lines(), buffer.stream
        outbox = outbox_of(buffer, link, said)
        outbox.pump()
        link.received = [ack(buffer, stored, b"of another one")]
        outbox.pump()
        assert said.told("fusion has stored other messages of this stream")
        assert (len(buffer), outbox.stored, buffer.stream == before) == (5, 0, False)
        assert link.messages()[-5:] == [(buffer.stream, k) for k in range(1, 6)]
        link.received = [ack(buffer, 5)]
        outbox.pump()
        assert (len(buffer), outbox.empty) == (0, True)


def pose_follower(follower, begin):
    return PoseFollower(follower, SimpleNamespace(), gr.read_pose(SAMPLE / "R1.json"), begin)


def test_a_follower_that_ended_takes_nothing_and_a_fault_in_it_is_raised():
    """What a thread meets is never silent, and nothing gathers before a thread that is gone."""
    frame = next(frames_of_recording(SAMPLE / "R1.parquet"))
    for fault in (NoAnswerError("no traffic"), ZeroDivisionError("a fault")):
        follower = pose_follower(Faulty(fault), float(frame.time[0]))
        follower.push(frame)
        wait_for(lambda: all(each.name != "pose" for each in threading.enumerate()))
        assert all(follower.push(frame) for _ in range(2 * WAITING_FRAMES))  # none gathers
        if isinstance(fault, NoAnswerError):
            found = follower.latest()
            assert (found.trusted, found.refused) == (False, "no traffic")
        else:
            with pytest.raises(ZeroDivisionError):
                follower.latest()
        follower.close()


def test_frames_that_a_slow_follower_leaves_out_are_counted():
    frame = next(frames_of_recording(SAMPLE / "R1.parquet"))
    free = Event()
    follower = pose_follower(Slow(free), float(frame.time[0]))
    taken = [follower.push(frame) for _ in range(WAITING_FRAMES + 30)]
    assert WAITING_FRAMES <= sum(taken) <= WAITING_FRAMES + 1  # one of them is being fitted
    assert all(taken[:WAITING_FRAMES])
    free.set()
    follower.close()


class Slow:
    """A follower of poses that waits."""

    def __init__(self, free):
        self._free = free

    def push(self, _frame):
        self._free.wait(LONGEST_S)


class Faulty:
    """A follower of poses that breaks at its first frame."""

    def __init__(self, fault):
        self._fault = fault

    def push(self, _frame):
        raise self._fault


def test_a_fault_in_a_reader_ends_the_source():
    def read(*_):
        yield from ()
        raise ZeroDivisionError("a fault")

    with pytest.raises(ZeroDivisionError):
        for waited, _ in enumerate(Radar(source="udp://x", read=read).frames()):
            assert waited < 100


def test_messages_stay_under_the_limit_and_what_cannot_be_sent_is_lost_at_once(tmp_path):
    rng = np.random.default_rng(1)
    frames = [
        FrameDetections(
            time_us=1_750_000_000_000_000 + k, points=rng.integers(-75_000, 75_000, (300, 3)),
            rates=rng.integers(-20_000, 20_000, 300), rcs_db=rng.integers(-50, 50, 300),
        )
        for k in range(100)
    ]  # fmt: skip
    parts = list(in_parts(frames, lambda each: pack_detections(each, pose=b"pose")))
    assert len(parts) > 1
    assert max(map(len, parts)) <= MOST_CONTENT
    found = [frame for part in parts for frame in unpack_detections(part)[1]]
    assert [frame.time_us for frame in found] == [frame.time_us for frame in frames]
    whole = Envelope(stream=STREAM, number=2**62)
    assert len(pack_message(whole, bytes(MOST_CONTENT))) <= MOST_BYTES
    with filled(tmp_path / "b", 0) as buffer:
        reporter = Lines()
        outbox = outbox_of(buffer, NoLink(), reporter)
        assert not outbox.put(bytes(MOST_CONTENT + 1))
        assert (outbox.lost, len(reporter.lines), len(buffer)) == (1, 1, 0)
        assert outbox.put(bytes(MOST_CONTENT))
