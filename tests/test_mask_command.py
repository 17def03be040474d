"""`gis-radar mask` as scripts use it."""

import json

import geopandas as gpd
import laspy
import pytest
import shapely
from maps import write_road
from scans import EAST, NORTH, UTM, ground, level, write_points

import gis_radar as gr
from gis_radar.cli.maps import MASK_ENGINES
from gis_radar.scans import engines


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder with a scan, a map and a layer of polygons; commands run in it."""
    monkeypatch.chdir(tmp_path)
    write_points(tmp_path / "scan.laz", ground((-5, -5, 25, 9), level, density=20.0), category=2)
    write_road(tmp_path / "map.osm")
    box = shapely.box(EAST, NORTH, EAST + 20, NORTH + 3)
    gpd.GeoDataFrame(geometry=[box], crs=UTM).to_file(tmp_path / "roads.gpkg")
    return tmp_path


@pytest.mark.parametrize("name", ["map.osm", "roads.gpkg"])
def test_scan_to_tiles(site, run, name):
    words = ("mask", "scan.laz", "--map", name, "-o", "road.laz", "--engine", "laspy", "--json")
    code, out, err = run(*words)
    assert (code, err) == (0, "")
    result = json.loads(out.splitlines()[-1])
    assert result["outputs"] == ["road.laz", "road.pipeline.json", "road.roads.gpkg"]
    summary = result["summary"]
    assert summary["engine"].startswith("laspy")
    assert summary["points_in"] > summary["points_on_road"] > 0
    assert summary["covered"] > 0.9
    with laspy.open(site / "road.laz") as road:
        assert road.header.parse_crs() == UTM
        assert str(road.header.version) == "1.4"
        assert road.header.point_count == summary["cells"]
    code, _, _ = run("tiles", "map.osm", "--road", "road.laz", "-o", "tiles.gpkg")
    assert code == 0
    assert gr.read_tiles(site / "tiles.gpkg")["height_m"].to_numpy() == pytest.approx(100, abs=0.05)


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        (["gone.laz"], 3, "gone.laz: no such file"),
        (["cut.laz"], 3, "cut.laz"),
        (["empty.laz"], 3, "empty.laz: empty file"),
        (["far.laz"], 3, "do not overlap"),
        (["bare.laz"], 3, "--scan-crs"),
        (["scan.laz", "--engine", "magic"], 2, "magic"),
        (["scan.laz", "--scan-crs", "EPSG:4326"], 3, "geographic"),
        (["scan.laz", "-o", "road.txt"], 2, "road.txt"),
        (["scan.laz", "--map", "bow.gpkg"], 3, "bow.gpkg"),
        (["scan.laz", "--map", "gone.osm"], 3, "gone.osm"),
    ],
)
def test_refusals(site, run, words, code, part):
    content = (site / "scan.laz").read_bytes()
    (site / "cut.laz").write_bytes(content[: len(content) // 2])
    (site / "empty.laz").write_bytes(b"")
    write_points(site / "far.laz", ground((900, 0, 920, 20), level))
    write_points(site / "bare.laz", ground((0, 0, 20, 3), level), crs=None)
    bow = shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])
    gpd.GeoDataFrame(geometry=[bow], crs=UTM).to_file(site / "bow.gpkg")
    before = sorted(site.iterdir())
    words = [*words, *(["--map", "map.osm"] if "--map" not in words else [])]
    words += ["--engine", "laspy"] if "--engine" not in words else []
    words += ["-o", "road.laz"] if "-o" not in words else []
    answer = run("mask", *words)
    assert answer[0] == code
    lines = answer[2].splitlines()
    assert len(lines) == 1
    assert part in lines[0]
    assert sorted(site.iterdir()) == before


def test_the_command_offers_every_engine():
    assert MASK_ENGINES == engines.ENGINE_NAMES
