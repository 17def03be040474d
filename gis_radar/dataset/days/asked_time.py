"""The time that a question asks for: quarters of an hour by weekday, period and holidays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from functools import cache
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_S,
    Booleans,
    InputError,
    Integers,
    Text,
    UsageError,
    csv_rows,
    text_in,
)
from gis_radar.dataset.days.tables import QUARTERS, STEPS_PER_QUARTER
from gis_radar.dataset.files.parts import HOURS_PER_DAY
from gis_radar.dataset.files.records import Span

DAY_NAMES = ("Mo", "Tu", "We", "Th", "Fr", "Sa", "Su")  # as in opening hours of OpenStreetMap
QUARTERS_PER_DAY = HOURS_PER_DAY * QUARTERS
QUARTER_S = STEPS_PER_QUARTER * STEP_S
_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})")  # 12.10.2026
_LONGEST_YEARS = 100  # of a period of holidays: a longer one is a mistake
_NO_HOLIDAYS = Text("is no table of holidays: has no column date, nor begin and end")

Holidays: TypeAlias = str | Path | Sequence[str | date] | None
"""Dates such as `2026-10-12`, periods such as `2026-10-12/2026-10-23`, or a CSV file of them."""


def day_numbers(days: str | None) -> set[int]:
    """Return the days of the week in a text such as `Mo-Fr,Su`, Monday as 0.

    Raises
    ------
    UsageError
        If it names none.
    """
    numbers: set[int] = set()
    for span in (days or "Mo-Su").split(","):
        names = [each.strip().capitalize() for each in span.split("-")]
        if not set(names) <= set(DAY_NAMES) or len(names) > 2:
            raise UsageError(
                "{} names no days of the week", repr(days), hint="such as Mo-Fr or Sa,Su"
            )
        first, last = DAY_NAMES.index(names[0]), DAY_NAMES.index(names[-1])
        numbers |= {(first + k) % 7 for k in range((last - first) % 7 + 1)}
    return numbers


@cache
def month_edges(month: str, zone: str) -> tuple[pd.Timestamp, pd.Timestamp]:
    """Return the begin of a month such as `2026-10`, and of the next, by the clocks of a zone.

    Raises
    ------
    UsageError
        If it is no month.
    """
    if not re.fullmatch(r"[12]\d{3}-(0[1-9]|1[0-2])", month):
        raise UsageError("{} is no month", repr(month), hint="such as 2026-10")
    begin = pd.Timestamp(f"{month}-01")
    first, after = (
        each.tz_localize(zone, ambiguous=True, nonexistent="shift_forward")
        for each in (begin, begin + pd.DateOffset(months=1))
    )
    return first, after


def holiday_dates(holidays: Holidays) -> Integers:
    """Return the days since 1970 of holidays, ascending; both ends of a period are holidays.

    Parameters
    ----------
    holidays : str, Path or sequence, optional
        Dates and periods, also in one text with commas between them; or a CSV file with a column
        `date`, or columns `begin` and `end`.

    Raises
    ------
    UsageError
        If one is no date.
    InputError
        If the file is no such table.
    """
    periods = np.array(
        [_day_numbers_of(*each) for each in _stated_periods(holidays)], np.int64
    ).reshape(-1, 2)
    low = int(periods.min(initial=0))
    change = np.zeros(int(periods.max(initial=0)) - low + 2, np.int64)  # by day, of periods
    np.add.at(change, periods[:, 0] - low, 1)
    np.add.at(change, periods[:, 1] + 1 - low, -1)
    return low + np.flatnonzero(np.cumsum(change))


def _stated_periods(holidays: Holidays) -> Iterator[tuple[Any, Any]]:
    """Yield the first and the last day of holidays, as stated."""
    if isinstance(holidays, Path) or (
        isinstance(holidays, str) and (Path(holidays).suffix or Path(holidays).is_file())
    ):
        yield from _periods_in_file(holidays)
        return
    parts = holidays.split(",") if isinstance(holidays, str) else holidays or ()
    for each in parts:
        first, _, last = each.partition("/") if isinstance(each, str) else (each, "", "")
        yield first, last or first


def _periods_in_file(path: str | Path) -> Iterator[tuple[Any, Any]]:
    header, rows = csv_rows(path, _NO_HOLIDAYS)
    names = ("date", "date") if "date" in header else ("begin", "end")
    if not {*names} <= {*header}:
        raise InputError(
            "{}: {}", path, _NO_HOLIDAYS, hint="such as begin,end or date in its first row"
        )
    for number, row in rows:
        first, last = (text_in(row, name) for name in names)
        try:
            yield _date_of(first), _date_of(last or first)
        except UsageError as error:
            raise InputError("{}: {}", f"{path}, line {number}", error.message) from error


def _day_numbers_of(first: Any, last: Any) -> tuple[int, int]:
    low, high = ((_date_of(each) - date(1970, 1, 1)).days for each in (first, last))
    if not 0 <= high - low <= 366 * _LONGEST_YEARS:
        raise UsageError("holidays end on {}, before they begin on {}", last, first)
    return low, high


def _date_of(value: Any) -> date:
    if isinstance(value, date):
        return value.date() if isinstance(value, datetime) else value
    text = str(value).strip()
    if german := _GERMAN.fullmatch(text):
        text = f"{german[3]}-{german[2]:0>2}-{german[1]:0>2}"
    try:
        return date.fromisoformat(text)
    except ValueError as error:
        raise UsageError(
            "{} is no date", repr(value), hint="such as 2026-10-12, or 2026-10-12/2026-10-23"
        ) from error


@dataclass(frozen=True, kw_only=True, eq=False)
class AskedTime:
    """Quarters of an hour of the months that a question touches, and which of them it asks for.

    Parameters
    ----------
    first : int
        The first quarter since 1970; it begins a UTC date.
    month : (n,) int64 array
        Months, 12 x year + 0 to 11, by the clocks of the site.
    weekday, hour : (n,) int64 arrays
        Day of the week (0: Monday) and hour of the day, by these clocks.
    on_days : (n,) bool array
        Whether the quarters lie on the days of the week that are asked for.
    asked : (n,) bool array
        Whether they are asked for.
    measured : (n,) bool array
        Whether they lie between the first and the last measured hour.
    """

    first: int
    month: Integers
    weekday: Integers
    hour: Integers
    on_days: Booleans
    asked: Booleans
    measured: Booleans

    @classmethod
    def of(
        cls, span: Span, zone: str, days: str | None, holidays: Holidays, measured: Span
    ) -> Self:
        """Return the quarters of a span of steps.

        Parameters
        ----------
        span : (int, int)
            First and last step.
        zone : str
            Time zone of the site.
        days : str, optional
            Days of the week, such as `Mo-Fr`; by default all.
        holidays : str, Path or sequence, optional
            Dates that are left out, as for :func:`holiday_dates`.
        measured : (int, int)
            First and last step of what was measured.

        Raises
        ------
        UsageError
            If an end of the span lies within a quarter of an hour, or there are no such days.
        """
        ends = (span[0], span[1] + 1)
        for at, what in zip(ends, ("begin", "end"), strict=True):
            if at % STEPS_PER_QUARTER:
                raise UsageError(
                    "{} lies within a quarter of an hour", what, hint="such as 2026-10-12 07:15"
                )
        begin, end = (
            month_edges(pd.Timestamp(at * STEP_S, unit="s", tz=zone).strftime("%Y-%m"), zone)[k]
            for k, at in enumerate((ends[0], ends[1] - STEPS_PER_QUARTER))
        )
        begin, end = begin.tz_convert("UTC").floor("D"), end.tz_convert("UTC").ceil("D")
        clock = pd.date_range(begin, end, freq="15min", inclusive="left").tz_convert(zone)
        first = int(begin.timestamp() / QUARTER_S)
        step = (first + np.arange(len(clock))) * STEPS_PER_QUARTER
        date_of = clock.tz_localize(None).to_numpy().astype("datetime64[D]").astype(np.int64)
        weekday = np.asarray(clock.day_of_week, np.int64)
        on_days = np.isin(weekday, sorted(day_numbers(days)))
        inside = (step >= span[0]) & (step <= span[1])
        return cls(
            first=first, month=np.asarray(clock.year * 12 + clock.month - 1, np.int64),
            weekday=weekday, hour=np.asarray(clock.hour, np.int64), on_days=on_days,
            asked=inside & on_days & ~np.isin(date_of, holiday_dates(holidays)),
            measured=(step >= measured[0]) & (step <= measured[1]),
        )  # fmt: skip

    def months(self) -> Iterator[tuple[str, bool]]:
        """Yield the months with an asked quarter, and whether they are whole.

        A month is whole if all that was measured in it on the asked days of the week is asked for:
        its sums are then those of its roll-up over these days.
        """
        for number in np.unique(self.month[self.asked]).tolist():
            in_month = self.month == number
            whole = bool(((self.asked == self.on_days) | ~self.measured)[in_month].all())
            yield f"{number // 12}-{number % 12 + 1:02d}", whole

    def masks(self, month: str) -> dict[int, Booleans]:
        """Return the asked quarters of a month by the first hour of each UTC date."""
        year, number = map(int, month.split("-"))
        in_month = (self.asked & (self.month == 12 * year + number - 1)).reshape(
            -1, QUARTERS_PER_DAY
        )
        days = np.flatnonzero(in_month.any(axis=1))
        first_hour = self.first // QUARTERS
        return {int(first_hour + HOURS_PER_DAY * day): in_month[day] for day in days}
