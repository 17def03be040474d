import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from sites import EAST, NORTH, lane_quads

from bench.tile_oracles import TileGridNumpy, TileTree
from gis_radar.hdmap import TileGrid, polygons

ENGINES = [TileGrid, TileGridNumpy, TileTree]


def random_site(rng, lanes=12):
    return np.concatenate(
        [
            lane_quads(
                EAST + rng.uniform(0, 60), NORTH + rng.uniform(0, 60), rng.uniform(0, 360),
                count=int(rng.integers(1, 40)), length_m=rng.uniform(0.3, 0.7),
            )
            for _ in range(lanes)
        ]
    )  # fmt: skip


def oracle(quads, points):
    tree = shapely.STRtree(polygons(quads))
    point, tile = tree.query(shapely.points(points), predicate="intersects")
    order = np.lexsort((tile, point))
    return point[order], tile[order]


@pytest.mark.parametrize("engine", ENGINES)
def test_random_points_fall_where_shapely_says(engine):
    rng = np.random.default_rng(3)
    quads = random_site(rng)
    points = rng.uniform([EAST - 20, NORTH - 20], [EAST + 80, NORTH + 80], (20_000, 2))
    point, tile = engine(quads).assign(*points.T)
    expected_point, expected_tile = oracle(quads, points)
    assert len(point) > 500
    np.testing.assert_array_equal(point, expected_point)
    np.testing.assert_array_equal(tile, expected_tile)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    heading=st.sampled_from([0.0, 45.0, 90.0, 180.0, 270.0, 33.3]),
)
def test_a_point_on_a_shared_edge_has_one_tile(seed, heading):
    rng = np.random.default_rng(seed)
    quads = lane_quads(EAST, NORTH, heading, count=20)
    share = rng.uniform(0.02, 0.98, (19, 1))
    on_edges = quads[:-1, 1] * share + quads[:-1, 2] * (1 - share)
    corners_inside = (quads[:-1, 1] + quads[:-1, 2]) / 2
    points = np.concatenate([on_edges, corners_inside])
    for engine in ENGINES:
        point, _ = engine(quads).assign(*points.T)
        np.testing.assert_array_equal(point, np.arange(len(points)))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_engines_agree_to_the_last_bit(seed):
    rng = np.random.default_rng(seed)
    quads = random_site(rng, lanes=4)
    corners = quads.reshape(-1, 2)
    middles = (quads + np.roll(quads, 1, axis=1)).reshape(-1, 2) / 2
    scattered = rng.uniform(corners.min(0) - 1, corners.max(0) + 1, (500, 2))
    points = np.concatenate([corners, middles, scattered])
    answers = [engine(quads).assign(*points.T) for engine in ENGINES]
    for other in answers[1:]:
        np.testing.assert_array_equal(answers[0], other)


@pytest.mark.parametrize("engine", ENGINES)
def test_concave_tile_and_points_without_place(engine):
    dart = np.array([[[0, 0], [4, 0], [1, 1], [0, 4]]], dtype=float) + np.array([EAST, NORTH])
    x = np.array([0.5, 1.5, np.nan, np.inf, 1e300, -5.0]) + EAST
    y = np.array([0.5, 1.5, 0.5, 0.5, 0.5, 0.5]) + NORTH
    point, tile = engine(dart).assign(x, y)
    assert point.tolist() == [0]
    assert tile.tolist() == [0]


@pytest.mark.parametrize("engine", ENGINES)
def test_no_tiles_and_no_points(engine):
    nothing = np.empty(0)
    assert len(engine(np.empty((0, 4, 2))).assign(np.ones(3), np.ones(3))[0]) == 0
    assert len(engine(lane_quads(0, 0, 0)).assign(nothing, nothing)[0]) == 0
