"""After `kill -9`: the old result or the new one, nothing in the way, nobody locked out."""

import errno
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from filelock import lock_descriptor

from gis_radar.base import (
    OutputError,
    atomic_folder,
    atomic_write,
    atomic_writes,
    files,
    folder_to_fill,
    leftovers,
    scratch_folder,
    writing_errors,
)

ROOT = Path(__file__).parents[1]


def killed(code, *words, when="ready"):
    """Run a program until it prints a line, then kill it with all that it has open."""
    child = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)], stdout=subprocess.PIPE, cwd=ROOT
    )
    with child:
        assert child.stdout.readline().strip() == when.encode()
        child.kill()
    assert child.returncode == -signal.SIGKILL


BEGIN = (
    "import sys, time; from pathlib import Path; from gis_radar.base import files\n"
    "place = Path(sys.argv[1])\n"
    "def stop():\n    print('ready', flush=True); time.sleep(60)\n"
)
FILE = BEGIN + "with files.atomic_write(place) as part:\n    part.write_text('half'); stop()\n"
FOLDER = BEGIN + (
    "with files.atomic_folder(place, owned=('a',)) as part:\n    (part / 'a').write_text('half')\n"
    "    stop()\n"
)
BETWEEN = BEGIN + (
    "rename = Path.rename\ncalls = []\n"
    "def stopping(self, target):\n"
    "    calls.append(1)\n"
    "    stop() if len(calls) == 2 else rename(self, target)\n"
    "Path.rename = stopping\n"
    "with files.atomic_folder(place, owned=('a',)) as part:\n    (part / 'a').write_text('new')\n"
)
SEVERAL = BEGIN + (
    "import os\nreplace = os.replace\ncalls = []\n"
    "def stopping(part, target):\n"
    "    stop() if len(calls) == int(sys.argv[2]) else replace(part, target)\n"
    "    calls.append(1)\n"
    "os.replace = stopping\n"
    "with files.atomic_writes(place) as (private, places):\n"
    "    for name in ('road.laz', 'road.json', 'road.gpkg'):\n"
    "        (private / name).write_text('new'); places[private / name] = place.with_name(name)\n"
)
SCRATCH = BEGIN + (
    "import tempfile; tempfile.tempdir = str(place)\n"
    "with files.scratch_folder() as folder:\n    (folder / 'a').write_text('half'); stop()\n"
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_next_run_clears_what_a_killed_one_left_of_a_file(tmp_path):
    killed(FILE, tmp_path / "a.txt")
    assert len(names(tmp_path)) == 1
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("new")
    assert names(tmp_path) == ["a.txt"]


def test_the_next_run_clears_what_a_killed_one_left_of_a_folder(tmp_path):
    killed(FOLDER, tmp_path / "o")
    with atomic_folder(tmp_path / "o", owned=("a",)) as part:
        (part / "a").write_text("new")
    assert names(tmp_path) == ["o"]


def test_what_another_run_is_writing_is_not_cleared(tmp_path):
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("first")
        with atomic_write(tmp_path / "a.txt") as other:
            other.write_text("second")
        assert part.read_text() == "first"
    assert (tmp_path / "a.txt").read_text() == "first"
    assert names(tmp_path) == ["a.txt"]


def test_other_hidden_files_stay(tmp_path):
    kept = [".a.txt.part", ".a.txt.0000000g.part", ".b.txt.00000000.part", "a.txt.00000000.part"]
    for name in kept:
        (tmp_path / name).mkdir()
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("new")
    assert names(tmp_path) == sorted([*kept, "a.txt"])


def test_a_killed_report_does_not_lock_the_folder_of_a_heat_map(tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "a").write_text("old")
    killed(FILE, tmp_path / "o" / "report.html")
    with atomic_folder(tmp_path / "o", owned=("a",)) as part:
        (part / "a").write_text("new")
    assert names(tmp_path / "o") == ["a"]


def test_a_folder_into_which_another_run_writes_is_not_replaced(tmp_path):
    (tmp_path / "o").mkdir()
    with atomic_write(tmp_path / "o" / "report.html") as part:
        part.write_text("report")
        with (
            pytest.raises(OutputError, match="another run is writing into it"),
            atomic_folder(tmp_path / "o", owned=("a",)),
        ):
            pass
    assert names(tmp_path / "o") == ["report.html"]


def test_a_kill_between_two_renames_hides_nothing_for_good(tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "a").write_text("old")
    killed(BETWEEN, tmp_path / "o")
    assert not (tmp_path / "o").exists()
    with pytest.raises(RuntimeError), atomic_folder(tmp_path / "o", owned=("a",)):
        raise RuntimeError
    assert (tmp_path / "o" / "a").read_text() == "old"
    assert names(tmp_path) == ["o"]


@pytest.mark.parametrize("moved", [0, 1, 2])
@pytest.mark.parametrize("before", [False, True])
def test_several_files_are_whole_after_the_next_run(tmp_path, moved, before):
    """The file that is asked for comes last, so that it is there only with those beside it."""
    trio = ["road.gpkg", "road.json", "road.laz"]
    for name in trio if before else ():
        (tmp_path / name).write_text("old")
    killed(SEVERAL, tmp_path / "road.laz", moved)
    there = tmp_path / "road.laz"
    assert (there.read_text() == "old") if before else (not there.exists())
    with pytest.raises(RuntimeError), atomic_writes(there):
        raise RuntimeError
    assert names(tmp_path) == trio
    assert {(tmp_path / name).read_text() for name in trio} == {"new"}


def test_a_folder_that_cannot_be_made_is_named_and_a_new_one_stays_only_if_all_goes_well(tmp_path):
    with (
        pytest.raises(OutputError, match="cannot be written"),
        folder_to_fill(tmp_path / ("x" * 300)),
    ):
        pass
    with pytest.raises(RuntimeError), folder_to_fill(tmp_path / "a/b"):
        raise RuntimeError
    assert names(tmp_path) == []
    with folder_to_fill(tmp_path / "a/b"):
        pass
    assert (tmp_path / "a/b").is_dir()


def test_a_plan_moves_nothing_elsewhere(tmp_path):
    private = tmp_path / ".a.00000000.part"
    private.mkdir()
    (private / "a").write_text("hostile")
    (private / leftovers.LOCK_NAME).write_text("\n")
    (private / leftovers.PLAN).write_text(json.dumps([["a", str(tmp_path / "sub" / "a")]]))
    (tmp_path / "sub").mkdir()
    with atomic_write(tmp_path / "a") as part:
        part.write_text("new")
    assert names(tmp_path / "sub") == []


def test_temporary_files_of_killed_runs_go(tmp_path, monkeypatch):
    killed(SCRATCH, tmp_path)
    assert len(names(tmp_path)) == 1
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder() as one, scratch_folder() as other:
        assert names(tmp_path) == sorted([one.name, other.name])
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    "name", ["gis_radar_results", "gis_radar_0123abcd", leftovers.SCRATCH + "mine"]
)
@pytest.mark.parametrize("held", ["mine.txt", leftovers.PLAN])
def test_what_others_keep_among_temporary_files_stays(tmp_path, monkeypatch, name, held):
    (tmp_path / name).mkdir()
    (tmp_path / name / held).write_text("mine")
    os.utime(tmp_path / name, (1.0, 1.0))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder():
        pass
    assert (tmp_path / name / held).read_text() == "mine"


def test_a_plan_among_temporary_files_moves_nothing(tmp_path, monkeypatch):
    """Anybody may write there."""
    private = tmp_path / f"{leftovers.SCRATCH}0123abcd"
    private.mkdir()
    (tmp_path / "mine").write_text("mine")
    (private / "mine").write_text("hostile")
    (private / leftovers.LOCK_NAME).write_text("\n")
    (private / leftovers.PLAN).write_text(json.dumps([["mine", str(tmp_path / "mine")]]))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder():
        pass
    assert (tmp_path / "mine").read_text() == "mine"
    assert names(tmp_path) == ["mine"]


def test_a_folder_that_is_being_made_is_not_cleared(tmp_path):
    """Another run looks between the two steps: the file is there, its lock is not yet held."""
    private = tmp_path / ".a.00000000.part"
    private.mkdir()
    handle = os.open(private / leftovers.LOCK_NAME, os.O_RDWR | os.O_CREAT)
    try:
        leftovers.clear_abandoned(tmp_path, leftovers.PRIVATE)
        assert private.exists()
    finally:
        os.close(handle)


@pytest.mark.parametrize("locked", [False, True])
def test_a_run_that_was_killed_while_it_made_its_folder_leaves_nothing(tmp_path, locked):
    """Who writes a folder holds its lock: nobody else is making one just now."""
    private = tmp_path / ".a.00000000.part"
    private.mkdir()
    if locked:
        (private / leftovers.LOCK_NAME).touch()
    with atomic_folder(tmp_path / "a", owned=("a",)) as part:
        (part / "a1").write_text("new")
    assert names(tmp_path) == ["a"]


AS_MADE = (
    "def look(event, words):\n"
    "    if event == 'os.mkdir':\n        print('filelock' in sys.modules)\n"
    "sys.addaudithook(look)\n"
    "with getattr(files, sys.argv[2])(*[place][: int(sys.argv[3])]):\n    pass\n"
)


@pytest.mark.parametrize(("writer", "words"), [("atomic_writes", 1), ("scratch_folder", 0)])
def test_what_locks_a_folder_is_loaded_before_it_is_made(tmp_path, writer, words):
    """Who is killed in between leaves it for a minute."""
    command = [sys.executable, "-c", BEGIN + AS_MADE, tmp_path / "a", writer, str(words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == ["True"]


def test_a_file_that_was_never_begun_goes_after_a_minute(tmp_path):
    private = tmp_path / ".a.00000000.part"
    private.mkdir()
    for age_s, left in (30.0, [private.name, "a"]), (90.0, ["a"]):
        os.utime(private, (time.time() - age_s,) * 2)
        with atomic_write(tmp_path / "a") as part:
            part.write_text("new")
        assert names(tmp_path) == left


def test_a_run_that_can_open_no_more_files_clears_nothing(tmp_path, monkeypatch):
    """Whether somebody writes there cannot be told then."""
    private = tmp_path / ".a.00000000.part"
    private.mkdir()
    (private / leftovers.LOCK_NAME).write_text("\n")
    os.utime(private, (time.time() - 3600.0,) * 2)

    def refuse(*_, **__):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(leftovers.os, "open", refuse)
    assert not leftovers.is_abandoned(private)
    monkeypatch.undo()
    assert leftovers.is_abandoned(private)


def test_a_look_of_another_run_does_not_cost_the_lock(tmp_path):
    """The look holds the lock for a moment; the owner waits for it."""
    (tmp_path / leftovers.LOCK_NAME).touch()
    handle = os.open(tmp_path / leftovers.LOCK_NAME, os.O_RDWR)
    assert lock_descriptor(handle, blocking=False)
    threading.Timer(0.1, os.close, [handle]).start()
    with leftovers.hold_lock(tmp_path):
        assert not leftovers.is_abandoned(tmp_path)
    assert leftovers.is_abandoned(tmp_path)


@pytest.mark.parametrize("length", [200, 231, 232, 240, 255])
def test_names_of_every_legal_length(tmp_path, length):
    name = "x" * (length - 4) + ".txt"
    with atomic_write(tmp_path / name) as part:
        part.write_text("new")
    with atomic_folder(tmp_path / f"y{name[1:]}", owned=("a",)) as part:
        (part / "a").write_text("new")
    assert names(tmp_path) == [name, f"y{name[1:]}"]


LOOP = (
    "import sys; from pathlib import Path; from gis_radar.base import files\n"
    "place = Path(sys.argv[1])\nprint('ready', flush=True)\nnumber = 0\n"
    "while True:\n"
    "    number += 1\n"
    "    with files.atomic_folder(place, owned=('a',)) as part:\n"
    "        for name in ('a1', 'a2', 'a3'):\n"
    "            (part / name).write_text(str(number) * 1000)\n"
)


def test_kills_at_any_moment(tmp_path):
    """Kills of a writer that never pauses: its folder is whole, and the next one begins."""
    chance = random.Random(4)  # noqa: S311 - moments
    place = tmp_path / "o"
    for _ in range(8):
        child = subprocess.Popen(
            [sys.executable, "-c", LOOP, str(place)], stdout=subprocess.PIPE, cwd=ROOT
        )
        with child:
            child.stdout.readline()
            time.sleep(chance.uniform(0.0, 0.15))
            child.kill()
        if place.exists():
            texts = {path.read_text() for path in place.iterdir()}
            assert len(texts) == 1
            assert len(names(place)) == 3
    with atomic_folder(place, owned=("a",)) as part:
        (part / "a1").write_text("end")
    assert names(tmp_path) == ["o"]


class OfLibraryError(RuntimeError):
    pass


@pytest.mark.parametrize("module", ["pyogrio.errors", "lazrs", "rasterio._err", "sqlite3"])
def test_what_libraries_raise_that_write_names_the_output(tmp_path, monkeypatch, module):
    monkeypatch.setattr(OfLibraryError, "__module__", module)
    odd = pytest.raises(OutputError, match=r"a: cannot be written: odd$")
    with odd, atomic_write(tmp_path / "a"):
        raise OfLibraryError("odd\nmore")
    full = pytest.raises(OutputError, match="a: cannot be written: the disk is full")
    with full, atomic_write(tmp_path / "a"):
        raise OfLibraryError("sqlite3_exec(...) failed: database or disk is full")
    monkeypatch.setattr(files, "LEAST_FREE", 1 << 62)
    with full, atomic_write(tmp_path / "a"):
        raise OfLibraryError("something went wrong")


def test_an_error_of_ours_or_of_a_reader_stays(tmp_path):
    with pytest.raises(OfLibraryError), writing_errors(tmp_path):
        raise OfLibraryError("no writer")
    with pytest.raises(OutputError, match=r"^ours$"), writing_errors(tmp_path):
        raise OutputError("ours")


def test_the_folder_of_a_stranger_is_left_alone(tmp_path):
    """A private folder without a lock is of an earlier version: it goes after a day."""
    private = tmp_path / ".a.00000000.part"
    private.mkdir()
    with atomic_write(tmp_path / "a") as part:
        part.write_text("new")
    assert private.exists()
    os.utime(private, (1.0, 1.0))
    with atomic_write(tmp_path / "a") as part:
        part.write_text("new")
    assert names(tmp_path) == ["a"]
