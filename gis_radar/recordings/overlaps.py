"""Warn of recordings of one sensor that overlap, and of sensors without any time in common."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

from gis_radar.base import Text


def time_warnings(recorded: Mapping[str, Sequence[tuple[float, float, Path]]]) -> Iterator[str]:
    """Yield a warning for recordings of a sensor that overlap, and for sensors that never do.

    Parameters
    ----------
    recorded : mapping of str to sequence of (float, float, Path)
        First and last time of each recording, UNIX seconds, and its file, by sensor.
    """
    for sensor, spans in recorded.items():
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
