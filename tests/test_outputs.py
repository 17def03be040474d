import errno
import json
import math
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from maps import Listener
from pyogrio.errors import DataLayerError
from rasterio.errors import RasterioIOError

from gis_radar.base import (
    OutputError,
    atomic_folder,
    atomic_write,
    json_text,
    only_writer,
    refuse_inputs,
)


def contents(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_a_file_appears_whole(tmp_path):
    with atomic_write(tmp_path / "a.txt") as part:
        part.write_text("new")
        assert not (tmp_path / "a.txt").exists()
        assert stat.S_IMODE(part.parent.stat().st_mode) == 0o700  # passwords are written, too
    assert (tmp_path / "a.txt").read_text() == "new"
    assert contents(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failed_file_leaves_the_old_one(tmp_path, error):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(error), atomic_write(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise error
    assert (tmp_path / "a.txt").read_text() == "old"
    assert contents(tmp_path) == ["a.txt"]


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    for text in ("one", "two"):
        with atomic_folder(tmp_path / "map", owned=("heat",)) as part:
            (part / f"heat-{text}").write_text(text)
    assert contents(tmp_path) == ["map", "map/heat-two"]


def test_a_failed_folder_leaves_the_old_one(tmp_path):
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "heat").write_text("old")
    with (
        pytest.raises(KeyboardInterrupt),
        atomic_folder(tmp_path / "map", owned=("heat",)) as part,
    ):
        (part / "heat").write_text("half")
        raise KeyboardInterrupt
    assert contents(tmp_path) == ["map", "map/heat"]
    assert (tmp_path / "map" / "heat").read_text() == "old"


def test_foreign_files_are_not_replaced(tmp_path):
    (tmp_path / "thesis.doc").write_text("years of work")
    with (
        pytest.raises(OutputError, match=r"thesis\.doc"),
        atomic_folder(tmp_path, owned=("heat",)),
    ):
        pass
    assert contents(tmp_path) == ["thesis.doc"]


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), atomic_write(tmp_path / "no" / "a"):
        pass
    with pytest.raises(OutputError, match="is a folder"), atomic_write(tmp_path):
        pass
    with pytest.raises(OutputError, match="is a file"), atomic_folder(tmp_path / "file", owned=()):
        pass


@pytest.fixture
def earlier(tmp_path):
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "heat").write_text("old")
    return tmp_path / "map"


def stop_renames(monkeypatch, error, *, after, done):
    """Let `after` renames pass, then fail once: before the next one happens, or behind it."""
    rename, calls = Path.rename, []

    def stopping(self, target):
        calls.append(target)
        if len(calls) != after + 1:
            return rename(self, target)
        if done:
            rename(self, target)
        raise error

    monkeypatch.setattr(Path, "rename", stopping)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(16, "Device or resource busy")])
@pytest.mark.parametrize(
    ("after", "done", "left"),
    [(0, False, "old"), (0, True, "old"), (1, False, "old"), (1, True, "new")],
)
def test_an_earlier_folder_outlives_a_stopped_move(earlier, monkeypatch, error, after, done, left):
    stop_renames(monkeypatch, error, after=after, done=done)
    expected = KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else OutputError
    with pytest.raises(expected), atomic_folder(earlier, owned=("heat",)) as part:
        (part / "heat").write_text("new")
    assert contents(earlier.parent) == ["map", "map/heat"]
    assert (earlier / "heat").read_text() == left


def test_the_working_folder_is_not_replaced(earlier, monkeypatch):
    monkeypatch.chdir(earlier)
    for name in (".", "", "..", "../map"):
        with (
            pytest.raises(OutputError, match=r"is the folder you are in|is not part of"),
            atomic_folder(Path(name), owned=("heat", "map")),
        ):
            pass
    assert contents(earlier.parent) == ["map", "map/heat"]


def test_a_relative_folder_lies_where_the_program_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with atomic_folder(Path("a") / ".." / "map", owned=()) as part:
        (part / "heat").write_text("new")
    assert contents(tmp_path) == ["map", "map/heat"]


def test_a_file_that_cannot_be_moved_is_named(tmp_path, monkeypatch):
    def busy(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "replace", busy)
    with (
        pytest.raises(OutputError, match=r"a\.txt: cannot be written: Permission denied"),
        atomic_write(tmp_path / "a.txt") as part,
    ):
        part.write_text("new")
    assert contents(tmp_path) == []


def test_an_input_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "in").mkdir()
    source = tmp_path / "in" / "r.parquet"
    source.write_text("rows")
    (tmp_path / "link").symlink_to(source)
    (tmp_path / "twin").hardlink_to(source)
    monkeypatch.chdir(tmp_path)
    for output in (source, "in/r.parquet", "in/../in/r.parquet", "link", "twin", "in", "."):
        with pytest.raises(OutputError, match=r"would replace the input .*r\.parquet"):
            refuse_inputs(output, tmp_path / "gone", source)
    for output in ("new.parquet", "in/other", "in/r.gpkg"):
        refuse_inputs(output, source, "gone")


def test_two_runs_do_not_write_one_folder(tmp_path):
    with atomic_folder(tmp_path / "o", owned=("a",)) as part:
        (part / "a").write_text("first")
        with (
            pytest.raises(OutputError, match="o: another run is writing it"),
            atomic_folder(tmp_path / "o", owned=("a",)),
        ):
            pass
        with atomic_folder(tmp_path / "p", owned=("a",)):
            pass
    assert (tmp_path / "o" / "a").read_text() == "first"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["o", "p"]


def test_another_process_holds_the_lock(tmp_path):
    code = (
        "import sys; from pathlib import Path; from gis_radar.base.files import atomic_folder\n"
        "with atomic_folder(Path(sys.argv[1]), owned=()): print('in', flush=True); input()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, tmp_path / "o"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    with other:
        assert other.stdout.readline().strip() == b"in"
        with (
            pytest.raises(OutputError, match=f"another run .* .process {other.pid}"),
            atomic_folder(tmp_path / "o", owned=()),
        ):
            pass
        other.kill()
    with atomic_folder(tmp_path / "o", owned=()):
        pass


def test_an_interruption_of_the_clearing_up_leaves_nothing(tmp_path):
    """A worker whose parent dies is stopped twice: by the broken pipe and by the watchdog."""
    code = (
        "import shutil, sys; from pathlib import Path\n"
        "from gis_radar.base import atomic_folder\n"
        "remove, told = shutil.rmtree, []\n"
        "def rmtree(*words, **options):\n"
        "    if not told:\n"
        "        told.append(1)\n"
        "        raise KeyboardInterrupt\n"
        "    remove(*words, **options)\n"
        "shutil.rmtree = rmtree\n"
        "with atomic_folder(Path(sys.argv[1]), owned=()) as part:\n"
        "    (part / 'half').touch()\n"
        "    raise BrokenPipeError\n"
    )
    words = [sys.executable, "-c", code, tmp_path / "o"]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[1]
    )
    assert "KeyboardInterrupt" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError("Error writing bytes to file. Detail: [errno 28] No space left on device"),
        RasterioIOError("TIFFAppendToStrip:Write error at scanline 4294967295"),
        DataLayerError("sqlite3_exec(ROLLBACK) failed: cannot rollback - no transaction is active"),
    ],
)
def test_a_full_disk_is_said_and_leaves_nothing(tmp_path, error):
    place = tmp_path / "o"
    said = pytest.raises(OutputError, match="o: cannot be written: the disk is full")
    with said, atomic_folder(place, owned=()) as part:
        (part / "half").write_text("half")
        raise error
    with said, atomic_write(place):
        raise error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    lock = tmp_path / "gone" / "lock"
    with (
        pytest.raises(OutputError, match="o: cannot be written: No such file or directory"),
        only_writer(tmp_path / "o", lock=lock),
    ):
        pass


def test_a_file_system_without_locks_is_said(tmp_path, monkeypatch):
    said = Listener()

    def refuse(_, *, blocking):
        raise OSError(errno.ENOTSUP, "Operation not supported")

    monkeypatch.setattr("filelock.lock_descriptor", refuse)
    with only_writer(tmp_path / "o", reporter=said):
        pass
    with atomic_folder(tmp_path / "p", owned=(), reporter=said):
        pass
    assert said.messages == [
        ("warning", f"{tmp_path / name}: cannot be locked: Operation not supported")
        for name in ("o", "p")
    ]


@given(st.recursive(st.none() | st.integers() | st.floats() | st.text(), lambda each: (
    st.lists(each) | st.dictionaries(st.text(), each) | st.tuples(each, each)
), max_leaves=10))  # fmt: skip
def test_json_holds_finite_numbers_and_null_only(document):
    def refuse(constant):
        raise AssertionError(constant)

    def numbers(value):
        if isinstance(value, dict | list | tuple):
            inner = value.values() if isinstance(value, dict) else value
            return [each for part in inner for each in numbers(part)]
        finite = not isinstance(value, float) or math.isfinite(value)
        return [value if finite else None]

    found = json.loads(json_text(document), parse_constant=refuse)
    assert numbers(found) == numbers(document)
