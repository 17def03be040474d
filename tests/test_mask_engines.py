"""The same road from both engines: the built-in one and a real PDAL."""

import json
import subprocess
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS
from scans import EAST, NORTH, UTM, box_roads, ground, hidden, write_points
from scipy.spatial import cKDTree

import gis_radar as gr
from gis_radar.base import InputError, transformer
from gis_radar.scans.mask import relative_name

ROAD = (0.0, 0.0, 60.0, 8.0)
AROUND = (-30.0, -30.0, 90.0, 38.0)


def slope(x, y):
    return 100.0 + 0.05 * x + 0.02 * y


def agree(mask, other, *, cells=0.005, metres=0.02):
    """Check that two masks have the same cells and heights, up to shares and metres."""
    scale = [1.0, 1.0, 0.01]
    distance, nearest = cKDTree(other.points * scale).query(mask.points * scale)
    same = distance < 0.1
    missing = (~same).sum() + len(other.points) - same.sum()
    assert missing <= cells * len(mask.points)
    assert np.abs(mask.points[same, 2] - other.points[nearest[same], 2]).max() <= metres


def both(paths, roads, **options):
    return [gr.mask_road(paths, roads, engine=name, **options) for name in ("laspy", "pdal")]


def scene():
    """A road with cars, a crown and a house; and its classes."""
    rng = np.random.default_rng(2)
    points = ground(AROUND, slope)
    things = [((x, 1.0, x + 4.5, 2.8), 1.5, 1) for x in (5, 25, 45)]
    things += [((30.0, 5.0, 38.0, 14.0), 6.0, 5), ((10.0, 7.0, 22.0, 30.0), 9.0, 6)]
    category = np.full(len(points), 2)
    for box, height, kind in things:
        before = points
        points = hidden(points, box, lambda x, y, h=height: slope(x, y) + h + rng.normal(0, 0.02))
        category[points[:, 2] != before[:, 2]] = kind
    return points, category


def test_engines_agree_on_classes(tmp_path, pdal):
    points, category = scene()
    path = write_points(tmp_path / "scan.laz", points, category=category)
    own, other = both([path], box_roads(ROAD))
    assert other.engine == pdal.name
    assert len(own.points) > 1500
    agree(own, other)


def test_engines_agree_over_tiles_with_heights(tmp_path, pdal):
    points, category = scene()
    paths = []
    for number, (low, high) in enumerate([(-30, 12), (8, 45), (45, 95)]):
        some = (points[:, 0] >= low) & (points[:, 0] < high)
        paths.append(
            write_points(tmp_path / f"{number}.laz", points[some], category=category[some])
        )
    own, other = both(paths, box_roads(ROAD, heights=[slope]))
    assert own.points_on_road > 0
    agree(own, other)


def test_engines_agree_on_mixed_scans(tmp_path, pdal):
    points, category = scene()
    west = points[:, 0] < 30.0
    paths = [
        write_points(tmp_path / "west.laz", points[west], category=category[west]),
        write_points(tmp_path / "east.laz", points[~west]),
    ]
    own, other = both(paths, box_roads(ROAD))
    assert own.pipeline.classified == (True, False)
    agree(own, other, cells=0.03, metres=0.05)


def test_pdal_tile_by_tile(tmp_path, pdal, monkeypatch):
    points, _ = scene()
    paths = []
    for number, (low, high) in enumerate([(-30, 20), (20, 95)]):
        some = (points[:, 0] >= low) & (points[:, 0] < high)
        paths.append(write_points(tmp_path / f"{number}.laz", points[some]))
    whole = gr.mask_road(paths, box_roads(ROAD), engine="pdal")
    monkeypatch.setattr("gis_radar.scans.engines.MOST_AT_ONCE", 100)
    tiled = gr.mask_road(paths, box_roads(ROAD), engine="pdal")
    agree(whole, tiled, cells=0.01, metres=0.03)


def test_the_document_runs_on_its_own(tmp_path, pdal):
    points, category = scene()
    path = write_points(tmp_path / "scan.laz", points, category=category)
    mask = gr.mask_road([path], box_roads(ROAD), engine="laspy")
    mask.write(tmp_path / "road.laz")
    text = (tmp_path / "road.pipeline.json").read_bytes()
    command = [pdal.path, "pipeline", "--stdin"]
    subprocess.run(command, input=text, cwd=tmp_path, check=True)
    written = laspy.read(tmp_path / "road.points.laz")
    inside = np.asarray(written.xyz)[:, :2] - [EAST, NORTH]
    assert (inside >= 0.0).all()
    assert (inside <= [60.0, 8.0]).all()
    assert set(np.unique(written.classification)) == {2}
    assert written.header.parse_crs() == UTM
    expected = (category == 2) & (points[:, 0] > 0) & (points[:, 0] < 60)
    expected &= (points[:, 1] > 0) & (points[:, 1] < 8)
    assert abs(len(written.points) - expected.sum()) <= 2


def test_a_scan_in_another_system(tmp_path, pdal):
    points, category = scene()
    path = write_points(tmp_path / "scan.laz", points, category=category, crs="EPSG:25832+7837")
    corner = transformer(UTM, CRS.from_epsg(25833)).transform(EAST + 30, NORTH + 4)
    east, north = corner[0] - 678_000.0, corner[1] - 5_403_600.0
    roads = box_roads((east - 15, north - 15, east + 15, north + 15), crs=CRS.from_epsg(25833))
    own, other = both([path], roads)
    assert abs(np.median(own.points[:, 2]) - slope(30.0, 4.0)) < 0.5
    agree(own, other)


def test_a_cut_scan_is_refused_by_both(tmp_path, pdal):
    path = write_points(tmp_path / "scan.laz", scene()[0])
    cut = tmp_path / "cut.laz"
    cut.write_bytes(path.read_bytes()[:-20_000])
    for engine in ("laspy", "pdal"):
        with pytest.raises(InputError, match=r"cut\.laz"):
            gr.mask_road([cut], box_roads(ROAD), engine=engine)


def test_pdal_finds_no_point_on_the_road(tmp_path, pdal):
    points, _ = scene()
    off_road = points[(points[:, 1] < -1.0) | (points[:, 1] > 9.0)]
    path = write_points(tmp_path / "scan.laz", off_road, category=2)
    with pytest.raises(InputError, match="do not overlap"):
        gr.mask_road([path], box_roads(ROAD), engine="pdal")


def test_the_stages_of_the_document(tmp_path):
    path = write_points(tmp_path / "scan.laz", scene()[0], category=2, crs=None)
    mask = gr.mask_road([path], box_roads(ROAD), engine="laspy", scan_crs="EPSG:25832")
    mask.write(tmp_path / "road.laz")
    stages = json.loads((tmp_path / "road.pipeline.json").read_text())["pipeline"]
    kinds = [stage["type"] for stage in stages]
    assert kinds == [
        "readers.las", "filters.crop", "filters.merge", "filters.range", "filters.assign",
        "filters.overlay", "filters.range", "writers.las",
    ]  # fmt: skip
    assert stages[0]["override_srs"] == "EPSG:25832"
    assert [stage["filename"] for stage in (stages[0], stages[-1])] == [
        "scan.laz", "road.points.laz",
    ]  # fmt: skip
    assert stages[5]["datasource"] == "road.roads.gpkg"


def test_names_in_the_document_are_relative_where_they_can_be(tmp_path):
    (tmp_path / "scans").mkdir()
    (tmp_path / "out").mkdir()
    path = write_points(tmp_path / "scans" / "scan.laz", scene()[0], category=2)
    gr.mask_road([path], box_roads(ROAD), engine="laspy").write(tmp_path / "out" / "road.laz")
    text = (tmp_path / "out" / "road.pipeline.json").read_text()
    assert str(tmp_path) not in text
    assert json.loads(text)["pipeline"][0]["filename"] == "../scans/scan.laz"
    elsewhere = Path(tmp_path.anchor) / "elsewhere" / "scan.laz"
    assert relative_name(str(elsewhere), tmp_path) == str(
        elsewhere
    )  # nothing but the root in common
