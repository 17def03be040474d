"""Counts of the last minutes, against sums over all steps that were counted."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gis_radar.live import RecentCounts

FIRST = 20 * 1_700_000_100
GAPS = st.lists(st.sampled_from([300, 300, 600, 1500, 3300, 9000, 24_000, 99_000]),
                min_size=1, max_size=60)  # fmt: skip


@settings(max_examples=60)
@given(gaps=GAPS, seed=st.integers(0, 1_000))
def test_sums_are_those_of_the_steps(gaps, seed):
    chance = np.random.default_rng(seed)
    steps = FIRST + np.cumsum(gaps)
    observed = chance.random((len(steps), 4)) < 0.8
    hit = observed & (chance.random((len(steps), 4)) < 0.5)
    counts = RecentCounts(4, interval=7000)

    def sums(number, length, last=1):
        chosen = (steps // length > number - last) & (steps // length <= number)
        return [hit[chosen].sum(axis=0).tolist(), observed[chosen].sum(axis=0).tolist()]

    for step, one, other in zip(steps.tolist(), hit, observed, strict=True):
        counts.take(step, one, other)
    newest = int(steps[-1])
    assert [each.tolist() for each in counts.last_minutes()] == sums(newest // 1200, 1200, 15)
    assert [each.tolist() for each in counts.since_begin()] == sums(newest // 7000, 7000)
    found = {number: rows.tolist() for number, rows in counts.quarters()}
    last = range(newest // 18_000 - 4, newest // 18_000 + 1)
    assert found == {each: sums(each, 18_000) for each in last if any(sums(each, 18_000)[1])}


def test_nothing_was_counted_yet():
    counts = RecentCounts(4)
    assert not counts.quarters()
    assert not np.any(counts.last_minutes())
