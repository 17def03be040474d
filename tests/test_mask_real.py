"""The road mask on the shared real and simulated scans."""

from functools import cache

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import shapely
from maps import SHARED
from scipy import ndimage
from scipy.spatial import cKDTree
from test_mask_engines import agree

import gis_radar as gr
from gis_radar.scans import read_roads

ALS = SHARED / "als"
IGN = tuple(sorted(ALS.glob("test_data_*.laz")))
AMSTERDAM = tuple(sorted(ALS.glob("ahn_*.laz")))
CITY = ALS / "bgt_roads_demo.csv"

needs_ign = pytest.mark.skipif(not IGN, reason="shared data absent: als")
needs_amsterdam = pytest.mark.skipif(not AMSTERDAM, reason="shared data absent: als")


def needs_town(name):
    absent = not (SHARED / name / "als.laz").exists()
    return pytest.mark.skipif(absent, reason=f"shared data absent: {name}")


@pytest.fixture(scope="module")
def ign_roads(tmp_path_factory):
    """Draw a road layer from the ground of the scans: open areas of seven metres and more."""
    ground = np.concatenate([_ground(path) for path in IGN])
    corner = np.floor(ground.min(axis=0))
    cells = np.floor(ground - corner).astype(int)
    mask = np.zeros(cells.max(axis=0) + 1, bool)
    mask[cells[:, 0], cells[:, 1]] = True
    mask = ndimage.binary_opening(ndimage.binary_closing(mask, iterations=2), np.ones((7, 7)))
    low = np.argwhere(mask) + corner
    area = shapely.union_all(shapely.box(*low.T, *(low + 1.0).T))
    parts = [part for part in shapely.get_parts(area) if part.area > 200.0]
    path = tmp_path_factory.mktemp("ign") / "roads.gpkg"
    gpd.GeoDataFrame(geometry=parts, crs="EPSG:2154").to_file(path)
    return read_roads(path)


@pytest.fixture(scope="module")
def ign_mask(ign_roads):
    """The road mask of the city, by the built-in engine; only to be read."""
    return gr.mask_road(IGN, ign_roads, engine="laspy")


def _ground(path):
    scan = laspy.read(path)
    return scan.xyz[np.asarray(scan.classification) == 2, :2]


def without_classes(path, folder):
    """Copy a scan, all of its points in class 1."""
    scan = laspy.read(path)
    scan.classification = np.ones(len(scan.points), np.uint8)
    scan.write(folder / path.name)
    return folder / path.name


def cells_of(mask):
    return pd.MultiIndex.from_arrays(np.floor(mask.points[:, :2].T * 2).astype(int))


def compared(mask, other):
    """Return the share of cells that only one has, and the differences in height."""
    a = pd.Series(mask.points[:, 2], cells_of(mask))
    b = pd.Series(other.points[:, 2], cells_of(other))
    both = a.index.intersection(b.index)
    return 1.0 - len(both) / max(len(a), len(b)), np.abs((a[both] - b[both]).to_numpy())


@needs_ign
def test_six_tiles_of_a_city(ign_mask):
    mask = ign_mask
    figures = mask.figures()
    assert figures["scans"] == 6
    assert figures["crs"] == "EPSG:2154"
    assert figures["epoch"] == ["2021-05-28", "2021-05-28"]
    assert mask.covered > 0.7
    scan = np.concatenate([laspy.read(p).xyz[np.asarray(laspy.read(p).classification) == 2]
                           for p in IGN])  # fmt: skip
    # The ground's own points around each cell know its height.
    around = cKDTree(scan[:, :2]).query_ball_point(mask.points[:, :2], 0.6)
    truth = np.array([np.median(scan[rows, 2]) for rows in around])
    off = np.abs(mask.points[:, 2] - truth)
    assert np.median(off) < 0.01
    assert np.percentile(off, 99) < 0.1


@needs_ign
def test_a_city_without_classes(ign_roads, ign_mask, tmp_path):
    """Trees, cars and edges of roofs go without classes: as few remain as differ in kind."""
    bare = gr.mask_road([without_classes(p, tmp_path) for p in IGN], ign_roads, engine="laspy")
    assert bare.pipeline.classified == (False,) * 6
    differing, off = compared(bare, ign_mask)
    assert differing < 0.03
    assert np.percentile(off, 99) < 0.05


@needs_amsterdam
def test_amsterdam_with_the_city_s_polygons(tmp_path):
    roads = read_roads(CITY, map_crs="EPSG:28992")
    mask = gr.mask_road(AMSTERDAM, roads, engine="laspy", scan_crs="EPSG:28992")
    assert mask.roads.crs.to_string() == "EPSG:28992"
    assert 0.55 < mask.figures()["outside_share"] < 0.65
    assert np.ptp(mask.points[:, 2]) < 1.0  # Amsterdam is flat, its parked cars are not
    bare = gr.mask_road(
        [without_classes(path, tmp_path) for path in AMSTERDAM], roads, engine="laspy",
        scan_crs="EPSG:28992",
    )  # fmt: skip
    differing, off = compared(bare, mask)
    assert differing < 0.01
    assert off.max() < 0.05


@cache
def masked(town):
    """The road mask of a town, by the built-in engine; only to be read."""
    roads = read_roads(SHARED / town / "map.osm")
    return gr.mask_road([SHARED / town / "als.laz"], roads, engine="laspy")


@pytest.mark.parametrize(
    "town", [pytest.param(name, marks=needs_town(name)) for name in ("town02", "town04")]
)
def test_towns(town):
    mask = masked(town)
    by_level = [level.height_near(mask.points[:, :2]) for level in mask.roads.levels]
    off = np.min([np.abs(mask.points[:, 2] - height) for height in by_level], axis=0)
    assert np.median(off) < 0.02
    assert mask.figures()["outside_share"] < 0.001
    assert mask.cells.offset_m == 0.0
    assert mask.pipeline.classified == (town == "town02",)


@needs_town("town02")
def test_engines_agree_on_a_town(pdal):
    roads = read_roads(SHARED / "town02" / "map.osm")
    scan = SHARED / "town02" / "als.laz"
    agree(masked("town02"), gr.mask_road([scan], roads, engine="pdal"))


@needs_town("town04")
def test_the_bridge_of_a_town():
    """The deck of a bridge that hides the road below belongs to the upper road."""
    mask = masked("town04")
    assert len(mask.roads.levels) == 2
    deck = shapely.union_all(mask.roads.levels[1].shapes)
    on_deck = shapely.contains_xy(deck, mask.points[:, 0], mask.points[:, 1])
    assert on_deck.sum() > 1000
    assert (mask.points[on_deck, 2] > 380.0).mean() > 0.99
