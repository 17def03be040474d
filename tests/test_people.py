"""Walkers and cyclists: where they go, whom they heed, and what a radar sees of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from test_as_recorded import LEVEL, MODEL, MOVES_MPS, driven, pose, record
from test_drivers import PACE_M, streets

from gis_radar.base import STEP_S
from simulation.movement import Traffic
from simulation.people import People, simulate_people
from simulation.scene import Scene, road_surface

STEPS = 1201


@pytest.fixture(scope="module")
def network():
    return streets(3)


@pytest.fixture(scope="module")
def road(network):
    return road_surface(network)


@pytest.fixture(scope="module")
def traffic(network) -> Traffic:
    """Cars every 100 m on all streets, at 50 km/h, for a minute."""
    s = 100.0 * np.arange(12) - 1000.0 + PACE_M * np.arange(STEPS)[:, None]
    lanes = [lane for lane in network.lanes.values() if lane.edge.startswith("s")]
    east = np.tile(s, (1, len(lanes)))
    north = np.repeat([lane.centre[0, 1] for lane in lanes], 12) + np.zeros_like(east)
    gone = (east < 0.0) | (east > 120.0)
    made = driven(np.stack([east, north], axis=-1), 14.0, kind="car", size=(4.5, 1.8, 1.5))
    centre = np.where(gone[..., None], np.nan, np.stack([east, north], axis=-1))
    return replace(made, centre=centre, speed=np.where(gone, np.nan, 14.0))


@pytest.fixture(scope="module")
def people(network, road, traffic) -> Traffic:
    wanted = People(walkers=30, cyclists=18, crossing=0.4)
    return simulate_people(network, road, traffic, wanted, seed=2)


def of(people: Traffic, kind: str) -> Traffic:
    rows = np.array(people.kind) == kind
    return replace(
        people, centre=people.centre[:, rows], speed=people.speed[:, rows],
        heading=people.heading[:, rows], yaw_rate=people.yaw_rate[:, rows], size=people.size[rows],
        kind=(kind,) * int(rows.sum()),
    )  # fmt: skip


def test_48_are_there_at_once_and_always(people):
    now = np.isfinite(people.speed)
    kind = np.array(people.kind)
    assert (now[:, kind == "walker"].sum(axis=1) == 30).all()
    assert (now[:, kind == "cyclist"].sum(axis=1) >= 17).all()
    assert now.sum(axis=1).max() >= 48


def test_the_same_seed_gives_the_same_people(network, road, traffic):
    few = People(walkers=4, cyclists=2, crossing=0.4)
    one, again, other = (simulate_people(network, road, traffic, few, seed=k) for k in (2, 2, 3))
    assert np.array_equal(one.centre, again.centre, equal_nan=True)
    assert not np.array_equal(one.centre[:, :4], other.centre[:, :4], equal_nan=True)


def test_nobody_jumps_and_all_keep_their_pace(people):
    for kind, most in (("walker", 2.0), ("cyclist", 7.5)):
        moved = np.hypot(*np.moveaxis(np.diff(of(people, kind).centre, axis=0), -1, 0))
        assert np.nanmax(moved) < most * STEP_S * 1.6
        assert 0.5 * most < np.nanmedian(moved[moved > 0.02]) / STEP_S < most


def test_walkers_go_beside_the_road_and_now_and_then_across(people, road):
    walkers = of(people, "walker").centre
    on = shapely.contains_xy(road, walkers[..., 0], walkers[..., 1])
    assert 0.01 < on.mean() < 0.2
    assert 0.1 < on.any(axis=0).mean() < 0.6
    beside = shapely.distance(road, shapely.points(walkers[:, ~on.any(axis=0)]))
    assert beside.max() < 2.0
    assert np.quantile(beside, 0.1) > 1.5


def test_no_car_drives_into_a_walker(people, traffic):
    walkers = of(people, "walker").centre
    gap = np.abs(walkers[:, :, None] - traffic.centre[:, None])
    hit = (gap[..., 0] < 2.25) & (gap[..., 1] < 0.9)
    hit &= walkers[:, :, None, 0] < 115.0  # there the streets end, but not the cars
    assert not hit.any()


def test_cyclists_ride_at_the_edge_of_lanes_and_behind_it(people, road):
    riders = of(people, "cyclist").centre
    there = riders[np.isfinite(riders[..., 0])]
    inside = shapely.contains_xy(road, there[:, 0], there[:, 1])
    assert 0.3 < inside.mean() < 0.9
    assert shapely.distance(shapely.boundary(road), shapely.points(there)).max() < 4.0


def test_people_have_their_own_class_in_the_truth(traffic, people):
    table = traffic.joined(people).table(LEVEL)
    assert set(table["kind"]) == {"car", "walker", "cyclist"}
    walkers = table[table["kind"] == "walker"]
    assert walkers["id"].nunique() == 30
    assert set(walkers["width"]) == {0.5}
    assert len(walkers) == 30 * STEPS


@pytest.fixture(scope="module")
def seen_walkers():
    """Eight walkers 10 to 24 m before the radar, for 9 s."""
    begin = np.column_stack([np.linspace(10.0, 24.0, 8), np.linspace(-9.0, 12.0, 8)])
    places = begin + 1.35 * STEP_S * np.arange(190)[:, None, None] * [1.0, 0.0]
    there = driven(places, 1.35, kind="walker", size=(0.4, 0.5, 1.75))
    bare = Scene(terrain=LEVEL, road=shapely.box(0, 0, 1, 1))
    return *record(MODEL, pose(over_m=4.0, pitch=5.0), bare, there, 9.0), there


def test_a_walker_near_by_gives_four_or_five_returns_a_frame(seen_walkers):
    table, frames, there = seen_walkers
    stand = pose(over_m=4.0, pitch=5.0)
    on = []
    for time, rows in table.groupby("time"):
        place = stand.to_map(rows[["x", "y", "z"]].to_numpy(np.float64))[:, :2]
        off = place[:, None] - there.at(float(time)).centre
        on.append((np.hypot(*np.moveaxis(off, -1, 0)) < 1.0).any(axis=1))
    count = np.concatenate(on)
    assert 3.5 < count.sum() / frames / 8 < 5.5
    rates = table.loc[count, "range_rate"]
    assert 0.5 < (rates.abs() > MOVES_MPS).mean() <= 1.0
    assert 2.0 < rates.quantile(0.995) < 4.5  # a leg that swings forward
    assert rates.median() == pytest.approx(1.2, abs=0.4)
