"""Assignment of points to tiles: our engines beside shapely's STRtree and geopandas.sjoin.

Input: the detections on the road of a site's recordings, one after the other, repeated to
`--points`. The site is by default town04, where it is there (`simulated.py`), else the sample.
All run in one thread. Our engines get the points in blocks, as a recording is read; the peers get
theirs at once, which is their best case. Before anything is timed, the engines and the STRtree must
give identical pairs. Exit code 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from figures import TIME_CHANCE, Figure, report
from simulated import DATA, true_pose
from tile_oracles import TileEngine, TileGridNumpy, TileTree

import gis_radar as gr
from gis_radar.base import Floats
from gis_radar.hdmap import TileGrid, polygons, quads
from gis_radar.recordings.parquet_table import ROWS_AT_ONCE

TARGETS = {"sjoin from coordinates": 25.0, "sjoin with points built": 5.0}  # times as fast
ROUNDS = 3


def main() -> None:
    """Time the engines and their peers, and judge."""
    town = DATA / "town04"
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--site", type=Path, default=town if town.exists() else gr.sample_folder())
    parser.add_argument("--points", type=int, default=10_000_000)
    arguments = parser.parse_args()
    tiles, x, y = _input(arguments.site, arguments.points)
    rates = _rates(tiles, x, y)
    report("assignment", _figures(rates, len(tiles)))
    ratios = {name: rates["grid"] / rates[name] for name in TARGETS}
    if missed := [name for name, least in TARGETS.items() if ratios[name] < least]:
        sys.exit("below target: " + ", ".join(f"{n} {ratios[n]:.1f} x" for n in missed))


def _figures(rates: dict[str, float], tiles: int) -> Iterator[Figure]:
    for peer in (each for each in rates if each != "grid"):
        yield Figure(
            what=f"points to tiles in one thread, beside {peer}", ours=rates["grid"],
            unit="M points/s", peer=rates[peer], peer_name=peer, more_is_better=True,
            chance=TIME_CHANCE, size=f"{tiles:,} tiles",
        )  # fmt: skip


def _input(site: Path, count: int) -> tuple[gpd.GeoDataFrame, Floats, Floats]:
    """Return a site's tiles, and easting and northing of `count` detections on them."""
    tiles = gr.make_tiles(gr.read_map(next(site.glob("*.osm"))))
    grid = TileGrid(quads(tiles))
    batches = []
    for path in sorted(site.glob("R*.parquet")):
        pose = true_pose(site, path.stem)
        for detections in gr.open_recording(path).read():
            footprint = pose.to_map(detections.points[detections.present])[:, :2]
            on_road, _ = grid.assign(footprint[:, 0], footprint[:, 1])
            batches.append(footprint[np.unique(on_road)])
    points = np.concatenate(batches)
    repeated = np.tile(points, (-(-count // len(points)), 1))[:count]
    return tiles, np.ascontiguousarray(repeated[:, 0]), np.ascontiguousarray(repeated[:, 1])


def _check(engines: tuple[TileEngine, ...], strtree: shapely.STRtree, x: Floats, y: Floats) -> None:
    """Exit unless the engines and the STRtree find the same pairs (no point lies on an edge)."""
    point, tile = strtree.query(shapely.points(x, y), predicate="intersects")
    order = np.lexsort((tile, point))
    for engine in engines:
        found = engine.assign(x, y)
        if not (np.array_equal(found[0], point[order]) and np.array_equal(found[1], tile[order])):
            sys.exit(f"{type(engine).__name__} and shapely.STRtree disagree")


def _rates(tiles: gpd.GeoDataFrame, x: Floats, y: Floats) -> dict[str, float]:
    """Return million points a second of each engine and peer; slow ones get fewer points."""
    corners = quads(tiles)
    grid, tree, plain = TileGrid(corners), TileTree(corners), TileGridNumpy(corners)
    strtree = shapely.STRtree(polygons(corners))
    _check((grid, tree), strtree, x[:300_000], y[:300_000])
    few = min(len(x), 1_000_000)
    shapes = tiles[["tile_id", "geometry"]]

    def made() -> gpd.GeoDataFrame:
        return gpd.GeoDataFrame(geometry=gpd.points_from_xy(x[:few], y[:few], crs=tiles.crs))

    built = made()
    points = built.geometry.array
    ways: dict[str, tuple[Callable[[], Any], int]] = {
        "grid": (lambda: _in_blocks(grid, x, y), len(x)),
        "sjoin from coordinates": (
            lambda: gpd.sjoin(made(), shapes, predicate="intersects"), few
        ),
        "sjoin with points built": (
            lambda: gpd.sjoin(built, shapes, predicate="intersects"), few
        ),
        "STRtree with points built": (lambda: strtree.query(points, predicate="intersects"), few),
        "grid in NumPy": (lambda: _in_blocks(plain, x[:few], y[:few]), few),
        "rtree": (lambda: _in_blocks(tree, x[: few // 4], y[: few // 4]), few // 4),
    }  # fmt: skip
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, (way, _) in ways.items():
            # CPU time of this thread: other programs do not count
            begin = time.thread_time()
            way()
            times[name].append(time.thread_time() - begin)
    return {name: ways[name][1] / statistics.median(times[name]) / 1e6 for name in ways}


def _in_blocks(engine: TileEngine, x: Floats, y: Floats) -> int:
    """Assign block by block; return the number of pairs."""
    return sum(
        len(engine.assign(x[at : at + ROWS_AT_ONCE], y[at : at + ROWS_AT_ONCE])[0])
        for at in range(0, len(x), ROWS_AT_ONCE)
    )


if __name__ == "__main__":
    main()
