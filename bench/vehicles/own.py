"""Runs of the package's commands on a scene: found poses, datasets, CPU time and memory."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scenes import SceneFiles

import gis_radar as gr

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
from figures import ProcessResult, run_alone

GUESS_M, GUESS_DEG = 6.0, 8.0  # errors of a user's guess from a map and a compass


def run(*arguments: object) -> ProcessResult:
    """Run a command of the package on one core, as a process of its own."""
    return run_alone("-m", "gis_radar", *arguments, "--json", check=False)


def messages(ran: ProcessResult, kind: str) -> list[str]:
    """Return the messages of a command: its errors (`error`) or its warnings (`warning`)."""
    return [event["message"] for event in ran.lines if kind in (event["event"], event.get("level"))]


def found_poses(site: SceneFiles) -> list[Path]:
    """Return kept pose files: as `gis-radar localize` finds them with a guess 6 m, 8 deg off.

    Where the answer is refused or not `observable` it is the true one: a user has it surveyed.
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
    """Return the pose file of a sensor, which is found where it is not kept."""
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
            refused.write_text(
                "\n".join(messages(ended, "warning") + messages(ended, "error")) + "\n"
            )
    if not output.exists() or not gr.read_pose(output).evidence.get("observable", True):
        return surveyed
    return output


def true_pose_files(site: SceneFiles) -> list[Path]:
    """Return files of the true poses, kept."""
    folder = site.kept / "true-poses"
    folder.mkdir(exist_ok=True)
    for pose in site.poses:
        pose.write(folder / f"{pose.sensor}.json")
    return [folder / f"{pose.sensor}.json" for pose in site.poses]


def pose_errors(site: SceneFiles, files: Sequence[Path]) -> dict[str, list[float]]:
    """Return the errors of poses by sensor: metres on the plane, degrees of yaw."""
    known = {pose.sensor: pose for pose in site.poses}
    found = {}
    for path in files:
        pose = gr.read_pose(path)
        true = known[path.stem]
        apart = np.hypot(*(pose.position - true.position)[:2])
        turn = (pose.yaw - true.yaw + 180.0) % 360.0 - 180.0
        found[path.stem] = [round(float(apart), 3), round(float(turn), 3)]
    return found


def measured(site: SceneFiles, folder: Path, *, found: bool) -> gr.Dataset:
    """Measure a scene into a folder with found or with true poses, without the check of poses."""
    poses = [gr.read_pose(path) for path in found_poses(site)] if found else site.poses
    return gr.measure(
        site.recordings, poses, site.tiles(), site.map, folder, scans=[site.scan], check=False
    )


def measure(site: SceneFiles, files: Sequence[Path], folder: Path) -> ProcessResult:
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


def costs(site: SceneFiles, files: Sequence[Path], whole: ProcessResult) -> dict[str, float]:
    """Return CPU seconds a sensor-minute, the ratio to those of hits alone, and memory."""
    with tempfile.TemporaryDirectory() as folder:
        plain = run("measure", *_sources(site, files), "--hits-only", "-o", Path(folder) / "hits")
    return {
        "cpu_s": whole.cpu_s / sensor_minutes(site),
        "times_occupancy": whole.cpu_s / plain.cpu_s,
        "peak_mib": whole.peak_mib,
    }


def sensor_minutes(site: SceneFiles) -> float:
    """Return the minutes that all sensors recorded, summed."""
    times = (pd.read_parquet(path, columns=["time"])["time"] for path in site.recordings)
    return sum(float(time.iloc[-1] - time.iloc[0]) / 60.0 for time in times)
