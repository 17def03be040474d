"""Clock offsets from vehicles that several sensors see: errors beside stated standard deviations.

The clocks of the simulated sites are right. Here they are put off by part of a second, by an hour,
and to count from when the sensor was switched on. Errors are against the reference of each answer.
Exit code 1 where an answer is over four stated standard deviations off.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from figures import Figure, report
from simulated import sites, true_pose

import gis_radar as gr
from gis_radar.recordings import Recording

AHEAD_S = (0.0, 0.35, -3600.4, -1.7e9)  # of the second sensor; twice as much of the third
MOST_SIGMAS = 4.0


def main() -> None:
    """Measure the clocks of each site, print the answers, keep the median error."""
    pairs = np.array([pair for site in sites() for pair in _errors(site)])
    error_s, sigma_s = np.abs(pairs).T
    median_ms = 1000.0 * float(np.median(error_s))
    report("clocks", [Figure(what="clocks, median error", ours=median_ms, unit="ms")])
    if wrong := int((error_s > MOST_SIGMAS * sigma_s).sum()):
        sys.exit(f"{wrong} answers over {MOST_SIGMAS:g} standard deviations off")


def _errors(site: Path) -> Iterator[tuple[float, float]]:
    """Yield error and stated sigma, seconds, of each answer about a site."""
    tiles = gr.make_tiles(gr.read_map(next(site.glob("*.osm"))))
    opened = [gr.open_recording(path) for path in sorted(site.glob("R*.parquet"))]
    poses = [true_pose(site, recording.path.stem) for recording in opened]
    for ahead_s in AHEAD_S:
        off = {pose.sensor: ahead_s * i for i, pose in enumerate(poses)}
        late = [_later(each, off[p.sensor]) for each, p in zip(opened, poses, strict=True)]
        found = gr.measure_clocks(late, poses, tiles)
        for sensor, clock in found.clocks.items():
            if sensor != found.reference:
                error_s = clock.offset_s - off[sensor] + off[found.reference]
                print(
                    f"{site.name:12s} {found.reference}-{sensor} {ahead_s:14.2f} s ahead: error "
                    f"{1000 * error_s:6.1f} ms, sigma {1000 * clock.sigma_s:5.1f} ms"
                )
                yield error_s, clock.sigma_s
        for sensor, why in found.refused.items():
            print(f"{site.name:12s} {sensor} no answer {why}")


def _later(recording: Recording, ahead_s: float) -> Recording:
    """Return a recording whose times are so many seconds later."""

    def batches(columns: Sequence[str] | None) -> Iterator[pa.RecordBatch]:
        for batch in recording.batches(columns):
            place = batch.schema.get_field_index("time")
            time = np.asarray(batch.column(place).to_numpy()) + ahead_s
            yield batch.set_column(place, "time", pa.array(time))

    return Recording(path=recording.path, rows=recording.rows, batches=batches)


if __name__ == "__main__":
    main()
