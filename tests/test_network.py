"""No data file makes the program call the network or open another file."""

import json
import os
import sqlite3
import subprocess
import sys
import threading
import zipfile
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import geopandas as gpd
import pytest
import shapely
from maps import write_road
from scans import EAST, NORTH, UTM

import gis_radar as gr
from gis_radar import cli
from gis_radar.base import OFFLINE, CrsError, InputError, go_offline, opened_package, read_vector
from gis_radar.products.heatmap.layers import read_package
from gis_radar.scans import read_roads

BOX = shapely.box(EAST, NORTH, EAST + 60, NORTH + 8)


class Recorder(BaseHTTPRequestHandler):
    def do_GET(self):
        self.server.seen.append(self.path)
        self.send_error(404)

    do_HEAD = do_POST = do_GET  # noqa: N815

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    """A web server on this machine; `seen` holds the paths it was asked for."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Recorder) as server:
        server.seen, server.url = [], f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def virtual(source):
    """A virtual layer, which GDAL knows by its content, whatever the file is called."""
    layer = f'<OGRVRTLayer name="tiles"><SrcDataSource>{source}</SrcDataSource></OGRVRTLayer>'
    return f"<OGRVRTDataSource>{layer}</OGRVRTDataSource>"


def geojson(crs):
    feature = {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(BOX))}
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]})


HOSTILE = {
    "virtual, vsicurl": lambda url: virtual(f"/vsicurl/{url}/t.gpkg"),
    "virtual, streaming": lambda url: virtual(f"/vsicurl_streaming/{url}/t.geojson"),
    "virtual, http": lambda url: virtual(f"{url}/t.geojson"),
    "wfs": lambda url: f"<OGRWFSDataSource><URL>{url}/wfs</URL></OGRWFSDataSource>",
    "wms": lambda url: f"<GDAL_WMS><Service name='WMS'><ServerUrl>{url}</ServerUrl></Service>",
    "linked crs": lambda url: geojson({"type": "link", "properties": {"href": f"{url}/crs"}}),
    "named crs": lambda url: geojson({"type": "name", "properties": {"name": f"{url}/crs"}}),
}  # fmt: skip
NAMES = ("roads.gpkg", "roads.geojson", "roads.json", "roads.shp", "roads.fgb", "roads.gml")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", HOSTILE)
def test_no_map_calls_the_network(server, tmp_path, kind, name):
    (tmp_path / name).write_text(HOSTILE[kind](server.url))
    with pytest.raises(InputError) as caught:
        read_roads(tmp_path / name)
    with pytest.raises(InputError, match=name):
        read_vector(tmp_path / name, what="layer of streets", columns=None)
    assert server.seen == []
    assert name in caught.value.message
    assert "\n" not in caught.value.message


@pytest.mark.parametrize("kind", HOSTILE)
def test_no_result_of_ours_calls_the_network(server, tmp_path, kind):
    path = tmp_path / "heatmap.gpkg"
    path.write_text(HOSTILE[kind](server.url))
    readers = (
        gr.read_tiles,
        read_package,
        lambda path: gr.write_qgis_project(tmp_path / "p.qgz", heatmap=path.parent),
    )
    for read in readers:
        with pytest.raises(InputError, match=r"heatmap\.gpkg"):
            read(path)
    assert server.seen == []


def test_a_virtual_layer_opens_no_other_file(tmp_path):
    gpd.GeoDataFrame(geometry=[BOX], crs=UTM).to_file(tmp_path / "other.gpkg", layer="tiles")
    (tmp_path / "roads.gpkg").write_text(virtual(tmp_path / "other.gpkg"))
    with pytest.raises(InputError, match=r"roads\.gpkg"):
        read_roads(tmp_path / "roads.gpkg")


@pytest.mark.parametrize(
    "name", ["roads.zip", "roads.ZIP", "a!roads.gpkg", "a.gpkg;b", "link.gpkg"]
)
def test_an_archive_behind_a_layer_opens_no_other_file(tmp_path, name):
    """A GeoPackage, by its first bytes, and an archive, by its last: pyogrio goes by the name."""
    gpd.GeoDataFrame(geometry=[BOX], crs=UTM).to_file(tmp_path / "other.gpkg", layer="tiles")
    place = path = tmp_path / name
    if name == "link.gpkg":
        place = tmp_path / "roads.zip"
        path.symlink_to(place)
    place.write_bytes((tmp_path / "other.gpkg").read_bytes())
    with zipfile.ZipFile(place, "a") as archive:
        archive.writestr("a.vrt", virtual(tmp_path / "other.gpkg"))
    readers = (
        lambda: read_vector(path, what="map"),
        lambda: gr.read_tiles(path),
    )
    for read in readers:
        with pytest.raises(InputError, match="cannot be read under this name"):
            read()


def test_a_shapefile_and_a_flatgeobuf_under_names_of_archives(tmp_path):
    for name, kind in (("a!b.shp", "ESRI Shapefile"), ("roads.zip", "FlatGeobuf")):
        made = tmp_path / f"made.{'shp' if kind[0] == 'E' else 'fgb'}"
        gpd.GeoDataFrame({"a": [1]}, geometry=[BOX], crs=UTM).to_file(made, driver=kind)
        (tmp_path / name).write_bytes(made.read_bytes())
        with pytest.raises(InputError, match="cannot be read under this name"):
            read_vector(tmp_path / name, what="map")


def test_a_geopackage_whose_crs_is_an_address(server, tmp_path):
    path = tmp_path / "roads.gpkg"
    gpd.GeoDataFrame(geometry=[BOX], crs=UTM).to_file(path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(
            "UPDATE gpkg_spatial_ref_sys SET definition = ?, organization = 'none'",
            (f"{server.url}/crs",),
        )
    with pytest.raises(CrsError, match="no coordinate system"):
        read_roads(path)
    assert server.seen == []


def test_a_view_runs_no_function_of_gdal(server, tmp_path):
    path = tmp_path / "tiles.gpkg"
    gpd.GeoDataFrame(geometry=[BOX], crs=UTM).to_file(path, layer="base")
    asked = f"ogr_geocode('x', '{server.url}/raw', 'raw', '{server.url}/q?x=%s')"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(f"CREATE VIEW tiles AS SELECT fid, geom, {asked} AS a FROM base")  # noqa: S608
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id)"
            " VALUES ('tiles', 'features', 'tiles', 25832)"
        )
        database.execute(
            "INSERT INTO gpkg_geometry_columns VALUES ('tiles', 'geom', 'POLYGON', 25832, 0, 0)"
        )
    with pytest.raises(InputError, match=r"tiles\.gpkg"):
        gr.read_tiles(path)
    assert server.seen == []


@pytest.mark.parametrize("suffix", ["gpkg", "geojson", "json", "shp", "fgb"])
def test_polygons_of_each_format_are_read(tmp_path, suffix):
    path = tmp_path / f"roads.{suffix}"
    table = gpd.GeoDataFrame({"name": ["a", "b"]}, geometry=[BOX, BOX.buffer(1)], crs=UTM)
    degrees = suffix.endswith("json")
    driver = "GeoJSON" if degrees else None
    (table.to_crs(4326) if degrees else table).to_file(path, driver=driver)
    roads = read_roads(path)
    assert roads.crs.to_string() == "EPSG:25832"
    assert roads.area.area == pytest.approx(BOX.buffer(1).area, rel=1e-4)


@pytest.mark.parametrize("crs", ["EPSG:25832", "urn:ogc:def:crs:EPSG::25832"])
def test_geojson_of_a_named_crs(tmp_path, crs):
    path = tmp_path / "roads.geojson"
    path.write_text(geojson({"type": "name", "properties": {"name": crs}}))
    roads = read_roads(path)
    assert roads.crs.to_string() == "EPSG:25832"
    assert roads.area.area == pytest.approx(480.0)


def test_gml_is_named_as_no_format_and_nothing_is_put_beside_it(tmp_path):
    path = tmp_path / "roads.gml"
    path.write_text('<gml:FeatureCollection xmlns:gml="http://www.opengis.net/gml"/>')
    with pytest.raises(InputError, match=r"roads\.gml: .* format is not known") as caught:
        read_roads(path)
    assert "GeoPackage" in caught.value.hint
    assert [each.name for each in tmp_path.iterdir()] == ["roads.gml"]


def test_a_layer_that_is_none_is_named_with_its_file(tmp_path):
    path = tmp_path / "t.gpkg"
    gpd.GeoDataFrame(geometry=[BOX], crs=UTM).to_file(path)
    with (
        pytest.raises(InputError, match=r"(?m)t\.gpkg: not a thing: text$") as caught,
        opened_package(path, what="a thing", hint="make it"),
    ):
        raise sqlite3.OperationalError("text\nmore")
    assert caught.value.hint == "make it"


ASK = """
import sys, pyogrio, rasterio
for path in sys.argv[2:]:
    for read in (pyogrio.read_dataframe, rasterio.open):
        try:
            read(path)
        except Exception as error:
            print(type(error).__name__)
"""


@pytest.mark.parametrize("offline", [False, True])
def test_both_gdals_of_the_process_are_offline(server, tmp_path, offline):
    """What the command line sets keeps either GDAL from the network; without it they go there."""
    found = [tmp_path / f"{number}.vrt" for number in range(len(HOSTILE))]
    for path, make in zip(found, HOSTILE.values(), strict=True):
        path.write_text(make(server.url))
    environment = dict(os.environ) | {"no_proxy": "127.0.0.1", "NO_PROXY": "127.0.0.1"}
    environment |= OFFLINE if offline else {}
    words = [sys.executable, "-c", ASK, "-", *map(str, found), f"/vsicurl/{server.url}/t.tif"]
    done = subprocess.run(words, env=environment, capture_output=True, timeout=600, check=True)
    assert b"Error" in done.stdout
    assert bool(server.seen) is not offline, server.seen


def test_commands_and_their_workers_are_offline(monkeypatch):
    for name in OFFLINE:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(cli, "run_group", lambda _: None)
    cli.main()
    assert {name: os.environ[name] for name in OFFLINE} == OFFLINE
    for name in OFFLINE:
        monkeypatch.delenv(name, raising=False)
    go_offline()
    assert {name: os.environ[name] for name in OFFLINE} == OFFLINE


def test_a_map_with_a_lanelet_is_still_read(tmp_path):
    assert read_roads(write_road(tmp_path / "map.osm")).area.area > 0.0
