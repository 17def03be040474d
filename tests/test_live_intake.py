"""What fusion takes of what sensors send, and what it refuses: nothing acknowledged is lost."""

import time

import numpy as np
import pytest
from live_intake import NOW_US, ROAD, STREAM, FedIntake, frame, pose_message
from live_programs import Lines
from live_site import LiveSite

from gis_radar.live import (
    Envelope,
    Fusion,
    key_of_pose,
    pack_message,
    prometheus_text,
    read_live_site,
    spool_files,
)
from gis_radar.live.hours.recordings import hour_of_time
from gis_radar.live.hours.spool import FRAMES_RECORD, POSE_RECORD, SKIPPED_RECORD
from gis_radar.scans import find_sight

DAY_US, HOUR_US = 86_400_000_000, 3_600_000_000


@pytest.fixture
def fed(tmp_path):
    made = FedIntake(tmp_path)
    made.pose()
    yield made
    made.spool.close()


def test_odd_messages_are_counted_and_the_rest_goes_on(tmp_path):
    """Other versions, tiles, sensors, noise and doubles: a line and a count each, no frame."""
    said = Lines()
    fed = FedIntake(tmp_path, reporter=said)
    other = pose_message("00" * 16)
    fed.send(b"", sensor="R9")
    assert said.told("R9: no sensor of this site")
    fed.pose(other)
    fed.frames(1, key=key_of_pose(other), first=True)
    assert (fed.sensor.received, "refused" in fed.sensor.health.alarms) == (0, True)
    assert fed.sensor.refused == f"tiles {'00' * 16}, expected {ROAD.fingerprint}"
    fed.send(b"\x09" + pack_message(Envelope(stream=STREAM, number=1), b"")[1:])
    assert fed.sensor.refused == "a message of version 9, expected 2"
    fed.frames(1, first=True)  # of a pose that is not there yet
    assert (fed.sensor.received, fed.sensor.resend, fed.sensor.due) == (0, 1, True)
    fed.pose()
    fed.frames(1, first=True)
    assert (fed.sensor.received, fed.sensor.health.alarms) == (1, {})
    fed.frames(2)
    fed.frames(2)  # a double
    assert (fed.sensor.received, fed.counts["duplicates"]) == (2, 1)
    fed.frames(4)  # 3 is missing
    assert (fed.sensor.received, fed.counts["frames"]) == (2, 2)
    fed.send(pack_message(Envelope(stream=STREAM, number=3), b"pose\x01\x00\x7f"))
    assert (fed.sensor.received, fed.counts["damaged"]) == (3, 1)  # passed over
    for noise in (b"", b"\x02", bytes(70_000), b"\xff" * 50):
        for kind in ("detections", "status", "pose"):
            fed.send(noise, kind)
    fed.send(b'{"version": 2, "state": "online", "trusted": false}', "status")
    assert "moved" in fed.sensor.health.alarms
    assert fed.counts["frames"] == 2
    fed.commit()
    assert fed.stored == 3
    assert [each.kind for each in fed.spooled()] == [
        POSE_RECORD,
        FRAMES_RECORD,
        FRAMES_RECORD,
        SKIPPED_RECORD,
    ]


def test_what_a_sensor_leaves_out_is_told_by_its_status_and_shown(fed):
    fed.send(b'{"version": 2, "state": "online", "lost": 3, "not_followed": 40}', "status")
    fed.send(b'{"version": 2, "state": "offline", "not_followed": -1}', "status")
    assert fed.sensor.health.alarms["lost"] == "3 messages"
    shown = prometheus_text([fed.sensor.health], {})
    assert 'gis_radar_lost_total{sensor="R1"} 3' in shown
    assert 'gis_radar_not_followed_total{sensor="R1"} 40' in shown
    fed.send(b'{"version": 2, "state": "online", "lost": 0}', "status")
    assert "lost" not in fed.sensor.health.alarms


def test_a_number_far_ahead_does_not_end_a_stream(fed):
    """One message of number 2^62 with the sensor's own password: the next ones are taken."""
    fed.frames(1, first=True)
    for number in (2**62, 2**63 - 1):
        for first in (False, True):
            fed.frames(number, first=first)
    assert fed.sensor.received == 1
    assert "number 9,223,372,036,854,775,807 after 1" in fed.sensor.health.alarms["damaged"]
    fed.frames(2)
    assert (fed.sensor.received, fed.counts["frames"]) == (2, 2)
    fed.frames(2**62, stream=b"efgh", first=True)  # nor does one of another stream
    fed.frames(3)
    assert (fed.sensor.received, fed.counts["frames"]) == (3, 3)


def test_a_fusion_of_an_older_disk_goes_on_and_names_what_is_gone(fed):
    """Its sensor no longer has what was acknowledged before: else it would ask for ever."""
    fed.frames(1, first=True)
    fed.frames(7, first=True)
    assert fed.sensor.received == 7
    assert "5 messages that the sensor no longer has" in fed.sensor.health.alarms["lost"]


@pytest.mark.parametrize(
    "off_us",
    [HOUR_US, -3 * DAY_US - 10_000_000, -NOW_US, 2**62],
    ids=["ahead", "old", "1970", "beyond any time"],
)
def test_frames_of_another_time_are_named_and_passed_over(fed, off_us):
    fed.frames(1, frame(NOW_US), first=True)
    fed.frames(2, frame(NOW_US + off_us))
    fed.frames(3, frame(NOW_US + 100_000))
    assert (fed.sensor.received, fed.counts["frames"], fed.counts["off_time"]) == (3, 2, 1)
    assert "from now" in fed.sensor.health.alarms["off_time"]
    assert fed.intake.touched == {hour_of_time(NOW_US), hour_of_time(NOW_US + 100_000)}


def test_few_messages_open_few_hours(fed):
    """Three messages of a hundred frames, each of another hour; only one hour is touched."""
    times = [NOW_US - DAY_US - k * HOUR_US for k in range(60, 0, -1)]
    for number in (1, 2, 3):
        fed.frames(number, *map(frame, times), first=number == 1)
    assert fed.intake.touched == set()
    assert fed.counts["off_time"] == 180
    fed.frames(4, *(frame(NOW_US - 200_000 + k) for k in range(100)))
    assert len(fed.intake.touched) == 1


def test_frames_that_do_not_ascend_are_damaged(fed):
    fed.frames(1, frame(NOW_US), frame(NOW_US), first=True)
    assert (fed.counts["damaged"], fed.counts["frames"]) == (1, 0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"crs": "EPSG:25833"}, "is in EPSG:25833, but the tiles in"),
        ({"easting": 1e300}, "easting"),
        ({"easting": 790360.0}, "over 20 km from the tiles"),
        ({"sensor": "R2"}, "it is that of R2"),
    ],
)
def test_a_pose_that_cannot_be_is_named_and_its_frames_do_not_hold_others_up(fed, changes, says):
    key = fed.pose(pose_message(**changes))
    assert says in fed.sensor.health.alarms["damaged"]
    fed.frames(1, key=key, first=True)
    fed.frames(2)
    assert (fed.sensor.received, fed.counts["frames"]) == (2, 1)


def test_two_streams_that_take_turns_are_named(fed):
    for number in (1, 2):
        for stream in (b"one.", b"two."):
            fed.frames(number, stream=stream, first=number == 1)
    assert "take turns" in fed.sensor.health.alarms["twins"]
    assert fed.counts["frames"] == 4


def test_old_poses_are_forgotten_and_asked_for_again(fed):
    """A sensor that is followed brings another pose every few seconds, for years."""
    fed.frames(1, first=True)
    for k in range(200):
        fed.pose(pose_message(easting=690360.0 + 0.001 * k))
    assert len(fed.sensor.poses) == 64
    fed.frames(2)
    assert (fed.sensor.received, fed.sensor.resend) == (1, 1)
    fed.pose()
    fed.frames(2)
    assert fed.sensor.received == 2


def test_a_new_start_goes_on_where_it_was(tmp_path):
    """Streams go on at their marks."""
    fed = FedIntake(tmp_path)
    fed.pose()
    for k in range(1, 101):
        fed.frames(k, frame(NOW_US - 60_000_000 + 50_000 * k), first=k == 1)
    fed.commit()
    fed.frames(101, frame(NOW_US))  # not on disk, so not acknowledged
    fed.spool.close()
    again = FedIntake(tmp_path)
    assert again.sensor.received == again.stored == 100
    again.pose()  # retained by the broker
    again.frames(101, frame(NOW_US))
    again.frames(102, frame(NOW_US + 50_000))
    again.commit()
    again.spool.close()
    third = FedIntake(tmp_path)
    assert third.stored == 102
    third.pose()
    third.frames(103, frame(NOW_US + 100_000))
    third.commit()
    third.spool.close()
    kinds = [each.kind for each in third.spooled()]
    assert kinds.count(FRAMES_RECORD) == 103
    assert kinds.count(POSE_RECORD) == 3  # each file holds those that its frames name


def test_where_the_newest_file_of_the_spool_is_torn_the_one_before_it_tells_the_marks(tmp_path):
    fed = FedIntake(tmp_path)
    fed.pose()
    fed.frames(1, first=True)
    fed.commit()
    fed.spool.close()
    FedIntake(tmp_path).spool.close()  # a second file, which begins with all marks
    (_, second) = spool_files(tmp_path / "spool")
    again = FedIntake(tmp_path)
    again.spool.close()
    assert again.stored == 1
    second.write_bytes(second.read_bytes()[:20])  # torn
    third = spool_files(tmp_path / "spool")[-1]
    third.write_bytes(b"")
    again = FedIntake(tmp_path)
    again.spool.close()
    assert again.stored == 1


def test_the_map_counts_the_tiles_under_what_is_sent(fed):
    fed.map.validity_s["R1"] = 0.1
    fed.frames(1, frame(NOW_US), frame(NOW_US + 100_000, x=40.0), first=True)
    (found,) = [f["R1"] for _, f in fed.windows.close(NOW_US + 260_000) if f]
    pose = fed.sensor.pose
    east, north = pose.to_map(np.array([[30.0, 0.0, -1.8]]))[0, :2]
    seen = find_sight(pose, ROAD).seen
    assert 0 < len(seen) < len(ROAD.tile_id)
    np.testing.assert_array_equal(ROAD.tile_id[found.in_sight], seen)
    quads = ROAD.quads[found.tiles]
    assert len(quads)
    assert (quads.min(axis=1) <= [east, north]).all()
    assert (quads.max(axis=1) >= [east, north]).all()


def test_a_frame_is_valid_on_the_map_for_the_cycle_that_the_site_file_states(tmp_path, once):
    """At 4 Hz no step between two frames is unobserved, and the last frame holds for seven more."""
    site = LiveSite(tmp_path, once, names=("R1",), of_live='interval = "2400h"')
    text = site.file.read_text().replace('name = "R1"', 'name = "R1"\ncycle = "250ms"')
    site.file.write_text(text)
    read = read_live_site(site.file)
    begin_us, fed = int(time.time()) * 1_000_000 - 20_000_000, FedIntake(tmp_path / "else")
    fusion = Fusion(read)
    fed.intake = fusion.intake
    fed.pose()
    for k in range(20):
        fed.frames(k + 1, frame(begin_us + 250_000 * k), first=k == 0)
    fusion.advance(begin_us + 20_000_000)
    hit, observed = fusion.counts.since_begin()
    fusion.close()
    assert observed.max() == hit.max() == 19 * 5 + 8
