"""Tile counts: steps of each tile by quarter of an hour, from the exact tables of its hours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from gis_radar.base import (
    STEPS_PER_HOUR,
    STEPS_PER_SECOND,
    Booleans,
    Floats,
    Integers,
    compiled,
    ranges,
)
from gis_radar.dataset.days.tables import QUARTERS, STEPS_PER_QUARTER, DayTables
from gis_radar.dataset.files.parts import HOURS_PER_DAY, Keys
from gis_radar.dataset.files.records import HourRecord
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.tables import HITS, OBSERVED, OCCUPIED, TILE_COUNTS, VISIBLE

# Error of a run of occupied steps by the ends of its vehicle, as a share of the run's length (both
# ends of a car of 4.5 m are known to 0.5 m), and at most (of a vehicle that stops, at 1.5 m/s).
RUN_END_SHARE, RUN_END_MOST_S = 0.16, 0.5
# Root of the variance of a run by false and missed vehicles, relative to its length: of a seen run
# (7 % and 13 % of the time in five simulated places), and of an inferred one (25 % each).
FALSE_SHARE, INFERRED_SHARE = 0.45, 0.7


def run_variance(steps: Integers, seen: Booleans) -> Floats:
    """Return the variance of the length of runs of occupied steps, steps squared."""
    ends = np.minimum(RUN_END_SHARE * steps, RUN_END_MOST_S * STEPS_PER_SECOND)
    share = np.where(seen, FALSE_SHARE, INFERRED_SHARE)
    return np.asarray(ends**2 + (share * steps) ** 2, np.float64)


@dataclass(frozen=True, kw_only=True)
class _Runs:
    """Runs of steps on a common axis, on which each tile has an hour of its own.

    A step of the tile at position p lies at p x `STEPS_PER_HOUR` + its place in the hour. `cell`
    numbers the tile and span of cut runs.
    """

    first: Integers
    last: Integers
    seen: Booleans
    cell: Integers = field(default_factory=lambda: np.empty(0, np.int64))

    @classmethod
    def of(cls, table: pa.Table, tiles: Integers, hour: int) -> _Runs:
        """Return the runs of a table, all of whose tiles must be among the given ones."""
        first, last = (table[name].to_numpy() for name in ("first_step", "last_step"))
        place = np.searchsorted(tiles, table["tile_id"].to_numpy())
        shift = (place - hour) * STEPS_PER_HOUR
        known = "seen" in table.column_names
        seen = table["seen"].to_numpy() if known else np.ones(len(first), np.bool_)
        return cls(first=first + shift, last=last + shift, seen=seen)

    def joined(self) -> _Runs:
        """Join runs that follow each other without a gap, whether seen or not."""
        new = np.diff(self.first, prepend=-1) > 0
        new[1:] = (self.first[1:] != self.last[:-1] + 1) | (self.first[1:] % STEPS_PER_HOUR == 0)
        begins = np.flatnonzero(new)
        ends = np.append(begins[1:], len(self.first)) - 1
        return _Runs(
            first=self.first[begins], last=self.last[ends[: len(begins)]], seen=self.seen[begins]
        )

    def during(self, others: _Runs) -> _Runs:
        """Intersect the runs with others."""
        low = np.searchsorted(others.last, self.first)
        count = np.searchsorted(others.first, self.last, side="right") - low
        return self._cut(count, others.first[at := ranges(low, count)], others.last[at])

    def within(self, first: Integers, last: Integers) -> _Runs:
        """Return the parts of runs in each span of the hour, disjoint ones that ascend."""
        tile = self.first // STEPS_PER_HOUR
        begin = tile * STEPS_PER_HOUR
        low = np.searchsorted(last, self.first - begin)
        count = np.searchsorted(first, self.last - begin, side="right") - low
        span = ranges(low, count)
        at = np.repeat(begin, count)
        cut = self._cut(count, at + first[span], at + last[span])
        return replace(cut, cell=np.repeat(tile, count) * len(first) + span)

    def _cut(self, count: Integers, first: Integers, last: Integers) -> _Runs:
        """Repeat each run `count` times, and cut each copy to a span."""
        return _Runs(
            first=np.maximum(np.repeat(self.first, count), first),
            last=np.minimum(np.repeat(self.last, count), last),
            seen=np.repeat(self.seen, count),
        )

    @property
    def steps(self) -> Integers:
        """Lengths of the runs, steps."""
        return self.last - self.first + 1

    def total(self, values: Integers | Floats | Booleans, cells: int) -> Floats:
        """Sum a value of cut runs by tile and span."""
        return np.bincount(self.cell, values, cells).astype(np.float64)


def count_hour(folder: Path, record: HourRecord) -> pa.Table:
    """Count the steps of the tiles of an hour.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    record : HourRecord
        Record of the hour.

    Returns
    -------
    pyarrow.Table
        The hour's rows of `tile_counts`: tiles and quarters with an observed step.

    Raises
    ------
    InputError
        If a part of the hour is not what it should be.
    """
    begins = np.arange(QUARTERS, dtype=np.int64) * STEPS_PER_QUARTER
    tiles, sums = count_spans(folder, record, begins, begins + STEPS_PER_QUARTER - 1)
    rows = np.flatnonzero(sums["observed_steps"])
    quarter = record.hour % HOURS_PER_DAY * QUARTERS + rows % QUARTERS
    counts = {"tile_id": tiles[rows // QUARTERS], "interval": quarter}
    return TILE_COUNTS.to_arrow(counts | {name: each[rows] for name, each in sums.items()})


def count_spans(
    folder: Path, record: HourRecord, first: Integers, last: Integers
) -> tuple[Integers, dict[str, Floats]]:
    """Count the steps of the tiles in spans of an hour.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    record : HourRecord
        Record of the hour.
    first, last : (spans,) int64 arrays
        Disjoint spans of the hour, ascending: steps from its begin, inclusive.

    Returns
    -------
    tiles : (n,) int64 array
        Ids of the tiles with a run, ascending.
    sums : dict
        The columns of `tile_counts`, each (n * spans,): by tile, then by span.

    Raises
    ------
    InputError
        If a part of the hour is not what it should be.
    """

    def read(table: TableSchema) -> pa.Table:
        return record.read(folder, table) if table.name in record.parts else table.empty()

    tables = {table.name: read(table) for table in (OBSERVED, VISIBLE, OCCUPIED)}
    ids = [table["tile_id"].to_numpy() for table in tables.values()]
    tiles = np.unique(np.concatenate(ids))
    observed, visible, occupied = (_Runs.of(table, tiles, record.hour) for table in tables.values())
    occupied = occupied.during(visible.joined())
    observed, visible, occupied = (
        each.within(first, last) for each in (observed, visible, occupied)
    )
    cells = len(tiles) * len(first)
    variance = run_variance(occupied.steps, occupied.seen)
    sums = {
        "hit_steps": observed.total(_hits_in(observed, folder, record, tiles), cells),
        "observed_steps": observed.total(observed.steps, cells),
        "occupied_steps": occupied.total(occupied.steps, cells),
        "visible_steps": visible.total(visible.steps, cells),
        "occupied_variance": occupied.total(variance, cells),
        "inferred_steps": visible.total(visible.steps * ~visible.seen, cells),
    }
    hidden = sums["observed_steps"] - sums["visible_steps"]
    sums["hidden_steps"] = hidden * (VISIBLE.name in record.parts)
    return tiles, sums


def _hits_in(runs: _Runs, folder: Path, record: HourRecord, tiles: Integers) -> Integers:
    """Count the hits in each run; memory holds one row group."""
    counts, reached = np.zeros(len(runs.first), np.int64), np.zeros(2, np.int64)
    begin = record.hour * STEPS_PER_HOUR
    with record.opened(folder, HITS) as file:
        for group in range(file.num_row_groups):
            rows = file.read_row_group(group, columns=HITS.names, use_threads=False)
            tile, step = (rows[name].to_numpy() for name in HITS.names)
            _count_hits(tile, step, tiles, runs.first, runs.last, begin, reached, counts)
    return counts


@compiled
def _count_hits(  # pragma: no cover - compiled
    tile: Integers, step: Integers, tiles: Integers, first: Integers, last: Integers, begin: int,
    reached: Integers, counts: Integers,
) -> None:  # fmt: skip
    """Count sorted hits in sorted runs, continuing at the tile and the run in `reached`."""
    place, run = reached
    for k in range(len(tile)):
        while place < len(tiles) and tiles[place] < tile[k]:
            place += 1
        if place == len(tiles) or tiles[place] != tile[k]:
            continue
        position = place * STEPS_PER_HOUR + step[k] - begin
        while run < len(last) and last[run] < position:
            run += 1
        if run < len(last) and first[run] <= position:
            counts[run] += 1
    reached[0], reached[1] = place, run


def count_keys(records: Mapping[int, HourRecord]) -> Keys:
    """Return the keys of the counts of each hour: the digests that they follow from."""
    return {hour: [each.origin.method, each.origin.inputs] for hour, each in records.items()}


class TileCounts(DayTables):
    """Maker and reader of the tile counts of a dataset."""

    tables = (TILE_COUNTS,)

    def keys(self, _day: int, records: Mapping[int, HourRecord]) -> Keys:
        """Return the keys of the counts of hours."""
        return count_keys(records)

    def make(self, record: HourRecord) -> tuple[pa.Table]:
        """Count an hour."""
        return (count_hour(self.folder, record),)
