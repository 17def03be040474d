"""The road mask on scans whose truth is known: what stays, what goes, at which height."""

import json
from dataclasses import asdict

import laspy
import numpy as np
import pytest
from maps import Listener
from scans import (
    EAST,
    NORTH,
    UTM,
    box_roads,
    ground,
    hidden,
    level,
    strewn,
    write_points,
)

import gis_radar as gr
from gis_radar.base import InputError, NoAnswerError, OutputError
from gis_radar.scans.settings import MaskSettings

ROAD = (0.0, 0.0, 120.0, 8.0)
AROUND = (-20.0, -20.0, 140.0, 28.0)


def slope(x, y):
    return 100.0 + 0.12 * x + 0.025 * y


def crest(x, y):
    return 100.0 + 0.08 * x - x**2 / 400.0  # a radius of 200 m


def masked(path, points, roads=None, **options):
    """Mask with the built-in engine; return the mask and its points relative to the site."""
    write_points(path, points, **options)
    mask = gr.mask_road([path], roads or box_roads(ROAD), engine="laspy")
    return mask, mask.points - [EAST, NORTH, 0.0]


def off(points, surface):
    return np.abs(points[:, 2] - surface(points[:, 0], points[:, 1]))


@pytest.mark.parametrize("surface", [level, slope, crest])
def test_a_bare_road(tmp_path, surface):
    mask, points = masked(tmp_path / "scan.laz", ground(AROUND, surface))
    assert mask.covered > 0.9
    assert np.median(off(points, surface)) < 0.012
    assert off(points, surface).max() < 0.08


def test_centres_of_half_metre_cells(tmp_path):
    _, points = masked(tmp_path / "scan.laz", ground(AROUND, level))
    np.testing.assert_allclose(np.mod(points[:, :2], 0.5), 0.25, atol=1e-6)
    assert len(np.unique(points[:, :2], axis=0)) == len(points)
    inside = (points[:, :2] > [0.0, 0.0]) & (points[:, :2] < [120.0, 8.0])
    assert inside.all()


@pytest.mark.parametrize("surface", [level, slope])
def test_cars_go(tmp_path, surface):
    points = ground(AROUND, surface)
    cars = [(x, y, x + 4.5, y + 1.8) for x in range(2, 110, 7) for y in (0.6, 5.4)]
    lorry = (60.0, 2.7, 76.0, 5.2)
    for box, height in [*((car, 1.5) for car in cars), (lorry, 3.8)]:
        points = hidden(points, box, lambda x, y, h=height: surface(x, y) + h)
    _, found = masked(tmp_path / "scan.laz", points)
    assert off(found, surface).max() < 0.12
    assert len(found) > 0.6 * 240 * 16


def test_a_crown_without_a_gap_goes(tmp_path):
    rng = np.random.default_rng(3)
    points = hidden(
        ground(AROUND, slope), (40.0, -4.0, 52.0, 5.0),
        lambda x, y: slope(x, y) + rng.uniform(3.0, 8.0, len(x)),
    )  # fmt: skip
    _, found = masked(tmp_path / "scan.laz", points)
    assert off(found, slope).max() < 0.12


@pytest.mark.parametrize("height", [0.5, 3.0, 12.0])
def test_a_roof_over_the_edge_goes(tmp_path, height):
    points = hidden(
        ground(AROUND, slope), (30.0, 5.5, 60.0, 30.0), lambda x, y: slope(x, y) + height
    )
    _, found = masked(tmp_path / "scan.laz", points)
    beside = ~((found[:, 0] > 30) & (found[:, 0] < 60) & (found[:, 1] > 5.5))
    assert off(found, slope).max() < 0.15
    assert beside.all()


def test_a_bridge_the_map_does_not_know_goes(tmp_path):
    points = hidden(
        ground(AROUND, level), (50.0, -20.0, 62.0, 28.0), lambda x, y: level(x, y) + 6.0
    )
    _, found = masked(tmp_path / "scan.laz", points)
    assert off(found, level).max() < 0.12
    assert not ((found[:, 0] > 50) & (found[:, 0] < 62)).any()


def test_stray_points_under_the_ground_do_not_pull(tmp_path):
    rng = np.random.default_rng(5)
    low = np.column_stack([strewn(ROAD, 0.02, rng), rng.uniform(80.0, 99.0, 19)])
    _, found = masked(tmp_path / "scan.laz", np.vstack([ground(AROUND, slope), low]))
    assert off(found, slope).max() < 0.12


CROSSING = (50.0, -40.0, 62.0, 48.0)


def deck(x, y):
    return np.full(np.shape(x), 106.0)


def overpass():
    """A road on the ground, and one that crosses it six metres up and hides it there."""
    points = ground((-20.0, -40.0, 140.0, 48.0), level)
    return hidden(points, CROSSING, lambda x, y: deck(x, y) + 0.0 * x)


def test_the_map_chooses_the_upper_road(tmp_path):
    _, found = masked(tmp_path / "s.laz", overpass(), box_roads(CROSSING, heights=[deck]))
    assert off(found, deck).max() < 0.12
    assert len(found) > 0.9 * 24 * 176


def test_both_roads_of_a_crossing(tmp_path):
    seen_below = ground((40.0, 0.0, 72.0, 8.0), level, density=4.0, seed=9)
    roads = box_roads(ROAD, CROSSING, heights=[level, deck])
    mask, found = masked(tmp_path / "s.laz", np.vstack([overpass(), seen_below]), roads)
    upper = found[:, 2] > 103.0
    assert off(found[~upper], level).max() < 0.12
    assert off(found[upper], deck).max() < 0.12
    both = np.unique(found[:, :2], axis=0, return_counts=True)[1] == 2
    assert both.sum() > 0.5 * 24 * 16
    assert mask.cells.area_cells == 240 * 16 + 24 * 176


@pytest.mark.parametrize("metres", [47.3, -0.8])
def test_another_vertical_datum(tmp_path, metres):
    def ellipsoidal(x, y):
        return slope(x, y) + metres

    points = ground(AROUND, ellipsoidal)
    mask, found = masked(tmp_path / "s.laz", points, box_roads(ROAD, heights=[slope]))
    assert off(found, ellipsoidal).max() < 0.12
    assert mask.cells.offset_m == pytest.approx(metres, abs=0.2)


def test_classes_are_believed(tmp_path):
    """Without classes a flat roof as wide as the road is a road; with them it is not."""
    points = ground(AROUND, level)
    category = np.where(points[:, 0] > 60.0, 5, 2)
    mask, found = masked(tmp_path / "scan.laz", points, category=category)
    assert mask.pipeline.classified == (True,)
    assert found[:, 0].max() < 60.5


def test_small_clusters_go(tmp_path):
    points = ground(ROAD, level)
    x = points[:, 0]
    kept = (x < 40.0) | ((x > 60.0) & (x < 60.4))
    mask, found = masked(tmp_path / "scan.laz", points[kept])
    assert found[:, 0].max() < 40.5
    assert mask.cells.removed > 0


def test_what_lies_outside_is_said(tmp_path):
    write_points(tmp_path / "scan.laz", ground((0.0, 0.0, 90.0, 8.0), level))
    listener = Listener()
    mask = gr.mask_road([tmp_path / "scan.laz"], box_roads(ROAD), engine="laspy", reporter=listener)
    assert mask.outside.area == pytest.approx(30 * 8, abs=2.0)
    assert mask.figures()["outside_share"] == pytest.approx(0.25, abs=0.01)
    assert any("25.0% of the map's roads" in text for _, text in listener.messages)
    assert mask.density == pytest.approx(10.0, rel=0.05)


def test_houses_on_the_roads_are_told(tmp_path):
    """As a scan of the neighbouring town shows them, in which the roads run elsewhere."""
    points = ground(AROUND, level)
    for share, told in ((0.6, True), (0.95, False)):
        house = points[:, 0] > share * 120.0
        standing = points + house[:, None] * [0.0, 0.0, 9.0]
        write_points(tmp_path / "scan.laz", standing, category=np.where(house, 6, 2))
        listener = Listener()
        gr.mask_road(tmp_path / "scan.laz", box_roads(ROAD), engine="laspy", reporter=listener)
        assert told == any("are they of another place" in it for _, it in listener.messages)


def test_tiles_off_the_site_are_skipped(tmp_path):
    near = write_points(tmp_path / "near.laz", ground(AROUND, level))
    far = write_points(tmp_path / "far.laz", ground((500.0, 0.0, 520.0, 20.0), level))
    mask = gr.mask_road([far, near], box_roads(ROAD), engine="laspy")
    assert mask.figures()["scans"] == 1
    with pytest.raises(InputError, match=r"far\.laz.*do not overlap"):
        gr.mask_road([far], box_roads(ROAD), engine="laspy")


def test_a_scan_around_the_site_with_a_hole(tmp_path):
    points = ground(AROUND, level)
    off_road = points[(points[:, 1] < -1.0) | (points[:, 1] > 9.0)]
    write_points(tmp_path / "scan.laz", off_road)
    with pytest.raises(InputError, match="do not overlap"):
        gr.mask_road([tmp_path / "scan.laz"], box_roads(ROAD), engine="laspy")


def test_only_things_on_the_road(tmp_path):
    points = ground(ROAD, level)
    write_points(tmp_path / "scan.laz", points[points[:, 0] < 0.4])
    with pytest.raises(NoAnswerError, match="none on a road's surface"):
        gr.mask_road([tmp_path / "scan.laz"], box_roads(ROAD), engine="laspy")


def test_order_and_batches_change_nothing(tmp_path, monkeypatch):
    points = hidden(ground(AROUND, slope), (3.0, 3.0, 8.0, 5.0), lambda x, y: slope(x, y) + 1.4)
    whole, _ = masked(tmp_path / "whole.laz", points)
    shuffled = np.random.default_rng(1).permutation(points)
    monkeypatch.setattr("gis_radar.scans.scan.BATCH_POINTS", 997)
    monkeypatch.setattr("gis_radar.scans.point_store.MOST_IN_MEMORY", 2_000)
    parts = np.split(shuffled, [1_000, 20_000])
    overlapping = [np.vstack([parts[0], parts[1][:500]]), *parts[1:]]
    paths = [tmp_path / f"{i}.laz" for i in range(3)]
    for path, part in zip(paths, overlapping, strict=True):
        write_points(path, part)
    again = gr.mask_road(paths[::-1], box_roads(ROAD), engine="laspy")
    np.testing.assert_array_equal(again.points, whole.points)


def test_the_result_and_what_lies_beside(tmp_path):
    mask, _ = masked(tmp_path / "scan.laz", ground(AROUND, level))
    written = mask.write(tmp_path / "road.laz")
    assert [path.name for path in written] == [
        "road.laz", "road.pipeline.json", "road.roads.gpkg"
    ]  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["scan.laz", *(path.name for path in written)]
    )
    np.testing.assert_allclose(gr.read_road(tmp_path / "road.laz", UTM), mask.points, atol=6e-4)


def test_the_settings_are_written_beside_the_road(tmp_path):
    points = ground(ROAD, level)
    path = write_points(tmp_path / "scan.laz", points[points[:, 0] < 40.0])
    settings = MaskSettings(least_cells=10_000)
    with pytest.raises(NoAnswerError):
        gr.mask_road([path], box_roads(ROAD), engine="laspy", settings=settings)
    settings = MaskSettings(surface_m=0.05)
    mask = gr.mask_road([path], box_roads(ROAD), engine="laspy", settings=settings)
    assert mask.cells.used < 0.95 * mask.points_on_road  # the noise is 0.03 m
    assert mask.figures()["settings"]["surface_m"] == 0.05
    with laspy.open(mask.write(tmp_path / "road.laz")[0]) as road:
        (record,) = (one for one in road.header.vlrs if one.user_id == "gis_radar")
    assert json.loads(record.record_data_bytes()) == json.loads(json.dumps(asdict(settings)))


def test_files_of_a_mask_appear_together_or_not_at_all(tmp_path):
    mask, _ = masked(tmp_path / "scan.laz", ground(AROUND, level))
    (tmp_path / "road.pipeline.json").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        mask.write(tmp_path / "road.laz")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["road.pipeline.json", "scan.laz"]
