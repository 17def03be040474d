"""The files of a heat map, read back with other programs' libraries."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pyogrio
import pytest
import rasterio
import rasterio.features
from counted_sites import EAST, NORTH, T0, lane_tiles, make_site, two_sensors
from matplotlib import image
from matplotlib.figure import Figure

from gis_radar.base import InputError, OutputError, Reporter
from gis_radar.products import make_heatmap, read_heatmap

FILES = ["heatmap.gpkg", "heatmap.parquet", "heatmap.png", "heatmap.qml", "hits.qml", "hits.tif"]


@pytest.fixture(scope="module")
def heatmap():
    site = two_sensors()
    return make_heatmap(site.dataset, interval="5s")


@pytest.fixture(scope="module")
def folder(heatmap, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site") / "heat map"
    paths = heatmap.write(folder)
    assert sorted(path.name for path in paths) == FILES
    assert all(path.parent == folder for path in paths)
    return folder


def test_nothing_else_is_left_behind(folder):
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_a_second_map_replaces_the_first(heatmap, tmp_path):
    for _ in range(2):
        heatmap.write(tmp_path / "map")
    assert sorted(path.name for path in (tmp_path / "map").iterdir()) == FILES


def test_foreign_files_are_not_replaced(heatmap, tmp_path):
    (tmp_path / "thesis.docx").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.docx"):
        heatmap.write(tmp_path)


def test_a_failure_leaves_nothing(heatmap, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rasterio.shutil.copy", fail)
    with pytest.raises(OutputError, match=r"hits\.tif: cannot be written: the disk is full"):
        heatmap.write(tmp_path / "map")
    assert list(tmp_path.iterdir()) == []


class Impatient(Reporter):
    def __init__(self, stage):
        self.stage = stage

    def progress(self, stage, done, total):  # noqa: ARG002
        if stage == self.stage:
            raise KeyboardInterrupt


@pytest.mark.parametrize(
    "stage", ["writing measures by interval", "writing bands", "drawing the picture"]
)
def test_ctrl_c_leaves_nothing_and_stays_ctrl_c(heatmap, tmp_path, stage):
    with pytest.raises(KeyboardInterrupt):
        heatmap.write(tmp_path / "map", Impatient(stage))
    assert list(tmp_path.iterdir()) == []


# --- GeoPackage ---------------------------------------------------------------------------------


def test_wide_layer_reads_back_equal(heatmap, folder):
    read = pyogrio.read_dataframe(folder / "heatmap.gpkg", layer="heatmap")
    wide = heatmap.wide()
    assert read.crs == wide.crs
    assert read.geometry.geom_equals(wide.geometry).all()
    pd.testing.assert_frame_equal(
        pd.DataFrame(read.drop(columns="geometry")),
        pd.DataFrame(wide.drop(columns="geometry")),
        check_dtype=False,
    )


@pytest.fixture
def relabelled(folder, tmp_path):
    """Give a function that changes a note in a copy of the map, and gives the folder."""

    def change(key, function):
        shutil.copytree(folder, tmp_path / "map")
        package = tmp_path / "map" / "heatmap.gpkg"
        with closing(sqlite3.connect(package)) as database, database:
            (text,) = database.execute("SELECT metadata FROM gpkg_metadata").fetchone()
            root = ET.fromstring(text)  # noqa: S314 - our own file
            note = root.find(f".//MDI[@key='{key}']")
            note.text = function(note.text)
            changed = ET.tostring(root, encoding="unicode")
            database.execute("UPDATE gpkg_metadata SET metadata = ?", (changed,))
        return tmp_path / "map"

    return change


@pytest.mark.parametrize(
    "labels", ["nonsense", "[1]", '{"x": 1}', '{"sources": 5}', '{"timezone": "Mars/Base"}']
)
def test_damaged_labels_are_refused_by_name(relabelled, labels):
    with pytest.raises(InputError, match=r"heatmap\.gpkg: its labels cannot be read"):
        read_heatmap(relabelled("labels", lambda _: labels))


def test_tiles_that_are_not_those_of_the_counts_are_refused(relabelled):
    with pytest.raises(InputError, match=r"heatmap\.gpkg: its tiles were changed"):
        read_heatmap(relabelled("fingerprint", lambda text: text[::-1]))


def test_long_layer_reads_back_equal(heatmap, folder):
    read = pyogrio.read_dataframe(folder / "heatmap.gpkg", layer="by_interval")
    long = heatmap.long()
    assert read.geometry.geom_equals(long.geometry).all()
    pd.testing.assert_frame_equal(
        pd.DataFrame(read.drop(columns="geometry")),
        pd.DataFrame(long.drop(columns="geometry")),
        check_dtype=False,
    )


def rows(folder, query, *values):
    with closing(sqlite3.connect(folder / "heatmap.gpkg")) as database:
        return database.execute(query, values).fetchall()


def test_times_are_utc_with_z(folder):
    begin, end = rows(folder, "SELECT begin, end FROM by_interval LIMIT 1")[0]
    assert (begin, end) == ("2023-11-14T22:13:20.000Z", "2023-11-14T22:13:25.000Z")


def test_not_observed_is_null_and_never_zero(folder):
    unseen = "SELECT hit_s, observed_s, hit_share FROM heatmap WHERE tile_id = 15"
    assert rows(folder, unseen) == [(None, 0.0, None)]
    never = "SELECT hit_s, hit_share FROM heatmap WHERE tile_id = 9"
    assert rows(folder, never) == [(0.0, 0.0)]


def test_geopackage_is_of_version_1_2_with_indexes_and_no_log(folder):
    assert rows(folder, "PRAGMA user_version") == [(10200,)]
    assert rows(folder, "PRAGMA journal_mode") == [("delete",)]
    assert rows(folder, "PRAGMA integrity_check") == [("ok",)]
    names = {name for (name,) in rows(folder, "SELECT name FROM sqlite_master")}
    assert {"rtree_tiles_geom", "tiles_tile_id"} <= names


def test_the_layer_by_interval_is_a_view_of_whole_steps(folder):
    """No polygon a row; an interval is found by its time, without a look at other rows."""
    assert rows(folder, "SELECT type FROM sqlite_master WHERE name = 'by_interval'") == [("view",)]
    kinds = "SELECT DISTINCT typeof(hit), typeof(observed) FROM steps_by_interval"
    assert set(rows(folder, kinds)) == {("integer", "integer"), ("null", "integer")}
    plan = rows(folder, "EXPLAIN QUERY PLAN SELECT * FROM by_interval WHERE begin = ?", "x")
    assert [step[3].split(" USING ")[0] for step in plan] == ["SCAN i", "SEARCH s", "SEARCH t"]


def test_rows_of_views_are_known_without_a_count(heatmap, folder):
    known = dict(rows(folder, "SELECT table_name, feature_count FROM gpkg_ogr_contents"))
    assert known["heatmap"] == len(heatmap.wide())
    assert known["by_interval"] == len(heatmap.long())


def test_default_styles_are_registered(folder):
    found = rows(
        folder,
        "SELECT f_table_name, f_geometry_column, useAsDefault, styleQML "
        "FROM layer_styles ORDER BY f_table_name",
    )
    assert [row[0] for row in found] == ["by_interval", "heatmap"]
    columns = dict(rows(folder, "SELECT table_name, column_name FROM gpkg_geometry_columns"))
    for name, geometry, default, qml in found:
        assert geometry == columns[name]
        assert default == 1
        assert "graduatedSymbol" in qml
        assert ('mode="1"' in qml) == (name == "by_interval")
    kind = "SELECT data_type FROM gpkg_contents WHERE table_name = 'layer_styles'"
    assert rows(folder, kind) == [("attributes",)]


def test_fingerprint_travels_in_every_file(heatmap, folder):
    for layer in ("heatmap", "by_interval"):
        info = pyogrio.read_info(folder / "heatmap.gpkg", layer=layer)
        assert info["layer_metadata"]["fingerprint"] == heatmap.fingerprint
        assert "hit_s" in json.loads(info["layer_metadata"]["definitions"])
    assert gpd.read_parquet(folder / "heatmap.parquet").attrs["fingerprint"] == heatmap.fingerprint
    with rasterio.open(folder / "hits.tif") as raster:
        assert raster.tags()["fingerprint"] == heatmap.fingerprint


# --- GeoParquet ---------------------------------------------------------------------------------


def test_geoparquet_has_crs_and_boxes(heatmap, folder):
    path = folder / "heatmap.parquet"
    geo = json.loads(pq.read_metadata(path).metadata[b"geo"])
    assert geo["version"] == "1.1.0"
    column = geo["columns"][geo["primary_column"]]
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 25832}
    assert column["covering"]["bbox"]["xmin"] == ["bbox", "xmin"]
    read = gpd.read_parquet(path)
    wide = heatmap.wide()
    assert read.geometry.geom_equals(wide.geometry).all()
    columns = wide.columns.drop("geometry")
    pd.testing.assert_frame_equal(
        pd.DataFrame(read[columns]), pd.DataFrame(wide[columns]), check_dtype=False
    )
    few = gpd.read_parquet(path, bbox=(EAST - 5, NORTH - 5, EAST - 4, NORTH))
    assert 0 < len(few) < len(wide)


def test_a_flipped_bit_in_the_table_is_found(folder, tmp_path):
    content = bytearray((folder / "heatmap.parquet").read_bytes())
    content[200] ^= 4
    (tmp_path / "bad.parquet").write_bytes(content)
    with pytest.raises(OSError, match=r"(?i)crc|checksum"):
        pq.read_table(tmp_path / "bad.parquet", page_checksum_verification=True)


# --- Picture ------------------------------------------------------------------------------------


def test_picture_shows_the_classes(folder):
    pixels = image.imread(folder / "heatmap.png")
    height, width, _ = pixels.shape
    assert width == 2000
    assert 1000 < height < 2100
    shown = {
        tuple(colour)
        for colour in np.rint(pixels[:, :1490, :3] * 255).astype(int)[::2, ::2].reshape(-1, 3)
    }
    for colour in ("#480d58", "#f1f6fb", "#b9bdc1"):  # hit often, never hit, not observed
        assert tuple(bytes.fromhex(colour[1:])) in shown


def test_plot_draws_on_given_axes(heatmap):
    ax = Figure().add_subplot()
    assert heatmap.plot(ax) is ax
    assert len(ax.images) == 1
    west, east = ax.get_xlim()
    assert west < EAST < east


@pytest.mark.parametrize("hit", [set(), {(T0, 0)}])
def test_picture_of_almost_nothing(tmp_path, hit):
    view = ("R1", "a")
    site = make_site(lane_tiles(1), {view: {T0}}, {view: {0}}, hit)
    make_heatmap(site.dataset, at="2023-11-14T22:13:20Z").write(tmp_path / "map")
    assert image.imread(tmp_path / "map" / "heatmap.png").std() > 0.05
