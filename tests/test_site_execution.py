"""The execution of stages: what is done, what is kept, and what a kill or a fault leaves."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue

import pytest
from fake_stages import diamond, execute, stage, threads
from maps import Listener
from waiting import is_gone, wait_for

from gis_radar.base import (
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    content_digest,
    only_writer,
    workers_here,
)
from gis_radar.site import Pool, RunState, execution, process_pool

HERE = Path(__file__).parent
NAMES = ["road", "a1", "b1", "a2", "b2", "map"]
OLD = 1_700_000_000


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "out"
    (folder / ".gis-radar").mkdir(parents=True)
    return folder


@pytest.fixture
def source(tmp_path):
    return written(tmp_path / "source", "S")


def written(path, text):
    """Write a file that has settled: its hash may be remembered."""
    path.write_text(text)
    os.utime(path, (OLD, OLD))
    return path


def calls(root):
    """The stages that were done since the last time one asked."""
    path = root / "calls"
    found = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return sorted(found)


def states(outcomes):
    return {name: outcome.state for name, outcome in outcomes.items()}


def all_gone(root):
    """Wait until all workers have ended."""
    pids = (root / "workers").read_text().split()
    wait_for(lambda: all(map(is_gone, pids)))
    return True


def test_stages_are_done_once_in_the_order_of_need(root, source):
    first = execute(diamond(root, source), root, most=2, pool=process_pool)
    assert set(states(first).values()) == {"done"}
    assert (root / "map").read_text() == "Sroad" + "Sroada1a2" + "Sroadb1b2" + "map"
    assert calls(root) == sorted(NAMES)
    second = execute(diamond(root, source), root)
    assert set(states(second).values()) == {"kept"}
    assert calls(root) == []
    assert [dict(o.figures) for o in first.values()] == [dict(o.figures) for o in second.values()]
    assert all_gone(root)


def test_what_changes_is_done_again_and_no_more(root, source, monkeypatch):
    execute(diamond(root, source), root)
    calls(root)
    changed = diamond(root, source)
    changed[2] = stage(root, "b1", ["road"], sensor="b", wait_s=0.01)
    execute(changed, root)
    assert calls(root) == ["b1"]  # its output is what it was, so the rest stands
    written(source, "T")
    execute(changed, root)
    assert calls(root) == sorted(NAMES)
    (root / "a2").unlink()
    execute(changed, root)
    assert calls(root) == ["a2"]
    (root / "b2").write_text("tampered with")
    execute(changed, root)
    assert calls(root) == ["b2"]
    assert "tampered" not in (root / "map").read_text()
    monkeypatch.setattr(execution, "software", lambda: {"gis_radar": "99"})
    execute(changed, root)
    assert calls(root) == sorted(NAMES)


@pytest.mark.parametrize("damage", ["", "[]", '{"files": {}, "stages": {"a1": {"key": 1}}}'])
def test_a_damaged_state_is_none(root, source, damage):
    execute(diamond(root, source), root)
    calls(root)
    (root / ".gis-radar" / "state.json").write_text(damage)
    execute(diamond(root, source), root)
    assert calls(root) == sorted(NAMES)


def test_a_moved_run_goes_on(root, source):
    execute(diamond(root, source), root)
    calls(root)
    moved = root.rename(root.with_name("elsewhere"))
    execute(diamond(moved, source), moved)
    assert calls(moved) == []


@pytest.mark.parametrize(("work", "kind"), [("refuse", NoAnswerError), ("fail", InputError)])
def test_a_sensor_that_fails_does_not_stop_the_others(root, source, work, kind):
    stages = diamond(root, source)
    execute(stages, root)
    calls(root)
    stages[1] = stage(root, "a1", ["road"], work=work, sensor="a")
    heard = Listener()
    found = execute(stages, root, reporter=heard)
    state = "refused" if work == "refuse" else "failed"
    assert states(found) == {**dict.fromkeys(["road", "b1", "b2"], "kept"),
                             "a1": state, "a2": "skipped", "map": "done"}  # fmt: skip
    assert isinstance(found["a1"].error, kind)
    assert found["a2"].error is found["a1"].error
    assert (root / "map").read_text() == "SroadSroadb1b2map"
    # What the earlier run found is no answer of this one.
    assert not (root / "a1").exists()
    assert not (root / "a2").exists()
    assert any("a1" in text and found["a1"].error.message in text for _, text in heard.messages)
    calls(root)
    again = execute(stages, root)["a1"].error
    for told in (found["a1"].error, again) if work == "refuse" else ():
        lines = [(each.message, each.hint) for each in (told, *told.parts)]
        assert lines == [("nothing fits", "look again"), ("a does not fit", "look at a"),
                         ("b does not fit", "look at b")]  # fmt: skip
    # A refusal is an answer and stands; bad data may have been a bad moment.
    assert calls(root) == ([] if work == "refuse" else ["a1"])
    assert execute(diamond(root, source), root)["map"].state == "done"
    assert (root / "map").read_text() == "SroadSroada1a2Sroadb1b2map"


def test_errors_name_files_from_the_folder_of_the_site_on(root, source):
    stages = [stage(root, "a1", [source], work="name_its_input", sensor="a")]
    found = execute(stages, root, site=source.parent)
    assert found["a1"].error.message == "source: bad data"


def test_without_any_sensor_there_is_no_map(root, source):
    stages = diamond(root, source)
    execute(stages, root)
    for place, name in ((1, "a1"), (2, "b1")):
        stages[place] = stage(root, name, ["road"], work="refuse", sensor=name[0])
    found = execute(stages, root)
    assert found["map"].state == "skipped"
    assert isinstance(found["map"].error, NoAnswerError)
    assert not (root / "map").exists()


@pytest.mark.parametrize(
    ("work", "kind", "words"),
    [
        ("fail", InputError, "bad data"),
        ("refuse", NoAnswerError, "nothing fits"),
        ("cannot_write", OutputError, "disk full"),
        ("break_down", RuntimeError, "ZeroDivisionError"),
        ("die", GisRadarError, "road: a worker process ended"),
    ],
)
def test_what_all_depends_on_stops_all(root, source, work, kind, words):
    stages = diamond(root, source)
    stages[0] = stage(root, "road", [source], work=work)
    with pytest.raises(kind, match=words):
        execute(stages, root, pool=process_pool if work == "die" else threads)
    assert not (root / "a1").exists()


def test_where_nobody_knows_which_worker_died_all_at_work_are_named(root, source):
    """Any executor may break; a stage that still waits for a worker is not among the suspects."""
    broken = Future()
    broken.set_exception(BrokenExecutor())

    class Breaking(Executor):
        def submit(self, _carry_out, name, *_):
            if name != "b1":
                events.put({"stage": name, "worker": 1})
            return broken if name == "c1" else Future()

    events = SimpleQueue()
    stages = [stage(root, name, [source], sensor=name) for name in ("a1", "b1", "c1")]
    state = RunState(root / ".gis-radar" / "state.json", root)
    pool = Pool(executor=Breaking(), send=events.put, events=events)
    with pytest.raises(GisRadarError, match=r"(?m)^a1, c1: a worker process ended$"):
        execution.Execution(stages=stages, state=state, pool=pool, reporter=Listener()).run()


def test_a_full_disk_stops_all_whoever_meets_it(root, source):
    stages = diamond(root, source)
    stages[1] = stage(root, "a1", ["road"], work="cannot_write", sensor="a")
    with pytest.raises(OutputError, match="disk full"):
        execute(stages, root)


def test_a_warning_names_a_sensor_once(root, source):
    said = Listener()
    execute([stage(root, "a", [source], work="refuse_sensor", sensor="a")], root, reporter=said)
    assert said.messages[-1] == ("warning", "a: nothing fits")


def test_warnings_stand_when_a_stage_is_kept(root, source):
    for state in ("done", "kept"):
        found = execute([stage(root, "road", [source], work="warn")], root)
        assert (found["road"].state, tuple(found["road"].warnings)) == (state, ("beware",))


def test_libraries_that_print_disturb_nothing(root, source, capfd):
    found = execute([stage(root, "road", [source], work="chatter")], root, pool=process_pool)
    assert found["road"].state == "done"
    assert capfd.readouterr().out == ""


def test_an_input_that_changes_meanwhile_leaves_no_record(root, source):
    heard = Listener()
    work = [stage(root, "road", [source], work="touch_input")]
    assert execute(work, root, reporter=heard)["road"].state == "done"
    assert any("has changed meanwhile" in text for _, text in heard.messages)
    assert not RunState(root / ".gis-radar" / "state.json", root).records


def test_a_bar_a_stage_never_goes_back_and_ends_full(root, source):
    heard = Listener()
    execute(diamond(root, source), root, reporter=heard)
    for name in NAMES:
        told = [done for stage, done, _ in heard.stages if stage == name]
        assert told == sorted(told)
        assert told[-1] == 100
    assert ("all stages", 6, 6) in heard.stages


def test_the_bar_of_all_stages_grows_where_they_are_done_in_two_goes(root, source):
    heard, stages = Listener(), diamond(root, source)
    state = RunState(root / ".gis-radar" / "state.json", root)
    with threads(1, root) as pool:
        run = execution.Execution(stages=stages, state=state, pool=pool, reporter=heard)
        assert [outcome.stage.name for outcome in run.run(-1)] == NAMES[:-1]
        assert not (root / "map").exists()
        assert [outcome.stage.name for outcome in run.run()] == NAMES
    shares = [done / total for stage, done, total in heard.stages if stage == "all stages"]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)


class Interrupting(Listener):
    """Interrupts at the n-th word of progress, as a Ctrl-C or a cancel button would."""

    def __init__(self, after):
        super().__init__()
        self.after = after

    def progress(self, stage, done, total):
        super().progress(stage, done, total)
        if len(self.stages) == self.after:
            raise KeyboardInterrupt


@pytest.mark.parametrize("after", [1, 5, 12])
def test_an_interrupted_run_goes_on_to_the_same_end(root, source, tmp_path, after):
    with pytest.raises(KeyboardInterrupt):
        execute(
            diamond(root, source), root, most=2, reporter=Interrupting(after), pool=process_pool
        )
    assert not (root / "workers").exists() or all_gone(root)
    done = calls(root)
    found = execute(diamond(root, source), root)
    kept = [name for name, state in states(found).items() if state == "kept"]
    assert set(kept) <= set(done)
    assert sorted(kept + calls(root)) == sorted(NAMES)
    whole = tmp_path / "whole"
    whole.mkdir()
    execute(diamond(whole, source), whole)
    assert {name: (root / name).read_text() for name in NAMES} == {
        name: (whole / name).read_text() for name in NAMES
    }


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("after", ["road", "a1", "map"])
def test_kill_9_leaves_no_worker_no_lock_and_no_half_answer(root, source, after):
    words = [sys.executable, str(HERE / "fake_stages.py"), str(root), str(source), "0.3"]
    paths = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=paths) as run:
        for line in run.stdout:
            name, done, _ = json.loads(line)
            if name == after and (root / "workers").exists() and done < 100:
                break
        run.send_signal(signal.SIGKILL)
    assert all_gone(root)
    calls(root)
    found = execute(diamond(root, source, wait_s=0.3), root)
    assert all(outcome.has_result for outcome in found.values())
    assert found["road"].state == ("done" if after == "road" else "kept")
    assert (root / "map").read_text() == "SroadSroada1a2Sroadb1b2map"


def test_workers_do_not_run_the_script_of_the_caller_again(root, source, tmp_path):
    """A script needs no guard: stages are functions of modules, and workers get no other."""
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\n"
        "from fake_stages import diamond, execute, process_pool\n"
        "execute(diamond(sys.argv[1], sys.argv[2]), sys.argv[1], pool=process_pool)\n"
        "print('once', __file__ == sys.argv[0], __spec__)\n"
    )
    paths = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
    words = [sys.executable, str(script), str(root), str(source)]
    done = subprocess.run(words, capture_output=True, text=True, env=paths, check=False)
    assert (done.returncode, done.stdout) == (0, "once True None\n"), done.stderr


def test_two_runs_in_one_folder_are_refused(root, source):
    with (
        only_writer(root, lock=root / ".gis-radar" / "lock"),
        pytest.raises(OutputError, match=f"another run is writing it .process {os.getpid()}"),
    ):
        execute(diamond(root, source), root)
    assert execute(diamond(root, source), root)["map"].state == "done"


def test_hashes_follow_the_bytes(tmp_path):
    memory = tmp_path / "memory.json"
    file = written(tmp_path / "file", "one")
    first = RunState(memory, tmp_path)
    before = first.hash_of(file)
    first.save()
    read = []
    second = RunState(memory, tmp_path)
    assert second.hash_of(file, read.append) == before
    assert read == []  # remembered
    file.write_text("two")
    assert second.hash_of(file, read.append) != before
    assert read == [3]
    written(file, "one")
    assert second.hash_of(file) == before
    assert second.hash_of(tmp_path / "gone") is None


def test_a_file_that_is_still_young_is_read_each_time(tmp_path):
    file = tmp_path / "file"
    file.write_text("one")
    state, read = RunState(tmp_path / "memory.json", tmp_path), []
    for _ in range(2):
        state.hash_of(file, read.append)
    assert read == [3, 3]


def test_the_hash_of_a_geopackage_is_that_of_its_tables(tmp_path):
    """A viewer changes the bytes only."""
    file, state = tmp_path / "a.gpkg", RunState(tmp_path / "memory.json", tmp_path)
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("CREATE TABLE tiles (id INTEGER)")
    before = state.hash_of(file)
    assert before == content_digest(file)
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("CREATE TABLE qgis_projects (name TEXT)")
    assert state.hash_of(file) == before
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("INSERT INTO tiles VALUES (1)")
    assert state.hash_of(file) != before
    file.write_text("damaged")
    assert state.hash_of(file) not in {before, None}


def test_the_content_of_a_folder_is_that_of_its_files(tmp_path):
    folder = tmp_path / "folder"
    (folder / "inner").mkdir(parents=True)
    (folder / "inner" / "a").write_text("a")
    state = RunState(tmp_path / "memory.json", tmp_path)
    before = state.hash_of(folder)
    (folder / "heatmap.tif.aux.xml").write_text("left by a viewer")
    assert state.hash_of(folder) == before
    (folder / "inner" / "a").rename(folder / "inner" / "b")
    assert state.hash_of(folder) != before


def test_there_is_at_least_one_worker(monkeypatch):
    monkeypatch.setattr("gis_radar.base.processes.free_memory", lambda: 1)
    assert workers_here() == 1
    monkeypatch.setattr("gis_radar.base.processes.free_memory", lambda: None)
    assert workers_here() >= 1
