"""Tracks for other programs: points, MovingPandas, and Moving Features JSON that it reads back."""

from __future__ import annotations

import itertools
import json
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer
from test_vehicles_folder import FIRST, straight_tiles, write
from test_vehicles_layer import CARS

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.progress import Reporter
from gis_radar.steps import step_begin


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory):
    return write(tmp_path_factory.mktemp("cars") / "vehicles", straight_tiles(), CARS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


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
    points = gr.track_points(vehicles, every="50ms")
    low, high = points.index[4], points.index[-6]
    assert low < high
    local = [str(each.tz_convert("Asia/Kolkata").tz_localize(None)) for each in (low, high)]
    part = gr.track_points(
        vehicles, every="50ms", begin=local[0], end=local[1], timezone="Asia/Kolkata"
    )
    pd.testing.assert_frame_equal(part, points[(points.index >= low) & (points.index < high)])


def test_moving_features_are_read_back(vehicles, tmp_path):
    path = tmp_path / "tracks.json"
    assert gr.write_trajectories(vehicles, path) == 2
    text = json.loads(path.read_text(encoding="utf-8"))
    assert text["crs"]["properties"]["name"] == "urn:ogc:def:crs:OGC:1.3:CRS84"
    other, first = text["features"]  # as they end
    assert [each["properties"]["vehicle"] for each in (other, first)] == [8, 3]
    assert first["temporalGeometry"]["type"] == "MovingPoint"
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


class Heard(Reporter):
    """Notes progress among other events."""

    def __init__(self, events):
        self.events = events

    def progress(self, stage, done, total):
        self.events.append((stage, done, total))


def in_pieces(vehicles, ends, events):
    """Return vehicles whose tracks come in pieces, after which these rows follow."""
    rows = pd.concat(list(vehicles.tracks()))

    def read(_span):
        for begin, end in itertools.pairwise((0, *ends, len(rows))):
            events.append(begin)
            yield rows[begin:end]

    return replace(vehicles, read_tracks=read)


def test_a_vehicle_is_written_once_it_ended(vehicles, tmp_path):
    """The recording is not held: vehicle 8 is in the file before the last piece is read."""
    events = []
    last = len(CARS) - 3
    parts = in_pieces(vehicles, [10, last], events)
    assert gr.write_trajectories(parts, tmp_path / "t.json", every="50ms", reporter=Heard(events))
    stage = "writing trajectories"
    assert events == [0, 10, (stage, 1, 2), last, (stage, 2, 2)]


@given(
    cuts=st.lists(st.integers(1, len(CARS) - 1), unique=True, max_size=5).map(sorted),
    every=st.sampled_from(["50ms", "500ms", "1h"]),
    span=st.sampled_from([(None, None), (30, None), (None, 52), (24, 41), (51, 55)]),
)
@settings(max_examples=40, deadline=None)
def test_pieces_do_not_matter_and_the_file_is_the_points(vehicles, folder, cuts, every, span):
    times = [None if each is None else step_begin(FIRST + each) for each in span]
    options = {"every": every, "begin": times[0], "end": times[1]}
    count = gr.write_trajectories(vehicles, folder / "whole.json", **options)
    parts = in_pieces(vehicles, cuts, [])
    assert gr.write_trajectories(parts, folder / "parts.json", **options) == count
    text = (folder / "whole.json").read_bytes()
    assert (folder / "parts.json").read_bytes() == text
    points = gr.track_points(vehicles, **options)
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


def test_a_command_writes_a_span(vehicles, tmp_path):
    path, folder = tmp_path / "tracks.json", Path(vehicles.place)
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
def test_moving_pandas_measures_the_ways(vehicles):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    found = gr.to_trajectories(vehicles)
    assert sorted(each.id for each in found) == [3, 8]
    for each in found:
        mine = sampled()[lambda t, vehicle=each.id: t["vehicle"] == vehicle]
        way = np.hypot(np.diff(mine["easting"]), np.diff(mine["northing"])).sum()
        assert each.get_length() == pytest.approx(way)
        assert each.crs == vehicles.provenance.map["crs"]


def test_moving_pandas_is_silent_about_extras_of_its_own(vehicles, monkeypatch):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    monkeypatch.delitem(sys.modules, "movingpandas")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        gr.to_trajectories(vehicles)
    assert not [each for each in said if each.category is UserWarning]


def test_a_time_without_vehicles(vehicles):
    pytest.importorskip("movingpandas", reason="movingpandas is not installed")
    assert gr.track_points(vehicles, begin="2101-01-01").empty
    with pytest.raises(gr.InputError, match="there is no vehicle in that time"):
        gr.to_trajectories(vehicles, begin="2101-01-01")


def test_tracks_that_go_on_after_the_end_of_their_vehicle(vehicles, tmp_path):
    table = vehicles.vehicles
    for bad in (table[table["vehicle"] == 3], table.assign(last_step=FIRST + 41)):
        with pytest.raises(gr.InputError, match=r"the tracks of vehicle \d go on after its end"):
            gr.write_trajectories(replace(vehicles, vehicles=bad), tmp_path / "tracks.json")
    assert not list(tmp_path.iterdir())


def test_what_is_refused(vehicles, tmp_path, monkeypatch):
    with pytest.raises(gr.UsageError, match="Moving Features are written as JSON"):
        gr.write_trajectories(vehicles, tmp_path / "tracks.csv")
    monkeypatch.setitem(sys.modules, "movingpandas", None)
    with pytest.raises(gr.InputError, match="movingpandas, which is missing") as error:
        gr.to_trajectories(vehicles)
    assert error.value.hint == "pip install gis_radar[trajectories]"
