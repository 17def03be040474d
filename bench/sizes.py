"""Sizes of files: the heat map of a day in quarter hours, and detections in the map.

The day is simulated: 12,000 tiles, of which lanes out of sight are a fifth, with few vehicles at
night; and one in which every tile is busy in every interval, and frames are missing in each.
Exit code 1 over a target.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from simulated import ROOT, sites, true_pose

import gis_radar as gr
from gis_radar.heatmap import HeatMap
from gis_radar.heatmap.intervals import Timeline
from gis_radar.heatmap.layers import write_package
from gis_radar.heatmap.occupancy import Occupancy
from gis_radar.progress import QUIET
from gis_radar.tiles.tiles import fingerprint

TILES, INTERVALS = 12_000, 96
TILES_A_LANE = 200
LENGTH_M = 0.5
QUARTER = 18_000  # steps
FIRST = 35_258_040_000 // QUARTER * QUARTER  # a step of November 2025
VIEWS = 4  # sets of sensors that see the same tiles
TARGET_MB = 40.0
TARGET_TIMES = 2.0


def main() -> None:
    """Write the files, print and keep their sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-sizes.json")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"tiles": TILES, "intervals": INTERVALS, "heatmap_mb": {}}
    with tempfile.TemporaryDirectory() as name:
        for busy, what in ((False, "as usual"), (True, "every tile busy")):
            path = Path(name) / f"{busy}.gpkg"
            write_package(day(TILES, INTERVALS, busy=busy), path, QUIET)
            report["heatmap_mb"][what] = path.stat().st_size / 1e6
            print(f"heatmap.gpkg of a day, {what}: {report['heatmap_mb'][what]:.1f} MB")
        for site in sites():
            times = projected(site, Path(name) / "hits.parquet")
            report.setdefault("projected_times", {})[site.name] = times
            print(f"detections of {site.name} in the map: {times:.2f} x the recording")
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if max(report["heatmap_mb"].values()) > TARGET_MB:
        sys.exit(f"the heat map of a day takes over {TARGET_MB:.0f} MB")
    if max(report["projected_times"].values()) > TARGET_TIMES:
        sys.exit(f"detections in the map take over {TARGET_TIMES:g} times the recording")


def projected(site: Path, path: Path) -> float:
    """Return the size of a sensor's detections in the map, over that of its recording."""
    pose, recording = true_pose(site, "R1"), site / "R1.parquet"
    roads = gr.read_map(next(site.glob("*.osm")), crs=pose.crs)
    gr.write_projection(recording, pose, path, roads=roads)
    return path.stat().st_size / recording.stat().st_size


def day(tiles: int, intervals: int, *, busy: bool) -> HeatMap:
    """Return a heat map with occupancy: as usual, or with each tile busy in each interval."""
    rng = np.random.default_rng(1)
    lane = np.arange(tiles) // TILES_A_LANE
    lanes = int(lane[-1]) + 1
    table = lanes_of_tiles(tiles, rng)
    in_sight = np.ones(lanes, np.bool_) if busy else rng.random(lanes) < 0.8
    seen = np.flatnonzero(in_sight[lane])
    group = rng.integers(0, VIEWS, lanes)[lane[seen]]
    observed = np.full((intervals, VIEWS), QUARTER)
    observed[:, : VIEWS if busy else 1] -= rng.integers(0, 3000, (intervals, 1))
    of_tile, shape = observed[:, group], (intervals, len(seen))
    if busy:
        hidden, occupied = rng.integers(129, 3000, shape), rng.uniform(0.02, 0.9, shape)
    else:
        hidden = (rng.random(shape) < 0.3) * rng.integers(0, 2000, shape)
        rate = by_hour(intervals)[:, None] * rng.gamma(0.7, 0.15, lanes)[lane[seen]]
        vehicles = rng.poisson(120.0 * rate)  # a quarter hour
        occupied = np.minimum(vehicles * rng.uniform(6, 40, shape) / QUARTER, 0.95)
    visible = of_tile - hidden
    steps = (visible * occupied).astype(np.uint32)
    error = np.clip(np.sqrt(6.0 * steps) / visible, 2.0 / visible, 1.0).astype(np.float32)
    edges = FIRST + QUARTER * np.arange(intervals + 1)
    return HeatMap(
        tiles=table, fingerprint=fingerprint(table), sensors=("R1", "R2"), seen=seen,
        whole=Timeline(begin=edges[:1], end=edges[-1:]), observed=of_tile.astype(np.uint32),
        timeline=Timeline(begin=edges[:-1], end=edges[1:]),
        hit=(steps * rng.uniform(0.1, 0.4, shape)).astype(np.uint32),
        occupancy=Occupancy(
            visible=visible.astype(np.uint32), occupied=steps, error=error,
            error_whole=error.mean(axis=0),
        ),
    )  # fmt: skip


def by_hour(intervals: int) -> np.ndarray:
    """Return traffic over a day, 1 at most: little at night."""
    hour = 24.0 * np.arange(intervals) / intervals
    return np.clip(np.sin((hour - 4.0) / 20.0 * np.pi), 0.02, 1.0) ** 1.5


def lanes_of_tiles(tiles: int, rng: np.random.Generator) -> gpd.GeoDataFrame:
    """Return straight lanes in all directions, cut into tiles."""
    number = np.arange(tiles)
    lane, index = number // TILES_A_LANE, number % TILES_A_LANE
    lanes = int(lane[-1]) + 1
    east, north = rng.uniform(-500.0, 500.0, (2, lanes)) + np.array([[691_000.0], [5_336_000.0]])
    way = rng.uniform(0.0, 2.0 * np.pi, lanes)
    along, across = LENGTH_M * (index[:, None] + [0, 0, 1, 1]), np.array([1.6, -1.6, -1.6, 1.6])
    cos, sin = np.cos(way)[lane, None], np.sin(way)[lane, None]
    corners = np.stack(
        [
            east[lane, None] + along * cos - across * sin,
            north[lane, None] + along * sin + across * cos,
        ],
        axis=-1,
    )
    ids = np.sort(rng.integers(1, 2**62, lanes))[lane]
    columns = {
        "tile_id": number, "lanelet_id": ids, "index": index, "s_m": LENGTH_M * index,
        "length_m": LENGTH_M, "width_m": 3.2 + 0.01 * rng.random(tiles),
        "height_m": 370.0 + rng.random(tiles), "subtype": "road", "lane": ids,
    }  # fmt: skip
    return gpd.GeoDataFrame(columns, geometry=shapely.polygons(corners), crs="EPSG:25832")


if __name__ == "__main__":
    main()
