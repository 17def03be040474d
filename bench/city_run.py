"""Executors of a city's run: the CPU time that they add to the hour jobs, the gain of two workers.

The hours are copies of the sample's recordings, an hour apart. Each executor makes a few hours and
many, in processes of its own; the difference counts, so that start and compilation do not. All
must make the same bytes. Exit code 1 where a target is missed.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import pyarrow.parquet as pq
from figures import ONE_CORE, TARGET, TIME_CHANCE, Figure, report

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.city.executors import workers_of
from gis_radar.city.tasks import SiteTask, add_recordings, make_site_hour
from gis_radar.dataset import open_hours

FEW, MANY = 2, 8  # hours that are made
SITE = """
title = "Sample"
[map]
file = "junction.osm"
crs = "EPSG:25832"
[[sensor]]
name = "R1"
recordings = ["R1_*.parquet"]
pose = "R1.json"
[[sensor]]
name = "R2"
recordings = ["R2_*.parquet"]
pose = "R2.json"
"""
CPU_TARGETS = {"processes": 1.03, "Dask": 1.06}  # times that of the bare jobs, at most
WAYS = ("bare", "processes", "Dask", "Dask, two workers")


def main() -> None:
    """Measure all executors, and judge."""
    if len(sys.argv) > 1:
        way, root, hours = sys.argv[1:]
        _make(way, Path(root), int(hours))
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        site = _write_site(folder / "site")
        task = add_recordings(SiteTask(root=folder / "root", name="a", file=site))
        if task.failures:
            raise task.failures[0][1]
        cpu_s, wall_s = {}, {}
        _run(folder, "bare", 1)  # compiles what no other run shall compile
        for way in WAYS:
            few, many = (_run(folder, way, hours) for hours in (FEW, MANY))
            cpu_s[way], wall_s[way] = (
                (b - a) / (MANY - FEW) for a, b in zip(few, many, strict=True)
            )
        bare = _bytes(folder / f"bare {MANY}")
        for way in WAYS:
            if _bytes(folder / f"{way} {MANY}") != bare:
                sys.exit(f"{way}: other bytes than the bare jobs")
    size = f"{2 * (MANY - FEW)} sensor-hours"
    report("city_run", [
        Figure(what="CPU of an hour job, bare", ours=cpu_s["bare"], unit="s", chance=TIME_CHANCE),
        *(Figure(what=f"CPU by {way}", ours=cpu_s[way] / cpu_s["bare"], peer=most,
                 peer_name=TARGET, size=size) for way, most in CPU_TARGETS.items()),
        Figure(what="CPU of two workers of Dask beside one", peer=1.05, peer_name=TARGET,
               ours=cpu_s["Dask, two workers"] / cpu_s["Dask"], size=size),
        Figure(what="gain of a second worker of Dask", peer=1.7, peer_name=TARGET, size=size,
               ours=wall_s["Dask"] / wall_s["Dask, two workers"], more_is_better=True),
    ])  # fmt: skip


def _write_site(folder: Path) -> Path:
    folder.mkdir()
    sample = gr.sample_folder()
    for name in ("junction.osm", "R1.json", "R2.json"):
        shutil.copyfile(sample / name, folder / name)
    for hour in range(MANY):
        for sensor in ("R1", "R2"):
            rows = pq.read_table(sample / f"{sensor}.parquet")
            place = rows.schema.get_field_index("time")
            rows = rows.set_column(place, "time", pc.add(rows["time"], 3600.0 * hour))
            pq.write_table(rows.slice(7 * hour), folder / f"{sensor}_{hour}.parquet")
    path = folder / "SITE.toml"
    path.write_text(SITE, encoding="utf-8")
    return path


def _run(folder: Path, way: str, hours: int) -> tuple[float, float]:
    """Make hours in a new process; return its CPU time, and the time that passed, seconds.

    The latter begins when all workers are there.
    """
    root = folder / f"{way} {hours}"
    shutil.copytree(folder / "root" / "site=a", root)
    command = [sys.executable, __file__, way, str(root), str(hours)]
    before = os.times()
    done = subprocess.run(
        command, check=True, env={**os.environ, **ONE_CORE}, stdout=subprocess.PIPE, text=True
    )
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user
    return cpu_s - before.children_system, float(done.stdout.split()[-1])


def _make(way: str, root: Path, most: int) -> None:
    """Make the first hours of a dataset, and print how many seconds passed."""
    with open_hours(root, QUIET) as found:
        calls: dict[int, Sequence[Any]] = {
            hour: (make_site_hour, root, hour, 1) for hour in found.missing[:most]
        }
        begin = time.monotonic()
        if way == "bare":
            results = {hour: work(*given) for hour, (work, *given) in calls.items()}
        elif way == "processes":
            with workers_of(None, 1, QUIET) as workers:
                results = dict(workers.results(calls))
        else:
            results, begin = _by_dask(calls, 2 if "two" in way else 1)
        wall_s = time.monotonic() - begin
    if errors := [each for each in results.values() if isinstance(each, Exception)]:
        raise errors[0]
    print(wall_s)


def _by_dask(calls: Mapping[int, Sequence[Any]], count: int) -> tuple[dict[int, Any], float]:
    """Return the results by hour, and the (monotonic) time when all workers were there."""
    dask: Any = importlib.import_module("distributed")  # which states no types
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    address, words = f"tcp://127.0.0.1:{port}", ("--host", "127.0.0.1", "--no-dashboard")
    running = [_dask("scheduler", "--port", port, *words)]
    running += [
        _dask("worker", address, "--nthreads", "1", "--no-nanny", "--memory-limit", "0", *words)
        for _ in range(count)
    ]
    try:
        with dask.Client(address) as client:
            client.wait_for_workers(count)
        begin = time.monotonic()
        with workers_of(address, None, QUIET) as workers:
            return dict(workers.results(calls)), begin
    finally:
        for each in reversed(running):
            each.terminate()
            each.wait()


def _dask(*words: str) -> subprocess.Popen[bytes]:
    program = Path(sys.executable).with_name("dask")
    return subprocess.Popen([program, *words], stderr=subprocess.DEVNULL)


def _bytes(root: Path) -> str:
    """Return names and contents of a dataset's files as one text."""
    paths = sorted(path for path in root.rglob("*") if path.is_file())
    return json.dumps([
        (path.relative_to(root).as_posix(), path.read_bytes().hex())
        for path in paths if path.name != "recordings.parquet"
    ])  # fmt: skip


if __name__ == "__main__":
    main()
