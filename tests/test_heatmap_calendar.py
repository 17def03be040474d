"""Intervals that follow local time: parts of days and days, also where clocks change."""

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from datasets import measured
from hypothesis import given
from hypothesis import strategies as st
from sites import START, crossing, pose, recording

from gis_radar.base import UsageError, interval_steps, step_begin
from gis_radar.products import make_heatmap
from gis_radar.products.heatmap.intervals import local_intervals

BERLIN = ZoneInfo("Europe/Berlin")


def step_at(*date, zone=UTC):
    return (
        round((datetime(*date, tzinfo=zone) - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds())
        * 20
    )


def local_begins(timeline, zone=BERLIN):
    return [step_begin(int(step)).astimezone(zone) for step in timeline.begin]


@pytest.mark.parametrize(("day", "hours"), [((2026, 3, 29), 23), ((2026, 10, 25), 25)])
def test_days_on_which_clocks_change(day, hours):
    noon = step_at(*day, 12)
    (begin,) = local_begins(local_intervals(noon, noon, interval_steps("1d"), BERLIN))
    assert (begin.day, begin.hour) == (day[2], 0)
    first, last = step_at(*day, zone=BERLIN), step_at(*day, 23, 59, zone=BERLIN)
    each = local_intervals(first, last, interval_steps("1h"), BERLIN)
    assert len(each) == hours
    assert set((each.end - each.begin).tolist()) == {72_000}
    six = local_intervals(first, last, interval_steps("6h"), BERLIN)
    assert [begin.hour for begin in local_begins(six)] == [0, 6, 12, 18]


def test_weeks_begin_on_monday():
    week = local_intervals(
        step_at(2026, 11, 20), step_at(2026, 11, 20), interval_steps("7d"), BERLIN
    )
    (begin,) = local_begins(week)
    assert (begin.weekday(), begin.hour, begin.day) == (0, 0, 16)


@given(
    first=st.integers(0, 2 * 10**9),
    length=st.integers(0, 10 * 86400),
    interval=st.sampled_from(["30min", "1h", "90min", "2h", "6h", "12h", "1d", "7d"]),
    zone=st.sampled_from(["Europe/Berlin", "Asia/Kathmandu", "America/St_Johns", "UTC"]),
)
def test_intervals_cover_the_time_without_gap(first, length, interval, zone):
    first, last, steps = first * 20, (first + length) * 20, interval_steps(interval)
    found = local_intervals(first, last, steps, ZoneInfo(zone))
    assert found.begin[0] <= first < found.end[0]
    assert found.begin[-1] <= last < found.end[-1]
    assert (found.begin[1:] == found.end[:-1]).all()
    assert np.abs(found.end - found.begin - steps).max() <= 72_000
    for begin in local_begins(found, ZoneInfo(zone)):
        wall = timedelta(hours=begin.hour, minutes=begin.minute)
        assert wall % min(timedelta(seconds=steps / 20), timedelta(days=1)) == timedelta() or (
            begin.utcoffset() != (begin - timedelta(hours=24)).utcoffset()
        )


def test_in_utc_nothing_changes(tmp_path):
    path = recording(
        tmp_path / "r.parquet", START + np.arange(0, 9000, 60.0), [[12.25, 0, -5]] * 150
    )
    dataset = measured([path], [pose()], crossing(), tmp_path / "site")
    for interval in ("20min", "1h", "6h", "1d"):
        plain, local = (
            make_heatmap(dataset, interval=interval, timezone=zone).wide() for zone in (None, "UTC")
        )
        assert plain.drop(columns="geometry").equals(local.drop(columns="geometry"))
    half = make_heatmap(dataset, interval="1h", timezone="Asia/Kathmandu")
    assert {begin.minute for begin in half.long()["begin"]} == {15}
    assert half.long()["hit_s"].sum() == make_heatmap(dataset).wide()["hit_s"].sum()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"interval": "7h", "timezone": "Europe/Berlin"}, "parts of a day"),
        ({"interval": "1h", "timezone": "Europe/Bayern"}, "no time zone"),
        ({"timezone": "Europe/Bayern"}, "no time zone"),
    ],
)
def test_what_makes_no_sense(tmp_path, options, said):
    path = recording(tmp_path / "r.parquet", [START], [[12.25, 0.0, -5.0]])
    dataset = measured([path], [pose()], crossing(), tmp_path / "site")
    with pytest.raises(UsageError, match=said):
        make_heatmap(dataset, **options)
