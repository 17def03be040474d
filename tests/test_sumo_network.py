"""Edges of a network of SUMO: their traffic is that of all their lanes, or unknown."""

from types import SimpleNamespace
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from shapely import LineString

import gis_radar as gr
from gis_radar.products.sumo import lanes_of_network, read_sumo_network, write_turn_counts


def straight_lanes(*lanes):
    """Give the layer `lanes`, each as its number, its place to the left and its ends, metres."""
    lines = [LineString([(first, y), (last, y)]) for _, y, first, last in lanes]
    table = {"lane": [number for number, *_ in lanes], "stop_line_m": np.nan}
    return gpd.GeoDataFrame(table, geometry=lines, crs="EPSG:25832")


def matched(lanes, network, *, after=None, connectors=(), at="line"):
    """Give on which of the lanes of a network, `edge_index`, lanes are counted."""
    names = [f"{edge}_{k}" for edge, k, *_ in network]
    lines = straight_lanes(*((0, *each[2:]) for each in network)).assign(sumo_lane=names)
    number = lanes["lane"].to_numpy(np.int64)
    order = SimpleNamespace(
        lane=number, connector=np.isin(number, connectors), after=after or [[]] * len(number)
    )
    found = lanes_of_network(lanes, order, lines.assign(edge=[each[0] for each in network]))
    return found[found["place"] == at]


def counting(found):
    rows = found[found["counts"]]
    return dict(zip(rows["lane"], rows["sumo_lane"], strict=True))


def test_two_lanes_on_one_lane_of_a_network_are_not_its_traffic():
    """Networks of OpenStreetMap often have one lane where a road has two."""
    two = straight_lanes((1, 1.7, 0, 100), (2, -1.7, 0, 100))
    assert counting(matched(two, [("e", 0, 0.0, 0, 100)])) == {}
    with pytest.raises(gr.NoAnswerError):  # it lies on one of them, and lacks the other
        matched(two, [("e", 0, -1.7, 0, 100)])
    both = [("e", 0, -1.7, 0, 100), ("e", 1, 1.7, 0, 100)]
    assert counting(matched(two, both)) == {1: "e_1", 2: "e_0"}


def test_of_lanes_that_follow_each_other_on_an_edge_the_last_count():
    edge = [("e", 0, 0.0, 0, 200), ("e", 1, 3.4, 0, 200)]
    lanes = straight_lanes((1, 0.0, 0, 100), (2, 0.0, 100, 200), (3, 3.4, 100, 200))
    fans_out = matched(lanes, edge, after=[[1, 2], [], []])
    assert counting(fans_out) == {2: "e_0", 3: "e_1"}
    assert fans_out["lane"].tolist() == [1, 2, 3]  # turns may lead to the first
    merge = straight_lanes((1, 0.0, 0, 100), (2, 3.4, 0, 100), (3, 0.0, 100, 200))
    assert counting(matched(merge, edge, after=[[2], [2], []])) == {3: "e_0"}


def test_a_connector_is_not_the_traffic_of_an_edge():
    """It begins on the edge where the network's junction is smaller than the map's."""
    lanes = straight_lanes((1, 0.0, 0, 60), (2, 0.0, 60, 100))
    found = matched(lanes, [("e", 0, 0.0, 0, 100)], after=[[1], []], connectors=[2])
    assert counting(found) == {1: "e_0"}


def test_turns_of_a_part_of_the_lanes_of_an_edge_are_unknown(tmp_path):
    begin = pd.Timestamp("2026-01-01")
    turns = pd.DataFrame(
        {
            "from_lane": [1, 2, 3], "to_lane": [4, 5, 4], "begin": begin,
            "end": begin + pd.Timedelta("15min"), "volume": [4.0, 3.0, 2.0], "geometry": None,
        }
    )  # fmt: skip
    edges = pd.DataFrame(
        {
            "lane": [1, 2, 3, 4, 5], "edge": ["in", "in", "half", "out", "out"],
            "sumo_lane": ["in_0", "in_0", "half_0", "out_0", "out_1"],
            "edge_lanes": [1, 1, 2, 2, 2], "counts": [False, False, True, True, True],
        }
    )  # fmt: skip
    edges = pd.concat([edges.assign(place=place) for place in ("begin", "end")])
    path = tmp_path / "turns.xml"
    write_turn_counts(turns, edges, begin, path)
    rows = [each.attrib for each in ET.parse(path).iter("edgeRelation")]  # noqa: S314 - ours
    assert rows == [{"from": "in", "to": "out", "count": "7.00"}]


def test_turns_lead_to_the_edge_on_which_the_exit_begins():
    """Networks split edges at crossings; jtrrouter wants edges that follow each other."""
    exit_lane = straight_lanes((1, 0.0, 0, 160))
    split = [("near", 0, 0.0, 0, 40), ("far", 0, 0.0, 40, 160)]
    at = {place: counting(matched(exit_lane, split, at=place)) for place in ("begin", "line")}
    assert at == {"begin": {1: "near_0"}, "line": {1: "far_0"}}
    assert counting(matched(exit_lane, split[::-1], at="end")) == {1: "far_0"}


def test_ways_for_walking_and_cycling_are_no_lanes(tmp_path):
    allowed = ["pedestrian wheelchair", "bicycle scooter", "bus", "all"]
    rows = [f'<lane id="e_{k}" allow="{each}" shape="0,0 9,0"/>' for k, each in enumerate(allowed)]
    path = tmp_path / "net.xml"
    path.write_text(
        '<net><location netOffset="0,0" projParameter="EPSG:25832"/><edge id="e">'
        + "".join(rows) + "</edge></net>"
    )  # fmt: skip
    assert read_sumo_network(path)["sumo_lane"].tolist() == ["e_2", "e_3"]
