"""Time: UTC throughout, and the 50 ms steps that all sensors share."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import groupby
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from gis_radar.base.arrays import Booleans, Floats, Integers
from gis_radar.base.errors import InputError, UsageError
from gis_radar.base.texts import Text
from gis_radar.base.words import MINUS, long_day, short_day, tr, weekday

STEP_US = 50_000  # the nominal cycle of the sensors, 20 Hz
STEP_S = 0.05
STEPS_PER_SECOND = 20
STEPS_PER_HOUR = 3600 * STEPS_PER_SECOND
TRACK_EVERY_STEPS = 4
"""Steps between two states of a vehicle that are kept; its first and last are kept, too."""

SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 0.001, 2.0  # of any radar; beyond, a unit is mistaken
CYCLE_HINT = Text(
    "a cycle is stated, such as 150ms, and never measured; without one, frames are valid for 100 ms"
)

# Nanosecond time stamps hold 1677 to 2262; the longest interval fits in on either side.
FIRST_YEAR, LAST_YEAR = 1800, 2150
_LONGEST_INTERVAL_YEARS = 100
UNIX_SECONDS_HINT = Text("times are UNIX seconds (UTC), not milli-, micro- or nanoseconds")

CLOCK_SET_S = 631_152_000.0  # 1990-01-01: earlier times count from when the sensor was switched on
_GPS_EPOCH_S = 315_964_800  # 1980-01-06
# GPS time ahead of UTC, by the leap seconds of IERS Bulletin C since the epoch of GPS.
_LEAP_DATES = (
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01",
    "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01",
    "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
)  # fmt: skip
_LEAPS_S = np.array(_LEAP_DATES, dtype="datetime64[s]").astype(np.float64)

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FIRST_S = (datetime(FIRST_YEAR, 1, 1, tzinfo=UTC) - _EPOCH).total_seconds()
_END_S = (datetime(LAST_YEAR + 1, 1, 1, tzinfo=UTC) - _EPOCH).total_seconds()
_LONGEST_INTERVAL_S = _LONGEST_INTERVAL_YEARS * 365.25 * 86400
_UTC_TEXT = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d(?::\d\d(?:\.\d+)?)?Z")
_UNITS_S = {"ms": 0.001, "s": 1, "sec": 1, "min": 60, "h": 3600, "d": 86400}


def step_of(time: Floats) -> Integers:
    """Return the step of each time.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, float64. Rounded to microseconds first, because float64 resolves
        no finer at today's times and a frame at `1.7e9 + k * 0.05` must not fall short.

    Returns
    -------
    (n,) int64 array
        `round(time * 1e6) // 50_000`.

    Raises
    ------
    InputError
        If a time is no number or lies outside the years that are known.
    """
    time = np.asarray(time)
    known = in_known_years(time)
    if not known.all():
        raise InputError(
            "time {:g} is outside the years {} to {}",
            time[~known].flat[0],
            FIRST_YEAR,
            LAST_YEAR,
            hint=UNIX_SECONDS_HINT,
        )
    return np.rint(time * 1e6).astype(np.int64) // STEP_US


def in_known_years(time: Floats) -> Booleans:
    """Return which times (UNIX seconds) are in the years that steps and time stamps cover."""
    return (time >= _FIRST_S) & (time < _END_S)


def gps_seconds(time: Floats) -> Floats:
    """Return times as GPS seconds, which run on through leap seconds.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, UTC.

    Returns
    -------
    (n,) array
        Seconds since 1980-01-06; negative before, where GPS time is UTC carried on backwards.
        Leap seconds to come are unknown: the offset stays that of 2017.
    """
    leaps = np.searchsorted(_LEAPS_S, time, side="right")
    return np.asarray(time - _GPS_EPOCH_S + leaps, dtype=np.float64)


def step_begin(step: int) -> datetime:
    """Return when a step begins, UTC."""
    return _EPOCH + timedelta(microseconds=step * STEP_US)


def iso_from_step(step: int) -> str:
    """Return the begin of a step as ISO 8601 text with `Z`, no finer than needed."""
    text = step_begin(step).isoformat(timespec="milliseconds").removesuffix("+00:00")
    return text.removesuffix(".000") + "Z"


def iso_from_time(time: datetime) -> str:
    """Return a time with its zone as ISO 8601 text with `Z`, in whole seconds."""
    return f"{time.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"


def seconds_from_iso(text: str, *, what: str) -> float:
    """Return UNIX seconds of an ISO 8601 time with its offset from UTC.

    Raises
    ------
    InputError
        If it is no time, or leaves open in which zone it is.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(
            "{} is {}, expected a time such as 2026-11-20T09:00:00Z", what, repr(text)
        ) from error
    if moment.tzinfo is None:
        raise InputError(
            "{} is {}, which names no time zone", what, repr(text), hint="add Z for UTC"
        )
    return (moment - _EPOCH) / timedelta(seconds=1)


def moment_in(value: Any, zone: ZoneInfo, *, what: str) -> datetime:
    """Return a time in UTC; one without an offset is local time of a zone.

    Parameters
    ----------
    value : str, datetime or numpy.datetime64
        A time such as `2025-06-12 07:30`, or `2025-06-12T05:30Z`; 24:00 is the end of a day.
    zone : ZoneInfo
        Zone of a time without an offset.
    what : str
        Name of the time, for messages.

    Raises
    ------
    UsageError
        If it is no time, or the clocks of the zone show it twice or never.
    """
    try:
        moment = value if isinstance(value, datetime) else _moment(str(value))
        if moment.tzinfo is not None:
            return moment.astimezone(UTC)
        both = [moment.replace(tzinfo=zone, fold=fold) for fold in (0, 1)]
        in_utc = both[0].astimezone(UTC)
    except (ValueError, OverflowError) as error:  # the latter at both ends of the calendar
        raise UsageError(
            "{} is {}, expected a time such as 2026-11-20 09:00", what, repr(str(value))
        ) from error
    if both[0].utcoffset() != both[1].utcoffset():
        is_shown = in_utc.astimezone(zone).replace(tzinfo=None) == moment
        which_fault = Text("is twice") if is_shown else Text("is left out")
        earlier, later = (_offset(each)[3:].replace(MINUS, "-") for each in both)  # to be typed
        raise UsageError(
            "{} is {}, which {} that day in {}",
            what,
            moment,
            which_fault,
            zone,
            hint=Text("add the offset, {} or {}", earlier, later),
        )
    return in_utc


def _moment(text: str) -> datetime:
    """Return an ISO 8601 time; Python reads 24:00, the end of a day, from version 3.14 on."""
    begin_of_day = re.sub(r"(?<=^.{10}[ T])24(?=:00(?:$|[Z+-]|:00(?:$|[Z+-])))", "00", text)
    return datetime.fromisoformat(begin_of_day) + timedelta(days=begin_of_day != text)


def step_at(value: Any, zone: ZoneInfo, *, what: str) -> int:
    """Return the first step that begins at or after a time, given as in :func:`moment_in`."""
    return -(round(-moment_in(value, zone, what=what).timestamp() * 1e6) // STEP_US)


def duration_s(text: str, *, what: str = "time") -> float:
    """Return the seconds of a duration such as `57ms`, `20s`, `15min` or `1h`.

    Raises
    ------
    UsageError
        If it is no duration.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-z]+)\s*", str(text).lower())
    if match is None or match[2] not in _UNITS_S:
        raise UsageError("{} {} is no duration", what, repr(text), hint="e.g. 20s, 15min, 1h")
    return float(match[1]) * _UNITS_S[match[2]]


def interval_steps(text: str) -> int:
    """Return the length of an interval such as `20s`, `15min` or `1h` in steps.

    Raises
    ------
    UsageError
        If it is no duration, not a whole number of 50 ms steps, or over 100 years long.
    """
    seconds = duration_s(text, what="interval")
    if seconds > _LONGEST_INTERVAL_S:
        raise UsageError("interval {} is longer than {} years", repr(text), _LONGEST_INTERVAL_YEARS)
    steps = seconds * STEPS_PER_SECOND
    if steps < 1 or abs(steps - round(steps)) > 1e-6:
        raise UsageError("interval {} is not a whole number of 50 ms steps", repr(text))
    return round(steps)


def zone_of(name: str) -> ZoneInfo:
    """Return a time zone by its name, such as Europe/Berlin.

    Raises
    ------
    UsageError
        If there is none of that name.
    """
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError) as error:
        raise UsageError(
            "there is no time zone {}", repr(name), hint="a name such as Europe/Berlin or UTC"
        ) from error


def utc_offsets(zone: ZoneInfo, begin: datetime, end: datetime) -> list[tuple[datetime, int]]:
    """Return (time, offset from UTC in seconds) wherever the offset changes, first at `begin`."""

    def offset_at(moment: datetime) -> int:
        return round((moment.astimezone(zone).utcoffset() or timedelta()).total_seconds())

    offsets, at = [(begin, offset_at(begin))], begin
    while at < end:
        after = min(at + timedelta(hours=6), end)  # no zone changes twice within it
        if offset_at(after) != offsets[-1][1]:
            low, high = at, after
            while high - low > timedelta(seconds=1):
                middle = low + (high - low) / 2
                low, high = (middle, high) if offset_at(middle) == offsets[-1][1] else (low, middle)
            offsets.append((high.replace(microsecond=0), offset_at(after)))
        at = after
    return offsets


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Formatter of times as local times of a site.

    Parameters
    ----------
    zone : ZoneInfo
        The site's.
    first, last : datetime
        All times written are between these; days and offsets are named only where they differ
        in between.
    to_seconds : bool
        Whether times name their seconds.
    """

    zone: ZoneInfo
    first: datetime
    last: datetime
    to_seconds: bool = True

    @property
    def name(self) -> str:
        """The zone with its offset from UTC; with both offsets where clocks change in between."""
        if str(self.zone) == "UTC":
            return "UTC"
        return f"{self.zone}, {tr(' then ').join(self._offsets)}"

    def date(self, moment: datetime) -> str:
        """Return the day."""
        return long_day(self._local(moment))

    def time(self, moment: datetime) -> str:
        """Return day (where there are several), time of day, offset (where it changes)."""
        local = self._local(moment)
        text = _clock_text(local)
        if not (self.to_seconds or local.second or local.microsecond):
            text = f"{local:%H:%M}"
        if self._changes:
            text += f" {_offset(local)}"
        return text if self._one_day else f"{weekday(local)} {self.day(moment)} {text}"

    def day(self, moment: datetime) -> str:
        """Return the day, short."""
        return short_day(self._local(moment))

    def stamp(self, moment: datetime) -> str:
        """Return day (always), time to the minute, and the offset where it changes."""
        local = self._local(moment)
        return f"{short_day(local)} {local:%H:%M}" + (f" {_offset(local)}" if self._changes else "")

    def tick(self, moment: datetime, first: datetime) -> str:
        """Return a time below a chart that begins at `first`: the day where it is a new one."""
        local = self._local(moment)
        text = _clock_text(local) if self.to_seconds else f"{local:%H:%M}"
        new = moment == first or text.startswith("00:00")
        return f"{text}\n{self.day(moment)}" if new and not self._one_day else text

    def span(self, begin: datetime, end: datetime) -> str:
        """Return an interval; its end without the day where it ends on the day it begins."""
        until = self.time(end)
        last = end - timedelta(microseconds=1)
        if self._local(begin).date() == self._local(last).date():
            until = until if self._one_day else until.split(" ", 2)[2]
            if until.startswith("00:") and self._local(end).date() != self._local(last).date():
                until = f"24:{until.removeprefix('00:')}"
        return tr("{begin} to {end}", begin=self.time(begin), end=until)

    def long_span(self, begin: datetime, end: datetime) -> str:
        """Return a span for a sentence; with milliseconds only where it is under 10 s."""
        if end - begin >= timedelta(seconds=10):
            begin, end = _to_second(begin), _to_second(end)
        since, until = (_clock_text(self._local(each)) for each in (begin, end))
        last = end
        if until == "00:00:00" and end > begin:
            until, last = "24:00:00", end - timedelta(microseconds=1)
        if since.endswith(":00") and until.endswith(":00") and end - begin >= timedelta(hours=1):
            since, until = since[:-3], until[:-3]
        if self._changes:
            since, until = (
                f"{since} {_offset(self._local(begin))}",
                f"{until} {_offset(self._local(end))}",
            )
        if self._is_in_one_day(begin, end):
            return tr("{day}, {begin} to {end}", day=self.date(begin), begin=since, end=until)
        days = {"day": self.date(begin), "last": self.date(last)}
        return tr("{day}, {begin}, to {last}, {end}", begin=since, end=until, **days)

    def long_span_in_zone(self, begin: datetime, end: datetime) -> str:
        """Return a span as :meth:`long_span` does, with the zone; the offset is written once."""
        zone = str(self.zone) if self._changes else self.name
        return f"{self.long_span(begin, end)} ({zone})"

    def iso(self, moment: datetime) -> str:
        """Return local time as ISO 8601, with its offset."""
        local = self._local(moment)
        return local.isoformat(timespec="milliseconds" if local.microsecond else "seconds")

    @property
    def _one_day(self) -> bool:
        return self._is_in_one_day(self.first, self.last)

    def _is_in_one_day(self, begin: datetime, end: datetime) -> bool:
        """Return whether a span lies within one local day; it may end at midnight."""
        last = end - timedelta(microseconds=1)
        return self._local(begin).date() == self._local(last).date()

    @cached_property
    def _offsets(self) -> list[str]:
        """Offsets from UTC between `first` and `last`, in order: one may come again."""
        days = range((self.last - self.first).days + 1)
        moments = [*(self.first + timedelta(days=day) for day in days), self.last]
        return [offset for offset, _ in groupby(_offset(self._local(each)) for each in moments)]

    @property
    def _changes(self) -> bool:
        return len(self._offsets) > 1

    def _local(self, moment: datetime) -> datetime:
        return moment.astimezone(self.zone)


def long_span(begin: datetime, end: datetime, zone: ZoneInfo) -> str:
    """Return a span for a sentence, by the clocks of a zone, which is named."""
    return Clock(zone=zone, first=begin, last=end).long_span_in_zone(begin, end)


def localised(text: str, zone: ZoneInfo) -> str:
    """Return a text in which UTC times (ending in Z) are replaced by local times."""
    if isinstance(text, Text) and text.values:
        values = (localised(v, zone) if isinstance(v, str) else v for v in text.values)
        return Text(text.template, *values)
    local = _UTC_TEXT.sub(lambda found: _local_stamp(found[0], zone), text)
    return text if local == text else local  # a word without values keeps its template


def _local_stamp(text: str, zone: ZoneInfo) -> str:
    local = datetime.fromisoformat(text).astimezone(zone)
    clock = _clock_text(local) if text.count(":") > 1 else f"{local:%H:%M}"
    return f"{short_day(local)} {clock} {_offset(local)}"


def _clock_text(local: datetime) -> str:
    """Return the time of day to the second, or to the millisecond where it has some."""
    milliseconds = local.microsecond // 1000
    return f"{local:%H:%M:%S}" + (f".{milliseconds:03d}" if milliseconds else "")


def _to_second(moment: datetime) -> datetime:
    """Return the nearest whole second."""
    return (moment + timedelta(milliseconds=500)).replace(microsecond=0)


def _offset(local: datetime) -> str:
    minutes = round((local.utcoffset() or timedelta()).total_seconds() / 60)
    sign = MINUS if minutes < 0 else "+"
    return f"UTC{sign}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}"
