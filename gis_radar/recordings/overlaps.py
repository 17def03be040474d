"""What recordings have in common: detections or frames of two sensors, and time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gis_radar.base import CLOCK_SET_S, Floats, Integers, Text, iso_from_step, step_of

_FIRST_RADARS_S = 1_577_836_800.0  # 2020-01-01: no radar that measures elevation was sold before
# Later than the file by these: file systems keep times to two seconds, and archives may give all
# files one time, years ago.
_LEAST_LATE_S, _MOST_LATE_S = 3.0, 86_400.0
_GPS_S = 315_964_782  # from times of GPS to UNIX time, with 18 leap seconds


def detection_keys(*columns: Floats | Integers) -> NDArray[np.uint64]:
    """Return a number for each detection; equal detections, by all given columns, have equal ones.

    Parameters
    ----------
    *columns : (n,) or (n, m) array
        Such as positions and range rates.
    """
    values = pd.DataFrame(np.nan_to_num(np.column_stack(columns)))
    return np.asarray(pd.util.hash_pandas_object(values, index=False), dtype=np.uint64)


def keys_in_common(
    keys: Mapping[str, NDArray[np.uint64]],
) -> Iterator[tuple[str, str, NDArray[np.uint64]]]:
    """Yield two sensors and the keys that both have, where they have any.

    Parameters
    ----------
    keys : mapping of str to array
        Keys of detections, or of frames, by sensor.
    """
    distinct = {name: np.unique(each) for name, each in keys.items()}
    every = np.concatenate([np.empty(0, np.uint64), *distinct.values()])
    values, counts = np.unique(every, return_counts=True)
    shared = values[counts > 1]  # usually few, so that comparing all pairs of sensors is cheap
    found = {name: np.intersect1d(each, shared) for name, each in distinct.items()}
    for name, other in combinations([name for name, each in found.items() if len(each)], 2):
        common = np.intersect1d(found[name], found[other])
        if len(common):
            yield name, other, common


def time_warnings(recorded: Mapping[str, Sequence[tuple[float, float, Path]]]) -> Iterator[str]:
    """Yield warnings of times that cannot be right, that overlap, or that have none in common.

    Parameters
    ----------
    recorded : mapping of str to sequence of (float, float, Path)
        First and last time of each recording, UNIX seconds, and its file, by sensor.
    """
    for sensor, spans in recorded.items():
        for begin, end, path in spans:
            yield from _impossible_times(sensor, begin, end, path)
        ordered = sorted(spans)
        latest = ordered[0]  # the one that ends last, so far
        for each in ordered[1:]:
            if each[0] <= latest[1]:
                yield Text(
                    "{}: {} and {} overlap in time: what both hold counts once",
                    sensor,
                    latest[2].name,
                    each[2].name,
                )
            latest = max(latest, each, key=lambda span: span[1])
    span_by_sensor = {
        sensor: (min(begin for begin, _, _ in spans), max(end for _, end, _ in spans))
        for sensor, spans in recorded.items()
    }
    for (first_sensor, (begin_s, end_s)), (second_sensor, (first_s, last_s)) in combinations(
        span_by_sensor.items(), 2
    ):
        if (apart_s := max(first_s - end_s, begin_s - last_s)) > 0:
            yield Text(
                "{} and {} have no time in common: {:,.0f} s lie between them; if they "
                "were recorded together, a clock is off: gis-radar clocks finds by how "
                "much",
                first_sensor,
                second_sensor,
                apart_s,
            )


def _impossible_times(sensor: str, begin: float, end: float, path: Path) -> Iterator[str]:
    """Yield a warning where a recording is older than its kind of radar, or newer than its file."""
    if CLOCK_SET_S <= begin < _FIRST_RADARS_S:
        yield Text(
            "{}: times begin at {}, before there were such radars: do they count from another "
            "year than 1970? To those of GPS add {:,} s",
            path.name, iso_from_step(int(step_of(np.array(begin)))), _GPS_S,
        )  # fmt: skip
    late_s = end - path.stat().st_mtime
    if _LEAST_LATE_S < late_s < _MOST_LATE_S:
        yield Text(
            "{}: its last frame is {:,.0f} s later than the file was written: is the clock of {} "
            "ahead (GPS is by 18 s), or are its times local ones?",
            path.name, late_s, sensor,
        )  # fmt: skip
