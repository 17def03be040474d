"""The layer of footprints: its rows, its shapes, and the project that plays it."""

import re
import sqlite3
import zipfile
from contextlib import closing

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from datasets import stepwise_dataset
from driven import FIRST, drive, driven, straight_tiles
from shapely.affinity import rotate, translate

import gis_radar as gr
from gis_radar.dataset import footprint_style
from gis_radar.products import write_site_project

CARS = pd.concat(
    [
        drive(3, FIRST + 4, 10.0 + 0.5 * np.arange(57)),
        drive(8, FIRST + 20, np.full(30, 9.0), speed=0.4, seen=False),
    ]
).assign(heading=lambda t: np.where(t["vehicle"] == 3, 30.0, -90.0))


def layer_of(folder, tracks, **options):
    """Write tracks as a dataset and as a layer; give the layer and the file."""
    dataset = driven(folder / "dataset", straight_tiles(), tracks, **options)
    path = folder / "footprints.gpkg"
    rows = dataset.write_footprints(path)
    layer = gpd.read_file(path, layer="footprints")
    assert len(layer) == rows
    return layer, path


def test_a_vehicle_has_a_row_each_half_second(tmp_path):
    layer, _ = layer_of(tmp_path, CARS)
    steps = layer["begin"].astype("datetime64[ms, UTC]").astype(np.int64) // 50
    wanted = CARS[CARS["step"] % 10 == 0].sort_values(["step", "vehicle"])
    assert list(zip(steps, layer["vehicle"], strict=True)) == list(
        zip(wanted["step"], wanted["vehicle"], strict=True)
    )
    assert ((layer["end"] - layer["begin"]).dt.total_seconds() == 0.5).all()
    assert layer["speed_kmh"].tolist() == pytest.approx((wanted["speed"] * 3.6).round(1).tolist())
    still = layer["vehicle"] == 8
    assert set(layer.loc[still, "state"]) == {"standing"}
    assert set(layer.loc[~still, "state"]) == {"moving"}
    assert not layer.loc[still, "seen"].any()
    assert layer.loc[~still, "seen"].all()
    assert set(layer["kind"]) == {"light"}


def test_a_car_is_its_rectangle(tmp_path):
    layer, _ = layer_of(tmp_path, CARS)
    states = CARS[CARS["step"] % 10 == 0].sort_values(["step", "vehicle"])
    box = shapely.box(-4.5 / 2, -0.9, 4.5 / 2, 0.9)
    for (_, row), state in zip(layer.iterrows(), states.itertuples(), strict=True):
        true = translate(rotate(box, state.heading), state.easting, state.northing)
        assert row.geometry.symmetric_difference(true).area < 1e-6


def turned(radius=15.0, length=18.0, last=200):
    """Drive a long vehicle around the origin: the states, and the angles of its front."""
    angle = np.linspace(0.0, np.pi, last)
    front = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    ahead = np.column_stack([-np.sin(angle), np.cos(angle)])
    middle = front - length / 2 * ahead
    states = drive(5, FIRST, np.zeros(last), length=length).assign(
        easting=middle[:, 0], northing=middle[:, 1], heading=np.degrees(angle) + 90.0
    )
    return states, angle


def test_a_long_vehicle_is_the_strip_of_its_path(tmp_path):
    radius, length, width = 15.0, 18.0, 2.5
    states, angle = turned(radius, length)
    layer, _ = layer_of(tmp_path, states, length=length, width=width, p_heavy=1.0)
    assert set(layer["kind"]) == {"heavy"}
    shown = angle[states["step"] % 10 == 0]
    assert len(layer) == len(shown) == 20
    for shape, at in zip(layer.geometry, shown, strict=True):
        if at < length / radius + 0.1:
            continue  # its rear is still on the straight way before
        back = np.linspace(at - length / radius, at, 60)
        arc = shapely.LineString(radius * np.column_stack([np.cos(back), np.sin(back)]))
        true = arc.buffer(width / 2, cap_style="flat")
        assert shape.symmetric_difference(true).area < 0.03 * true.area


def test_the_style_shows_every_kind_and_state(tmp_path):
    _, path = layer_of(tmp_path, CARS)
    with closing(sqlite3.connect(path)) as database:
        ((stored,),) = database.execute("SELECT styleQML FROM layer_styles WHERE useAsDefault")
    assert stored == footprint_style()
    values = set(re.findall(r'<category symbol="\d" value="([^"]*)"', stored))
    assert values == {f"{k}, {s}" for k in ("light", "heavy") for s in ("moving", "standing")}


def test_an_hour_without_vehicles_is_an_empty_layer(tmp_path):
    hits = stepwise_dataset(
        tmp_path / "dataset", straight_tiles(), {("R1", "a"): {FIRST}}, {("R1", "a"): {0}}, set(),
        occupied={}, visible={(0, True): {FIRST}},
    )  # fmt: skip
    path = tmp_path / "none.gpkg"
    assert hits.write_footprints(path) == 0
    layer = gpd.read_file(path, layer="footprints")
    assert layer.empty
    assert layer.crs == "EPSG:25832"


def test_layers_that_are_refused(tmp_path):
    layer_of(tmp_path, CARS)
    dataset = gr.open_dataset(tmp_path / "dataset")
    with pytest.raises(gr.UsageError, match=r"footprints are written as GeoPackage"):
        dataset.write_footprints(tmp_path / "footprints.shp")
    hits = stepwise_dataset(
        tmp_path / "hits", straight_tiles(), {("R1", "a"): {FIRST}}, {("R1", "a"): {0}}, set()
    )
    with pytest.raises(gr.InputError, match="holds no vehicles"):
        hits.write_footprints(tmp_path / "footprints.gpkg")


def test_the_project_of_a_site_plays_vehicles_only_where_asked(tmp_path):
    """Tracks of single vehicles are shown by choice, and gone when the choice is taken back."""
    dataset = driven(tmp_path / "dataset", straight_tiles(), CARS)
    gr.make_heatmap(dataset, interval="1s").write(tmp_path / "heatmap")
    for asked in (True, False):
        made = [path.name for path in write_site_project(tmp_path, footprints=asked)]
        assert ("footprints.gpkg" in made) == asked
        assert (tmp_path / "footprints.gpkg").exists() == asked
        with zipfile.ZipFile(tmp_path / "site.qgz") as archive:
            text = archive.read("site.qgs").decode()
        assert ("./footprints.gpkg|layername=footprints" in text) == asked
        assert ('timeStep="0.5"' in text) == asked
        sheet = text[text.index("<Layouts>") :]
        assert "gis_radar_footprints" not in sheet  # of all times at once
