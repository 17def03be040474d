"""PDAL found and run. Stand-ins are shell scripts; the fixture `pdal` is the real one."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pytest
from maps import Listener
from pyproj import CRS
from waiting import wait_for

from gis_radar.base import GisRadarError, InputError, OutputError, transformer
from gis_radar.scans import find_pdal
from gis_radar.scans.pdal import INSTALL_HINT, VARIABLE

needs_sh = pytest.mark.skipif(os.name == "nt", reason="stand-ins are shell scripts")


def make_program(path, body="", version="2.6.1"):
    """Write a stand-in that tells a version and then does what `body` says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    answer = f'[ "$1" = --version ] && echo "pdal {version} (git-version: x)" && exit\n'
    path.write_text(f"#!/bin/sh\n{answer}{body}\n")
    path.chmod(0o755)
    return path


def make_scan(path, *, epsg=25832, count=400, seed=1):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [0.001] * 3
    header.offsets = [600_000, 5_400_000, 0]
    if epsg:
        header.add_crs(CRS.from_epsg(epsg))
    scan = laspy.LasData(header)
    rng = np.random.default_rng(seed)
    scan.x = 600_000 + rng.uniform(0, 20, count)
    scan.y = 5_400_000 + rng.uniform(0, 20, count)
    scan.z = 100 + rng.uniform(0, 1, count)
    scan.write(path)
    return scan


def from_to(source, target, *stages):
    writer = {"type": "writers.las", "filename": str(target)}
    return {"pipeline": [str(source), *stages, writer]}


@pytest.fixture
def stand_in(no_pdal, tmp_path, monkeypatch):
    """Give a function that makes a stand-in the only PDAL, and finds it."""

    def make(body):
        monkeypatch.setenv(VARIABLE, str(make_program(tmp_path / "stand-in" / "pdal", body)))
        return find_pdal()

    return make


# Finding


def test_none_is_none(no_pdal):
    assert find_pdal() is None
    assert "conda" in INSTALL_HINT
    assert "apt-get" in INSTALL_HINT
    assert "\n" not in INSTALL_HINT


@needs_sh
def test_the_order(tmp_path, monkeypatch):
    named, beside, path = (tmp_path / each / "pdal" for each in ("named", "beside", "path"))
    for program, version in ((named, "2.3.0"), (beside, "2.4.0"), (path, "2.5.0")):
        make_program(program, version=version)
    monkeypatch.setenv(VARIABLE, str(named))
    monkeypatch.setattr(sys, "executable", str(beside.parent / "python"))
    monkeypatch.setenv("PATH", str(path.parent))
    assert find_pdal().name == "PDAL 2.3.0"
    monkeypatch.delenv(VARIABLE)
    assert find_pdal().name == "PDAL 2.4.0"
    beside.unlink()
    assert find_pdal().name == "PDAL 2.5.0"
    assert find_pdal().version == (2, 5, 0)


@needs_sh
@pytest.mark.parametrize(
    ("text", "remark"),
    [
        ("echo 'error while loading libgdal.so' >&2; exit 127", "loading libgdal.so"),
        ("echo hello", "does not print a version"),
        ("echo 'pdal 1.9.1 (x)'", "it is PDAL 1.9.1, needed is 2.2"),
    ],
)
def test_a_broken_program_is_passed_over(no_pdal, tmp_path, monkeypatch, text, remark):
    broken = tmp_path / "broken"
    broken.write_text(f"#!/bin/sh\n{text}\n")
    broken.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(broken))
    notes = Listener()
    assert find_pdal(reporter=notes) is None
    [(level, line)] = notes.messages
    assert level == "warning"
    assert line.startswith(f"{VARIABLE}={broken} is passed over")
    assert remark in line


@needs_sh
def test_a_program_is_asked_once(no_pdal, tmp_path, monkeypatch):
    program = tmp_path / "pdal"
    program.write_text(f"#!/bin/sh\necho x >>'{tmp_path}/asked'\necho pdal 2.8.0\n")
    program.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(program))
    assert find_pdal() == find_pdal()
    assert (tmp_path / "asked").read_text() == "x\n"


# Running stand-ins


@needs_sh
@pytest.mark.parametrize(
    ("said", "kind", "message"),
    [
        (
            "(pdal pipeline Error) GDAL failure (1) PROJ: crs not found\nPDAL: No such CRS.\n",
            InputError,
            "PDAL: No such CRS.",
        ),
        ("PDAL: readers.las: not LASF\n\n", InputError, "a.las: PDAL: readers.las: not LASF"),
        ("PDAL: STDIN: No root element.\n", InputError, "PDAL: No root element."),
        ("PDAL: writers.las: No room.\n", OutputError, "PDAL: writers.las: No room."),
        ("what(): std::bad_alloc\n", InputError, "PDAL: what(): std::bad_alloc"),
        ("", InputError, "PDAL: it ended with exit code 3"),
    ],
)
def test_what_pdal_says_is_one_line(stand_in, said, kind, message):
    runner = stand_in(f"printf '%s' '{said}' >&2; exit 3")
    with pytest.raises(GisRadarError) as caught:
        runner.run({"pipeline": ["a.las", {"type": "writers.las", "filename": "b.las"}]})
    assert type(caught.value) is kind
    assert caught.value.message == message


@needs_sh
def test_a_lost_reprojection_is_an_error_though_pdal_ends_well(stand_in):
    line = "(pdal pipeline Error) GDAL failure (6) Cannot find coordinate operations from x to y"
    runner = stand_in(f"echo '{line}' >&2")
    with pytest.raises(InputError, match=r"^PDAL: Cannot find coordinate operations"):
        runner.run({"pipeline": []})


@needs_sh
def test_a_killed_program_is_no_answer(stand_in):
    with pytest.raises(GisRadarError, match="was ended by SIGKILL") as caught:
        stand_in("kill -9 $$").run({"pipeline": []})
    assert caught.value.hint


@needs_sh
def test_progress_and_much_output(stand_in):
    notes = Listener()
    body = "i=0; while [ $i -lt 4000 ]; do echo $i-------------------------; i=$((i+1)); done"
    stand_in(f"{body}; ({body}) >&2; sleep 0.7").run({"pipeline": []}, reporter=notes)
    assert len(notes.messages) == 4000
    assert notes.stages
    assert {stage for stage, _, _ in notes.stages} == {"running PDAL"}


INTERRUPTED = """
import signal, sys
from gis_radar.scans.pdal import find_pdal
def stop(*_): raise KeyboardInterrupt
signal.signal(signal.SIGTERM, stop)
find_pdal().run({"pipeline": []})
"""


@needs_sh
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_the_child(no_pdal, tmp_path, monkeypatch, number):
    body = f"echo $$ >'{tmp_path}/part'; mv '{tmp_path}/part' '{tmp_path}/pid'; exec sleep 60"
    monkeypatch.setenv(VARIABLE, str(make_program(tmp_path / "pdal", body)))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    with subprocess.Popen([sys.executable, "-c", INTERRUPTED], stderr=subprocess.PIPE) as parent:
        try:
            wait_for((tmp_path / "pid").exists)
            wait_for(lambda: state_of(parent.pid) == "S")
            time.sleep(0.5)  # the parent has turned to waiting
            parent.send_signal(number)
            _, said = parent.communicate(timeout=300)
        finally:
            parent.kill()  # one that hangs fails here, and does not hold the others
    assert b"KeyboardInterrupt" in said
    pid = int((tmp_path / "pid").read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert list((tmp_path / "tmp").iterdir()) == []


def state_of(pid):
    """Return what a process does: R where it runs, or would if it could; S where it waits."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


# The real one


def test_pdal_runs_a_pipeline(pdal, tmp_path):
    scan = make_scan(tmp_path / "a.las")
    half = {"type": "filters.range", "limits": "Z[100.5:]"}
    pdal.run(from_to(tmp_path / "a.las", tmp_path / "b.laz", half))
    kept = laspy.read(tmp_path / "b.laz")
    assert len(kept.points) == np.count_nonzero(scan.z >= 100.5) > 100
    assert kept.header.parse_crs().to_epsg() == 25832


def test_pdal_reprojects(pdal, tmp_path):
    scan = make_scan(tmp_path / "a.las")
    to = {"type": "filters.reprojection", "out_srs": "EPSG:25833"}
    pdal.run(from_to(tmp_path / "a.las", tmp_path / "b.las", to))
    moved = laspy.read(tmp_path / "b.las")
    transform = transformer(CRS.from_epsg(25832), CRS.from_epsg(25833))
    x, y = transform.transform(scan.x, scan.y)
    np.testing.assert_allclose(moved.x, x, atol=0.011)
    np.testing.assert_allclose(moved.y, y, atol=0.011)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "LASF"), (b"hello", "LASF"), (None, "No such file or directory")],
)
def test_pdal_names_a_bad_scan(pdal, tmp_path, content, message):
    bad = tmp_path / "bad scan.las"
    if content is not None:
        bad.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        pdal.run(from_to(bad, tmp_path / "b.las"))
    assert "bad scan.las" in caught.value.message
    assert "\n" not in caught.value.message


def test_pdal_cannot_write(pdal, tmp_path):
    make_scan(tmp_path / "a.las")
    with pytest.raises(OutputError, match=r"nowhere"):
        pdal.run(from_to(tmp_path / "a.las", tmp_path / "nowhere" / "b.las"))
