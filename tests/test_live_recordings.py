"""The spool of fusion and the recordings that are made of it, whatever ends in the midst of it."""

import errno
import os
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from live_hours import SpooledSite, frames_at, selected_frames
from live_intake import NOW_US, FedIntake, frame, pose_message
from live_programs import Lines, pose_beside

import gis_radar as gr
from gis_radar.base import STEP_US, OutputError
from gis_radar.live import (
    HOUR_OFFSET_US,
    HOUR_US,
    Envelope,
    Spool,
    SpooledFrames,
    SpoolFile,
    join_parts,
    make_parts,
    pack_message,
    recording_path,
    spool_files,
    waiting_hours,
)
from gis_radar.live.hours.recordings import remove_old
from gis_radar.live.hours.spool import FRAMES_RECORD, POSE_RECORD

HOUR = 486_111  # since 1970: 2025-06
BEGIN_US = HOUR * HOUR_US + HOUR_OFFSET_US


def times(path):
    return np.unique(np.rint(pd.read_parquet(path)["time"] * 1e6).astype(np.int64)).tolist()


def test_a_spool_that_ends_in_a_record_is_read_up_to_there(tmp_path):
    fed = FedIntake(tmp_path)
    fed.pose()
    for number in (1, 2, 3):
        fed.frames(number, first=number == 1)
        fed.commit()
    fed.spool.close()
    (path,) = spool_files(tmp_path / "spool")
    whole = path.read_bytes()
    kept = len(fed.spooled())
    for end in range(len(whole) - 1, len(whole) - 20, -3):
        path.write_bytes(whole[:end])
        assert len(fed.spooled()) == kept - 1
    path.write_bytes(whole[:-8] + bytes(8))  # as a loss of power leaves it
    again = FedIntake(tmp_path)
    assert again.stored == 2
    assert again.spool.closed == [path]


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_full_disk_keeps_what_waits_and_leaves_no_half_record(tmp_path, monkeypatch, call):
    fed = FedIntake(tmp_path)
    fed.pose()
    fed.frames(1, first=True)
    fed.commit()
    fed.frames(2)
    real = getattr(os, call)

    def full(handle, *data):
        if data:
            real(handle, data[0][:7])
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        for _ in range(2):
            with pytest.raises(OutputError, match="cannot be written"):
                fed.commit()
    assert (fed.stored, fed.spool.waiting) == (1, 1)
    before = len(fed.spooled())
    fed.commit()
    assert (fed.stored, fed.spool.waiting) == (2, 0)
    assert len(fed.spooled()) == before + 1


def test_a_disk_without_an_inode_leaves_the_old_file_in_use(tmp_path, monkeypatch):
    fed = FedIntake(tmp_path)
    fed.pose()
    fed.frames(1, first=True)
    fed.commit()
    real = os.open

    def no_inode(path, flags, *mode):
        if flags & os.O_CREAT:
            raise OSError(errno.ENOSPC, "no inode")
        return real(path, flags, *mode)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", no_inode)
        with pytest.raises(OutputError, match="cannot be written"):
            fed.spool.rotate()
        fed.frames(2)
        fed.commit()
    assert len(spool_files(tmp_path / "spool")) == 1
    fed.spool.rotate()
    assert len(spool_files(tmp_path / "spool")) == 2
    assert len(fed.spooled()) == 3


def test_the_spool_reaches_the_disk_before_it_counts(tmp_path, monkeypatch):
    """Each batch is synced after it was written: a loss of power takes nothing acknowledged."""
    spool = Spool(tmp_path / "s")
    spool.rotate()
    calls = []
    write, sync = os.write, os.fsync
    monkeypatch.setattr(os, "write", lambda *each: calls.append("write") or write(*each))
    monkeypatch.setattr(os, "fsync", lambda each: calls.append("fsync") or sync(each))
    message = pack_message(Envelope(stream=b"abcd", number=1), b"")
    spool.add(SpooledFrames("R1", b"", message))
    spool.collect()
    spool.write()
    assert calls == ["write", "fsync"]


def test_of_streams_that_take_turns_the_one_heard_last_is_gone_on_with(tmp_path):
    spool = Spool(tmp_path / "s")
    turns = ((b"abcd", 1), (b"efgh", 1), (b"abcd", 2))
    spool.mark(
        ("R1", pack_message(Envelope(stream=stream, number=number), b""))
        for stream, number in turns
    )
    assert [(bytes.fromhex(name), mark.number) for name, mark in spool.marks["R1"].items()] == [
        (b"efgh", 1), (b"abcd", 2),
    ]  # fmt: skip


@pytest.mark.skipif(os.name != "posix", reason="names are brought to disk by the system")
def test_a_new_file_of_the_spool_has_its_name_on_disk_before_it_is_used(tmp_path, monkeypatch):
    spool, synced, sync = Spool(tmp_path / "s"), [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda each: synced.append(os.fstat(each)) or sync(each))
    spool.rotate()
    places = [*spool_files(tmp_path / "s"), tmp_path / "s"]
    assert [each.st_ino for each in synced] == [each.stat().st_ino for each in places]


def test_a_recording_holds_each_frame_once_in_the_order_of_time(tmp_path):
    """Of two files of the spool that overlap, out of order, over the end of an hour."""
    made = SpooledSite(tmp_path)
    frames = frames_at("R1", BEGIN_US + HOUR_US - 15_000_000)
    spooled = made.add("R1", frames[180:420])
    spooled = made.add("R1", [*frames[:270], *frames[390:]])
    for path in spooled:
        make_parts(made.folder, path)
    assert made.spool.closed == []
    assert waiting_hours(made.folder) == {HOUR, HOUR + 1}
    said = Lines()
    found = [join_parts(made.folder, "R1", hour, said) for hour in (HOUR, HOUR + 1)]
    border = BEGIN_US + HOUR_US
    wanted = [each.time_us for each in frames]
    assert times(found[0]) == [each for each in wanted if each < border]
    assert times(found[1]) == [each for each in wanted if each >= border]
    rows = pd.concat([pd.read_parquet(path) for path in found], ignore_index=True)
    sent = np.concatenate([each.as_rows().points for each in frames])
    np.testing.assert_array_equal(rows[["x", "y", "z"]], sent.astype(np.float32))
    assert (said.lines, waiting_hours(made.folder)) == ([], set())
    assert list(gr.open_recording(found[0]).read())


def test_making_parts_and_joining_them_again_changes_nothing(tmp_path):
    """As after `kill -9` between any two steps."""
    made = SpooledSite(tmp_path)
    frames = frames_at("R1", BEGIN_US)
    (spooled,) = made.add("R1", frames)
    kept = spooled.read_bytes()
    make_parts(made.folder, spooled)
    (part,) = (made.folder / "parts" / "R1").iterdir()
    first = part.read_bytes()
    spooled.write_bytes(kept)
    make_parts(made.folder, spooled)
    assert part.read_bytes() == first
    said = Lines()
    path = join_parts(made.folder, "R1", HOUR, said)
    recording = path.read_bytes()
    part.write_bytes(first)  # killed before it was removed
    assert join_parts(made.folder, "R1", HOUR, said).read_bytes() == recording
    assert (said.lines, list((made.folder / "parts" / "R1").iterdir())) == ([], [])


@pytest.mark.parametrize("at_once", [False, True], ids=["two files of the spool", "one file"])
def test_frames_that_contradict_each_other_are_named_and_the_first_stay(tmp_path, at_once):
    """Two programs with one name, or a clock that is set back."""
    made, said = SpooledSite(tmp_path), Lines()
    frames = frames_at("R1", BEGIN_US)
    other = [replace(each, points=each.points + 250) for each in frames[90:110]]
    if at_once:
        made.add("R1", [*frames[:100], *frames[:50], *other])
    else:
        made.add("R1", frames[:100])
        made.add("R1", other)
    for path in made.spool.closed:
        make_parts(made.folder, path, said)
    path = join_parts(made.folder, "R1", HOUR, said)
    assert said.told("R1: 10 frames differ from others of the same time")
    assert times(path) == [each.time_us for each in frames[:110]]
    mine = pd.read_parquet(path).iloc[: sum(len(each.as_rows()) for each in frames[:100])]
    sent = np.concatenate([each.as_rows().points for each in frames[:100]])
    np.testing.assert_array_equal(mine[["x", "y", "z"]], sent.astype(np.float32))


def test_poses_lie_beside_a_recording_as_they_were_in_force(tmp_path):
    made = SpooledSite(tmp_path)
    frames = frames_at("R1", BEGIN_US)
    steps = [each.time_us // STEP_US for each in frames]
    cut = next(k for k in range(400, 500) if steps[k] > steps[k - 1])  # as a sensor does
    made.add("R1", frames[:cut])
    moved = made.pose("R1", easting=690360.21, event="")
    for path in made.add("R1", frames[cut:], pose=moved):
        make_parts(made.folder, path)
    path = join_parts(made.folder, "R1", HOUR, Lines())
    track = gr.read_track(pose_beside(path))
    assert [pose.easting for pose in track.poses] == [690360.113, 690360.21]
    at = track.at(np.array([each.time_us / 1e6 for each in frames]))
    assert at.tolist() == [0] * cut + [1] * (len(frames) - cut)
    assert not path.with_suffix(".json").exists()


def test_recordings_are_kept_for_a_time_and_in_a_room(tmp_path):
    made = SpooledSite(tmp_path)
    now = NOW_US // HOUR_US
    frames = selected_frames("R1")[:40]
    for hour in (now - 200, now - 5, now - 4, now - 3):
        shift = hour * HOUR_US + HOUR_OFFSET_US - frames[0].time_us
        made.add("R1", [replace(each, time_us=each.time_us + shift) for each in frames])
        for path in made.spool.closed:
            make_parts(made.folder, path)
        join_parts(made.folder, "R1", hour, Lines())
    said = Lines()
    remove_old(made.folder, keep_s=168 * 3600.0, most_bytes=1e12, reporter=said)
    there = [recording_path(made.folder, "R1", now - k).exists() for k in (200, 5, 4, 3)]
    assert (there, said.lines) == ([False, True, True, True], [])
    size = recording_path(made.folder, "R1", now - 3).stat().st_size
    remove_old(made.folder, keep_s=168 * 3600.0, most_bytes=2.5 * size, reporter=said)
    there = [recording_path(made.folder, "R1", now - k).exists() for k in (5, 4, 3)]
    assert there == [False, True, True]
    assert said.told("1 recordings are removed before their time")
    assert not list((made.folder / "recordings" / "R1").glob("*T*Z.json"))[2:]


def test_where_the_room_is_full_what_is_not_measured_goes_too_and_the_newest_stays(tmp_path):
    made = SpooledSite(tmp_path)
    now, frames = NOW_US // HOUR_US, selected_frames("R1")[:40]
    for hour in (now - 200, now - 199, now - 3):
        shift = hour * HOUR_US + HOUR_OFFSET_US - frames[0].time_us
        for path in made.add("R1", [replace(f, time_us=f.time_us + shift) for f in frames]):
            make_parts(made.folder, path)
        join_parts(made.folder, "R1", hour, Lines())
    paths = [recording_path(made.folder, "R1", now - k) for k in (200, 199, 3)]
    size, said = paths[0].stat().st_size, Lines()

    def left(most_bytes):
        keep = {"keep_s": 168 * 3600.0, "is_needed": paths[:2].__contains__}
        remove_old(made.folder, most_bytes=most_bytes, reporter=said, **keep)
        return [path.exists() for path in paths]

    assert (left(1e12), said.lines) == ([True, True, True], [])
    assert left(2.5 * size) == [False, True, True]
    assert left(0.0) == [False, False, True]
    assert sum("1 recordings are removed before their time" in line for line in said.lines) == 2


@pytest.mark.parametrize("share", [0.02, 0.5, 0.999])
@pytest.mark.parametrize("whole_head", [False, True])
def test_a_damaged_record_of_the_spool_costs_itself_alone(tmp_path, share, whole_head):
    made = SpooledSite(tmp_path)
    frames = frames_at("R1", BEGIN_US)
    (spooled,) = made.add("R1", frames)
    begins = [at for at, record in SpoolFile(spooled).records() if record.kind == FRAMES_RECORD]
    begin = begins[int(share * len(begins))]
    damaged = bytearray(spooled.read_bytes())
    damaged[begin + (20 if whole_head else 3)] ^= 1
    spooled.write_bytes(damaged)
    said = Lines()
    make_parts(made.folder, spooled, said)
    path = join_parts(made.folder, "R1", HOUR, said)
    lost = len(frames) - len(times(path))
    assert 0 < lost <= 50
    if begin != begins[-1] or whole_head:  # else as a crash leaves it
        assert spooled.with_suffix(".damaged").read_bytes() == damaged
        assert said.told(f"{spooled}: damaged records are left out")


def test_frames_whose_pose_is_damaged_in_the_spool_get_no_other(tmp_path):
    made = SpooledSite(tmp_path)
    frames = frames_at("R1", BEGIN_US)[:100]
    moved = made.pose("R1", easting=690360.21)
    for part, pose in ((frames[:50], None), (frames[50:], moved)):
        (*_, spooled) = made.add("R1", part, pose=pose)
    first, second = made.spool.closed
    data = first.read_bytes() + second.read_bytes()  # as of one batch
    at = data.rindex(moved)
    spooled.write_bytes(data[:at] + b"?" + data[at + 1 :])
    said = Lines()
    make_parts(made.folder, spooled, said)
    path = join_parts(made.folder, "R1", HOUR, said)
    assert times(path) == [each.time_us for each in frames[:50]]
    assert said.told("damaged records are left out")


def test_frames_keep_their_pose_however_many_poses_come_before_the_disk(tmp_path):
    """A sensor that follows its pose, after an outage: over 64 poses between two commits."""
    fed = FedIntake(tmp_path)
    for k in range(100):
        key = fed.pose(pose_message(easting=690360.0 + 0.01 * k))
        fed.frames(k + 1, frame(NOW_US - HOUR_US + 50_000 * k), key=key, first=k == 0)
    fed.commit()
    kinds = [each.kind for each in fed.spooled()]
    assert (kinds.count(FRAMES_RECORD), kinds.count(POSE_RECORD)) == (100, 100)
