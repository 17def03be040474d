"""After `kill -9`: the old result or the new one, nothing in the way, nobody locked out."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gis_radar.base import (
    OutputError,
    atomic_folder,
    atomic_write,
    atomic_writes,
    clear_leftovers,
    files,
    folder_to_fill,
    replacing_folder,
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
    "replace = Path.replace\ncalls = []\n"
    "def stopping(part, target):\n"
    "    stop() if len(calls) == int(sys.argv[2]) else replace(part, target)\n"
    "    calls.append(1)\n"
    "Path.replace = stopping\n"
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


def age(folder, hours=25.0):
    """Give all in a folder the time of so many hours ago."""
    for path in folder.rglob("*"):
        os.utime(path, (time.time() - 3600.0 * hours,) * 2)


def test_what_a_killed_run_left_of_a_file_is_cleared_after_a_day(tmp_path):
    killed(FILE, tmp_path / "a.txt")
    (left,) = names(tmp_path)
    for hours, expected in (23.0, [left, "a.txt"]), (25.0, ["a.txt"]):
        age(tmp_path, hours)
        with atomic_write(tmp_path / "a.txt") as part:
            part.write_text("new")
        assert names(tmp_path) == expected


def test_what_is_written_for_days_is_not_cleared(tmp_path):
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("half")
        age(tmp_path)
        part.write_text("whole")
        with atomic_write(tmp_path / "a.txt") as other:
            other.write_text("other")
    assert (tmp_path / "a.txt").read_text() == "whole"


def test_the_next_run_clears_what_a_killed_one_left_of_a_folder(tmp_path):
    """It is the only writer: what lies beside the folder is of a killed one."""
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
    kept = [".a.txt.part", ".a.txt.000000000.part", ".b.txt.00000000.part", "a.txt.00000000.part"]
    for name in kept:
        (tmp_path / name).mkdir()
    age(tmp_path)
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("new")
    assert names(tmp_path) == sorted([*kept, "a.txt"])


def test_leftovers_within_a_leftover_keep_no_other_one(tmp_path):
    """As of a dataset that was being made anew in a folder of results."""
    nested = ".b.00000000.part/new/b/.c.00000000.part"
    for name in ("a/.e.00000000.part", nested, "d/.e.00000000.part"):
        (tmp_path / "o" / name).mkdir(parents=True)
    clear_leftovers(tmp_path / "o")
    assert sorted(path.name for path in (tmp_path / "o").rglob("*")) == ["a", "d"]


def test_a_killed_report_does_not_lock_the_folder_of_a_heat_map(tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "a").write_text("old")
    killed(FILE, tmp_path / "o" / "report.html")
    with atomic_folder(tmp_path / "o", owned=("a",)) as part:
        (part / "a").write_text("new")
    assert names(tmp_path / "o") == ["a"]


def test_a_kill_between_two_renames_is_mended_by_the_same_command(tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "a").write_text("old")
    killed(BETWEEN, tmp_path / "o")
    assert not (tmp_path / "o").exists()
    with atomic_folder(tmp_path / "o", owned=("a",)) as part:
        (part / "a").write_text("new")
    assert (tmp_path / "o" / "a").read_text() == "new"
    assert names(tmp_path) == ["o"]


def test_a_replacement_killed_between_two_renames_is_finished_by_the_next_call(tmp_path):
    """Also where that call writes the folder around it."""
    place = tmp_path / "results" / "o"
    place.mkdir(parents=True)
    (place / "a").write_text("old")
    killed(BETWEEN, place)
    clear_leftovers(tmp_path / "results")
    assert (place / "a").read_text() == "new"
    assert names(place.parent) == [".o.lock", "o"]


@pytest.mark.parametrize("moved", [0, 1, 2])
@pytest.mark.parametrize("before", [False, True])
def test_several_files_are_whole_after_the_same_command(tmp_path, moved, before):
    """The file that is asked for comes last, so that it is there only with those beside it."""
    trio = ["road.gpkg", "road.json", "road.laz"]
    for name in trio if before else ():
        (tmp_path / name).write_text("old")
    killed(SEVERAL, tmp_path / "road.laz", moved)
    there = tmp_path / "road.laz"
    assert (there.read_text() == "old") if before else (not there.exists())
    age(tmp_path)
    with atomic_writes(there) as (private, places):
        for name in trio:
            (private / name).write_text("new")
            places[private / name] = tmp_path / name
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


def test_temporary_files_of_killed_runs_go(tmp_path, monkeypatch):
    killed(SCRATCH, tmp_path)
    assert len(names(tmp_path)) == 1
    age(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder() as one, scratch_folder() as other:
        assert names(tmp_path) == sorted([one.name, other.name])
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["gis_radar-scratch", "gis_radar_0123abcd", ".gis_radar.mine"])
def test_what_others_keep_among_temporary_files_stays(tmp_path, monkeypatch, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "mine.txt").write_text("mine")
    age(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with scratch_folder():
        pass
    assert (tmp_path / name / "mine.txt").read_text() == "mine"


def test_nothing_is_removed_through_a_link(tmp_path):
    """Anybody may make one among temporary files."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a").write_text("mine")
    (tmp_path / ".o.00000000.part").symlink_to(tmp_path / "mine")
    with replacing_folder(tmp_path / "o"):
        pass
    assert names(tmp_path / "mine") == ["a"]


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
