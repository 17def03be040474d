"""Odd clocks: who is named among sensors of one view, and how many pairs are compared for it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from gis_radar.calibration.check.odd_clocks import clock_offsets_between, odd_clocks
from gis_radar.calibration.timing.clock_offsets import ClockOffset
from gis_radar.calibration.timing.lane_detections import LaneDetections

SENSORS, LATE_S, CYCLE_S = 9, 1.0, 100.0


def drive(rng, *, late_s=0.0):
    """Return what one sensor sees of 20 vehicles on a street of 300 m, some metres off."""
    traffic = np.random.default_rng(7)
    begin = np.sort(traffic.uniform(0.0, 60.0, 20))
    speed = traffic.uniform(8.0, 16.0, 20)
    moment = np.arange(0.0, 100.0, 0.25)
    on = (moment - begin[:, None]) * speed[:, None]
    vehicle, step = np.nonzero((on > 0.0) & (on < 300.0))
    order = np.argsort(moment[step], kind="stable")
    vehicle, step = vehicle[order], step[order]
    return LaneDetections(
        time=1e9 + moment[step] + late_s + rng.normal(0.0, 0.01),
        lanelet=vehicle % 2,
        s_m=on[vehicle, step] + rng.normal(0.0, 0.5, len(step)),
        speed=speed[vehicle] + rng.normal(0.0, 0.1, len(step)),
        side=np.ones(len(step)),
    )


@pytest.fixture(scope="module")
def seen():
    rng = np.random.default_rng(1)
    late = dict.fromkeys([f"S{k:02d}" for k in range(SENSORS)], 0.0) | {"S05": LATE_S}
    return {name: drive(rng, late_s=value) for name, value in late.items()}


def test_of_many_sensors_with_one_view_the_late_one_is_named(seen):
    found = odd_clocks(seen)
    assert list(found) == ["S05"]
    ahead = re.search(r"this one is ([\d.]+) ± [\d.]+ s ahead", found["S05"].evidence)
    assert float(ahead[1]) == pytest.approx(LATE_S, abs=0.1)


@pytest.mark.parametrize("late_s", [LATE_S, 3600.0])
@pytest.mark.parametrize("share", [0.4, 0.5, 0.6])
def test_a_clock_that_is_set_on_the_way_is_named(share, late_s):
    rng = np.random.default_rng(3)
    right, late = drive(rng), drive(rng)
    moment = np.quantile(late.time, share)
    late = replace(late, time=late.time + late_s * (late.time > moment))
    assert set(odd_clocks({"A": right, "B": late})) == {"A", "B"}


@pytest.mark.parametrize("silent", ["begin", "end"])
def test_a_sensor_that_is_silent_for_half_the_time_is_not_off_by_a_cycle(silent):
    """At signals, traffic looks alike one cycle later: parts are compared at the same times."""
    rng = np.random.default_rng(5)
    both = [drive(rng), drive(rng)]
    cycle = [replace(each, time=each.time + CYCLE_S) for each in both]
    right = LaneDetections.joined([both[0], cycle[0]])
    half = cycle[1] if silent == "begin" else both[1]
    right = right.take(np.argsort(right.time, kind="stable"))
    assert odd_clocks({"A": right, "B": half}) == {}
    quarter = half.take(np.flatnonzero(half.time < np.median(half.time)))
    assert odd_clocks({"A": right, "B": quarter}) == {}


@pytest.mark.parametrize("later_s", [7200.0, 30 * 86_400.0])
def test_copied_traffic_is_no_clock_that_is_off(later_s):
    """The clocks are right, though one sensor's traffic is all found again earlier, too."""
    rng = np.random.default_rng(6)
    first, second = drive(rng), drive(rng)
    one, other = (
        LaneDetections.joined([replace(each, time=each.time + day * later_s) for day in days])
        for each, days in ((first, (0, 1)), (second, (1, 2)))
    )
    assert odd_clocks({"A": one, "B": other}) == {}


def test_a_sensor_without_detections_on_lanes_is_compared_with_none(seen):
    nothing = LaneDetections.joined([])
    assert odd_clocks({"A": nothing, "B": seen["S00"], "C": nothing}) == {}


def test_a_certain_offset_is_not_hidden_by_a_larger_one_that_is_uncertain(monkeypatch):
    """By few vehicles in a part, the offset may be larger, with an error as large as it."""

    def measured(one, _):
        whole = len(one) == len(right)
        offset_s, sigma_s = (LATE_S, 0.01) if whole else (1.2 * LATE_S, 0.25)
        return ClockOffset(
            offset_s=offset_s, sigma_s=sigma_s, drift=0.0, drift_sigma=1e-4, at=1e9, vehicles=8
        )

    right = drive(np.random.default_rng(4))
    monkeypatch.setattr("gis_radar.calibration.check.odd_clocks.measured_offset", measured)
    assert set(odd_clocks({"A": right, "B": right})) == {"A", "B"}


def test_each_sensor_is_compared_with_some_not_with_all(seen):
    pairs = clock_offsets_between(seen)
    assert len(pairs) <= 3 * SENSORS < SENSORS * (SENSORS - 1) / 2
    assert all(sum(name in pair for pair in pairs) >= 3 for name in seen)


def test_groups_that_share_a_clock_each_are_compared_with_each_other():
    """Two recorders a second apart, six sensors each, are named though each agrees within."""
    rng = np.random.default_rng(2)
    late = {f"A{k}": 0.0 for k in range(6)} | {f"B{k}": LATE_S for k in range(6)}
    seen = {}
    for name, value in late.items():
        every = drive(rng, late_s=value)
        # each group sees a piece of its own, which puts its pairs first
        near = every.s_m < 200.0 if name[0] == "A" else every.s_m > 100.0
        seen[name] = every.take(near)
    assert {name[0] for name in odd_clocks(seen)} == {"A", "B"}
