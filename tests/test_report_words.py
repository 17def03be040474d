"""How a report writes numbers and times."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from types import SimpleNamespace
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from test_heatmap_occupancy import BEGIN

from gis_radar.base import (
    WINDS,
    Clock,
    Text,
    bearing_of,
    direction,
    figure_text,
    in_language,
    listed,
    localised,
    percent,
    tr,
    utc_offsets,
    wind_of,
)
from gis_radar.measures import Runs
from gis_radar.products.heatmap.intervals import HOUR
from gis_radar.products.report.basis import recorded_row


def at(*fields):
    return datetime(*fields, tzinfo=UTC)


def clock(first, last, zone="Europe/Berlin", **options):
    return Clock(zone=ZoneInfo(zone), first=first, last=last, **options)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (1234567.891, 1, "1\u202f234\u202f567.9"),
        (-0.5, 1, "\u22120.5"),
        (-0.04, 1, "0.0"),
        (math.nan, 1, "\u2013"),
        (0, 0, "0"),
    ],
)
def test_numbers(value, digits, text):
    assert figure_text(value, digits) == text


def test_a_little_is_not_nothing():
    assert percent(0.0) == "0.0\u202f%"
    assert percent(0.0004) == "under 0.1\u202f%"
    assert percent(0.0006) == "0.1\u202f%"
    assert percent(math.nan) == "\u2013"


def test_winds():
    assert direction(1.0, 0.1) == "east"
    assert direction(-1.0, -1.0) == "south-west"
    assert direction(0.0, 0.0) == "\u2013"
    turned = [np.deg2rad(90.0 - 45.0 * k) for k in range(8)]
    assert tuple(wind_of(np.cos(way), np.sin(way)) for way in turned) == WINDS
    assert wind_of(0.0, 0.0) == ""
    assert [bearing_of(wind) for wind in WINDS] == [45.0 * k for k in range(8)]
    assert listed(["a", "b", "c"]) == "a, b and c"


def test_one_day_is_not_named_again():
    day = clock(at(2025, 6, 12, 7), at(2025, 6, 12, 10), to_seconds=False)
    assert day.span(at(2025, 6, 12, 7), at(2025, 6, 12, 8)) == "09:00 to 10:00"
    assert day.long_span(day.first, day.last) == "12 June 2025, 09:00 to 12:00"
    assert day.name == "Europe/Berlin, UTC+02:00"


def test_a_day_ends_at_24():
    days = clock(at(2025, 6, 11, 22), at(2025, 6, 13, 22), to_seconds=False)
    whole_day = days.span(at(2025, 6, 11, 22), at(2025, 6, 12, 22))
    assert whole_day == "Thu 2025-06-12 00:00 to 24:00"


def test_an_hour_that_comes_twice_has_its_offset():
    autumn = clock(at(2025, 10, 25, 22), at(2025, 10, 26, 23), to_seconds=False)
    assert autumn.name == "Europe/Berlin, UTC+02:00 then UTC+01:00"
    before, after = (autumn.time(at(2025, 10, 26, hour)) for hour in (0, 1))
    assert before == "02:00 UTC+02:00"
    assert after == "02:00 UTC+01:00"
    long = clock(at(2025, 10, 25, 12), at(2025, 10, 26, 23), to_seconds=False)
    assert long.time(at(2025, 10, 26, 1)) == "Sun 2025-10-26 02:00 UTC+01:00"
    span = long.span(at(2025, 10, 26, 0), at(2025, 10, 26, 1))
    assert span == "Sun 2025-10-26 02:00 UTC+02:00 to 02:00 UTC+01:00"
    assert autumn.iso(at(2025, 10, 26, 1)) == "2025-10-26T02:00:00+01:00"


def test_the_time_of_all_data_has_its_offsets_where_clocks_change():
    night = clock(at(2025, 10, 26, 0, 59, 30), at(2025, 10, 26, 1, 0, 30))
    text = "26 October 2025, 02:59:30 UTC+02:00 to 02:00:30 UTC+01:00"
    assert night.long_span(night.first, night.last) == text


def test_times_in_messages_are_those_of_the_site():
    told = "no data from 2025-06-12T07:30Z to 2025-06-12T07:31:40.5Z, 3 times"
    local = "no data from 2025-06-12 09:30 UTC+02:00 to 2025-06-12 09:31:40.500 UTC+02:00, 3 times"
    assert localised(told, ZoneInfo("Europe/Berlin")) == local
    away = localised(Text("{:.1f} m to the {}", 1.2, Text("south")), ZoneInfo("Europe/Berlin"))
    with in_language("de"):  # a word among the values is still translated
        assert tr(away) == "1,2 m weiter Richtung Süd"


def test_offsets_hold_from_the_second_on_which_clocks_change():
    found = utc_offsets(ZoneInfo("Europe/Berlin"), at(2025, 3, 1), at(2025, 11, 1))
    changes = [at(2025, 3, 1), at(2025, 3, 30, 1), at(2025, 10, 26, 1)]
    assert found == list(zip(changes, [3600, 7200, 3600], strict=True))


def test_a_day_without_its_midnight():
    cairo = clock(at(2023, 4, 26), at(2023, 4, 29), zone="Africa/Cairo")
    night = cairo.span(at(2023, 4, 27, 21), at(2023, 4, 27, 22))
    assert night == "Thu 2023-04-27 23:00:00 UTC+02:00 to 01:00:00 UTC+03:00"


def test_parts_of_a_second_are_kept():
    day = clock(at(2025, 6, 12, 7), at(2025, 6, 12, 10))
    assert day.iso(at(2025, 6, 12, 7, 0, 0, 250_000)) == "2025-06-12T09:00:00.250+02:00"


@pytest.mark.parametrize(
    ("begin", "end", "text"),
    [
        (
            "2025-10-25T22:00Z", "2025-10-26T22:59:59.950Z",
            "26 October 2025, 00:00 UTC+02:00 to 24:00 UTC+01:00 (Europe/Berlin)",
        ),
        (
            "2025-06-10T22:00Z", "2025-06-12T22:00Z",
            "11 June 2025, 00:00, to 12 June 2025, 24:00 (Europe/Berlin, UTC+02:00)",
        ),
        (
            "2025-06-12T07:30Z", "2025-06-12T07:31:40.050Z",  # the last frame's step
            "12 June 2025, 09:30:00 to 09:31:40 (Europe/Berlin, UTC+02:00)",
        ),
        (
            "2025-06-12T07:30Z", "2025-06-12T07:30:00.300Z",
            "12 June 2025, 09:30:00 to 09:30:00.300 (Europe/Berlin, UTC+02:00)",
        ),
    ],
)  # fmt: skip
def test_a_whole_day_ends_at_24_and_names_each_offset_once(begin, end, text):
    first, last = (datetime.fromisoformat(each) for each in (begin, end))
    clock = Clock(zone=ZoneInfo("Europe/Berlin"), first=first, last=last)
    assert clock.long_span_in_zone(first, last) == text


@pytest.mark.parametrize(
    ("steps", "told"),
    [
        (24 * HOUR - 1, "Holds for this time, and not for other hours or days."),
        (23 * HOUR, "Less than a day: nothing about the hours that were not recorded."),
    ],
)
def test_a_recording_of_a_day_is_not_called_less(steps, told):
    """The last frame of a day begins before its end."""
    begin = BEGIN + np.zeros(1, np.int64)
    runs = Runs(first=begin, last=begin + steps - 1)
    dataset = SimpleNamespace(frame_steps=lambda *_: runs, sensors=["R1"])
    found = SimpleNamespace(
        results=SimpleNamespace(dataset=dataset),
        clock=clock(at(2025, 6, 12), at(2025, 6, 13)),
    )
    assert recorded_row(found)[2] == told
