"""A city's run: what is missing is made, by processes or a cluster; no site stops another."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from fake_work import end_always, end_once
from site_runs import unchecked
from small_site import write_site

import gis_radar as gr
from gis_radar.base import (
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    Reporter,
    Text,
    UsageError,
    only_writer,
)
from gis_radar.city import is_city_file, tasks
from gis_radar.city.executors import OtherSoftwareError, Processes, Workers, run_task, workers_of
from gis_radar.city.tasks import make_site_hour
from gis_radar.dataset.hours.job import MadeHour
from gis_radar.site import software

HOURS = 3
SENSOR = "guess = [{east:.1f}, {north:.1f}]\ncompass = 130.0\n"


class Said(Reporter):
    def __init__(self):
        self.warnings, self.stages = [], []

    def log(self, message, level="info"):
        if level == "warning":
            self.warnings.append(str(message))

    def progress(self, stage, done, total):
        self.stages.append((str(stage), done, total))


def shifted(source, path, hours):
    rows = pq.read_table(source)
    place = rows.schema.get_field_index("time")
    rows = rows.set_column(place, "time", pc.add(rows["time"], 3600.0 * hours))
    pq.write_table(rows.slice(3 * hours), path)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Make a site of one radar whose pose is given, with a recording in each of some hours."""
    folder = tmp_path_factory.mktemp("site")
    _, poses = write_site(folder)
    poses["R1"].write(folder / "R1.json")
    text = (folder / "SITE.toml").read_text(encoding="utf-8")
    head = text.partition("[[sensor]]")[0]
    text = head + '[[sensor]]\nname = "R1"\nrecordings = ["R1_*.parquet"]\npose = "R1.json"\n'
    (folder / "SITE.toml").write_text(text + "\n[vehicles]\nfollow = false\n", encoding="utf-8")
    for hour in range(HOURS):
        shifted(folder / "R1.parquet", folder / f"R1_{hour}.parquet", hour)
    return folder


def copied(site, folder, hours=HOURS):
    folder.mkdir(parents=True)
    for path in site.iterdir():
        if not path.name.startswith("R1_") or int(path.stem[3:]) < hours:
            os.link(path, folder / path.name)
    text = (folder / "SITE.toml").read_text(encoding="utf-8")
    (folder / "SITE.toml").unlink()
    (folder / "SITE.toml").write_text(text, encoding="utf-8")
    return folder / "SITE.toml"


def city_file(folder, **sites):
    lines = ['title = "A city"', 'timezone = "Europe/Berlin"', "reports = false"]
    for name, file in sites.items():
        lines += ["[[site]]", f'name = "{name}"', f"file = {json.dumps(str(file))}"]
    (folder / "CITY.toml").write_text("\n".join(lines), encoding="utf-8")
    return folder / "CITY.toml"


def bytes_of(dataset):
    return {
        path.relative_to(dataset).as_posix(): path.read_bytes()
        for path in sorted(dataset.rglob("*"))
        # the one names the files, the other holds what was checked
        if path.is_file() and path.name not in {"recordings.parquet", "dataset.json"}
    }


@contextmanager
def threads():
    """Make the hours in a thread of this process: new processes load for seconds each."""
    with pytest.MonkeyPatch.context() as here, unchecked():
        here.setattr(Processes, "begin", lambda _: ThreadPoolExecutor(1))
        here.setattr(Processes, "end", lambda _, pool: pool.shutdown(cancel_futures=True))
        yield


@pytest.fixture
def in_a_thread():
    with threads():
        yield


@pytest.fixture(scope="module")
def whole(site, tmp_path_factory):
    """Make the dataset of the site by `measure`, in one piece."""
    folder = tmp_path_factory.mktemp("whole")
    with threads():
        gr.run_city(city_file(folder, one=copied(site, folder / "one")), folder / "root", jobs=1)
    recordings = sorted((folder / "one").glob("R1_*.parquet"))[::-1]
    tiles = gr.read_tiles(folder / "root" / "results" / "one" / "tiles.gpkg")
    pose = gr.read_pose(folder / "root" / "results" / "one" / "sensors" / "R1" / "pose.json")
    scans = sorted((folder / "one").glob("scan*.laz"))
    gr.measure(
        recordings, [pose] * len(recordings), tiles, folder / "one" / "map.osm",
        folder / "measured", scans=scans, hits_only=True, timezone="Europe/Berlin",
        filters=gr.Filters(clearance=(-0.5, 4.5), elevation_error_deg=0.5), check=False,
    )  # fmt: skip
    return folder


def test_a_run_makes_what_measuring_in_one_piece_makes(whole):
    made, wanted = (bytes_of(whole / name) for name in ("root/site=one", "measured"))
    assert len(made) > 3 * HOURS
    assert made.keys() == wanted.keys()
    assert [name for name in made if made[name] != wanted[name]] == []


def test_only_new_hours_are_made(site, whole, tmp_path):
    file = copied(site, tmp_path / "one", hours=2)
    city = city_file(tmp_path, one=file)
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 2  # in a process
    dataset = tmp_path / "root" / "site=one"
    before = {path: path.stat().st_mtime_ns for path in dataset.glob("h*/**/*.*")}
    left = dataset / "tile_counts" / "date=2020-01-01" / "day.parquet"  # by a killed withdrawal
    left.parent.mkdir()
    left.touch()
    said = Said()
    with threads():
        assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 0
        for hour in range(2, HOURS):
            os.link(site / f"R1_{hour}.parquet", tmp_path / "one" / f"R1_{hour}.parquet")
        assert gr.run_city(city, tmp_path / "root", jobs=1, reporter=said).sites["one"].hours == 1
    assert ("hours", 1, 1) in said.stages
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert not left.exists()
    made, wanted = bytes_of(dataset), bytes_of(whole / "root" / "site=one")
    assert [name for name in wanted if made[name] != wanted[name]] == []


@pytest.mark.usefixtures("in_a_thread")
def test_a_recording_that_was_changed_is_found_whenever_it_was(site, tmp_path):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one", hours=2))
    gr.run_city(city, tmp_path / "root", jobs=1)
    path = tmp_path / "one" / "R1_0.parquet"
    rows = pq.read_table(path)
    path.unlink()
    pq.write_table(rows.slice(0, len(rows) // 2), path)
    os.utime(path, (1e9, 1e9))  # as cp -p leaves it, or a change while the run was at work
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 1
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 0


@pytest.mark.usefixtures("in_a_thread")
def test_exact_tables_of_an_archive_are_kept_as_long_as_others(site, tmp_path):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one"))
    text = city.read_text(encoding="utf-8")
    city.write_text('keep = "720h"\n' + text, encoding="utf-8")
    gr.run_city(city, tmp_path / "root", jobs=1)
    dataset = tmp_path / "root" / "site=one"
    assert len(list(dataset.glob("hits/*/*.parquet"))) == HOURS
    for path in dataset.glob("hours/*/*.json"):
        os.utime(path, (path.stat().st_mtime - 721 * 3600.0,) * 2)
    gr.run_city(city, tmp_path / "root", jobs=1)
    assert not list(dataset.glob("hits/*/*.parquet"))


@pytest.mark.usefixtures("in_a_thread")
def test_recordings_of_one_name_in_two_folders_are_both_converted(site, tmp_path):
    file = copied(site, tmp_path / "one", hours=2)
    for hour in range(2):
        (tmp_path / "one" / f"day{hour}").mkdir()
        (tmp_path / "one" / f"R1_{hour}.parquet").rename(
            tmp_path / "one" / f"day{hour}" / "R1.parquet"
        )
    text = file.read_text(encoding="utf-8").replace("R1_*", "day*/R1")
    table = 'pose = "R1.json"\n[sensor.convert]\n'
    file.write_text(text.replace('pose = "R1.json"\n', table), encoding="utf-8")
    city = city_file(tmp_path, one=file)
    run = gr.run_city(city, tmp_path / "root", jobs=1)
    assert run.failure is None
    assert run.sites["one"].hours == 2
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 0
    columns = '[sensor.convert]\ncolumns = { rcs = "-rcs" }'
    changed = file.read_text(encoding="utf-8").replace("[sensor.convert]", columns)
    file.write_text(changed, encoding="utf-8")
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 2
    path = tmp_path / "one" / "day0" / "R1.parquet"
    rows = pq.read_table(path)
    path.unlink()
    pq.write_table(rows.slice(0, len(rows) // 2), path)
    os.utime(path, (1e9, 1e9))  # older than what was made of it, as cp -p leaves it
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 1
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 0


@pytest.mark.usefixtures("in_a_thread")
def test_a_run_that_ended_before_its_page_makes_it_when_it_goes_on(site, tmp_path, monkeypatch):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one", hours=1))
    gr.run_city(city, tmp_path / "root", jobs=1)
    page = tmp_path / "root" / "month.html"
    before = page.stat().st_mtime_ns
    os.link(site / "R1_1.parquet", tmp_path / "one" / "R1_1.parquet")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("gis_radar.city.run.write_month_page", interrupted)
        gr.run_city(city, tmp_path / "root", jobs=1)
    assert page.stat().st_mtime_ns == before
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 0
    assert page.stat().st_mtime_ns > before
    before = page.stat().st_mtime_ns
    gr.run_city(city, tmp_path / "root", jobs=1)
    assert page.stat().st_mtime_ns == before


@pytest.mark.usefixtures("in_a_thread")
def test_lanes_that_are_named_later_are_named_everywhere_and_no_hour_is_made(site, tmp_path):
    file = copied(site, tmp_path / "one", hours=1)
    city, root = city_file(tmp_path, one=file), tmp_path / "root"
    gr.run_city(city, root, jobs=1)
    lane = int(gr.open_city(root).sites["one"].lanes()["lane"].min())
    text = file.read_text(encoding="utf-8")
    for stated in ({lane: "To the harbour"}, {lane: "To the quay"}, {}):
        tables = "".join(f'[[lane]]\nid = {k}\nname = "{v}"\n' for k, v in stated.items())
        file.write_text(text + tables, encoding="utf-8")
        before = (root / "month.html").stat().st_mtime_ns
        assert gr.run_city(city, root, jobs=1).sites["one"].hours == 0
        assert lanes_in_sql(root).dropna().to_dict() == stated
        assert (root / "month.html").stat().st_mtime_ns > before
    before = (root / "month.html").stat().st_mtime_ns
    gr.run_city(city, root, jobs=1)
    assert (root / "month.html").stat().st_mtime_ns == before


def lanes_in_sql(root):
    lanes = gr.open_city(root).query("FROM lanes").set_index("lane")
    return lanes["name"] if "name" in lanes else pd.Series()


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.usefixtures("in_a_thread")
def test_hours_of_an_earlier_method_are_made_again(site, whole, tmp_path):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one", hours=2))
    gr.run_city(city, tmp_path / "root", jobs=1)
    dataset = tmp_path / "root" / "site=one"
    record = min((dataset / "hours").rglob("*.json"))
    now = record.read_bytes()
    record.write_text(json.dumps(json.loads(now) | {"method": 1}), encoding="utf-8")
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 1
    assert record.read_bytes() == now
    record.write_text(json.dumps(json.loads(now) | {"method": 1}), encoding="utf-8")
    (tmp_path / "one" / "R1_0.parquet").unlink()  # what it would be made from
    assert gr.run_city(city, tmp_path / "root", jobs=1).sites["one"].hours == 0


@pytest.mark.usefixtures("in_a_thread")
def test_a_bad_site_stops_no_other(site, tmp_path):
    damaged = copied(site, tmp_path / "damaged", hours=1)
    cut(tmp_path / "damaged" / "R1_0.parquet")
    good = copied(site, tmp_path / "good", hours=1)
    city = city_file(tmp_path, damaged=damaged, gone=tmp_path / "gone.toml", good=good)
    said = Said()
    run = gr.run_city(city, tmp_path / "root", jobs=2, reporter=said)
    assert run.sites["good"].hours == 1
    assert not run.sites["good"].failures
    assert isinstance(run.failure, InputError)
    assert len(run.failure.parts) == 2
    assert run.failure.message.startswith("2 of 3 sites lack a result: damaged: ")
    assert any("gone.toml: cannot be read" in each for each in said.warnings)
    record = json.loads((tmp_path / "root" / "run.json").read_text(encoding="utf-8"))
    assert [bool(each["failures"]) for each in record["sites"].values()] == [True, True, False]
    assert gr.open_city(tmp_path / "root").sites.keys() == {"good"}


@pytest.mark.parametrize(("implausible", "kind"), [(["R1"], NoAnswerError), ([], InputError)])
def test_what_is_refused_is_told_in_words_of_the_site_file(
    site, tmp_path, monkeypatch, implausible, kind
):
    hint = Text("or {}", Text("{} {}", "--accept", "R1"))
    told = {"refused": {"R1": "R1: no"}, "hints": {"R1": hint}, "implausible": implausible}
    monkeypatch.setattr(tasks, "measure_stage", lambda **_: told)
    monkeypatch.setattr("gis_radar.site.stages.measure_stage", tasks.measure_stage)
    task = tasks.SiteTask(root=tmp_path, name="one", file=site / "SITE.toml")
    tasks.register_checked(gr.read_site(site / "SITE.toml"), task)
    ((what, error),) = task.failures
    assert (what, type(error)) == ("R1", kind)
    assert error.hint == "or accept = true in [[sensor]] R1"


def cut(path):
    held = path.read_bytes()
    path.unlink()
    path.write_bytes(held[: len(held) // 2])


@pytest.mark.usefixtures("in_a_thread")
def test_damaged_recordings_stop_no_others_of_their_sensor(site, whole, tmp_path):
    file = copied(site, tmp_path / "one")
    for damaged in ("R1_8", "R1_9"):
        os.link(site / "R1_0.parquet", file.with_name(f"{damaged}.parquet"))
        cut(file.with_name(f"{damaged}.parquet"))
    run = gr.run_city(city_file(tmp_path, one=file), tmp_path / "root", jobs=1)
    assert [what for what, _ in run.sites["one"].failures] == ["R1", "R1"]
    assert ["R1_8" in str(e.message) for _, e in run.sites["one"].failures] == [True, False]
    made, wanted = (bytes_of(each / "root" / "site=one") for each in (tmp_path, whole))
    assert made == wanted


@pytest.mark.usefixtures("in_a_thread")
def test_a_broken_site_file_leaves_its_hours_to_be_made(site, tmp_path):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one", hours=2))
    gr.run_city(city, tmp_path / "root", jobs=1)
    hours = sorted((tmp_path / "root" / "site=one" / "hours").rglob("*.json"))
    hours[0].unlink()
    (tmp_path / "one" / "SITE.toml").write_text("title = ", encoding="utf-8")
    run = gr.run_city(city, tmp_path / "root", jobs=1)
    assert run.sites["one"].hours == 1
    assert hours[0].exists()
    assert [what for what, _ in run.sites["one"].failures] == ["one"]


@pytest.mark.usefixtures("in_a_thread")
def test_a_recording_that_is_gone_leaves_its_hour_as_it_is(site, tmp_path):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one", hours=2))
    gr.run_city(city, tmp_path / "root", jobs=1)
    dataset = tmp_path / "root" / "site=one"
    min((dataset / "hits").rglob("*.parquet")).unlink()
    (tmp_path / "one" / "R1_0.parquet").unlink()
    run = gr.run_city(city, tmp_path / "root", jobs=1)
    assert "R1_0.parquet: is not there" in run.failure.message


@pytest.mark.usefixtures("in_a_thread")
def test_poses_that_were_found_are_kept(site, tmp_path):
    file = copied(site, tmp_path / "one", hours=1)
    text = file.read_text(encoding="utf-8")
    pose = gr.read_pose(tmp_path / "one" / "R1.json")
    guess = SENSOR.format(east=pose.easting + 900.0, north=pose.northing)  # a search would fail
    file.write_text(text.replace('pose = "R1.json"\n', guess), encoding="utf-8")
    kept = tmp_path / "root" / "poses" / "one" / "R1.json"
    kept.parent.mkdir(parents=True)
    pose.write(kept)
    run = gr.run_city(city_file(tmp_path, one=file), tmp_path / "root", jobs=1)
    assert run.failure is None
    assert run.sites["one"].hours == 1


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('title = "x"\n', "lacks site"),
        ('title = "x"\n[[site]]\nname = "a"\nfile = "a"\n[[site]]\nname = "A"\nfile = "b"\n',
         "two sites are called 'A'"),
        ('title = "x"\nspeed = 3\n[[site]]\nname = "a"\nfile = "a"\n', "speed"),
    ],
)  # fmt: skip
def test_a_bad_city_file_is_refused(tmp_path, lines, message):
    path = tmp_path / "CITY.toml"
    path.write_text(lines, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        gr.run_city(path, tmp_path / "root")


@pytest.mark.usefixtures("in_a_thread")
def test_an_hour_that_cannot_be_made_again_stays(site, tmp_path):
    file = copied(site, tmp_path / "one", hours=1)
    city = city_file(tmp_path, one=file)
    gr.run_city(city, tmp_path / "root", jobs=1)
    dataset = tmp_path / "root" / "site=one"
    before = {path: path.read_bytes() for path in sorted(dataset.glob("h*/**/*.*"))}
    rows = pq.read_table(tmp_path / "one" / "R1_0.parquet")
    pq.write_table(rows, tmp_path / "one" / "R2.parquet", compression="gzip")
    pose = replace(gr.read_pose(tmp_path / "one" / "R1.json"), sensor="R2")
    pose.write(tmp_path / "one" / "R2_pose.json")
    text = file.read_text(encoding="utf-8")
    sensor = '[[sensor]]\nname = "R2"\nrecordings = ["R2.parquet"]\npose = "R2_pose.json"\n'
    head, _, rest = text.partition("[vehicles]")
    file.write_text(f"{head}{sensor}[vehicles]{rest}", encoding="utf-8")
    run = gr.run_city(city, tmp_path / "root", jobs=1)
    assert any(
        "frames of R2 are those of R1" in str(error) for _, error in run.sites["one"].failures
    )
    assert {path: path.read_bytes() for path in before} == before
    assert len(gr.open_dataset(dataset).records()) == 1


def test_the_results_of_one_site_are_no_folder_for_a_city(tmp_path):
    city = city_file(tmp_path, one=tmp_path / "none.toml")
    (tmp_path / "results" / "heatmap").mkdir(parents=True)
    (tmp_path / "results" / "run.json").write_text("{}", encoding="utf-8")
    with pytest.raises(OutputError, match="holds 'heatmap'"):
        gr.run_city(city, tmp_path / "results")
    assert (tmp_path / "results" / "run.json").read_text(encoding="utf-8") == "{}"


def test_a_file_of_any_length_is_looked_into_for_sites(tmp_path):
    path = tmp_path / "long.toml"
    path.write_text("# " + 5_000_000 * "x" + '\n[[site]]\nname = "a"\n', encoding="utf-8")
    assert not is_city_file(path)


def test_check_of_a_city_asks_for_the_file_of_a_site(run, tmp_path):
    city = city_file(tmp_path, one=tmp_path / "none.toml")
    code, out, _ = run("check", city, "--json")
    error = json.loads(out.splitlines()[-1])
    assert code == 2
    assert error["message"] == "gis-radar check is for one site"
    assert error["hint"] == "name the file of a site of the city"


def test_two_runs_do_not_work_in_one_folder(site, tmp_path):
    city = city_file(tmp_path, one=tmp_path / "none.toml")
    root = tmp_path / "root"
    (root / ".gis-radar").mkdir(parents=True)
    locked = only_writer(root, lock=root / ".gis-radar" / "lock")
    with locked, pytest.raises(OutputError, match="another run"):
        gr.run_city(city, root)


def test_a_killed_process_is_replaced(tmp_path):
    said = Said()
    calls = {"killed": (end_once, tmp_path / "marker"), "other": (os.path.basename, "a/b")}
    with workers_of(None, 2, said) as workers:
        assert dict(workers.results(calls)) == {"killed": "done", "other": "b"}
    assert said.warnings == ["workers were lost: what they had not finished is done again"]


def test_a_task_that_always_ends_its_worker_is_left_out():
    calls = {"bad": (end_always,)} | {k: (os.path.basename, f"a/{k}") for k in range(4)}
    with workers_of(None, 2, Said()) as workers:
        results = dict(workers.results(calls))
    assert str(results.pop("bad")) == "its workers were lost"
    assert results == {k: str(k) for k in range(4)}


def test_workers_that_are_lost_whatever_they_do_end_the_run():
    calls = dict.fromkeys(range(9), (end_always,))
    with pytest.raises(OutputError, match="lost 4 times"), workers_of(None, 1, Said()) as workers:
        list(workers.results(calls))


def test_a_worker_waits_for_another_that_makes_the_same_hour(tmp_path, monkeypatch):
    at_work, most = [], []

    def make(*_):
        at_work.append(1)
        most.append(len(at_work))
        time.sleep(0.2)
        at_work.pop()
        return MadeHour(hour=7, evidence={}, vehicles=len(most), on_lanes=[])

    monkeypatch.setattr("gis_radar.city.tasks.make_registered", make)
    with ThreadPoolExecutor(2) as pool:
        made = [pool.submit(make_site_hour, tmp_path, 7, 1) for _ in range(2)]
        assert sorted(each.result() for each in made) == [1, 2]
    assert most == [1, 1]
    assert list(tmp_path.iterdir()) == []


def wrong():
    return {}["gone"]


def test_a_fault_in_a_task_is_one_line_with_its_place():
    with pytest.raises(GisRadarError, match=r"fault in gis_radar, test_city_run\.py:\d+: KeyError"):
        run_task(software(), wrong)


def test_a_worker_with_other_packages_is_refused():
    with pytest.raises(OtherSoftwareError, match=r"a worker has numpy .*, the run 1\.0"):
        run_task(software() | {"numpy": "1.0"}, os.getpid)


class WithoutPackage(Workers, Executor):
    """Workers whose scheduler lacks a package: Dask names the cause of its error."""

    def begin(self):
        return self

    def end(self, executor):
        pass

    def submit(self, *_):
        future = Future()
        error = RuntimeError("Error during deserialization of the task graph")
        error.__cause__ = ModuleNotFoundError("No module named 'gis_radar'")
        future.set_exception(error)
        return future


def test_a_scheduler_without_the_packages_is_refused():
    workers = WithoutPackage(Said())
    with pytest.raises(OtherSoftwareError, match=r"the scheduler or a worker lacks .* 'gis_radar'"):
        list(workers.results({"a": (os.getpid,)}))


def test_jobs_and_executor_exclude_each_other():
    with pytest.raises(UsageError), workers_of("tcp://127.0.0.1:1", 2, Said()):
        pass


# A cluster: scheduler and workers as processes on this machine.


def dask(*words):
    program = Path(sys.executable).with_name("dask")
    return subprocess.Popen(
        [program, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"}, start_new_session=True,
    )  # fmt: skip


class SmallCluster:
    def __init__(self):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address, self.running = f"tcp://127.0.0.1:{self.port}", []

    def begin(self):
        words = ("--host", "127.0.0.1", "--no-dashboard")
        self.scheduler = dask("scheduler", "--port", str(self.port), *words)
        self.running.append(self.scheduler)
        self.workers = [
            dask("worker", self.address, "--nthreads", "1", "--no-nanny", "--memory-limit", "0",
                 "--death-timeout", "60", *words)
            for _ in range(2)
        ]  # fmt: skip
        self.running += self.workers

    def end(self):
        for each in self.running:
            with suppress(ProcessLookupError):
                os.killpg(each.pid, signal.SIGKILL)
            each.wait()


@pytest.fixture(scope="module")
def cluster():
    cluster = SmallCluster()
    cluster.begin()
    yield cluster
    cluster.end()


def test_a_cluster_makes_the_same_bytes(site, whole, tmp_path, cluster):
    city = city_file(tmp_path, one=copied(site, tmp_path / "one"))
    run = gr.run_city(city, tmp_path / "root", executor=cluster.address)
    assert run.sites["one"].hours == HOURS
    made, wanted = (bytes_of(each / "root" / "site=one") for each in (tmp_path, whole))
    assert made == wanted


def test_a_run_goes_on_where_a_worker_is_killed_and_the_scheduler_restarted(cluster):
    said, done = Said(), []
    calls = dict.fromkeys(range(24), (time.sleep, 0.3))
    with workers_of(cluster.address, None, said) as workers:
        assert workers.share(1) == 1  # Dask's workers may have no children
        for number, _ in workers.results(calls):
            done.append(number)
            if len(done) == 3:
                cluster.workers[0].kill()
            if len(done) == 8:
                cluster.scheduler.kill()
                cluster.begin()
    assert sorted(done) == sorted(calls)
    assert "workers were lost: what they had not finished is done again" in said.warnings


def test_dask_prints_no_tracebacks(cluster):
    with workers_of(cluster.address, None, Said()):
        known = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
        loud = [name for name in known if logging.getLogger(name).isEnabledFor(logging.ERROR)]
    assert "distributed.client" in known
    assert loud == []


def test_a_cluster_that_is_not_there_is_named():
    named = pytest.raises(OutputError, match=r"tcp://127\.0\.0\.1:9: no scheduler answers")
    with named, workers_of("tcp://127.0.0.1:9", None, Said()):
        pass


@pytest.mark.parametrize("address", ["localhost", "tcp://localhost", "http://localhost:8786"])
def test_what_is_no_address_is_refused_at_once(address):
    with pytest.raises(UsageError, match="no address"), workers_of(address, None, Said()):
        pass


def day_site(source, folder):
    """Write a site of two radars with a recording of each on two dates."""
    folder.mkdir(parents=True)
    for name in ("map.osm", "scan_1.laz", "R1.json", "R2.json"):
        os.link(source / name, folder / name)
    for day, hours in ((1, 0), (2, 24)):
        for sensor, recording in (("R1", "R1"), ("R2", "R2_0")):
            path = folder / f"{sensor}_day{day}.parquet"
            shifted(source / f"{recording}.parquet", path, hours)
    return folder / "SITE.toml"


def stated(source, folder, days, sensors):
    """Write the site file of some sensors, with their recordings of some days."""
    text = (source / "SITE.toml").read_text(encoding="utf-8")
    head = text.partition("[[sensor]]")[0]
    for sensor in sensors:
        paths = json.dumps([f"{sensor}_day{day}.parquet" for day in days])
        head += f'[[sensor]]\nname = "{sensor}"\npose = "{sensor}.json"\nrecordings = {paths}\n'
    (folder / "SITE.toml").write_text(head, encoding="utf-8")


def files_of(root):
    """Return all files of the datasets of a city; of their manifests all but what was checked."""
    found = {p.relative_to(root).as_posix(): p.read_bytes() for p in root.glob("site=*/**/*.*")}
    for name in (each for each in found if each.endswith("dataset.json")):
        manifest = json.loads(found[name])
        assert manifest.pop("checks").keys() == {"R1"}
        manifest.pop("texts", None)
        found[name] = manifest
    return found


@pytest.mark.skipif(os.environ.get("GIS_RADAR_LIVE") != "all", reason="takes long: make live-test")
def test_days_in_any_order_without_a_sensor_as_if_it_had_never_been(site, tmp_path, cluster):
    names = ("one", "two")
    places = {name: day_site(site, tmp_path / name) for name in names}
    city = city_file(tmp_path, **places)

    def run(root, days, sensors, **how):
        for name in names:
            stated(site, tmp_path / name, days, sensors)
        made = gr.run_city(city, tmp_path / root, **how)
        assert made.failure is None
        return sum(each.hours for each in made.sites.values())

    assert run("days", [1], ["R1", "R2"], jobs=2) == 2
    assert run("days", [1, 2], ["R1", "R2"], jobs=2) == 2
    for name in names:
        gr.open_dataset(tmp_path / "days" / f"site={name}").withdraw(sensor="R2")
    assert run("whole", [2], ["R1"], executor=cluster.address) == 2
    assert run("whole", [2, 1], ["R1"], executor=cluster.address) == 2
    made, wanted = (files_of(tmp_path / root) for root in ("days", "whole"))
    assert made.keys() == wanted.keys()
    assert [name for name in made if made[name] != wanted[name]] == []
    tables = {name.split("/")[1] for name in made}
    assert tables >= {"lane_measures", "turns", "lane_months", "tile_months", "tracks"}
