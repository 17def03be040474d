"""Intervals: where they begin, what they are called, and what becomes of very many."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from counted_sites import T0, assert_like_oracle, lane_tiles, make_site, two_sensors
from maps import Listener

from gis_radar.base import STEPS_PER_SECOND
from gis_radar.products import make_heatmap
from gis_radar.products.heatmap.heatmap import NO_OCCUPANCY


def test_intervals_are_aligned_to_utc_and_contiguous():
    view = ("R1", "a")
    site = make_site(lane_tiles(1), {view: {T0 + 5, T0 + 1700}}, {view: {0}}, set())
    long = make_heatmap(site.dataset, interval="20s").long()
    assert long["begin"].dt.strftime("%H:%M:%S").tolist() == [
        "22:13:20", "22:13:40", "22:14:00", "22:14:20", "22:14:40",
    ]  # fmt: skip
    assert str(long["begin"].dtype) == "datetime64[ms, UTC]"
    assert (long["end"] - long["begin"] == pd.Timedelta("20s")).all()
    assert long["observed_s"].tolist() == [0.05, 0.0, 0.0, 0.0, 0.05]
    assert long["hit_s"].fillna(-1).tolist() == [0.0, -1.0, -1.0, -1.0, 0.0]


@pytest.mark.parametrize(
    ("interval", "name"),
    [
        ("15min", "hit_20231114T2200"),
        ("20s", "hit_20231114T221320"),
        ("250ms", "hit_20231114T221320250"),
    ],
)
def test_interval_columns_are_named_by_their_begin(interval, name):
    view = ("R1", "a")
    site = make_site(lane_tiles(1), {view: {T0 + 5}}, {view: {0}}, {(T0 + 5, 0)})
    wide = make_heatmap(site.dataset, interval=interval).wide()
    assert [column for column in wide if column.startswith("hit_2")] == [name]
    assert wide[name].tolist() == [0.05]


def test_long_layer_has_a_row_for_every_tile_and_interval():
    site = two_sensors()
    heatmap = make_heatmap(site.dataset, interval="5s")
    long = heatmap.long()
    assert len(long) == len(site.tiles) * 4
    assert (
        long.groupby("begin")["tile_id"].apply(list).map(lambda ids: ids == list(range(16))).all()
    )
    assert (long["hit_s"] == 0.0).any()
    assert long["hit_share"].isna().equals(long["observed_s"] == 0.0)
    assert long.crs == site.tiles.crs
    wide = heatmap.wide()
    begins = [column for column in wide if column.startswith("hit_2")]
    assert np.array_equal(
        wide[begins].to_numpy().T.ravel(), long["hit_s"].to_numpy(), equal_nan=True
    )


def test_more_than_500_intervals_are_rows_only():
    view = ("R1", "a")
    site = make_site(lane_tiles(2), {view: set(range(T0, T0 + 501))}, {view: {0}}, {(T0 + 3, 0)})
    remarks = Listener()
    heatmap = make_heatmap(site.dataset, interval="50ms", reporter=remarks)
    assert remarks.lines[1:] == [NO_OCCUPANCY]
    assert "501 intervals" in remarks.lines[0]
    assert "by_interval" in remarks.lines[0]
    assert not [column for column in heatmap.wide() if column.startswith("hit_2")]
    assert len(heatmap.columns) == 0
    assert len(heatmap.long()) == 1002
    assert_like_oracle(site, heatmap)


def test_500_intervals_are_columns():
    view = ("R1", "a")
    site = make_site(lane_tiles(1), {view: set(range(T0, T0 + 500))}, {view: {0}}, set())
    assert len(make_heatmap(site.dataset, interval="50ms").columns) == 500


@pytest.mark.parametrize(("apart", "kept"), [(19, [*range(20)]), (20, [0, 20]), (168, [0, 168])])
def test_an_outage_is_kept_and_a_week_between_two_hours_is_not(apart, kept):
    view, hour = ("R1", "a"), 3600 * STEPS_PER_SECOND
    first = T0 // hour * hour
    steps = {first + 7, first + apart * hour}
    site = make_site(lane_tiles(1), {view: steps}, {view: {0}}, {(first + 7, 0)})
    heatmap = make_heatmap(site.dataset, interval="1h", reporter=Listener())
    assert ((heatmap.timeline.begin - first) // hour).tolist() == kept
    assert len(heatmap.columns) == len(kept)


def test_many_intervals_without_frames_are_left_out():
    view = ("R1", "a")
    steps = {T0, T0 + 1, T0 + 399, T0 + 400, T0 + 401, T0 + 10_000_000}
    site = make_site(lane_tiles(1), {view: steps}, {view: {0}}, {(T0 + 400, 0)})
    heatmap = make_heatmap(site.dataset, interval="20s", reporter=Listener())
    assert (heatmap.timeline.begin - T0).tolist() == [0, 400, 10_000_000]
    assert len(heatmap.columns) == 3
    assert_like_oracle(site, heatmap)
