"""Green times of signals, by lane, as a city's computer lists them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from gis_radar.base import (
    STEPS_PER_SECOND,
    InputError,
    Text,
    csv_rows,
    listed,
    stated_moment,
    step_at,
    text_in,
)
from gis_radar.measures import Greens

_NEEDED = ("lane", "green_begin")


def read_signals(path: str | Path, lanes: Mapping[str, int], zone: ZoneInfo) -> dict[int, Greens]:
    """Read begins and, where they are stated, ends of green.

    Parameters
    ----------
    path : str or Path
        CSV with a header: `lane`, its number or name; `green_begin` and, optional, `green_end`,
        without a zone by the clocks of the site.
    lanes : mapping
        Positions of the lanes by their numbers, as text, and their names.
    zone : ZoneInfo
        Time zone of the site.

    Raises
    ------
    InputError
        If it is no such table, is empty, names an unknown lane, or a green ends before it begins or
        after the next one begins, or two begin within a second.
    """
    header, rows = csv_rows(path, Text("not a table of signals"))
    if missing := [name for name in _NEEDED if name not in header]:
        hint = Text("columns are lane, green_begin, green_end")
        raise InputError("{}: lacks the columns {}", path, listed(missing), hint=hint)
    if not rows:
        raise InputError("{}: holds no green times", path)
    found: dict[int, dict[int, int]] = {}
    for number, row in rows:
        what = f"{path}, line {number}"
        lane, begin, end = (text_in(row, name) for name in (*_NEEDED, "green_end"))
        if lane not in lanes:
            raise InputError(
                "{}: lane {} is none that was measured", what, repr(lane),
                hint="traffic.csv lists lanes with numbers and names",
            )  # fmt: skip
        first, ends = _step(begin, zone, f"{what}: green_begin"), found.setdefault(lanes[lane], {})
        if first in ends:
            raise InputError("{}: a green of the lane begins then already", what)
        ends[first] = _step(end, zone, f"{what}: green_end") if end else -1
    return {lane: _greens(found[lane], path) for lane in sorted(found)}


def _step(text: str, zone: ZoneInfo, what: str) -> int:
    return int(step_at(stated_moment(text, zone, what), zone, what=what))


def _greens(ends: Mapping[int, int], path: str | Path) -> Greens:
    begin = np.array(sorted(ends), np.int64)
    end = np.array([ends[each] for each in begin.tolist()], np.int64)
    stated = end >= 0
    after = np.append(begin[1:], np.iinfo(np.int64).max)
    if (stated & ((end <= begin) | (end > after))).any():
        raise InputError("{}: a green ends before it begins, or after the next one begins", path)
    if (np.diff(begin) < STEPS_PER_SECOND).any():  # queues are looked at each second
        raise InputError("{}: two greens begin within a second", path)
    return Greens(begin, end)
