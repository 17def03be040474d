"""A map that is off its place by the scan is named; one in its place is not."""

import numpy as np
import pytest
import shapely
from maps import Listener

import gis_radar as gr
from gis_radar.base import Grid
from gis_radar.scans import (
    ScanColumns,
    SightScan,
    SightTiles,
    find_sight,
    open_scan,
    read_shifted,
)
from gis_radar.scans.roads import roads_of_map
from gis_radar.scans.scan import Scan
from gis_radar.scans.shift import warn_shifted

SAMPLE = gr.sample_folder()
SCAN = SAMPLE / "scan.laz"


@pytest.fixture(scope="module")
def roads():
    return gr.read_map(SAMPLE / "junction.osm")


@pytest.mark.parametrize("shift", [(0.0, 0.0), (2.0, -1.0), (10.0, 0.0), (-6.0, 8.0)])
def test_roads_beside_their_place_are_named(roads, shift):
    listener = Listener()
    area = roads_of_map(roads)
    area = type(area)(**{**vars(area), "area": shapely.affinity.translate(area.area, *shift)})
    pose = gr.read_pose(SAMPLE / "R1.json")
    for near in (None, pose.position[:2]):
        named = read_shifted([open_scan(SCAN)], area, listener, near=near)
        assert named == (np.hypot(*shift) > 4.0)
    said = f"{0.0 - shift[0]:.0f} m to the east and {0.0 - shift[1]:.0f} m to the north"
    assert all(said in each for each in listener.lines)


def test_a_mask_reads_a_scan_once_and_looks_for_no_roads_beside_those_of_a_city(roads, monkeypatch):
    listener, read, batches = Listener(), [], Scan.batches
    monkeypatch.setattr(
        Scan, "batches", lambda *args, **rest: read.append(1) or batches(*args, **rest)
    )
    area = roads_of_map(roads)
    area = type(area)(**{**vars(area), "area": shapely.affinity.translate(area.area, 10.0)})
    for cells in (4_000_000, 1):
        monkeypatch.setattr("gis_radar.scans.shift.MOST_COMPARED", cells)
        gr.mask_road(SCAN, area, engine="laspy", reporter=listener)
    assert len(read) == 2
    assert sum("fit the scan" in each for each in listener.lines) == 1


@pytest.mark.parametrize("shift", [0.0, 10.0])
def test_tiles_beside_their_place_are_named_where_a_scan_gives_sight(roads, shift):
    tiles = gr.make_tiles(roads)
    tiles = tiles.set_geometry(tiles.geometry.translate(shift, 0.0))
    listener, road = Listener(), SightTiles.of(tiles)
    find_sight(gr.read_pose(SAMPLE / "R1.json"), road, SightScan([SCAN], road, reporter=listener))
    assert any("fit the scan" in each for each in listener.lines) == (shift > 0.0)


@pytest.mark.parametrize(("turn", "named"), [(10.0, True), (180.0, True), (0.0, False)])
def test_roads_that_are_turned_against_the_scan_are_named(roads, turn, named):
    listener, area = Listener(), roads_of_map(roads)
    turned = shapely.affinity.rotate(area.area, turn, origin="centroid")
    area = type(area)(**{**vars(area), "area": turned})
    assert read_shifted([open_scan(SCAN)], area, listener) is named
    assert all("of another place, or turned" in each for each in listener.lines)


@pytest.mark.parametrize("strays", [0, 1])
def test_an_avenue_in_open_fields_is_in_its_place(strays):
    """Crowns reach over the road, and nothing stands beside it: that it fits there says nothing."""
    columns = ScanColumns(grid=Grid(cell_m=1.0, west=0, south=0, columns=80, rows=300))
    columns.low[:] = 0.0
    columns.top[:] = 0.0
    columns.top[38:43, ::3] = 6.0
    columns.top[52, : 2 * strays : 2] = 6.0
    middle = np.stack(np.meshgrid(np.arange(39.5, 42.0), np.arange(20.5, 280.0)), -1).reshape(-1, 2)
    assert not warn_shifted(columns, middle, "avenue.laz", Listener())
