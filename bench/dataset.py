"""Costs of a dataset: CPU time, memory, bytes on disk, time of answers.

    python bench/dataset.py [--only hits,towns,...] [--minutes 60] [--hours 10]

Each measurement is a process of its own on one core; memory is the most that Linux saw.

- `hits`: hits alone of a recording of the sample site, filled up to 500 detections a frame and
  repeated end to end; the share of it that decoding takes; and the reading of the hits.
- `towns`: hits and vehicles of the simulated sites; bytes of a hit and of a state of a vehicle.
- `map`: the heat map of a day in quarters of an hour, 12,000 tiles; with usual traffic, and with
  every tile occupied in every quarter.
- `profile`: occupancy of a street by hour of day over a month of one sensor, in a new process.
- `projected`: the size of detections in the map (`project`), beside that of their recording.
- `memory`: an hour of five sensors with vehicles, and several hours.

Exit code 1 where a figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from drawn_days import write_days
from figures import (
    EXACT_CHANCE,
    SHARE_CHANCE,
    TARGET,
    TIME_CHANCE,
    Figure,
    report,
    run_alone,
    spent_s,
)
from simulated import sites, true_pose

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.dataset.files.tables import HITS, TRACKS
from gis_radar.products import write_projection
from gis_radar.products.heatmap.layers import write_package
from gis_radar.recordings.recording_file import parquet_options

PER_SECOND = 10_000  # detections: 500 at 20 Hz
STILL_MPS, SPREAD_M = 0.15, 3.0  # range rate of what stands; distance of its copies, 1 sigma
BEGIN = 1_780_300_800.0  # of an hour, UNIX seconds
TILES, STREET_TILES, DAYS = 12_000, 4_000, 30
SENSORS = 5
CHILD = """
import json, sys, time
from pathlib import Path
import gis_radar as gr
from gis_radar.recordings.recording import COLUMNS
given = json.loads(sys.argv[1])
def measure(site, folder):
    poses, tiles = [gr.read_pose(name) for name in site["poses"]], gr.read_tiles(site["tiles"])
    only = given["hits_only"]
    roads = None if only else site["map"]
    # repeated traffic looks like clocks that are apart by any number of repetitions
    gr.measure(site["names"], poses, tiles, roads, folder, hits_only=only, check=False)
def spent_s(work):
    begin = time.process_time()
    work()
    return time.process_time() - begin
folder = Path(given["folder"])
measure(given["first"], folder / "first")  # compiles
def read():
    for name in given["names"]:
        sum(map(len, gr.open_recording(name).batches(COLUMNS)))
decode_s = spent_s(read) if given["hits_only"] else 0.0
print(json.dumps({"decode_s": decode_s,
                  "measure_s": spent_s(lambda: measure(given, folder / "made"))}))
"""
PROFILE = """
import json, sys, time
import duckdb, geopandas, pyarrow.parquet
import gis_radar.dataset.questions.answers, gis_radar.dataset.questions.queries
import gis_radar as gr
loaded = time.process_time()
gr.open_dataset(sys.argv[1]).query(
    "SELECT hour(begin) AS hour, sum(occupied_steps) / sum(visible_steps) AS occupancy "
    "FROM tile_counts JOIN tiles USING (tile_id) "
    f"WHERE lanelet_id = {sys.argv[2]} GROUP BY hour ORDER BY hour"
)
print(json.dumps({"query_s": time.process_time() - loaded}))
"""


def aimed(what: str, ours: float, target: float | None, **more: Any) -> Figure:
    """Return a figure with a target, by default one of time or memory."""
    given = {"chance": TIME_CHANCE} | more
    return Figure(what=what, ours=ours, peer=target, peer_name=TARGET, **given)


class Measuring:
    """Runs of `gis_radar.measure` on sites, each in a new process.

    Parameters
    ----------
    folder : Path
        Folder for the datasets.
    rounds : int
        How often a run is repeated for its median.
    """

    def __init__(self, folder: Path, rounds: int = 1) -> None:
        self.folder, self.rounds, self._number = folder, rounds, 0
        self.sample = self.site(gr.sample_folder())

    def site(self, of: Path) -> dict[str, Any]:
        """Return the files of a site: map, tiles, recordings and poses."""
        (map_path,) = of.glob("*.osm")
        place = self.folder / of.name
        place.mkdir()
        gr.write_tiles(gr.make_tiles(gr.read_map(map_path, crs="EPSG:25832")), place / "t.gpkg")
        names = sorted(of.glob("R?.parquet"))
        for name in names:
            true_pose(of, name.stem).write(place / f"{name.stem}.json")
        return {
            "map": str(map_path), "tiles": str(place / "t.gpkg"), "names": list(map(str, names)),
            "poses": [str(place / f"{name.stem}.json") for name in names],
        }  # fmt: skip

    def run(
        self, given: Mapping[str, Any], *, hits_only: bool = False
    ) -> tuple[dict[str, float], Path]:
        """Measure in a new process; return its seconds and memory, and the dataset's folder."""
        self._number += 1
        place = self.folder / f"run{self._number}"
        place.mkdir()
        spec = {"first": self.sample, **given, "hits_only": hits_only, "folder": str(place)}
        ran = run_alone("-c", CHILD, json.dumps(spec))
        return ran.lines[-1] | {"peak_mib": ran.peak_mib}, place / "made"

    def medians(
        self, given: Mapping[str, Any], *, hits_only: bool = False
    ) -> tuple[dict[str, float], Path]:
        """Return the medians of several runs, and the last dataset's folder."""
        runs = [self.run(given, hits_only=hits_only) for _ in range(self.rounds)]
        names = runs[0][0]
        took = {name: float(np.median([row[name] for row, _ in runs])) for name in names}
        return took, runs[-1][1]


class Parts:
    """The parts of the bench, each a method that yields its figures."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.minutes, self.hours = float(options.minutes), int(options.hours)
        self.each, self.folder = float(options.each), folder
        self.measuring = Measuring(folder, options.rounds)
        self.sample = self.measuring.sample

    def hits(self) -> Iterator[Figure]:
        """Yield the figures of hits alone, and of reading them."""
        path = self.folder / "thick.parquet"
        write_repeated(_thickened(self.sample["names"][0]), path, 60.0 * self.minutes)
        given = self.sample | {"names": [str(path)], "poses": self.sample["poses"][:1]}
        took, made = self.measuring.medians(given, hits_only=True)
        speed = pq.read_metadata(path).num_rows / took["measure_s"] / PER_SECOND
        yield aimed(
            "hits of an hour, Parquet to dataset, x real time", speed, None, more_is_better=True
        )
        yield aimed(
            "bare decoding in hits, share", took["decode_s"] / took["measure_s"], 0.24,
            more_is_better=True,
        )  # fmt: skip
        yield aimed("memory of hits, MiB", took["peak_mib"], None)
        dataset = gr.open_dataset(made)
        spent = min(spent_s(lambda: list(dataset.batches(HITS))) for _ in range(3))
        rate = dataset.hours()["hits"].sum() / spent / 1e6
        yield aimed("reading hits, M pairs a second", rate, 20.0, more_is_better=True)

    def towns(self) -> Iterator[Figure]:
        """Yield CPU time a sensor-minute with vehicles, and bytes of the tables."""
        sums = {HITS: np.zeros(2), TRACKS: np.zeros(2)}
        for of in sites("town01", "town02", "town04"):
            given = self.sample if of == gr.sample_folder() else self.measuring.site(of)
            minutes = sum(_minutes(name) for name in given["names"])
            took, made = self.measuring.medians(given)
            what = f"hits and vehicles of {of.name}, CPU s a sensor-minute"
            yield aimed(what, took["measure_s"] / minutes, None)
            hours = gr.open_dataset(made).hours()
            for table, sizes in sums.items():
                parts = made.glob(f"{table.name}/*/*.parquet")
                sizes += [sum(each.stat().st_size for each in parts), hours[table.name].sum()]
        for table, what, target in ((HITS, "hits", 1.25), (TRACKS, "tracks", 5.0)):
            size, count = sums[table]
            name = f"{what} on disk, bytes a {'pair' if table is HITS else 'row'}"
            yield aimed(name, size / count, target, chance=SHARE_CHANCE)

    def map(self) -> Iterator[Figure]:
        """Yield size and time of the heat map of a day."""
        for busy, what, most_mb in ((False, "", 30.0), (True, ", every tile busy", 40.0)):
            dataset = write_days(self.folder / f"day{busy}", tiles=TILES, days=1, busy=busy)
            path = self.folder / f"day{busy}.gpkg"

            def work(dataset: gr.Dataset = dataset, path: Path = path) -> None:
                write_package(gr.make_heatmap(dataset, interval="15min"), path, QUIET)

            spent = spent_s(work)
            yield aimed(f"heat map of a day{what}, MB", path.stat().st_size / 1e6, most_mb)
            yield aimed(f"heat map of a day{what}, s", spent, 10.0)

    def profile(self) -> Iterator[Figure]:
        """Yield the time of a street's occupancy by hour of day."""
        dataset = write_days(self.folder / "month", tiles=STREET_TILES, days=DAYS)
        tiles = dataset.tiles().set_index("tile_id")
        street = tiles.loc[dataset.sights()["tile_id"].iloc[0], "lanelet_id"]
        answers = [run_alone("-c", PROFILE, dataset.folder, street).lines[-1] for _ in range(3)]
        yield aimed("profile of a month, s", min(each["query_s"] for each in answers), 0.5)

    def projected(self) -> Iterator[Figure]:
        """Yield the sizes of detections in the map, as `project` writes them."""
        for site in sites():
            pose, recording = true_pose(site, "R1"), site / "R1.parquet"
            path = self.folder / f"{site.name}.parquet"
            write_projection(recording, pose, path)
            times = path.stat().st_size / recording.stat().st_size
            what = f"`project` in GeoParquet, {site.name}"
            yield aimed(what, times, 2.0, unit="x the recording", chance=EXACT_CHANCE)

    def memory(self) -> Iterator[Figure]:
        """Yield the memory of a full hour of five sensors, and of hours with few minutes."""
        for hours, minutes in ((1, 60.0), (1, self.each), (self.hours, self.each)):
            took, _ = self.measuring.run(self._five_sensors(hours, minutes))
            whole = minutes == 60.0
            what = "an hour" if whole else f"{hours} h, {minutes:g} min of each"
            yield aimed(f"memory of {what}, MiB", took["peak_mib"], 1536.0 if whole else None)

    def _five_sensors(self, hours: int, minutes: float) -> dict[str, Any]:
        """Return files as `site` does, of sensors that record some minutes of each hour."""
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


def _thickened(name: str) -> pd.DataFrame:
    """Return a recording with `PER_SECOND` detections: those that stand have copies beside them."""
    table = pd.read_parquet(name)
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
    """Write a recording that repeats another for some seconds of each hour.

    With a seed, x gets an error of 2 cm and one detection of fifty is left out: copies of another
    sensor's frames would be refused.
    """
    if seed is not None:
        rng = np.random.default_rng(seed)
        once = once.assign(x=once["x"] + rng.normal(0.0, 0.02, len(once)).astype(np.float32))
        once = once[rng.random(len(once)) > 0.02]
    after = once["time"].to_numpy() - once["time"].iloc[0]
    span = np.ceil(after[-1] + 0.05)  # equal for sensors of one site: else their clocks go apart
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


PARTS = ("hits", "towns", "map", "profile", "projected", "memory")  # methods of `Parts`


def main() -> None:
    """Measure the parts, and judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default=",".join(PARTS), help=f"of {', '.join(PARTS)}")
    parser.add_argument("--minutes", type=float, default=60.0, help="of the recording of `hits`")
    parser.add_argument("--hours", type=int, default=10, help="of the longest run of `memory`")
    parser.add_argument("--each", type=float, default=3.0, help="minutes recorded of each of them")
    parser.add_argument("--rounds", type=int, default=3, help="runs of `hits` and `towns`")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        parts = Parts(options, Path(name))
        wanted = options.only.split(",")
        report("dataset", (each for part in wanted for each in getattr(parts, part)()))


if __name__ == "__main__":
    main()
