"""Curves: directions along lanes whose bends are drawn as chords, beside those of the true bend."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from gis_radar.hdmap.curves import lane_headings

HALF_M = 1.75


def arc(radius_m, turn, count):
    """Return the chords of both bounds of a lane that turns left about (0, radius)."""
    angle = np.linspace(0.0, turn, count + 1)
    way = np.column_stack([np.sin(angle), -np.cos(angle)])
    return tuple(
        shapely.LineString([0.0, radius_m] + (radius_m + side) * way) for side in (-HALF_M, HALF_M)
    )


def straight(length_m):
    """Return the bounds of a lane along the x axis that ends at (0, 0)."""
    ends = np.array([[-length_m, 0.0], [0.0, 0.0]])
    return tuple(shapely.LineString(ends + [0.0, side]) for side in (HALF_M, -HALF_M))


@given(st.floats(8.0, 60.0), st.integers(3, 40))
def test_directions_within_a_bend_are_those_of_the_arc(radius_m, count):
    turn = np.pi / 2.0
    # what a chord turns by: as drawn, or where corners are less than 5 cm off a longer one
    chord = max(turn / count, 2.0 * np.sqrt(8.0 * 0.05 / radius_m))
    share = np.linspace(chord / turn, 1.0 - chord / turn, 50)
    if share[0] < share[-1]:
        found = lane_headings([arc(radius_m, turn, count)], [share], [[]])[0]
        assert found == pytest.approx(share * turn, abs=0.3 * chord)  # half of it at a corner


def test_a_bend_begins_where_the_lane_before_ends():
    """Half of the corner's turn lies before it, half after: none jumps."""
    turn, count = np.pi / 2.0, 4
    lanes = [straight(30.0), arc(13.0, turn, count)]
    shares = [np.linspace(0.0, 1.0, 31), np.linspace(0.0, 1.0, 21)]
    before, bend = lane_headings(lanes, shares, [[1], []])
    corner = turn / count / 2.0
    assert before[:26] == pytest.approx(0.0, abs=1e-6)
    assert before[-1] == pytest.approx(bend[0], abs=1e-6)
    assert 0.3 * corner < bend[0] < 0.7 * corner
    alone = lane_headings(lanes, shares, [[], []])
    assert alone[1][0] == pytest.approx(corner)


def test_a_corner_between_lanes_stays_one():
    across = tuple(shapely.LineString([[x, 0.0], [x, 30.0]]) for x in (-HALF_M, HALF_M))
    found = lane_headings([straight(30.0), across], [np.array([1.0]), np.array([0.0])], [[1], []])
    assert [float(each[0]) for each in found] == pytest.approx([0.0, np.pi / 2.0])


def test_of_several_lanes_the_straightest_is_what_goes_on():
    away = tuple(
        shapely.LineString([[0.0, side], [30.0, side + 10.0]]) for side in (HALF_M, -HALF_M)
    )
    ahead = tuple(shapely.LineString([[0.0, side], [30.0, side]]) for side in (HALF_M, -HALF_M))
    share = np.array([1.0])
    found = lane_headings([straight(30.0), away, ahead], [share] * 3, [[1, 2], [], []])
    assert found[0] == pytest.approx([0.0], abs=1e-9)


@given(st.integers(0, 100))
def test_bounds_drawn_by_hand_in_short_steps_do_not_shake_the_direction(seed):
    rng, x = np.random.default_rng(seed), np.arange(0.0, 30.0, 0.25)
    lane = tuple(
        shapely.LineString(np.column_stack([x, side + rng.uniform(-0.02, 0.02, len(x))]))
        for side in (HALF_M, -HALF_M)
    )
    found = lane_headings([lane], [np.linspace(0.0, 1.0, 31)], [[]])[0]
    assert np.abs(found).max() < np.radians(0.5)


def test_a_bound_without_length_leaves_the_direction_to_the_other():
    """The inner bound of a sharp turn may be one point."""
    point = shapely.LineString([[0.0, 0.0], [0.0, 0.0]])
    outer = arc(5.0, np.pi / 2.0, 8)[1]
    found = lane_headings([(point, outer)], [np.array([0.25, 0.5, 0.75])], [[0]])[0]
    assert found == pytest.approx(np.array([0.25, 0.5, 0.75]) * np.pi / 2.0, abs=0.05)
    none = lane_headings([(point, point)], [np.array([0.5])], [[]])[0]
    assert np.isfinite(none).all()
