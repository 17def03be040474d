"""Where memory runs short, one line says so, whatever was in want of it."""

import pytest

import gis_radar as gr
from gis_radar.base import InputError, OutputError, scratch_folder
from gis_radar.cli import console
from gis_radar.cli.console import NO_MEMORY


@pytest.fixture
def ends_by(run, monkeypatch, tmp_path):
    """Give a function that runs a command in which an error is raised."""

    def call(error, *words):
        def breaks(*_, **__):
            raise error

        monkeypatch.setattr(gr, "sample_folder", breaks)
        return run("sample", "-o", tmp_path / "sample", *words)

    return call


@pytest.mark.parametrize(
    "error",
    [MemoryError(), ImportError("a.so: failed to map segment from shared object"),
     RuntimeError("can't start new thread"), OSError("Could not find libllvmlite.so")],
    ids=lambda error: type(error).__name__,
)  # fmt: skip
def test_what_is_raised_for_want_of_memory(ends_by, error):
    code, _, said = ends_by(error)
    assert code == OutputError.exit_code
    assert said.startswith(f"gis-radar: {NO_MEMORY}")


def test_a_file_that_is_called_damaged_for_want_of_memory(ends_by):
    error = InputError("a.gpkg: damaged: malloc of size 64 failed")
    error.__cause__ = ValueError()
    error.__cause__.__cause__ = MemoryError()
    code, said, _ = ends_by(error, "--json")
    assert code == InputError.exit_code
    assert f"{NO_MEMORY}, or the file claims too much" in said


def test_no_memory_for_the_message(ends_by, monkeypatch):
    def fail(*_):
        raise MemoryError

    monkeypatch.setattr(console.JsonConsole, "error", fail)
    code, _, said = ends_by(InputError("a"), "--json")
    assert code == InputError.exit_code
    assert said == f"gis-radar: {NO_MEMORY}\n"


def test_no_place_for_temporary_files(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(OutputError, match="/missing: cannot be written"), scratch_folder():
        pass
