"""Hours and quarters that fusion has measured beside the map: equal to the batch, made once."""

import json
import multiprocessing
import time
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from live_hours import SAMPLE, SpooledSite, frames_at
from live_programs import Lines, pose_beside
from live_site import wait_for

import gis_radar as gr
from gis_radar.base import InputError, WorkerPool, step_begin
from gis_radar.calibration.findings import Cause, wrong
from gis_radar.dataset import hour_text, read_hours
from gis_radar.live import HOUR_OFFSET_US, HOUR_US, QuarterMeasures, recording_path
from gis_radar.live.hours import hour_work
from gis_radar.live.hours import jobs as jobs_module
from gis_radar.live.hours.hour_work import (
    QUARTER_US,
    JobResult,
    make_hours,
    make_quarter,
    refuse_other_settings,
    resume_hours,
)
from gis_radar.live.hours.jobs import DOUBTS_FILE, HourJobs
from gis_radar.live.hours.quarters import QUARTERS_KEPT, TRAFFIC_FIELDS, Quarters, read_quarters
from gis_radar.live.hours.recordings import end_of_hour_s

pytestmark = pytest.mark.usefixtures("ready_workers")
HOUR = 486_111  # since 1970: 2025-06-15T15Z
FULL_US = (HOUR + 1) * HOUR_US  # the full hour after it
NAMES = ("R1", "R2")
# The check of poses, of which some tests are, takes longer than to measure.
measure_hours = partial(make_hours, check=lambda *_: ())


class Clock:
    """The module `time` at a time of its own."""

    def __init__(self, now_s):
        self.now_s = now_s

    def time(self):
        return self.now_s

    def monotonic(self):
        return self.now_s


def recorded_at(made, begin_us, names=NAMES, *, seconds=10.0):
    for name in names:
        made.add(name, frames_at(name, begin_us, seconds=seconds))
    return made.spool.closed


def batch_of(made, folder, **given):
    """Return the parts that `measure` makes of the recordings of fusion."""
    paths = sorted((made.folder / "recordings").glob("*/*.parquet"))
    tracks = [gr.read_track(pose_beside(path)) for path in paths]
    gr.measure(
        paths, tracks, gr.read_tiles(made.site.tiles), SAMPLE / "junction.osm", folder,
        check=False, **given,
    )  # fmt: skip
    found = folder.glob("*/date=*/*.parquet")
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def test_an_hour_is_made_once_with_what_follows_it_and_equals_the_batch(tmp_path, monkeypatch):
    """With vehicles that drive over its end; the next hour is made when its own is over."""
    made = SpooledSite(tmp_path, vehicles=True)
    clock = Clock(end_of_hour_s(HOUR) + 20.0)
    monkeypatch.setattr(hour_work, "time", clock)
    done = measure_hours(made.site, recorded_at(made, FULL_US - 4_000_000, seconds=6.5), [HOUR])
    assert [text for text in done.warnings if "not measured" in text] == []
    assert list(read_hours(made.site.dataset)) == [HOUR]
    first = made.parts("15")
    assert {name.partition("/")[0] for name in first} >= {"hits", "tracks", "passages", "occupied"}
    assert len(gr.open_dataset(made.site.dataset).continued()) == 0
    stamps = {path: path.stat().st_mtime_ns for path in made.site.dataset.glob("*/date=*/15.*")}
    clock.now_s += 3600.0
    late_us = FULL_US + HOUR_OFFSET_US + 5_000_000
    measure_hours(made.site, recorded_at(made, late_us, seconds=2.0), [HOUR + 1])
    assert list(read_hours(made.site.dataset)) == [HOUR, HOUR + 1]
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps  # not made again
    assert len(gr.open_dataset(made.site.dataset).continued()) > 0
    assert made.parts() == batch_of(made, tmp_path / "batch")


def test_a_pose_that_does_not_fit_is_named_each_hour(tmp_path):
    made = SpooledSite(tmp_path)
    spooled = recorded_at(made, FULL_US - 45_000_000, ["R1"], seconds=40.0)
    assert make_hours(made.site, spooled, [HOUR]).doubts == {"R1": None}
    (pose,) = (made.folder / "recordings" / "R1").glob("*.json")
    table = json.loads(pose.read_text())
    table.pop("quaternion", None)
    pose.write_text(json.dumps(table | {"yaw": table["yaw"] - 180.0}))
    doubts = make_hours(made.site, [], [HOUR]).doubts
    assert doubts["R1"].startswith("does not fit: yaw is off by 180 deg (")


def test_a_check_that_fails_loses_nothing_of_the_hour(tmp_path):
    """No table depends on it: the hour is made, and the log says why it is not checked."""

    def fail(*_, **__):
        raise np.linalg.LinAlgError("singular")

    made = SpooledSite(tmp_path)
    spooled = recorded_at(made, FULL_US - 45_000_000, ["R1"], seconds=40.0)
    done = make_hours(made.site, spooled, [HOUR], check=fail)
    assert list(read_hours(made.site.dataset)) == [HOUR]
    assert done.doubts == {}
    assert "poses and recordings could not be checked: singular" in done.warnings


def test_an_hour_that_is_made_again_says_nothing_of_the_pose_of_now(tmp_path):
    made, found = SpooledSite(tmp_path), replace(wrong("few", Cause("turned", "turn")), sensor="R1")
    later = recorded_at(made, FULL_US + HOUR_US - 5_000_000, ["R1"], seconds=4.0)
    told = make_hours(made.site, later, [HOUR + 1], check=lambda *_: (found,))
    assert list(told.doubts) == ["R1"]
    late = recorded_at(made, FULL_US - 5_000_000, ["R1"], seconds=4.0)
    done = make_hours(made.site, late, [HOUR], check=lambda *_: (found,))
    assert (done.doubts, done.unchecked) == ({}, {})
    assert list(read_hours(made.site.dataset)) == [HOUR, HOUR + 1]


def test_a_map_that_is_gone_keeps_its_hour_from_being_measured_and_checked(tmp_path):
    made = SpooledSite(tmp_path)
    spooled = recorded_at(made, FULL_US - 5_000_000)
    done = make_hours(replace(made.site, map=tmp_path / "gone.osm"), spooled, [HOUR])
    assert "gone.osm" in done.not_measured[HOUR]
    assert done.doubts == {}


def test_frames_that_come_late_make_their_hour_again(tmp_path):
    made = SpooledSite(tmp_path)
    measure_hours(made.site, recorded_at(made, FULL_US - 5_000_000, ["R1"]), [HOUR])
    alone = made.parts()
    measure_hours(made.site, recorded_at(made, FULL_US - 5_000_000, ["R2"]), [HOUR])
    assert made.parts() != alone
    dataset = gr.open_dataset(made.site.dataset)
    assert (dataset.sensors, dataset.manifest.live) == (["R1", "R2"], True)
    assert made.parts() == batch_of(made, tmp_path / "batch", hits_only=True)


def test_lanes_have_the_names_of_the_site_file(tmp_path):
    made = SpooledSite(tmp_path)
    spooled = recorded_at(made, FULL_US - 5_000_000)
    lane = int(gr.read_tiles(made.site.tiles)["lane"].min())
    for work, name in ((make_hours, "To the harbour"), (resume_hours, "To the quay")):
        site = replace(made.site, of_lanes={"lanes": [{"id": lane, "name": name}]})
        work(site, spooled, *([[HOUR]] if work is make_hours else []))
        before, spooled = made.parts(), []
        found = gr.open_dataset(site.dataset).query("FROM lanes").set_index("lane")["name"]
        assert found.dropna().to_dict() == {lane: name}
    assert made.parts() == before


def test_a_quarter_is_provisional_beside_the_tables_until_its_hour_is_made(tmp_path, monkeypatch):
    made = SpooledSite(tmp_path, vehicles=True)
    quarter = FULL_US // QUARTER_US - 2  # from a quarter past to half past
    begin_us = quarter * QUARTER_US
    monkeypatch.setattr(hour_work, "time", Clock(end_of_hour_s(HOUR) + 20.0))
    spooled = recorded_at(made, begin_us + 300_000_000, seconds=14.0)
    done = make_quarter(made.site, spooled, quarter)
    assert not made.site.dataset.exists()
    (found,) = done.quarters
    assert found.until_step == (begin_us + QUARTER_US) // 50_000 - 1
    assert found.lanes["counted"].sum() > 8
    assert found.lanes["volume"].isna().all()  # 14 s tell no volume of a quarter
    assert 0 < found.occupied.sum() < found.visible.sum()
    assert found.lanes["speed_kmh"].dropna().between(0.0, 100.0).all()
    assert (found.lanes["queue_max_m"] > 5.0).any()
    (folder,) = (made.folder / "provisional").iterdir()
    again = resume_hours(made.site, [])
    assert again.quarters[0].lanes.equals(found.lanes)
    assert again.hours == [HOUR]
    done = measure_hours(made.site, [], [HOUR])
    assert not folder.exists()
    tiles = gr.read_tiles(made.site.tiles)
    (by_hour,) = read_quarters(gr.open_dataset(made.site.dataset), tiles, [quarter])
    assert by_hour.lanes["hit_s"].equals(found.lanes["hit_s"])
    shown = by_hour.lanes.set_index("lane").dropna(subset="counted")[list(TRAFFIC_FIELDS)]
    table = gr.open_dataset(made.site.dataset).traffic("15min").set_index("lane")
    expected = table[table["begin"] == step_begin(quarter * 18_000)].loc[
        shown.index, list(TRAFFIC_FIELDS)
    ]
    pd.testing.assert_frame_equal(shown, expected.astype(float), rtol=1e-5)
    assert by_hour.lanes["counted"].sum() == found.lanes["counted"].sum()
    assert resume_hours(made.site, []).hours == []


def test_a_quarter_stays_until_its_hour_is_measured(tmp_path, monkeypatch):
    made = SpooledSite(tmp_path)
    quarter = FULL_US // QUARTER_US - 2
    monkeypatch.setattr(hour_work, "time", Clock(end_of_hour_s(HOUR) + 20.0))
    same = frames_at("R1", quarter * QUARTER_US + 300_000_000, seconds=5.0)
    made.add("R1", same)
    make_quarter(made.site, made.spool.closed, quarter)
    (folder,) = (made.folder / "provisional").iterdir()
    made.add("R2", same)  # one recording for two sensors: the hour cannot be measured
    assert HOUR in measure_hours(made.site, made.spool.closed, [HOUR]).not_measured
    assert folder.exists()
    monkeypatch.setattr(hour_work, "time", Clock(end_of_hour_s(HOUR + 25) + 20.0))
    measure_hours(made.site, [], [])
    assert not folder.exists()


def test_an_hour_that_cannot_be_measured_is_named_and_holds_no_other_up(tmp_path):
    made = SpooledSite(tmp_path)
    recorded_at(made, FULL_US - 5_000_000, ["R1"])
    same = frames_at("R1", FULL_US - 5_000_000, seconds=10.0)
    made.add("R2", same)  # the same frames for two sensors
    recorded_at(made, FULL_US + 2 * HOUR_US)
    done = measure_hours(made.site, made.spool.closed, [HOUR, HOUR + 2])
    assert list(done.not_measured) == [HOUR]
    assert "those of R1" in done.not_measured[HOUR]
    assert list(read_hours(made.site.dataset)) == [HOUR + 3]
    measure_hours(replace(made.site, keep_s=1.0), [], [])  # what is measured is old and goes
    there = {path.stem for path in (made.folder / "recordings").glob("*/*.parquet")}
    assert there == {recording_path(made.folder, "R1", HOUR).stem}


def test_hours_that_wait_are_measured_side_by_side_and_equal_the_batch(tmp_path):
    """With an hour that is refused, too."""
    made = SpooledSite(tmp_path, processes=2)
    recorded_at(made, FULL_US - 5_000_000)
    spooled = recorded_at(made, FULL_US + 2 * HOUR_US)
    measure_hours(made.site, spooled, [HOUR, HOUR + 1, HOUR + 2, HOUR + 3])
    assert made.parts() == batch_of(made, tmp_path / "batch", hits_only=True)
    same = frames_at("R1", FULL_US + 5 * HOUR_US, seconds=10.0)
    for name in NAMES:
        made.add(name, same)
    done = measure_hours(made.site, recorded_at(made, FULL_US + 7 * HOUR_US), [HOUR + 5, HOUR + 7])
    assert list(done.not_measured) == [HOUR + 5]
    assert HOUR + 8 in read_hours(made.site.dataset)


def test_what_comes_after_its_recording_was_removed_spoils_no_hour(tmp_path):
    made = SpooledSite(tmp_path)
    frames = frames_at("R1", FULL_US - 5_000_000, seconds=10.0)
    measure_hours(made.site, made.add("R1", frames[:-20]), [HOUR])
    before = made.parts()
    recording_path(made.folder, "R1", HOUR).unlink()
    done = measure_hours(made.site, made.add("R1", frames[-20:]), [HOUR])
    assert any("came after its recording was removed" in text for text in done.warnings)
    assert made.parts() == before


def test_frames_of_a_sensor_that_left_the_site_are_measured_all_the_same(tmp_path):
    """They were acknowledged; the hour is not taken up at each start."""
    made = SpooledSite(tmp_path)
    alone = replace(made.site, sensors=("R1",))
    spooled = recorded_at(made, FULL_US - 5_000_000)
    assert resume_hours(alone, spooled).hours == [HOUR]
    measure_hours(alone, [], [HOUR])
    assert gr.open_dataset(made.site.dataset).sensors == ["R1", "R2"]
    assert resume_hours(alone, []).hours == []
    assert made.parts() == batch_of(made, tmp_path / "batch", hits_only=True)


def test_a_dataset_of_other_tiles_or_settings_is_refused(tmp_path):
    made = SpooledSite(tmp_path)
    measure_hours(made.site, recorded_at(made, FULL_US - 5_000_000), [HOUR])
    tiles = gr.read_tiles(made.site.tiles)
    refuse_other_settings(made.site, tiles, None)
    with pytest.raises(InputError, match="tiles"):
        refuse_other_settings(made.site, tiles.iloc[1:], None)
    other = {"filters": gr.Filters(min_speed=1.0), "cycles": {"R1": 0.15}}
    for (name, value), says in zip(
        other.items(), ("settings: filters", "cycle of R1"), strict=True
    ):
        with pytest.raises(InputError, match=says):
            refuse_other_settings(replace(made.site, **{name: value}), tiles, None)


def test_an_hour_that_is_not_measured_is_tried_again_ever_more_rarely(tmp_path, pool):
    said = Lines()
    jobs = JobsHere(SpooledSite(tmp_path).site, Quarters(), reporter=said, pool=pool)
    jobs.touch([HOUR])
    begin_s, tried = end_of_hour_s(HOUR) + 1.0, []
    for quarter in range(16):
        now_s = begin_s + 900.0 * quarter
        for _ in range(2):  # once in a quarter
            if jobs.hours_at(now_s) is not None:
                tried.append(quarter)
                why = "why" if quarter < 7 else "another reason"
                jobs.end(JobResult(not_measured={HOUR: why} if quarter < 15 else {}))
    assert tried == [0, 1, 3, 7, 15]
    assert jobs.figures()["hours_not_measured"] == 0.0
    assert [line.rpartition(": ")[2] for line in said.lines] == ["why", "another reason"]
    assert jobs.hours_at(begin_s + 1e6) is None


class HeldPool:
    """A pool of processes whose work is done when the test says so."""

    def __init__(self):
        self.begun, self.future = [], Future()
        self.future.set_result(None)

    def submit(self, work, *_):
        known = work if isinstance(work, partial) else partial(work)
        self.begun.append((known.func.__name__, *known.keywords.values()))
        self.future = Future()
        return self.future

    def stop(self):
        """Stop nothing."""


@pytest.fixture
def pool():
    return HeldPool()


class JobsHere(HourJobs):
    """Jobs in a pool that is held."""

    def __init__(self, *given, pool, **more):
        super().__init__(*given, process=lambda: pool, **more)
        self.pool = pool

    def poll_at(self, now_s, newest_s, **more):
        """Turn; return what is being done then."""
        self.poll(now_s, {"R1": newest_s, "R2": newest_s}, **more)
        if self.wanted:
            self.begin([])
        return None if self.pool.future.done() else self.pool.begun[-1]

    def hours_at(self, now_s):
        """Turn until no quarter is left to do; return what is being done then."""
        while (work := self.poll_at(now_s, now_s)) is not None and work[0] == "make_quarter":
            self.end()
        return work

    def end(self, done=None, error=None):
        if error is not None:
            self.pool.future.set_exception(error)
        else:
            self.pool.future.set_result(done or JobResult())


def test_what_an_earlier_run_left_is_taken_up_again_after_a_failure(tmp_path, pool, monkeypatch):
    made = SpooledSite(tmp_path)
    recorded_at(made, FULL_US - 5_000_000, ["R1"])
    monkeypatch.setattr(jobs_module, "RETRY_S", 0.0)
    jobs = HourJobs(made.site, Quarters(), process=lambda: pool, reporter=Lines())
    jobs.resume(made.spool.closed)
    pool.future.set_exception(BrokenExecutor())
    jobs.poll(0.0, {})
    jobs.begin(made.spool.closed)
    pool.future.set_result(JobResult())
    jobs.poll(0.0, {})
    assert not jobs.wanted
    assert [each[0] for each in pool.begun] == ["resume_hours", "resume_hours"]


def test_quarters_and_hours_are_measured_once_all_frames_are_there_or_after_a_while(tmp_path, pool):
    jobs = JobsHere(SpooledSite(tmp_path).site, Quarters(), pool=pool)
    begin_s = HOUR * 3600.0 + 1800.0
    jobs.touch([HOUR])
    quarter = int(begin_s) // 900 - 1
    assert jobs.poll_at(begin_s + 59.0, begin_s + 59.0) == ("make_quarter", quarter - 1)
    jobs.end()
    assert jobs.poll_at(begin_s + 59.0, begin_s + 59.0) is None
    assert jobs.poll_at(begin_s + 60.5, begin_s + 59.0) is None  # a sensor is still to come
    assert jobs.poll_at(begin_s + 60.5, begin_s + 60.1) == ("make_quarter", quarter)
    jobs.end()
    assert jobs.poll_at(begin_s + 62.0, begin_s + 62.0) is None  # it was measured
    assert jobs.poll_at(begin_s + 989.0, begin_s + 900.0) is None
    assert jobs.poll_at(begin_s + 991.0, begin_s + 900.0) == ("make_quarter", quarter + 1)
    jobs.end()
    end_s = end_of_hour_s(HOUR)
    assert jobs.poll_at(end_s - 1.0, end_s - 1.0)[0] == "make_quarter"
    jobs.end()
    assert jobs.poll_at(end_s + 1.0, end_s - 1.0) is None
    assert jobs.poll_at(end_s + 1.0, end_s + 0.5) == ("make_hours", [HOUR])
    jobs.touch([HOUR])  # a late frame, meanwhile
    jobs.end()
    assert jobs.poll_at(end_s + 2.0, end_s + 2.0) == ("make_hours", [HOUR])
    jobs.end()
    assert jobs.poll_at(end_s + 3.0, end_s + 3.0) is None
    assert jobs.poll_at(end_s + 3.0, end_s + 3.0, full=True) == ("make_recordings",)


def test_a_doubt_lasts_until_the_sensor_fits(tmp_path, pool):
    """At night too little moves: that ends no doubt, but is said, with the first such hour."""
    site = SpooledSite(tmp_path).site
    jobs = JobsHere(site, Quarters(), pool=pool)

    def after(number, **found):
        now_s = end_of_hour_s(HOUR + number) + 1.0
        jobs.touch([HOUR + number])
        assert jobs.hours_at(now_s) == ("make_hours", [HOUR + number])
        jobs.end(JobResult(**found))
        jobs.poll_at(now_s, now_s)
        return jobs.doubts

    assert after(0, unchecked={"R1": HOUR}, doubts={"R2": "turned"}) == {"R2": "turned"}
    assert after(1, doubts={"R1": "turned", "R2": None}) == {"R1": "turned", "R2": None}
    since = f"turned; since {hour_text(HOUR + 2)} too little traffic to check it again"
    for number in (2, 3):
        unchecked = {"R1": HOUR + number, "R2": HOUR + number}
        assert after(number, unchecked=unchecked) == {"R1": since, "R2": None}
    assert after(4, doubts={"R1": "turned"})["R1"] == "turned"
    assert after(5, unchecked={"R1": HOUR + 5})["R1"].startswith(
        f"turned; since {hour_text(HOUR + 5)}"
    )
    begun_anew = JobsHere(site, Quarters(), pool=pool)
    assert begun_anew.doubts == jobs.doubts
    assert after(6, doubts={"R1": None})["R1"] is None


DAMAGED = (
    "", "[1]", '{"doubts": 3}', '{"doubts": {"R1": {}}, "unchecked": []}',
    '{"doubts": {}, "unchecked": 3}', '{"doubts": {}}',
)  # fmt: skip


@pytest.mark.parametrize("text", DAMAGED)
def test_a_file_of_doubts_that_is_damaged_stops_nothing_and_is_told(tmp_path, pool, text):
    site, said = SpooledSite(tmp_path).site, Lines()
    (site.folder / DOUBTS_FILE).write_text(text)
    assert JobsHere(site, Quarters(), reporter=said, pool=pool).doubts == {}
    assert said.told("doubts.json: it is damaged")


def test_at_the_end_hours_that_an_earlier_run_left_are_measured(tmp_path):
    made = SpooledSite(tmp_path)
    spooled, said = recorded_at(made, FULL_US - 45_000_000, ["R1"], seconds=6.0), Lines()
    content = bytearray(spooled[-1].read_bytes())
    content[-40] ^= 1  # in the last of three messages
    spooled[-1].write_bytes(content)
    HourJobs(made.site, Quarters(), reporter=said).finish(spooled)  # nothing came in this run
    assert list(read_hours(made.site.dataset)) == [HOUR]
    assert said.told("damaged records are left out")


def test_falling_behind_is_told_with_how_far(tmp_path, pool, monkeypatch):
    said, clock = Lines(), Clock(0.0)
    monkeypatch.setattr(jobs_module, "time", clock)
    jobs = JobsHere(SpooledSite(tmp_path).site, Quarters(), reporter=said, pool=pool)
    end_s = end_of_hour_s(HOUR)
    jobs.touch([HOUR])
    for minutes in (16, 17, 40, 50):
        jobs.poll_at(end_s + 60.0 * minutes, end_s + 60.0 * minutes)
        jobs.end(error=OSError(28, "no space"))
        assert jobs.poll_at(end_s + 60.0 * minutes, end_s) is None  # not at once
        clock.now_s += jobs_module.RETRY_S
    behind = [line for line in said.lines if "measuring is behind" in line]
    assert ["16 min" in behind[0], "40 min" in behind[1], len(behind)] == [True, True, 2]
    assert jobs.figures()["hours_behind_seconds"] == 3000.0
    assert sum("failed and is tried again" in line for line in said.lines) == 1
    assert HOUR in jobs.touched
    jobs.poll_at(end_s + 3100.0, end_s + 3100.0)
    jobs.end()
    jobs.poll_at(end_s + 3100.0, end_s + 3100.0)
    assert jobs.figures()["hours_behind_seconds"] == 0.0


@pytest.mark.parametrize("idle", [False, True])
def test_a_worker_that_is_killed_is_started_anew_and_gives_the_same(tmp_path, monkeypatch, idle):
    made, said, pools = SpooledSite(tmp_path), Lines(), []
    recorded_at(made, FULL_US - 5_000_000)

    def process():
        pools.append(WorkerPool(1, context=multiprocessing.get_context("spawn")))
        if not idle and len(pools) == 1:
            pools[0].submit(time.sleep, 600.0)  # the job waits behind it until the kill
        return pools[-1]

    def broken():
        try:
            pools[0].submit(int)
        except BrokenExecutor:
            return True
        return False

    monkeypatch.setattr(jobs_module, "RETRY_S", 0.0)
    jobs = HourJobs(made.site, Quarters(), reporter=said, process=process)
    jobs.resume([])
    wait_for(multiprocessing.active_children)
    if idle:
        pools[0].submit(int).result()  # after what it was given before
        jobs.poll(0.0, {})
    for each in multiprocessing.active_children():
        each.kill()
    wait_for(broken)
    jobs.touch([HOUR])

    def polled():
        jobs.poll(end_of_hour_s(HOUR) + 60.0, {"R1": 2e9, "R2": 2e9})
        if jobs.wanted:
            jobs.begin(made.spool.closed)
        return not jobs.touched

    wait_for(polled)
    jobs.stop()
    assert bool(said.told("measuring failed and is tried again")) is not idle
    assert made.parts() == batch_of(made, tmp_path / "batch", hits_only=True)
    assert multiprocessing.active_children() == []


def test_quarters_of_a_day_are_kept():
    quarters = Quarters()
    lanes = pd.DataFrame({"lane": [7], "volume": [1.0]})
    ends = [18_000 * k - 1 for k in range(1, QUARTERS_KEPT + 9)]
    quarters.add(
        QuarterMeasures(until_step=end, visible=[], occupied=[], lanes=lanes) for end in ends
    )
    table = quarters.intervals()
    assert len(table) == QUARTERS_KEPT
    assert table["begin"].is_monotonic_increasing
    assert quarters.newest().until_step == 18_000 * (QUARTERS_KEPT + 8) - 1
