"""What a heat map counts, against sets of steps counted one by one."""

from __future__ import annotations

import json

import numpy as np
import pytest
from counted_sites import (
    T0,
    assert_like_oracle,
    lane_tiles,
    make_site,
    two_sensors,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gis_radar.base import InputError
from gis_radar.products import make_heatmap


@pytest.mark.parametrize("interval", ["1.5s", "7s", "15min"])
def test_counts_are_those_of_the_oracle(interval):
    site = two_sensors()
    assert_like_oracle(site, make_heatmap(site.dataset, interval=interval))


steps = st.sets(st.integers(T0, T0 + 60), max_size=40)
keys = st.sampled_from([("R1", "a"), ("R1", "b"), ("R2", "a")])


@given(
    delivered=st.dictionaries(keys, steps, min_size=1),
    seen=st.dictionaries(keys, st.sets(st.integers(0, 5)), min_size=1),
    hit=st.sets(st.tuples(st.integers(T0 - 2, T0 + 62), st.integers(0, 5))),
    interval=st.sampled_from([None, "50ms", "250ms", "1s", "1h"]),
)
@settings(max_examples=25, suppress_health_check=[HealthCheck.filter_too_much])
def test_any_views_frames_and_hits_count_as_in_the_oracle(delivered, seen, hit, interval):
    site = make_site(lane_tiles(6), delivered, seen, hit)
    if not any(delivered.values()) or not any(seen.values()):
        with pytest.raises(InputError):
            make_heatmap(site.dataset, interval=interval)
        return
    heatmap = make_heatmap(site.dataset, interval=interval)
    assert_like_oracle(site, heatmap)
    assert np.nanmax(np.append(heatmap.long()["hit_share"], 0.0)) <= 1.0


def test_225_of_2000_steps_are_11_25_seconds():
    tiles = lane_tiles(2)
    view = ("R1", "a")
    hit = {(T0 + 7 * k, 1) for k in range(225)}
    site = make_site(tiles, {view: set(range(T0, T0 + 2000))}, {view: {0, 1}}, hit)
    row = make_heatmap(site.dataset).wide().iloc[1]
    assert row["hit_s"] == 11.25
    assert row["observed_s"] == 100.0
    assert row["hit_share"] == 0.1125


def test_overlapping_views_never_count_twice():
    both = {("R1", "a"): {T0, T0 + 1}, ("R2", "a"): {T0 + 1, T0 + 2}}
    site = make_site(lane_tiles(1), both, {key: {0} for key in both}, {(T0 + 1, 0)})
    shares = make_heatmap(site.dataset).shares()
    assert shares.observed_s[0] == 0.15
    assert shares.hit_s[0] == 0.05


def test_the_map_of_one_moment():
    site = two_sensors()
    heatmap = make_heatmap(site.dataset, at="2023-11-14T22:13:21.02Z")
    assert_like_oracle(site, heatmap)
    assert (int(heatmap.whole.begin[0]), int(heatmap.whole.end[0])) == (T0 + 20, T0 + 21)
    local = make_heatmap(site.dataset, at="2023-11-14 23:13:21.02", timezone="Europe/Berlin")
    assert local.whole.begin == heatmap.whole.begin
    assert set(heatmap.wide()["hit_s"].dropna()) == {0.0, 0.05}
    assert len(heatmap.long()) == len(site.tiles)


def test_inputs_are_not_changed_and_other_columns_are_left():
    site = two_sensors()
    tiles = site.tiles.rename_geometry("geom").assign(hit_s=1.0, note="x")
    before = tiles.copy()
    wide = make_heatmap(site.dataset).wide()
    assert tiles.equals(before)
    assert "note" not in wide
    assert wide.geometry.name == "geometry"


def test_repr_says_the_time_of_the_site_and_ranks_nothing_by_hits():
    site = two_sensors()
    text = repr(make_heatmap(site.dataset, interval="5s", timezone="Europe/Berlin"))
    assert "HeatMap(2023-11-14T23:13:20+01:00 to 2023-11-14T23:13:40+01:00 (Europe/Berlin)" in text
    assert "4 intervals" in text
    assert "13 of 16 tiles observed" in text
    assert "busiest" not in text
    empty = make_site(site.tiles, {("R1", "a"): {T0}}, {("R1", "a"): {0}}, set())
    assert "(UTC), 1 interval, 1 of 16 tiles observed, 0 hit)" in repr(make_heatmap(empty.dataset))


def test_a_heat_maps_card_shows_the_time_of_the_site():
    site = two_sensors()
    page = make_heatmap(site.dataset, timezone="Europe/Berlin")._repr_html_()
    assert "2023-11-14T23:13:20+01:00" in page
    assert "Europe/Berlin" in page
    assert "busiest" not in page


def test_figures_are_plain_numbers_and_text():
    tiles, view = lane_tiles(2), ("R1", "a")
    site = make_site(tiles, {view: set(range(T0, T0 + 40))}, {view: {0, 1}}, {(T0 + 3, 1)})
    figures = make_heatmap(site.dataset, interval="1s").figures()
    assert json.loads(json.dumps(figures)) == {
        "begin": "2023-11-14T22:13:20Z",
        "end": "2023-11-14T22:13:22Z",
        "intervals": 2,
        "tiles_observed": 2,
        "tiles_hit": 1,
    }
