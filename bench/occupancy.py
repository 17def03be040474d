"""Speed, memory and disk of `gis-radar occupancy`, from Parquet to the folder, one process.

A recording of the sample site is topped up to 500 detections a frame: each that stands comes
several times, metres apart. It is repeated end to end, each time later, as a sensor would deliver
it over `--hours`; every repetition is decoded from Parquet anew. `times real time` is the time
recorded over the processor time spent, scaled to a sensor of 500 detections at 20 Hz (10,000
detections a second). Exit code 1 under the target, or where memory goes over a gigabyte.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import gis_radar as gr
from gis_radar.recordings.recording import Recording

ROOT = Path(__file__).parent.parent
PER_SECOND = 10_000
STILL_MPS = 0.15
SPREAD_M = 3.0
TARGET = 200.0
MOST_MIB = 1000.0


def main() -> None:
    """Measure, print and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="R1")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-occupancy.json")
    arguments = parser.parse_args()
    sample = gr.sample_folder()
    tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    pose = gr.read_pose(sample / f"{arguments.sensor}.json")
    with tempfile.TemporaryDirectory() as name:
        folder, thick = Path(name) / "occupancy", Path(name) / f"{arguments.sensor}.parquet"
        _thicken(sample / thick.name, thick)
        once = gr.open_recording(thick)
        recording, recorded_s = _repeated(once, arguments.hours)
        gr.measure_occupancy([once], [pose], tiles, folder)  # compiles
        begin = time.process_time()
        gr.measure_occupancy([recording], [pose], tiles, folder)
        spent_s = time.process_time() - begin
        disk = {path.name: path.stat().st_size / 2**20 for path in folder.iterdir()}
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    rows = recording.rows or 0
    ratio = rows / spent_s / PER_SECOND
    memory_mib = int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 1024
    report = {
        "hours": recorded_s / 3600,
        "detections": rows,
        "processor_s": spent_s,
        "times_real_time": ratio,
        "memory_mib": memory_mib,
        "disk_mib": disk,
    }
    print(f"{report['hours']:.2f} h of {arguments.sensor}, {rows / recorded_s:,.0f} detections/s")
    print(f"{ratio:.0f} x real time for 500 detections at 20 Hz")
    print(f"memory {memory_mib:.0f} MiB, disk {sum(disk.values()):.1f} MiB: "
          + ", ".join(f"{name} {size:.1f}" for name, size in sorted(disk.items())))  # fmt: skip
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if ratio < TARGET or memory_mib > MOST_MIB:
        sys.exit(f"outside the targets: {TARGET:.0f} x real time, {MOST_MIB:.0f} MiB")


def _thicken(source: Path, target: Path) -> None:
    """Write a recording with `PER_SECOND` detections: more fixed things beside those it has."""
    table = pq.read_table(source).to_pandas()
    recorded_s = table["time"].iloc[-1] - table["time"].iloc[0]
    still = (table["range_rate"].abs() <= STILL_MPS).to_numpy()
    times = max(round((PER_SECOND * recorded_s - (~still).sum()) / still.sum()), 1)
    copies = np.where(still, times, 1)
    copy = np.arange(copies.sum()) - np.repeat(np.cumsum(copies) - copies, copies)
    table = table.loc[np.repeat(table.index, copies)]
    beside = np.random.default_rng(1).normal(0.0, SPREAD_M, (times, 2)).astype(np.float32)
    beside[0] = 0.0
    table[["x", "y"]] += beside[copy]
    table.to_parquet(target, index=False)


def _repeated(once: Recording, hours: float) -> tuple[Recording, float]:
    """Return a recording that repeats another for some hours, and how long it is in seconds."""
    first, last = np.inf, -np.inf
    for piece in once.read():
        first, last = min(first, piece.time[0]), max(last, piece.time[-1])
    span = last - first + 0.05
    times = max(round(hours * 3600 / span), 1)

    def batches(columns: Sequence[str] | None) -> Iterator[pa.RecordBatch]:
        for turn in range(times):
            for batch in once.batches(columns):
                place = batch.schema.get_field_index("time")
                later = batch.column(place).to_numpy() + turn * span
                yield batch.set_column(place, "time", pa.array(later))

    rows = None if once.rows is None else once.rows * times
    return Recording(path=once.path, rows=rows, batches=batches), times * span


if __name__ == "__main__":
    main()
