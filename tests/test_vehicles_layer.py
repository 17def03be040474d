"""The layer of footprints: its rows, its shapes, and the project that plays it."""

import re
import sqlite3
import zipfile
from contextlib import closing
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from shapely.affinity import rotate, translate
from test_heatmap_coverage import occupancy_in
from test_vehicles_folder import FIRST, drive, straight_tiles, write

import gis_radar as gr
from gis_radar.vehicles.layer import footprint_style

CARS = pd.concat(
    [
        drive(3, FIRST + 4, 10.0 + 0.5 * np.arange(57)),
        drive(8, FIRST + 20, np.full(30, 9.0), speed=0.4, seen=False),
    ]
).assign(heading=lambda t: np.where(t["vehicle"] == 3, 30.0, -90.0))


def layer_of(folder, tracks, **options):
    """Write tracks as a folder and as a layer; give the layer and the file."""
    vehicles = write(folder / "vehicles", straight_tiles(), tracks, **options)
    path = folder / "footprints.gpkg"
    rows = gr.write_footprints(vehicles, path)
    layer = gpd.read_file(path, layer="footprints")
    assert len(layer) == rows
    return layer, path


def test_a_vehicle_has_a_row_each_half_second(tmp_path):
    layer, _ = layer_of(tmp_path, CARS, cuts=[FIRST + 33])
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


def test_no_vehicle_is_an_empty_layer(tmp_path):
    some = write(tmp_path / "vehicles", straight_tiles(), CARS)
    none = replace(some, vehicles=some.vehicles[:0], read_tracks=lambda _: iter(()))
    path = tmp_path / "none.gpkg"
    assert gr.write_footprints(none, path) == 0
    layer = gpd.read_file(path, layer="footprints")
    assert layer.empty
    assert layer.crs == "EPSG:25832"


def test_layers_that_are_refused(tmp_path):
    layer_of(tmp_path, CARS)
    vehicles = gr.read_vehicles(tmp_path / "vehicles")
    with pytest.raises(gr.UsageError, match=r"footprints are written as GeoPackage"):
        gr.write_footprints(vehicles, tmp_path / "footprints.shp")


def test_the_project_of_a_site_plays_vehicles_only_where_asked(tmp_path):
    """Tracks of single vehicles are shown by choice, and gone when the choice is taken back."""
    tiles = straight_tiles()
    layer_of(tmp_path, CARS)
    occupancy = occupancy_in(tiles, range(FIRST, FIRST + 100))
    gr.make_heatmap(occupancy, tiles, interval="1s").write(tmp_path / "heatmap")
    for asked in (True, False):
        made = [path.name for path in gr.write_site_project(tmp_path, footprints=asked)]
        assert ("footprints.gpkg" in made) == asked
        assert (tmp_path / "footprints.gpkg").exists() == asked
        with zipfile.ZipFile(tmp_path / "site.qgz") as archive:
            text = archive.read("site.qgs").decode()
        assert ("./footprints.gpkg|layername=footprints" in text) == asked
        assert ('timeStep="0.5"' in text) == asked
        sheet = text[text.index("<Layouts>") :]
        assert "gis_radar_footprints" not in sheet  # of all times at once
