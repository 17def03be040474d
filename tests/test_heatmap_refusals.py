"""What a heat map is not made of: each refusal is one clear line."""

from __future__ import annotations

import pytest
from counted_sites import T0, lane_tiles, make_site, two_sensors

from gis_radar.base import InputError, UsageError
from gis_radar.products import make_heatmap


def test_too_many_rows_are_refused():
    view = ("R1", "a")
    site = make_site(lane_tiles(2000), {view: set(range(T0, T0 + 60_000))}, {view: {0}}, set())
    with pytest.raises(UsageError, match="more than a heat map can hold") as caught:
        make_heatmap(site.dataset, interval="50ms")
    assert "longer interval" in caught.value.hint


def test_a_moment_without_frames_names_the_nearest_step():
    view = ("R1", "a")
    site = make_site(lane_tiles(1), {view: {T0, T0 + 30}}, {view: {0}}, set())
    with pytest.raises(InputError, match="no sensor delivered a frame") as caught:
        make_heatmap(site.dataset, at="2023-11-14T22:13:21.00Z")
    assert "2023-11-14T22:13:21.500Z" in caught.value.hint


def test_a_time_without_frames_tells_when_there_are_some():
    view = ("R1", "a")
    dataset = make_site(lane_tiles(1), {view: {T0, T0 + 30}}, {view: {0}}, set()).dataset
    with pytest.raises(InputError, match=r"frame from 2023-11-14T23:00:00Z to its end") as caught:
        make_heatmap(dataset, begin="2023-11-14T23:00Z")
    assert "from 2023-11-14T22:13:20Z to 2023-11-14T22:13:21.550Z" in caught.value.hint
    with pytest.raises(UsageError, match="expected ascending times"):
        make_heatmap(dataset, begin="2023-11-14T23:00Z", end="2023-11-14T22:00Z")


def test_interval_and_moment_exclude_each_other():
    site = two_sensors()
    with pytest.raises(UsageError, match="at and interval"):
        make_heatmap(site.dataset, at="2023-11-14T22:13:21Z", interval="1s")


def test_a_dataset_without_frames_or_sight_is_refused():
    tiles = lane_tiles(2)
    with pytest.raises(InputError, match="no frame"):
        make_heatmap(make_site(tiles, {}, {("R1", "a"): {0}}, set()).dataset)
    with pytest.raises(InputError, match="no sensor sees"):
        make_heatmap(make_site(tiles, {("R1", "a"): {T0}}, {}, set()).dataset)


def test_unknown_tiles_are_refused():
    site = make_site(lane_tiles(2), {("R1", "a"): {T0}}, {("R1", "a"): {0, 5}}, set())
    with pytest.raises(InputError, match="tile 5"):
        make_heatmap(site.dataset)
