"""Pictures of a report: what can be read on a phone, without colours, and in the reader's words."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as MplFigure

from gis_radar.base import Clock, label_map, legend_below
from gis_radar.products.heatmap import picture
from gis_radar.products.report import chart, maps, plan

PHONE_PX, LEAST_PX = 350, 10  # of a page 390 pixels wide, between its edges
LONELY = np.array([0.2, np.nan, 0.4]), np.array([0.1, np.nan, 0.1])


def test_the_band_of_a_lonely_interval_is_drawn():
    """Of a lane that is seen in one interval, then not."""
    strip = chart.strip_of("1", np.array([0.0, 0.25, 0.5, 1.0]), *LONELY)
    assert strip.line == "M0 80 250 80M500 60 1000 60"
    assert strip.band == "M0 70 250 70L250 90 0 90ZM500 50 1000 50L1000 70 500 70Z"
    assert strip.unseen == [(0.25, 0.25)]


def test_a_gap_between_intervals_is_not_seen():
    """Else the interval before it is as long as the gap."""
    hour = [datetime(2025, 6, 11, tzinfo=UTC) + timedelta(hours=each) for each in range(5)]
    edges, interval = chart.edges_of([(hour[0], hour[1]), (hour[3], hour[4])])
    assert (edges, interval) == ([hour[0], hour[1], hour[3], hour[4]], [0, -1, 1])


@pytest.mark.parametrize(
    ("minutes", "count", "begin", "labels"),
    [
        (15, 96, 22, ["00:00", "04:00", "08:00", "12:00", "16:00", "20:00", "00:00"]),
        (15, 96, 22.1, None),
        (60, 5, 7, ["09:00", "10:00", "11:00", "12:00", "13:00", "14:00"]),
    ],
)
def test_times_below_a_chart_are_round(minutes, count, begin, labels):
    first = datetime(2025, 6, 11, tzinfo=UTC) + timedelta(hours=begin)
    edges = [first + timedelta(minutes=minutes) * i for i in range(count + 1)]
    clock = Clock(zone=ZoneInfo("Europe/Berlin"), first=first, last=edges[-1], to_seconds=False)
    seconds = np.array([(each - first).total_seconds() for each in edges])
    times = chart.times_below(edges, seconds, clock)
    assert len(times) <= chart.MOST_TICKS + 1
    if labels is not None:
        assert [label.split("\n")[0] for _, label in times] == labels


@pytest.mark.parametrize("size_m", [(12.0, 90.0), (90.0, 12.0), (60.0, 60.0)])
def test_ticks_and_legend_of_a_map_are_clear_of_each_other(size_m):
    figure = MplFigure(figsize=(3.9, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    ax.scatter([0], [0], label="here")
    label_map(ax)
    ax.set(xlim=(677_940, 677_940 + size_m[0]), ylim=(5_403_600, 5_403_600 + size_m[1]))
    legend = legend_below(ax)
    figure.draw_without_rendering()
    boxes = [each.get_window_extent() for each in ax.get_xticklabels() if each.get_text()]
    low, high = ax.get_window_extent().x0 - 1, ax.get_window_extent().x1 + 1
    shown = [box for box in boxes if low <= (box.x0 + box.x1) / 2 <= high]
    assert shown
    assert all(one.x1 < other.x0 for one, other in pairwise(shown))
    assert legend.get_window_extent().y1 <= ax.xaxis.label.get_window_extent().y0 + 1


def test_words_in_pictures_can_be_read_on_a_phone():
    for letters_pt, width_in in (
        (plan.LETTERS_PT, picture.NARROW_IN),
        (7.0, picture.NARROW_IN),  # of the north arrow, the smallest of a map
        (8.0, maps.SIGHT_IN),
    ):
        assert letters_pt * PHONE_PX / (72.0 * width_in) >= LEAST_PX
