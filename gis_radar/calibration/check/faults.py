"""Faults of values that need neither map nor pose: frozen, constant, off, twice, fast, near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, Text, iso_from_step, step_of
from gis_radar.calibration.findings import Cause, Finding, wrong
from gis_radar.calibration.registration.traces import MIN_SPEED_MPS
from gis_radar.recordings import constant_value, detection_keys

_FROZEN_FRAMES = 20  # least number of equal frames in a row that is a fault; 1 s at 20 Hz
_LEAST_REPEATED = 2  # smaller frames equal the one before by chance
# Share of repeated detections that is accepted, and a number: of a few, two may be alike by chance.
_MOST_DUPLICATES, _LEAST_DUPLICATES = 0.1, 30
# So many detections faster than this (m/s) cannot be vehicles, in m/s or in km/h.
_TOO_FAST_MPS, _LEAST_TOO_FAST = 300.0, 30
# So many detections within this range (m, 99 % of them): a radar on a mast sees farther.
_LEAST_REACH_M, _LEAST_CHECKED = 5.0, 1000
# What stands has one range rate: of slower detections than _SLOW_MPS, at least _LEAST_SLOW, half
# lie within _SAME_RATE_MPS (sensors have 0.02 to 0.08). That is 0 but for less than moving ones
# have.
_SLOW_MPS, _LEAST_SLOW, _SAME_RATE_MPS = 3.0, 1000, MIN_SPEED_MPS
# Half of what stands is in cells of so many metres that are detected in this share of the frames
# (eleven sensors: 0.41 to 0.92); a vehicle is in such a cell for a second.
_STAYING_CELL_M, _STAYING_SHARE = 2.0, 0.2


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Detections of several recordings, in order of time; `source` is the recording's index."""

    time: Floats
    points: Floats
    range_rate: Floats
    source: Integers


def find_fault(rows: Rows, moves: Booleans) -> Finding | None:
    """Return the finding on frozen, constant, repeated, impossible or shifted values, if any.

    Parameters
    ----------
    rows : Rows
        The detections.
    moves : (n,) bool array
        Which of them move.
    """
    found = _frozen(rows) or _constant(rows) or _unplaced(rows) or _duplicated(rows, moves)
    return found or _too_fast(rows) or _too_near(rows) or _shifted(rows)


def _frozen(rows: Rows) -> Finding | None:
    """Return the finding on the longest run of equal frames."""
    present = np.isfinite(rows.points[:, 0])
    frames, first, count = np.unique(rows.time[present], return_index=True, return_counts=True)
    if len(frames) < _FROZEN_FRAMES:
        return None
    values = np.column_stack([rows.points, rows.range_rate])[present]
    sums = np.add.reduceat(np.nan_to_num(values, posinf=0.0, neginf=0.0), first)
    same = (np.diff(count) == 0) & (np.diff(sums, axis=0) == 0.0).all(axis=1)
    changes = np.flatnonzero(np.append(~(same & (count[1:] >= _LEAST_REPEATED)), True))
    runs = np.diff(changes, prepend=-1)  # frames from one change to the next
    longest = int(runs.argmax())
    if runs[longest] < _FROZEN_FRAMES:
        return None
    last = int(changes[longest])
    begin, end = frames[last - runs[longest] + 1], frames[last]
    evidence = Text("{} frames from {} to {} are the same", runs[longest], iso(begin), iso(end))
    return wrong(evidence, Cause(Text("the recording is frozen"), Text("leave that time out")))


def _constant(rows: Rows) -> Finding | None:
    """Return the finding on a column with one value; where nothing moves, all rates may be 0."""
    for name, column in (("range_rate", rows.range_rate), ("z", rows.points[:, 2])):
        value = constant_value(column)
        if value is not None and (name == "z" or value != 0.0):
            cause = Text("{} was not measured, or converted wrongly", name)
            advice = Text("leave {} empty (NaN) where the radar does not measure it", name)
            return wrong(Text("{} is {:g} in all detections", name, value), Cause(cause, advice))
    return None


def _unplaced(rows: Rows) -> Finding | None:
    """Return the finding on range rates of which none has a position."""
    rates = int(np.isfinite(rows.range_rate).sum())
    if rates == 0 or np.isfinite(rows.points[:, :2]).all(axis=1).any():
        return None
    cause = Text("x and y were converted wrongly")
    evidence = Text("none of {:,} detections has a position", rates)
    return wrong(evidence, Cause(cause, Text("x, y and z are metres from the sensor")))


def _duplicated(rows: Rows, moves: Booleans) -> Finding | None:
    """Return the finding on moving detections that repeat another one of recording and frame."""
    values = rows.source, rows.time, rows.points, rows.range_rate
    keys = detection_keys(*(each[moves] for each in values))
    twice = len(keys) - len(np.unique(keys))
    if twice < _LEAST_DUPLICATES or twice <= _MOST_DUPLICATES * len(keys):
        return None
    cause = Cause(
        Text("a file was joined with a copy of itself"), Text("leave each detection once")
    )
    return wrong(Text("{:.0%} of the moving detections are twice in it", twice / len(keys)), cause)


def _too_fast(rows: Rows) -> Finding | None:
    """Return the finding on many range rates that no vehicle has."""
    speeds = np.abs(rows.range_rate)
    fast, infinite = int((speeds > _TOO_FAST_MPS).sum()), int(np.isinf(speeds).sum())
    if fast < _LEAST_TOO_FAST:
        return None
    if 2 * infinite > fast:  # a wrong unit leaves them finite
        cause = Text("the recording is damaged, or was converted wrongly")
        advice = Text("a detection without a range rate has NaN there")
        return wrong(Text("{:,} range rates are infinite", infinite), Cause(cause, advice))
    evidence = Text("{:,} detections are faster than {:g} m/s", fast, _TOO_FAST_MPS)
    looks = Text("range rates look like cm/s or mm/s")
    return wrong(evidence, Cause(looks, Text("range_rate is m/s")))


def _too_near(rows: Rows) -> Finding | None:
    """Return the finding on positions that all lie nearer than a road to its radar."""
    range_m = np.hypot(rows.points[:, 0], rows.points[:, 1])
    range_m = range_m[np.isfinite(range_m)]
    if len(range_m) < _LEAST_CHECKED or (reach_m := np.percentile(range_m, 99.0)) > _LEAST_REACH_M:
        return None
    cause = Text("positions look like kilometres, or divided by 100 or 1000")
    evidence = Text("99 % of the detections lie within {:.2g} m", reach_m)
    return wrong(evidence, Cause(cause, Text("x, y and z are metres from the sensor")))


def _shifted(rows: Rows) -> Finding | None:
    """Return the finding on range rates of what stands that are not 0 but something else."""
    slow = np.sort(rows.range_rate[np.abs(rows.range_rate) < _SLOW_MPS])
    half = len(slow) // 2
    if len(slow) < _LEAST_SLOW:
        return None
    widths = slow[half:] - slow[: len(slow) - half]
    first = int(widths.argmin())  # of the shortest interval with half of them
    low, high = slow[[first, first + half]]
    shift = float(np.median(slow[first : first + half]))
    if high - low > _SAME_RATE_MPS or abs(shift) <= MIN_SPEED_MPS:
        return None
    if not _stays(rows, (rows.range_rate >= low) & (rows.range_rate <= high)):
        return None
    looks = Text("range rates are {:.2f} m/s too high", shift)
    if shift < 0.0:
        looks = Text("range rates are {:.2f} m/s too low", -shift)
    evidence = Text("what stands has range rates of {:+.2f} m/s", shift)
    return wrong(evidence, Cause(looks, Text("subtract {:.2f} from range_rate", shift)))


def _stays(rows: Rows, chosen: Booleans) -> bool:
    """Return whether half of the chosen detections lie in cells that are detected all the time."""
    frames, frame = np.unique(rows.time, return_inverse=True)
    places = np.floor(rows.points[chosen, :2] / _STAYING_CELL_M)
    cell = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(np.unique(np.column_stack([cell, frame[chosen]]), axis=0)[:, 0])
    return bool(np.median(count[cell]) >= _STAYING_SHARE * len(frames))


def iso(time: float) -> str:
    """Format a time (UNIX seconds) as ISO 8601 text for a message."""
    return iso_from_step(int(step_of(np.array(time))))
