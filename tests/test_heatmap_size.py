"""A heat map takes little room: a day of quarter hours of 12,000 tiles is under 40 MB."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyogrio
import pytest

sys.path.append(str(Path(__file__).parents[1] / "bench"))

from sizes import TARGET_MB, TILES, day

from gis_radar.heatmap.layers import write_package
from gis_radar.progress import QUIET

MOST_BYTES = 1e6 * TARGET_MB / (TILES * 96)  # of a tile in an interval, its share of all else too


def written(heat, path):
    write_package(heat, path, QUIET)
    return path


@pytest.mark.parametrize("busy", [True, False])
def test_a_tile_in_an_interval_takes_few_bytes(tmp_path, busy):
    few, many = (
        written(day(tiles, 96, busy=busy), tmp_path / f"{tiles}.gpkg").stat().st_size
        for tiles in (200, 1200)
    )
    assert (many - few) / (1000 * 96) < MOST_BYTES


def test_the_most_columns_and_thousands_of_tiles_read_as_made(tmp_path):
    for heat in (day(200, 500, busy=False), day(4300, 2, busy=False)):
        path = written(heat, tmp_path / f"{len(heat.tiles)}.gpkg")
        layer = pyogrio.list_layers(path)[0, 0]  # what programs open that are given none
        assert layer == "heatmap"
        read, wide = pyogrio.read_dataframe(path, layer=layer), heat.wide()
        assert list(read) == list(wide)
        names = [name for name in wide if name.startswith(("hit_2", "occ_2"))]
        assert len(names) == 2 * len(heat.timeline)
        np.testing.assert_array_equal(read[names], wide[names])
