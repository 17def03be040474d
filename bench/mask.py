"""Road mask: time beside the bare reading of a scan, memory of one tile of a scan and of many.

Time: `mask_road` with each engine, beside `laspy` with lazrs reading the same file. Memory: most
that Linux saw a process hold that masks tiles of two million points. Exit code 1 over a target.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
import shapely
from figures import TIME_CHANCE, Figure, report, run_alone
from pyproj import CRS

import gis_radar as gr
from gis_radar.scans import Roads, find_pdal
from gis_radar.scans.engines import write_layer
from gis_radar.scans.roads import RoadLevel

TARGET_READS = 5.0  # time of the mask over that of the reading, at most
TARGET_GROWTH = 1.5  # memory with many tiles over that with one, at most
CRS_OF_TILES = CRS.from_epsg(25832)
EAST, NORTH = 678_000.0, 5_403_600.0  # corner of the first tile
TILE_M, TILE_POINTS, STREET_M = 400.0, 2_000_000, 20.0
CHILD = """
import sys
import gis_radar as gr
layer, *tiles = sys.argv[1:]
gr.mask_road(tiles, layer, engine="laspy").write(layer + ".laz")
"""


def main() -> None:
    """Measure, and judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", type=int, default=10, help="of two million points each")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        found = [*_time(Path(name)), _memory(arguments.tiles, Path(name))]
    report("mask", found)
    reads, growth = found[0].ratio or 0.0, found[-1].ratio or 0.0
    if reads > TARGET_READS or growth > TARGET_GROWTH:
        sys.exit(f"over a target: {reads:.1f} x reading, memory grows {growth:.2f} x")


def _time(folder: Path) -> Iterator[Figure]:
    path, roads = _write_tile(folder / "speed.laz", 0), _streets(1)
    reading_s = _best(lambda: laspy.read(path).xyz)
    for engine, about in (("laspy", "built-in engine"), ("pdal", "PDAL")):
        if engine == "laspy" or find_pdal():
            yield Figure(
                what=f"road mask, {about}, a scan of 2 M points", unit="s", chance=TIME_CHANCE,
                ours=_best(lambda name=engine: gr.mask_road([path], roads, engine=name)),  # type: ignore[misc]
                peer=reading_s, peer_name="the bare reading by laspy and lazrs",
            )  # fmt: skip


def _memory(count: int, folder: Path) -> Figure:
    paths = [_write_tile(folder / f"{number}.laz", number) for number in range(count)]
    peaks = []
    for some in (paths[:1], paths):
        layer = folder / f"{len(some)}.gpkg"
        write_layer(_streets(len(some)), layer)
        peaks.append(run_alone("-c", CHILD, layer, *some).peak_mib)
    return Figure(
        what=f"memory of the road mask of {count * TILE_POINTS // 1_000_000} M points", unit="MiB",
        ours=peaks[1], peer=peaks[0], peer_name="that of 2 M points", chance=TIME_CHANCE,
    )  # fmt: skip


def _best(call: Callable[[], object]) -> float:
    """Return the shortest of three times that a call takes, seconds."""
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def _write_tile(path: Path, number: int) -> Path:
    """Write an unclassified tile of a scan: a slope with houses beside two streets."""
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
    """Return two crossing streets in each tile, a tenth of its area."""
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
