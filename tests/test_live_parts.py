"""Parts of the live system without a network: messages, buffer, windows, map of now, health."""

import re
import sqlite3
import time
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_programs import Lines
from live_site import SAMPLE
from pydantic import ValidationError

import gis_radar as gr
from gis_radar.base import GisRadarError, InputError
from gis_radar.base.languages import catalogue
from gis_radar.live import (
    Acknowledgement,
    BrokerAddress,
    DetectionSelector,
    DiskBuffer,
    Envelope,
    FrameDetections,
    MapOfNow,
    PoseContent,
    RecentCounts,
    SensorHealth,
    Windows,
    frames_of_recording,
    pack_detections,
    pack_message,
    prometheus_text,
    unpack_detections,
    unpack_message,
)
from gis_radar.live.health import ALARMS
from gis_radar.live.intake import SensorState
from gis_radar.live.now.map_of_now import SensorReport
from gis_radar.live.served.page import read_token
from gis_radar.live.served.snapshot import ShownMap
from gis_radar.live.wire.broker import parts_of
from gis_radar.live.wire.buffer import FullError
from gis_radar.live.wire.detections import FARTHEST, UNKNOWN_Z
from gis_radar.live.wire.payload import VersionError
from gis_radar.live.wire.sources import Replay
from gis_radar.measures import NO_FURTHER
from gis_radar.recordings import Detections
from gis_radar.scans import SightTiles
from gis_radar.site import PageTable

PRINT = "00112233445566778899aabbccddeeff"
KEY = b"pose"
NUMBERS = st.integers(1, 2**60)


@given(NUMBERS, st.binary(min_size=4, max_size=4), st.booleans(), st.booleans(), st.binary())
def test_envelopes_come_out_as_they_went_in(number, stream, first, live, content):
    envelope = Envelope(stream=stream, number=number, first=first, live=live)
    assert unpack_message(pack_message(envelope, content)) == (envelope, content)


@given(
    st.lists(
        st.tuples(*[st.integers(-FARTHEST, FARTHEST)] * 3, st.integers(-45_000, 45_000),
                  st.integers(-128, 100)),
        max_size=60,
    )
)  # fmt: skip
def test_detections_come_out_as_they_went_in(rows):
    values = np.array(rows, np.int64).reshape(-1, 5)
    values[values[:, 2] == UNKNOWN_Z, 2] += 1
    frame = FrameDetections(
        time_us=1, points=values[:, :3], rates=values[:, 3], rcs_db=values[:, 4]
    )
    content = pack_detections([frame, replace(frame, time_us=50_001)], pose=KEY)
    pose, found = unpack_detections(content)
    assert (pose, [each.time_us for each in found]) == (KEY, [1, 50_001])
    for back in found:
        assert np.array_equal(np.column_stack([back.points, back.rates, back.rcs_db]), values)


def test_the_message_of_the_page_reads_as_it_says():
    page = (Path(__file__).parents[1] / "docs" / "live.md").read_text(encoding="utf-8")
    (message,) = re.findall("`(02c00badcafe[0-9a-f]+)`", page)
    envelope, content = unpack_message(bytes.fromhex(message))
    assert (envelope.stream.hex(), envelope.number) == ("0badcafe", 1)
    pose, (frame,) = unpack_detections(content)
    assert pose.hex() == "5205449f"
    assert frame.time_us == 1_749_713_400_000_000  # 2025-06-12T07:30Z
    assert (frame.points * 0.004).tolist() == [[12.8, -18.5, -4.8], [13.6, 10.4, 0.6]]
    assert (frame.rates * 0.002).tolist() == [0.0, -2.5]
    assert frame.rcs_db.tolist() == [-6, 12]


def test_what_is_not_measured_is_not_known_again():
    time, none = np.full(3, 5.0), np.full(3, np.nan)
    points = np.column_stack([[10.0, 20.0, 30.0], [1.0, -2.0, 3.0], none])
    frame = Detections(
        time=time, points=points, range_rate=np.array([0.149, -0.151, np.nan]), rcs=none,
        further=NO_FURTHER,
    )  # fmt: skip
    quads = np.array([[[0.0, -5.0], [50.0, -5.0], [50.0, 5.0], [0.0, 5.0]]])
    road = SightTiles(tile_id=np.array([0]), lanelet_id=np.array([0]), quads=quads,
                      height=np.array([np.nan]), crs="EPSG:25832", fingerprint="")  # fmt: skip
    pose = gr.Pose(sensor="R1", crs="EPSG:25832", easting=0.0, northing=0.0, height=5.0, yaw=0.0,
                   pitch=0.0, roll=0.0)  # fmt: skip
    selector = DetectionSelector(road)
    # till the noise is known nothing slow moves: else an edge that starts sends noise as traffic
    first = selector.find(frame, pose, road_m=0.0)
    assert first.rates[:2].tolist() == [0, 0]
    found = selector.find(replace(frame, time=time + 1.0), pose, road_m=0.0)
    _, (back,) = unpack_detections(pack_detections([found], pose=KEY))
    read = back.as_rows()
    assert np.isnan(read.points[:, 2]).all()
    assert np.isnan(read.rcs).all()
    assert read.range_rate[0] == 0.0  # stands; the next one just does not
    assert read.range_rate[1] == pytest.approx(-0.151, abs=0.001)
    assert abs(read.range_rate[1]) >= 0.15
    assert np.isnan(read.range_rate[2])


def test_a_frame_without_detections_is_a_row_and_one_of_two_kinds_is_refused():
    none = np.empty((0, 3), np.int64)
    empty = FrameDetections(time_us=7, points=none, rates=none[:, 0], rcs_db=none[:, 0])
    _, (back,) = unpack_detections(pack_detections([empty], pose=KEY))
    rows = back.as_rows()
    assert (len(rows), rows.present.any(), rows.time.tolist()) == (1, False, [7e-6])
    mixed = FrameDetections(
        time_us=7, points=np.array([[1, 2, 3], [1, 2, UNKNOWN_Z]]), rates=np.zeros(2, np.int64),
        rcs_db=np.zeros(2, np.int64),
    )  # fmt: skip
    with pytest.raises(InputError, match="some detections have a height"):
        unpack_detections(pack_detections([mixed], pose=KEY))


@settings(max_examples=200)
@given(st.binary(max_size=80), st.integers(0, 3))
def test_what_is_no_message_is_refused_and_nothing_else_is_raised(noise, start):
    good = pack_message(Envelope(stream=b"abcd", number=5), b"")
    data = good[: [0, 2, 6, len(good)][start]] + noise
    for read in (unpack_message, Acknowledgement.unpack, PoseContent.unpack, unpack_detections):
        with suppress(InputError):
            read(data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\x01\x83abcd\x00\x00", "version 1, expected 2"),
        (b"", "version none"),
        (b"\x02\x01ab", "4 bytes"),
        (b"\x02\x01abcd\x80", "within a number"),
        (b"\x02" * 70_000, "70,000 bytes"),
    ],
)
def test_odd_envelopes_are_named(data, says):
    with pytest.raises(InputError, match=says):
        unpack_message(data)
    assert issubclass(VersionError, InputError)


def sent_frames(name, count):
    """Return frames of the sample as its sensor sends them."""
    road = SightTiles.of(gr.make_tiles(gr.read_map(SAMPLE / "junction.osm")))
    pose, selector = gr.read_pose(SAMPLE / f"{name}.json"), DetectionSelector(road)
    frames = islice(frames_of_recording(SAMPLE / f"{name}.parquet"), count)
    return road, pose, [selector.find(each, pose, road_m=np.nan) for each in frames]


def test_messages_are_as_small_as_stated():
    envelope = Envelope(stream=b"abcd", number=20 * 86_400 * 365)  # of a year
    _, _, frames = sent_frames("R1", None)
    sizes = [len(pack_message(envelope, pack_detections([each], pose=KEY))) for each in frames]
    assert np.percentile(sizes, 99) < 600
    assert np.mean(sizes) * 20 * 8 < 60_000  # bits a second


def test_only_what_is_acknowledged_leaves_the_buffer(tmp_path):
    path = tmp_path / "R1.buffer"
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        stream = buffer.stream
        buffer.add_pose(b"one")
        assert [buffer.append(bytes([k])) for k in range(3)] == [1, 2, 3]
        buffer.add_pose(b"two")
        assert [buffer.append(bytes([k])) for k in range(2)] == [4, 5]
        assert [buffer.pose_of(number) for number in (1, 3, 4, 5)] == [b"one"] * 2 + [b"two"] * 2
        buffer.acknowledge(2)
        kept = [(3, True), (4, False), (5, False)]
        assert [each[:2] for each in buffer.read_after(0, 9)] == kept
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        assert buffer.stream != stream  # an older copy of the file uses no number twice
        assert buffer.append(b"new") == 6
        assert [each[:2] for each in buffer.read_after(0, 9)] == [*kept, (6, False)]
        assert [each.content for each in buffer.read_after(5, 9)] == [b"new"]
        assert buffer.pose_of(3) == b"one"


def test_an_emptied_buffer_gives_each_message_its_own_pose(tmp_path):
    """A pose that all messages of an earlier run were found by stays, with its number."""
    path = tmp_path / "R1.buffer"
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        for k, pose in enumerate((b"one", b"two")):
            buffer.add_pose(pose)
            for _ in range(10 - 9 * k):
                buffer.append(pose)
        buffer.acknowledge(buffer.last)
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        assert len(buffer) == 0
        buffer.add_pose(b"three")
        numbers = [buffer.append(b"three") for _ in range(12)]
        assert next(buffer.read_after(buffer.stored, 1)).first
        assert {buffer.pose_of(number) for number in numbers} == {b"three"}
        buffer.acknowledge(numbers[10])
        assert buffer.pose_of(numbers[11]) == b"three"


def test_a_full_buffer_takes_nothing_and_drops_nothing(tmp_path):
    with DiskBuffer(tmp_path / "b", most_bytes=100_000, fingerprint=PRINT) as buffer:
        with pytest.raises(FullError, match="full"):
            for _ in range(10_000):
                buffer.append(bytes(100))
        kept = len(buffer)
        assert kept > 500
        assert next(buffer.read_after(0, 1)).number == 1
        with pytest.raises(FullError):
            buffer.append(bytes(100))
        assert len(buffer) == kept
        buffer.acknowledge(kept)
        buffer.append(b"again")
        assert len(buffer) == 1


def test_a_buffer_of_other_tiles_is_put_aside_and_one_in_use_refused(tmp_path):
    path = tmp_path / "b"
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        buffer.append(b"old")
        with pytest.raises(GisRadarError, match="another edge"):
            try:
                DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT)
            except GisRadarError as error:
                raise GisRadarError(f"{error.message} {error.hint}") from error
    with DiskBuffer(path, most_bytes=10**7, fingerprint="ff" * 16) as buffer:
        assert len(buffer) == 0
        aside = buffer.put_aside
    with sqlite3.connect(aside) as database:
        assert database.execute("SELECT content FROM messages").fetchall() == [(b"old",)]


def seen(*tiles, in_sight=()):
    return SensorReport(np.array(tiles, np.int64), np.array(in_sight, np.int64))


def test_windows_close_in_order_at_their_lateness():
    windows = Windows(0.2)
    assert windows.add("R1", 1000, seen(1))
    assert windows.add("R2", 1000, seen(2))
    assert windows.add("R1", 1002, seen(3))
    end = 1001 * 50_000 + 200_000  # of step 1000, and the lateness
    assert list(windows.close(end - 1)) == []
    ((step, found),) = windows.close(end)
    assert (step, sorted(found)) == (1000, ["R1", "R2"])
    assert not windows.add("R1", 1000, seen(9))  # too late for the map
    assert windows.add("R1", 1001, seen(4))  # late, and in time
    assert windows.add("R1", 1001, seen(5))  # two frames of a step are one
    closed = dict(windows.close(end + 100_000))
    assert closed[1001]["R1"].tiles.tolist() == [4, 5]
    assert closed[1002]["R1"].tiles.tolist() == [3]


def test_a_clock_that_is_set_back_begins_the_map_anew():
    windows, current = Windows(0.2), MapOfNow(3)
    current.validity_s["R1"] = 0.1
    recent = RecentCounts(3, interval=1 << 40)

    def close(step):
        for closed, frames in windows.close(step * 50_000 + 200_000):
            state = current.take(closed, frames)
            recent.take(closed, state.hit, state.observed)
        return current.state()

    every = [0, 1, 2]
    windows.add("R1", 100_000, seen(0, in_sight=every))
    assert close(100_001).hit.tolist() == [True, False, False]
    windows.add("R1", 172_000, seen(1, in_sight=every))
    windows.close(100_002 * 50_000)
    ahead = close(172_001)
    assert ahead.step == 172_000
    # within what a map may be late by: nothing happens
    windows.add("R1", 99_990, seen(2, in_sight=every))
    assert close(171_990).step == 172_000
    back = close(100_010)
    assert (back.step, back.hit.any()) == (100_009, False)
    assert windows.add("R1", 100_011, seen(2, in_sight=every))
    after = close(100_012)
    assert (after.step, after.hit.tolist()) == (100_011, [False, False, True])
    for hit, observed in (recent.last_minutes(), recent.since_begin()):
        assert (hit.tolist(), observed.max()) == ([0, 0, 1], 1)
    assert len(recent.quarters()) == 1


def test_a_looping_replay_is_at_the_same_place_whenever_it_began(monkeypatch):
    now = [1_800_000_000.0]
    monkeypatch.setattr("gis_radar.live.wire.sources.time.time", lambda: now[0])
    first = next(iter(Replay(path=SAMPLE / "R1.parquet", loop_s=100.0).frames()))
    now[0] += 37.0
    later = next(iter(Replay(path=SAMPLE / "R1.parquet", loop_s=100.0).frames()))
    recorded = {int(np.rint(f.time[0] * 1e6)) % 100_000_000: f
                for f in frames_of_recording(SAMPLE / "R1.parquet")}  # fmt: skip
    for frame in (first, later):
        same = recorded[int(np.rint(frame.time[0] * 1e6)) % 100_000_000]
        assert np.array_equal(frame.points, same.points, equal_nan=True)
    assert 36.9 < later.time[0] - first.time[0] < 37.1


def test_a_clock_that_is_off_by_half_a_window_raises_the_alarm():
    said = Lines()
    health = SensorHealth(name="R1", reporter=said)
    for k in range(40):
        health.heard(100.0 + k, 99.99 + k - 0.05 * (k % 3), live=True)
    assert not health.alarms  # late now and then; 10 ms at the least
    for k in range(300):
        health.heard(200.0 + k, 199.96 + k, live=True)
    assert "clock" in health.alarms
    for k in range(300):
        health.heard(600.0 + k, 500.0 + k, live=False)  # waited on disk: tells nothing
    assert health.clock_offset_s == pytest.approx(0.04)
    for k in range(300):
        health.heard(1600.0 + k, 1600.0 + k, live=True)
    assert not health.alarms
    assert len(said.lines) == 2
    health.counts = Counter(frames=7)
    text = prometheus_text([health], {"map_step": 3.0})
    assert 'gis_radar_frames_total{sensor="R1"} 7' in text
    assert 'gis_radar_alarm{alarm="clock",sensor="R1"} 0' in text
    assert text.endswith("gis_radar_map_step 3.0\n")


@pytest.mark.parametrize(
    ("text", "host", "port", "tls"),
    [("mqtt://a", "a", 1883, False), ("mqtts://b.c:99", "b.c", 99, True)],
)
def test_addresses_of_brokers(text, host, port, tls):
    found = BrokerAddress.of(text, password="secret")  # noqa: S106
    assert (found.host, found.port, found.tls) == (host, port, tls)
    assert "secret" not in f"{found!r}{found}"


@pytest.mark.parametrize("text", ["broker:1883", "http://a", "mqtt://", "mqtt://a:x", "mqtt://a/b",
                                  "mqtt://a?tls=1", "mqtts://a[b:8883"])  # fmt: skip
def test_what_is_no_address_is_refused(text):
    with pytest.raises(gr.UsageError, match="no address of a broker"):
        BrokerAddress.of(text)


@pytest.mark.parametrize("place", ["a", "a:99999", "a:b", "[a", "", "a/b"])
def test_a_user_in_the_address_of_a_broker_is_refused_and_the_password_not_repeated(place):
    with pytest.raises(gr.UsageError, match="holds a user") as caught:
        BrokerAddress.of(f"mqtt://R1:secret@{place}")
    assert "secret" not in f"{caught.value}{caught.value.hint}"


def test_topics():
    assert parts_of("v1/junction/R1/status") == ("R1", "status")
    assert parts_of("v2/junction/R1/status") == parts_of("$SYS/broker") == ("", "")


def test_alarms_keep_their_last_words_and_end():
    health = SensorHealth(name="R1")
    health.alarm("damaged", "number 1")
    health.alarm("damaged", "number 2")
    assert health.alarms == {"damaged": "number 2"}
    health.heard_s = now = time.time()
    health.check(now + 1.0)
    assert health.alarms == {"damaged": "number 2"}
    health.heard_s = now + 1_000.0
    health.check(now + 1_000.0)
    assert health.alarms == {}


def test_who_asks_once_gets_the_lag_of_a_sensor_that_sends():
    sensor, none = SensorState(health=SensorHealth(name="R1")), np.zeros(1)
    for at in np.arange(0.0, 1.0, 0.05):
        sensor.health.heard(at + 0.02, at, live=True)
    fusion = Mock(sensors={"R1": sensor}, vehicles=None)
    fusion.counts.last_minutes.return_value = none, none
    fusion.state.return_value = Mock(step=0, hit=none, observed=none)
    shown = ShownMap(fusion, Mock())
    assert shown.snapshot().sensors[0].lag_s == pytest.approx(0.02)
    sensor.health.alarm("silent", "for 6 s")
    assert np.isnan(shown.snapshot().sensors[0].lag_s)


def test_every_alarm_has_its_german():
    assert set(ALARMS.values()) <= set(catalogue("de"))


@pytest.mark.parametrize(
    "address", ["127.0.0.1:8080/", "a@127.0.0.1:80", "127.0.0.1:80?x", "::1:80"]
)
def test_addresses_that_are_none_are_refused(address):
    with pytest.raises(ValidationError):
        PageTable(address=address)


@pytest.mark.parametrize("token", ["", "zwei wörter", "ünicode", "a b"])
def test_tokens_that_cannot_be_sent_are_refused(tmp_path, token):
    file = tmp_path / "page.token"
    file.write_text(token, encoding="utf-8")
    with pytest.raises(InputError, match=r"page\.token: holds no token"):
        read_token(file)
