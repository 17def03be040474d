"""Bounds: driving direction, rungs, and mending, on shapes that hypothesis thinks of."""

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from shapely import LineString, Polygon

from gis_radar.hdmap import (
    CannotMendError,
    at_fractions,
    bound_length,
    outline,
    rungs,
    slices,
    sound,
    sound_rungs,
)
from gis_radar.hdmap.bounds import drawn_direction, ribbon_between
from gis_radar.hdmap.mending import is_sound, mend, without_first_loop, without_loops

SHIFT = np.array([678_123.25, 5_403_456.5])


@st.composite
def lanes(draw, most_turn=1.2):
    """The bounds of a lane that bends as lanes do: the inner one never comes to a point."""
    steps = draw(st.integers(3, 25))
    width = draw(st.floats(1.5, 6.0))
    # Turning by more than this over a step would fold the inner bound.
    step = st.floats(0.7, 8.0)
    lengths = np.array(draw(st.lists(step, min_size=steps, max_size=steps)))
    bends = np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=steps, max_size=steps)))
    most = np.minimum(most_turn, lengths / width)
    heading = np.cumsum(bends * most * 0.8) + draw(st.floats(0.0, 6.28))
    assume(np.ptp(heading) < 2.5)
    along = np.column_stack([np.cos(heading), np.sin(heading)])
    centre = np.concatenate([[[0.0, 0.0]], np.cumsum(lengths[:, None] * along, axis=0)])
    at_points = np.concatenate([heading[:1], (heading[1:] + heading[:-1]) / 2.0, heading[-1:]])
    across = np.column_stack([-np.sin(at_points), np.cos(at_points)]) * width / 2.0
    return centre + across, centre - across


@st.composite
def scribbles(draw):
    """Two lines of random points: often no lanelet at all."""
    number = st.floats(-10.0, 10.0).map(lambda value: round(value, 2))
    point = st.tuples(number, number)
    line = st.lists(point, min_size=2, max_size=7, unique=True).map(np.array)
    return draw(line), draw(line)


def driven(left, right):
    turn_left, turn_right = drawn_direction(left, right)
    left = left[::-1] if turn_left else left
    return left, right[::-1] if turn_right else right


def quads(left_points, right_points):
    corners = [right_points[:-1], right_points[1:], left_points[1:], left_points[:-1]]
    return shapely.polygons(np.stack([corner[:, :2] for corner in corners], axis=1))


def uncovered(left, right, n):
    """Area where slices and outline differ, as a share of the outline."""
    shape = outline(left, right)
    union = shapely.union_all(quads(*rungs(left, right, n)))
    return union.symmetric_difference(shape).area / shape.area


@given(lanes(), st.booleans(), st.booleans())
def test_the_driving_direction_does_not_depend_on_how_bounds_are_drawn(lane, flip_left, flip_right):
    left, right = lane
    drawn = left[::-1] if flip_left else left, right[::-1] if flip_right else right
    for found, expected in zip(driven(*drawn), lane, strict=True):
        np.testing.assert_array_equal(found, expected)


@given(lanes())
def test_mirrored_lanes_are_driven_the_same_way(lane):
    mirror = np.array([-1.0, 1.0])
    left, right = driven(lane[1] * mirror, lane[0] * mirror)
    np.testing.assert_array_equal(left, lane[1] * mirror)
    np.testing.assert_array_equal(right, lane[0] * mirror)


@pytest.mark.parametrize("flip", [False, True])
def test_a_ring_road_is_driven_with_its_left_bound_inside_counter_clockwise(flip):
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    inner, outer = 10.0 * circle, 14.0 * circle
    left, right = driven(inner, outer[::-1] if flip else outer)
    np.testing.assert_array_equal(left, inner)
    np.testing.assert_array_equal(right, outer)
    assert mend(left, right).repairs == ()
    assert outline(left, right).area == pytest.approx(np.pi * (14**2 - 10**2), rel=0.01)
    assert uncovered(left, right, slices(left, right)) < 0.005


def test_tiny_and_short_wide_lanelets_have_a_direction():
    left, right = np.array([[0.0, 8.0], [0.02, 8.0]]), np.array([[0.01, 0.0], [0.03, 0.0]])
    for a in (left, left[::-1]):
        for b in (right, right[::-1]):
            found = driven(a, b)
            np.testing.assert_array_equal(found[0], left)
            np.testing.assert_array_equal(found[1], right)


@given(lanes())
def test_lanes_that_need_nothing_are_left_alone(lane):
    assume(outline(*lane).is_valid)
    assume(sound(*rungs(*lane, slices(*lane))).all())
    assume(not len(ribbon_between(*lane).left_wrong) and not len(ribbon_between(*lane).right_wrong))
    mended = mend(*lane)
    assert mended.repairs == ()
    np.testing.assert_array_equal(mended.left, lane[0])
    np.testing.assert_array_equal(mended.right, lane[1])


@given(lanes())
def test_slices_are_simple_share_their_edges_and_cover_the_outline(lane):
    try:
        mended = mend(*lane)
    except CannotMendError:
        assume(False)
    left, right = mended.left, mended.right
    n = slices(left, right)
    left_points, right_points = rungs(left, right, n)
    assert left_points.shape == right_points.shape == (n + 1, 2)
    np.testing.assert_array_equal(left_points[[0, -1]], left[[0, -1]])
    np.testing.assert_array_equal(right_points[[0, -1]], right[[0, -1]])
    shapes = quads(left_points, right_points)
    assert shapely.is_valid(shapes).all()
    assert all(len(set(shape.exterior.coords)) == 4 for shape in shapes)
    assert all(shape.exterior.is_ccw for shape in shapes)
    assert shapely.area(shapes).sum() == pytest.approx(shapely.union_all(shapes).area, rel=1e-6)
    if n > 8:
        assert uncovered(left, right, n) < 0.005


@given(lanes())
def test_mending_does_not_depend_on_where_the_map_lies(lane):
    here, there = outcome(*lane), outcome(lane[0] + SHIFT, lane[1] + SHIFT)
    assert here[0] == there[0]
    for a, b in zip(here[1:], there[1:], strict=True):
        np.testing.assert_allclose(a + SHIFT, b, atol=1e-6)


def outcome(left, right):
    try:
        mended = mend(left, right)
    except CannotMendError as error:
        return (str(error),)
    return mended.repairs, mended.left, mended.right


@given(scribbles())
def test_whatever_comes_is_either_sound_afterwards_or_refused_with_a_reason(lines):
    left, right = driven(*lines)
    result = outcome(left, right)
    if len(result) == 1:
        assert result[0]
        return
    _, left, right = result
    assert is_sound(left, right)
    assert outline(left, right).is_valid
    assert LineString(left).is_simple
    assert LineString(right).is_simple
    assert shapely.is_valid(quads(*rungs(left, right, slices(left, right)))).all()
    assert np.hypot(*(left[[0, -1]] - right[[0, -1]]).T).min() > 0.009


def test_plain_lanes_are_divided_by_equal_lengths():
    angle = np.linspace(0.0, 1.5, 60)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    left, right = 20.0 * circle, 23.5 * circle
    fractions = np.linspace(0.0, 1.0, 51)
    for points, bound in zip(rungs(left, right, 50), (left, right), strict=True):
        np.testing.assert_array_equal(points, at_fractions(bound, fractions))


def test_a_bay_is_divided_by_rungs_that_do_not_cross():
    left = np.array([[0.0, 3.0], [20.0, 3.0], [20.0, 9.0], [32.0, 9.0], [32.0, 3.0], [60.0, 3.0]])
    right = np.array([[0.0, 0.0], [60.0, 0.0]])
    n = slices(left, right)
    even = np.linspace(0.0, 1.0, n + 1)
    assert sound(*rungs(left, right, n)).all()
    assert uncovered(left, right, n) < 0.005
    assert mend(left, right).repairs == ()
    assert bound_length(left) > bound_length(right)
    assert len(even) == n + 1


def test_heights_are_carried_along():
    left = np.array([[0.0, 3.0, 10.0], [10.0, 3.0, 20.0]])
    right = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 5.0]])
    left_points, right_points = rungs(left, right, 10)
    np.testing.assert_allclose(left_points[:, 2], np.linspace(10.0, 20.0, 11))
    np.testing.assert_allclose(right_points[:, 2], np.linspace(0.0, 5.0, 11))


RIGHT = np.array([[0.0, 0.0], [30.0, 0.0]])
FOLDS = {
    "a z": [[0, 3], [15, 3.0], [12, 3.3], [30, 3.3]],
    "a spike": [[0, 3], [15, 3.0], [12, 3.0], [30, 3.0]],
    "a hook at the start": [[1, 3], [0, 3.1], [30, 3.1]],
    "a hook at the end": [[0, 3], [30, 3.0], [29.5, 3.2]],
    "two folds": [[0, 3], [8, 3.0], [7, 3.2], [20, 3.2], [18, 3.4], [30, 3.4]],
}


@pytest.mark.parametrize("fold", FOLDS.values(), ids=FOLDS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_fold_backs_are_taken_out(fold, side):
    folded = np.array(fold, dtype=float)
    if side == "left":
        mended = mend(folded, RIGHT)
        clean, other = mended.left, mended.right
    else:
        turned = -folded, -RIGHT  # half a turn: what was left is right, and drives backwards
        mended = mend(turned[1][::-1], turned[0][::-1])
        clean, other = -mended.right[::-1], -mended.left[::-1]
    assert len(mended.repairs) == 1
    assert side in mended.repairs[0]
    assert np.all(np.diff(clean[:, 0]) > 0.0)
    np.testing.assert_allclose(clean[[0, -1]], folded[[0, -1]])
    np.testing.assert_array_equal(other, RIGHT)
    assert Polygon([*clean, *RIGHT[::-1]]).area == pytest.approx(93.0, rel=0.1)


def test_a_small_loop_is_cut_off():
    left = np.array([[0, 3], [15, 3], [16, 4], [15, 5], [14, 4], [15.5, 3], [30, 3]], dtype=float)
    mended = mend(left, RIGHT)
    assert "a loop of the left bound cut off" in mended.repairs
    assert mended.left[:, 1].max() < 3.7
    assert outline(mended.left, mended.right).area == pytest.approx(90.0, rel=0.01)


@pytest.mark.parametrize("at_start", [True, False])
@pytest.mark.parametrize("shared", [1, 2])
def test_an_end_without_width_is_parted_by_a_centimetre(at_start, shared):
    left = np.array([[0.0, 0.0], [1.0, 0.0], [30.0, 3.0]])[2 - shared :]
    right = np.array([[0.0, 0.0], [1.0, 0.0], [30.0, 0.0]])[2 - shared :]
    if not at_start:
        left, right = -right[::-1], -left[::-1]
        left, right = driven(left, right)
    mended = mend(left, right)
    where = 0 if at_start else -1
    assert mended.repairs == (f"{'start' if at_start else 'end'} without width parted by 1 cm",)
    assert np.hypot(*(mended.left[where] - mended.right[where])) == pytest.approx(0.01)
    assert sound(*rungs(mended.left, mended.right, 60)).all()


def test_a_lens_is_parted_at_both_ends():
    left = np.array([[0.0, 0.0], [15.0, 3.0], [30.0, 0.0]])
    mended = mend(left, RIGHT)
    assert [repair.split()[0] for repair in mended.repairs] == ["start", "end"]
    assert uncovered(mended.left, mended.right, 60) < 0.005


def test_bounds_that_cross_right_at_an_end_are_cut_there():
    left = np.array([[0.0, -0.05], [30.0, 3.0]])
    mended = mend(left, RIGHT)
    assert mended.repairs[0] == "bounds that crossed at the start cut there"
    assert is_sound(mended.left, mended.right)


REFUSED = {
    "the left bound has no length": [[5, 3], [5.001, 3]],
    "it has no width": [[0, 0.001], [30, 0.001]],
    "cross": [[0, 3], [10, 3], [20, -3], [30, -3.5]],
    "cross or meet between": [[0, 3], [15, 0], [30, 3]],
    "crosses itself in a large loop": [[0, 3], [28, 3], [28, 20], [2, 20], [2, 2], [30, 2]],
}


@pytest.mark.parametrize(("reason", "left"), list(REFUSED.items()))
def test_what_cannot_be_mended_is_refused_with_the_reason(reason, left):
    with pytest.raises(CannotMendError, match=reason):
        mend(np.array(left, dtype=float), RIGHT)


def test_a_step_straight_sideways_is_no_fold_back():
    left = np.array([[0.0, 3.0], [10.0, 3.0], [10.0, 5.0], [30.0, 5.0]])
    assert mend(left, RIGHT).repairs == ()


def zigzag_with_loops(points, loops):
    """A bound of many points along x with small loops, and the same without them."""
    x = np.linspace(0.0, 0.5 * points, points)
    plain = np.column_stack([x, 3.0 + 0.1 * np.sin(x)])
    knots = np.linspace(0, points - 1, loops + 2).astype(int)[1:-1]
    turns = np.array([[0.3, 0.3], [0.1, 0.6], [-0.2, 0.3], [0.2, -0.1]])
    return np.insert(plain, np.repeat(knots + 1, 4), (plain[knots, None] + turns).reshape(-1, 2), 0)


def test_loops_of_a_bound_with_thousands_of_points_are_cut_off():
    bound = zigzag_with_loops(5000, 18)
    assert not LineString(bound).is_simple
    cleaned = without_loops(bound, "left")
    assert LineString(cleaned).is_simple
    np.testing.assert_array_equal(cleaned[[0, -1]], bound[[0, -1]])
    assert len(bound) - 18 * 5 <= len(cleaned) < len(bound)


def first_meeting(bound):
    """The first two segments that meet, each compared with every later one."""
    lines = [LineString(bound[i : i + 2]) for i in range(len(bound) - 1)]
    steps = np.diff(bound, axis=0)
    for i, one in enumerate(lines):
        for j in range(i + 2, len(lines)):
            parallel = steps[i, 0] * steps[j, 1] == steps[i, 1] * steps[j, 0]
            if not parallel and one.intersects(lines[j]):
                return i, j
    return None


@settings(suppress_health_check=[HealthCheck.filter_too_much])
@given(scribbles())
def test_the_first_loop_is_cut_where_its_segments_meet(lines):
    bound = lines[0]
    step = np.diff(bound, axis=0)
    bends = step[1:, 0] * step[:-1, 1] - step[1:, 1] * step[:-1, 0]
    found = first_meeting(bound)
    assume(found is not None and np.all(np.abs(bends) > 1e-6))
    i, j = found
    try:
        cut = without_first_loop(bound, "left")
    except CannotMendError:
        return
    np.testing.assert_array_equal(cut[: i + 1], bound[: i + 1])
    np.testing.assert_array_equal(cut[-1], bound[-1])
    np.testing.assert_array_equal(cut[len(cut) - len(bound[j + 2 :]) :], bound[j + 2 :])
    # The knot is new, unless it falls on a point before or behind it.
    assert abs(len(cut) - (i + 1) - len(bound[j + 1 :])) <= 1


@settings(max_examples=60)
@given(lanes(), st.floats(0.2, 1000.0))
def test_slices_of_any_length_are_sound(lane, slice_m):
    try:
        mended = mend(*lane)
    except CannotMendError:
        assume(False)
    left_points, right_points = sound_rungs(mended.left, mended.right, slice_m)
    assert sound(left_points, right_points).all()
    np.testing.assert_array_equal(left_points[[0, -1]], mended.left[[0, -1]])


def test_more_slices_than_asked_for_only_where_fewer_cross_themselves():
    angle = np.linspace(0.0, 4.7, 60)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    left, right = 4.0 * circle, 8.0 * circle
    asked = slices(left, right, 1000.0)
    assert asked == 1
    assert not sound(*rungs(left, right, asked)).all()
    assert 2 <= len(sound_rungs(left, right, 1000.0)[0]) - 1 <= 4
    assert len(sound_rungs(left, right, 0.5)[0]) - 1 == slices(left, right, 0.5)
    with pytest.raises(CannotMendError, match="sound"):
        sound_rungs(RIGHT, RIGHT + np.array([0.0, 3.0]), 1000.0)
