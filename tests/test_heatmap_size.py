"""A heat map takes little room: a day of quarter hours of 12,000 tiles is under 40 MB."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyogrio

sys.path.append(str(Path(__file__).parents[1] / "bench"))

from drawn_days import tiles_of_lanes, write_days

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.hdmap import fingerprint
from gis_radar.products import HeatMap
from gis_radar.products.heatmap.intervals import Timeline
from gis_radar.products.heatmap.layers import write_package
from gis_radar.products.heatmap.occupancy import Occupancy

MOST_BYTES = 40e6 / (12_000 * 96)  # of a tile in an interval, its share of all else too
QUARTER = 18_000  # steps
FIRST = 35_258_040_000 // QUARTER * QUARTER


def test_a_tile_in_an_interval_takes_few_bytes(tmp_path):
    dataset = write_days(tmp_path / "day", tiles=1000, days=1, busy=True)
    path = tmp_path / "heatmap.gpkg"
    write_package(gr.make_heatmap(dataset, interval="15min"), path, QUIET)
    assert path.stat().st_size / (1000 * 96) < MOST_BYTES


def counted(tiles, intervals):
    """A heat map of all tiles with any counts."""
    rng = np.random.default_rng(1)
    table, shape = tiles_of_lanes(tiles, rng), (intervals, tiles)
    visible = rng.integers(1, QUARTER, shape).astype(np.uint32)
    occupied = rng.integers(0, visible + 1).astype(np.uint32)
    error = rng.random(shape).astype(np.float32)
    edges = FIRST + QUARTER * np.arange(intervals + 1)
    return HeatMap(
        tiles=table, fingerprint=fingerprint(table), sensors=("R1", "R2"), seen=np.arange(tiles),
        whole=Timeline(begin=edges[:1], end=edges[-1:]), observed=visible, hit=occupied,
        timeline=Timeline(begin=edges[:-1], end=edges[1:]),
        occupancy=Occupancy(
            visible=visible, occupied=occupied, error=error, error_whole=error.mean(axis=0)
        ),
    )  # fmt: skip


def test_the_most_columns_read_as_made(tmp_path):
    heat, path = counted(50, 500), tmp_path / "heatmap.gpkg"
    write_package(heat, path, QUIET)
    layer = pyogrio.list_layers(path)[0, 0]  # what programs open that are given none
    assert layer == "heatmap"
    read, wide = pyogrio.read_dataframe(path, layer=layer), heat.wide()
    assert list(read) == list(wide)
    names = [name for name in wide if name.startswith(("hit_2", "occ_2"))]
    assert len(names) == 2 * 500
    np.testing.assert_array_equal(read[names], wide[names])
