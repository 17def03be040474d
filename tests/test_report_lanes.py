"""Lanes of a report: chains of lanelets, against the successors that the map itself tells."""

from __future__ import annotations

from itertools import combinations
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
import shapely
from counted_sites import lane_tiles
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sites import EAST, NORTH, lane_quads, tiles_of
from test_heatmap_occupancy import both_of
from test_report_pages import content_of, letters_of, pages_of

from gis_radar.base import Clock
from gis_radar.hdmap import lanes_of
from gis_radar.products import make_heatmap
from gis_radar.products.heatmap.occupancy import surest
from gis_radar.products.report import chart
from gis_radar.products.report.lanes import lane_table, sums_of, write_lanes
from gis_radar.products.report.maps import with_room_for_scale
from gis_radar.products.report.plan import place_numbers


def straight(*starts_m, heading=0.0, aside_m=0.0):
    return [lane_quads(EAST + x, NORTH + aside_m, heading, count=20) for x in starts_m]


def chains_of(lanes):
    return sorted(lane.lanelets for lane in lanes)


@pytest.mark.parametrize(
    ("lanes", "chains"),
    [
        (straight(0, 10, 20), [(100, 101, 102)]),
        (straight(20, 0, 10), [(101, 102, 100)]),
        (straight(0, 10.2), [(100,), (101,)]),  # a gap
        (straight(0) + straight(20, heading=180.0), [(100,), (101,)]),  # head on
        (straight(0, 10, 10), [(100,), (101,), (102,)]),  # ways part
        (straight(0, 0, 10), [(100,), (101,), (102,)]),  # ways join
    ],
)
def test_chains(lanes, chains):
    assert chains_of(lanes_of(tiles_of(lanes))) == sorted(chains)


def test_a_ring_is_one_lane():
    corners = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)]
    ring = []
    for i, start in enumerate(corners):
        end = corners[(i + 1) % 4]
        ways = [np.array(start), np.array(end)]
        outward = [np.array(each) * 1.2 - 1.0 for each in (start, end)]
        quad = np.array([[outward[0], outward[1], ways[1], ways[0]]]) + (EAST, NORTH)
        ring.append(quad)
    assert chains_of(lanes_of(tiles_of(ring))) == [(100, 101, 102, 103)]


@pytest.mark.parametrize(
    ("share", "error", "top"),
    [
        ([0.8, 0.85, 0.3], [0.1, 0.55, 0.0], 0),
        ([0.8, 0.85, 0.3], [np.nan, np.nan, np.nan], 1),
        ([np.nan, 0.2, 0.1], [np.nan, 0.2, 0.0], 2),
    ],
)
def test_the_busiest_spot_is_not_the_one_of_which_least_is_known(share, error, top):
    assert surest(np.array(share), np.array(error)) == top


@pytest.mark.parametrize(("places", "low"), [([5.0, 95.0], -13.0), ([5.0], 0.0), ([50.0], 0.0)])
def test_a_map_with_road_in_both_lower_corners_has_room_for_the_scale_below(places, low):
    road = np.array([[(x, 4.0), (x, 90.0), (x + 1.0, 90.0), (x + 1.0, 4.0)] for x in places])
    found = with_room_for_scale((np.zeros(2), np.full(2, 100.0)), road)
    np.testing.assert_allclose(found, [(0.0, low), (100.0, 100.0)])


def test_names_of_lanes_are_whole_in_the_chart(tmp_path):
    tiles = lane_tiles(14).assign(lane=lambda t: np.where(t["lanelet_id"] == 7, 2**63 - 1, 90))
    heat = make_heatmap(both_of(tiles, steps=400)[0], interval="5s")
    sums, charts = sums_of(heat, each=True), []
    begin, end = heat.timeline.span(0)[0], heat.timeline.span(-1)[1]
    clock = Clock(zone=ZoneInfo("UTC"), first=begin, last=end)
    for street in ("", "Heinrich-von-Stephan", "Wilhelm WWWWWWWWWWW"):
        table = lane_table(heat, sums).assign(street=street, east_m=-1.0, north_m=1.0)
        charts += chart.draw_lanes_over_time(heat, sums, table, clock)
    assert len(charts) == 3
    words = letters_of(pages_of(tmp_path, content_of(parts=charts)))
    for strip in [each for drawn in charts for each in drawn.strips]:
        assert "".join(strip.name.split()) in words


def test_the_error_of_a_lane_is_the_mean_of_its_tiles(tmp_path):
    """Weighted by visible time; that of the busiest interval too, and both are in the table."""
    tiles = lane_tiles(14)
    heat = make_heatmap(both_of(tiles, steps=400)[0], interval="5s")
    table = lane_table(heat, sums_of(heat, each=True))
    begins = [begin for begin, _ in heat.timeline.spans()]
    for _, row in table.iterrows():
        mine = tiles["lanelet_id"].isin(row["lanelets"]).to_numpy()
        interval = begins.index(row["busiest_begin"])
        for which, name in ((None, "share_se"), (interval, "busiest_share_se")):
            known = heat.occupancy_shares(which)
            seen = mine & (known.visible_s > 0)
            mean = np.average(known.occupancy_se[seen], weights=known.visible_s[seen])
            assert row[name] == pytest.approx(mean, rel=1e-6)
    clock = Clock(zone=ZoneInfo("UTC"), first=begins[0], last=begins[-1])
    write_lanes(tmp_path / "lanes.csv", table, clock, heat.measure)
    read = pd.read_csv(tmp_path / "lanes.csv")
    np.testing.assert_allclose(read["occupancy_se"], table["share_se"], atol=1e-6)
    np.testing.assert_allclose(read["busiest_occupancy_se"], table["busiest_share_se"], atol=1e-6)


@given(st.integers(1, 30), st.integers(0, 2**31))
@example(22, 1)  # square to the lanes there is no room
@settings(max_examples=25)
def test_no_number_of_the_plan_is_missing_and_none_covers_another(lanes, seed):
    """Side by side at 3.5 m, as on a wide road, with numbers of six figures."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, np.pi)
    along = np.column_stack([np.cos(heading), np.sin(heading)])[0]
    across = np.array([-along[1], along[0]])
    ways = {
        100_000 + i: (np.arange(0, 60.0)[:, None] - 30.0) * along + (i - lanes / 2) * 3.5 * across
        for i in range(lanes)
    }
    placed = place_numbers(ways, 300.0 / (6 * 72), shapely.box(-150, -150, 150, 150))
    assert set(placed) == set(ways)
    boxes = [each.box for each in placed.values()]
    overlaps = sum(a.intersection(b).area for a, b in combinations(boxes, 2))
    assert overlaps == pytest.approx(0.0, abs=1e-6)
