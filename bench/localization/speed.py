"""Speed and memory: the command `gis-radar localize` on a million detections, as a process.

The sample's recording is topped up to a million by more returns from fixed things. One run before
those that count fills the caches of files and compiled code. On a machine that others use the time
of the processor is the fairer figure.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

import gis_radar as gr
from simulation.recording import write_recording

DETECTIONS = 1_000_000
FRAMES = 2000
FIXED_MPS = 0.1
RUNS = 3
TARGETS_S = {"heading unknown": 10.0, "heading within 25 deg": 3.0}
TARGET_MIB = 1.5e9 / 2**20
CHILD = """
import atexit, re, sys, time
from pathlib import Path
def print_peak():
    high = re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]
    print(high, time.process_time(), file=sys.stderr)
atexit.register(print_peak)
from gis_radar.cli import main
main()
"""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a run of the command takes.

    Parameters
    ----------
    wall_s, cpu_s : float
        From start to end, the least of the runs; and of the processor.
    peak_mib : float
        Most memory held.
    target_s : float
        What it should stay under.
    """

    wall_s: float
    cpu_s: float
    peak_mib: float
    target_s: float


def measure() -> dict[str, Cost]:
    """Time the command with and without a heading."""
    sample = gr.sample_folder()
    true = gr.read_pose(sample / "R1.json")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recording(_million(sample / "R1.parquet"), folder / "R1.parquet")
        roads = gr.read_roads(sample / "junction.osm")
        gr.mask_road([sample / "scan.laz"], roads, engine="laspy").write(folder / "road.laz")
        call = [
            "localize", str(folder / "R1.parquet"), "--map", str(sample / "junction.osm"),
            "--road", str(folder / "road.laz"), "-o", str(folder / "pose.json"),
            "--guess", f"{true.easting + 6:.1f},{true.northing - 5:.1f}",
        ]  # fmt: skip
        _run(call)
        ways = {
            "heading unknown": call,
            "heading within 25 deg": [*call, "--heading", f"{true.yaw + 18:.0f}"],
        }
        return {way: _cost(words, TARGETS_S[way]) for way, words in ways.items()}


def _million(recording: Path) -> pd.DataFrame:
    """Return the last frames of a recording with a million detections."""
    table = pd.read_parquet(recording)
    table = table[table["time"] >= np.unique(table["time"])[-FRAMES:][0]].dropna()
    rng = np.random.default_rng(0)
    fixed = table[np.abs(table["range_rate"]) < FIXED_MPS]
    more = fixed.sample(max(0, DETECTIONS - len(table)), replace=True, random_state=0).copy()
    for axis in "xyz":
        more[axis] += rng.normal(0.0, 0.2, len(more)).astype(np.float32)
    whole: pd.DataFrame = pd.concat([table, more]).sort_values("time", kind="stable")
    return whole.iloc[:DETECTIONS]


def _run(words: list[str]) -> tuple[float, float, float]:
    """Return seconds on the wall, of the processor, and the peak in MiB."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *words], check=True, capture_output=True, text=True
    )
    spent = time.perf_counter() - begin
    high, cpu = done.stderr.split()[-2:]
    return spent, float(cpu), int(high) / 1024


def _cost(words: list[str], target_s: float) -> Cost:
    wall, cpu, peak = zip(*(_run(words) for _ in range(RUNS)), strict=True)
    return Cost(wall_s=min(wall), cpu_s=min(cpu), peak_mib=max(peak), target_s=target_s)


def markdown(costs: dict[str, Cost]) -> str:
    """Return the figures as a table."""
    lines = [
        f"| a million detections in {FRAMES} frames | wall | CPU | goal | peak memory | goal |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {way} | {c.wall_s:.1f} s | {c.cpu_s:.1f} s | {c.target_s:.0f} s | {c.peak_mib:.0f} MiB "
        f"| {TARGET_MIB:.0f} MiB |"
        for way, c in costs.items()
    ]
    return "\n".join(lines)
