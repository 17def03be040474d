"""Where simulated drivers go: sideways in their lanes, and only where a way leads."""

import numpy as np
import pytest
import shapely

from simulation.demand import random_flows
from simulation.driving import EASED_M, LaneKeeping, eased
from simulation.network import Lane, RoadNetwork, Turn
from simulation.roadside import furnish
from simulation.terrain import Terrain

LEVEL = Terrain(origin=(0.0, 0.0))


def band(kind, name, line, **more):
    line = np.asarray(line, dtype=float)
    ahead = np.diff(line, axis=0)
    ahead = np.vstack([ahead, ahead[-1:]]) / np.hypot(*np.vstack([ahead, ahead[-1:]]).T)[:, None]
    left = 1.6 * np.column_stack([-ahead[:, 1], ahead[:, 0]])
    return kind(id=name, centre=line, left=line + left, right=line - left, speed_limit=13.9, **more)


def lane(edge, line):
    return band(Lane, f"{edge}_0", line, edge=edge, index=0)


def joined(source, target, line):
    ends = {"source": f"{source}_0", "target": f"{target}_0", "signal": "", "direction": "s"}
    return band(Turn, f":{source}{target}_0", line, **ends)


def network(lanes, turns=()):
    bands = [*lanes, *turns]
    return RoadNetwork(
        lanes={b.id: b for b in lanes},
        turns={b.id: b for b in turns},
        spans={b.id: (b.id, 0.0, 1.0) for b in bands},
        lengths={b.id: 50.0 for b in bands},
    )


@pytest.fixture
def two_roads():
    """A road from a over b to c, and another from d to e that never meets it."""
    return network(
        [
            lane("a", [(0, 0), (50, 0)]),
            lane("b", [(60, 0), (110, 0)]),
            lane("c", [(120, 0), (170, 0)]),
            lane("d", [(0, 90), (80, 90)]),
            lane("e", [(90, 90), (170, 90)]),
        ],
        [
            joined("a", "b", [(50, 0), (60, 0)]),
            joined("b", "c", [(110, 0), (120, 0)]),
            joined("d", "e", [(80, 90), (90, 90)]),
        ],
    )


def test_flows_go_only_where_a_way_leads(two_roads):
    flows = random_flows(two_roads, per_hour=900.0, rng=np.random.default_rng(0))
    assert {(f.source, f.sink) for f in flows} == {("a", "c"), ("d", "e")}
    assert sum(f.per_hour for f in flows) == pytest.approx(900.0)


def test_a_street_is_driven_alike_by_all_and_otherwise_than_the_next(two_roads):
    keeping = LaneKeeping(mean_m=0.5, street_m=0.2)
    roads = keeping.on(two_roads, seed=3)
    again = keeping.on(two_roads, seed=3)
    places = [roads.aside(f"{edge}_0") for edge in "abcde"]
    assert places == [again.aside(f"{edge}_0") for edge in "abcde"]
    assert len(set(places)) == 5
    assert np.mean(places) == pytest.approx(0.5, abs=0.3)
    assert roads.aside(":ab_0") == roads.aside("b_0")  # a turn is driven as what it leads to


def test_by_default_all_keep_to_the_middle(two_roads):
    roads = LaneKeeping().on(two_roads, seed=3)
    assert {roads.aside(f"{edge}_0") for edge in "abcde"} == {0.0}


def test_a_new_street_is_taken_up_slowly():
    driven = np.linspace(0.0, 200.0, 401)
    step = np.where(driven < 100.0, -0.2, 0.4)
    way = eased(step, driven)
    assert way[0] == pytest.approx(-0.2)
    assert way[-1] == pytest.approx(0.4)
    assert way[200] == pytest.approx(0.1, abs=0.02)  # half of it where the street begins
    steepest = 0.6 / (2.0 * EASED_M)
    assert np.abs(np.diff(way) / np.diff(driven)).max() == pytest.approx(steepest, rel=0.01)


def test_who_stands_does_not_drift_aside():
    driven = np.concatenate([np.linspace(0.0, 30.0, 61), np.full(100, 30.0)])
    way = eased(np.where(driven < 25.0, 0.0, 0.3), driven)
    assert np.ptp(way[60:]) == pytest.approx(0.0)


def test_what_roads_enclose_is_lined_inside_too():
    corners = np.array([(0.0, 0.0), (160.0, 0.0), (160.0, 120.0), (0.0, 120.0), (0.0, 0.0)])
    ring = shapely.segmentize(shapely.LineString(corners), 4.0)
    block = network([lane("ring", shapely.get_coordinates(ring))])
    made = furnish(block, LEVEL, rng=np.random.default_rng(1))
    inside = shapely.Polygon(corners).buffer(-3.0)
    assert any(inside.contains(shapely.Polygon(b.outline)) for b in made.buildings)
    assert any(inside.contains(shapely.Point(t.place)) for t in made.trees)
    assert any(not inside.intersects(shapely.Point(t.place)) for t in made.trees)
