"""The bench of vehicles: the truth and its scores, on cases done by hand."""

import sys
from pathlib import Path
from types import FunctionType, SimpleNamespace

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
import shapely.affinity
from pyproj import CRS

import gis_radar as gr

sys.path.append(str(Path(__file__).parents[1] / "bench" / "vehicles"))

from ablated import PARTS
from passages import lanes_of, score_passages, true_passages
from score import agreement, score_by_tiles, score_occupancy
from tracks import Scored, score_tracks, similarity
from true_occupancy import (
    Sensor,
    TrueOccupancy,
    frames_valid,
    hidden_too_long,
    occupied_steps,
    true_occupancy,
)
from true_traffic import strip, traffic_of

START = 1_780_300_800.0
FIRST = 35_606_016_000


def lane(count=20, width=3.0, south=0.0):
    """Tiles of half a metre to the east from 0, 0."""
    west = np.arange(count) / 2.0
    boxes = [
        shapely.Polygon(
            [(w, south), (w + 0.5, south), (w + 0.5, south + width), (w, south + width)]
        )
        for w in west
    ]
    return gpd.GeoDataFrame(
        {"tile_id": np.arange(count), "lanelet_id": 1, "height_m": 100.0}, geometry=boxes, crs=25832
    )


def drive(*rows, kind="car", length=4.0, width=1.8, **more):
    """A table of one vehicle: (seconds, middle east, middle north)."""
    t, east, north = np.array(rows, dtype=float).T
    columns = {
        "t": START + t, "id": 7, "easting": east, "northing": north, "height": 100.0,
        "heading": 0.0, "speed": 0.0, "length": length, "width": width, "vehicle_height": 1.5,
        "kind": kind, "part": 0, "whole_length": length,
    }  # fmt: skip
    return pd.DataFrame(columns | more)


def occupied_by(table, tiles=None, count=3):
    tiles = lane() if tiles is None else tiles
    return occupied_steps(tiles, traffic_of(table), FIRST, count)


def test_tiles_whose_middle_line_is_under_the_footprint_are_occupied():
    occupied = occupied_by(drive((0.0, 4.0, 1.5), (0.05, 4.5, 1.5)))
    # from 2.0 to 6.0: middle lines at 2.25 to 5.75; then half a metre on
    assert np.flatnonzero(occupied[:, 0]).tolist() == list(range(4, 12))
    assert np.flatnonzero(occupied[:, 1]).tolist() == list(range(5, 13))
    assert not occupied[:, 2].any()


@pytest.mark.parametrize(
    ("north", "covers"), [(3.4, True), (3.42, False), (-0.4, True), (-0.42, False)]
)
def test_half_a_metre_of_overlap_covers(north, covers):
    assert occupied_by(drive((0.0, 4.0, north)))[5, 0] == covers


def test_half_of_a_narrow_vehicle_or_lane_covers():
    motorcycle = drive((0.0, 4.0, 3.0), width=0.8)
    assert occupied_by(motorcycle)[5, 0]
    assert not occupied_by(motorcycle.assign(northing=3.02))[5, 0]
    path = lane(width=0.6)
    assert occupied_by(drive((0.0, 4.0, 1.2)), path)[5, 0]
    assert not occupied_by(drive((0.0, 4.0, 1.22)), path)[5, 0]


def test_a_bridge_and_the_road_below_are_two_levels():
    assert not occupied_by(drive((0.0, 4.0, 1.5), height=103.0)).any()
    unknown = lane().assign(height_m=np.nan)
    assert occupied_by(drive((0.0, 4.0, 1.5), height=103.0), unknown).any()


def test_walkers_and_cyclists_cover_nothing():
    assert not occupied_by(drive((0.0, 4.0, 1.5), kind="walker")).any()


def test_crossing_lanelets_are_occupied_together():
    both = pd.concat([lane(), lane(south=0.5)], ignore_index=True)
    occupied = occupied_by(drive((0.0, 4.0, 1.5)), both)
    assert occupied[5, 0]
    assert occupied[25, 0]


def test_a_vehicle_at_rest_covers_all_its_steps():
    occupied = occupied_by(drive(*((k * 0.05, 4.0, 1.5) for k in range(3))))
    assert occupied[4:12].all()
    assert occupied.sum() == 24


def test_a_long_vehicle_is_the_strip_behind_its_front():
    # the front drove 10 m to the east, then 8 m to the north; 14 m reach round the corner
    path = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 8.0]])
    shape = strip(path, 14.0, 2.0, heading=0.0)
    assert shape.contains(shapely.Point(5.0, 0.0))
    assert not shape.intersects(shapely.Point(3.5, 0.0))
    assert shape.contains(shapely.Point(10.0, 7.9))
    assert not shape.intersects(shapely.Point(10.0, 8.1))
    drawn_out = strip(path[:1], 14.0, 2.0, heading=0.0)
    assert drawn_out.bounds == pytest.approx((-14.0, -1.0, 0.0, 1.0))


def test_parts_of_a_vehicle_are_one():
    parts = drive((0.0, 9.0, 1.5), length=6.0, whole_length=16.0)
    trailer = parts.assign(easting=1.0, length=10.0, part=1)
    traffic = traffic_of(pd.concat([trailer, parts]))
    assert traffic.states[["length", "easting", "front_e"]].to_numpy().tolist() == [[16, 4, 12]]
    assert len(traffic.bodies) == 2


def test_frames_hold_until_the_next_one_and_no_longer_than_100_ms():
    times = START + np.array([0.0, 0.16, 0.5])
    # at 0.0 steps 0 and those that begin by 0.1; at 0.16 step 3 to 5; at 0.5 step 10 to 12
    assert np.flatnonzero(frames_valid(times, FIRST, 20)).tolist() == [0, 1, 2, 3, 4, 5, 10, 11, 12]
    regular = START + 0.0572 * np.arange(40)
    assert frames_valid(regular, FIRST, 40).all()


def test_what_is_hidden_for_more_than_ten_seconds_is_not_visible():
    blocked = np.zeros((1, 500), bool)
    blocked[0, 10:300] = True
    late = hidden_too_long(blocked)
    assert np.flatnonzero(late).tolist() == list(range(210, 300))


def test_a_lorry_hides_what_is_behind_it_but_not_where_it_stands():
    steps = 40
    lorry = drive(*((k * 0.05, 3.0, 1.5) for k in range(steps)), vehicle_height=4.0)
    pose = gr.Pose(
        sensor="R1", crs=CRS.from_epsg(25832), easting=-20.0, northing=1.5, height=102.0,
        yaw=0.0, pitch=0.0, roll=0.0, view=gr.View(max_range_m=100.0),
    )  # fmt: skip
    times = START + 0.05 * np.arange(steps)
    sensor = Sensor(pose=pose, in_sight=np.ones(20, bool), times=times)
    truth = true_occupancy(lane(), [sensor], traffic_of(lorry))
    assert np.flatnonzero(truth.occupied.all(axis=1)).tolist() == list(range(2, 10))
    assert np.flatnonzero(truth.blocked.all(axis=1)).tolist() == list(range(10, 20))
    assert truth.visible.all()  # for ten seconds
    table = truth.table()
    assert table["occupancy"].tolist() == [0.0] * 2 + [1.0] * 8 + [0.0] * 10
    assert table["visible_s"].tolist() == pytest.approx([2.0] * 20)


def made_truth():
    occupied = np.zeros((4, 100), bool)
    occupied[1, :50] = occupied[2, :100] = occupied[3, :10] = True
    visible = np.ones((4, 100), bool)
    visible[3] = False
    return TrueOccupancy(
        tile_id=np.array([3, 5, 8, 9]), first_step=0, occupied=occupied, visible=visible,
        blocked=~visible,
    )  # fmt: skip


def test_the_truth_itself_scores_full():
    score = score_occupancy(made_truth(), made_truth().table())
    assert (score.tiles, score.answered, score.beyond) == (3, 1.0, 0.0)
    assert score.rank == pytest.approx(1.0)
    assert (score.scale, score.mae_percent) == (1.0, 0.0)
    assert score.true_mean == pytest.approx(0.5)


def test_what_is_not_answered_and_what_lies_beyond_is_told():
    table = pd.DataFrame({"tile_id": [3, 5, 9, 77], "occupancy": [0.1, 0.0, 0.5, 0.5]})
    score = score_occupancy(made_truth(), table)
    assert score.answered == pytest.approx(2 / 3)
    assert score.beyond == 0.5
    assert score.mae_percent == pytest.approx(30.0)
    assert score.scale == pytest.approx(0.2)


def test_standard_errors_are_checked():
    table = made_truth().table().assign(occupancy_se=0.1)
    table["occupancy"] += [0.0, 0.15, 0.25, 0.0]
    score = score_occupancy(made_truth(), table)
    assert score.within_2_se == pytest.approx(2 / 3)


def test_groups_of_tiles_have_figures_of_their_own():
    truth = made_truth()
    tiles = lane(20).assign(tile_id=np.arange(20))
    pose = SimpleNamespace(position=np.array([-49.0, 1.5, 0.0]))
    table = truth.table()
    table.loc[0, "occupancy"] += 0.1  # tile 3, 50.75 m away; the others lie farther off
    groups = score_by_tiles(truth, table, tiles, [pose])
    assert groups["empty"]["mae_percent"] == pytest.approx(10.0)
    assert groups["standing"]["mae_percent"] == 0.0  # on tiles 5 and 8 for seconds on end
    assert groups["50-100 m"]["mae_percent"] == pytest.approx(10.0 / 3)
    assert np.isnan(groups["0-50 m"]["mae_percent"])


def test_nothing_to_compare_is_not_a_number():
    assert np.isnan(agreement(np.array([]), np.array([]))["rank"])
    assert np.isnan(agreement(np.zeros(3), np.arange(3.0))["rank"])


def states(*rows, length=4.0):
    """Rows of (vehicle, step, east), all due, headed to the east."""
    vehicle, step, east = np.array(rows, dtype=float).T
    table = pd.DataFrame(
        {
            "vehicle": vehicle.astype(int), "step": step.astype(int), "easting": east,
            "northing": 0.0, "heading": 0.0, "speed": 5.0, "length": length, "due": True,
        }
    )  # fmt: skip
    return table.sort_values("step", kind="stable", ignore_index=True)


def scored(true, given):
    return Scored(true=true, given=given)


def test_what_is_not_due_is_neither_missed_nor_false():
    true = states((1, 0, 0.0), (2, 0, 50.0)).assign(due=[True, False])
    given = states((9, 0, 0.0), (8, 0, 90.0)).assign(due=[False, False])
    figures = score_tracks(scored(true, given))
    assert figures["recall"] == 1.0
    assert np.isnan(figures["precision"])


def test_a_second_vehicle_on_a_true_one_is_doubled():
    true = states((1, 0, 0.0), (2, 0, 50.0))
    figures = score_tracks(scored(true, states((9, 0, 3.0), (8, 0, 6.0), (7, 0, 90.0))))
    assert (figures["recall"], figures["precision"]) == (0.5, pytest.approx(1 / 3))
    assert figures["doubled"] == pytest.approx(1 / 3)  # the one at 6 m, not that at 90 m


def test_similarity_is_the_overlap_along_the_lane():
    one, other = states((1, 0, 0.0)), states((1, 0, 2.0), (2, 0, -4.0), (3, 0, 0.0))
    other.loc[2, "northing"] = 1.6
    assert similarity(one, other)[0].tolist() == pytest.approx([1 / 3, 0.0, 0.0])


def test_a_vehicle_found_half_of_the_time_is_found():
    true = states(*((1, 10 * k, 0.0) for k in range(4)), *((2, 10 * k, 50.0) for k in range(4)))
    given = states((7, 0, 0.0), (7, 10, 0.0), (8, 0, 50.0))
    figures = score_tracks(scored(true, given))
    assert figures["found"] == 0.5
    assert figures["recall"] == pytest.approx(3 / 8)
    assert figures["precision"] == 1.0


def fork():
    """Lanelet 1 to the east, then 2 straight on and 3 that turns off to the left."""
    at = np.arange(20) / 2.0
    straight = lane(40)
    straight["lanelet_id"] = np.repeat([1, 2], 20)
    straight["index"] = np.tile(np.arange(20), 2)
    turned = lane(20)
    angle = at / 12.0
    turned["geometry"] = [
        shapely.affinity.translate(
            shapely.affinity.rotate(shape, np.degrees(a), origin=(w, 1.5)),
            10.0 + 12.0 * np.sin(a) - w, 12.0 * (1.0 - np.cos(a)),
        )
        for shape, a, w in zip(turned.geometry, angle, at, strict=True)
    ]  # fmt: skip
    turned["lanelet_id"], turned["index"] = 3, np.arange(20)
    tiles = pd.concat([straight, turned], ignore_index=True)
    tiles["tile_id"] = np.arange(len(tiles))
    after = gpd.GeoDataFrame({"lanelet_id": [1, 2, 3], "successors": [(2, 3), (), ()]})
    return tiles, SimpleNamespace(lanelets=after)


@pytest.mark.parametrize(("turns", "second"), [(False, 2), (True, 3)])
def test_a_passage_is_of_the_lanelet_that_is_followed(turns, second):
    tiles, roads = fork()
    t = np.arange(0.0, 2.0, 0.05)
    s = -4.0 + 12.0 * t  # of the front
    angle = np.where((s > 10.0) & turns, (s - 10.0) / 12.0, 0.0)
    east = np.where(angle > 0, 10.0 + 12.0 * np.sin(angle), s)
    north = 1.5 + 12.0 * (1.0 - np.cos(angle))
    table = drive(*zip(t, east, north, strict=True), length=0.2)
    table["heading"] = np.degrees(angle)
    truth = TrueOccupancy(
        tile_id=np.arange(60), first_step=FIRST, occupied=np.zeros((60, 40), bool),
        visible=np.ones((60, 40), bool), blocked=np.zeros((60, 40), bool),
    )  # fmt: skip
    passed = true_passages(lanes_of(tiles, roads), traffic_of(table), truth)
    assert passed["lanelet_id"].tolist() == [1, second]
    # the front is at 5 m after 0.75 s, at 15 m after 1.58 s
    assert passed["step"].to_numpy() - FIRST == pytest.approx([15, 32], abs=1)


def test_passages_pair_within_a_second():
    true = pd.DataFrame({"lanelet_id": [1, 1, 2], "step": [100, 200, 300]})
    given = pd.DataFrame({"lanelet_id": [1, 1, 3], "step": [119, 240, 300]})
    figures = score_passages(true, given)
    assert figures["passages_recall"] == pytest.approx(1 / 3)
    assert figures["passages_precision"] == pytest.approx(1 / 3)
    assert (figures["count_bias"], figures["count_error"]) == (0.0, pytest.approx(2 / 3))


@pytest.mark.parametrize("part", sorted(PARTS))
def test_a_part_is_off_in_each_module_that_imports_it(part):
    """Its own module may hold it still, for others to call."""
    patched = [each.__defaults__[0] for each in PARTS[part] if each.__defaults__]
    owners = {(owner.__name__, name) for owner, name, _ in patched}
    for owner, name, _ in patched:
        original = vars(owner)[name]
        if not isinstance(original, FunctionType):
            continue
        users = {
            (module.__name__, name) for module in list(sys.modules.values())
            if module.__name__.startswith("gis_radar.tracking")
            and vars(module).get(name) is original
        }  # fmt: skip
        assert users - owners <= {(original.__module__, name)}
