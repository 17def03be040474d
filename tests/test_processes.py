"""Child processes: none outlives its parent, and a parent that is gone ends its children."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from waiting import is_gone, wait_for

from gis_radar.base import GisRadarError, OutputError, run_child, watch_parent, worker_pool
from gis_radar.base.processes import WATCHDOG_VARIABLE

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


CHILD = """
import os, tempfile
from gis_radar.base import run_child
def waiting(seconds):
    print("waits", flush=True)
with tempfile.TemporaryFile() as file:
    body = "echo $$ >&2; exec sleep 60"
    with open(2, "wb", closefd=False) as said:
        run_child(["sh", "-c", body], stdin=file, stderr=said, environment=os.environ,
                  waiting=waiting)
"""


# An interrupt between two instructions of Popen.wait leaves its lock taken for ever.
LOCKED = """
import subprocess
kill = subprocess.Popen.kill
def kill_and_lock(child):
    kill(child)
    child._waitpid_lock.acquire()
subprocess.Popen.kill = kill_and_lock
"""


@posix
@pytest.mark.parametrize("before", ["", LOCKED], ids=["", "within wait"])
def test_ctrl_c_leaves_no_child(before):
    with subprocess.Popen([sys.executable, "-c", before + CHILD], stderr=subprocess.PIPE,
                          stdout=subprocess.PIPE) as parent:  # fmt: skip
        try:
            assert parent.stdout.readline() == b"waits\n"
            parent.send_signal(signal.SIGINT)
            _, said = parent.communicate(timeout=45.0)
        finally:
            parent.kill()  # one that hangs fails here, and does not hold the others
    assert said.endswith(b"KeyboardInterrupt\n")
    assert is_gone(int(said.split()[0]))


@posix
def test_a_program_that_is_not_there_does_not_start(tmp_path):
    missing = pytest.raises(GisRadarError, match="no such program: does not start: No such file")
    with (tmp_path / "a").open("w+b") as file, missing:
        run_child(["no such program"], stdin=file, stderr=file, environment={}, waiting=print)


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
from gis_radar.base import WorkerPool, watch_parent

def work(note):
    child = subprocess.Popen(["sleep", "600"])
    pathlib.Path(note + ".part").write_text(f"{os.getpid()} {child.pid}")
    os.rename(note + ".part", note)
    time.sleep(600)

if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    with WorkerPool(1, context=spawn, initializer=watch_parent) as pool:
        pool.submit(work, sys.argv[1])
        sys.stdin.read()
        pool.stop()
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


AUTOGROUP = Path("/proc/self/autogroup")  # Linux: how its session is weighed against others


def niceness():
    """Return that of this process, and that of its session."""
    return os.nice(0), int(AUTOGROUP.read_text().split()[-1])


def begin_nicely():
    os.nice(7)
    watch_parent()


def begin_beside_others():
    """Begin while others do: of all users' processes Linux serves one each 0.1 s."""
    write, refused = Path.write_text, [BlockingIOError(), BlockingIOError()]

    def write_later(path, *given, **options):
        if refused:
            raise refused.pop()
        return write(path, *given, **options)

    Path.write_text = write_later
    begin_nicely()


@pytest.mark.skipif(not AUTOGROUP.exists(), reason="no autogroups here")
@pytest.mark.parametrize("begin", [begin_nicely, begin_beside_others])
def test_a_worker_of_low_priority_gives_way_to_other_sessions_too(begin):
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=begin) as pool:
        own, of_session = pool.submit(niceness).result()
    assert own == of_session == min(os.nice(0) + 7, 19)


def test_only_a_worker_has_a_parent_to_watch():
    with pytest.raises(RuntimeError, match="multiprocessing"):
        watch_parent()


@posix
def test_a_worker_of_a_pool_that_is_killed_is_one_line():
    with (
        pytest.raises(OutputError, match="a worker process was killed"),
        worker_pool(2, watch_parent) as pool,
    ):
        pool.submit(signal.raise_signal, signal.SIGKILL).result()
    assert multiprocessing.active_children() == []


def test_a_pool_stops_where_its_user_fails():
    with pytest.raises(ZeroDivisionError), worker_pool(2, watch_parent) as pool:
        pool.submit(divmod, 1, 0).result()
    assert multiprocessing.active_children() == []
