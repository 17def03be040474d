"""The hour in which a lane loses most time, against sums made by hand."""

import pandas as pd

from gis_radar.city.site_month import worst_hours


def test_a_few_vehicles_at_night_are_not_the_worst_hour():
    """They wait longest each; the rush hour loses ten times as much. Weekends do not count."""
    sums = pd.DataFrame(
        {"lane": 1, "weekday": [0, 0, 0, 5], "hour": [0, 8, 17, 12], "quarters": 4,
         "volume": [3.0, 200.0, 240.0, 500.0], "delay_h": [0.03, 0.9, 1.2, 5.0]},
    )  # fmt: skip
    worst = worst_hours(sums)
    assert worst.loc[1, "worst_hour"] == 17
    assert worst.loc[1, "worst_delay_s"] == 1.2 / 240.0 * 3600.0


def test_an_hour_counts_by_the_days_that_are_known():
    """Seven is known on one day only, and loses more on it than eight on each of two."""
    sums = pd.DataFrame(
        {"lane": 1, "weekday": [0, 0, 1], "hour": [7, 8, 8], "quarters": 4, "volume": 100.0,
         "delay_h": [0.9, 0.6, 0.6]},
    )  # fmt: skip
    assert worst_hours(sums).loc[1, "worst_hour"] == 7


def test_a_lane_without_delay_has_no_worst_hour():
    sums = pd.DataFrame(
        {"lane": [1, 2], "weekday": 0, "hour": 8, "quarters": 4, "volume": [9.0, 0.0],
         "delay_h": [0.0, float("nan")]},
    )  # fmt: skip
    assert worst_hours(sums).empty
