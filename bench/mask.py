"""The road mask: time against the bare reading of a scan, memory from few tiles to many.

Time: `mask_road` with the built-in engine against `laspy` with lazrs reading the same file. Memory:
tiles of two million points side by side, masked in a process of its own; the figure is the largest
memory that Linux saw it hold since it began. Exit code 1 over a target.

With `--sensitivity SITE`, a folder with `map.osm`, `als.laz`, `truth.json` and recordings: every
number of the settings halved and doubled; the mask against the map's heights, and the scan check
at the true pose of the first sensor and 3.5 m beside it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import shapely
from pyproj import CRS

import gis_radar as gr
from gis_radar.calibration import ScanCheckSettings
from gis_radar.errors import GisRadarError
from gis_radar.scans.engines import write_layer
from gis_radar.scans.pdal import find_pdal
from gis_radar.scans.roads import RoadLevel, Roads, roads_of_map
from gis_radar.scans.settings import MaskSettings, RoadSettings

ROOT = Path(__file__).parent.parent
TARGET_READS = 5.0
TARGET_GROWTH = 1.5
CRS_OF_TILES = CRS.from_epsg(25832)
EAST, NORTH = 678_000.0, 5_403_600.0
TILE_M, TILE_POINTS, STREET_M = 400.0, 2_000_000, 20.0
CHILD = """
import re, sys
from pathlib import Path
import gis_radar as gr
layer, *tiles = sys.argv[1:]
mask = gr.mask_road(tiles, gr.read_roads(layer), engine="laspy")
mask.write(layer + ".laz")
peak = re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]
print(len(mask.points), peak)
"""


def main() -> None:
    """Measure, print and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--map", type=Path, default=gr.sample_folder() / "junction.osm")
    parser.add_argument("--scan", type=Path, help="by default a made one of two million points")
    parser.add_argument("--tiles", type=int, default=10, help="of two million points each")
    parser.add_argument("--sensitivity", type=Path, metavar="SITE")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-mask.json")
    arguments = parser.parse_args()
    if arguments.sensitivity:
        _sensitivity(arguments.sensitivity)
        return
    with tempfile.TemporaryDirectory() as name:
        report = {"time": _time(arguments.scan, arguments.map, Path(name))}
        report["memory"] = _memory(arguments.tiles, Path(name))
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    reads, growth = report["time"]["times_reading"], report["memory"]["growth"]
    if reads > TARGET_READS or growth > TARGET_GROWTH:
        sys.exit(f"over a target: {reads:.1f} x reading, memory grows {growth:.2f} x")


def _time(scan: Path | None, map_path: Path, folder: Path) -> dict[str, float]:
    roads = _streets(1)
    if scan is not None:
        roads = roads_of_map(gr.read_map(map_path))
    path = scan or _write_tile(folder / "speed.laz", 0)
    reading_s = _best(lambda: laspy.read(path).xyz)
    report = {"reading_s": reading_s}
    engines = ["laspy", *(["pdal"] if find_pdal() else [])]
    for engine in engines:
        taken_s = _best(lambda name=engine: gr.mask_road([path], roads, engine=name))  # type: ignore[misc]
        report[f"{engine}_s"] = taken_s
        print(f"{engine}: {taken_s:.2f} s, {taken_s / reading_s:.1f} x reading {reading_s:.2f} s")
    report["times_reading"] = report["laspy_s"] / reading_s
    return report


def _memory(count: int, folder: Path) -> dict[str, float]:
    paths = [_write_tile(folder / f"{number}.laz", number) for number in range(count)]
    report: dict[str, float] = {}
    for name, some in (("one_tile", paths[:1]), ("all_tiles", paths)):
        layer = folder / f"{name}.gpkg"
        write_layer(_streets(len(some)), layer)
        begin = time.perf_counter()
        answer = subprocess.run(
            [sys.executable, "-c", CHILD, layer, *some], check=True, capture_output=True, text=True
        )
        cells, peak_kib = map(int, answer.stdout.split())
        report[f"{name}_mib"] = peak_kib / 1024
        taken_s = time.perf_counter() - begin
        print(f"{len(some) * TILE_POINTS:,} points: {peak_kib / 1024:.0f} MiB, {taken_s:.0f} s, "
              f"{cells:,} cells")  # fmt: skip
    report["points"] = count * TILE_POINTS
    report["growth"] = report["all_tiles_mib"] / report["one_tile_mib"]
    return report


def _sensitivity(site: Path) -> None:
    """Print the figures of mask and scan check with each setting halved and doubled."""
    roads = RoadSettings()
    cases: tuple[tuple[Callable[[Path, Any], str], Any, Callable[[Any], Any]], ...] = (
        (_measure_mask, roads, lambda changed: MaskSettings(roads=changed)),
        (_measure_mask, MaskSettings(), lambda changed: changed),
        (_measure_look, ScanCheckSettings(), lambda changed: changed),
    )
    for measure, settings, read in cases:
        print(f"as set: {measure(site, read(settings))}", flush=True)
        for name, value in vars(settings).items():
            for factor in (0.5, 2.0) if value != roads else ():
                scaled = np.multiply(value, factor).tolist()
                change = max(1, int(scaled)) if isinstance(value, int) else scaled
                try:
                    figures = measure(site, read(replace(settings, **{name: change})))
                except (GisRadarError, ValueError, IndexError) as error:
                    figures = f"{type(error).__name__}: {error}"
                print(f"{name} {change}: {figures}", flush=True)


def _measure_mask(site: Path, settings: MaskSettings) -> str:
    """Return the share of cells, and their distance to the map's heights: median, 99 %, largest."""
    roads = roads_of_map(gr.read_map(site / "map.osm"), settings=settings.roads)
    mask = gr.mask_road([site / "als.laz"], roads, engine="laspy", settings=settings)
    heights = [level.height_near(mask.points[:, :2]) for level in roads.levels if level.has_heights]
    off_m = np.min([np.abs(mask.points[:, 2] - height) for height in heights], axis=0)
    figures = (mask.covered, *np.percentile(off_m, (50, 99, 100)))
    return " ".join(f"{figure:.4f}" for figure in figures)


def _measure_look(site: Path, settings: ScanCheckSettings) -> str:
    """Return score and verdict at the true pose of a sensor, and a lane beside it."""
    sensor, truth = next(iter(json.loads((site / "truth.json").read_text()).items()))
    names = ("easting", "northing", "height", "yaw", "pitch", "roll")
    pose = gr.Pose(sensor=sensor, crs=CRS_OF_TILES, **{name: truth[name] for name in names})
    left_m = 3.5 * pose.R_map_sensor[:2, 1]
    beside = replace(pose, easting=pose.easting + left_m[0], northing=pose.northing + left_m[1])
    found = []
    for one in (pose, beside):
        scans = [site / "als.laz"]
        look = gr.check_against_scan(site / f"{sensor}.parquet", one, scans, settings=settings)
        found.append(f"{look.verdict} {look.score:.2f} {look.z_score:.1f}")
    return ", ".join(found)


def _best(call: Callable[[], object]) -> float:
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def _write_tile(path: Path, number: int) -> Path:
    """Write an unclassified tile: a slope with houses beside the streets."""
    rng = np.random.default_rng(number)
    xy = rng.uniform(0.0, TILE_M, (TILE_POINTS, 2))
    middle = np.abs(xy - TILE_M / 2).min(axis=1)
    house = (middle > STREET_M) & ((xy // 25.0).sum(axis=1) % 2 == 0)
    z = 400.0 + 0.02 * xy[:, 0] + rng.normal(0.0, 0.03, len(xy)) + 9.0 * house
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.01), np.array([EAST, NORTH, 0.0])
    header.add_crs(CRS_OF_TILES)
    las = laspy.LasData(header)
    las.xyz = np.column_stack([xy + _corner(number), z])
    las.classification = np.ones(len(xy), np.uint8)
    las.return_number = las.number_of_returns = np.ones(len(xy), np.uint8)
    las.write(path)
    return path


def _corner(number: int) -> tuple[float, float]:
    return EAST + number % 10 * TILE_M, NORTH + number // 10 * TILE_M


def _streets(count: int) -> Roads:
    """Return two crossing streets a tile, a tenth of its area."""
    shapes = []
    for number in range(count):
        west, south = _corner(number)
        low, high = (TILE_M - STREET_M) / 2, (TILE_M + STREET_M) / 2
        shapes.append(shapely.box(west, south + low, west + TILE_M, south + high))
        shapes.append(shapely.box(west + low, south, west + high, south + TILE_M))
    parts = shapely.get_parts(shapely.union_all(shapes))
    area = shapely.MultiPolygon(list(parts))
    return Roads(crs=CRS_OF_TILES, area=area, levels=(RoadLevel(shapes=parts),), source="streets")


if __name__ == "__main__":
    main()
