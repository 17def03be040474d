"""Hits and observed steps of the tiles in an hour, of all sensors together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from gis_radar.base import STEP_US, STEPS_PER_HOUR, Booleans, Integers, compiled
from gis_radar.hdmap import Numbers
from gis_radar.measures.counting_loop import DETECTIONS, MOVING, SHIFT_US, TILES_HIT, TIME_US, WILD
from gis_radar.measures.hour import LONGEST_VALID_STEPS, HourWindow
from gis_radar.measures.pose_sights import PoseSight
from gis_radar.measures.sensor_reading import SensorHour
from gis_radar.measures.validity import Runs, union_of_runs

_BATCH_PAIRS = 1 << 19  # pairs in a batch, 8 MiB; more than a tile can have
_RUN_BASE = LONGEST_VALID_STEPS  # a run is packed as offset x _RUN_BASE + number of steps after it
_CHECKSUM_BITS = np.uint64(0xFFFF)  # bits of the hash that the table `frames` keeps


@dataclass(frozen=True, kw_only=True)
class ValidFrames:
    """The steps with a frame of a sensor, and the last step in which each is valid.

    Parameters
    ----------
    step : (n,) int64 array
        Steps of the window with a frame, each once, ascending.
    until : (n,) int64 array
        The last step in which the frames of each step are valid.
    """

    step: Integers
    until: Integers

    @classmethod
    def of(cls, sensor: SensorHour, most: int) -> ValidFrames:
        """Return the valid frames of a sensor; each is valid for `most` steps after its own."""
        step = np.unique(sensor.frames.time_us // STEP_US)
        return cls(step=step, until=valid_until(step, most))

    def until_of(self, step: Integers) -> Integers:
        """Return the last step in which the frames of some steps are valid."""
        return np.asarray(self.until[np.searchsorted(self.step, step)])


def valid_until(step: Integers, most: int) -> Integers:
    """Return the last step in which frames of ascending steps are valid: up to `most` later."""
    before_next = np.append(step[1:], np.iinfo(np.int64).max) - 1
    return np.asarray(np.minimum(step + most, before_next))


def frame_columns(sensor: SensorHour, valid: ValidFrames, window: HourWindow) -> dict[str, object]:
    """Return the columns of the table `frames` for a sensor's frames in the hour.

    Parameters
    ----------
    sensor : SensorHour
        Frames of the sensor.
    valid : ValidFrames
        Steps in which they are valid.
    window : HourWindow
        The hour.
    """
    time_us = sensor.counted[:, TIME_US]
    is_of_hour = time_us >= window.begin * STEP_US
    is_of_hour[:-1] &= time_us[1:] != time_us[:-1]  # frames of the same microsecond count as one
    rows = sensor.counted[is_of_hour]
    step = rows[:, TIME_US] // STEP_US
    place = np.searchsorted(sensor.frames.time_us, rows[:, TIME_US])
    pose = sensor.place[place]
    names = [name for source in sensor.sources for name in source.pose_names]
    sight_names = [each.name for each in sensor.sights]
    tiles_in_sight = [len(each.tile_id) for each in sensor.sights]
    checksum = (sensor.frames.hash[place] & _CHECKSUM_BITS).astype(np.int64)
    return {
        "sensor": np.full(len(rows), sensor.sensor, object), "time_us": rows[:, TIME_US],
        "first_step": step, "last_step": valid.until_of(step),
        "detections": rows[:, DETECTIONS], "moving": rows[:, MOVING],
        "pose": np.array(sight_names, object)[pose],
        "wild": rows[:, WILD], "tiles_hit": rows[:, TILES_HIT],
        "tiles_seen": np.array(tiles_in_sight, np.int64)[pose],
        "checksum": checksum, "shift_us": rows[:, SHIFT_US],
        "pose_in_force": np.array(names, object)[pose],
    }  # fmt: skip


def valid_runs(
    sensors: Sequence[SensorHour], valid: Sequence[ValidFrames], window: HourWindow
) -> pd.DataFrame:
    """Return `sight, first_step, last_step`: the runs of steps with a valid frame of each sight.

    They lie in the window, sorted by sensor, name of the sight and step.
    """
    tables = [pd.DataFrame({"sight": [], "first_step": [], "last_step": []})]
    for sensor, frames in zip(sensors, valid, strict=True):
        step = sensor.frames.time_us // STEP_US
        name = np.array([each.name for each in sensor.sights], object)[sensor.place]
        for sight in sorted(set(name.tolist())):
            of_sight = np.unique(step[name == sight])
            runs = union_of_runs([Runs(first=of_sight, last=frames.until_of(of_sight))])
            first, last = runs.first, np.minimum(runs.last, window.span[1] - 1)
            tables.append(pd.DataFrame({"sight": sight, "first_step": first, "last_step": last}))
    runs_of_sights = pd.concat(tables, ignore_index=True)
    return runs_of_sights.astype({"first_step": np.int64, "last_step": np.int64})


def observed_runs(
    sight_runs: pd.DataFrame, sights: Mapping[str, PoseSight], tile_id: Integers, window: HourWindow
) -> tuple[Integers, Integers, Integers]:
    """Return the runs of steps in which each tile is observed in the hour.

    Parameters
    ----------
    sight_runs : DataFrame
        Table from :func:`valid_runs`.
    sights : mapping
        Sights by name.
    tile_id : (n,) int64 array
        Ids of all tiles, ascending.
    window : HourWindow
        The hour.

    Returns
    -------
    tile, first, last : (n,) int64 arrays
        Positions of tiles, first and last steps of runs, sorted by tile and step.
    """
    names = sorted(set(sight_runs["sight"]))
    seen = np.zeros((len(tile_id), len(names)), np.bool_)
    for k, name in enumerate(names):
        seen[np.searchsorted(tile_id, sights[name].tile_id), k] = True
    combinations, combination = np.unique(seen, axis=0, return_inverse=True)
    parts = []
    for number, row in enumerate(combinations):
        rows = sight_runs[
            sight_runs["sight"].isin([name for name, on in zip(names, row, strict=True) if on])
        ]
        if rows.empty:
            continue
        first, last = (rows[name].to_numpy(np.int64) for name in ("first_step", "last_step"))
        runs = union_of_runs([Runs(first=first, last=last)]).within(window.begin, window.end - 1)
        of_kind = np.flatnonzero(combination.ravel() == number)
        tile = np.repeat(of_kind, len(runs))
        parts.append((tile, np.tile(runs.first, len(of_kind)), np.tile(runs.last, len(of_kind))))
    none = np.empty(0, np.int64)
    tile, first, last = map(np.concatenate, zip((none, none, none), *parts, strict=True))
    order = np.lexsort((first, tile))
    return tile[order], first[order], last[order]


def sorted_hits(
    sensors: Sequence[SensorHour], valid: Sequence[ValidFrames], tile_id: Integers,
    window: HourWindow,
) -> Iterator[dict[str, Integers]]:  # fmt: skip
    """Yield, in batches, the pairs of a tile and a step of the hour, each once, sorted by both.

    Parameters
    ----------
    sensors, valid : sequences
        Frames of each sensor, and the steps in which they are valid.
    tile_id : (n,) int64 array
        Ids of the tiles, ascending.
    window : HourWindow
        The hour.
    """
    counts = np.zeros(len(tile_id), np.int64)
    for sensor in sensors:
        for tile in sensor.tile:
            counts += np.bincount(tile, minlength=len(tile_id))
    first = np.concatenate([[0], np.cumsum(counts)])
    packed, place = np.empty(first[-1], np.int32), first[:-1].copy()
    for sensor, frames in zip(sensors, valid, strict=True):
        frame, run = 0, _packed_runs(sensor, frames, window)
        for tile in sensor.tile:
            frame = _sort_runs_by_tile(
                run, sensor.counted[:, TILES_HIT], frame, tile, place, packed
            )
    state, is_hit = np.zeros(2, np.int64), np.zeros(STEPS_PER_HOUR, np.bool_)
    while state[0] < len(tile_id):
        tiles, steps = np.empty(_BATCH_PAIRS, np.int64), np.empty(_BATCH_PAIRS, np.int64)
        _fill_pairs(packed, first, tile_id, window.begin, is_hit, state, tiles, steps)
        if state[1]:
            yield {"tile_id": tiles[: state[1]], "step": steps[: state[1]]}
        state[1] = 0


def _packed_runs(sensor: SensorHour, frames: ValidFrames, window: HourWindow) -> Numbers:
    """Return each frame's step, from `_RUN_BASE` before the hour on, packed with its validity."""
    step = sensor.counted[:, TIME_US] // STEP_US
    valid = frames.until_of(step) - step
    return ((step - window.begin + _RUN_BASE) * _RUN_BASE + valid).astype(np.int32)


@compiled
def _sort_runs_by_tile(  # pragma: no cover - compiled
    run: Numbers, hits: Integers, frame: int, tile: Numbers, place: Integers, packed: Numbers
) -> int:
    """Store the runs of frames from `frame` on by the tiles they hit; return the next frame."""
    begin = 0
    while begin < len(tile):
        for k in range(begin, begin + hits[frame]):
            packed[place[tile[k]]] = run[frame]
            place[tile[k]] += 1
        begin += hits[frame]
        frame += 1
    return frame


@compiled
def _fill_pairs(
    packed: Numbers, first: Integers, tile_id: Integers, begin: int, is_hit: Booleans,
    state: Integers, tiles: Integers, steps: Integers,
) -> None:  # fmt: skip
    """Fill in the pairs of consecutive tiles, as long as there is room for all pairs of a tile.

    `state` holds the next tile and the number of pairs filled in; both are updated. `is_hit`, by
    step of the hour, is working memory and all False.
    """
    tile, filled = state[0], state[1]
    while tile < len(tile_id):
        least, most = STEPS_PER_HOUR, 0
        room = 0
        for k in range(first[tile], first[tile + 1]):
            room += packed[k] % _RUN_BASE + 1
        if filled + min(room, STEPS_PER_HOUR) > len(tiles):
            break
        for k in range(first[tile], first[tile + 1]):
            offset = packed[k] // _RUN_BASE - _RUN_BASE
            low, high = max(offset, 0), min(offset + packed[k] % _RUN_BASE + 1, STEPS_PER_HOUR)
            for step in range(low, high):
                is_hit[step] = True
            least, most = min(least, low), max(most, high)
        for step in range(least, most):
            if is_hit[step]:
                steps[filled], tiles[filled] = begin + step, tile_id[tile]
                filled += 1
                is_hit[step] = False
        tile += 1
    state[0], state[1] = tile, filled
