"""Tracks for other programs: points, MovingPandas, and Moving Features JSON that it reads back."""

from __future__ import annotations

import json
import sys
import warnings
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from driven import FIRST, drive, driven, straight_tiles
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer
from test_vehicles_layer import CARS

import gis_radar as gr
from gis_radar.base import step_begin
from gis_radar.cli import group
from gis_radar.dataset import STEPS_PER_HOUR


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return driven(tmp_path_factory.mktemp("cars") / "dataset", straight_tiles(), CARS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


def sampled(apart=10):
    return CARS[CARS["step"] % apart == 0].sort_values(["step", "vehicle"])


@pytest.mark.parametrize(("every", "apart"), [("500ms", 10), ("50ms", 1), ("1s", 20)])
def test_points_are_the_states(dataset, every, apart):
    points, wanted = gr.track_points(dataset, every=every), sampled(apart)
    assert points["vehicle"].tolist() == wanted["vehicle"].tolist()
    np.testing.assert_allclose(points.geometry.x, wanted["easting"], atol=1e-9)
    times = points.index.tz_convert(None).to_numpy().astype("datetime64[ms]").astype(np.int64)
    assert (times // 50).tolist() == wanted["step"].tolist()
    assert str(points.index.tz) == "UTC"
    assert set(points["length_m"]) == {4.5}


def test_a_span_by_the_clocks_of_the_site(dataset):
    points = gr.track_points(dataset, every="50ms")
    low, high = points.index[4], points.index[-6]
    assert low < high
    local = [str(each.tz_convert("Asia/Kolkata").tz_localize(None)) for each in (low, high)]
    part = gr.track_points(
        dataset, every="50ms", begin=local[0], end=local[1], timezone="Asia/Kolkata"
    )
    pd.testing.assert_frame_equal(part, points[(points.index >= low) & (points.index < high)])


def test_moving_features_are_read_back(dataset, tmp_path):
    path = tmp_path / "tracks.json"
    assert gr.write_trajectories(dataset, path) == 2
    text = json.loads(path.read_text(encoding="utf-8"))
    assert text["crs"]["properties"]["name"] == "urn:ogc:def:crs:OGC:1.3:CRS84"
    other, first = text["features"]  # as they end
    assert [each["properties"]["vehicle"] for each in (other, first)] == [8, 3]
    assert first["temporalGeometry"]["type"] == "MovingPoint"
    wanted = sampled()[lambda t: t["vehicle"] == 3]
    to_map = Transformer.from_crs("OGC:CRS84", dataset.crs, always_xy=True)
    x, y = to_map.transform(*np.transpose(first["temporalGeometry"]["coordinates"]))
    np.testing.assert_allclose(x, wanted["easting"], atol=0.002)
    np.testing.assert_allclose(y, wanted["northing"], atol=0.002)
    assert len(first["temporalProperties"][0]["speed"]["values"]) == len(wanted)
    mpd = pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its own: it drops the zone of its own times
        back = mpd.read_mf_json(str(path), traj_id_property="vehicle")
    assert sorted(each.id for each in back) == [3, 8]


def test_a_vehicle_that_goes_on_over_an_hours_begin_is_one(tmp_path):
    """It has two numbers in the dataset; in the file and the table it has the first."""
    edge = (FIRST // STEPS_PER_HOUR + 1) * STEPS_PER_HOUR
    whole = drive(3, edge - 50, 0.5 * np.arange(100))
    halves = whole.assign(vehicle=np.where(whole["step"] < edge, 3, 4))
    other = drive(9, edge + 2, np.arange(9.0))
    dataset = driven(
        tmp_path / "dataset", straight_tiles(), pd.concat([halves, other]),
        continued={edge // STEPS_PER_HOUR: [(3, 4)]},
    )  # fmt: skip
    path = tmp_path / "tracks.json"
    assert gr.write_trajectories(dataset, path, every="50ms") == 2
    found = json.loads(path.read_text())["features"]
    lengths = [len(each["temporalGeometry"]["datetimes"]) for each in found]
    assert [each["properties"]["vehicle"] for each in found] == [9, 3]
    assert lengths == [9, 100]
    points = gr.track_points(dataset, every="50ms")
    mine = points[points["vehicle"] == 3]
    np.testing.assert_allclose(mine.geometry.x, whole["easting"], atol=1e-9)
    assert gr.write_trajectories(dataset, path, end=step_begin(edge)) == 1


@given(
    every=st.sampled_from(["50ms", "500ms", "1h"]),
    span=st.sampled_from([(None, None), (30, None), (None, 52), (24, 41), (51, 55)]),
)
@settings(max_examples=15, deadline=None)
def test_the_file_is_the_points(dataset, folder, every, span):
    times = [None if each is None else step_begin(FIRST + each) for each in span]
    options = {"every": every, "begin": times[0], "end": times[1]}
    count = gr.write_trajectories(dataset, folder / "whole.json", **options)
    text = (folder / "whole.json").read_bytes()
    points = gr.track_points(dataset, **options)
    features = json.loads(text)["features"]
    assert count == len(features) == points["vehicle"].nunique()
    for each in features:
        rows = points[points["vehicle"] == each["properties"]["vehicle"]]
        moving, more = each["temporalGeometry"], each["temporalProperties"][0]
        times = pd.DatetimeIndex(moving["datetimes"])
        assert times.tolist() == rows.index.tolist()
        assert more["speed"]["values"] == rows["speed"].round(2).tolist()
        assert more["heading"]["values"] == rows["heading"].round(2).tolist()
        assert each["properties"]["length_m"] == rows["length_m"].iloc[0]
        degrees = rows.to_crs("OGC:CRS84").geometry
        np.testing.assert_allclose(
            moving["coordinates"], np.column_stack([degrees.x, degrees.y]), atol=1e-8
        )


def test_a_command_writes_a_span(dataset, tmp_path):
    path, folder = tmp_path / "tracks.json", dataset.folder
    low, high = step_begin(FIRST + 24), step_begin(FIRST + 41)
    local = low.astimezone(ZoneInfo("Asia/Kolkata")).replace(tzinfo=None)
    words = ["trajectories", str(folder), "-o", str(path), "--every", "50ms",
             "--begin", str(local), "--end", str(high), "--timezone", "Asia/Kolkata"]  # fmt: skip
    assert CliRunner().invoke(group, words).exit_code == 0
    features = json.loads(path.read_text())["features"]
    found = {each["properties"]["vehicle"]: each["temporalGeometry"] for each in features}
    assert {name: len(each["datetimes"]) for name, each in found.items()} == {3: 17, 8: 17}
    assert pd.Timestamp(found[3]["datetimes"][0]) == low
    words[-5], words[-3] = str(high), str(low)
    refused = CliRunner().invoke(group, words).exception
    assert isinstance(refused, gr.UsageError)
    assert "expected ascending times" in refused.message


@pytest.mark.filterwarnings("ignore::DeprecationWarning:movingpandas")
@pytest.mark.filterwarnings("ignore:The inplace keyword")
def test_moving_pandas_measures_the_ways(dataset):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    found = gr.to_trajectories(dataset)
    assert sorted(each.id for each in found) == [3, 8]
    for each in found:
        mine = sampled()[lambda t, vehicle=each.id: t["vehicle"] == vehicle]
        way = np.hypot(np.diff(mine["easting"]), np.diff(mine["northing"])).sum()
        assert each.get_length() == pytest.approx(way)
        assert each.crs == dataset.crs


def test_moving_pandas_is_silent_about_extras_of_its_own(dataset, monkeypatch):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    monkeypatch.delitem(sys.modules, "movingpandas")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        gr.to_trajectories(dataset)
    assert not [each for each in said if each.category is UserWarning]


def test_a_time_without_vehicles(dataset):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    assert gr.track_points(dataset, begin="2101-01-01").empty
    with pytest.raises(gr.InputError, match="there is no vehicle in that time"):
        gr.to_trajectories(dataset, begin="2101-01-01")


def test_what_is_refused(dataset, tmp_path, monkeypatch):
    with pytest.raises(gr.UsageError, match="Moving Features are written as JSON"):
        gr.write_trajectories(dataset, tmp_path / "tracks.csv")
    monkeypatch.setitem(sys.modules, "movingpandas", None)
    with pytest.raises(gr.InputError, match="movingpandas, which is missing") as error:
        gr.to_trajectories(dataset)
    assert error.value.hint == "pip install gis_radar[trajectories]"
