"""Lanes of a map: numbers, turns, stop lines, and names from the map or a layer of streets."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from maps import SHARED, Listener, needs_shared_maps, write_osm

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.hdmap import chain_lanelets, lanes_of
from gis_radar.hdmap.streets import name_streets
from gis_radar.measures import LaneNetwork, lane_names


@pytest.fixture(scope="module")
def junction():
    return gr.read_map(gr.sample_folder() / "junction.osm", crs="EPSG:25832")


def by_the_rule(roads):
    """Chain lanelets by the contract's words alone, by the successors that share nodes."""
    after = dict(zip(roads.lanelets["lanelet_id"], roads.lanelets["successors"], strict=True))
    before = dict(zip(roads.lanelets["lanelet_id"], roads.lanelets["predecessors"], strict=True))
    lane_of = {ref: {ref} for ref in after}
    for ref, found in after.items():
        if len(found) == 1 and len(before[found[0]]) == 1:
            both = lane_of[ref] | lane_of[found[0]]
            for each in both:
                lane_of[each] = both
    return {ref: min(lane) for ref, lane in lane_of.items()}


@needs_shared_maps
@pytest.mark.parametrize("name", ["carla_Town03", "kashiwanoha"])
def test_the_number_of_a_lane_in_real_maps(name):
    numbered_by_the_rule(gr.read_map(SHARED / "maps" / f"{name}.osm"))


def numbered_by_the_rule(roads):
    lanes = roads.lanes()
    mine = {
        ref: lane
        for lane, refs in zip(lanes["lane"], lanes["lanelets"], strict=True)
        for ref in refs
    }
    assert mine == by_the_rule(roads)
    assert lanes["lane"].is_monotonic_increasing


def test_a_lane_leads_where_its_name_says(junction):
    """Behind its stop line, in the junction, a lane may already turn to another wind."""
    lanes = junction.lanes().set_index("lane", drop=False)
    stop_m = lanes["stop_line_m"].dropna().to_dict()
    network = LaneNetwork.of(gr.make_tiles(junction), stop_m)
    names = pd.Series(lane_names(lanes, network), network.lane)
    assert len(stop_m) > 5
    for lane in stop_m:
        assert names[lane].startswith(f"Road {lanes['direction'][lane]}bound, ")


def test_tiles_carry_the_number_and_the_same_lanes(junction):
    tiles = gr.make_tiles(junction)
    lanes = junction.lanes().set_index("lane")
    for lane in lanes_of(tiles):
        assert lane.lanelets == lanes.loc[lane.number, "lanelets"]
        assert tiles["length_m"].iloc[lane.rows].sum() == pytest.approx(
            lanes.loc[lane.number, "length_m"], rel=0.01
        )
    older = tiles.drop(columns="lane")
    assert [each.lanelets for each in lanes_of(older)] == [
        each.lanelets for each in lanes_of(tiles)
    ]


def test_a_lane_keeps_its_number_where_only_a_part_of_it_is_tiled(junction):
    subtypes = junction.lanelets["subtype"].mask(junction.lanelets["lanelet_id"].eq(83), "closed")
    part = gr.LaneletMap(
        **{**vars(junction), "lanelets": junction.lanelets.assign(subtype=subtypes)}
    )
    tiles = gr.make_tiles(part, subtypes=["road"])
    (lane,) = [each for each in lanes_of(tiles) if each.number == 83]
    assert lane.lanelets == (972, 143)


def test_rings_and_gaps():
    corners = np.array([[0, 0, 1, 1], [9, 0, 8, 1], [9, 9, 8, 8], [0, 9, 1, 8]], float)
    ring = chain_lanelets(np.array([5, 3, 8, 9]), corners, np.roll(corners, -1, axis=0))
    assert ring in ([(3, 8, 9, 5)], [(5, 3, 8, 9)])
    assert chain_lanelets(np.array([1, 2]), corners[:2], corners[2:]) == [(1,), (2,)]


def test_lanes_end_at_branches_and_merges_whose_ends_are_turned_against_each_other():
    """As converters of OpenDRIVE draw them: no shared nodes, bounds 0.28 m apart, middles equal."""
    ids = np.array([1, 2, 3, 4])  # 1 branches into 2 and 3, which merge into 4
    begin, end, cross = np.array([0.0, 10.0, 10.0, 30.0]), [10.0, 30.0, 30.0, 40.0], (0.28, 2.0)
    starts = np.column_stack([begin, np.full(4, 2.0), begin, np.full(4, -2.0)])
    ends = np.column_stack([end, np.full(4, 2.0), end, np.full(4, -2.0)])
    assert chain_lanelets(ids[[0, 1, 3]], starts[[0, 1, 3]], ends[[0, 1, 3]]) == [(1, 2, 4)]
    for corners in (starts, ends):
        corners[2] += [cross[0], 0.0, -cross[0], 0.0]
    assert chain_lanelets(ids, starts, ends) == [(1,), (2,), (3,), (4,)]


@needs_shared_maps
def test_a_converted_town_has_turns_at_its_junctions():
    """No lane runs on through junctions, past branches and merges."""
    roads = gr.read_map(SHARED / "town01" / "map.osm")
    assert roads.lanes()["length_m"].max() < 500.0  # along the ring; through junctions 1442


@needs_shared_maps
@pytest.mark.parametrize("name", ["carla_Town01", "carla_Town03", "kashiwanoha"])
def test_turns_by_geometry_are_those_that_mappers_tagged(name):
    roads = gr.read_map(SHARED / "maps" / f"{name}.osm")
    bare = roads.lanelets.assign(turn_direction=None)
    tagged = roads.lanes()["turn"]
    seen = gr.LaneletMap(**{**vars(roads), "lanelets": bare}).lanes()["turn"]
    both = tagged.notna() & seen.notna()
    assert both.sum() > 20
    assert (tagged[both] == seen[both]).mean() > 0.9


def test_the_sample_has_stop_lines_where_its_lights_are(junction):
    stops, lanes = junction.stop_lines(), junction.lanes().set_index("lane")
    named = {ref for refs in junction.regulatory["lanelet_ids"] for ref in refs}
    assert set(stops["lanelet_id"]) == named
    for _, stop in stops.iterrows():
        line = lanes.geometry[stop["lane"]]
        assert line.interpolate(stop["lane_m"]).distance(stop.geometry) < 0.1
        assert lanes.loc[stop["lane"], "stop_line_m"] == stop["lane_m"]


def test_a_stop_line_of_lanelets_that_were_left_out_ends_no_lane(junction):
    named = {ref for refs in junction.regulatory["lanelet_ids"] for ref in refs}
    left = junction.lanelets[~junction.lanelets["lanelet_id"].isin(named)].reset_index(drop=True)
    roads = gr.LaneletMap(**{**vars(junction), "lanelets": left})
    stops = roads.stop_lines()
    assert (len(stops), list(stops)) == (0, list(junction.stop_lines()))
    assert stops.crs == junction.crs
    assert roads.lanes()["stop_line_m"].isna().all()


def two_lanes(folder, apart_m=0.0, stop=None, **tags):
    """Two lanes of 20 m eastward, one beside or behind the other, neither following."""
    nodes, ways, lanelets = {}, {}, {}
    for k in range(2):
        for side in range(2):
            first = 10 * k + 2 * side + 1
            x, y = k * apart_m, 3.0 - 3.0 * side - 3.5 * k
            nodes |= {first: (x, y), first + 1: (x + 20.0, y)}
            ways[first] = [first, first + 1]
        lanelets[100 + k] = (10 * k + 1, 10 * k + 3, {"subtype": "road", **tags})
    if stop:
        nodes |= {50: stop[0], 51: stop[1]}
        ways[50] = ([50, 51], {"type": "stop_line"})
    write_osm(path := folder / "two.osm", nodes, ways, lanelets)
    return gr.read_map(path, crs="EPSG:25832")


def test_a_stop_line_that_nothing_names_ends_the_lane_before_it_only(tmp_path):
    roads = two_lanes(tmp_path, stop=((21.0, 2.8), (21.0, 0.2)))
    stops = roads.stop_lines()
    assert stops[["stop_line", "lane"]].to_numpy().tolist() == [[50, 100]]
    assert stops["lane_m"].to_numpy() == pytest.approx([20.0], abs=0.01)


def test_a_lane_with_a_stop_line_at_its_begin_leads_somewhere(tmp_path):
    lanes = two_lanes(tmp_path, stop=((0.0, 2.8), (0.0, 0.2))).lanes().set_index("lane")
    assert lanes.loc[100, "stop_line_m"] < 0.1
    assert lanes.loc[100, "direction"] == "east"


# Names of streets.


def streets_of(junction, **names):
    """Lay a street of each name along a lane."""
    lines = junction.lanes().set_index("lane").geometry
    ends = [lines[int(lane[1:])].coords for lane in names]
    shapes = [shapely.LineString([each[0], each[-1]]) for each in ends]
    return gpd.GeoDataFrame({"Name": list(names.values())}, geometry=shapes, crs=junction.crs)


def test_lanes_are_named_by_the_street_that_they_run_along(junction, tmp_path):
    streets = streets_of(junction, l83="Weststraße", l568="Südring").to_crs(4326)
    streets.to_file(path := tmp_path / "streets.gpkg")
    for given in (streets, path, streets.rename_geometry("geom")):
        lanes = junction.lanes(streets=given).set_index("lane")
        assert lanes.loc[[83, 160, 176, 111], "street"].tolist() == ["Weststraße"] * 4
        assert lanes.loc[[568, 553], "street"].tolist() == ["Südring"] * 2
        assert lanes.loc[[352, 382], "street"].isna().all()  # other arms have no street here


def test_the_name_in_the_map_comes_first(junction):
    tagged = junction.lanelets.assign(street="Am Markt")
    roads = gr.LaneletMap(**{**vars(junction), "lanelets": tagged})
    lanes = roads.lanes(streets=streets_of(junction, l83="Weststraße"))
    assert set(lanes["street"]) == {"Am Markt"}


def test_names_of_streets_are_one_line_that_xml_can_hold(junction):
    streets = streets_of(junction, l83="West\nstraße\u202e", l568="\ufffe")
    names = junction.lanes(streets=streets)["street"].dropna()
    assert set(names) == {"West straße\\u202e", "\\ufffe"}


def told(roads, **options):
    """Return the lanes and the warnings that they come with."""
    lanes = roads.lanes(reporter=(listener := Listener()), **options)
    return lanes, [message for level, message in listener.messages if level == "warning"]


def test_a_layer_without_names_is_told_in_one_sentence(junction):
    streets = streets_of(junction, l83="Weststraße").rename(columns={"Name": "width"})
    lanes, warned = told(junction, streets=streets)
    assert len(lanes) == 30
    assert lanes["street"].isna().all()
    assert len(warned) == 1
    assert "no column of names" in warned[0]
    with pytest.raises(gr.InputError, match="has no column 'nom'"):
        junction.lanes(streets=streets, street_field="nom")
    with pytest.raises(gr.CrsError, match="states no coordinate system"):
        junction.lanes(streets=streets.set_crs(None, allow_override=True))
    points = streets.set_geometry(streets.centroid)
    with pytest.raises(gr.InputError, match="streets are lines, the layer has Point"):
        junction.lanes(streets=points)


@pytest.mark.parametrize("name", [7, "", None])
def test_streets_whose_names_are_no_texts_are_told(junction, name):
    streets = streets_of(junction, l83="Weststraße").assign(Name=name)
    lanes, warned = told(junction, streets=streets)
    assert lanes["street"].isna().all()
    assert len(warned) == 1
    assert warned[0].startswith("streets: its column 'Name' holds no text beside a line")


def test_two_streets_of_one_name_are_told(tmp_path):
    """And so is that no lanelet follows another."""
    roads = two_lanes(tmp_path, apart_m=2000.0)
    streets = gpd.GeoDataFrame({"name": ["Ring", "Ring"]}, geometry=list(roads.lanelets["centre"]))
    lanes, warned = told(roads, streets=streets.set_crs(roads.crs))
    assert lanes["street"].tolist() == ["Ring", "Ring"]
    assert sorted(lanes["street_part"]) == ["east", "west"]
    assert lanes["turn"].isna().all()
    assert warned == [
        "no lanelet of the map follows another: each is a lane of its own, without turns",
        "streets: 2 streets are called Ring; their lanes differ by number",
    ]


def test_three_streets_in_a_row_are_told_apart_by_numbers():
    lines = [shapely.LineString([(x, 0), (x + 50, 0)]) for x in (0, 1000, 2000, 5000)]
    names = ["Ring", "Ring", "Ring", None]
    lanes = gpd.GeoDataFrame({"street": names}, geometry=lines, crs=25832)
    named = name_streets(lanes, None, None, QUIET)
    assert named["street_part"].tolist()[:3] == ["1", "2", "3"]
    assert named["street_part"].isna().tolist() == [False, False, False, True]
