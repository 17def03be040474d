"""Sight: what stands in a scan hides tiles; crowns and decks let rays pass."""

import re
from dataclasses import fields, replace

import geopandas as gpd
import numpy as np
import pytest
from datasets import measured
from maps import Listener
from scans import ground, hidden, strewn, write_points
from sites import EAST, NORTH, START, lane_quads, pose, recording, tiles_of

from gis_radar.base import InputError, UsageError
from gis_radar.measures import sight_of_tiles
from gis_radar.poses import View
from gis_radar.scans import (
    HIDDEN,
    IN_SIGHT,
    OUT_OF_VIEW,
    SightScan,
    SightTiles,
    find_sight,
    report_uncovered,
    write_sights,
)

ROAD_M = 372.0
AREA = (-20.0, -80.0, 160.0, 80.0)
SENSOR = pose(height=ROAD_M + 6.0, view=View(max_range_m=150.0, elevation_deg=120.0))
HOUSE, ROOF_M = (40.0, -10.0, 60.0, 10.0), ROAD_M + 9.0


def level(height):
    return lambda x, y: np.full(len(x), height)  # noqa: ARG005 - of a place


def across(height_m=ROAD_M):
    """A lane across, 100 m ahead, from 60 m to the right to 60 m to the left."""
    lane = lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)
    return SightTiles.of(tiles_of([lane], height_m=height_m))


def left_m(tiles):
    """How far left of the sensor's axis each tile is."""
    return tiles.centres[:, 1] - NORTH


def sight_over(tmp_path, points, tiles, sensor=SENSOR, **scan):
    path = write_points(tmp_path / "scan.laz", points, **scan)
    return find_sight(sensor, tiles, SightScan([path], tiles))


def flat(*bodies, density=6.0):
    """Level ground with bodies on it, each (box, top)."""
    points = ground(AREA, level(ROAD_M), density=density)
    for box, top in bodies:
        points = hidden(points, box, level(top))
    return points


def crown(box, top, density=4.0):
    """Leaves over a box, the ground under them being seen too."""
    spread = strewn(box, density, np.random.default_rng(5))
    return np.column_stack([spread, np.random.default_rng(6).uniform(top - 3, top, len(spread))])


@pytest.mark.parametrize(("density", "category"), [(2.0, 6), (12.0, 1)])
def test_a_house_hides_what_a_straight_line_through_it_reaches(tmp_path, density, category):
    points = flat((HOUSE, ROOF_M), density=density)
    classes = np.where(points[:, 2] > ROAD_M + 3.0, category, 2 if category == 6 else 1)
    tiles = across()
    sight = sight_over(tmp_path, points, tiles, category=classes)
    edge = 10.0 / 0.4  # of the shadow of the house's front at 40 m
    certain = np.abs(np.abs(left_m(tiles)) - edge) > 3.0
    shadow = np.abs(left_m(tiles)) < edge
    np.testing.assert_array_equal((sight.state == HIDDEN)[certain], shadow[certain])
    middle = np.abs(left_m(tiles)) < 5.0
    np.testing.assert_allclose(sight.hidden_at_m[middle], 40.0, atol=2.0)
    assert set(sight.state) == {HIDDEN, IN_SIGHT}
    assert sight.covered == 1.0


def test_over_a_low_house_and_past_a_wide_crown_all_is_in_sight(tmp_path):
    low = flat(((40.0, -10.0, 60.0, 10.0), ROAD_M + 2.2))
    leaves = np.vstack([flat(), crown(HOUSE, ROOF_M)])
    for points in (low, leaves):
        assert (sight_over(tmp_path, points, across()).state == IN_SIGHT).all()
    solid = flat((HOUSE, ROOF_M))
    assert (sight_over(tmp_path, solid, across()).state == HIDDEN).any()


def test_a_truck_on_the_road_when_the_scan_was_flown_hides_nothing(tmp_path):
    points = flat(((98.4, -8.0, 101.6, 8.0), ROAD_M + 4.0))
    assert (sight_over(tmp_path, points, across()).state == IN_SIGHT).all()


def two_levels():
    """A road ahead, and a bridge of 10 m across it, 6.5 m higher, 50 m away."""
    ahead = lane_quads(EAST + 10.0, NORTH, 0.0, count=240)
    bridge = [lane_quads(EAST + x, NORTH - 40.0, 90.0, count=160) for x in (51.6, 54.8, 58.0)]
    heights = [ROAD_M, *[ROAD_M + 6.5] * len(bridge)]
    tiles = SightTiles.of(tiles_of([ahead, *bridge], height_m=heights))
    return tiles, flat(((50.0, -40.0, 60.0, 40.0), ROAD_M + 6.5))


def test_a_ray_passes_under_a_deck_and_over_it(tmp_path):
    tiles, points = two_levels()
    lower = tiles.height == ROAD_M
    sight = sight_over(tmp_path, points, tiles, pose(height=ROAD_M + 4.0, view=SENSOR.view))
    assert (sight.state[lower] == IN_SIGHT).all()
    high = pose(height=ROAD_M + 16.0, view=SENSOR.view, pitch=5.0)
    sight = sight_over(tmp_path, points, tiles, high)
    assert (sight.state[~lower] == IN_SIGHT).all()
    beyond = lower & (tiles.centres[:, 0] > EAST + 76.0) & (tiles.centres[:, 0] < EAST + 92.0)
    assert (sight.state[beyond] == HIDDEN).all()  # z = 377 to 378.5 m over it
    assert set(sight.hider[beyond]) == {3}


def test_a_bank_of_earth_hides_what_is_behind_it(tmp_path):
    def bank(x, y):
        return ROAD_M + np.clip(6.0 - np.abs(x - 55.0) / 1.5 + 5.0, 0.0, 6.0) + 0.0 * y

    points = ground(AREA, bank, density=6.0)
    assert (sight_over(tmp_path, points, across()).state == HIDDEN).all()


def test_without_a_scan_or_heights_the_view_decides(tmp_path):
    tiles = across(np.nan)
    SENSOR.write(tmp_path / "S.json")
    sight = find_sight(tmp_path / "S.json", tiles)
    place = SENSOR.to_sensor(np.column_stack([tiles.centres[:, :2], np.full(240, 378.0)]))
    assert ((sight.state == IN_SIGHT) == (np.hypot(*place[:, :2].T) <= 150.0)).all()
    narrow = pose(height=378.0, view=View(max_range_m=150.0, azimuth_deg=30.0))
    assert (find_sight(narrow, tiles).state == OUT_OF_VIEW).any()
    assert sight.scan == "view only"


def test_tiles_without_heights_take_those_of_the_ground(tmp_path):
    sight = sight_over(tmp_path, flat((HOUSE, ROOF_M)), across(np.nan))
    known = sight_over(tmp_path, flat((HOUSE, ROOF_M)), across())
    assert np.count_nonzero(sight.state != known.state) <= 4


@pytest.mark.parametrize("higher_m", [46.3, -46.3])
def test_a_scan_in_another_vertical_system_is_refused(tmp_path, higher_m):
    tiles = across()
    path = write_points(tmp_path / "high.laz", flat() + [0.0, 0.0, higher_m])
    told = re.escape(f"high.laz: its road is {higher_m:+} m from the height")
    with pytest.raises(InputError, match=told):
        find_sight(SENSOR, tiles, SightScan([path], tiles))


@pytest.mark.parametrize("drop_m", [5.1, 5.7])
def test_what_is_looked_at_is_60_cm_over_the_road(drop_m):
    """From 6 m over it, through a view that ends so much lower at 100 m."""
    view = View(max_range_m=150.0, elevation_deg=2.0 * np.degrees(np.arctan(drop_m / 100.0)))
    sensor, tiles = pose(height=ROAD_M + 6.0, view=view), across()
    away_m = np.hypot(*(tiles.centres[:, :2] - sensor.position[:2]).T)
    in_sight = find_sight(sensor, tiles).state == IN_SIGHT
    np.testing.assert_array_equal(in_sight, 5.4 / away_m <= drop_m / 100.0)


def test_a_frame_beside_a_scan_that_is_open_is_refused(tmp_path):
    tiles = across()
    scan = SightScan([write_points(tmp_path / "scan.laz", flat())], tiles)
    for source in (scan, None):
        with pytest.raises(UsageError, match="scan_crs is for files of scans"):
            find_sight(SENSOR, tiles, source, scan_crs=25832)


def test_what_the_scan_does_not_cover_counts_as_in_sight_and_is_named(tmp_path):
    points = flat((HOUSE, ROOF_M))
    half = points[points[:, 1] > 0.0]
    sight = sight_over(tmp_path, half, across())
    right = left_m(across()) < -10.0
    assert (sight.state[right] == IN_SIGHT).all()
    assert sight.uncovered[right].all()
    heard = Listener()
    report_uncovered([sight, sight], heard)
    ((rank, message),) = heard.messages
    assert rank == "warning"
    assert re.match(r"the scan covers \d\d% of the view of R1", message)


def test_a_scan_that_misses_the_rim_of_a_view_is_no_warning(tmp_path):
    points = flat()
    heard = Listener()
    report_uncovered([sight_over(tmp_path, points, across())], heard)
    assert heard.messages == []
    nearly = sight_over(tmp_path, points[points[:, 1] > -45.0], across())
    assert 0.9 < nearly.covered < 1.0
    report_uncovered([nearly], heard)
    ((rank, _),) = heard.messages
    assert rank == "info"


def test_a_dataset_observes_what_is_in_sight_and_names_the_scan(tmp_path):
    path = write_points(tmp_path / "scan.laz", flat((HOUSE, ROOF_M)))
    tiles = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    track = recording(
        tmp_path / "r.parquet", START + np.arange(3), np.tile([100.0, 0, -6.0], (3, 1))
    )
    found = measured([track], [SENSOR], tiles, tmp_path / "ds", scans=[path])
    road = SightTiles.of(tiles)
    sight = find_sight(SENSOR, road, SightScan([path], road))
    seen = road.tile_id[sight.state == IN_SIGHT]
    assert (sight.state == HIDDEN).any()
    np.testing.assert_array_equal(sight.seen, seen)
    np.testing.assert_array_equal(found.sight_of("R1"), seen)
    np.testing.assert_array_equal(np.unique(found.observed()["tile_id"]), seen)
    assert found.manifest.settings["sight"]["files"] == ["scan.laz"]
    plain = measured([track], [SENSOR], tiles, tmp_path / "plain")
    assert len(plain.sights()) == 240
    assert plain.manifest.settings["sight"] == "view only"


def test_the_layer_has_a_row_a_tile_in_view_and_names_what_hides_it(tmp_path):
    tiles = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    sight = sight_over(tmp_path, flat((HOUSE, ROOF_M)), SightTiles.of(tiles))
    write_sights([sight], tiles, tmp_path / "sight.gpkg")
    layer = gpd.read_file(tmp_path / "sight.gpkg", layer="sight")
    assert layer["tile_id"].tolist() == sight.tile_id[sight.state != OUT_OF_VIEW].tolist()
    hidden_ids = sight.tile_id[sight.state == HIDDEN]
    behind = layer[layer["state"] == "hidden"]
    np.testing.assert_array_equal(behind["tile_id"], hidden_ids)
    assert set(behind["hidden_by"]) == {"something that stands"}
    middles = layer.geometry.centroid.y - NORTH
    np.testing.assert_allclose(middles, left_m(SightTiles.of(tiles)), atol=1e-6)


def test_a_dataset_has_the_sight_that_it_was_measured_with(tmp_path):
    """What a report draws: hidden is what a scan took from the view."""
    path = write_points(tmp_path / "scan.laz", flat((HOUSE, ROOF_M)))
    table = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    road = SightTiles.of(table)
    track = recording(tmp_path / "r.parquet", [START], [[100.0, 0, -6.0]])
    found = measured([track], [SENSOR], table, tmp_path / "ds", scans=[path])
    sight = sight_of_tiles(found.sight_of("R1"), SENSOR, road)
    true = find_sight(SENSOR, road, SightScan([path], road))
    np.testing.assert_array_equal(sight.state, true.state)


def arrays_of(sight):
    named = {field.name: getattr(sight, field.name) for field in fields(sight)}
    return {name: each for name, each in named.items() if isinstance(each, np.ndarray)}


def test_sight_is_found_once_a_pose_and_the_same_when_kept(tmp_path):
    tiles = across()
    path = write_points(tmp_path / "scan.laz", flat((HOUSE, ROOF_M)))
    for turn in range(4):
        heard = Listener()
        kept = SightScan([path], tiles, cache=tmp_path / "sights", reporter=heard)
        kept.read([SENSOR])
        found = kept.find(SENSOR)
        assert bool(heard.stages) == (turn != 1)  # whether the scan was read
        expected = SightScan([path], tiles).find(SENSOR)
        assert found.scan == expected.scan
        for name, values in arrays_of(expected).items():
            np.testing.assert_array_equal(arrays_of(found)[name], values)
        (file,) = (tmp_path / "sights").iterdir()
        content = file.read_bytes()
        if turn == 1:
            file.write_bytes(content[:-30])  # damaged: found anew
        if turn == 2:
            begin = content.index(b"state.npy") + 29  # behind its name and sizes of 64 bits
            file.write_bytes(content[:begin] + b"\xff" * 9 + content[begin + 9 :])


def test_kept_sight_is_that_of_pose_view_heights_and_scan(tmp_path):
    tiles = across()
    path = write_points(tmp_path / "scan.laz", flat((HOUSE, ROOF_M)))
    other = write_points(tmp_path / "other.laz", flat())
    higher = replace(SENSOR, height=SENSOR.height + 5.0)
    short = replace(SENSOR, view=View(max_range_m=90.0))
    asked = [
        (path, tiles, SENSOR), (path, tiles, higher), (path, tiles, short),
        (path, across(ROAD_M + 1.0), SENSOR), (other, tiles, SENSOR),
    ]  # fmt: skip
    for scan, road, sensor in asked:
        source = SightScan([scan], road, cache=tmp_path / "sights")
        found = source.find(sensor)
        expected = SightScan([scan], road).find(sensor)
        np.testing.assert_array_equal(found.state, expected.state)
    assert len(list((tmp_path / "sights").iterdir())) == len(asked)
