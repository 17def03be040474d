"""The package's own commands on a scene: found poses, the dataset, and what they cost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scenes import ROOT, SceneFiles

import gis_radar as gr
from gis_radar.poses.files import write_pose

ONE_CORE = dict.fromkeys(
    ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
GUESS_M, GUESS_DEG = 6.0, 8.0  # what a user is off by who reads map and compass
STARTER = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu_s = used.ru_utime + used.ru_stime
print("\\n" + json.dumps({"code": code, "cpu_s": cpu_s, "peak_kb": used.ru_maxrss}), flush=True)
"""


@dataclass(frozen=True, kw_only=True)
class Ran:
    """How a command ended.

    Parameters
    ----------
    code : int
        Its exit code.
    warnings, errors : list of str
        Its lines.
    cpu_s, wall_s, peak_mb : float
        What it took.
    summary : dict
        Of its result.
    """

    code: int
    warnings: list[str]
    errors: list[str]
    cpu_s: float
    wall_s: float
    peak_mb: float
    summary: dict[str, Any] = field(default_factory=dict)


def run(*arguments: object) -> Ran:
    """Run a command of the package on one core, as a process of its own."""
    command = [sys.executable, "-m", "gis_radar", *map(str, arguments), "--json"]
    begin = time.perf_counter()
    with tempfile.TemporaryFile("w+", encoding="utf-8") as out:
        # started by a small process: the peak of a child begins with the memory of its parent
        subprocess.run(
            [sys.executable, "-I", "-S", "-c", STARTER, *command], check=False,
            stdout=out, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, cwd=ROOT,
            env={**os.environ, **ONE_CORE, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        wall_s = time.perf_counter() - begin
        out.seek(0)
        *events, used = [json.loads(line) for line in out if line.startswith("{")]
    logged = [event for event in events if event["event"] == "log"]
    results = [event for event in events if event["event"] == "result"]
    return Ran(
        code=used["code"],
        warnings=[event["message"] for event in logged if event["level"] == "warning"],
        errors=[event["message"] for event in events if event["event"] == "error"],
        cpu_s=used["cpu_s"],
        wall_s=wall_s,
        peak_mb=used["peak_kb"] / 1024.0,
        summary=results[-1]["summary"] if results else {},
    )


def found_poses(site: SceneFiles) -> list[Path]:
    """Return pose files, kept: as `gis-radar localize` finds them, else the true ones.

    The guess is as far off as a user's: six metres, eight degrees. Where the answer is refused, or
    says itself that the place along the road cannot be found, a user has the sensor surveyed.
    """
    folder = site.kept / "found"
    folder.mkdir(exist_ok=True)
    road = folder / "road.laz"
    if not road.exists():
        run("mask", site.scan, "--map", site.map, "-o", road)
    return [
        _found(site, number, path, surveyed)
        for number, (path, surveyed) in enumerate(
            zip(site.recordings, true_pose_files(site), strict=True)
        )
    ]


def _found(site: SceneFiles, number: int, recording: Path, surveyed: Path) -> Path:
    """Return the pose file of a sensor, found before or now."""
    folder, pose = surveyed.parent.parent / "found", gr.read_pose(surveyed)
    output, refused = folder / surveyed.name, folder / f"{pose.sensor}.refused"
    if not output.exists() and not refused.exists():
        turn = np.random.default_rng([7, number]).uniform(0.0, 2.0 * np.pi)
        east = pose.easting + GUESS_M * np.cos(turn)
        north = pose.northing + GUESS_M * np.sin(turn)
        ended = run(
            "localize", recording, "--map", site.map, "--road", folder / "road.laz",
            "--scan", site.scan, "--guess", f"{east:.2f},{north:.2f}",
            "--heading", f"{pose.yaw + GUESS_DEG * (-1) ** number:.1f}", "-o", output,
        )  # fmt: skip
        if ended.code:
            refused.write_text("\n".join([*ended.warnings, *ended.errors]) + "\n")
    if not output.exists() or not gr.read_pose(output).evidence.get("observable", True):
        return surveyed
    return output


def true_pose_files(site: SceneFiles) -> list[Path]:
    """Return files of the true poses, kept."""
    folder = site.kept / "true-poses"
    folder.mkdir(exist_ok=True)
    for pose in site.poses:
        write_pose(pose, folder / f"{pose.sensor}.json")
    return [folder / f"{pose.sensor}.json" for pose in site.poses]


def pose_errors(site: SceneFiles, files: Sequence[Path]) -> dict[str, list[float]]:
    """Return by sensor how far a pose is off, metres and degrees of yaw; 0 where surveyed."""
    known = {pose.sensor: pose for pose in site.poses}
    found = {}
    for path in files:
        pose = gr.read_pose(path)
        true = known[path.stem]
        apart = np.hypot(*(pose.position - true.position)[:2])
        turn = (pose.yaw - true.yaw + 180.0) % 360.0 - 180.0
        found[path.stem] = [round(float(apart), 3), round(float(turn), 3)]
    return found


def measure(site: SceneFiles, files: Sequence[Path], folder: Path) -> Ran:
    """Run `gis-radar measure` on a scene with some pose files."""
    return run("measure", *_sources(site, files), "-o", folder)


def _sources(site: SceneFiles, files: Sequence[Path]) -> list[object]:
    """Return the arguments of `measure`, but the output."""
    site.tiles()
    recordings = {path.stem: path for path in site.recordings}
    given: list[object] = [recordings[path.stem] for path in files]
    for path in files:
        given += ["--pose", path]
    tiles = site.kept / "tiles.gpkg"
    return [*given, "--tiles", tiles, "--map", site.map, "--scan", site.scan]


def costs(site: SceneFiles, files: Sequence[Path], whole: Ran) -> dict[str, float]:
    """Return CPU seconds and memory a sensor-minute, also beside those of hits alone."""
    with tempfile.TemporaryDirectory() as folder:
        plain = run("measure", *_sources(site, files), "--hits-only", "-o", Path(folder) / "hits")
    minutes = sensor_minutes(site, [path.stem for path in files])
    return {
        "sensor_minutes": minutes,
        "cpu_s": whole.cpu_s / minutes,
        "occupancy_cpu_s": plain.cpu_s / minutes,
        "times_occupancy": whole.cpu_s / plain.cpu_s,
        "peak_mb": whole.peak_mb,
        "occupancy_peak_mb": plain.peak_mb,
        "wall_s": whole.wall_s,
    }


def sensor_minutes(site: SceneFiles, sensors: Sequence[str]) -> float:
    """Return the minutes that some sensors recorded, summed."""
    return sum(_minutes(path) for path in site.recordings if path.stem in sensors)


def _minutes(path: Path) -> float:
    times = pd.read_parquet(path, columns=["time"])["time"]
    return float(times.iloc[-1] - times.iloc[0]) / 60.0
