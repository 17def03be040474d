"""Runs of a small site that were stopped, or whose inputs changed: what is done again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from maps import Listener
from site_runs import (
    HITS_ALONE,
    PAPER,
    change,
    done_by,
    in_a_thread,
    no_report,
    only_pictures,
    results,
    same,
    states,
)
from sites import START, recording
from waiting import is_gone, wait_for

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.site import RunState, stages_of
from gis_radar.site import run as product
from gis_radar.site.execution import discard


def test_a_run_leaves_a_project_that_was_edited(copied, without_report):
    path, out = copied
    project, state = out / "site.qgz", out / ".gis-radar"
    with zipfile.ZipFile(project) as archive:
        text = archive.read("site.qgs")
    with zipfile.ZipFile(project, "w") as archive:  # as QGIS saves it
        archive.writestr("site.qgs", text)
    edited = project.read_bytes()
    heard = Listener()
    first = states(gr.run_site(path, out, reporter=heard))
    assert first["QGIS project"] == "done"
    assert "the new project is site_2.qgz" in str(heard.messages)
    assert set(states(gr.run_site(path, out)).values()) == {"kept"}
    discard([project, out / "site_2.qgz"])
    assert project.read_bytes() == edited
    assert not (out / "site_2.qgz").exists()
    assert state.is_dir()


def test_nothing_is_done_twice(small, copied):
    path, out = copied
    before = {name: (out / name).stat().st_mtime_ns for name in results(out)}
    done = gr.run_site(path, out)
    assert set(states(done).values()) == {"kept"}
    after = {name: (out / name).stat().st_mtime_ns for name in results(out)}
    assert {name for name in after if after[name] != before[name]} == {"run.json"}
    same(out, small[1])


class Killing(Listener):
    """Interrupts when a stage begins."""

    def __init__(self, stage):
        super().__init__()
        self.stage = stage

    def progress(self, stage, done, total):
        super().progress(stage, done, total)
        if (stage, done) == (self.stage, 0):
            raise KeyboardInterrupt


def test_a_run_that_was_stopped_and_killed_ends_with_the_same_files(
    small, tmp_path, monkeypatch, all_fit
):
    path, unbroken, _ = small
    out = shutil.copytree(unbroken, tmp_path / "out")
    state = RunState(out / product.STATE / "state.json", out)
    for name in sorted(state.records.keys() - {"mask", "localize R1"}):
        discard(state.drop(name))
    state.save()
    with pytest.raises(KeyboardInterrupt):
        gr.run_site(path, out, reporter=Killing("tiles"))
    assert json.loads((out / "run.json").read_text())["finished"] is False
    words = [sys.executable, "-m", "gis_radar", "run", str(path), "-o", str(out), "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment()) as run:
        for line in run.stdout:
            if json.loads(line).get("stage") == "measure":
                break
        run.send_signal(signal.SIGKILL)
    # As if it had been killed in the midst of writing.
    (out / "heatmap").mkdir(exist_ok=True)
    (out / ".heatmap.0123abcd.part" / "heatmap").mkdir(parents=True)
    (out / ".heatmap.0123abcd.part" / "heatmap" / "heatmap.gpkg").write_text("half")
    monkeypatch.setattr(product, "process_pool", in_a_thread)
    done = gr.run_site(path, out)
    assert {name for name, ended in states(done).items() if ended == "kept"} >= {
        "mask", "localize R1",
    }  # fmt: skip
    same(out, unbroken)
    assert not [each for each in out.rglob(".*") if each.suffix == ".part"]
    assert {path.name for path in (out / product.STATE).iterdir()} == {
        ".gitignore", "sights", "state.json",
    }  # fmt: skip


def test_finished_means_that_the_record_says_so(small, copied, blank_paper):
    path, out = copied

    class Stopping(Listener):
        """Interrupts when the report is made but the record is not yet written."""

        def progress(self, stage, done, total):
            super().progress(stage, done, total)
            if (stage, done) == ("report", 100):
                raise KeyboardInterrupt

    state = RunState(out / product.STATE / "state.json", out)
    discard(state.drop("report"))
    state.save()
    with pytest.raises(KeyboardInterrupt):
        gr.run_site(path, out, reporter=Stopping())
    before = json.loads((out / "run.json").read_text())
    assert before["finished"] is False
    assert "report" not in [stage["name"] for stage in before["stages"]]
    done = gr.run_site(path, out)
    assert states(done)["report"] == "kept"
    after = json.loads((out / "run.json").read_text())
    assert after["finished"] is True
    assert after["stages"][-1]["name"] == "report"
    same(out, small[1], but=PAPER)


def environment():
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_ends_with_130_and_leaves_no_process(small, tmp_path):
    words = [sys.executable, "-m", "gis_radar", "run", str(small[0]), "-o", str(tmp_path / "out")]
    with subprocess.Popen(
        [*words, "--json"], stdout=subprocess.PIPE, text=True, env=environment()
    ) as run:
        for line in run.stdout:
            if json.loads(line).get("stage") == "mask":
                break
        children = children_of(run.pid)
        run.send_signal(signal.SIGINT)
        said = [json.loads(line) for line in run.stdout]
        assert run.wait(30) == 130
    assert said[-1]["event"] == "error"
    assert any("goes on from there" in event.get("message", "") for event in said)
    assert children
    wait_for(lambda: all(map(is_gone, children)))


def test_a_worker_ended_while_it_measures_leaves_nothing_that_counts(copied):
    path, out = copied
    before = results(out / "dataset")
    shutil.rmtree(out / "dataset")

    class Ending(Listener):
        """Ends the stage as a worker's signal handler does, while an hour is being written."""

        def progress(self, stage, done, total):
            super().progress(stage, done, total)
            if list(out.glob("dataset/hits/*/*")):
                raise SystemExit(143)

    (stage,) = [each for each in stages_of(gr.read_site(path), out) if each.name == "measure"]
    with pytest.raises(SystemExit):
        stage.work(outputs=list(stage.outputs), reporter=Ending(), **stage.arguments)
    shown = Listener()
    stage.work(outputs=list(stage.outputs), reporter=shown, **stage.arguments)
    assert results(out / "dataset") == before
    assert len({name for name, *_ in shown.stages}) <= stage.phases  # else it waits at 99 %


def children_of(pid):
    """The processes that a process has started."""
    found = set()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found.add(int(stat.parent.name))
        except OSError:
            continue
    return found


def test_a_sensor_without_an_answer_and_those_with_bad_data_stop_no_other(small, copied):
    path, out = copied
    folder = path.parent
    recording(folder / "R3.parquet", START + np.arange(150) * 0.05, np.ones((150, 3)))
    shutil.copy(folder / "R3.parquet", folder / "R5.parquet")
    (folder / "R4.parquet").write_bytes((folder / "R1.parquet").read_bytes()[:5000])
    pose = json.loads((folder / "R2.json").read_text()) | {"sensor": "R5", "covariance": [[1.0]]}
    (folder / "R5.json").write_text(json.dumps(pose))
    text = path.read_text()
    third = '\n[[sensor]]\nname = "R3"\nrecordings = "R3.parquet"\nguess = [677990, 5403610]\n'
    fifth = '\n[[sensor]]\nname = "R5"\nrecordings = "R5.parquet"\npose = "R5.json"\n'
    path.write_text(text + third + third.replace("R3", "R4") + fifth)
    words = ["run", str(path), "-o", str(out), "--jobs", "1", "--json"]
    with only_pictures(), no_report():
        answer = CliRunner().invoke(group, words)
    assert type(answer.exception) is gr.InputError
    first, *parts = map(str, answer.exception.parts)
    assert "no result for R3, R4, R5; the heat maps show R1, R2 only" in first
    for told in ("moving vehicles", "R4.parquet", "covariance"):
        assert sum(told in part for part in parts) == 1
    result = json.loads(answer.stdout.splitlines()[-1])
    assert result["summary"]["heat_maps_show"] == ["R1", "R2"]
    record = json.loads((out / "run.json").read_text())
    assert record["sensors_in_heat_maps"] == ["R1", "R2"]
    assert not (out / "sensors" / "R3").exists()
    assert list(gpd.read_file(out / "sensors.gpkg", layer="sensors")["sensor"]) == ["R1", "R2"]
    assert (out / "heatmap" / "heatmap.gpkg").is_file()
    path.write_text(text)
    with only_pictures():
        assert gr.run_site(path, out, jobs=1).failure is None
    same(out, small[1], but=PAPER)


def test_what_is_changed_is_done_again_and_what_is_taken_out_is_gone(
    copied, blank_paper, without_report
):
    path, out = copied
    text = path.read_text()
    path.write_text(text[: text.rindex("[[sensor]]")].replace('"10s"', '"15s"'))
    heard = Listener()
    done = gr.run_site(path, out, jobs=1, reporter=heard)
    assert done.failure is None
    assert {name for name, state in states(done).items() if state == "done"} == {
        "measure", "heat map", "QGIS project", "report",
    }  # fmt: skip
    assert not (out / "sensors" / "R2").exists()
    assert gr.open_dataset(out / "dataset").sensors == ["R1"]
    assert json.loads((out / "run.json").read_text())["sensors_in_heat_maps"] == ["R1"]
    assert any("no longer part of the site" in text for _, text in heard.messages)
    state = RunState(out / product.STATE / "state.json", out)
    assert "localize R1" in state.records
    state.invalidate()
    localized = next(each.stage for each in done.outcomes if each.stage.name == "localize R1")
    assert state.recorded_outcome(localized) is None
    product.drop_removed_stages(state, [localized], heard)
    assert set(state.records) == {"localize R1"}
    assert not (out / "sensors" / "R1" / "pose.json").exists()


def add_recording(folder, number, *, later_s):
    """Record again what R2 did in its first four seconds, so much later."""
    table = pd.read_parquet(folder / "R2_0.parquet")
    table = table[table["time"] < table["time"].iloc[0] + 4.0]
    again = table.assign(time=table["time"] + later_s)
    again.to_parquet(folder / f"R2_{number}.parquet", index=False)


def test_what_is_added_is_measured_alone_and_as_if_all_were_measured_anew(copied, blank_paper):
    path, out = copied
    change(path, '"10s"', '"30min"')  # hundreds of intervals would take most of the time
    path.write_text(path.read_text() + HITS_ALONE)
    after_all = ["measure", "heat map", "QGIS project", "report"]
    hour = out / "dataset" / "hours" / "2023-11-14" / "22.json"
    add_recording(path.parent, 1, later_s=2798.0)  # over the hour: 22:59:58 to 23:00:02
    with no_report():
        assert sorted(done_by(gr.run_site(path, out))) == sorted(after_all)
    made = hour.stat().st_mtime_ns
    add_recording(path.parent, 2, later_s=7200.0)  # after midnight
    added = gr.run_site(path, out)
    assert sorted(done_by(added)) == sorted(after_all)
    assert hour.stat().st_mtime_ns == made
    assert len(gr.open_dataset(out / "dataset").hours()) == 3
    assert not any(product.STATE in place.parts for place in added.outputs)
    # the same bytes as all measured anew
    anew = shutil.copytree(out, path.parent.parent / "anew")
    shutil.rmtree(anew / "dataset")
    assert "measure" in done_by(gr.run_site(path, anew))
    same(anew, out, but=PAPER)


def test_a_pose_is_searched_again_only_where_it_was_not_found(copied, blank_paper):
    """The first recording that gives a pose counts; without one, each that is added is asked."""
    path, out = copied
    stage = next(each for each in stages_of(gr.read_site(path), out) if each.name == "localize R1")
    state = RunState(out / product.STATE / "state.json", out)
    recordings = stage.inputs["recordings"]
    more = replace(stage, inputs={**stage.inputs, "recordings": (*recordings, path)})
    before = replace(stage, inputs={**stage.inputs, "recordings": (path, *recordings)})
    recorded = [state.recorded_outcome(each) for each in (stage, more, before)]
    assert [each is not None for each in recorded] == [True, True, False]
    state.records["localize R1"].figures.pop("asked")  # as of a refusal
    assert state.recorded_outcome(more) is None


def test_what_is_set_for_measuring_counts_and_repeats_no_localization(
    copied, blank_paper, without_report
):
    """A stage depends on what it reads and on its own settings, on no others."""
    path, out = copied
    change(path, "max_range_m = 150.0", "max_range_m = 120.0")
    change(path, "[-0.5, 4.5]", "[-0.5, 4.0]")
    change(path, 'pose = "R2.json"', 'pose = "R2.json"\ncycle = "150ms"')
    change(path, "[heatmap]", 'clocks = "clocks.json"\n\n[heatmap]')
    clocks = {"clocks": {"R2": {"offset_s": 2.0}}}
    (path.parent / "clocks.json").write_text(json.dumps(clocks), encoding="utf-8")
    before = frames_of(out, "R2")
    done = gr.run_site(path, out)
    assert done.failure is None
    assert sorted(done_by(done)) == ["QGIS project", "heat map", "measure", "pose R1", "report"]
    assert gr.read_pose(out / "sensors" / "R1" / "pose.json").view.max_range_m == 120.0
    after = frames_of(out, "R2")
    assert after["begin"].min() == before["begin"].min() - pd.Timedelta(seconds=2)
    rows = gr.open_dataset(out / "dataset").recordings().set_index("sensor")
    assert rows.loc["R2", ["clock_offset", "validity_s"]].tolist() == [2.0, 0.225]
    assert "the clock of R1 is not corrected" in (out / "run.json").read_text(encoding="utf-8")
    assert "clocks.json" in json.loads((out / "run.json").read_text(encoding="utf-8"))["inputs"]


def frames_of(out, sensor):
    frames = gr.open_dataset(out / "dataset").frames()
    return frames[frames["sensor"] == sensor]


def test_names_of_streets_that_come_later_count_nothing_anew(copied, blank_paper):
    path, out = copied
    before = lanes_of(out)
    middle = gpd.read_file(out / "tiles.gpkg", layer="lanes").geometry.iloc[:1]
    street = gpd.GeoDataFrame({"name": ["Newly Named Street"]}, geometry=middle)
    street.to_file(path.parent / "streets.gpkg")
    change(path, "[map]\n", '[map]\nstreets = "streets.gpkg"\n')
    done = gr.run_site(path, out)
    assert {*done_by(done)} - {"QGIS project"} == {"tiles", "lanes", "report"}
    after = lanes_of(out)
    names = after.loc[after["street"] == "Newly Named Street", "name"].dropna()
    assert len(names) > 0
    assert names.str.startswith("Newly Named Street ").all()
    directions = gr.open_dataset(out / "dataset").profile("Newly Named Street")["direction"]
    assert names.str.startswith(tuple(directions)).all()
    counted = ["lane", "occupancy", "hit_share", "visible_m"]
    pd.testing.assert_frame_equal(after[counted], before[counted])


def test_lanes_that_are_named_later_count_nothing_anew(small, copied, blank_paper):
    path, out = copied
    hours = {each: each.stat().st_mtime_ns for each in (out / "dataset").rglob("*.*")}
    lane = f"[[lane]]\nid = {lanes_of(out)['lane'][0]}\nname = "
    change(path, "[heatmap]", f'{lane}"To the harbour"\n\n[heatmap]')
    for name in ("To the harbour", "To the quay"):
        change(path, "To the harbour", name)
        done = gr.run_site(path, out)
        assert done_by(done) == ["lanes", "report"]
        assert name in set(lanes_of(out)["name"])
        assert name in set(pd.read_csv(out / "traffic.csv")["name"])
        assert name in set(gr.open_dataset(out / "dataset").query("FROM lanes")["name"])
    (out / "dataset" / "lanes.json").unlink()
    change(path, "[[lane]]", '[[lane]]\nid = 77\nname = "gone"\n\n[[lane]]')
    heard = Listener()
    done = gr.run_site(path, out, reporter=heard)
    assert done_by(done) == ["lanes", "report"]
    said = "the site file names lanes that the map has not: 77; they are left out"
    assert [each for each in heard.lines if said in each] == [f"lanes: {said}"]
    assert said in (out / "report.html").read_text(encoding="utf-8")
    assert name in set(lanes_of(out)["name"])
    assert set(states(gr.run_site(path, out)).values()) == {"kept"}
    assert {each: each.stat().st_mtime_ns for each in hours} == hours
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(text[text.index("[[lane]]") : text.index("[heatmap]")], ""))
    assert done_by(gr.run_site(path, out)) == ["report"]
    same(out, small[1], but=PAPER)


def lanes_of(out):
    return pd.read_csv(out / "lanes.csv")
