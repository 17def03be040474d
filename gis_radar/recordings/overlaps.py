"""Recordings of one sensor that hold the same time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from gis_radar.base import Text


def overlap_warnings(sensor: str, spans: Sequence[tuple[float, float, Path]]) -> Iterator[str]:
    """Yield a warning for each recording of a sensor that holds time of an earlier one.

    Parameters
    ----------
    sensor : str
        Its name.
    spans : sequence of (float, float, Path)
        First and last time of each recording, in one unit, and its file.
    """
    ordered = sorted(spans)
    last = ordered[0]  # of those so far the one that ends last
    for each in ordered[1:]:
        if each[0] <= last[1]:
            yield Text(
                "{}: {} and {} overlap in time: what both hold counts once",
                sensor,
                last[2].name,
                each[2].name,
            )
        last = max(last, each, key=lambda span: span[1])
