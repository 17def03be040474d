"""Tracks for other programs: points, and MovingPandas."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from driven import FIRST, drive, driven, straight_tiles
from test_vehicles_layer import CARS

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return driven(tmp_path_factory.mktemp("cars") / "dataset", straight_tiles(), CARS)


def sampled(apart=10):
    return CARS[CARS["step"] % apart == 0].sort_values(["step", "vehicle"])


@pytest.mark.parametrize(("every", "apart"), [("500ms", 10), ("50ms", 1), ("1s", 20)])
def test_points_are_the_states(dataset, every, apart):
    points, wanted = dataset.track_points(every=every), sampled(apart)
    assert points["vehicle"].tolist() == wanted["vehicle"].tolist()
    np.testing.assert_allclose(points.geometry.x, wanted["easting"], atol=1e-9)
    times = points.index.tz_convert(None).to_numpy().astype("datetime64[ms]").astype(np.int64)
    assert (times // 50).tolist() == wanted["step"].tolist()
    assert str(points.index.tz) == "UTC"
    assert set(points["length_m"]) == {4.5}


def test_a_span_by_the_clocks_of_the_site(dataset):
    points = dataset.track_points(every="50ms")
    low, high = points.index[4], points.index[-6]
    assert low < high
    local = [str(each.tz_convert("Asia/Kolkata").tz_localize(None)) for each in (low, high)]
    there = replace(dataset, manifest=replace(dataset.manifest, timezone="Asia/Kolkata"))
    part = there.track_points(every="50ms", begin=local[0], end=local[1])
    pd.testing.assert_frame_equal(part, points[(points.index >= low) & (points.index < high)])


def test_a_vehicle_that_goes_on_over_an_hours_begin_is_one(tmp_path):
    """It has two numbers in the dataset; in the table it has the first."""
    edge = (FIRST // STEPS_PER_HOUR + 1) * STEPS_PER_HOUR
    whole = drive(3, edge - 50, 0.5 * np.arange(100))
    halves = whole.assign(vehicle=np.where(whole["step"] < edge, 3, 4))
    other = drive(9, edge + 2, np.arange(9.0))
    dataset = driven(
        tmp_path / "dataset", straight_tiles(), pd.concat([halves, other]),
        continued={edge // STEPS_PER_HOUR: [(3, 4)]},
    )  # fmt: skip
    points = dataset.track_points(every="50ms")
    mine = points[points["vehicle"] == 3]
    np.testing.assert_allclose(mine.geometry.x, whole["easting"], atol=1e-9)
    assert points["vehicle"].value_counts().to_dict() == {3: 100, 9: 9}


@pytest.mark.filterwarnings("ignore::DeprecationWarning:movingpandas")
@pytest.mark.filterwarnings("ignore:The inplace keyword")
def test_moving_pandas_measures_the_ways(dataset):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    found = dataset.to_trajectories()
    assert sorted(each.id for each in found) == [3, 8]
    for each in found:
        mine = sampled()[lambda t, vehicle=each.id: t["vehicle"] == vehicle]
        way = np.hypot(np.diff(mine["easting"]), np.diff(mine["northing"])).sum()
        assert each.get_length() == pytest.approx(way)
        assert each.crs == dataset.crs


def test_a_time_without_vehicles(dataset):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    for ask in (dataset.track_points, dataset.to_trajectories):
        with pytest.raises(gr.InputError, match="nothing was measured in that time"):
            ask(begin="2101-01-01")
    with pytest.raises(gr.InputError, match="there is no vehicle in that time"):
        dataset.to_trajectories(every="23h")


def test_what_is_refused(dataset, monkeypatch):
    with pytest.raises(gr.UsageError, match="is not after begin"):
        dataset.track_points(begin="2101-01-02", end="2101-01-01")
    monkeypatch.setitem(sys.modules, "movingpandas", None)
    with pytest.raises(gr.InputError, match="movingpandas, which is missing") as error:
        dataset.to_trajectories()
    assert error.value.hint == "pip install gis_radar[trajectories]"
