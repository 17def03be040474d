"""Scans and road layers as they come, and those that must be refused in one line."""

import shutil
import struct
from contextlib import suppress

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from maps import SHARED, Listener, write_road
from pyproj import CRS
from scans import EAST, NORTH, UTM, box_roads, ground, level, write_points

import gis_radar as gr
from gis_radar.base import CrsError, GisRadarError, InputError, UsageError, transformer
from gis_radar.scans import open_scan, read_roads

ROAD = (0.0, 0.0, 60.0, 8.0)
AROUND = (-5.0, -5.0, 65.0, 13.0)
PLACES = {2154: (770_500, 6_277_500), 28992: (119_300, 485_100), 31468: (4_468_000, 5_400_000)}


def mask(path, roads=None, **options):
    return gr.mask_road([path], roads or box_roads(ROAD), engine="laspy", **options)


def refused(call, *parts, error=InputError):
    with pytest.raises(error) as caught:
        call()
    assert "\n" not in caught.value.message
    for part in parts:
        assert part in f"{caught.value.message} ({caught.value.hint})"


@pytest.fixture
def scan(tmp_path):
    return write_points(tmp_path / "scan.laz", ground(AROUND, level))


@pytest.mark.parametrize("point_format", range(11))
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_every_point_format(tmp_path, point_format, suffix):
    version = "1.4" if point_format > 5 else "1.3" if point_format > 3 else "1.2"
    if suffix == "laz" and point_format in {4, 5, 9, 10}:
        pytest.skip("laspy writes no compressed waveforms")
    path = write_points(
        tmp_path / f"scan.{suffix}", ground(AROUND, level), version=version,
        point_format=point_format, category=2,
    )  # fmt: skip
    assert mask(path).covered > 0.9


def test_withheld_points_are_left_out(tmp_path):
    points = ground(AROUND, level)
    west = points[:, 0] < 30.0
    path = write_points(tmp_path / "s.laz", points, withheld=west.astype(np.uint8))
    assert mask(path).points[:, 0].min() > EAST + 29.9


def test_noise_and_vegetation_are_no_road(tmp_path):
    points = ground(AROUND, level)
    category = np.where(points[:, 0] < 20.0, 7, np.where(points[:, 0] < 40.0, 3, 2))
    assert mask(write_points(tmp_path / "s.laz", points, category=category)).points[
        :, 0
    ].min() == pytest.approx(EAST + 40.25, abs=0.6)


def test_a_scan_without_coordinate_system(tmp_path):
    path = write_points(tmp_path / "s.laz", ground(AROUND, level), crs=None)
    refused(lambda: mask(path), "s.laz", "no coordinate system", "--scan-crs", error=CrsError)
    assert mask(path, scan_crs="EPSG:25832").covered > 0.9
    refused(lambda: mask(path, scan_crs="EPSG:4326"), "geographic", error=CrsError)
    refused(lambda: mask(path, scan_crs="EPSG:2"), "--scan-crs", error=CrsError)


def test_a_compound_system_keeps_heights(tmp_path):
    compound = CRS.from_user_input("EPSG:25832+7837")
    path = write_points(tmp_path / "s.laz", ground(AROUND, level), crs=compound)
    found = mask(path)
    assert found.figures()["vertical_crs"] == "EPSG:7837"
    assert found.figures()["crs"] == "EPSG:25832"
    assert np.median(found.points[:, 2]) == pytest.approx(100.0, abs=0.01)


@pytest.mark.parametrize("epsg", PLACES)
def test_national_systems(tmp_path, epsg):
    """Roads in the scan's own system and in UTM give the same places."""
    national = CRS.from_epsg(epsg)
    east, north = PLACES[epsg]
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.array([east, north, 0.0])
    header.add_crs(national)
    las = laspy.LasData(header)
    las.xyz = ground(AROUND, level) + [east, north, 0.0]
    las.write(tmp_path / "s.laz")
    shape = shapely.box(east, north, east + 60, north + 8)
    zone = CRS.from_epsg(25831 if epsg != 31468 else 25832)
    layer = gpd.GeoDataFrame(geometry=[shapely.segmentize(shape, 5.0)], crs=national)
    layer.to_file(tmp_path / "roads.gpkg")
    own = gr.mask_road([tmp_path / "s.laz"], read_roads(tmp_path / "roads.gpkg"), engine="laspy")
    moved = gr.mask_road(
        [tmp_path / "s.laz"], read_roads(tmp_path / "roads.gpkg", crs=zone), engine="laspy"
    )
    assert own.figures()["crs"] == f"EPSG:{epsg}"
    assert moved.points_on_road == pytest.approx(own.points_on_road, rel=0.002)
    back = transformer(zone, national).transform(*moved.points[:, :2].T)
    assert shapely.contains_xy(shape.buffer(0.01), *back).all()
    assert np.median(moved.points[:, 2]) == pytest.approx(100.0, abs=0.01)


def test_a_scan_in_a_datum_of_metres_is_told(tmp_path):
    """Monte Mario: PROJ has one shift for northern Italy, which is right to 4 m."""
    italian = CRS.from_epsg(3003)
    west, south = transformer(italian, UTM).transform(1_514_000.0, 5_034_000.0)
    box = shapely.box(west - 40.0, south - 40.0, west + 40.0, south + 40.0)
    gpd.GeoDataFrame(geometry=[box], crs=UTM).to_file(tmp_path / "roads.gpkg")
    points = ground(AROUND, level) + [1_514_000.0 - EAST, 5_034_000.0 - NORTH, 0.0]
    heard = {}
    for crs in (italian, UTM):
        path = write_points(tmp_path / "s.laz", points, crs=crs)
        heard[crs] = Listener()
        with suppress(InputError):
            mask(path, read_roads(tmp_path / "roads.gpkg"), reporter=heard[crs])
    told = "Monte Mario / Italy zone 1 (EPSG:3003) to ETRS89 / UTM zone 32N (EPSG:25832) with an"
    assert told in str(heard[italian].messages)
    assert "with an error of" not in str(heard[UTM].messages)


def test_degrees_become_utm(tmp_path, scan):
    layer = gpd.GeoDataFrame(
        geometry=[shapely.box(EAST, NORTH, EAST + 60, NORTH + 8)], crs=UTM
    ).to_crs(4326)
    layer.to_file(tmp_path / "roads.geojson")
    roads = read_roads(tmp_path / "roads.geojson")
    assert roads.crs.to_string() == "EPSG:25832"
    assert mask(scan, roads).covered > 0.9


def test_a_lanelet_map(tmp_path, scan):
    roads = read_roads(write_road(tmp_path / "map.osm"))
    assert roads.area.area == pytest.approx(60.0, rel=0.01)
    assert mask(scan, roads).covered > 0.9


def test_a_table_of_polygons(tmp_path):
    ring = [[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]
    for name, text in (("wkt", shapely.Polygon(ring).wkt), ("rings", str(ring))):
        path = tmp_path / f"{name}.csv"
        path.write_text(f'kind,shape\nroad,"{text}"\n')
        assert read_roads(path, map_crs=28992).area.area == pytest.approx(81.0)
        refused(lambda p=path: read_roads(p), "no coordinate system", error=CrsError)
    (tmp_path / "none.csv").write_text("a,b\n1,2\n")
    refused(lambda: read_roads(tmp_path / "none.csv"), "no column of polygons")


def write_layer(path, *shapes, crs=UTM, **options):
    gpd.GeoDataFrame(geometry=list(shapes), crs=crs).to_file(path, **options)
    return path


def test_polygons_that_can_be_mended_are(tmp_path):
    touching = shapely.Polygon([(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)])
    listener = Listener()
    roads = read_roads(write_layer(tmp_path / "r.gpkg", touching), reporter=listener)
    assert roads.area.area == pytest.approx(touching.area)
    assert any("1 polygons mended" in text for _, text in listener.messages)


def test_polygons_that_cannot_are_refused(tmp_path):
    bow_tie = shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])
    path = write_layer(tmp_path / "bow.gpkg", shapely.box(9, 9, 10, 10), bow_tie)
    with pytest.raises(InputError, match="has no layer 'roads'") as caught:
        read_roads(path, layer="roads")
    assert caught.value.hint == "it has bow"
    refused(lambda: read_roads(path), "bow.gpkg", "polygon 1", "Self-intersection")
    flat = write_layer(tmp_path / "flat.gpkg", shapely.Polygon([(0, 0), (1, 0), (2, 0)]))
    refused(lambda: read_roads(flat), "flat.gpkg", "invalid")
    line = write_layer(tmp_path / "line.gpkg", shapely.LineString([(0, 0), (1, 0)]))
    refused(lambda: read_roads(line), "LineString", "polygons")
    empty = write_layer(tmp_path / "empty.gpkg", shapely.Polygon(), shapely.Polygon())
    refused(lambda: read_roads(empty), "nothing", "polygons")
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        bare = write_layer(tmp_path / "bare.gpkg", shapely.box(0, 0, 1, 1), crs=None)
    refused(lambda: read_roads(bare), "bare.gpkg", "--map-crs", error=CrsError)
    (tmp_path / "text.gpkg").write_text("no")
    refused(lambda: read_roads(tmp_path / "text.gpkg"), "text.gpkg")
    refused(lambda: read_roads(tmp_path / "gone.gpkg"), "gone.gpkg: no such file")
    wide = write_layer(tmp_path / "wide.gpkg", shapely.box(0, 0, 1e6, 1e6))
    refused(lambda: read_roads(wide), "1000 km")


def test_of_several_layers_one_is_chosen(tmp_path):
    for name, side in (("streets", 5.0), ("parks", 7.0)):
        write_layer(tmp_path / "city.gpkg", shapely.box(0, 0, side, side), layer=name)
    refused(lambda: read_roads(tmp_path / "city.gpkg"), "streets, parks", "--layer")
    assert read_roads(tmp_path / "city.gpkg", layer="streets").area.area == 25.0


def damaged(path, target, at, value, form="<Q"):
    """Copy a scan with one number of its header replaced."""
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, at, value)
    target.write_bytes(content)
    return target


@pytest.mark.parametrize(
    ("at", "value", "form", "words"),
    [
        (247, 10**12, "<Q", "claims 1000000000000 points"),
        (100, 2**31, "<I", "claims 2147483648 records"),
        (243, 2**31, "<I", "claims 2147483648 further records"),
        (96, 2**31, "<I", "points begin at byte"),
        (96, 10, "<I", "2 records, which do not fit before byte 10"),
        (104, 0x80 | 33, "<B", "point format 33"),
        (105, 3, "<H", "do not fit each other"),
        (25, 9, "<B", "version 1.9"),
        (24, 2, "<B", "version 2.4"),
        (94, 100, "<H", "record of the compression is missing"),
        (247, 0, "<Q", "without points"),
        (131, 0.0, "<d", "scales"),
        (155, float("nan"), "<d", "offsets"),
    ],
)
def test_a_header_that_cannot_be(tmp_path, scan, at, value, form, words):
    path = damaged(scan, tmp_path / "bad.laz", at, value, form)
    refused(lambda: open_scan(path), "bad.laz", words)


def test_a_header_that_claims_too_few_or_many(tmp_path, scan):
    count = open_scan(scan).points
    path = damaged(scan, tmp_path / "more.laz", 247, count + 60_000)
    refused(lambda: mask(path), "more.laz")


def test_a_plain_file_that_holds_more_points_than_its_header_says(tmp_path, scan):
    plain = tmp_path / "plain.las"
    laspy.read(scan).write(plain)
    count = open_scan(plain).points
    path = damaged(plain, tmp_path / "half.las", 247, count // 2)
    refused(lambda: open_scan(path), "half.las", f"claims {count // 2} points")
    with plain.open("ab") as file:
        file.write(bytes(100))
    assert open_scan(plain).points == count


@pytest.mark.parametrize("share", [0.0, 0.001, 0.02, 0.5, 0.97, 0.999])
def test_a_cut_scan(tmp_path, scan, share):
    content = scan.read_bytes()
    path = tmp_path / "cut.laz"
    path.write_bytes(content[: int(len(content) * share)])
    refused(lambda: mask(path), "cut.laz")


def test_other_files_are_no_scans(tmp_path):
    (tmp_path / "text.laz").write_text("LAS?")
    refused(lambda: open_scan(tmp_path / "text.laz"), "text.laz", "LASF")
    refused(lambda: open_scan(tmp_path / "gone.laz"), "no such file")
    refused(lambda: open_scan(tmp_path), "no such file")


@pytest.mark.skipif(not (SHARED / "als").exists(), reason="shared data absent: als")
def test_the_shared_scans_with_faults(tmp_path):
    corrupt = SHARED / "als" / "Semis_2022_0906_6665_LA93_IGN69_nok.laz"
    refused(lambda: mask(corrupt), corrupt.name)
    bare = SHARED / "als" / "test_noepsg_043500_629205_IGN69.laz"
    refused(lambda: mask(bare), bare.name, "--scan-crs", error=CrsError)
    east, north = 435_000.0, 6_291_000.0
    path = write_layer(
        tmp_path / "r.gpkg", shapely.box(east, north, east + 50, north + 50), crs=2154
    )
    found = mask(bare, read_roads(path), scan_crs="EPSG:2154")
    assert found.points_on_road == found.points_in


def test_an_unknown_engine(scan):
    refused(lambda: gr.mask_road([scan], box_roads(ROAD), engine="las"), "'las'", error=UsageError)


def test_without_pdal(scan, no_pdal):
    assert gr.mask_road([scan], box_roads(ROAD)).engine.startswith("laspy")
    refused(lambda: gr.mask_road([scan], box_roads(ROAD), engine="pdal"), "conda", "apt",
            error=GisRadarError)  # fmt: skip


def test_read_only_scans_work(tmp_path, scan):
    copy = tmp_path / "copy.laz"
    shutil.copy(scan, copy)
    copy.chmod(0o444)
    assert mask(copy).covered > 0.9
