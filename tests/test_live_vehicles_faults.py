"""What may happen to following vehicles live: links away, sensors silent, processes killed."""

import multiprocessing.spawn
import os
import pickle
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import time
from dataclasses import replace
from multiprocessing import resource_tracker
from pathlib import Path
from queue import Queue
from threading import Event, Thread
from threading import enumerate as enumerate_threads
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from live_site import LONGEST_S, SAMPLE, Background, wait_for
from live_vehicles import Sent, frames_in

import gis_radar as gr
from gis_radar.live.detections import FrameDetections, pack_detections
from gis_radar.live.vehicles import follower as follower_module
from gis_radar.live.vehicles import in_fusion
from gis_radar.live.vehicles import worker as worker_module
from gis_radar.live.vehicles.clocks import SensorFrame
from gis_radar.live.vehicles.counts import VehicleCounts
from gis_radar.live.vehicles.in_fusion import LiveVehicles
from gis_radar.live.vehicles.now import VehiclesNow
from gis_radar.live.vehicles.occupancy import Finished
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.live.vehicles.store import VehicleStore
from gis_radar.live.vehicles.worker import (
    EndMessage,
    FramesMessage,
    PoseMessage,
    VehicleWorker,
    WorkerEvent,
)
from gis_radar.steps import STEP_US
from gis_radar.tracking.visibility import SensorView

NAMES = ("R1", "R2")
SHORT = replace(DEFAULTS, steps=100, margin_steps=40, behind_steps=10**6)


@pytest.fixture(scope="module")
def sent(tmp_path_factory):
    poses = [gr.read_pose(SAMPLE / f"{name}.json") for name in NAMES]
    return Sent(SAMPLE / "junction.osm", [], poses, tmp_path_factory.mktemp("sent"))


def empty(sensor, pose, time_us):
    """Return a frame without a detection."""
    none = np.zeros(0, np.int64)
    points = np.zeros((0, 3), np.int64)
    found = FrameDetections(time_us=time_us, points=points, rates=none, rcs_db=none)
    return SensorFrame(sensor, pose, found)


def site_of(sent, tmp_path):
    live = SimpleNamespace(interval="15min")
    named = [SimpleNamespace(name=name) for name in NAMES]
    map_ = SimpleNamespace(file=SAMPLE / "junction.osm")
    return SimpleNamespace(map=map_, sensor=named, folder=tmp_path, live=live)


def test_a_pose_beside_a_sensor_that_follows_stays_known(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(follower_module, "POSES_KEPT", 3)
    here = sent.at(tmp_path / "here")
    follower = here.follower(SHORT)
    begin = 36_000_000 * STEP_US
    pose, _ = follower._poses[here.rows["R1"]]
    for k in range(12):  # R2 is away
        number = here.rows["R1"]
        if k:
            moved = replace(pose, view=f"of {k}", content={**pose.content, "easting": 1000.0 + k})
            seen = SensorView(
                sensor="R1", view=moved.view, tile_id=np.zeros(0, np.int64), position=np.zeros(3)
            )
            follower.store.add_view(seen, 1.0)
            follower.add_view(seen, 1.0)
            number = follower.store.add_pose(moved)
            follower.add_pose(number, moved)
        times = begin + np.arange(100 * k, 100 * k + 100) * STEP_US
        follower.take([empty("R1", number, int(each)) for each in times])
        while (span := follower.due()) is not None:
            follower.begin(span)
    assert len(follower._poses) < 7
    assert {*follower.store.poses()} == {*follower._poses}
    assert len(follower.store.views()) == len(follower._poses)
    assert len(follower._occupancy._engine._visibility._views) == len(follower._poses)
    assert len(follower._road_m) == len(follower._poses)
    assert not follower.knows(here.rows["R2"])
    follower.take([empty("R2", here.rows["R2"], int(times[-1]))])
    assert follower.unknown == 1


def test_fusion_names_a_pose_again_that_was_not_used_for_long(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(in_fusion, "POSES_NAMED", 2)
    vehicles = LiveVehicles(site_of(sent, tmp_path), sent.tiles, sent.book)
    named = []
    vehicles._hand_on = lambda message: named.append(message) or True
    content = {each.sensor: each.as_dict() for each in sent.poses}

    def name(sensor, row):
        known = SimpleNamespace(
            view=sent.views[sensor],
            content=SimpleNamespace(validity_s=0.1, pose=content[sensor], trusted=True),
        )
        vehicles._process = vehicles
        health = SimpleNamespace(name=sensor, counts={"detections": 0, "left_out": 0})
        vehicles.take(
            health,
            "s",
            pack_detections([empty(sensor, 1, 10**15).detections], pose=1),
            {("s", 1): row},
            {row: known},
        )

    for sensor, row in [("R2", 1), ("R1", 2), ("R2", 1), ("R1", 3), ("R2", 1), ("R1", 2)]:
        name(sensor, row)
    assert [each.number for each in named] == [1, 2, 3, 2]
    assert [each.view is not None for each in named] == [True, True, False, False]
    assert len(vehicles._known) == 2


def test_vehicles_of_now_are_none_once_all_sensors_are_silent(sent, tmp_path, monkeypatch):
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(in_fusion, "time", SimpleNamespace(monotonic=lambda: clock.now))
    vehicles = LiveVehicles(site_of(sent, tmp_path), sent.tiles, sent.book)
    vehicles._process = object()
    now = VehiclesNow.of(100.0, np.ones((1, 6)))
    for newest in (100.1, 100.2):
        vehicles._note(WorkerEvent(counts={"newest_s": newest}, now=now))
    assert len(vehicles.now()) == 1
    clock.now += in_fusion.OLD_S + 0.1
    vehicles._note(WorkerEvent(counts={"newest_s": 100.2}, now=now))
    assert len(vehicles.now()) == 0


def die_in_the_midst(_sites, _inbox, outbox, _settings):
    """Die as a process that is killed while it tells much."""
    os.write(outbox.fileno(), struct.pack("!i", 10_000_000) + bytes(30_000))
    os.kill(os.getpid(), signal.SIGKILL)


def be_fusion(folder):
    """Have a process killed with much in its inbox, as the fusion of a site; a program's work."""
    sent = Sent(
        SAMPLE / "junction.osm", [], [gr.read_pose(SAMPLE / f"{k}.json") for k in NAMES], folder
    )
    in_fusion.follow_in_process = die_in_the_midst
    vehicles = LiveVehicles(site_of(sent, folder), sent.tiles, sent.book)
    vehicles._start()
    vehicles._hand_on(bytes(1_000_000))
    while not vehicles.restarts:
        vehicles.turn()
        time.sleep(0.01)
    sys.stdout.write("lost")


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_a_process_killed_while_it_tells_holds_nothing_up(tmp_path):
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path)], timeout=LONGEST_S, check=True,
        capture_output=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.stdout.split() == [b"lost"]


@pytest.mark.skipif(os.name == "nt", reason="there is no false")
def test_a_process_that_dies_at_its_start_holds_nothing_up(sent, tmp_path, monkeypatch):
    said = []
    reporter = SimpleNamespace(log=lambda text, _: said.append(text))
    vehicles = LiveVehicles(site_of(sent, tmp_path), sent.tiles, sent.book, reporter=reporter)
    assert len(pickle.dumps(vehicles._site)) > 100_000  # more than a pipe holds
    resource_tracker.ensure_running()  # it is started by the same program
    # What starts the process, for spawn: a program that reads nothing and ends.
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", shutil.which("false").encode())
    starting = Thread(target=vehicles._start, daemon=True)
    starting.start()
    starting.join(LONGEST_S)
    assert not starting.is_alive()

    def lost():
        vehicles.turn()
        return vehicles.restarts == 1

    wait_for(lost)
    assert "has ended (1); a new one takes up where it was" in said[0]
    assert vehicles._failed == 1  # so that the next try comes later
    wait_for(lambda: "site" not in {thread.name for thread in enumerate_threads()})


def test_a_store_that_cannot_be_opened_is_tried_again(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(in_fusion, "AGAIN_S", 0.1)
    (tmp_path / "vehicles.sqlite").mkdir()
    said = []
    reporter = SimpleNamespace(log=lambda text, _: said.append(text))
    vehicles = LiveVehicles(site_of(sent, tmp_path), sent.tiles, sent.book, reporter=reporter)
    vehicles.make_ready(Event())
    first = vehicles._process

    def lost():
        vehicles.turn()
        return vehicles._process is None

    wait_for(lost)
    assert not first.is_alive()
    (tmp_path / "vehicles.sqlite").rmdir()
    time.sleep(0.1)
    vehicles.turn()
    vehicles.finish()
    assert vehicles._ended
    assert (tmp_path / "vehicles.sqlite").is_file()
    assert vehicles.restarts == 0
    assert len(said) == 1
    assert "vehicles.sqlite" in said[0]


@pytest.mark.parametrize("ruin", ["pages", "rows", "pieces"])
def test_a_damaged_store_is_put_aside(tmp_path, ruin):
    path = tmp_path / "vehicles.sqlite"
    VehicleStore(path, fingerprint="f").close()
    if ruin == "pages":
        path.write_bytes(b"no database" * 1000)
    else:
        row = ("0", "0", "x", "x", "x", "[]" if ruin == "pieces" else "no JSON", "[]", 0)
        with sqlite3.connect(path) as database:
            database.execute("INSERT INTO pieces VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
        database.close()
    store = VehicleStore(path, fingerprint="f")
    assert store.put_aside.is_file()
    assert store.edge() is None
    store.close()
    assert VehicleStore(path, fingerprint="f").put_aside is None


def worker(here, settings=SHORT):
    """Return what the process runs, on a store, with its inbox and what it tells."""
    store = VehicleStore(here.site.folder / "store", fingerprint=here.site.fingerprint)
    inbox, told = Queue(), []
    outbox = SimpleNamespace(put=told.append)
    return VehicleWorker(here.site, store, inbox, outbox.put, settings), inbox, told


def finished(told):
    return [each.finished for each in told if each.finished is not None]


def minutes(begin, count):
    """Return times of frames, 20 a second."""
    return (begin + np.arange(count)) * STEP_US


def message(follower, here, times):
    """Return a message of frames of R1, after its pose."""
    pose, _ = follower._poses[here.rows["R1"]]
    contents = [pack_detections([empty("R1", 1, int(each)).detections], pose=1) for each in times]
    return [
        PoseMessage(number=7, pose=pose),
        FramesMessage(rows=[("R1", 7, each) for each in contents]),
    ]


def test_an_hour_is_written_though_its_process_was_killed_long_ago(sent, tmp_path):
    here = sent.at(tmp_path / "here")
    follower = here.follower(SHORT)
    hour = 400_000
    follower.take([empty("R1", here.rows["R1"], int(each)) for each in minutes(hour * 72_000, 400)])
    assert len(list(here.end(follower))) == 4
    follower.store.close()  # killed
    again, inbox, told = worker(here)
    for each in [*message(follower, here, minutes((hour + 2) * 72_000, 400)), EndMessage()]:
        inbox.put(each)
    again.run()
    written = [each.written for each in told if each.written]
    assert {*written} == {here.site.path_of(hour), here.site.path_of(hour + 2)}
    assert frames_in(here.site.path_of(hour))["sensor"].unique().tolist() == ["R1"]
    again._store.close()


def test_an_hour_that_cannot_be_written_is_kept(sent, tmp_path):
    here = sent.at(tmp_path / "here")
    (tmp_path / "here" / "vehicles").write_text("in the way")
    follower = here.follower(SHORT)
    hour = 400_000
    running, inbox, told = worker(here)
    for later in range(4):
        begin = (hour + later) * 72_000
        for each in message(follower, here, minutes(begin, 300)):
            inbox.put(each)
    inbox.put(EndMessage())
    running.run()
    assert not [each for each in told if each.written]
    assert running._store.batch_hours(72_000) == [hour + k for k in range(4)]
    assert told[-1].counts["failing_hours"] == 4
    running._store.close()


def test_an_hour_that_cannot_be_written_for_a_day_is_given_up_by_name(sent, tmp_path):
    here = sent.at(tmp_path / "here")
    (tmp_path / "here" / "vehicles").write_text("in the way")
    follower = here.follower(SHORT)
    running, inbox, told = worker(here, replace(SHORT, give_up_s=0.0))
    for later in range(4):
        for each in message(follower, here, minutes((400_000 + later) * 72_000, 300)):
            inbox.put(each)
    inbox.put(EndMessage())
    running.run()
    assert running._store.batch_hours(72_000) == [400_002, 400_003]  # as of those written
    assert told[-1].counts["failing_hours"] == 0
    said = [each.said for each in told if each.said.endswith("they are dropped")]
    assert len(said) == 4
    assert said[0].startswith("vehicles of 2015-08-19T16Z could not be written")
    running._store.close()


def test_a_minute_that_cannot_be_followed_is_left_out_and_the_next_ones_count(sent, tmp_path):
    here = sent.at(tmp_path / "here")
    follower = here.follower(SHORT)
    begin = 400_000 * 72_000
    running, inbox, told = worker(here)
    broken, whole = [], running._follower.finish

    def finish(block, poses, **more):
        if not broken:
            broken.append(block)
            raise ValueError("planted")
        return whole(block, poses, **more)

    running._follower.finish = finish
    for each in [*message(follower, here, minutes(begin, 300)), EndMessage()]:
        inbox.put(each)
    running.run()
    assert [each.first_step for each in finished(told)] == [begin + 100, begin + 200]
    assert told[-1].counts["failed"] == 1
    assert any("planted" in each.said for each in told)
    running._store.close()


def test_a_vehicle_passes_a_lane_once_over_the_edge_of_a_block(sent):
    counts = VehicleCounts(sent.tiles, interval=18_000)
    lane = next(each for each in counts.lanes)
    of = np.array([counts.lanes[counts._lane_of[k]] for k in counts._lane_of])
    lanelet = np.array([*counts._lane_of])[of == lane][0]
    zeros = np.zeros(len(sent.tiles), np.int64)
    for k, vehicles in enumerate([[1], [1, 2], [3, 3]]):
        passages = pd.DataFrame({"vehicle": vehicles, "lanelet_id": lanelet, "speed": 10.0})
        counts.add(
            Finished(
                first_step=1200 * k, last_step=1200 * k + 1199, visible=zeros, occupied=zeros,
                passages=passages, stood=np.zeros((0, 5)),
            )
        )  # fmt: skip
    assert counts.lanes_lately()["passages"].sum() == 3
    assert counts.intervals()["passages"].sum() == 3


def test_a_sensor_whose_clock_is_set_back_a_little_is_followed_on(sent, tmp_path):
    here = sent.at(tmp_path / "here")
    follower = here.follower(SHORT)
    take = lambda times: follower.take([empty("R1", here.rows["R1"], int(t)) for t in times])  # noqa: E731
    begin = 400_000 * 72_000
    take(minutes(begin, 120))
    take(minutes(begin + 90, 1))  # came twice
    take(minutes(begin + 120, 1))
    assert follower.repeated == 1
    take(minutes(begin + 60, 100)[:50])
    take(minutes(begin + 110, 90))
    follower.keep()
    stored = [row.time_us for rows in follower.store.seconds() for row in rows]
    assert stored == minutes(begin, 200).tolist()  # each time once, none left out
    assert follower.newest_step == begin + 199
    blocks = list(here.end(follower))
    assert [(e.first_step, e.last_step) for e in blocks] == [
        (begin, begin + 99), (begin + 100, begin + 199),
    ]  # fmt: skip
    assert follower.repeated == 1


@pytest.mark.parametrize("back", [72_000, 350])
def test_clocks_that_are_set_back_far_begin_anew_and_nothing_counts_twice(sent, tmp_path, back):
    here = sent.at(tmp_path / "here")
    follower = here.follower(SHORT)
    begin = 400_001 * 72_000
    again = begin + 400 - back
    running, inbox, told = worker(here)
    work = Background(lambda _: running.run())
    for first, count in ((begin, 400), (again, 140)):
        for each in message(follower, here, minutes(first, count)):
            inbox.put(each)
        wait_for(lambda: len(finished(told)) >= 3)
    inbox.put(EndMessage())
    work.end()
    running._store.close()
    (folder,) = {each.written for each in told if each.written and each.written.exists()}
    frames = frames_in(folder)
    least = begin if back == 350 else again
    assert (frames["first_step"].min(), frames["last_step"].max()) == (least, again + 139)
    (aside,) = (each for each in folder.parent.iterdir() if each.name.count("."))
    assert aside.name.startswith("2015-08-19T17Z.")
    first = frames_in(aside)
    assert (first["first_step"].min(), first["last_step"].max()) == (begin, begin + 399)
    counts = VehicleCounts(sent.tiles, interval=18_000)
    for each in told:
        if each.anew is not None:
            assert counts.until_step == begin + 399
            counts.begin_anew(each.anew)
        if each.finished is not None:
            counts.add(each.finished)
    assert counts.until_step == again + 139
    seen = counts.last_minutes().visible.max()
    assert seen == again + 140 - least
    assert counts.interval().visible.max() == seen
    assert counts.intervals()["visible_s"].max() <= seen / 20
    assert any("clocks were set back" in each.said for each in told)


def test_vehicles_are_followed_anew_while_the_process_runs(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(worker_module, "COMMIT_S", 1e9)  # what is committed only in between
    here = sent.at(tmp_path / "here")
    follower = here.follower(SHORT)
    begin = 400_001 * 72_000
    running, inbox, told = worker(here, replace(SHORT, silent_s=0.3))
    work = Background(lambda _: running.run())

    def hand_on(first):
        for each in message(follower, here, minutes(first, 300)):
            inbox.put(each)

    hand_on(begin)
    wait_for(lambda: len(finished(told)) == 3)
    hand_on(begin - 72_000)
    wait_for(lambda: len(finished(told)) == 6)
    assert running._follower.done == begin - 72_000 + 299
    assert told[-1].counts["newest_s"] < begin / 20
    inbox.put(EndMessage())
    work.end()
    running._store.close()


if __name__ == "__main__":
    be_fusion(Path(sys.argv[1]))
