"""Points to tiles: our engines against shapely's STRtree and geopandas.sjoin, in one run.

Input: the detections on the road of several recordings, in time order, repeated to `--points`.
By default a simulated motorway where it lies beside the project, else the sample junction.
One thread. Building the index is stated apart. Our engines get the points in blocks, as a
recording is read; the peers get theirs at once, which is their best case. Before anything is
timed, the engines and the STRtree must give identical pairs. Exit code 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from plain_grid import TileGridNumpy
from simulated import ROOT, true_pose

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.recordings.parquet_table import ROWS_AT_ONCE
from gis_radar.tiles.lookup import TileEngine

TARGETS = {"sjoin from coordinates": 25.0, "sjoin with points built": 5.0}
ROUNDS = 3


def main() -> None:
    """Time the engines and their peers, print the table, write the JSON."""
    arguments = _arguments()
    tiles, x, y = _input(arguments.site, arguments.points)
    quads = gr.quads(tiles)
    grid, build_s = _timed(lambda: gr.TileGrid(quads))
    tree, tree_build_s = _timed(lambda: gr.TileTree(quads))
    _check(grid, tree, quads, x, y)
    figures = _peers(grid, tree, tiles, quads, x, y)
    ratios = {name: figures["grid"] / figures[name] for name in figures if name != "grid"}
    report = {
        "tiles": len(tiles),
        "points": len(x),
        "site": arguments.site.name,
        "build_s": {"grid": build_s, "rtree": tree_build_s},
        "million_points_per_s": figures,
        "times_faster": ratios,
        "targets": TARGETS,
    }
    print(f"{len(x):,} points on the road of {arguments.site.name}, {len(tiles):,} tiles")
    print(f"index: grid {build_s:.2f} s, rtree {tree_build_s:.2f} s")
    for name, rate in figures.items():
        ratio = f"{ratios[name]:7.1f} x" if name in ratios else ""
        print(f"{name:26s}{rate:9.2f} Mpoints/s{ratio}")
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    missed = [name for name, least in TARGETS.items() if ratios[name] < least]
    if missed:
        sys.exit("below target: " + ", ".join(f"{n} {ratios[n]:.1f} x" for n in missed))


def _arguments() -> Any:
    town = ROOT.parent / "shared" / "data" / "town04"
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--site", type=Path, default=town if town.exists() else gr.sample_folder())
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-assignment.json")
    return parser.parse_args()


def _input(site: Path, count: int) -> tuple[gpd.GeoDataFrame, Floats, Floats]:
    """Return a site's tiles and `count` footprints on them, in the order they were seen."""
    tiles = gr.make_tiles(gr.read_map(next(site.glob("*.osm"))))
    grid = gr.TileGrid(gr.quads(tiles))
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


def _check(
    grid: gr.TileGrid, tree: gr.TileTree, quads: Floats, x: Floats, y: Floats, count: int = 300_000
) -> None:
    """Stop unless both engines and the STRtree find the same pairs (no point lies on an edge)."""
    x, y = x[:count], y[:count]
    strtree = shapely.STRtree(_polygons(quads))
    point, tile = strtree.query(shapely.points(x, y), predicate="intersects")
    order = np.lexsort((tile, point))
    for engine in (grid, tree):
        found = engine.assign(x, y)
        if not (np.array_equal(found[0], point[order]) and np.array_equal(found[1], tile[order])):
            sys.exit(f"{type(engine).__name__} and shapely.STRtree disagree")


def _polygons(quads: Floats) -> Any:
    return shapely.polygons(np.concatenate([quads, quads[:, :1]], axis=1))


def _peers(
    grid: gr.TileGrid,
    tree: gr.TileTree,
    tiles: gpd.GeoDataFrame,
    quads: Floats,
    x: Floats,
    y: Floats,
) -> dict[str, float]:
    """Return million points a second of each way, the slower ones on fewer points."""
    few = min(len(x), 1_000_000)
    polygons = tiles[["tile_id", "geometry"]]
    strtree = shapely.STRtree(_polygons(quads))
    built = gpd.GeoDataFrame(geometry=gpd.points_from_xy(x[:few], y[:few], crs=tiles.crs))
    points = built.geometry.array
    plain = TileGridNumpy(quads)

    def from_coordinates() -> Any:
        made = gpd.GeoDataFrame(geometry=gpd.points_from_xy(x[:few], y[:few], crs=tiles.crs))
        return gpd.sjoin(made, polygons, predicate="intersects")

    ways: dict[str, tuple[Callable[[], Any], int]] = {
        "grid": (lambda: _in_blocks(grid, x, y), len(x)),
        "sjoin from coordinates": (from_coordinates, few),
        "sjoin with points built": (
            lambda: gpd.sjoin(built, polygons, predicate="intersects"),
            few,
        ),
        "STRtree with points built": (
            lambda: strtree.query(points, predicate="intersects"),
            few,
        ),
        "grid in NumPy": (lambda: _in_blocks(plain, x[:few], y[:few]), few),
        "rtree": (lambda: _in_blocks(tree, x[: few // 4], y[: few // 4]), few // 4),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, (way, _) in ways.items():
            times[name].append(_timed(way)[1])
    return {name: ways[name][1] / statistics.median(times[name]) / 1e6 for name in ways}


def _in_blocks(engine: TileEngine, x: Floats, y: Floats) -> int:
    """Assign block by block; return the number of pairs."""
    return sum(
        len(engine.assign(x[at : at + ROWS_AT_ONCE], y[at : at + ROWS_AT_ONCE])[0])
        for at in range(0, len(x), ROWS_AT_ONCE)
    )


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    # All ways run in one thread: its own time does not count what else the machine does.
    begin = time.thread_time()
    result = work()
    return result, time.thread_time() - begin


if __name__ == "__main__":
    main()
