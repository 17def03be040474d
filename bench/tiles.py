"""Time to make a million tiles from lanelets and to write them as a GeoPackage.

Copies of the sample's lanelets lie side by side until they make `--tiles` tiles. The peer is the
writing of the same polygons without attributes by pyogrio. Exit code 1 over the target.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
from figures import TIME_CHANCE, Figure, report

import gis_radar as gr

TARGET_S = 30.0


def main() -> None:
    """Make the tiles, write them, and judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", type=int, default=1_000_000)
    arguments = parser.parse_args()
    roads = _city(gr.read_map(gr.sample_folder() / "junction.osm"), arguments.tiles)
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        tiles = gr.make_tiles(roads)
        gr.write_tiles(tiles, Path(folder) / "tiles.gpkg", problems=roads.problems)
        total_s = time.perf_counter() - begin
        bare = tiles[["geometry"]]
        begin = time.perf_counter()
        pyogrio.write_dataframe(bare, Path(folder) / "bare.gpkg", use_arrow=True)
        bare_s = time.perf_counter() - begin
    figure = Figure(
        what="a million tiles, made and written as GeoPackage", ours=total_s, unit="s",
        peer=bare_s, peer_name="the bare writing of the polygons", chance=TIME_CHANCE,
    )  # fmt: skip
    report("tiles", [figure])
    if total_s > TARGET_S:
        sys.exit(f"over the target of {TARGET_S:g} s: {total_s:.1f} s")


def _city(roads: gr.LaneletMap, tiles: int) -> gr.LaneletMap:
    """Return copies of a map a kilometre apart, enough for so many tiles."""
    one = roads.lanelets
    copies = -(-tiles // len(gr.make_tiles(roads)))
    parts = []
    for copy in range(copies):
        shift = np.array([copy % 40, copy // 40]) * 1000.0
        part = one.assign(lanelet_id=one["lanelet_id"] + copy * 10_000_000)
        for column in ("left", "right", "geometry"):
            part[column] = gpd.GeoSeries(one[column]).translate(*shift)
        parts.append(part)
    return gr.LaneletMap(**{**vars(roads), "lanelets": pd.concat(parts, ignore_index=True)})


if __name__ == "__main__":
    main()
