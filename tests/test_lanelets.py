"""Lanelet2 maps: what is read, what is mended, left out or refused."""

import math

import numpy as np
import pytest
from maps import (
    LEFT,
    RIGHT,
    UTM,
    Listener,
    metres,
    one,
    refused,
    write_lanelet,
    write_osm,
    write_road,
)

from gis_radar.hdmap import read_map


def test_a_road_is_read_in_the_zone_of_its_place(tmp_path):
    listener = Listener()
    road = read_map(write_road(tmp_path / "road.osm", pieces=3), reporter=listener)
    assert road.crs == UTM
    assert road.lanelets.crs == road.regulatory.crs == road.problems.crs == UTM
    assert road.lanelets["left"].crs == road.lanelets["centre"].crs == UTM
    assert road.lanelets["lanelet_id"].tolist() == [1000, 1001, 1002]
    assert road.lanelets["lanelet_id"].dtype == np.int64
    assert road.lanelets["successors"].tolist() == [(1001,), (1002,), ()]
    assert road.lanelets["predecessors"].tolist() == [(), (1000,), (1001,)]
    assert road.lanelets.area.tolist() == pytest.approx([30.0] * 3, rel=1e-6)
    first = road.lanelets.iloc[0]
    np.testing.assert_allclose(metres(first["left"]), [[0, 3], [10, 3]], atol=1e-4)
    np.testing.assert_allclose(metres(first["right"]), [[0, 0], [10, 0]], atol=1e-4)
    assert metres(first["centre"])[[0, -1]] == pytest.approx(
        np.array([[0, 1.5], [10, 1.5]]), abs=1e-4
    )
    assert not first["left"].has_z
    assert road.problems.empty
    assert road.remarks == ()
    assert [stage[1:] for stage in listener.stages] == [(0, 3), (3, 3)]
    assert listener.messages == []


@pytest.mark.parametrize("turn_left", [False, True])
@pytest.mark.parametrize("turn_right", [False, True])
def test_bounds_drawn_backwards_are_turned(tmp_path, turn_left, turn_right):
    left = LEFT[::-1] if turn_left else LEFT
    right = RIGHT[::-1] if turn_right else RIGHT
    lanelet = one(write_lanelet(tmp_path / "a.osm", left, right))
    np.testing.assert_allclose(metres(lanelet["left"]), LEFT, atol=1e-4)
    np.testing.assert_allclose(metres(lanelet["right"]), RIGHT, atol=1e-4)


def test_bounds_of_several_ways_are_joined_in_any_order(tmp_path):
    nodes = {i: (10.0 * i, 3.0) for i in range(5)} | {9: (0.0, 0.0), 10: (40.0, 0.0)}
    ways = {1: [3, 4], 2: [1, 0], 3: [1, 2, 3], 4: [9, 10]}
    path = write_osm(tmp_path / "a.osm", nodes, ways, {7: ([1, 2, 3, 1], 4), 8: ([2, 1], 4)})
    road = read_map(path)
    np.testing.assert_allclose(
        metres(road.lanelets["left"][0])[:, 0], [0, 10, 20, 30, 40], atol=1e-4
    )
    assert road.problems["lanelet_id"].tolist() == [8]
    assert road.problems["reason"].tolist() == ["the ways of the left bound do not form a chain"]


@pytest.mark.parametrize(
    ("tags", "subtype", "participants", "one_way"),
    [
        ({"subtype": "road"}, "road", ("bicycle", "vehicle"), True),
        ({}, "road", ("vehicle",), True),
        ({"subtype": "road", "one_way": "no"}, "road", ("bicycle", "vehicle"), False),
        ({"subtype": "crosswalk"}, "crosswalk", ("pedestrian",), False),
        ({"subtype": "crosswalk", "one_way": "true"}, "crosswalk", ("pedestrian",), True),
        ({"subtype": "walkway"}, "walkway", ("pedestrian",), False),
        ({"subtype": "bicycle_lane"}, "bicycle_lane", ("bicycle",), True),
        ({"participant:pedestrian": "yes"}, "walkway", ("pedestrian",), False),
        (
            {"participant:bicycle": "1", "participant:vehicle": "no"},
            "bicycle_lane",
            ("bicycle",),
            True,
        ),
        ({"subtype": "road", "participant:vehicle:bus": "yes"}, "road", ("vehicle:bus",), True),
        ({"participant:vehicle:bus": "yes"}, "road", ("vehicle:bus",), True),
        ({"participant:vehicle": "no"}, "unknown", (), True),
        ({"subtype": "rail"}, "rail", (), True),
    ],
)
def test_tags_say_who_uses_a_lanelet_and_how(tmp_path, tags, subtype, participants, one_way):
    lanelet = one(write_road(tmp_path / "a.osm", tags))
    assert lanelet["subtype"] == subtype
    assert lanelet["participants"] == participants
    assert bool(lanelet["one_way"]) is one_way
    assert lanelet["location"] is None


@pytest.mark.parametrize(
    ("tag", "kmh"),
    [
        ("50", 50.0),
        ("50 km/h", 50.0),
        ("30km/h", 30.0),
        ("13.9 m/s", 50.04),
        ("30 mph", 48.28032),
        ("7,5", 7.5),
        ("", math.nan),
        ("walk", math.nan),
        ("0", math.nan),
        ("50 furlongs", math.nan),
    ],
)
def test_speed_limits_are_in_kilometres_an_hour(tmp_path, tag, kmh):
    lanelet = one(write_road(tmp_path / "a.osm", {"speed_limit": tag}))
    assert lanelet["speed_limit_kmh"] == pytest.approx(kmh, nan_ok=True)


@pytest.mark.parametrize(
    ("rule", "sign", "kmh"),
    [
        ({"sign_type": "30 km/h"}, {}, 30.0),
        ({"sign_type": "de274-50"}, {}, 50.0),
        ({}, {"type": "traffic_sign", "subtype": "de274-70"}, 70.0),
        ({}, {"type": "traffic_sign", "subtype": "de205"}, 100.0),
    ],
)
def test_a_speed_limit_element_wins_over_the_tag(tmp_path, rule, sign, kmh):
    nodes = {1: LEFT[0], 2: LEFT[1], 3: RIGHT[0], 4: RIGHT[1], 5: (5.0, 4.0), 6: (5.5, 4.0)}
    ways = {1: [1, 2], 2: [3, 4], 3: ([5, 6], sign)}
    rules = {80: ({"subtype": "speed_limit", **rule}, [("way", 3, "refers")])}
    tags = {"speed_limit": "100", "rules": [80, 81]}
    lanelet = one(write_osm(tmp_path / "a.osm", nodes, ways, {9: (1, 2, tags)}, rules))
    assert lanelet["speed_limit_kmh"] == kmh


def test_regulatory_elements_are_listed_with_their_members(tmp_path):
    nodes = {1: LEFT[0], 2: LEFT[1], 3: RIGHT[0], 4: RIGHT[1], 5: (19.0, 0.0), 6: (19.0, 3.0)}
    ways = {
        1: [1, 2],
        2: [3, 4],
        3: ([5, 6], {"type": "stop_line"}),
        4: ([4, 2], {"type": "stop_line"}),
    }
    members = [
        ("way", 3, "ref_line"),
        ("relation", 9, "yield"),
        ("node", 6, "refers"),
        ("way", 77, "x"),
    ]
    rules = {80: ({"subtype": "right_of_way"}, members)}
    table = read_map(
        write_osm(tmp_path / "a.osm", nodes, ways, {9: (1, 2, {"rules": [80]})}, rules)
    ).regulatory
    assert table["element_id"].tolist() == [80, 80, 80, 80, 4]
    assert table["role"].tolist() == ["ref_line", "yield", "refers", "x", "ref_line"]
    assert table["lanelet_ids"].tolist() == [(9,), (9,), (9,), (9,), ()]
    assert table["member_type"].tolist() == ["stop_line", "relation", "node", "way", "stop_line"]
    assert table["subtype"].tolist() == ["right_of_way"] * 4 + ["stop_line"]
    kinds = [shape and shape.geom_type for shape in table.geometry]
    assert kinds == ["LineString", None, "Point", None, "LineString"]
    np.testing.assert_allclose(metres(table.geometry[0]), [[19, 0], [19, 3]], atol=1e-4)


DEFECTS = {
    "the left bound is missing": ([], 2),
    "the right bound is missing: way 77 is not in the file": (1, 77),
    "the left bound has no length: 1 of its 2 nodes are missing": (3, 2),
    "the left bound has no length: 2 of its 2 nodes are missing": (4, 2),
    "it has no width: its bounds lie on each other, or cross": (2, 2),
    "its bounds cross or meet between its ends": (6, 2),
    "the left bound is 5864 km long: a node is in the wrong place": (7, 2),
    "the left bound has no length: it has not two distinct points": (8, 2),
    "the right bound has no length: it has not two distinct points": (1, 5),
}


@pytest.mark.parametrize(("reason", "bounds"), list(DEFECTS.items()))
def test_what_cannot_be_mended_is_left_out_and_the_rest_read(tmp_path, reason, bounds):
    nodes = {1: LEFT[0], 2: LEFT[1], 3: RIGHT[0], 4: RIGHT[1], 5: {"lat": "nan", "lon": "9"}}
    nodes |= {6: (12.0, 3.0), 7: (13.0, -3.0), 8: (20.0, -3.5), 9: {"lat": 11.0, "lon": 48.0}}
    ways = {
        1: [1, 2],
        2: [3, 4],
        3: [1, 99],
        4: [5, 99],
        5: [1, 1],
        6: [1, 6, 7, 8],
        7: [1, 9],
        8: [],
    }
    road = read_map(write_osm(tmp_path / "a.osm", nodes, ways, {20: (1, 2), 21: bounds}))
    assert road.lanelets["lanelet_id"].tolist() == [20]
    assert road.problems["lanelet_id"].tolist() == [21]
    assert road.problems["action"].tolist() == ["left out"]
    assert road.problems["reason"][0].startswith(reason)
    assert road.remarks == ("1 lanelet left out, see layer problems of the tiles",)


def test_lost_nodes_are_dropped_and_listed(tmp_path):
    nodes = {1: LEFT[0], 2: LEFT[1], 3: RIGHT[0], 4: RIGHT[1], 5: {"lat": "inf", "lon": "9"}}
    road = read_map(
        write_osm(tmp_path / "a.osm", nodes, {1: [1, 5, 99, 2], 2: [3, 4]}, {9: (1, 2)})
    )
    assert road.problems["action"].tolist() == ["repaired"]
    assert road.problems["reason"][0].startswith("2 of 4 nodes of the left bound are missing")
    np.testing.assert_allclose(metres(road.lanelets["left"][0]), LEFT, atol=1e-4)


def test_repairs_are_listed_with_the_outline(tmp_path):
    fork = [(0.0, 0.0), (20.0, 3.0)]
    road = read_map(write_lanelet(tmp_path / "a.osm", fork, RIGHT))
    assert road.problems["reason"].tolist() == ["start without width parted by 1 cm"]
    assert road.problems.geometry[0].equals(road.lanelets.geometry[0])
    assert road.remarks == ("1 lanelet repaired, see layer problems of the tiles",)


def test_a_map_without_a_readable_lanelet_is_refused(tmp_path):
    empty = refused(write_osm(tmp_path / "a.osm", {1: (0.0, 0.0)}, {}, {}))
    assert "holds no lanelets" in empty.message
    nowhere = refused(write_osm(tmp_path / "b.osm", {}, {1: [1, 2]}, {9: (1, 1)}))
    assert "no lanelet has a node with usable coordinates" in nowhere.message
    broken = refused(write_lanelet(tmp_path / "c.osm", LEFT, LEFT))
    assert "none of its 1 lanelets can be read: lanelet 1000: it has no width" in broken.message
