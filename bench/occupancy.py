"""Speed, memory and disk of `gis-radar occupancy`, from Parquet to the folder, one process.

A recording of the sample site is topped up to 500 detections a frame: each that stands comes
several times, metres apart. It is written as `convert` writes recordings, and repeated end to end,
each time later, as a sensor would deliver it over `--hours`; every repetition is decoded anew. The
same recording goes through the pass in NumPy, the oracle, and through bare decoding, in turns in
the same run; all three are processor times. `times real time` is scaled to a sensor of 500
detections at 20 Hz (10,000 detections a second).

A repeated recording flatters compression, so bytes a pair are measured on traffic that does not
repeat: each recording of the simulated sites as it is.

Exit code 1 where a figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from simulated import sites, true_pose

import gis_radar as gr
from gis_radar.recordings.raw_rows import RAW_COLUMNS
from gis_radar.recordings.recording import Recording
from gis_radar.recordings.recording_file import parquet_options

ROOT = Path(__file__).parent.parent
PER_SECOND = 10_000
STILL_MPS = 0.15
SPREAD_M = 3.0
TARGET = 200.0  # times real time
TIMES_PLAIN = 4.0  # the pass in NumPy, or
DECODING = 0.4  # the share of bare decoding: one of both
MOST_MIB = 1000.0
BYTES_A_PAIR = 0.9  # of a town; sparser traffic takes more
ROUNDS = 3


class PlainGrid(gr.TileGrid):
    """Any engine but the grid itself is asked by the pass in NumPy."""


def main() -> None:
    """Measure, print and keep the figures."""
    arguments = _arguments()
    sample = gr.sample_folder()
    tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    pose = gr.read_pose(sample / f"{arguments.sensor}.json")
    with tempfile.TemporaryDirectory() as name:
        folder, thick = Path(name) / "occupancy", Path(name) / f"{arguments.sensor}.parquet"
        _thicken(sample / thick.name, thick)
        once = gr.open_recording(thick)
        recording, recorded_s = _repeated(once, arguments.hours)

        def measure(of: Recording, engine: Any = gr.TileGrid) -> None:
            gr.measure_occupancy([of], [pose], tiles, folder, engine=engine)

        measure(once)  # compiles
        part, _ = _repeated(once, arguments.hours / ROUNDS)
        rounds = [_times(part, measure) for _ in range(ROUNDS)]
        spent_s = _spent(lambda: measure(recording))
        memory_mib = _peak_mib()
        disk = {path.name: path.stat().st_size / 2**20 for path in folder.iterdir()}
        decode_s, compiled_s, plain_s = np.median(rounds, axis=0).tolist()
    rows = recording.rows or 0
    report = {
        "hours": recorded_s / 3600,
        "detections": rows,
        "processor_s": spent_s,
        "times_real_time": rows / spent_s / PER_SECOND,
        "times_plain": plain_s / compiled_s,
        "plain_times_real_time": (part.rows or 0) / plain_s / PER_SECOND,
        "decoding_share": decode_s / compiled_s,
        "memory_mib": memory_mib,
        "disk_mib": disk,
        "bytes_a_pair": dict(_bytes_a_pair()),
    }
    _print(report, recorded_s, arguments.sensor)
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if missed := list(_missed(report)):
        sys.exit("outside the targets: " + "; ".join(missed))


def _times(part: Recording, measure: Callable[..., None]) -> list[float]:
    """Return processor seconds of bare decoding, of the compiled pass and of the one in NumPy."""
    return [
        _spent(lambda: sum(map(len, part.batches(RAW_COLUMNS)))),
        _spent(lambda: measure(part)),
        _spent(lambda: measure(part, PlainGrid)),
    ]


def _spent(work: Callable[[], object]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin


def _peak_mib() -> float:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 1024


def _print(report: dict[str, Any], recorded_s: float, sensor: str) -> None:
    per_s = report["detections"] / recorded_s
    print(f"{report['hours']:.2f} h of {sensor}, {per_s:,.0f} detections/s")
    print(f"{report['times_real_time']:.0f} x real time for 500 detections at 20 Hz")
    print(f"{report['times_plain']:.2f} x as fast as the pass in NumPy; "
          f"{100 * report['decoding_share']:.0f} % of the time is bare decoding")  # fmt: skip
    disk = report["disk_mib"]
    print(f"memory {report['memory_mib']:.0f} MiB, disk {sum(disk.values()):.1f} MiB: "
          + ", ".join(f"{name} {size:.1f}" for name, size in sorted(disk.items())))  # fmt: skip
    for name, size in report["bytes_a_pair"].items():
        print(f"{name}: {size:.2f} bytes a pair")


def _missed(report: dict[str, Any]) -> Iterator[str]:
    """Yield the targets that are missed."""
    if report["times_real_time"] < TARGET:
        yield f"{TARGET:.0f} x real time"
    if report["times_plain"] < TIMES_PLAIN and report["decoding_share"] < DECODING:
        yield f"{TIMES_PLAIN:g} x the pass in NumPy, or {100 * DECODING:.0f} % decoding"
    if report["memory_mib"] > MOST_MIB:
        yield f"{MOST_MIB:.0f} MiB"
    towns = [size for name, size in report["bytes_a_pair"].items() if name.startswith("town")]
    if towns and np.median(towns) > BYTES_A_PAIR:
        yield f"{BYTES_A_PAIR:g} bytes a pair"


def _bytes_a_pair() -> Iterator[tuple[str, float]]:
    """Yield the bytes that a pair takes, of each recording of the simulated sites."""
    for site in sites():
        (path,) = site.glob("*.osm")
        crs = None if site == gr.sample_folder() else "EPSG:25832"
        tiles = gr.make_tiles(gr.read_map(path, crs=crs))
        for recording in sorted(site.glob("R*.parquet")):
            pose = true_pose(site, recording.stem)
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name) / "occupancy"
                found = gr.measure_occupancy([recording], [pose], tiles, folder)
                pairs = sum(len(step) for step, _ in found.hits())
                size = (folder / "hits_by_sensor.parquet").stat().st_size
            yield f"{site.name} {recording.stem}", size / pairs


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
    thick = pa.Table.from_pandas(table, preserve_index=False)
    pq.write_table(thick, target, **parquet_options(thick.schema.names))


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


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="R1")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-occupancy.json")
    return parser.parse_args()


if __name__ == "__main__":
    main()
