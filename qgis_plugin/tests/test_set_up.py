"""'Set up the worker': an environment made from inside QGIS, whole or not at all."""

import os
import time
import zipfile
from pathlib import Path

import pytest
from conftest import VERSION
from helpers import Feedback, algorithm, one_sentence
from qgis.core import QgsApplication, QgsSettings

MAIN = "print('gis_radar')\n"
UV = Path(os.environ.get("GIS_RADAR_UV", "/nonexistent"))


def wheel(folder, version=VERSION, main=MAIN, needs=""):
    """Write a wheel called gis_radar that needs nothing from a network."""
    path = folder / f"gis_radar-{version}-py3-none-any.whl"
    info = f"gis_radar-{version}.dist-info"
    head = f"Metadata-Version: 2.1\nName: gis-radar\nVersion: {version}\n{needs}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("gis_radar/__init__.py", "")
        archive.writestr("gis_radar/__main__.py", main)
        archive.writestr(f"{info}/METADATA", head)
        archive.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        archive.writestr(f"{info}/RECORD", "")
    return path


@pytest.fixture
def profile(tmp_path, monkeypatch):
    """A profile without a worker, whose folder has a space and an umlaut."""
    folder = tmp_path / "Mein Prüfprofil"
    for place in ("base", "algorithms.set_up"):
        monkeypatch.setattr(f"gis_radar_plugin.{place}.profile_folder", lambda: folder)
    monkeypatch.delenv("GIS_RADAR_PYTHON")
    yield folder
    QgsSettings().remove("gis_radar/worker_python")


@pytest.fixture(params=["venv", "uv"])
def tools(request, monkeypatch):
    """With and without uv on the path."""
    if request.param == "venv":
        monkeypatch.setattr("gis_radar_plugin.installer.shutil.which", lambda _name: None)
    elif not UV.is_file():
        pytest.skip("uv is not installed")
    else:
        monkeypatch.setenv("PATH", f"{UV.parent}:{os.environ['PATH']}")
    return request.param


def test_a_worker_is_made(run, profile, tmp_path, tools):
    assert algorithm("heatmap").canExecute()[0] is False
    results, heard = run("setupworker", {"PACKAGE": str(wheel(tmp_path))})
    assert heard.errors == []
    assert results["VERSION"] == VERSION
    assert Path(results["WORKER"]) == profile / "gis_radar" / "worker" / "bin" / "python"
    assert algorithm("heatmap").canExecute() == (True, "")
    assert heard.percents[-1] == 100
    assert heard.stages[:2] == ["Making an environment", "Fetching gis_radar and what it needs"]
    assert f"The worker is ready: gis_radar {VERSION}." in heard.infos
    assert [path.name for path in (profile / "gis_radar").iterdir()] == ["worker"]


def test_an_earlier_worker_survives_a_failure(run, profile, tmp_path, monkeypatch):
    mark = profile / "gis_radar" / "worker" / "mark"
    mark.parent.mkdir(parents=True)
    mark.touch()
    bad = wheel(tmp_path, needs="Requires-Python: >=9\n")
    results, heard = run("setupworker", {"PACKAGE": str(bad)})
    assert results is None
    assert "different Python" in one_sentence(heard)
    assert mark.exists()
    # by uv where it is there: a second environment by pip takes seconds and shows no more
    monkeypatch.setenv("PATH", f"{UV.parent}:{os.environ['PATH']}")
    broken = wheel(tmp_path, main="raise SystemExit('a library is missing')")
    results, heard = run("setupworker", {"PACKAGE": str(broken)})
    assert results is None
    assert "a library is missing" in one_sentence(heard)
    assert mark.exists()
    assert [path.name for path in (profile / "gis_radar").iterdir()] == ["worker"]


def test_cancel(run, profile, tmp_path):
    results, heard = run(
        "setupworker", {"PACKAGE": str(wheel(tmp_path))}, feedback=Feedback(cancel_after=1)
    )
    assert results is None
    assert one_sentence(heard) == "Cancelled; nothing was left half-written."
    assert list((profile / "gis_radar").iterdir()) == []


def test_cancel_of_a_tool_that_does_not_listen(run, profile, tmp_path):
    """Neither pip nor venv notices that its standard input ends: it is ended within a second."""
    from gis_radar_plugin.installer import GRACE_S, Tools, set_up
    from gis_radar_plugin.runner import CancelledError, Listener

    python = tmp_path / "python"
    python.write_text("#!/usr/bin/python3\nimport time\ntime.sleep(600)\n")
    python.chmod(0o755)

    class Stopped(Listener):
        def cancelled(self):
            return time.monotonic() - began > 0.5

    began = time.monotonic()
    with pytest.raises(CancelledError):
        set_up(profile / "worker", "no.whl", Tools(str(python), ""), Stopped())
    assert GRACE_S < 0.5
    assert time.monotonic() - began < 60.0  # on a machine that is busy
    assert list(profile.iterdir()) == []


def test_without_a_package(run, profile):
    results, heard = run("setupworker", {})
    assert results is None
    assert "choose its wheel" in one_sentence(heard)


def test_a_python_that_is_ready(run, profile, fake_worker):
    python = str(fake_worker(""))
    os.environ.pop("GIS_RADAR_PYTHON")
    results, heard = run("setupworker", {"READY": python})
    assert heard.errors == []
    assert results == {"WORKER": python, "VERSION": VERSION}
    assert algorithm("heatmap").canExecute() == (True, "")
    assert not profile.exists()


def test_a_python_that_is_not(run, profile):
    results, heard = run("setupworker", {"READY": "/usr/bin/python3"})
    assert results is None
    assert one_sentence(heard) == "/usr/bin/python3 has no gis_radar"
    assert algorithm("heatmap").canExecute()[0] is False


def test_a_profile_that_cannot_be_written(run, profile, tmp_path, monkeypatch):
    nowhere = Path("/proc/gis_radar")
    monkeypatch.setattr("gis_radar_plugin.algorithms.set_up.profile_folder", lambda: nowhere)
    results, heard = run("setupworker", {"PACKAGE": str(wheel(tmp_path))})
    assert results is None
    assert "/proc/gis_radar" in one_sentence(heard)


def test_the_profile_is_qgis_own(provider):
    from gis_radar_plugin.base import profile_folder

    assert profile_folder() == Path(QgsApplication.qgisSettingsDirPath())
