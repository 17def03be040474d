"""How long each tile was observed and how long it was occupied, interval by interval.

Occupied(tile, interval) is the number of steps in which the tile was hit, observed(tile,
interval) the number of steps in which any sensor delivered a frame in a view that sees the tile:
a union over the sensors, so that overlapping views never count twice (the paper's section
"Global Occupancy Heat Map"). A hit counts only where the tile was observed in that step: a
detection on the corner of a tile whose centre lies outside the view is left out, and occupied
never exceeds observed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gis_radar.arrays import Booleans, Integers
from gis_radar.errors import InputError
from gis_radar.heatmap.timeline import Timeline
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.frames import runs_in
from gis_radar.occupancy.runs import Runs, union
from gis_radar.progress import Reporter

Counts = NDArray[np.uint32]


@dataclass(frozen=True, kw_only=True)
class Observation:
    """Which tiles were observed in which steps.

    Parameters
    ----------
    seen : (k,) int64 array
        Positions of the tiles that some view sees, ascending.
    group : (k,) int64 array
        For each of them, the group of tiles that the same views see.
    runs : tuple of Runs
        For each group, the steps in which it was observed.
    """

    seen: Integers
    group: Integers
    runs: tuple[Runs, ...]


def frame_runs(occupancy: Occupancy) -> Runs:
    """Return the steps in which any sensor delivered a frame.

    Raises
    ------
    InputError
        If there is none.
    """
    frames = occupancy.frames
    if frames.empty:
        raise InputError("the occupancy holds no frame", hint="was the recording empty?")
    return union([runs_in(frames)])


def observe(occupancy: Occupancy, tile_ids: Integers) -> Observation:
    """Find the steps in which each tile was observed.

    Tiles that the same views see are observed in the same steps and are treated as one.

    Parameters
    ----------
    occupancy : Occupancy
        Its frames and views.
    tile_ids : (n,) int64 array
        The tiles, ascending.

    Raises
    ------
    InputError
        If no view sees any tile, or a view names a tile that is not there.
    """
    frames, views = occupancy.frames, occupancy.views
    if views.empty:
        raise InputError(
            "no sensor sees any of the tiles", hint="do the poses belong to this place?"
        )
    codes, tiles = _view_codes(frames, views)
    position = positions(tile_ids, views["tile_id"].to_numpy(np.int64))
    seen, group, members = _group(position, tiles)
    of_view: dict[Any, Runs] = {
        code: union([runs_in(rows)]) for code, rows in frames.groupby(codes)
    }
    runs = tuple(union([of_view.get(code, _NO_RUNS) for code in each]) for each in members)
    return Observation(seen=seen, group=group, runs=runs)


def positions(tile_ids: Integers, wanted: Integers) -> Integers:
    """Return where each wanted tile stands among the ascending `tile_ids`.

    Raises
    ------
    InputError
        If one is not there.
    """
    position = np.searchsorted(tile_ids, wanted)
    known = position < len(tile_ids)
    known[known] = tile_ids[position[known]] == wanted[known]
    if not known.all():
        raise InputError(f"the occupancy names tile {wanted[~known][0]}, which the tiles lack")
    return position


def count_hits(
    occupancy: Occupancy,
    observation: Observation,
    timeline: Timeline,
    tile_ids: Integers,
    reporter: Reporter,
) -> Counts:
    """Count the steps in which each tile was occupied while it was observed.

    Parameters
    ----------
    occupancy : Occupancy
        Its hits; read once, chunk by chunk.
    observation : Observation
        Which tiles were observed when.
    timeline : Timeline
        The intervals.
    tile_ids : (n,) int64 array
        The tiles, ascending.
    reporter : Reporter
        Where progress goes.

    Returns
    -------
    (intervals, k) uint32 array
        One column for each of `observation.seen`.
    """
    tiles = len(observation.seen)
    column = np.full(len(tile_ids), -1)
    column[observation.seen] = np.arange(tiles)
    lookup = _Lookup(observation)
    counts = np.zeros((len(timeline), tiles), np.uint32)
    done = 0
    for step, tile_id in occupancy.hits():
        place, row = column[positions(tile_ids, tile_id)], timeline.find(step)
        kept = np.flatnonzero((place >= 0) & (row >= 0))
        kept = kept[lookup.observed(observation.group[place[kept]], step[kept])]
        np.add.at(counts.reshape(-1), row[kept] * tiles + place[kept], 1)
        done += len(step)
        reporter.progress("counting hits", done, None)
    return counts


class _Lookup:
    """Tells whether a group was observed in a step: all runs of all groups in one sorted list."""

    def __init__(self, observation: Observation) -> None:
        runs = observation.runs
        first = np.concatenate([one.first for one in runs])
        last = np.concatenate([one.last for one in runs])
        self._low = int(first.min()) if len(first) else 0
        self._high = int(last.max()) if len(last) else -1
        self._span = self._high - self._low + 1
        shift = np.repeat(np.arange(len(runs)), [len(one) for one in runs]) * self._span - self._low
        self._first, self._last = first + shift, last + shift

    def observed(self, group: Integers, step: Integers) -> Booleans:
        within = (step >= self._low) & (step <= self._high)
        key = group * self._span + (step - self._low)
        run = np.searchsorted(self._first, key, side="right") - 1
        within &= run >= 0
        within[within] = key[within] <= self._last[run[within]]
        return np.asarray(within)


_NO_RUNS = Runs(first=np.empty(0, np.int64), last=np.empty(0, np.int64))


def _view_codes(frames: pd.DataFrame, views: pd.DataFrame) -> tuple[Integers, Integers]:
    """Return a number for the view of each row of `frames` and of each row of `views`."""
    columns = ["sensor", "view"]
    both = pd.concat([frames[columns], views[columns]], ignore_index=True).astype(str)
    codes = np.asarray(both.groupby(columns, sort=False).ngroup(), dtype=np.int64)
    return codes[: len(frames)], codes[len(frames) :]


def _group(position: Integers, code: Integers) -> tuple[Integers, Integers, list[list[int]]]:
    """Group tiles by the set of views that see them.

    Returns
    -------
    seen, group : (k,) int64 arrays
        Position and group of each tile that is seen.
    members : list of lists of int
        The views of each group.
    """
    views = code.max() + 1
    tile, codes = np.divmod(np.unique(position * views + code), views)
    seen, start = np.unique(tile, return_index=True)
    stop = np.append(start[1:], len(tile))
    numbers: dict[bytes, int] = {}
    group = np.array(
        [
            numbers.setdefault(codes[low:high].tobytes(), len(numbers))
            for low, high in zip(start.tolist(), stop.tolist(), strict=True)
        ],
        dtype=np.int64,
    )
    members = [np.frombuffer(text, np.int64).tolist() for text in numbers]
    return seen, group, members
