"""What may go wrong in the live system, without a network: nothing acknowledged is lost then."""

import sqlite3

import numpy as np
import pytest
from live_site import LONGEST_S, SAMPLE

import gis_radar as gr
from gis_radar.errors import InputError, NoAnswerError
from gis_radar.live import own_pose
from gis_radar.live.broker import Received, SensorTopics
from gis_radar.live.buffer import DiskBuffer
from gis_radar.live.hits_folder.folder import read_stored_hits
from gis_radar.live.hits_folder.tile_sets import pack_tiles
from gis_radar.live.hour_copy import write_copied
from gis_radar.live.hours import HOUR_US
from gis_radar.live.intake import Intake
from gis_radar.live.journal import FrameRow, Journal, PoseRow
from gis_radar.live.map_of_now import MapOfNow
from gis_radar.live.outbox import Outbox
from gis_radar.live.payload import (
    HITS,
    MOST_BYTES,
    MOST_CONTENT,
    POSE,
    Acknowledgement,
    Envelope,
    PoseContent,
    in_parts,
    pack_hits,
    pack_message,
    unpack_hits,
    unpack_message,
)
from gis_radar.live.sources import Radar, frames_of_recording
from gis_radar.live.store import KnownPose, Store
from gis_radar.live.windows import Windows
from gis_radar.measures.hit_counter import CountedFrame
from gis_radar.measures.views import ViewBook
from gis_radar.progress import Reporter
from gis_radar.sight import SightTiles

PRINT = "00112233445566778899aabbccddeeff"
HOUR = 486_111  # since 1970: 2025-06
STREAM = b"abcd"


class Lines(Reporter):
    """A reporter that keeps what it is told."""

    def __init__(self):
        self.lines = []

    def log(self, message, _level="info"):
        self.lines.append(message)


@pytest.fixture(scope="module")
def road():
    return SightTiles.of(gr.make_tiles(gr.read_map(SAMPLE / "junction.osm")))


def counted(time_us, *tiles):
    return CountedFrame(
        time_us=time_us, detections=2, moving=1, wild=0, checksum=5, tiles=np.array(tiles, np.int64)
    )


def row(sensor, time_us, pose=1):
    return FrameRow(sensor, time_us, pose, 1, 1, 0, 5, pack_tiles(np.array([1])))


def pose_content(fingerprint=PRINT, **changes):
    pose = gr.read_pose(SAMPLE / "R1.json").as_dict() | changes
    return PoseContent(pose=pose, since_step=0, fingerprint=fingerprint)


def intake_of(journal, road, *, names=("R1",), reporter=None):
    return Intake(
        names, site="s", book=ViewBook(road=road), journal=journal, windows=Windows(0.2),
        current=MapOfNow(len(road.tile_id), interval=18_000), reporter=reporter or Lines(),
    )  # fmt: skip


def message(kind, number, content, previous=None):
    previous = number - 1 if previous is None else previous
    envelope = Envelope(kind=kind, stream=STREAM, number=number, previous=previous)
    topic = {HITS: "hits", POSE: "pose"}[kind]
    return Received(f"v1/s/R1/{topic}", pack_message(envelope, content), 1.0, retained=False)


def test_frames_of_a_sensor_that_left_the_site_stay_in_the_journal(tmp_path, road):
    store = Store(folder=tmp_path / "o", fingerprint=PRINT, tile_id=np.arange(10), sight="none")
    known = {1: KnownPose(content=pose_content(), view="v")}
    with Journal(tmp_path / "j", fingerprint=PRINT) as journal:
        for name in ("R1", "R2"):
            frames = [row(name, HOUR * HOUR_US + k * 50_000) for k in range(9)]
            journal.add(frames, name, "aa", 1)
        journal.commit()
        store.write_hour(HOUR, journal, known, {"v": np.arange(10)}, ["R1"])
        kept = list(journal.frames("R2", 0, 2**60))
        assert [len(piece) for piece in kept] == [9]
        assert list(journal.frames("R1", 0, 2**60)) == []
        reporter = Lines()
        intake_of(journal, road, reporter=reporter)
        assert any("R2" in line and "no longer names" in line for line in reporter.lines)
        store.write_hour(HOUR, journal, known, {"v": np.arange(10)}, ["R1", "R2"])  # named again
        assert journal.hours() == []
    assert read_stored_hits(store.path_of(HOUR)).sensors == ["R1", "R2"]


def test_an_hour_that_another_process_writes_is_the_same(tmp_path):
    known, views = {1: KnownPose(content=pose_content(), view="v")}, {"v": np.arange(10)}
    found = []
    for name, write in (("here", Store.write_hour), ("there", write_copied)):
        store = Store(folder=tmp_path / name, fingerprint=PRINT, tile_id=np.arange(10), sight="x")
        with Journal(tmp_path / f"{name}.sqlite", fingerprint=PRINT) as journal:
            for sensor in ("R1", "R2"):
                frames = [row(sensor, HOUR * HOUR_US + k * 40_000_000) for k in range(120)]
                journal.add(frames, sensor, "aa", 1)
            journal.commit()
            path = write(store, HOUR, journal, known, views, ["R1", "R3"])
            assert path == store.path_of(HOUR)
            kept = {name: [len(piece) for piece in journal.frames(name, 0, 2**60)]
                    for name in ("R1", "R2")}  # fmt: skip
            assert kept == {"R1": [30], "R2": [120]}  # of the next hour, and not asked for
        assert not (tmp_path / "hour.sqlite").exists()
        found.append({each.name: each.read_bytes() for each in path.iterdir()})
        found[-1].pop("manifest.json")
    assert found[0] == found[1]


@pytest.mark.parametrize("killed", [False, True])
def test_frames_that_come_while_their_hour_is_written_are_kept_for_the_next_time(tmp_path, killed):
    store = Store(folder=tmp_path / "o", fingerprint=PRINT, tile_id=np.arange(10), sight="none")
    known, views = {1: KnownPose(content=pose_content(), view="v")}, {"v": np.arange(10)}
    times = [HOUR * HOUR_US + k * 50_000 for k in range(9)]
    journal = Journal(tmp_path / "j", fingerprint=PRINT)
    journal.add_pose(PoseRow(1, "R1", "aa", 1, pose_content().pack(), 1, "v"))
    journal.add([row("R1", each) for each in times[::2]], "R1", "aa", 2)
    journal.commit()
    journal.watch(HOUR)
    journal.add([row("R1", each) for each in [*times[1::2], times[-1] + HOUR_US]], "R1", "aa", 3)
    journal.commit()
    assert journal.poses_named("R1") == {1}
    store.write_hour(HOUR, journal, known, views, ["R1"])
    if killed:
        journal.__exit__()
        journal = Journal(tmp_path / "j", fingerprint=PRINT)
    else:
        journal.unwatch()
    assert journal.hours() == [HOUR, HOUR + 1]
    store.write_hour(HOUR, journal, known, views, ["R1"])
    journal.__exit__()
    found = read_stored_hits(store.path_of(HOUR)).frame_log(["R1"])
    assert [each for piece in found for each in piece[0]] == times


@pytest.mark.parametrize("times", [(1,), (2**62,), (2**63 - 1, 2**63)])
def test_a_frame_of_no_known_year_is_refused_and_stops_nothing(tmp_path, road, times):
    frames, sound = [counted(each, 1) for each in times], times == (1,)
    content = pack_hits(frames, pose=1, fingerprint=road.fingerprint)
    if not sound:
        with pytest.raises(InputError, match="outside the years"):
            unpack_hits(content, tiles=10)
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        intake = intake_of(journal, road)
        intake.handle(message(POSE, 1, pose_content(road.fingerprint).pack(), 0))
        intake.handle(message(HITS, 2, content))
        assert intake.sensors["R1"].received == 2  # else it would come again for ever
        assert intake.sensors["R1"].health.counts["damaged"] == (not sound)
        journal.commit()
        for hour in journal.hours():
            Store(folder=tmp_path, fingerprint=PRINT, tile_id=np.arange(1), sight="").path_of(hour)


class Broken:
    """A database whose disk is full for as long as `full` is set."""

    def __init__(self, database):
        self._database, self.full = database, True

    def execute(self, query, *values):
        if self.full and query.startswith(("INSERT", "DELETE")):
            raise sqlite3.OperationalError("database or disk is full")
        return self._database.execute(query, *values)

    def __getattr__(self, name):
        return getattr(self._database, name)


class NoLink:
    """A link that brings what a test puts into it."""

    def __init__(self, *received):
        self.received, self.connected, self.connections, self.sent = [*received], True, 1, []

    def take(self, _timeout_s):
        return self.received.pop(0) if self.received else None

    def publish(self, topic, payload, *, retain=False):
        self.sent.append((topic.rpartition("/")[2], payload, retain))


def outbox_of(buffer, link, reporter=None):
    return Outbox(buffer, link, SensorTopics("s", "R1"), figures=dict, reporter=reporter or Lines())


def ack(buffer, stored):
    found = Acknowledgement(stream=buffer.stream.hex(), stored=stored, session="a")
    return Received("v1/s/R1/ack", found.pack(), 1.0, retained=True)


def test_an_acknowledgement_on_a_full_disk_ends_no_edge(tmp_path):
    with DiskBuffer(tmp_path / "b", most_bytes=10**8, fingerprint=PRINT) as buffer:
        link, reporter = NoLink(), Lines()
        outbox = outbox_of(buffer, link, reporter)
        for k in range(5):
            assert outbox.put(HITS, bytes([k])) == k + 1
        buffer._database = broken = Broken(buffer._database)
        link.received = [ack(buffer, 2), ack(buffer, 3)]
        outbox.pump()
        assert outbox.put(HITS, b"x") == 0  # lost, and said
        assert (outbox.lost, len(buffer), outbox.stored) == (1, 5, 3)
        assert sum("the disk is full" in line for line in reporter.lines) == 2
        sent = [unpack_message(data)[0].number for kind, data, _ in link.sent if kind == "hits"]
        assert sent == [4, 5]  # what fusion has goes not again
        broken.full = False
        outbox._reported = 0.0
        outbox.pump()
        assert len(buffer) == 2


def test_a_pose_on_a_full_disk_ends_no_fusion_and_comes_again(tmp_path, road):
    reporter = Lines()
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        intake = intake_of(journal, road, reporter=reporter)
        journal._database = broken = Broken(journal._database)
        pose = message(POSE, 1, pose_content(road.fingerprint).pack(), 0)
        sensor = intake.sensors["R1"]
        for _ in range(3):
            intake.handle(pose)
        assert (sensor.received, sensor.poses, sensor.health.counts["damaged"]) == (0, {}, 0)
        assert sum("the disk is full" in line for line in reporter.lines) == 1
        broken.full = False
        intake.handle(pose)
        assert (sensor.received, sensor.poses) == (1, {(STREAM.hex(), 1): 1})
        assert [each.standing for each in journal.poses("R1")] == [1]


def test_views_of_an_old_journal_are_those_of_the_scan_of_now(tmp_path, road):
    """Poses that were seen by another scan: hours are written, and the map sees."""
    time_us = HOUR * HOUR_US + 50_000
    store = Store(
        folder=tmp_path / "o", fingerprint=road.fingerprint, tile_id=road.tile_id, sight="none"
    )
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        content = pose_content(road.fingerprint)
        for number in (1, 2):
            journal.add_pose(PoseRow(number, "R1", "aa", number, content.pack(), 1, "old view"))
        journal.add([row("R1", time_us), row("R1", time_us + 100_000, 2)], "R1", "aa", 3)
        journal.commit()
        intake = intake_of(journal, road)
        assert {each.view for each in intake.poses.values()} == set(intake._map.views)
        store.write_hour(HOUR, journal, intake.poses, intake._book.tiles, ["R1"])
    views = read_stored_hits(store.path_of(HOUR)).views
    assert set(views["tile_id"]) == set(*intake._book.tiles.values())


def test_a_follower_that_ended_takes_nothing_and_a_fault_in_it_is_raised(monkeypatch):
    """What a thread meets is never silent, and nothing gathers before a thread that is gone."""
    frame = next(frames_of_recording(SAMPLE / "R1.parquet"))
    begin = float(frame.time[0])
    for fault in (NoAnswerError("no traffic"), ZeroDivisionError("a fault")):
        monkeypatch.setattr(own_pose, "_map_of", lambda *_: (None, None))
        monkeypatch.setattr(own_pose, "WindowFitter", lambda *_, **__: None)
        monkeypatch.setattr(own_pose, "Follower", lambda *_, fault=fault, **__: Faulty(fault))
        follower = own_pose.PoseFollower(None, gr.read_pose(SAMPLE / "R1.json"), begin)
        follower.push(frame)
        follower._thread.join(LONGEST_S)
        for _ in range(50):
            follower.push(frame)
        assert follower._frames.empty()
        if isinstance(fault, NoAnswerError):
            found = follower.latest()
            assert (found.trusted, found.refused) == (False, "no traffic")
        else:
            with pytest.raises(ZeroDivisionError):
                follower.latest()
        follower.close()


class Faulty:
    """A follower of poses that breaks at its first frame."""

    def __init__(self, fault):
        self._fault = fault

    def push(self, _frame):
        raise self._fault


def test_a_fault_in_a_reader_ends_the_source(monkeypatch):
    class Form:
        def frames(self, *_):
            yield from ()
            raise ZeroDivisionError("a fault")

    monkeypatch.setattr("gis_radar.live.sources.format_of", lambda _: Form())
    with pytest.raises(ZeroDivisionError):
        for waited, _ in enumerate(Radar(source="udp://x").frames()):
            assert waited < 100


def test_messages_stay_under_the_limit_and_what_cannot_be_sent_is_lost_at_once(tmp_path):
    frames = [counted(1_750_000_000_000_000 + k, *range(k % 3, 3_000, 3)) for k in range(100)]
    parts = list(in_parts(frames, lambda each: pack_hits(each, pose=1, fingerprint=PRINT)))
    assert len(parts) > 1
    assert max(map(len, parts)) <= MOST_CONTENT
    found = [frame for part in parts for frame in unpack_hits(part, tiles=3_000).frames]
    assert [frame.time_us for frame in found] == [frame.time_us for frame in frames]
    whole = Envelope(kind=HITS, stream=STREAM, number=2**62, previous=1)
    assert len(pack_message(whole, bytes(MOST_CONTENT))) <= MOST_BYTES
    with DiskBuffer(tmp_path / "b", most_bytes=10**8, fingerprint=PRINT) as buffer:
        reporter = Lines()
        outbox = outbox_of(buffer, NoLink(), reporter)
        assert outbox.put(HITS, bytes(MOST_CONTENT + 1)) == 0
        assert (outbox.lost, len(reporter.lines), len(buffer)) == (1, 1, 0)
        assert outbox.put(HITS, bytes(MOST_CONTENT)) == 1


def test_a_new_start_goes_on_counting(tmp_path, road):
    """Fifteen minutes that the journal holds are counted whole, not their last minute."""
    begin_us = HOUR * HOUR_US
    times = range(begin_us, begin_us + 890_000_000, 1_000_000)
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        content = pose_content(road.fingerprint).pack()
        journal.add_pose(PoseRow(1, "R1", "aa", 1, content, 1, "v"))
        journal.add([row("R1", each) for each in times], "R1", "aa", 2)
        journal.commit()
        intake = intake_of(journal, road)
        steps = list(intake.resume(begin_us, begin_us + 890_000_000))
    assert sum(bool(frames) for _, frames in steps) == len(times)
    assert intake._windows.late == 0


def test_a_pose_in_another_coordinate_system_is_named_and_not_used(tmp_path, road):
    """Its sensor would see nothing, in silence."""
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        intake = intake_of(journal, road)
        content = pose_content(road.fingerprint, crs="EPSG:25833").pack()
        intake.handle(message(POSE, 1, content, 0))
        assert intake.poses == {}
        assert "is in EPSG:25833, but the tiles in" in intake.sensors["R1"].health.alarms["damaged"]
