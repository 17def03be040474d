"""Grids of square cells: half-open, on multiples of their side, numbered along the rows."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from gis_radar.base import Grid

PLACES = st.lists(st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)), min_size=1, max_size=9)


@example([(0.0, -5e-324)], 16.0)
@given(PLACES, st.sampled_from([0.5, 1.0, 16.0]))
def test_every_point_is_in_its_cell(places, side):
    x, y = np.array(places).T
    grid = Grid.around(x, y, side)
    corners = grid.corners(grid.keys(x, y))
    assert (corners <= np.array(places)).all()
    assert (np.array(places) < corners + side).all()
    assert grid.holds(*grid.cells(x, y)).all()
    np.testing.assert_array_equal(grid.centres(grid.keys(x, y)), corners + side / 2.0)
    np.testing.assert_array_equal(np.mod(corners, side), 0.0)
    np.testing.assert_allclose(grid.transform @ grid.cells(x, y), corners.T)


def test_an_edge_belongs_to_the_north_and_east():
    grid = Grid.around(np.array([0.0, 1.0]), np.array([0.0, 0.5]), 0.5)
    assert (grid.columns, grid.rows) == (3, 2)
    assert grid.keys(np.array([0.0, 0.5, 0.25, 1.0]), np.array([0.0, 0.0, 0.5, 0.5])).tolist() == [
        0, 1, 3, 5
    ]  # fmt: skip


def test_points_outside():
    grid = Grid(cell_m=0.5, west=-2, south=-2, columns=4, rows=4)
    x, y = np.array([-1.1, 0.0, 5.0]), np.array([0.0, 0.99, -9.0])
    assert grid.holds(*grid.cells(x, y)).tolist() == [False, True, False]
    assert np.column_stack(grid.nearest(x, y)).tolist() == [[0, 2], [2, 3], [3, 0]]
    assert grid.bounds == (-1.0, -1.0, 1.0, 1.0)
