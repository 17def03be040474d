"""Where memory runs short, one line says so, whatever was in want of it."""

import pytest

from gis_radar.cli import console
from gis_radar.cli.console import NO_MEMORY, JsonConsole, _error_of, _fail
from gis_radar.errors import InputError, OutputError
from gis_radar.files import scratch_folder


@pytest.mark.parametrize(
    "error",
    [MemoryError(), ImportError("a.so: failed to map segment from shared object"),
     RuntimeError("can't start new thread"), OSError("Could not find libllvmlite.so")],
    ids=lambda error: type(error).__name__,
)  # fmt: skip
def test_what_is_raised_for_want_of_memory(error):
    found = _error_of(error)
    assert isinstance(found, OutputError)
    assert found.message == NO_MEMORY


def test_a_file_that_is_called_damaged_for_want_of_memory(capsys):
    error = InputError("a.gpkg: damaged: malloc of size 64 failed")
    error.__cause__ = ValueError()
    error.__cause__.__cause__ = MemoryError()
    with pytest.raises(SystemExit) as left:
        _fail(JsonConsole(), error)
    assert left.value.code == 3
    assert f"{NO_MEMORY}, or the file claims too much" in capsys.readouterr().out


def test_no_memory_for_the_message(capfd, monkeypatch):
    def fail(*_):
        raise MemoryError

    monkeypatch.setattr(console.JsonConsole, "error", fail)
    with pytest.raises(SystemExit) as left:
        _fail(JsonConsole(), InputError("a"))
    assert left.value.code == 3
    assert capfd.readouterr().err == f"gis-radar: {NO_MEMORY}\n"


def test_no_place_for_temporary_files(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(OutputError, match="/missing: cannot be written"), scratch_folder():
        pass
