"""Scale of range, on traffic of a few straight lanes."""

from dataclasses import replace

import numpy as np
import pytest

from gis_radar.base import NoAnswerError
from gis_radar.calibration import RangeScale, measure_range_scale
from gis_radar.calibration.registration.traces import Moving

YARDS = 1.0 / 0.9144


def traffic(vehicles=24, seconds=60.0, seed=1, *, speed_mps=13.0, only=None):
    """Cars on two lanes that pass the sensor, as points of their faces; the truth is a factor 1."""
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(vehicles):
        towards = number % 2 if only is None else only
        lane_m, heading = (-8.0, -1.0) if towards else (-12.0, 1.0)
        pace = speed_mps * rng.uniform(0.8, 1.2)
        begin = rng.uniform(0.0, seconds)
        for time in np.arange(begin, begin + 120.0 / pace, 0.05):
            x = (130.0 if towards else 10.0) + heading * pace * (time - begin)
            for _ in range(rng.poisson(1.5)):
                # the end that is turned to the sensor, or the nearer side
                end = rng.random() < abs(x) / np.hypot(x, 2.0 * lane_m)
                along = -2.25 if end else rng.uniform(-2.25, 2.25)
                across = rng.uniform(-0.9, 0.9) if end else 0.9
                point = np.array([x + along, lane_m + across, -5.5])
                reach = np.linalg.norm(point)
                rate = heading * pace * point[0] / reach + rng.normal(0.0, 0.05)
                rows.append([time, *(point * (1.0 + rng.normal(0.0, 0.1) / reach)), rate])
    table = np.array(sorted(rows))
    return Moving(
        time=np.round(1.7e9 + table[:, 0], 2), points=table[:, 1:4], range_rate=table[:, 4],
        frames=int(seconds / 0.05), begin=1.7e9, end=1.7e9 + seconds,
    )  # fmt: skip


@pytest.fixture(scope="module")
def right():
    return traffic()


def test_a_right_recording_has_a_scale_of_one(right):
    scale = measure_range_scale(right)
    assert abs(scale.factor - 1.0) < 2.0 * scale.sigma < 0.03
    assert 20 <= scale.vehicles <= 30
    assert not scale.off
    assert repr(scale).startswith("RangeScale(1.00")


@pytest.mark.parametrize("times", [3.6, 2.237, 1.609, 0.5, 0.1, 30.0, -1.0, -3.6])
def test_range_rates_in_another_unit_are_found(right, times):
    scale = measure_range_scale(replace(right, range_rate=times * right.range_rate))
    assert scale.factor == pytest.approx(1.0 / times, rel=0.02)
    assert scale.off
    assert not scale.absolute


@pytest.mark.parametrize("times", [1.05, YARDS, 0.95, 3.28084])
def test_ranges_in_another_unit_are_found(right, times):
    scale = measure_range_scale(replace(right, points=times * right.points))
    assert scale.factor == pytest.approx(times, rel=0.015)
    assert scale.off


def test_times_that_run_twice_as_fast_are_found(right):
    begin = right.time[0]
    scale = measure_range_scale(replace(right, time=begin + (right.time - begin) / 2.0))
    assert scale.factor == pytest.approx(2.0, rel=0.02)


def test_signs_that_are_lost_are_told_from_signs_that_are_turned(right):
    scale = measure_range_scale(replace(right, range_rate=np.abs(right.range_rate)))
    assert scale.absolute
    assert scale.off
    assert scale.factor == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("towards", [0, 1])
def test_traffic_of_one_direction_has_not_lost_its_sign(towards):
    moving = traffic(only=towards)
    scale = measure_range_scale(moving)
    assert not scale.absolute
    assert not scale.off
    turned = measure_range_scale(replace(moving, range_rate=-moving.range_rate))
    assert turned.factor == pytest.approx(-1.0, rel=0.02)
    assert not turned.absolute


def test_a_radar_without_elevation_gives_slant_ranges(right):
    x, y = right.points[:, :2].T
    slant = np.linalg.norm(right.points, axis=1) / np.hypot(x, y)
    points = np.column_stack([x * slant, y * slant, np.full(len(x), np.nan)])
    assert measure_range_scale(replace(right, points=points)).factor == pytest.approx(1.0, abs=0.02)


def test_the_error_covers_the_truth_from_draw_to_draw():
    scales = [measure_range_scale(traffic(12, 40.0, seed)) for seed in range(2, 8)]
    assert all(abs(scale.factor - 1.0) < 2.0 * scale.sigma for scale in scales)
    assert not any(scale.off for scale in scales)


def test_one_vehicle_that_carries_the_scale_makes_it_uncertain():
    """A long look at a vehicle that reflects oddly counts as one, however many its detections."""
    others, one = traffic(12, 60.0, 3), traffic(1, 1.0, 4, speed_mps=5.0)
    short = (others.time - others.time[0]) % 8.0 < 1.0
    parts = [
        [getattr(m, n)[keep] for n in ("time", "points", "range_rate")]
        for m, keep in ((others, short), (one, one.time > 0.0))
    ]
    time, points, rate = (np.concatenate(each) for each in zip(*parts, strict=True))
    points[-len(one.time) :] *= 1.04
    order = np.argsort(time, kind="stable")
    scale = measure_range_scale(
        replace(others, time=time[order], points=points[order], range_rate=rate[order])
    )
    assert abs(scale.factor - 1.0) < scale.sigma


@pytest.mark.parametrize(
    ("factor", "looks", "advice"),
    [
        (1.0 / 3.6, "km/h", "divide range_rate by 3.6"),
        (1.609344 / 3.6, "mph", "multiply range_rate by 0.44704"),
        (1.852 / 3.6, "knots", "multiply range_rate by 0.514444"),
        (1.0 / 0.3048, "feet", "multiply x, y and z of all detections by 0.3048"),
        (1.0 / 0.9144, "yards", "multiply x, y and z of all detections by 0.9144"),
    ],
)
def test_a_unit_is_told_with_its_exact_factor(factor, looks, advice):
    scale = RangeScale(factor=1.003 * factor, sigma=0.003 * factor, vehicles=30)
    assert scale.causes[-1].text.endswith(looks)
    with pytest.raises(NoAnswerError, match=looks) as caught:
        scale.require_one("R1")
    assert caught.value.hint == advice


def test_units_that_are_as_likely_are_all_told():
    scale = RangeScale(factor=0.507, sigma=0.006, vehicles=30)
    likely = " ".join(each.text for each in scale.causes)
    assert "doubled" in likely
    assert "knots" in likely


def test_too_little_traffic_has_no_scale(right):
    few = right.time < right.time[0] + 3.0
    cut = replace(
        right, time=right.time[few], points=right.points[few], range_rate=right.range_rate[few]
    )
    assert measure_range_scale(cut) is None
    none = replace(cut, time=np.empty(0), points=np.empty((0, 3)), range_rate=np.empty(0))
    assert measure_range_scale(none) is None


def test_range_rates_of_other_detections_have_no_scale(right):
    rng = np.random.default_rng(0)
    mixed = replace(right, range_rate=rng.permutation(right.range_rate))
    scale = measure_range_scale(mixed)
    assert scale is None or not scale.off


@pytest.mark.parametrize(
    ("factor", "sigma", "off"),
    [(1.05, 0.01, True), (1.05, 0.02, False), (1.009, 0.001, False), (0.98, 0.004, True),
     (-1.0, 0.001, True)],
)  # fmt: skip
def test_off_one_is_beyond_three_sigma_and_one_percent(factor, sigma, off):
    assert RangeScale(factor=factor, sigma=sigma, vehicles=9).off is off
    assert RangeScale(factor=factor, sigma=sigma, vehicles=9, absolute=True).off
