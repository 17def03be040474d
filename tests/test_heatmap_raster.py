"""The GeoTIFF of a heat map, against shapely and GDAL pixel by pixel."""

from __future__ import annotations

import numpy as np
import pyogrio
import pytest
import rasterio
import rasterio.features
import shapely
from counted_sites import T0, lane_tiles, make_site, two_sensors
from maps import Listener

from gis_radar.products import make_heatmap


@pytest.fixture(scope="module")
def heatmap():
    site = two_sensors()
    return make_heatmap(site.dataset, interval="5s")


@pytest.fixture(scope="module")
def folder(heatmap, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site") / "heat map"
    heatmap.write(folder)
    return folder


def highest_at_centres(heatmap, interval, raster):
    """Find the highest hit share at each pixel's centre with shapely alone."""
    share = heatmap.shares(interval).hit_share
    columns, lines = np.meshgrid(np.arange(raster.width), np.arange(raster.height))
    x = raster.bounds.left + (columns.ravel() + 0.5) * 0.5
    y = raster.bounds.top - (lines.ravel() + 0.5) * 0.5
    tree = shapely.STRtree(heatmap.tiles.geometry.to_numpy())
    point, tile = tree.query(shapely.points(x, y), predicate="within")
    wanted = np.full(raster.width * raster.height, np.nan)
    np.fmax.at(wanted, point, share[tile])
    return wanted.reshape(raster.shape).astype(np.float32)


def test_pixels_follow_the_tiles(heatmap, folder):
    with rasterio.open(folder / "hits.tif") as raster:
        assert raster.count == 5
        for band, interval in enumerate([None, 0, 1, 2, 3], start=1):
            wanted = highest_at_centres(heatmap, interval, raster)
            np.testing.assert_array_equal(raster.read(band), wanted)
            assert np.isfinite(wanted).any()
            assert np.isnan(wanted).any()


def test_pixels_are_those_of_gdal(heatmap, folder):
    share = heatmap.shares().hit_share
    order = np.argsort(share)  # later ones overwrite; NaN is last and left out
    shapes = [(heatmap.tiles.geometry[i], share[i]) for i in order if not np.isnan(share[i])]
    with rasterio.open(folder / "hits.tif") as raster:
        burnt = rasterio.features.rasterize(
            shapes, raster.shape, fill=np.nan, transform=raster.transform, dtype="float32"
        )
        np.testing.assert_array_equal(raster.read(1), burnt)


def test_pixels_are_aligned_and_bands_described(heatmap, folder):
    with rasterio.open(folder / "hits.tif") as raster:
        assert raster.dtypes[0] == "float32"
        assert np.isnan(raster.nodata)
        assert raster.crs.to_epsg() == 25832
        assert raster.res == (0.5, 0.5)
        assert (np.array(raster.bounds) % 0.5 == 0.0).all()
        assert raster.descriptions == (
            "whole time, 2023-11-14T22:13:20Z to 2023-11-14T22:13:40Z",
            "2023-11-14T22:13:20Z",
            "2023-11-14T22:13:25Z",
            "2023-11-14T22:13:30Z",
            "2023-11-14T22:13:35Z",
        )
        seen = heatmap.tiles.geometry.iloc[:13].total_bounds
        assert np.abs(np.array(raster.bounds) - seen).max() < 0.5


def test_no_half_pixel_shift(tmp_path):
    """Tiles that are single pixels come out as exactly these pixels."""
    tiles = lane_tiles(4)
    corners = [(677_885.0 + i, 5_403_673.5 + 0.5 * i) for i in range(4)]
    tiles = tiles.set_geometry(
        [shapely.box(x, y, x + 0.5, y + 0.5) for x, y in corners], crs=tiles.crs
    )
    view = ("R1", "a")
    hit = {(T0 + k, tile) for tile in range(4) for k in range(tile)}
    site = make_site(tiles, {view: set(range(T0, T0 + 4))}, {view: set(range(4))}, hit)
    make_heatmap(site.dataset).write(tmp_path / "map")
    with rasterio.open(tmp_path / "map" / "hits.tif") as raster:
        assert raster.bounds == (677_885.0, 5_403_673.5, 677_888.5, 5_403_675.5)
        centres = [(x + 0.25, y + 0.25) for x, y in corners]
        assert [float(value[0]) for value in raster.sample(centres)] == [0.0, 0.25, 0.5, 0.75]
        assert np.isfinite(raster.read(1)).sum() == 4


def test_raster_is_cloud_optimised(folder):
    with rasterio.open(folder / "hits.tif") as raster:
        structure = raster.tags(ns="IMAGE_STRUCTURE")
        assert structure["LAYOUT"] == "COG"
        assert structure["COMPRESSION"] == "DEFLATE"
        assert structure["PREDICTOR"] == "3"
        assert raster.profile["tiled"]


def test_overviews_are_means_of_what_was_observed(tmp_path):
    tiles = lane_tiles(1)
    tiles = tiles.set_geometry([shapely.box(500_000, 5_000_000, 500_300.5, 5_000_301)], crs=25832)
    view = ("R1", "a")
    site = make_site(tiles, {view: {T0, T0 + 1}}, {view: {0}}, {(T0, 0)})
    make_heatmap(site.dataset).write(tmp_path / "map")
    with rasterio.open(tmp_path / "map" / "hits.tif") as raster:
        assert raster.overviews(1) == [2]
        small = raster.read(1, out_shape=(301, 301))
    assert (small == 0.5).all()  # the half-filled last column too: no-data does not count


def test_a_small_map_of_many_intervals_has_no_overviews_of_another_kind(tmp_path):
    """Where we build none, GDAL would: cubic ones, and in 20 s for 280 bands."""
    tiles = lane_tiles(1)
    tiles = tiles.set_geometry([shapely.box(500_000, 5_000_000, 500_100, 5_000_001)], crs=25832)
    site = make_site(tiles, {("R1", "a"): set(range(T0, T0 + 70))}, {("R1", "a"): {0}}, {(T0, 0)})
    make_heatmap(site.dataset, interval="50ms").write(tmp_path / "map")
    with rasterio.open(tmp_path / "map" / "hits.tif") as raster:
        assert raster.profile["blockxsize"] == 128 < raster.width
        assert raster.overviews(1) == []


def test_tiles_far_apart_make_an_empty_middle_of_little_size(tmp_path):
    tiles = lane_tiles(2)
    far = [shapely.box(x, x + 5e6, x + 3, x + 5e6 + 3) for x in (500_000.0, 504_000.0)]
    tiles = tiles.set_geometry(far, crs=25832)
    view = ("R1", "a")
    site = make_site(tiles, {view: {T0}}, {view: {0, 1}}, {(T0, 1)})
    make_heatmap(site.dataset).write(tmp_path / "map")
    path = tmp_path / "map" / "hits.tif"
    assert path.stat().st_size < 2e6
    with rasterio.open(path) as raster:
        assert raster.shape == (8006, 8006)
        values = [float(v[0]) for v in raster.sample([(500_001, 5_500_001), (504_001, 5_504_001)])]
        assert values == [0.0, 1.0]


def test_more_than_500_intervals_make_one_band(tmp_path):
    view = ("R1", "a")
    site = make_site(lane_tiles(2), {view: set(range(T0, T0 + 501))}, {view: {0}}, {(T0 + 3, 0)})
    make_heatmap(site.dataset, interval="50ms", reporter=Listener()).write(tmp_path / "map")
    with rasterio.open(tmp_path / "map" / "hits.tif") as raster:
        assert raster.count == 1
    info = pyogrio.read_info(tmp_path / "map" / "heatmap.gpkg", layer="by_interval")
    assert info["features"] == 1002


def test_500_bands_are_possible(tmp_path):
    view = ("R1", "a")
    site = make_site(lane_tiles(2), {view: set(range(T0, T0 + 500))}, {view: {0}}, {(T0 + 3, 0)})
    make_heatmap(site.dataset, interval="50ms").write(tmp_path / "map")
    with rasterio.open(tmp_path / "map" / "hits.tif") as raster:
        assert raster.count == 501
        assert raster.descriptions[500] == "2023-11-14T22:13:44.950Z"
        assert np.nanmax(raster.read(5)) == 1.0
        assert np.nanmax(raster.read(6)) == 0.0
