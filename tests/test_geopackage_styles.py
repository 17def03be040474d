"""Looking at a GeoPackage changes nothing, and styles that people save in it stay."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing

import geopandas as gpd
import pytest
import shapely
from counted_sites import two_sensors
from test_qgis_project import a_pose

import gis_radar as gr
from gis_radar.base import content_digest
from gis_radar.poses import write_sensors

MINE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis version=\"3.40\"/>"


@pytest.fixture
def path(tmp_path):
    write_sensors([a_pose()], tmp_path / "sensors.gpkg")
    return tmp_path / "sensors.gpkg"


def change(path, *statements):
    with closing(sqlite3.connect(path)) as database, database:
        for text, values in statements:
            database.execute(text, values)


def read_styles(path):
    """Return the default styles of a file, QML by layer."""
    with closing(sqlite3.connect(path)) as database:
        query = "SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"
        return dict(database.execute(query).fetchall())


def look(path):
    """Do to a file what QGIS does while it shows it: another journal, other pages."""
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute("PRAGMA journal_mode = wal")
        database.execute("UPDATE gpkg_contents SET last_change = '2030-01-01T00:00:00.000Z'")
        database.execute("PRAGMA journal_mode = delete")
        database.execute("VACUUM")


def saved(path, layer="sensors", name="mine"):
    """Save a style as QGIS does, as the layer's default."""
    others = "UPDATE layer_styles SET useAsDefault = 0 WHERE f_table_name = ?"
    columns = "f_table_name, f_geometry_column, styleName, styleQML, useAsDefault, description"
    mine = f"INSERT INTO layer_styles ({columns}, owner) VALUES (?, 'geom', ?, ?, 1, '', '')"  # noqa: S608
    change(path, (others, (layer,)), (mine, (layer, name, MINE)))


def test_looking_and_saving_a_style_leave_the_content(path):
    before, raw = content_digest(path), path.read_bytes()
    look(path)
    saved(path)
    assert path.read_bytes() != raw
    assert content_digest(path) == before
    change(path, ("UPDATE gpkg_spatial_ref_sys SET description = 'another'", ()))
    assert content_digest(path) != before


def test_a_style_that_was_saved_survives(path):
    ours = read_styles(path)
    saved(path)
    write_sensors([a_pose(), a_pose("R2", easting=690400.0)], path)
    assert read_styles(path) == ours | {"sensors": MINE}
    assert len(gpd.read_file(path, layer="sensors")) == 2
    with closing(sqlite3.connect(path)) as database:
        names = "SELECT styleName FROM layer_styles WHERE f_table_name = 'sensors' ORDER BY id"
        assert [name for (name,) in database.execute(names)] == ["sensor", "mine"]
    write_sensors([a_pose()], path)  # and again
    assert read_styles(path) == ours | {"sensors": MINE}


def test_styles_of_heat_maps_survive(tmp_path):
    heat = gr.make_heatmap(two_sensors().dataset)
    heat.write(tmp_path / "map")
    package = tmp_path / "map" / "heatmap.gpkg"
    saved(package, "heatmap", "grey")
    heat.write(tmp_path / "map")
    assert read_styles(package)["heatmap"] == MINE
    assert gr.read_heatmap(package).figures() == heat.figures()


def test_a_file_that_is_no_geopackage_is_replaced(path):
    shutil.copy(gr.sample_folder() / "junction.osm", path)
    assert content_digest(path) is None
    write_sensors([a_pose()], path)
    assert shapely.get_x(gpd.read_file(path, layer="sensors").geometry[0]) == 690360.0


WRITER = """
import sqlite3, sys
writer = sqlite3.connect(sys.argv[1], isolation_level=None)
writer.execute(f"BEGIN {sys.argv[2]}")
writer.execute("UPDATE layer_styles SET styleName = 'of a moment'")
print("begun", flush=True)
sys.stdin.read()
writer.execute("COMMIT")
"""


@pytest.mark.parametrize("kind", ["EXCLUSIVE", "IMMEDIATE"])
def test_a_file_that_another_program_writes_is_not_replaced(path, monkeypatch, kind):
    """Its styles could not be read, and what it has not saved would be gone: all stays."""
    monkeypatch.setattr("gis_radar.base.geopackage.LOCK_WAIT_S", 0.05)
    saved(path)
    words = [sys.executable, "-c", WRITER, path, kind]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"begun\n"
        with pytest.raises(gr.OutputError, match=r"sensors\.gpkg: another program has") as caught:
            write_sensors([a_pose()], path)
        writer.stdin.close()
    assert "\n" not in str(caught.value)
    assert [each.name for each in path.parent.iterdir()] == ["sensors.gpkg"]
    with closing(sqlite3.connect(path)) as database:
        names = {row[0] for row in database.execute("SELECT styleName FROM layer_styles")}
    assert names == {"of a moment"}
    write_sensors([a_pose()], path)  # now it goes
    assert read_styles(path)["sensors"] == MINE


def test_a_file_that_another_program_only_reads_is_replaced(path):
    """As QGIS does that shows it: in its journal, with a look at the file that is not closed."""
    with closing(sqlite3.connect(path, isolation_level=None)) as reader:
        reader.execute("PRAGMA journal_mode = wal")
        rows = reader.execute("SELECT * FROM sensors")
        assert rows.fetchone()
        write_sensors([a_pose(sensor="R7")], path)
        rows.close()
    assert gpd.read_file(path, layer="sensors")["sensor"].tolist() == ["R7"]
