"""Faults of recorded values that need neither map nor pose."""

import numpy as np
import pytest

from gis_radar.calibration.check.faults import Rows, find_fault

FRAMES = 800


def rows(x, rate):
    """Return detections, a value for each of them in each of `FRAMES` frames."""
    rng = np.random.default_rng(3)
    count = len(x)
    time = np.repeat(1.75e9 + 0.05 * np.arange(FRAMES), count)
    points = np.column_stack([np.concatenate(x.T), np.tile(np.arange(count), FRAMES), time * 0.0])
    points += rng.normal(0.0, 0.05, points.shape)
    rates = rate + rng.normal(0.0, 0.02, len(time))
    return Rows(time=time, points=points, range_rate=rates, source=np.zeros(len(time), np.int64))


@pytest.mark.parametrize(("rate", "named"), [(0.6, True), (-0.6, True), (0.02, False)])
def test_what_stands_has_no_range_rate(rate, named):
    still = np.repeat(5.0 + np.arange(20.0)[:, None], FRAMES, axis=1)
    made = rows(still, rate)
    found = find_fault(made, np.abs(made.range_rate) > 0.15)
    assert (found is not None) == named
    if named:
        assert found.cause == f"range rates are 0.60 m/s too {'high' if rate > 0.0 else 'low'}"
        assert found.advice == f"subtract {rate:.2f} from range_rate"


def test_what_creeps_at_one_speed_is_no_fault():
    """A recording of moving detections alone, of a queue."""
    creeping = 5.0 + np.arange(20.0)[:, None] + 0.6 * 0.05 * np.arange(FRAMES)
    made = rows(creeping, 0.6)
    assert find_fault(made, np.ones(len(made.time), dtype=bool)) is None
