"""Where a map lies: its zone, local metres against degrees, heights."""

import math
import re

import numpy as np
import pytest
import shapely
from maps import (
    EAST,
    LEFT,
    NORTH,
    RIGHT,
    SHARED,
    UTM,
    Listener,
    degrees,
    metres,
    one,
    refused,
    write_lanelet,
    write_osm,
    write_road,
)

from gis_radar import sample_folder
from gis_radar.base import CrsError, UsageError
from gis_radar.hdmap import make_tiles, read_map

MAPS = SHARED / "maps"


def test_a_map_across_zones_gets_one_zone(tmp_path):
    nodes = {}
    for i, lon in enumerate([5.999, 6.0, 6.0005, 6.001]):
        nodes[i], nodes[10 + i] = {"lon": lon, "lat": 50.0001}, {"lon": lon, "lat": 50.0}
    path = write_osm(tmp_path / "a.osm", nodes, {1: [0, 1, 2, 3], 2: [10, 11, 12, 13]}, {9: (1, 2)})
    road = read_map(path)
    assert road.crs.to_epsg() == 25832
    assert road.lanelets.length[0] == pytest.approx(2 * (143.4 + 11.1), rel=0.01)
    told = (
        "lies on the border of EPSG:25831 and EPSG:25832, all of it is in EPSG:25832; --crs names"
    )
    assert [text for text in road.remarks if "border" in text] == [f"{told} another"]
    named = read_map(path, crs="EPSG:25831")
    assert named.crs.to_epsg() == 25831
    assert not any("border" in text for text in named.remarks)


PLACES = {1: (0, 3), 2: (60, 33), 3: (60, 30), 4: (0, 0)}


def local_nodes(scale=1.0, turn_deg=0.0, shift=(1000.0, 2000.0), places=PLACES):
    """Nodes of two bounds whose local metres are the true ones, scaled, turned and moved."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    nodes = {}
    for ref, (x, y) in places.items():
        lon, lat = degrees(x, y)
        tags = {
            "local_x": scale * (c * x - s * y) + shift[0],
            "local_y": scale * (s * x + c * y) + shift[1],
        }
        nodes[ref] = {"lat": f"{lat:.12f}", "lon": f"{lon:.12f}", "tags": tags}
    return nodes


def local_map(path, nodes):
    return write_osm(path, nodes, {1: [1, 2], 2: [4, 3]}, {9: (1, 2)})


@pytest.mark.parametrize(
    ("scale", "turn_deg"), [(1.0, 0.0), (1.0009, 0.0), (0.9991, 1.8), (1.0, 90.0)]
)
def test_local_metres_that_agree_are_only_a_copy(tmp_path, scale, turn_deg):
    road = read_map(local_map(tmp_path / "a.osm", local_nodes(scale, turn_deg)))
    np.testing.assert_allclose(metres(road.lanelets["left"][0]), [[0, 3], [60, 33]], atol=1e-4)
    assert road.remarks == ()


def test_an_origin_that_is_not_needed_is_said_to_be_unused(tmp_path):
    road = read_map(local_map(tmp_path / "a.osm", local_nodes()), origin=(0.0, 0.0))
    np.testing.assert_allclose(metres(road.lanelets["left"][0])[0], [0, 3], atol=1e-4)
    assert "--origin is not used" in road.remarks[0]


def test_a_few_local_metres_do_not_move_a_map(tmp_path):
    nodes = {ref: {**node, "tags": {}} for ref, node in local_nodes().items()}
    nodes[1] |= {"tags": {"local_x": 5.0, "local_y": 6.0}}
    road = read_map(local_map(tmp_path / "a.osm", nodes), origin=(0.0, 0.0))
    np.testing.assert_allclose(metres(road.lanelets["left"][0])[0], [0, 3], atol=1e-4)
    assert "--origin is not used" in road.remarks[0]


def test_a_few_degrees_do_not_place_a_map(tmp_path):
    nodes = {ref: {**node, "lat": "", "lon": ""} for ref, node in local_nodes().items()}
    path = local_map(tmp_path / "a.osm", nodes | {1: local_nodes()[1]})
    road = read_map(path)
    np.testing.assert_allclose(metres(road.lanelets["left"][0]), [[0, 3], [60, 33]], atol=1e-4)
    assert "most nodes have nothing else" in road.remarks[0]


def test_a_node_without_degrees_is_filled_from_local_metres_that_agree(tmp_path):
    nodes = local_nodes(turn_deg=30.0)
    nodes[2] |= {"lat": "", "lon": ""}
    road = read_map(local_map(tmp_path / "a.osm", nodes))
    np.testing.assert_allclose(metres(road.lanelets["left"][0]), [[0, 3], [60, 33]], atol=1e-3)


@pytest.mark.parametrize("scale", [1.0011, 0.9989, 0.5, 50.0])
def test_local_metres_win_over_degrees_of_another_scale(tmp_path, scale):
    listener = Listener()
    path = local_map(tmp_path / "a.osm", local_nodes(scale, shift=(10.0, 20.0)))
    road = read_map(path, reporter=listener)
    line = metres(road.lanelets["left"][0])
    np.testing.assert_allclose(line[1] - line[0], [60 * scale, 30 * scale], rtol=1e-6)
    middle = np.mean([line.mean(axis=0), metres(road.lanelets["right"][0]).mean(axis=0)], axis=0)
    np.testing.assert_allclose(middle, [30.0, 16.5], atol=1e-3)
    assert "best-fit shift" in road.remarks[0]
    assert listener.messages[0] == ("warning", f"a.osm: {road.remarks[0]}")
    placed = read_map(path, origin=(600_000.0, 5_000_000.0))
    start = shapely.get_coordinates(placed.lanelets["left"][0])[0]
    np.testing.assert_allclose(start, [600_010.0, 5_000_020.0 + 3.0 * scale], rtol=1e-9)
    assert placed.remarks[0].endswith("and --origin")


def test_mirrored_degrees_lose_to_local_metres(tmp_path):
    nodes = local_nodes(places=PLACES | {2: (60, 63)})
    for node in nodes.values():
        node["tags"]["local_y"] *= -1.0
    road = read_map(local_map(tmp_path / "a.osm", nodes))
    assert "best-fit shift" in road.remarks[0]


@pytest.mark.parametrize(
    "same", [{"lat": "", "lon": ""}, {"lat": "0.0", "lon": "0.0"}, {"lat": "NaN"}]
)
def test_a_map_without_degrees_needs_an_origin_and_a_crs(tmp_path, same):
    nodes = {ref: node | same for ref, node in local_nodes().items()}
    path = local_map(tmp_path / "a.osm", nodes)
    assert "--origin E,N" in refused(path).hint
    assert "--crs" in refused(path, origin=(EAST, NORTH)).hint
    road = read_map(path, origin=(EAST - 1000.0, NORTH - 2000.0), crs=UTM)
    np.testing.assert_allclose(metres(road.lanelets["left"][0]), [[0, 3], [60, 33]], atol=1e-6)


def test_an_origin_without_local_metres_is_wrong_usage(tmp_path):
    refused(write_road(tmp_path / "a.osm"), UsageError, origin=(EAST, NORTH))
    refused(write_road(tmp_path / "b.osm", local=True), UsageError, origin=(EAST, math.nan))


def test_heights_are_kept_and_gaps_closed_along_the_bound(tmp_path):
    left = [(0.0, 3.0, 100.0), (10.0, 3.0), (20.0, 3.0, 104.0)]
    right = [(0.0, 0.0, 101.0), (20.0, 0.0, 101.0)]
    lanelet = one(write_lanelet(tmp_path / "a.osm", left, right))
    assert shapely.get_coordinates(lanelet["left"], include_z=True)[:, 2] == pytest.approx(
        [100, 102, 104]
    )
    assert shapely.get_coordinates(lanelet["centre"], include_z=True)[-1, 2] == 102.5


def test_a_bound_without_heights_takes_those_of_the_other(tmp_path):
    right = [(0.0, 0.0, 5.0), (10.0, 0.0, 6.0), (20.0, 0.0, 7.0)]
    lanelet = one(write_lanelet(tmp_path / "a.osm", LEFT, right))
    assert shapely.get_coordinates(lanelet["left"], include_z=True)[:, 2].tolist() == [5.0, 7.0]


def test_a_flat_map_has_heights(tmp_path):
    flat = [(x, y, 0.0) for x, y in LEFT], [(x, y, 0.0) for x, y in RIGHT]
    assert one(write_lanelet(tmp_path / "a.osm", *flat))["left"].has_z


def test_a_few_heights_mean_unknown(tmp_path):
    left = [(0.0, 3.0, 115.0), (10.0, 3.0), (20.0, 3.0)]
    road = read_map(write_lanelet(tmp_path / "a.osm", left, RIGHT))
    assert not road.lanelets["left"][0].has_z
    assert "heights are treated as unknown: only 1 of 5 nodes" in road.remarks[0]


def long_bounds(height_of):
    """Bounds of 20 nodes each; `height_of` gives the height at x, or None."""
    sides = []
    for y in (3.0, 0.0):
        heights = [(5.0 * i, height_of(5.0 * i)) for i in range(20)]
        sides.append([(x, y) if h is None else (x, y, h) for x, h in heights])
    return sides


def test_heights_of_some_nodes_are_kept_where_they_vary(tmp_path):
    left, right = long_bounds(lambda x: 400.0 + 0.1 * x if x % 25 in {0.0, 15.0} else None)
    road = read_map(write_lanelet(tmp_path / "a.osm", left, right))
    line = shapely.get_coordinates(road.lanelets["left"][0], include_z=True)
    np.testing.assert_allclose(line[:-1, 2], 400.0 + 0.1 * np.arange(0.0, 95.0, 5.0), atol=1e-9)
    remark = "only 16 of 40 nodes have a height: interpolated along bounds"
    assert [text.split(",")[0] for text in road.remarks] == [remark]


def test_equal_heights_of_many_nodes_are_kept(tmp_path):
    left, right = long_bounds(lambda x: 400.0 if x % 25 in {0.0, 15.0} else None)
    assert one(write_lanelet(tmp_path / "a.osm", left, right))["left"].has_z


def test_one_low_tag_of_many_nodes_means_unknown(tmp_path):
    left, right = long_bounds(lambda x: 115.0 if x == 50.0 else None)
    road = read_map(write_lanelet(tmp_path / "a.osm", left, right))
    assert not road.lanelets["left"][0].has_z
    assert "only 2 of 40 nodes have an ele tag, all equal" in road.remarks[0]


def test_a_lanelet_without_heights_stays_without_beside_one_that_has_them(tmp_path):
    nodes = {i: (10.0 * i, 3.0, 400.0 + i) if i < 2 else (10.0 * i, 3.0) for i in range(4)}
    nodes |= {10 + i: (10.0 * i, 0.0) for i in range(4)}
    ways = {1: [0, 1], 2: [10, 11], 3: [2, 3], 4: [12, 13]}
    road = read_map(write_osm(tmp_path / "a.osm", nodes, ways, {8: (1, 2), 9: (3, 4)}))
    assert road.lanelets["left"].has_z.tolist() == [True, False]
    heights = make_tiles(road)["height_m"]
    np.testing.assert_allclose(heights[:20], 400.0 + np.arange(0.025, 1.0, 0.05), atol=1e-6)
    assert heights[20:].isna().all()


@pytest.mark.parametrize(
    ("crs", "reason"),
    [
        ("EPSG:3857", "1.519 m for each metre"),
        ("EPSG:32601", "outside"),
        ("EPSG:2065", "axes that point south and west"),
    ],
)
def test_a_crs_that_does_not_fit_the_place_is_refused(tmp_path, crs, reason):
    error = refused(write_road(tmp_path / "a.osm"), CrsError, crs=crs)
    assert error.message.startswith("--crs: ")
    assert reason in error.message


@pytest.mark.parametrize("crs", ["EPSG:31468", "EPSG:32632", "EPSG:25833", "EPSG:5652"])
def test_a_grid_of_the_place_is_taken(tmp_path, crs):
    road = read_map(write_road(tmp_path / "a.osm"), crs=crs)
    assert road.lanelets.area.tolist() == pytest.approx([30.0] * 2, rel=2e-3)
    first = shapely.get_coordinates(road.lanelets["left"][0])
    assert first[0, 1] > 5_000_000.0


@pytest.mark.parametrize(("crs", "told"), [("EPSG:31468", True), ("EPSG:25833", False)])
def test_a_grid_of_an_old_datum_is_told(tmp_path, crs, told):
    heard = read_map(write_road(tmp_path / "a.osm"), crs=crs).remarks
    assert any("positions change from WGS 84" in each for each in heard) is told


def test_local_metres_keep_their_scale_whatever_the_crs_and_say_so(tmp_path):
    road = read_map(local_map(tmp_path / "a.osm", local_nodes(50.0)), crs="EPSG:3857")
    line = metres(road.lanelets["left"][0])
    np.testing.assert_allclose(line[1] - line[0], [3000.0, 1500.0], rtol=1e-6)
    assert "1.519 m for each metre" in str(road.remarks)


@pytest.mark.parametrize("file", ["junction.osm", "karlsruhe_mapping_example.osm"])
def test_swapped_latitudes_and_longitudes_are_named(tmp_path, file):
    """The swapped map is a mirror image, whose lanelets lead the other way."""
    path = sample_folder() / file
    if not path.exists():
        path = MAPS / file
        if not path.exists():
            pytest.skip("no maps beside the project")
    text = path.read_text(encoding="utf-8")
    assert not any("swapped" in each for each in read_map(path).remarks)
    for name, other in (("lat", "LAT"), ("lon", "lat"), ("LAT", "lon")):
        text = re.sub(rf"\b{name}=(?=[\"'])", f"{other}=", text)
    (tmp_path / "swapped.osm").write_text(text, encoding="utf-8")
    assert any("longitudes, or local_x and local_y, swapped?" in each
               for each in read_map(tmp_path / "swapped.osm").remarks)  # fmt: skip
