"""Child processes: none outlives its parent, and a parent that is gone ends its children."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from waiting import is_gone, wait_for

from gis_radar.base import GisRadarError, run_child, watch_parent
from gis_radar.base.processes import GONE_S, WATCHDOG_VARIABLE

ROOT = Path(__file__).parents[1]
posix = pytest.mark.skipif(os.name == "nt", reason="process groups")
WORK = [sys.executable, "-m", "gis_radar", "demo", "--json", "-o"]


def watching(out, **options):
    around = os.environ | {WATCHDOG_VARIABLE: "stdin", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [*WORK, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=around,
        **options,
    )  # fmt: skip


def test_a_worker_that_is_let_go_stops(tmp_path):
    with watching(tmp_path / "out") as worker:
        assert json.loads(worker.stdout.readline())["event"] in ("progress", "log")
        worker.stdin.close()
        last = worker.stdout.read().splitlines()[-1]
    assert worker.returncode == 130
    assert json.loads(last)["message"].startswith("interrupted")
    left = [path for path in (tmp_path / "out").rglob("*") if ".part" in path.name]
    assert left == []


INTERRUPTED = """
import os, signal, subprocess, sys, tempfile
from gis_radar.base import run_child
told = []

def interrupting(call):
    def called(*words):
        answer = call(*words)
        if not told:
            told.append(popen.pid)
            print(popen.pid, flush=True)
            os.kill(os.getpid(), signal.SIGINT)
        return answer
    return called

class Popen(subprocess.Popen):
    def _execute_child(self, *words):
        global popen
        popen = self
        if sys.argv[1] == "while it starts":
            self._close_pipe_fds = interrupting(self._close_pipe_fds)
        else:
            self._waitpid_lock = Lock(self._waitpid_lock)
        super()._execute_child(*words)

class Lock:
    def __init__(self, lock):
        self.acquire, self.release = interrupting(lock.acquire), lock.release
    def __enter__(self):
        self.acquire()
    def __exit__(self, *_):
        self.release()

subprocess.Popen = Popen
with tempfile.TemporaryFile() as file:
    run_child(["sleep", "60"], stdin=file, stderr=file, environment=os.environ, waiting=print)
"""


@posix
@pytest.mark.parametrize("moment", ["while it starts", "while it is asked whether it has ended"])
def test_an_interrupt_amid_a_call_of_the_standard_library_ends_the_child(moment):
    """Ctrl-C there left a child behind, or a lock that was then waited for without end."""
    words = [sys.executable, "-c", INTERRUPTED, moment]
    done = subprocess.run(words, capture_output=True, text=True, timeout=45.0, check=False)
    assert done.stderr.endswith("KeyboardInterrupt\n")
    with pytest.raises(ProcessLookupError):
        os.kill(int(done.stdout.split()[0]), 0)


TWICE = """
import os, subprocess, sys, tempfile, time
from gis_radar.base import run_child

class Popen(subprocess.Popen):
    def kill(self):
        time.sleep(0.5)  # a busy machine: the second Ctrl-C comes first
        super().kill()

subprocess.Popen = Popen
body = f"echo $$ >{sys.argv[1]}/part; mv {sys.argv[1]}/part {sys.argv[1]}/pid; exec sleep 60"
with tempfile.TemporaryFile() as file:
    run_child(["sh", "-c", body], stdin=file, stderr=file, environment=os.environ, waiting=print)
"""


@posix
def test_ctrl_c_twice_leaves_no_child(tmp_path):
    with subprocess.Popen([sys.executable, "-c", TWICE, tmp_path], stderr=subprocess.PIPE,
                          stdout=subprocess.DEVNULL) as parent:  # fmt: skip
        wait_for((tmp_path / "pid").exists)
        for _ in range(2):
            parent.send_signal(signal.SIGINT)
            time.sleep(0.1)
        parent.communicate(timeout=45.0)
    wait_for(lambda: is_gone(int((tmp_path / "pid").read_text())))


@posix
@pytest.mark.parametrize("failing", ["poll", "waiting"])
def test_a_child_that_cannot_be_waited_for_is_killed(tmp_path, monkeypatch, failing):
    poll, asked = subprocess.Popen.poll, []

    def poll_or_fail(process):
        asked.append(process)
        if failing == "poll" and len(asked) == 1:
            raise MemoryError
        return poll(process)

    def wait_or_fail(_seconds):
        raise MemoryError

    monkeypatch.setattr(subprocess.Popen, "poll", poll_or_fail)
    with (tmp_path / "a").open("w+b") as file, pytest.raises(MemoryError):
        run_child(["sleep", "60"], stdin=file, stderr=file, environment=os.environ,
                  waiting=wait_or_fail)  # fmt: skip
    assert asked[0].wait(45.0) == -signal.SIGKILL


@posix
@pytest.mark.parametrize(
    ("name", "error", "match"),
    [("no such program", GisRadarError, "no such program: does not start: No such file"),
     ("a\0b", ValueError, "null byte"), ("", RuntimeError, "can't start new thread")],
)  # fmt: skip
def test_what_cannot_be_started_is_an_error_at_once(tmp_path, monkeypatch, name, error, match):
    def no_thread(*_words):
        raise RuntimeError("can't start new thread")

    if not name:
        monkeypatch.setattr("_thread.start_new_thread", no_thread)
    begin = time.monotonic()
    with (tmp_path / "a").open("w+b") as file, pytest.raises(error, match=match):
        run_child([name], stdin=file, stderr=file, environment={}, waiting=print)
    assert time.monotonic() - begin < GONE_S


@posix
def test_a_worker_that_nobody_hears_stops(tmp_path):
    """Its listener died: what it says breaks the pipe. It has nobody to complain to."""
    with watching(tmp_path / "out", stderr=subprocess.PIPE) as worker:
        worker.stdout.readline()
        worker.stdout.close()
        complaint = worker.stderr.read()
    assert complaint == ""
    assert worker.returncode == 130
    assert [path for path in (tmp_path / "out").rglob("*") if ".part" in path.name] == []


@posix
def test_a_worker_that_was_told_to_ignore_ctrl_c_stops_too(tmp_path):
    def ignore():
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    with watching(tmp_path / "out", preexec_fn=ignore) as worker:
        worker.stdout.readline()
        worker.stdin.close()
        worker.stdout.read()
    assert worker.returncode == 130


def test_without_a_watchdog_the_input_does_not_matter(tmp_path):
    words = [sys.executable, "-m", "gis_radar", "sample", "--json", "-o", str(tmp_path / "s")]
    around = {name: value for name, value in os.environ.items() if name != WATCHDOG_VARIABLE}
    done = subprocess.run(
        words, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True,
        env=around | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert json.loads(done.stdout.splitlines()[-1])["event"] == "result"
    assert (tmp_path / "s" / "junction.osm").is_file()


POOL = """
import multiprocessing, os, pathlib, subprocess, sys, time
from concurrent.futures import ProcessPoolExecutor
from gis_radar.base import stop_workers, watch_parent

def work(note):
    child = subprocess.Popen(["sleep", "600"])
    pathlib.Path(note + ".part").write_text(f"{os.getpid()} {child.pid}")
    os.rename(note + ".part", note)
    time.sleep(600)

if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=watch_parent) as pool:
        pool.submit(work, sys.argv[1])
        sys.stdin.read()
        stop_workers(multiprocessing.active_children())
"""


@posix
@pytest.mark.parametrize("end", ["kill", "stop"])
def test_workers_of_a_pool_go_with_their_children(tmp_path, end):
    script, note = tmp_path / "pool.py", tmp_path / "note"
    script.write_text(POOL)
    around = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen([sys.executable, script, note], stdin=subprocess.PIPE, env=around) as run:
        wait_for(note.exists)
        if end == "kill":
            run.send_signal(signal.SIGKILL)
        else:
            run.stdin.close()
            assert run.wait(300) == 0
    for number in note.read_text().split():
        wait_for(lambda number=number: is_gone(number))


def test_only_a_worker_has_a_parent_to_watch():
    with pytest.raises(RuntimeError, match="multiprocessing"):
        watch_parent()
