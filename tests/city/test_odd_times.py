"""Hours in which far more time was lost than usual, beside those that only differ as hours do."""

from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest

from gis_radar.base import Clock
from gis_radar.city.month_tables import odd_table
from gis_radar.city.odd_times import odd_times_of
from gis_radar.city.site_month import SiteMonth

JAM = ["2026-10-14 15:00", "2026-10-14 16:00", "2026-10-14 17:00"]  # a Wednesday


def month(**beyond):
    """Give vehicle hours lost on lanes 7 and 8: most at the peaks, fewer at weekends."""
    hours = pd.date_range(
        "2026-10-01", "2026-11-01", freq="h", inclusive="left", tz="Europe/Berlin"
    )
    rng = np.random.default_rng(4)
    usual = np.where(np.isin(hours.hour, (7, 16, 17)), 6.0, 1.0)
    usual[hours.day_of_week >= 5] *= 0.4
    noise = np.exp(rng.normal(0.0, 0.15, (len(hours), 2)))
    lost = pd.DataFrame(usual[:, None] * noise * [0.6, 0.4], hours, [7, 8])
    for hour, more in beyond.items():
        lost.loc[pd.Timestamp(hour, tz="Europe/Berlin"), 8] += more
    return lost


def test_hours_that_differ_by_chance_are_not_odd():
    assert odd_times_of(month()) == []


def test_an_incident_of_three_hours_is_one_time_with_its_lane():
    lost = month(**dict.fromkeys(JAM, 15.0))
    (odd,) = odd_times_of(lost)
    assert (str(odd.begin)[:16], str(odd.end)[:16]) == (JAM[0], "2026-10-14 18:00")
    assert odd.lane == 8
    assert odd.lost_h == pytest.approx(lost.loc[odd.begin : odd.end].iloc[:3].to_numpy().sum())
    assert odd.usual_h == pytest.approx(1.0 + 6.0 + 6.0, rel=0.1)


def test_the_raised_hours_beside_an_odd_one_belong_to_it():
    raised = {"2026-10-14 14:00": 0.8, "2026-10-14 18:00": 0.8, "2026-10-20 11:00": 0.8}
    (odd,) = odd_times_of(month(**dict.fromkeys(JAM, 15.0), **raised))
    assert (str(odd.begin)[:16], str(odd.end)[:16]) == ("2026-10-14 14:00", "2026-10-14 19:00")


def test_a_weekend_is_measured_by_weekends():
    lost = month(**{"2026-10-17 11:00": 3.0})  # no more than at a peak of other days
    (odd,) = odd_times_of(lost)
    assert str(odd.begin)[:16] == "2026-10-17 11:00"
    assert odd.usual_h < 0.6


def test_of_few_days_nothing_is_usual():
    few = month(**dict.fromkeys(JAM, 15.0)).loc["2026-10-12":"2026-10-14"]
    assert odd_times_of(few) == []
    assert odd_times_of(few.iloc[:0]) == []


def test_lanes_that_were_not_visible_are_not_odd():
    lost = month()
    lost.iloc[40:90, 0] = np.nan
    assert odd_times_of(lost) == []


def test_the_table_has_the_worst_first_and_names_the_lane():
    one, two = (odd_times_of(month(**dict.fromkeys(JAM, more))) for more in (15.0, 40.0))
    lanes = pd.DataFrame({"lane": [7, 8], "name": ["Ring north, lane 1", "Ring south, lane 1"]})
    usual = {"link": "", "lines": [], "hours": 744, "lanes": lanes}
    sites = [
        SiteMonth(name="a", title="Market", odd_times=one, **usual),
        SiteMonth(name="b", title="Ring", odd_times=two, **usual),
    ]
    clock = Clock(
        zone=ZoneInfo("Europe/Berlin"), first=datetime(2026, 9, 30, 22, tzinfo=UTC),
        last=datetime(2026, 10, 31, 23, tzinfo=UTC), to_seconds=False,
    )  # fmt: skip
    table = odd_table(sites, clock)
    assert [(row[0], row[-1]) for row in table.rows] == [
        ("Ring", "Ring south, lane 1"), ("Market", "Ring south, lane 1"),
    ]  # fmt: skip
    assert odd_table([SiteMonth(name="c", title="c", **usual)], clock) is None
