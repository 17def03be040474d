from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gis_radar.base import (
    InputError,
    UsageError,
    gps_seconds,
    interval_steps,
    iso_from_step,
    seconds_from_iso,
    step_of,
)


@given(start=st.integers(1_000_000_000, 2_000_000_000))
def test_frames_every_50_ms_have_consecutive_steps(start):
    steps = step_of(start + np.arange(2000) * 0.05)
    assert steps[0] == start * 20
    np.testing.assert_array_equal(np.diff(steps), 1)


@given(step=st.integers(0, 2**36))
def test_a_step_begins_where_its_iso_time_says(step):
    seconds = seconds_from_iso(iso_from_step(step), what="time")
    assert step_of(np.array([seconds]))[0] == step


def test_iso_text_is_utc():
    assert iso_from_step(1_700_000_000 * 20) == "2023-11-14T22:13:20Z"
    assert iso_from_step(1_700_000_000 * 20 + 1) == "2023-11-14T22:13:20.050Z"
    assert seconds_from_iso("2023-11-14T23:13:20+01:00", what="t") == 1_700_000_000


@pytest.mark.parametrize("text", ["2023-11-14T22:13:20", "yesterday", ""])
def test_a_time_without_zone_is_refused(text):
    with pytest.raises(InputError, match="--at"):
        seconds_from_iso(text, what="--at")


@pytest.mark.parametrize(
    ("text", "steps"), [("20s", 400), ("15min", 18_000), ("1h", 72_000), ("50ms", 1), ("0.5s", 10)]
)
def test_intervals(text, steps):
    assert interval_steps(text) == steps


@pytest.mark.parametrize("text", ["", "20", "s", "-5s", "0s", "30ms", "3 fortnights"])
def test_odd_intervals_are_refused(text):
    with pytest.raises(UsageError, match="interval"):
        interval_steps(text)


@pytest.mark.parametrize("text", ["999999999999999d", "36526d", "9" * 400 + "s"])
def test_intervals_longer_than_a_century_are_refused(text):
    assert interval_steps("36525d") == 36_525 * 86_400 * 20
    with pytest.raises(UsageError, match="longer than 100 years"):
        interval_steps(text)


@pytest.mark.parametrize("time", [1.7e12, 1.7e15, 1.7e18, 1e300, -6e9, np.inf, np.nan])
def test_times_that_no_step_holds_are_refused(time):
    with pytest.raises(InputError, match="outside the years 1800 to 2150") as caught:
        step_of(np.array([1.7e9, time]))
    assert "UNIX seconds" in caught.value.hint


def test_steps_before_1970_are_negative():
    np.testing.assert_array_equal(step_of(np.array([-3e9, -0.01, 0.0])), [-60_000_000_000, -1, 0])


@pytest.mark.parametrize(
    ("utc", "ahead"),
    [
        ("1975-01-01", 0), ("1980-01-06", 0), ("1981-06-30", 0), ("1981-07-01", 1),
        ("1998-12-31", 12), ("1999-01-01", 13), ("2005-12-31", 13), ("2006-01-01", 14),
        ("2009-01-01", 15), ("2012-07-01", 16), ("2015-06-30", 16), ("2015-07-01", 17),
        ("2016-12-31", 17), ("2017-01-01", 18), ("2026-11-20", 18),
    ],
)  # fmt: skip
def test_gps_runs_ahead_by_the_leap_seconds_so_far(utc, ahead):
    moment = datetime.fromisoformat(utc + "T00:00:00+00:00")
    seconds = (moment - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds()
    assert gps_seconds(np.array([moment.timestamp()]))[0] == seconds + ahead


def test_gps_seconds_of_a_published_moment():
    # GPS week 1930 began on Sunday 2017-01-01 00:00:00 GPS, 17 s before midnight UTC.
    begin = datetime(2016, 12, 31, 23, 59, 43, tzinfo=UTC).timestamp()
    assert gps_seconds(np.array([begin]))[0] == 1930 * 604_800
