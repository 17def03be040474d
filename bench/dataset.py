"""What a dataset costs, beside the version before it: time, memory, bytes, answers.

    python bench/dataset.py --before FOLDER [--only hits,towns,...] [--minutes 60] [--hours 10]

FOLDER is a checkout of the version before the dataset. Both versions run in turns, each as a
process of its own on one core; times are of the processor, memory is the most that Linux saw.

- `hits`: a recording of the sample site is topped up to 500 detections a frame (those that stand
  come several times, metres apart) and repeated end to end; beside bare decoding. And read back.
- `towns`: hits and vehicles of the simulated sites; bytes of a hit and of a state of a vehicle, on
  traffic that does not repeat.
- `map`: the heat map of a day of quarters, 12,000 tiles; as usual, and each tile busy in each.
- `profile`: occupancy of a street by hour of day over a month of one sensor, in a new process.
- `memory`: an hour of five sensors with vehicles, and several.

Exit code 1 where a figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from dataset_days import write_days
from simulated import ROOT, sites, true_pose

import gis_radar as gr
from gis_radar.dataset.tables import HITS, TRACKS
from gis_radar.heatmap.layers import write_package
from gis_radar.progress import QUIET
from gis_radar.recordings.recording_file import parquet_options

PER_SECOND = 10_000  # detections: 500 at 20 Hz
STILL_MPS, SPREAD_M = 0.15, 3.0
BEGIN = 1_780_300_800.0  # of an hour
TILES, STREET_TILES, DAYS = 12_000, 4_000, 30
SENSORS = 5
TARGETS: Mapping[str, tuple[str, float]] = {
    "bare decoding in hits, share": (">=", 0.24),
    "hits, now and before, times as fast": (">=", 1.0),
    "hits on disk, bytes a pair": ("<=", 1.25),
    "reading hits, M pairs a second": (">=", 20.0),
    "tracks on disk, bytes a row": ("<=", 5.0),
    "heat map of a day, MB": ("<=", 30.0),
    "heat map of a day, s": ("<=", 10.0),
    "profile of a month, s": ("<=", 0.5),
    "memory of an hour, MiB": ("<=", 1536.0),
}
ONE_CORE = dict.fromkeys(
    ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
CHILD = """
import json, re, sys, time
from pathlib import Path
import gis_radar as gr
from gis_radar.recordings.raw_rows import RAW_COLUMNS
given = json.loads(sys.argv[1])
def measure(site, folder):
    names, poses = site["names"], [gr.read_pose(name) for name in site["poses"]]
    tiles, map_path = gr.read_tiles(site["tiles"]), site["map"]
    folder.mkdir()
    {work}
def spent(work):
    begin = time.process_time()
    work()
    return time.process_time() - begin
folder = Path(given["folder"])
measure(given["first"], folder / "first")  # compiles
def read():
    for name in given["names"]:
        sum(map(len, gr.open_recording(name).batches(RAW_COLUMNS)))
decode_s = spent(read) if given["decode"] else 0.0
measure_s = spent(lambda: measure(given, folder / "made"))
peak = int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024
print(json.dumps({"decode_s": decode_s, "measure_s": measure_s, "peak_mib": peak}))
"""
HITS_NOW = "gr.measure(names, poses, tiles, None, folder / 'site', hits_only=True)"
HITS_BEFORE = "gr.measure_occupancy(names, poses, tiles, folder / 'hits')"
ALL_NOW = "gr.measure(names, poses, tiles, map_path, folder / 'site')"
ALL_BEFORE = HITS_BEFORE + "; gr.find_vehicles(names, poses, tiles, map_path, folder / 'vehicles')"
PROFILE = """
import json, sys, time
import duckdb, geopandas, pyarrow.parquet, gis_radar.dataset.answers, gis_radar.dataset.queries
import gis_radar as gr
loaded = time.process_time()
gr.open_dataset(sys.argv[1]).query(
    "SELECT hour(begin) AS hour, sum(occupied_steps) / sum(visible_steps) AS occupancy "
    "FROM tile_counts JOIN tiles USING (tile_id) "
    f"WHERE lanelet_id = {sys.argv[2]} GROUP BY hour ORDER BY hour"
)
done = time.process_time()
print(json.dumps({"query_s": done - loaded, "whole_s": done}))
"""
Figures = dict[str, float]


class Bench:
    """The parts, and what they have in common."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.before: Path | None = options.before
        self.minutes, self.hours = float(options.minutes), int(options.hours)
        self.each = float(options.each)
        self.rounds, self.folder = int(options.rounds), folder
        self.sample = self.site(gr.sample_folder())
        self.number = 0

    def site(self, of: Path) -> dict[str, Any]:
        """Return map, tiles, recordings and poses of a site, as files."""
        (map_path,) = of.glob("*.osm")
        place = self.folder / of.name
        place.mkdir()
        gr.write_tiles(gr.make_tiles(gr.read_map(map_path, crs="EPSG:25832")), place / "t.gpkg")
        names = sorted(of.glob("R?.parquet"))
        for name in names:
            gr.write_pose(true_pose(of, name.stem), place / f"{name.stem}.json")
        return {
            "map": str(map_path), "tiles": str(place / "t.gpkg"), "names": list(map(str, names)),
            "poses": [str(place / f"{name.stem}.json") for name in names],
        }  # fmt: skip

    def run(self, work: str, given: Mapping[str, Any], root: Path = ROOT) -> tuple[Figures, Path]:
        """Measure in a new process; return what it took, and the folder."""
        self.number += 1
        place = self.folder / f"run{self.number}"
        place.mkdir()
        spec = {"decode": False, "first": self.sample, **given, "folder": str(place)}
        answer = subprocess.run(
            [sys.executable, "-c", CHILD.replace("{work}", work), json.dumps(spec)],
            check=True, stdout=subprocess.PIPE, text=True, cwd=place,
            env=os.environ | ONE_CORE | {"PYTHONPATH": str(root)},
        ).stdout  # fmt: skip
        return json.loads(answer.splitlines()[-1]), place / "made" / "site"

    def in_turns(
        self, now: str, before: str, given: Mapping[str, Any]
    ) -> tuple[dict[str, Figures], Path]:
        """Return the medians of both versions, and the last dataset."""
        rows: dict[str, list[Figures]] = {"now": [], "before": []}
        for _ in range(self.rounds):
            figures, made = self.run(now, given)
            rows["now"].append(figures)
            if self.before is not None:
                rows["before"].append(self.run(before, given, self.before)[0])
        medians = {
            name: {key: float(np.median([each[key] for each in of])) for key in of[0]}
            for name, of in rows.items() if of
        }  # fmt: skip
        return medians, made

    def thick(self) -> dict[str, Any]:
        """Return the recording with 500 detections a frame, repeated, and its site."""
        path = self.folder / "thick.parquet"
        if not path.exists():
            thick = thickened(pd.read_parquet(self.sample["names"][0]))
            write_repeated(thick, path, 60.0 * self.minutes)
        return self.sample | {"names": [str(path)], "poses": self.sample["poses"][:1]}

    def hits(self) -> Iterator[tuple[str, float]]:
        """Hits of a recording, and reading them."""
        given = self.thick() | {"decode": True}
        rows = pq.read_metadata(given["names"][0]).num_rows
        found, made = self.in_turns(HITS_NOW, HITS_BEFORE, given)
        for name, row in found.items():
            yield (
                f"hits of an hour, Parquet to dataset, x real time, {name}",
                rows / row["measure_s"] / PER_SECOND,
            )
            yield f"bare decoding in hits, share, {name}", row["decode_s"] / row["measure_s"]
            yield f"memory of hits, MiB, {name}", row["peak_mib"]
        if "before" in found:
            ratio = found["before"]["measure_s"] / found["now"]["measure_s"]
            yield "hits, now and before, times as fast", ratio
        yield "bare decoding in hits, share", (
            found["now"]["decode_s"] / found["now"]["measure_s"]
        )  # fmt: skip
        dataset = gr.open_dataset(made)
        spent = min(_spent(lambda: list(dataset.batches(HITS))) for _ in range(self.rounds))
        yield "reading hits, M pairs a second", dataset.hours()["hits"].sum() / spent / 1e6

    def towns(self) -> Iterator[tuple[str, float]]:
        """Hits and vehicles of sites, a sensor-minute; bytes of their tables."""
        sums: dict[str, list[int]] = {"hits": [0, 0], "tracks": [0, 0]}
        for of in [*sites(), ROOT.parent / "shared" / "data" / "town01"]:
            if not of.exists():
                continue
            given = self.sample if of == gr.sample_folder() else self.site(of)
            found, made = self.in_turns(ALL_NOW, ALL_BEFORE, given)
            minutes = sum(_minutes(name) for name in given["names"])
            for name, row in found.items():
                yield (
                    f"hits and vehicles of {of.name}, CPU s a sensor-minute, {name}",
                    row["measure_s"] / minutes,
                )
            hours = gr.open_dataset(made).hours()
            for table, sizes in ((HITS, sums["hits"]), (TRACKS, sums["tracks"])):
                size = sum(each.stat().st_size for each in made.glob(f"{table.name}/*/*.parquet"))
                count = int(hours[table.name].sum())
                yield f"{table.name} on disk, bytes a row, {of.name}", size / count
                sizes[0] += size
                sizes[1] += count
        yield "hits on disk, bytes a pair", sums["hits"][0] / sums["hits"][1]
        yield "tracks on disk, bytes a row", sums["tracks"][0] / sums["tracks"][1]

    def map(self) -> Iterator[tuple[str, float]]:
        """The heat map of a day."""
        for busy, what in ((False, ""), (True, ", every tile busy")):
            dataset = write_days(self.folder / f"day{busy}", tiles=TILES, days=1, busy=busy)
            path = self.folder / f"day{busy}.gpkg"

            def work(dataset: gr.Dataset = dataset, path: Path = path) -> None:
                write_package(gr.make_heatmap(dataset, interval="15min"), path, QUIET)

            spent = _spent(work)
            yield f"heat map of a day{what}, MB", path.stat().st_size / 1e6
            yield f"heat map of a day{what}, s", spent

    def profile(self) -> Iterator[tuple[str, float]]:
        """Occupancy of a street by hour of day."""
        dataset = write_days(self.folder / "month", tiles=STREET_TILES, days=DAYS)
        tiles = dataset.tiles().set_index("tile_id")
        street = tiles.loc[dataset.sights()["tile_id"].iloc[0], "lanelet_id"]
        answers = [
            json.loads(
                subprocess.run(
                    [sys.executable, "-c", PROFILE, str(dataset.folder), str(street)],
                    check=True, stdout=subprocess.PIPE, text=True,
                    env=os.environ | {"PYTHONPATH": str(ROOT)},
                ).stdout
            )
            for _ in range(self.rounds)
        ]  # fmt: skip
        yield "profile of a month, s", min(each["query_s"] for each in answers)
        yield "profile of a month, with all imports, s", min(each["whole_s"] for each in answers)

    def memory(self) -> Iterator[tuple[str, float]]:
        """An hour of five sensors; and one and several of which some minutes are recorded."""
        for hours, minutes in ((1, 60.0), (1, self.each), (self.hours, self.each)):
            given = self.five_sensors(hours, minutes)
            figures, _ = self.run(ALL_NOW, given)
            whole = minutes == 60.0
            what = "an hour" if whole else f"{hours} h, {minutes:g} min of each"
            yield f"memory of {what}, MiB", figures["peak_mib"]
            yield f"{what}, {SENSORS} sensors, CPU s", figures["measure_s"]

    def five_sensors(self, hours: int, minutes: float) -> dict[str, Any]:
        """Return recordings of some minutes of each hour, of sensors on the masts of the sample."""
        names, poses = [], []
        for number in range(SENSORS):
            mast = number % len(self.sample["names"])
            path = self.folder / f"S{number}.parquet"
            once = pd.read_parquet(self.sample["names"][mast])
            write_repeated(once, path, 60.0 * minutes, hours=hours, seed=number)
            names.append(str(path))
            document = json.loads(Path(self.sample["poses"][mast]).read_text())
            poses.append(str(self.folder / f"S{number}.json"))
            Path(poses[-1]).write_text(json.dumps(document | {"sensor": f"S{number}"}))
        return self.sample | {"names": names, "poses": poses}


def thickened(table: pd.DataFrame) -> pd.DataFrame:
    """Return a recording with `PER_SECOND` detections: more fixed things beside those it has."""
    recorded_s = table["time"].iloc[-1] - table["time"].iloc[0]
    still = (table["range_rate"].abs() <= STILL_MPS).to_numpy()
    times = max(round((PER_SECOND * recorded_s - (~still).sum()) / still.sum()), 1)
    copies = np.where(still, times, 1)
    copy = np.arange(copies.sum()) - np.repeat(np.cumsum(copies) - copies, copies)
    table = table.loc[np.repeat(table.index, copies)]
    beside = np.random.default_rng(1).normal(0.0, SPREAD_M, (times, 2)).astype(np.float32)
    beside[0] = 0.0
    table[["x", "y"]] += beside[copy]
    return table


def write_repeated(
    once: pd.DataFrame, path: Path, seconds: float, *, hours: int = 1, seed: int | None = None
) -> None:
    """Write a recording end to end for some seconds of each hour, each time later.

    With a seed, detections lie centimetres beside: sensors never deliver the same frames.
    """
    after = once["time"].to_numpy() - once["time"].iloc[0]
    span = float(after[-1]) + 0.05
    if seed is not None:
        rng = np.random.default_rng(seed)
        once = once.assign(x=once["x"] + rng.normal(0.0, 0.02, len(once)).astype(np.float32))
    table = pa.Table.from_pandas(once, preserve_index=False)
    place = table.schema.get_field_index("time")
    with pq.ParquetWriter(path, table.schema, **parquet_options(table.schema.names)) as writer:
        for hour in range(hours):
            for begin in np.arange(0.0, seconds, span):
                time = BEGIN + 3600.0 * hour + begin + after
                part = table.set_column(place, table.schema.field(place), pa.array(time))
                writer.write_table(part.filter(pa.array(begin + after < seconds)))


def _minutes(name: str) -> float:
    times = pd.read_parquet(name, columns=["time"])["time"]
    return float(times.iloc[-1] - times.iloc[0]) / 60.0


def _spent(work: Callable[[], object]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin


def missed(figures: Figures) -> list[str]:
    """Return a line for each target that is missed."""
    lines = []
    for what, (sense, bound) in TARGETS.items():
        value = figures.get(what)
        if value is not None and (value < bound if sense == ">=" else value > bound):
            lines.append(f"{what}: {value:.3g}, target {sense} {bound:g}")
    return lines


PARTS = ("hits", "towns", "map", "profile", "memory")


def main(words: Sequence[str] | None = None) -> None:
    """Measure, print and keep the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", type=Path, help="checkout of the version before")
    parser.add_argument("--only", default=",".join(PARTS), help=f"of {', '.join(PARTS)}")
    parser.add_argument("--minutes", type=float, default=60.0, help="of the recording of `hits`")
    parser.add_argument("--hours", type=int, default=10, help="of the longer run of `memory`")
    parser.add_argument("--each", type=float, default=3.0, help="minutes recorded of its hours")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each version")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-dataset.json")
    options = parser.parse_args(words)
    figures = json.loads(options.json.read_text()) if options.json.exists() else {}
    options.json.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(options, Path(name))
        for part in options.only.split(","):
            for what, value in getattr(bench, part)():
                print(f"{what}: {value:.4g}", flush=True)
                figures[what] = value
                options.json.write_text(json.dumps(figures, indent=1) + "\n")
    if lines := missed(figures):
        sys.exit("outside the targets: " + "; ".join(lines))


if __name__ == "__main__":
    main()
