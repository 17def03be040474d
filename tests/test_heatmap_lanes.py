"""Heat maps by lane and by times of the site's clocks, against sums by pandas."""

from __future__ import annotations

from datetime import datetime

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from counted_sites import lane_tiles
from matplotlib.figure import Figure
from test_heatmap_occupancy import both_of

import gis_radar as gr
from gis_radar.base import moment_in, zone_of
from gis_radar.products.heatmap.intervals import intervals_at, local_intervals

BERLIN = zone_of("Europe/Berlin")


@pytest.fixture(scope="module")
def heat():
    tiles = lane_tiles(14).assign(lane=lambda table: np.where(table["lanelet_id"] == 7, 70, 90))
    return gr.make_heatmap(both_of(tiles, steps=400)[0], interval="5s", timezone="Europe/Berlin")


def by_pandas(heat, which):
    """Sum the tables of all tiles, as anybody would."""
    long = heat.long() if which is None else heat.long()[lambda t: t["begin"].isin(which)]
    lane = heat.tiles.set_index("tile_id")["lane"]
    sums = long.groupby(long["tile_id"].map(lane))[["occupied_s", "visible_s"]].sum()
    return sums["occupied_s"] / sums["visible_s"], sums["visible_s"]


def test_occupancy_by_lane_is_that_of_its_tiles(heat):
    table = heat.by_lane()
    share, visible_s = by_pandas(heat, None)
    assert table.index.tolist() == [70, 90]
    np.testing.assert_allclose(table["occupancy"], share)
    np.testing.assert_allclose(table["visible_s"], visible_s / [7, 7])
    np.testing.assert_allclose(table["occupancy"], table["occupied_s"] / table["visible_s"])
    known = heat.occupancy_shares()
    mine = (heat.tiles["lane"] == 70).to_numpy() & (known.visible_s > 0)
    mean = np.average(known.occupancy_se[mine], weights=known.visible_s[mine])
    assert table.loc[70, "occupancy_se"] == pytest.approx(mean)
    hits = heat.shares()
    mine = (heat.tiles["lane"] == 90).to_numpy()
    share = hits.hit_s[mine].sum() / hits.observed_s[mine].sum()
    assert table.loc[90, "hit_share"] == pytest.approx(share)


def test_each_interval_by_lane(heat):
    table = heat.by_lane(each=True)
    assert len(table) == 2 * len(heat.timeline)
    assert table.index.names == ["begin", "lane"]
    for begin in heat.times:
        share, _ = by_pandas(heat, [begin])
        np.testing.assert_allclose(table.loc[begin, "occupancy"], share)
        pd.testing.assert_frame_equal(table.loc[begin], heat.by_lane(begin))


def test_of_no_interval_the_columns_remain(heat):
    none, whole = heat.by_lane(slice(0, 0), each=True), heat.by_lane(each=True)
    pd.testing.assert_frame_equal(none, whole.iloc[:0])


def test_streets_and_lines_come_along(heat):
    line = shapely.LineString([(0, 0), (1, 1)])
    lanes = gpd.GeoDataFrame(
        {"lane": [70, 90, 95], "street": ["Ring", None, "Markt"]}, geometry=[line] * 3, crs=heat.crs
    )
    table = heat.by_lane(lanes=lanes)
    assert isinstance(table, gpd.GeoDataFrame)
    assert table.loc[70, "street"] == "Ring"
    assert table.crs == heat.crs
    assert len(heat.by_lane(each=True, lanes=lanes)) == 2 * len(heat.timeline)


# Times.


def test_times_are_by_the_clocks_of_the_site(heat):
    assert isinstance(heat.times, pd.DatetimeIndex)
    assert str(heat.times.tz) == "Europe/Berlin"
    assert list(heat.times) == [begin for begin, _ in heat.timeline.spans()]


@pytest.mark.parametrize("shift_s", [0.0, 2.0, 4.95])
def test_a_time_names_the_interval_that_holds_it(heat, shift_s):
    for number, begin in enumerate(heat.times):
        there = begin + pd.Timedelta(seconds=shift_s)
        naive = str(there.tz_localize(None))
        for time in (there, there.tz_convert("UTC"), there.isoformat(), naive):
            assert heat.chosen(time) == number
    assert heat.chosen(heat.times[1].tz_localize(None).to_numpy()) == 1


def test_begin_and_end_take_whole_intervals(heat):
    times = heat.times
    assert heat.chosen(begin=times[1]) == slice(1, len(times))
    assert heat.chosen(end=times[2]) == slice(0, 2)
    second = pd.Timedelta(seconds=1)
    assert heat.chosen(begin=times[0] + second, end=times[3] + second) == slice(1, 3)
    np.testing.assert_allclose(
        heat.by_lane(begin=times[1], end=times[3])["occupancy"], by_pandas(heat, times[1:3])[0]
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"interval": "2001-01-01 07:30"}, "no interval holds 2001-01-01 07:30:00"),
        ({"interval": "half past seven"}, "interval is 'half past seven', expected a time"),
        ({"interval": 99}, "interval 99 of"),
        ({"begin": "2101-01-01"}, "no interval lies between 2101-01-01 00:00:00"),
        ({"interval": 0, "begin": "2001-01-01"}, "do not go together"),
    ],
)
def test_times_that_are_refused(heat, options, words):
    with pytest.raises(gr.UsageError, match=words):
        heat.chosen(**options)


def test_the_hour_that_is_twice_needs_its_offset():
    for text, how in (("2025-10-26 02:30", "is twice"), ("2025-03-30 02:30", "is left out")):
        told = pytest.raises(gr.UsageError, match=f"which {how} that day in Europe/Berlin")
        with told as caught:
            moment_in(text, BERLIN, what="begin")
        assert set(caught.value.hint.split()) >= {"+01:00", "+02:00"}
    assert moment_in("2025-10-26 02:30+01:00", BERLIN, what="begin").hour == 1
    assert moment_in(datetime(2025, 7, 1, 12), BERLIN, what="begin").hour == 10  # noqa: DTZ001


def test_offsets_are_told_as_they_are_typed():
    zone = zone_of("America/New_York")
    with pytest.raises(gr.UsageError) as caught:
        moment_in("2025-11-02 01:30", zone, what="begin")
    typed = [word for word in caught.value.hint.split() if ":" in word]
    hours = [moment_in(f"2025-11-02 01:30{word}", zone, what="").hour for word in typed]
    assert hours == [5, 6]


@pytest.mark.parametrize("text", ["2025-10-26 24:00", "2025-10-26T24:00:00+01:00", "2025-10-27"])
def test_a_day_ends_at_24_as_pictures_say(text):
    assert moment_in(text, BERLIN, what="end").isoformat() == "2025-10-26T23:00:00+00:00"
    for none in ("2025-10-26 24:01", "2025-10-26 24:00:01", "9999-12-31 24:00", "0001-01-01"):
        with pytest.raises(gr.UsageError, match="expected a time"):
            moment_in(none, BERLIN, what="end")


def test_the_day_of_a_clock_change_has_25_hours():
    first = round(moment_in("2025-10-26", BERLIN, what="").timestamp() * 20)
    hours = local_intervals(first, first + 20 * 86_400, 72_000, BERLIN)
    day = intervals_at(hours, BERLIN, None, "2025-10-26", "2025-10-27")
    assert day == slice(0, 25)


def test_pictures_say_which_clocks(heat):
    ax = Figure().add_subplot()
    heat.plot(ax, interval=heat.times[1].tz_localize(None), legend=False)
    assert "(Europe/Berlin, UTC+0" in ax.get_title()
    heat.plot(ax, begin=heat.times[1], end=heat.times[3], legend=False)
    assert heat.times[1].strftime("%H:%M:%S") in ax.get_title()
    assert heat.times[3].strftime("%H:%M:%S") in ax.get_title()


def test_plots_speak_the_language_of_the_labels():
    tiles = lane_tiles(14)
    dataset, *_ = both_of(tiles)
    labels = gr.MapLabels(timezone="Europe/Berlin", language="de")
    heat = gr.make_heatmap(dataset, labels=labels)
    ax = heat.plot(Figure().add_subplot())
    assert " bis " in ax.get_title()
    assert ax.get_xlabel() == "Ostwert, m"
    legend = ax.get_legend()
    assert legend.get_title().get_text() == "Belegungsgrad"
    assert [text.get_text() for text in legend.get_texts()][-2:] == ["unsicher", "nicht einsehbar"]
