"""Tracks for other programs: points, MovingPandas, and Moving Features JSON that it reads back."""

from __future__ import annotations

import json
import sys
import warnings

import numpy as np
import pandas as pd
import pytest
from pyproj import Transformer
from test_vehicles_folder import straight_tiles, write
from test_vehicles_layer import CARS

import gis_radar as gr


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory):
    return write(tmp_path_factory.mktemp("cars") / "vehicles", straight_tiles(), CARS)


def sampled(apart=10):
    return CARS[CARS["step"] % apart == 0].sort_values(["step", "vehicle"])


@pytest.mark.parametrize(("every", "apart"), [("500ms", 10), ("50ms", 1), ("1s", 20)])
def test_points_are_the_states(vehicles, every, apart):
    points, wanted = gr.track_points(vehicles, every=every), sampled(apart)
    assert points["vehicle"].tolist() == wanted["vehicle"].tolist()
    assert points.geometry.x.tolist() == wanted["easting"].tolist()
    times = points.index.tz_convert(None).to_numpy().astype("datetime64[ms]").astype(np.int64)
    assert (times // 50).tolist() == wanted["step"].tolist()
    assert str(points.index.tz) == "UTC"
    lengths = vehicles.vehicles.set_index("vehicle")["length_m"]
    assert points["length_m"].tolist() == lengths.loc[points["vehicle"]].tolist()


def test_a_span_by_the_clocks_of_the_site(vehicles):
    points = gr.track_points(vehicles)
    low, high = points.index[4], points.index[-6]
    local = [str(each.tz_convert("Asia/Kolkata").tz_localize(None)) for each in (low, high)]
    part = gr.track_points(vehicles, begin=local[0], end=local[1], timezone="Asia/Kolkata")
    pd.testing.assert_frame_equal(part, points[(points.index >= low) & (points.index < high)])


def test_moving_features_are_read_back(vehicles, tmp_path):
    path = tmp_path / "tracks.json"
    assert gr.write_trajectories(vehicles, path) == 2
    text = json.loads(path.read_text(encoding="utf-8"))
    assert text["crs"]["properties"]["name"] == "urn:ogc:def:crs:OGC:1.3:CRS84"
    first = text["features"][0]
    assert first["temporalGeometry"]["type"] == "MovingPoint"
    assert first["properties"]["vehicle"] == 3
    wanted = sampled()[lambda t: t["vehicle"] == 3]
    to_map = Transformer.from_crs("OGC:CRS84", vehicles.provenance.map["crs"], always_xy=True)
    x, y = to_map.transform(*np.transpose(first["temporalGeometry"]["coordinates"]))
    np.testing.assert_allclose(x, wanted["easting"], atol=0.002)
    np.testing.assert_allclose(y, wanted["northing"], atol=0.002)
    assert len(first["temporalProperties"][0]["speed"]["values"]) == len(wanted)
    mpd = pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its own: it drops the zone of its own times
        back = mpd.read_mf_json(str(path), traj_id_property="vehicle")
    assert sorted(each.id for each in back) == [3, 8]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:movingpandas")
@pytest.mark.filterwarnings("ignore:The inplace keyword")
def test_moving_pandas_measures_the_ways(vehicles):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    found = gr.to_trajectories(vehicles)
    assert sorted(each.id for each in found) == [3, 8]
    for each in found:
        mine = sampled()[lambda t, vehicle=each.id: t["vehicle"] == vehicle]
        way = np.hypot(np.diff(mine["easting"]), np.diff(mine["northing"])).sum()
        assert each.get_length() == pytest.approx(way)
        assert each.crs == vehicles.provenance.map["crs"]


def test_a_time_without_vehicles(vehicles):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    assert gr.track_points(vehicles, begin="2101-01-01").empty
    with pytest.raises(gr.InputError, match="there is no vehicle in that time"):
        gr.to_trajectories(vehicles, begin="2101-01-01")


def test_what_is_refused(vehicles, tmp_path, monkeypatch):
    with pytest.raises(gr.UsageError, match="Moving Features are written as JSON"):
        gr.write_trajectories(vehicles, tmp_path / "tracks.csv")
    monkeypatch.setitem(sys.modules, "movingpandas", None)
    with pytest.raises(gr.InputError, match="movingpandas, which is missing") as error:
        gr.to_trajectories(vehicles)
    assert error.value.hint == "pip install gis_radar[trajectories]"
