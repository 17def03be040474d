"""Memory of `gis-radar occupancy`: a recording against one ten times as long, in one run.

Each run is a process of its own; the figure is the largest memory that Linux saw it hold since it
began (`getrusage` would count what its parent held before).
Exit code 1 where the long one takes more than the target share over the short one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import gis_radar as gr

ROOT = Path(__file__).parent.parent
TIMES = 10
TARGET = 1.10
CHILD = """
import re, sys
from pathlib import Path
import gis_radar as gr
recording, pose, tiles, folder = sys.argv[1:]
gr.measure_occupancy([recording], [gr.read_pose(pose)], gr.read_tiles(tiles), folder)
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


def main() -> None:
    """Measure both, print and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="R1")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-memory.json")
    arguments = parser.parse_args()
    sample = gr.sample_folder()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        roads = gr.read_map(sample / "junction.osm")
        gr.write_tiles(gr.make_tiles(roads), folder / "tiles.gpkg", problems=roads.problems)
        short = sample / f"{arguments.sensor}.parquet"
        _repeat(short, folder / "long.parquet")
        short_mib, long_mib = (
            _peak_mib(path, sample / f"{arguments.sensor}.json", folder)
            for path in (short, folder / "long.parquet")
        )
    report = {"short_mib": short_mib, "long_mib": long_mib, "ratio": long_mib / short_mib}
    print(f"100 s: {short_mib:.0f} MiB, 1000 s: {long_mib:.0f} MiB: {long_mib / short_mib:.2f} x")
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if long_mib > TARGET * short_mib:
        sys.exit(f"memory grows with the recording: {long_mib / short_mib:.2f} x")


def _repeat(source: Path, target: Path) -> None:
    """Write a recording `TIMES` over, each time later, as one row group."""
    table = pq.read_table(source)
    time = table["time"].to_numpy()
    span = time[-1] - time[0] + 0.05
    later = np.concatenate([time + span * turn for turn in range(TIMES)])
    repeated = pa.concat_tables([table] * TIMES).combine_chunks()
    repeated = repeated.set_column(table.schema.get_field_index("time"), "time", pa.array(later))
    pq.write_table(repeated, target, row_group_size=len(repeated))


def _peak_mib(recording: Path, pose: Path, folder: Path) -> float:
    answer = subprocess.run(
        [sys.executable, "-c", CHILD, recording, pose, folder / "tiles.gpkg", folder / "occupancy"],
        check=True,
        capture_output=True,
        text=True,
    )
    return int(answer.stdout.split()[-1]) / 1024


if __name__ == "__main__":
    main()
