"""Runs of steps and intervals, against plain sets."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gis_radar.measures import Runs, union_of_runs
from gis_radar.products.heatmap.intervals import aligned, aligned_with, intervals_with

pieces = st.lists(st.tuples(st.integers(-50, 50), st.integers(0, 12)), max_size=12)


def as_runs(parts: list[tuple[int, int]]) -> Runs:
    first = np.array([begin for begin, _ in parts], dtype=np.int64)
    return Runs(first=first, last=first + np.array([more for _, more in parts], dtype=np.int64))


def as_set(parts: list[tuple[int, int]]) -> set[int]:
    return {step for begin, more in parts for step in range(begin, begin + more + 1)}


@given(one=pieces, two=pieces)
def test_union_is_that_of_sets(one, two):
    runs = union_of_runs([as_runs(one), as_runs(two)])
    steps = as_set(one) | as_set(two)
    assert runs.steps == len(steps)
    assert (runs.first[1:] > runs.last[:-1] + 1).all()
    edges = np.arange(-60, 70)
    assert runs.before(edges).tolist() == [sum(step < edge for step in steps) for edge in edges]


@given(parts=pieces.filter(bool), length=st.integers(1, 30))
def test_intervals_with_frames(parts, length):
    runs, steps = union_of_runs([as_runs(parts)]), as_set(parts)
    wanted = sorted({step // length for step in steps})
    assert intervals_with(runs, length) == len(wanted)
    timeline = aligned_with(runs, length)
    assert timeline.begin.tolist() == [number * length for number in wanted]
    assert timeline.counts(runs).sum() == len(steps)


@given(parts=pieces.filter(bool), length=st.integers(1, 30))
def test_aligned_intervals_are_contiguous_and_count_everything(parts, length):
    runs, steps = union_of_runs([as_runs(parts)]), as_set(parts)
    timeline = aligned(min(steps), max(steps), length)
    assert (timeline.begin % length == 0).all()
    assert (timeline.begin[1:] == timeline.end[:-1]).all()
    assert timeline.counts(runs).tolist() == [
        sum(begin <= step < begin + length for step in steps) for begin in timeline.begin
    ]
    ordered = np.array(sorted(steps))
    assert (timeline.begin[timeline.find(ordered)] == ordered // length * length).all()
    assert timeline.find(np.array([timeline.begin[0] - 1, timeline.end[-1]])).tolist() == [-1, -1]


@given(parts=pieces.filter(bool), step=st.integers(-80, 80))
def test_nearest_step(parts, step):
    nearest = union_of_runs([as_runs(parts)]).nearest(step)
    assert nearest in as_set(parts)
    assert abs(nearest - step) == min(abs(one - step) for one in as_set(parts))
