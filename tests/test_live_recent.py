"""Counts of the last minutes, against sums over all steps that were counted."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gis_radar.live import RecentCounts, recent

FIRST = 20 * 1_700_000_100
LANE_OF_TILE, LANES = np.array([0, 0, 1, 2]), [7, 9, 30]


@pytest.fixture(autouse=True)
def short_minutes(monkeypatch):
    """Let a minute have 4 steps and an interval 3 minutes, so that many pass."""
    monkeypatch.setattr(recent, "MINUTE", 4)
    monkeypatch.setattr(recent, "MINUTES", 3)
    monkeypatch.setattr(recent, "INTERVAL", 12)


GAPS = st.lists(st.sampled_from([1, 1, 1, 1, 2, 5, 11, 13, 40]), min_size=1, max_size=60)


@settings(max_examples=60, deadline=None)
@given(gaps=GAPS, seed=st.integers(0, 1_000))
def test_sums_are_those_of_the_steps(gaps, seed):
    chance = np.random.default_rng(seed)
    steps = FIRST + np.cumsum(gaps)
    observed = chance.random((len(steps), 4)) < 0.8
    hit = observed & (chance.random((len(steps), 4)) < 0.5)
    counts = RecentCounts(LANE_OF_TILE, LANES)
    for step, one, other in zip(steps.tolist(), hit, observed, strict=True):
        counts.take(step, one, other)
    lately = steps // 4 > steps[-1] // 4 - 3
    assert [each.tolist() for each in counts.last_minutes()] == [
        hit[lately].sum(axis=0).tolist(), observed[lately].sum(axis=0).tolist(),
    ]  # fmt: skip
    table = counts.lane_intervals()
    met = sorted(set((steps // 12).tolist()))
    assert len(table) == len(met) * len(LANES)
    for place, number in enumerate(met):
        part = table[3 * place : 3 * place + 3]
        chosen = steps // 12 == number
        assert part["begin"].tolist() == [pd.Timestamp(number * 600, unit="ms", tz="UTC")] * 3
        for name, values in (("hit_s", hit), ("observed_s", observed)):
            by_tile = values[chosen].sum(axis=0) * 0.05
            expected = [by_tile[lane == LANE_OF_TILE].mean() for lane in range(3)]
            assert part[name].to_numpy() == pytest.approx(expected)


def test_nothing_was_counted_yet():
    counts = RecentCounts(LANE_OF_TILE, LANES)
    assert counts.lane_intervals().empty
    assert not np.any(counts.last_minutes())
