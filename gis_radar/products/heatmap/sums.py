"""Sums of tile counts by interval.

Intervals of whole quarters of an hour are sums of the dataset's tile counts; finer ones are counted
from its exact tables, an hour at a time; a month is the sum of its roll-up.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from gis_radar.base import STEPS_PER_HOUR, Floats, Integers, Reporter
from gis_radar.dataset import STEPS_PER_QUARTER, TILE_COUNTS, Dataset, count_spans
from gis_radar.measures import Runs
from gis_radar.products.heatmap.intervals import Timeline

_COUNTED = tuple(name for name in TILE_COUNTS.names if name not in TILE_COUNTS.order)
Sums: TypeAlias = dict[str, Floats]
"""By column of `tile_counts`, (intervals, tiles) arrays."""


def sums_by_interval(
    dataset: Dataset, ids: Integers, whole: Timeline, timeline: Timeline, reporter: Reporter
) -> tuple[Sums, Sums]:
    """Return the sums of the columns of tile counts by interval, and those for the whole time.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    ids : (k,) int64 array
        Ids of the tiles, ascending.
    whole, timeline : Timeline
        The whole time, and the intervals.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    dict of (intervals, k) arrays, each
        The second is cut at quarters of an hour where the dataset has vehicles.
    """
    steps = dataset.frame_steps()
    of_quarters = _of_quarters(timeline, steps)
    sums = whole_sums = _sums(dataset, ids, timeline, reporter, of_quarters=of_quarters)
    if dataset.has_vehicles and not of_quarters:
        cut = whole.cut_at(STEPS_PER_QUARTER)
        exact = not _of_quarters(cut, steps)
        whole_sums = _sums(dataset, ids, cut, reporter, of_quarters=not exact)
    return sums, whole_sums


def sums_of_month(dataset: Dataset, ids: Integers, month: str) -> Sums:
    """Return the sums of a month by the clocks of the site, from its roll-up: (1, k) arrays."""
    sums = dataset.tile_months(month=month).groupby("tile_id")[list(_COUNTED)].sum()
    return {
        name: sums[name].reindex(ids, fill_value=0).to_numpy(np.float64)[None] for name in _COUNTED
    }


def _sums(
    dataset: Dataset, ids: Integers, timeline: Timeline, reporter: Reporter, *, of_quarters: bool
) -> dict[str, Floats]:
    """Return the sums of the columns of tile counts: (intervals, tiles) arrays."""
    sums = {name: np.zeros((len(timeline), len(ids))) for name in _COUNTED}
    source = _by_quarter if of_quarters else _by_step
    for done, (tile, interval, counts) in enumerate(source(dataset, timeline)):
        place = np.searchsorted(ids, tile)
        is_known = (interval >= 0) & (np.append(ids, -1)[place] == tile)
        cell = interval[is_known] * len(ids) + place[is_known]
        for name, total in sums.items():
            added = np.bincount(cell, counts[name][is_known], total.size)
            sums[name] = total + added.reshape(total.shape)
        reporter.progress("counting tiles", done + 1, None)
    return sums


_Counted = tuple[Integers, Integers, dict[str, Floats]]  # tiles, intervals, counts


def _of_quarters(timeline: Timeline, steps: Runs) -> bool:
    """Return whether no interval cuts a quarter of an hour in which frames are valid."""
    begin, end = timeline.begin, timeline.end
    begins_there = (begin % STEPS_PER_QUARTER == 0) | (begin <= steps.first[0])
    ends_there = (end % STEPS_PER_QUARTER == 0) | (end > steps.last[-1])
    return bool((begins_there & ends_there).all())


def _by_quarter(dataset: Dataset, timeline: Timeline) -> Iterator[_Counted]:
    """Yield the tile counts of each date, with the interval of each quarter."""
    first = timeline.begin // STEPS_PER_QUARTER * STEPS_PER_QUARTER
    last = -(-timeline.end // STEPS_PER_QUARTER) * STEPS_PER_QUARTER
    quarters = Timeline(begin=first, end=last)
    span = int(first[0]), int(last[-1]) - 1
    for rows in dataset.batches(TILE_COUNTS, span, ["tile_id", "first_step", *_COUNTED]):
        counts = {name: rows[name].to_numpy().astype(np.float64) for name in _COUNTED}
        yield rows["tile_id"].to_numpy(), quarters.find(rows["first_step"].to_numpy()), counts


def _by_step(dataset: Dataset, timeline: Timeline) -> Iterator[_Counted]:
    """Yield the counts of each hour in the intervals that overlap it."""
    records = dataset.records((int(timeline.begin[0]), int(timeline.end[-1]) - 1))
    for hour, record in records.items():
        begin = hour * STEPS_PER_HOUR
        low = int(np.searchsorted(timeline.end, begin, side="right"))
        high = int(np.searchsorted(timeline.begin, begin + STEPS_PER_HOUR))
        if low == high:
            continue
        first = np.maximum(timeline.begin[low:high] - begin, 0)
        last = np.minimum(timeline.end[low:high] - begin, STEPS_PER_HOUR) - 1
        tiles, sums = count_spans(dataset.folder, record, first, last)
        yield np.repeat(tiles, high - low), np.tile(np.arange(low, high), len(tiles)), sums
