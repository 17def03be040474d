"""Intervals in which steps are counted: equal ones, and local hours, days and weeks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from itertools import pairwise
from operator import index
from typing import Any, TypeAlias
from zoneinfo import ZoneInfo

import numpy as np

from gis_radar.base import (
    STEPS_PER_SECOND,
    InputError,
    Integers,
    Reporter,
    Text,
    UsageError,
    interval_steps,
    iso_from_step,
    known_language,
    moment_in,
    one_line,
    ranges,
    require_kinds,
    step_at,
    step_begin,
    step_of,
    zone_of,
)
from gis_radar.measures import Runs, union_of_runs

MOST_BANDS = 500  # intervals that become columns and bands (the contract); more are rows only
_MOST_EMPTY = 10  # intervals for each one with a frame; of more, empty ones are left out
_MOST_ROWS = 100_000_000  # most rows of the layer by interval: about 35 GB of GeoPackage


@dataclass(frozen=True, kw_only=True)
class MapLabels:
    """Labels of pictures and reports of a heat map.

    Parameters
    ----------
    title : str
        Title of the site.
    timezone : str
        Time zone of the times in pictures, such as Europe/Berlin; files stay in UTC.
    sources : sequence of str
        Sources of map, scan and recordings, and whether they are simulated: a line each.
    language : str
        Language of pictures and reports, `en` or `de`.
    """

    title: str = ""
    timezone: str = "UTC"
    sources: Sequence[str] = ()
    language: str = "en"

    def __post_init__(self) -> None:
        """Refuse a time zone or language that there is not; keep the title printable."""
        require_kinds(self)
        zone_of(self.timezone)
        known_language(self.language)
        object.__setattr__(self, "title", one_line(self.title))
        object.__setattr__(self, "sources", tuple(self.sources))


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Disjoint intervals in ascending order.

    Parameters
    ----------
    begin, end : (n,) int64 arrays
        First step of each interval, and the step after its last.
    """

    begin: Integers
    end: Integers

    def __len__(self) -> int:
        return len(self.begin)

    def span(self, interval: int = 0) -> tuple[datetime, datetime]:
        """Return begin and end of an interval, UTC."""
        return step_begin(int(self.begin[interval])), step_begin(int(self.end[interval]))

    def spans(self) -> list[tuple[datetime, datetime]]:
        """Return begin and end of all intervals, UTC."""
        return [self.span(i) for i in range(len(self))]

    def cut_at(self, steps: int) -> Timeline:
        """Cut the only interval at the multiples of a number of steps."""
        low, high = int(self.begin[0]), int(self.end[0])
        edges = np.arange(low // steps + 1, (high - 1) // steps + 1, dtype=np.int64) * steps
        return Timeline(begin=np.append(low, edges), end=np.append(edges, high))

    def cut(self, first: int | None, after: int | None) -> Timeline:
        """Return the parts of intervals from step `first` to before step `after`."""
        low = first if first is not None else int(self.begin[0])
        high = after if after is not None else int(self.end[-1])
        inside = (self.end > low) & (self.begin < high)
        begin, end = np.maximum(self.begin[inside], low), np.minimum(self.end[inside], high)
        return Timeline(begin=begin, end=end)

    def counts(self, runs: Runs) -> Integers:
        """Count the steps of a set that fall in each interval."""
        return runs.before(self.end) - runs.before(self.begin)

    def find(self, step: Integers) -> Integers:
        """Return the interval of each step, -1 where it is in none."""
        if not len(self):
            return np.full(len(step), -1)
        interval = np.searchsorted(self.begin, step, side="right") - 1
        inside = (interval >= 0) & (step < self.end[interval])
        return np.where(inside, interval, -1)


def aligned(first: int, last: int, steps: int) -> Timeline:
    """Return all intervals from that of step `first` to that of step `last`.

    Parameters
    ----------
    first, last : int
        Steps.
    steps : int
        Length of an interval; intervals begin at multiples of it since the UNIX epoch.
    """
    begin = np.arange(first // steps, last // steps + 1, dtype=np.int64) * steps
    return Timeline(begin=begin, end=begin + steps)


def _numbers_with(runs: Runs, steps: int) -> Runs:
    """Return the numbers of the aligned intervals that hold a step of the set, as runs."""
    return union_of_runs([Runs(first=runs.first // steps, last=runs.last // steps)])


def intervals_with(runs: Runs, steps: int) -> int:
    """Count the aligned intervals that hold a step of the set, without listing them."""
    return _numbers_with(runs, steps).steps


def aligned_with(runs: Runs, steps: int) -> Timeline:
    """Return only those aligned intervals that hold a step of the set."""
    numbers = _numbers_with(runs, steps)
    begin = ranges(numbers.first, numbers.last - numbers.first + 1) * steps
    return Timeline(begin=begin, end=begin + steps)


When: TypeAlias = int | slice | str | datetime | None
"""Which interval: its number, several, a time in it, or the whole time."""


def intervals_at(
    timeline: Timeline, zone: ZoneInfo, interval: When, begin: Any, end: Any
) -> int | slice | None:
    """Return the number, or a slice of numbers, of intervals given by number or by time.

    Raises
    ------
    UsageError
        If there is no such interval, or both `interval` and `begin` or `end` are given.
    """
    if begin is not None or end is not None:
        if interval is not None:
            raise UsageError("interval and begin, end do not go together", hint="give one of them")
        return _between(timeline, zone, begin, end)
    if interval is None or isinstance(interval, slice):
        return interval
    if not isinstance(interval, str | datetime | np.datetime64):
        number, count = index(interval), len(timeline)
        if not -count <= number < count:
            raise UsageError(
                "interval {} of {}", number, count, hint=Text("from 0 to {}", count - 1)
            )
        return number
    moment = moment_in(interval, zone, what="interval")
    number_at = int(timeline.find(step_of(np.array([moment.timestamp()])))[0])
    if number_at < 0:
        raise _no_interval(timeline, zone, Text("no interval holds {}", moment.astimezone(zone)))
    return number_at


def _between(timeline: Timeline, zone: ZoneInfo, begin: Any, end: Any) -> slice:
    """Return the intervals that lie completely between two times."""
    low, high = (
        None if time is None else moment_in(time, zone, what=what)
        for time, what in ((begin, "begin"), (end, "end"))
    )
    first, last = 0, len(timeline)
    if low is not None:
        step = step_at(low, zone, what="begin")
        first = int(np.searchsorted(timeline.begin, step, side="left"))
    if high is not None:
        step = step_of(np.array([high.timestamp()]))[0]
        last = int(np.searchsorted(timeline.end, step, side="right"))
    if first >= last:
        since, until = (each.astimezone(zone) if each else "..." for each in (low, high))
        raise _no_interval(timeline, zone, Text("no interval lies between {} and {}", since, until))
    return slice(first, last)


def _no_interval(timeline: Timeline, zone: ZoneInfo, what: str) -> UsageError:
    first, last = (each.astimezone(zone) for each in (timeline.span(0)[0], timeline.span(-1)[1]))
    return UsageError(what, hint=Text("they go from {} to {} ({})", first, last, zone))


_QUARTER = 900 * STEPS_PER_SECOND  # of an hour, in steps, as the two below
HOUR = 4 * _QUARTER
DAY = 24 * HOUR
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_A_MONDAY = date(1970, 1, 5)


def local_intervals(first: int, last: int, steps: int, zone: ZoneInfo) -> Timeline:
    """Return all intervals from that of step `first` to that of step `last`.

    Parameters
    ----------
    first, last : int
        Steps.
    steps : int
        Length of an interval: a part of a day, or whole days. Up to an hour they follow each other
        from midnight on, so that the day on which clocks are set back has 25 hours; longer ones
        begin at their time of day, so that `6h` begins at 0, 6, 12 and 18 o'clock. Whole
        days count from a Monday.
    zone : ZoneInfo
        Time zone of the midnights.

    Raises
    ------
    UsageError
        If the length neither divides a day nor is one of whole days.
    """
    if DAY % steps and steps % DAY:
        raise UsageError(
            "with a timezone, intervals are parts of a day or whole days",
            hint="such as 15min, 1h, 6h, 1d",
        )
    days = max(steps // DAY, 1)
    begin = step_begin(first).astimezone(zone).date()
    begin -= timedelta(days=(begin - _A_MONDAY).days % days)
    count = (step_begin(last).astimezone(zone).date() - begin).days // days + 2
    dates = [begin + timedelta(days=days * i) for i in range(count)]
    edges = _edges(dates, min(steps, DAY), zone)
    low, high = np.searchsorted(edges, [first, last], side="right")
    return Timeline(begin=edges[low - 1 : high], end=edges[low : high + 1])


def _edges(dates: list[date], steps: int, zone: ZoneInfo) -> Integers:
    """Return all begins of intervals on these days, and the midnight of the last one."""
    midnights = np.array([_step_of(day, time(), zone) for day in dates])
    if steps <= HOUR:
        parts = [np.arange(low, high, steps) for low, high in pairwise(midnights.tolist())]
        return np.concatenate([*parts, midnights[-1:]])
    minutes = range(0, 24 * 60, steps // (60 * STEPS_PER_SECOND))
    clock = [time(minute // 60, minute % 60) for minute in minutes]
    every = [_step_of(day, at, zone) for day in dates[:-1] for at in clock]
    return np.unique(np.array([*every, midnights[-1]], np.int64))


def _step_of(day: date, at: time, zone: ZoneInfo) -> int:
    moment = datetime.combine(day, at, tzinfo=zone)
    return round((moment - _EPOCH).total_seconds() * STEPS_PER_SECOND)


def whole_of(runs: Runs, at: str | datetime | None, zone: ZoneInfo) -> Timeline:
    """Return the whole time, or the step that contains `at`, as one interval."""
    first, last = int(runs.first[0]), int(runs.last[-1])
    if at is not None:
        moment = moment_in(at, zone, what="at").timestamp()
        first = last = int(step_of(np.array([moment]))[0])
        nearest = runs.nearest(first)
        if nearest != first:
            raise InputError(
                "no sensor delivered a frame at {}, in the step from {}",
                at,
                iso_from_step(first),
                hint=Text("the nearest step with a frame begins at {}", iso_from_step(nearest)),
            )
    return Timeline(begin=np.array([first]), end=np.array([last + 1]))


def intervals_of(
    runs: Runs, interval: str, zone: ZoneInfo | None, tiles: int, reporter: Reporter
) -> Timeline:
    """Return the intervals; where most are empty, or there are many, only those with a frame."""
    steps = interval_steps(interval)
    first, last = int(runs.first[0]), int(runs.last[-1])
    if zone is None or _QUARTER % steps == 0:  # zones differ by whole quarters of an hour
        local, every, filled = None, last // steps - first // steps + 1, intervals_with(runs, steps)
    else:
        local = local_intervals(first, last, steps, zone)
        has_frame = local.counts(runs) > 0
        every, filled = len(local), int(has_frame.sum())
    # Empty intervals of an outage are kept, those of a week between two hours are not.
    if every <= MOST_BANDS and every <= _MOST_EMPTY * filled:
        return aligned(first, last, steps) if local is None else local
    if filled * tiles > _MOST_ROWS:
        raise UsageError(
            "{} intervals of {} for {} tiles are more than a heat map can hold",
            filled,
            interval,
            tiles,
            hint="use a longer interval",
        )
    note = Text("only the {} intervals in which a sensor delivered a frame are kept", filled)
    if filled > MOST_BANDS:
        note = Text(
            "{}; more than {}, so they are rows of by_interval, not columns and bands",
            note,
            MOST_BANDS,
        )
    reporter.log(note)
    if local is None:
        return aligned_with(runs, steps)
    return Timeline(begin=local.begin[has_frame], end=local.end[has_frame])
