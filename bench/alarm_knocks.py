"""The test of the newest 20 and 60 s of `track`: what it reports of a sensor at rest.

The detections that `bench/alarm.py` has simulated are followed from the sensor's true pose, once by
traffic alone, as where a recording holds no still returns, and once with what stands still. Counted
are the events `moved`. Their rate by traffic alone comes from the tail of what each test finds, in
parts of its limit, largest of each five minutes.

Example: ``python bench/alarm.py`` first, then ``python bench/alarm_knocks.py``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import alarm
import make_samples
import numpy as np
import pyarrow as pa
from alarm_hours import tail
from figures import ROOT

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.calibration import (
    MONITOR,
    Follower,
    MonitorSettings,
    Problem,
    WindowFitter,
    start_estimate,
)
from gis_radar.calibration.moves import Scatter
from gis_radar.calibration.pose_track import MOVED, REJECTED
from gis_radar.recordings.recording import Detections

PART_S = 300.0
SIGMA = {"easting": 0.1, "northing": 0.1, "height": 0.1, "yaw": 0.1, "pitch": 0.1, "roll": 0.1}
BY_TRAFFIC = replace(MONITOR, still=replace(MONITOR.still, least_targets=10**9))


class Heard(Scatter):
    """Keeps what each test found, in parts of its limit."""

    def __init__(self, settings: MonitorSettings) -> None:
        super().__init__(settings)
        self.gate, self.found = settings.gate, list[float]()

    def add(self, chi2: float) -> None:
        """Take the result of a test."""
        self.found.append(chi2 / (self.ratio * self.gate))
        super().add(chi2)


def main() -> None:
    """Follow, print and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batches", type=int, default=2, help="of ten minutes, of each kind")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-alarm-knocks.json")
    arguments = parser.parse_args()
    report: dict[str, object] = {}
    largest: list[float] = []
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    for detector, settings in (("traffic", BY_TRAFFIC), ("both", MONITOR)):
        for kind, mast in (("ordinary", 0), ("ordinary", 1), ("light", 0)):
            name = make_samples.MASTS[mast].sensor
            paths = sorted((alarm.OUT / kind).glob(f"{name}_*_all.npz"))[: arguments.batches]
            if not paths:
                parser.error(f"no batches in {alarm.OUT / kind}: run bench/alarm.py first")
            figures, parts = rest(mast, paths, settings)
            report[f"{kind}, {name}, {detector}"] = figures
            print(f"{kind}, {name}, {detector}: {json.dumps(figures)}", flush=True)
            largest += parts if detector == "traffic" else []
        report.setdefault("traffic, all", tail(np.array(largest), part_min=PART_S / 60.0))
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    print(f"traffic, all: {json.dumps(report['traffic, all'])}")


def rest(
    mast: int, paths: Sequence[Path], settings: MonitorSettings
) -> tuple[dict[str, object], list[float]]:
    """Follow a sensor at rest; return figures, and the largest finding by five minutes."""
    pose, folder = make_samples.MASTS[mast].pose(), gr.sample_folder()
    pose = replace(pose, evidence={"sigma": SIGMA})
    roads = gr.read_map(folder / "junction.osm")
    mask = gr.mask_road(
        [folder / "scan.laz"], gr.read_roads(folder / "junction.osm"), engine="laspy"
    )
    problem = Problem(
        name=pose.sensor, roads=roads, road=mask.points, guess=pose.position[:2], heading=None
    )
    start = start_estimate(pose, make_samples.START, settings)
    follower = Follower(WindowFitter(problem, settings), start, settings)
    heard = follower.scatter = Heard(settings)
    sensor, largest, unmoved = alarm.Sensor.of(mast), [0.0], []
    for number, path in enumerate(paths):
        batch, begin = sensor.load(path), 60.0 * alarm.MINUTES * number
        for end in np.arange(settings.cycle_s, 60.0 * alarm.MINUTES + 1.0, settings.cycle_s):
            part = batch.between(end - settings.cycle_s, end)
            follower.push(_detections(part, make_samples.START + begin))
            follower.cycle(make_samples.START + begin + end)
            unmoved.append(follower.watch.unmoved)
            largest[-1] = max([largest[-1], *heard.found])
            heard.found.clear()
            if end % PART_S == 0.0:
                largest.append(0.0)
    events = [row.event for row in follower.rows]
    figures: dict[str, object] = {
        "hours": len(paths) * alarm.MINUTES / 60.0, "moved": events.count(MOVED),
        "rejected": events.count(REJECTED), "unmoved": float(np.mean(unmoved)),
        "largest": np.sort(largest[:-1]).round(2).tolist()[-10:],
    }  # fmt: skip
    return figures, largest[:-1]


def _detections(part: alarm.Detected, begin: float) -> Detections:
    nothing: Floats = np.full(len(part.time), np.nan)
    return Detections(
        time=begin + part.time, points=part.points, range_rate=part.rate, rcs=nothing,
        further=pa.RecordBatch.from_pydict({"none": nothing}),
    )  # fmt: skip


if __name__ == "__main__":
    main()
