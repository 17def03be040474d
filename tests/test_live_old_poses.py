"""Poses of a sensor that is followed: old ones go, and what later ones share stays the same."""

import numpy as np
import pytest
from live_site import SAMPLE
from test_live_faults import HOUR, intake_of, message, pose_content, road, row  # noqa: F401

import gis_radar as gr
from gis_radar.errors import OutputError
from gis_radar.live.hours import HOUR_US
from gis_radar.live.journal import Journal
from gis_radar.live.old_poses import FEW
from gis_radar.live.payload import HITS, POSE, pack_hits
from gis_radar.measures.hit_counter import CountedFrame
from gis_radar.measures.views import ViewBook
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import pose_from_dict


def content_of(road, change):  # noqa: F811
    return pose_content(road.fingerprint, **change)


def frame_at(time_us):
    return CountedFrame(
        time_us=time_us, detections=1, moving=1, wild=0, checksum=5, tiles=np.array([1])
    )


def hits(road, number, pose, time_us):  # noqa: F811
    return message(
        HITS, number, pack_hits([frame_at(time_us)], pose=pose, fingerprint=road.fingerprint)
    )


def changes(number, rng):
    """Return poses that drift, jump back to where they were, and are moved."""
    first, (east, yaw) = gr.read_pose(SAMPLE / "R1.json").as_dict(), (0.0, 0.0)
    for k in range(number):
        east += rng.normal(0.0, 0.1)
        yaw += rng.normal(0.0, 0.05)
        moved = {"event": "moved"} if k and rng.random() < 0.03 else {}
        away = rng.choice([0.0, 0.6, -0.6])
        yield {
            "easting": first["easting"] + east + away, "yaw": first["yaw"] + yaw,
            "quaternion": None, **moved,
        }  # fmt: skip


@pytest.mark.parametrize("seed", [1, 2])
def test_views_are_those_of_all_poses_however_often_old_ones_go(tmp_path, road, seed):  # noqa: F811
    """Poses are dropped and fusion is started anew, often; the batch knows the whole track."""
    rng = np.random.default_rng(seed)
    found, number, poses = [], 0, []
    journal = Journal(tmp_path / "j", fingerprint=road.fingerprint)
    intake = intake_of(journal, road)
    for k, change in enumerate(changes(120, rng)):
        content = content_of(road, {key: v for key, v in change.items() if v is not None})
        content.pose.pop("quaternion", None)
        number += 1
        intake.handle(message(POSE, number, content.pack(), number - 1))
        sensor = intake.sensors["R1"]
        assert sensor.received == number, sensor.health.alarms
        pose = number
        poses.append(pose_from_dict(content.pose, what="a pose"))
        found.append(intake.poses[sensor.poses[sensor.stream, pose]].view)
        time_us = HOUR * HOUR_US + k * 5_000_000
        number += 1
        intake.handle(hits(road, number, pose, time_us))
        if rng.random() < 0.5:
            journal.commit()
        if rng.random() < 0.3:
            journal.drop_hour(HOUR, ["R1"])
        intake.forget()
        if rng.random() < 0.2:  # killed: what is not on disk comes again
            journal.commit()
            journal.__exit__()
            journal = Journal(tmp_path / "j", fingerprint=road.fingerprint)
            intake = intake_of(journal, road)
        assert {each.pose for each in _rows(journal)} <= set(intake.poses)
    journal.__exit__()
    track = PoseTrack(poses=tuple(poses), since=np.arange(float(len(poses))))
    assert found == list(ViewBook(road=road).enter(track))
    assert 3 < len(set(found)) < 110


def _rows(journal):
    return [each for piece in journal.frames("R1", 0, 2**60) for each in piece]


def test_old_poses_go_all_or_none(tmp_path, road):  # noqa: F811
    """Broken off in the midst of it, no pose is gone that another one names."""
    content = content_of(road, {})
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        intake = intake_of(journal, road)
        for number in range(1, 4):
            intake.handle(message(POSE, number, content.pack(), number - 1))
        ids = [row.id for row in journal.poses("R1")]
        journal._database.execute(
            "CREATE TEMP TRIGGER stop BEFORE DELETE ON poses "
            f"WHEN old.id = {ids[1]} BEGIN SELECT RAISE(ABORT, 'the power is gone'); END"
        )
        with pytest.raises(OutputError, match="the power is gone"):
            journal.drop_poses(ids[:2])
        assert [row.id for row in journal.poses("R1")] == ids
        journal._database.execute("DROP TRIGGER stop")
        journal.drop_poses(ids[1:])
        assert [row.id for row in journal.poses("R1")] == ids[:1]


def test_a_day_of_followed_poses_takes_no_more_than_an_hour_of_them(tmp_path, road):  # noqa: F811
    """Another pose every 5 s: number and file are as large after six hours as after two."""
    rng, number, sizes, counts = np.random.default_rng(3), 0, [], []
    content = content_of(road, {})
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        intake = intake_of(journal, road)
        easting = content.pose["easting"]
        for hour in range(HOUR, HOUR + 6):
            for k in range(50):
                content.pose["easting"] = easting + rng.normal(0.0, 0.002)
                intake.handle(message(POSE, number + 1, content.pack(), number))
                time_us = hour * HOUR_US + k * 36_000_000
                intake.handle(hits(road, number + 2, number + 1, time_us))
                number += 2
                if k % 10 == 9:
                    journal.commit()
                intake.forget()
            journal.drop_hour(hour, ["R1"])
            intake.forget()
            counts.append(len(intake.poses))
            sizes += journal._database.execute("PRAGMA page_count").fetchone()
        sensor = intake.sensors["R1"]
        assert sensor.received == number == 600
        assert max(counts) <= FEW
        assert len(sensor.poses) == len(intake.poses) == len(journal.poses("R1"))
        assert sizes[-1] <= sizes[1]
        # an old pose that the broker kept is not taken up again
        kept = message(POSE, 1, content.pack(), 0)._replace(retained=True)
        pose = sensor.pose
        intake.handle(kept)
        assert sensor.pose is pose
        assert len(intake.poses) == counts[-1]
        # and a message of the pose in force still finds it
        intake.handle(hits(road, number + 1, number - 1, (HOUR + 6) * HOUR_US))
        assert sensor.received == number + 1
        assert sensor.health.counts["damaged"] == 0
