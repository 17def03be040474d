"""State files of the live system: a fault costs a line in the log, never the program."""

import errno
from pathlib import Path

import pytest
from live_programs import Lines

from gis_radar.live.state_file import StateFile


def test_what_was_written_is_read_again(tmp_path):
    StateFile(tmp_path / "a.json").write({"R1": 3})
    assert StateFile(tmp_path / "a.json").read({}, dict) == {"R1": 3}
    assert StateFile(tmp_path / "b.json").read({"R1": 0}, dict) == {"R1": 0}


@pytest.mark.parametrize("text", ["", "{", "[1]", '"\\ud800"', "[" * 100_000, '{"R1": 1e999}'])
def test_a_damaged_file_is_put_aside(tmp_path, text):
    said, path = Lines(), tmp_path / "a.json"
    path.write_text(text)
    check = lambda found: {name: int(each) for name, each in found.items()}  # noqa: E731
    assert StateFile(path, reporter=said).read({}, check) == {}
    (aside,) = tmp_path.iterdir()
    assert aside.read_text() == text
    assert said.lines == [f"{path}: it is damaged, and put aside as {aside.name}"]


def test_a_disk_that_fails_midway_is_told(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise OSError(errno.EIO, "Input/output error")

    said = Lines()
    monkeypatch.setattr(Path, "write_text", fails)
    StateFile(tmp_path / "a.json", reporter=said).write(1)
    assert said.lines == [f"{tmp_path / 'a.json'}: cannot be written: Input/output error"]


def test_a_fault_of_writing_is_told_once(tmp_path):
    said, folder = Lines(), tmp_path / "gone"
    file = StateFile(folder / "a.json", reporter=said)
    file.write(1)
    file.write(2)
    assert len(said.lines) == said.told("a.json: cannot be written") == 1
    folder.mkdir()
    file.write(3)
    assert file.read(0, int) == 3
