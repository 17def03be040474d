"""The sample site: what its files promise, and that they fit together."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from pyproj import Transformer

SAMPLE = Path(__file__).parents[1] / "sample_maps"
START = 1_749_713_400.0
COLUMNS = ["x", "y", "z", "range_rate", "rcs"]
SENSORS = ("R1", "R2")


@pytest.fixture(scope="module")
def recordings() -> dict[str, pd.DataFrame]:
    return {s: pq.read_table(SAMPLE / f"{s}.parquet").to_pandas() for s in SENSORS}


@pytest.fixture(scope="module")
def lanelet_map():
    lanelet2 = pytest.importorskip("lanelet2")
    origin = Transformer.from_crs(25832, 4326, always_xy=True).transform(690_400.0, 5_336_200.0)
    projector = lanelet2.projection.UtmProjector(
        lanelet2.io.Origin(origin[1], origin[0]), True, False
    )
    loaded, errors = lanelet2.io.loadRobust(str(SAMPLE / "junction.osm"), projector)
    assert not list(errors)
    return loaded


@pytest.mark.parametrize("sensor", SENSORS)
def test_recordings_keep_the_contract(recordings, sensor):
    table = recordings[sensor]
    assert list(table.columns) == ["time", *COLUMNS]
    assert table["time"].dtype == np.float64
    assert (table.dtypes[COLUMNS] == np.float32).all()
    assert table["time"].is_monotonic_increasing
    begins = START + 0.017 * (sensor == "R2")
    assert 0.0 <= table["time"].iloc[0] - begins < 0.06  # a cycle may begin at any moment of it
    assert 99.9 < table["time"].iloc[-1] - START < 100.0
    size = table.groupby("time").size()
    assert 70 < size.mean() < 100  # a recorded ARS548 gives 50-100
    assert size.max() < 150
    nothing = table[table["x"].isna()]
    assert len(nothing) >= 1
    assert (size[nothing["time"]] == 1).all()
    assert table["range_rate"].isna().sum() == len(nothing)


def test_the_map_can_be_routed(lanelet_map):
    lanelet2 = pytest.importorskip("lanelet2")
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(lanelet_map, rules)
    assert not list(graph.checkValidity(throwOnError=False))
    roads = [ll for ll in lanelet_map.laneletLayer if ll.attributes["subtype"] == "road"]
    following = {ll.id: len(graph.following(ll)) for ll in roads}
    ends = [name for name, count in following.items() if count == 0]
    assert len(ends) == 6  # the lanes that leave the map
    assert max(following.values()) >= 2
    assert any(graph.left(ll) or graph.adjacentLeft(ll) for ll in roads)
    lit = [ll for ll in roads if ll.trafficLights()]
    assert len(lit) == 10
    assert all(light.stopLine is not None for ll in lit for light in ll.trafficLights())
    walks = [ll for ll in lanelet_map.laneletLayer if ll.attributes["subtype"] == "crosswalk"]
    assert len(walks) == 2


@pytest.mark.usefixtures("sumo_installed")
def test_the_sample_is_made_again_alike(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(SAMPLE))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # the folder goes into the wheel
    make_samples = importlib.import_module("make_samples")
    made = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        make_samples.make_samples(folder, duration_s=1.0)
        made.append(folder)
    for path in made[0].iterdir():
        assert path.read_bytes() == (made[1] / path.name).read_bytes(), path.name
