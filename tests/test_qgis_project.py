"""Sensors as layers, and QGIS projects; that QGIS opens them is tested in qgis_plugin/tests."""

import re
import shutil
import sqlite3
import zipfile
from contextlib import closing
from importlib.resources import files
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from datasets import HOUR
from forks import LEFT, fork_dataset, through
from hypothesis import given
from hypothesis import strategies as st
from maps import Listener

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR, metric_crs, reprojected_position
from gis_radar.dataset import measure
from gis_radar.poses import ellipse, write_sensors
from gis_radar.products import write_site_project
from gis_radar.products.qgis.project_xml import TimeRange, fit_box, map_clock

SIGMA = {"easting": 0.1, "northing": 0.2, "height": 0.1, "yaw": 0.1, "pitch": 0.1, "roll": 0.1}


def a_pose(sensor="R1", **more):
    fields = {"crs": "EPSG:25832", "easting": 690360.0, "northing": 5336178.0, "height": 520.0,
              "yaw": 20.0, "pitch": 3.0, "roll": 0.0}  # fmt: skip
    evidence = {"evidence": more.pop("evidence", {})}
    return gr.Pose(sensor=sensor, **(fields | more), **evidence)


@given(
    st.floats(-180, 180), st.floats(-30, 30), st.sampled_from([0.0, 180.0]),
    st.floats(10, 170), st.floats(0.05, 0.95), st.floats(-0.95, 0.95),
)  # fmt: skip
def test_the_view_is_what_the_sensor_sees(yaw, pitch, roll, azimuth, far, aside):
    """Points straight ahead and aside within azimuth and range lie in it, seen from above."""
    view = gr.View(azimuth_deg=azimuth, max_range_m=100.0)
    pose = a_pose(yaw=yaw, pitch=pitch, roll=roll, view=view)
    outline = pose.outline()
    assert outline.is_valid
    angle = np.radians(azimuth / 2 * aside)
    ray = np.array([np.cos(angle), np.sin(angle), 0.0])
    reach = view.min_range_m + far * (view.max_range_m - view.min_range_m) * 0.99
    inside = pose.to_map((ray * reach)[None])[0]
    assert outline.buffer(0.2).contains(shapely.Point(*inside[:2]))
    beyond = pose.to_map((ray * view.max_range_m * 1.05)[None])[0]
    assert not outline.contains(shapely.Point(*beyond[:2]))


def test_the_ellipse_holds_95_percent():
    rng = np.random.default_rng(3)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = turn @ np.diag([0.04, 0.0025]) @ turn.T
    outline = ellipse(np.zeros(2), covariance)
    points = rng.multivariate_normal([0, 0], covariance, 20_000)
    share = shapely.contains_xy(outline, points[:, 0], points[:, 1]).mean()
    assert 0.94 < share < 0.96


def test_layers_of_sensors(tmp_path):
    path = tmp_path / "sensors.gpkg"
    known = a_pose("R1", evidence={"sigma": SIGMA, "fitness": 0.9, "method": "lane"})
    write_sensors([known, a_pose("R2", easting=690400.0)], path)
    points = gpd.read_file(path, layer="sensors")
    assert list(points["sensor"]) == ["R1", "R2"]
    assert points.geometry[1].x == 690400.0
    assert points["sigma_northing"][0] == 0.2
    assert np.isnan(points["sigma_northing"][1])
    assert len(gpd.read_file(path, layer="views")) == 2
    assert list(gpd.read_file(path, layer="uncertainty")["sensor"]) == ["R1"]
    with closing(sqlite3.connect(path)) as database:
        styled = database.execute("SELECT f_table_name FROM layer_styles WHERE useAsDefault")
        assert {name for (name,) in styled} == {"sensors", "views", "uncertainty"}


@pytest.mark.parametrize(
    ("poses", "name", "error"),
    [
        ([], "s.gpkg", gr.UsageError),
        ([a_pose()], "s.shp", gr.UsageError),
        ([a_pose(), a_pose("R2", crs="EPSG:25833")], "s.gpkg", gr.CrsError),
        ([a_pose(evidence={"covariance": [[1.0]]})], "s.gpkg", gr.InputError),
    ],
)
def test_sensors_that_are_refused(tmp_path, poses, name, error):
    with pytest.raises(error):
        write_sensors(poses, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Results of the sample as a run leaves them, with the pose that is known."""
    folder, sample = tmp_path_factory.mktemp("site") / "Straße", gr.sample_folder()
    (folder / "sensors" / "R1").mkdir(parents=True)
    known = gr.read_pose(sample / "R1.json")
    known.write(folder / "sensors" / "R1" / "pose.json")
    tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    problems = tiles.iloc[:0][["lanelet_id", "geometry"]].assign(action="", reason="")
    gr.write_tiles(tiles, folder / "tiles.gpkg", problems=problems)
    dataset = measure(
        [sample / "R1.parquet"],
        [known],
        tiles,
        None,
        folder / "dataset",
        hits_only=True,
        check=False,
    )
    gr.make_heatmap(dataset, interval="20s").write(folder / "heatmap")
    write_site_project(folder)
    return folder


def read_project(path):
    with zipfile.ZipFile(path) as archive:
        (name,) = archive.namelist()
        return ET.fromstring(archive.read(name))  # noqa: S314 - our own text


def test_a_project_of_a_site(results):
    assert write_site_project(results, title="Knoten 7") == [
        results / "sensors.gpkg",
        results / "sight.gpkg",
        results / "site.qgz",
    ]
    root = read_project(results / "site.qgz")
    assert root.findtext("title") == root.get("projectname") == "Knoten 7"
    layers = root.findall("projectlayers/maplayer")
    sources = [layer.findtext("datasource") for layer in layers]
    assert sources[0] == "./sensors.gpkg|layername=sensors"
    assert "./heatmap/heatmap.gpkg|layername=by_interval" in sources
    assert "./sight.gpkg|layername=sight" in sources
    assert all((results / source.split("|")[0]).exists() for source in sources)
    ids = [layer.findtext("id") for layer in layers]
    leaves = root.findall("layer-tree-group/layer-tree-group/layer-tree-layer")
    assert [leaf.get("id") for leaf in leaves] == ids
    assert all(len(key) > 10 for key in ids)
    span = root.find("ProjectTimeSettings/TemporalRange")
    assert span.findtext("start").startswith("2025-06-12T07:30:00")
    assert span.findtext("end").startswith("2025-06-12T07:31:40")
    step = root.find("ProjectTimeSettings")
    assert (step.get("timeStep"), step.get("timeStepUnit")) == ("20", "s")
    assert root.findtext("projectCrs/spatialrefsys/authid") == "EPSG:25832"


def test_a_project_opens_where_the_recording_has_begun(results, tmp_path):
    sample = gr.sample_folder()
    rows = pd.read_parquet(sample / "R1.parquet").query("time < time.min() + 25.0")
    rows.assign(time=rows["time"] - 0.1).to_parquet(tmp_path / "R1.parquet", index=False)
    tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    poses = [gr.read_pose(sample / "R1.json")]
    dataset = measure(
        [tmp_path / "R1.parquet"], poses, tiles, None, tmp_path / "dataset",
        hits_only=True, check=False,
    )  # fmt: skip
    gr.make_heatmap(dataset, interval="20s").write(tmp_path / "heatmap")
    gr.write_qgis_project(tmp_path / "site.qgz", heatmap=tmp_path / "heatmap")
    span = read_project(tmp_path / "site.qgz").find("ProjectTimeSettings/TemporalRange")
    assert span.findtext("start").startswith("2025-06-12T07:30:00")


def test_the_sight_of_a_site_is_what_its_dataset_has(results):
    layer = gpd.read_file(results / "sight.gpkg", layer="sight")
    sights = gr.open_dataset(results / "dataset").sights()
    in_sight = layer["state"] == "in sight"
    assert sorted(layer.loc[in_sight, "tile_id"]) == sorted(sights["tile_id"])
    assert in_sight.all()  # without a scan nothing is hidden


def test_the_same_results_give_the_same_project(results, tmp_path):
    paths = []
    for name in "ab":
        place = tmp_path / name
        place.mkdir()
        paths.append(place / "site.qgz")
        (place / "heatmap").symlink_to(results / "heatmap")
        gr.write_qgis_project(paths[-1], heatmap=place / "heatmap", title="x")
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_heat_map_may_be_named_by_its_file(results, tmp_path):
    for name in ("a.qgz", "b.qgz"):
        place = results / "heatmap" if name == "a.qgz" else results / "heatmap" / "heatmap.gpkg"
        gr.write_qgis_project(tmp_path / name, heatmap=place, title="x")
    first, second = (read_project(tmp_path / name) for name in ("a.qgz", "b.qgz"))
    assert [each.text for each in first.iter("datasource")] == [
        each.text for each in second.iter("datasource")
    ]


FOREIGN = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.40"><editforminitcode>import os; os.abort()</editforminitcode>
<attributeactions><actionsetting action="[% env('PATH') %]" type="1" /></attributeactions>
<renderer-v2 type="singleSymbol"><symbols><symbol name="http://198.51.100.1/x.svg" /></symbols>
</renderer-v2><mapTip>[% env('PATH') %]</mapTip></qgis>"""


def test_no_style_of_a_heat_map_that_was_given_comes_into_the_project(results, tmp_path):
    """Code of forms, actions and expressions: a project shows what gis_radar writes itself."""
    heatmap, project = (
        shutil.copytree(results / "heatmap", tmp_path / "heatmap"),
        tmp_path / "p.qgz",
    )
    gr.write_qgis_project(project, heatmap=heatmap)
    before = project.read_bytes()
    with closing(sqlite3.connect(heatmap / "heatmap.gpkg")) as database, database:
        query = "SELECT f_table_name, styleQML FROM layer_styles"
        ours = dict(database.execute(query).fetchall())
        database.execute("UPDATE layer_styles SET styleQML = ?", (FOREIGN,))
    gr.write_qgis_project(project, heatmap=heatmap)
    assert project.read_bytes() == before
    layers = {layer.findtext("id"): layer for layer in read_project(project).iter("maplayer")}
    for name, qml in ours.items():
        own = ET.fromstring(qml[qml.index("<qgis") :]).find("renderer-v2")  # noqa: S314 - our own
        there = layers[f"gis_radar_{name}"].find("renderer-v2")
        assert ET.canonicalize(ET.tostring(there), strip_text=True) == ET.canonicalize(
            ET.tostring(own), strip_text=True
        )


def test_the_print_layout_of_a_project(results, tmp_path):
    gr.write_qgis_project(
        tmp_path / "site.qgz", heatmap=results / "heatmap", sensors=results / "sensors.gpkg",
        title="Knoten [% 1+1 %][%3%]", timezone="Europe/Berlin", source="Stadt & Land [% 2 %]",
    )  # fmt: skip
    root = read_project(tmp_path / "site.qgz")
    layout = root.find("Layouts/Layout")
    texts = [item.get("labelText") for item in layout.iter("LayoutItem") if item.get("labelText")]
    assert texts[:2] == [  # QGIS prints the title as it was given: `[%` is a text in it
        "Knoten [% '[' || '%' %] 1+1 %][% '[' || '%' %]3%]",
        "12 June 2025, 09:30:00 to 09:31:40 (Europe/Berlin, UTC+02:00)"
    ]  # fmt: skip
    assert texts[2].startswith("Hit share: the share of the observed time")
    assert texts[3] == "Source: Stadt & Land [% '[' || '%' %] 2 %]"
    names = {layer.findtext("id"): layer.findtext("layername") for layer in root.iter("maplayer")}
    shown = [names[layer.text] for layer in layout.iter("Layer")]
    assert shown == ["Sensors", "Views",
                     "Hit share, whole time", "Road, not observed"]  # fmt: skip
    explained = [names[leaf.get("id")] for leaf in layout.iter("layer-tree-layer")]
    assert explained[:2] == ["Hit share, whole time", "Road, not observed"]
    assert sorted(explained) == sorted(shown)


def test_a_sheet_ends_with_what_was_recorded_and_not_with_its_last_interval(results, tmp_path):
    """As the report; a quarter of an hour goes on when the recording has ended."""
    dataset = gr.open_dataset(results / "dataset")
    gr.make_heatmap(dataset, interval="15min").write(tmp_path / "heatmap")
    gr.write_qgis_project(tmp_path / "site.qgz", heatmap=tmp_path / "heatmap")
    layout = read_project(tmp_path / "site.qgz").find("Layouts/Layout")
    texts = [item.get("labelText") for item in layout.iter("LayoutItem")]
    assert "12 June 2025, 07:30:00 to 07:31:40 (UTC)" in texts


def test_no_id_of_a_layer_begins_another():
    """QGIS's lists of layers find one by the beginning of its id; what they keep crashes it."""
    text = files("gis_radar").joinpath("products/qgis/project.qgs").read_text(encoding="utf-8")
    template = ET.fromstring(text)  # noqa: S314 - our own text
    ids = [node.text for node in template.iter("id")]
    assert len(ids) > 9
    assert [(a, b) for a in ids for b in ids if a != b and b.startswith(a)] == []


@given(
    st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(1, 1e4), st.floats(1, 1e4),
)  # fmt: skip
def test_the_map_on_the_sheet_holds_all_in_its_shape(west, south, wide, high):
    box = (west, south, west + wide, south + high)
    found = shapely.box(*fit_box(box, 215.0, 149.0))
    assert found.buffer(1e-6).contains(shapely.box(*box))
    x0, y0, x1, y1 = found.bounds
    assert (x1 - x0) / (y1 - y0) == pytest.approx(215.0 / 149.0, rel=1e-6)


def test_a_project_that_somebody_edited_stays(results, tmp_path):
    folder = shutil.copytree(results, tmp_path / "site")
    project, second = folder / "site.qgz", folder / "site_2.qgz"
    write_site_project(folder, title="Mine")  # nobody has touched it: written anew
    with zipfile.ZipFile(project) as archive:
        text = archive.read("site.qgs").replace(b"Mine", b"Edited")
    with zipfile.ZipFile(project, "w") as archive:  # as QGIS saves it
        archive.writestr("site.qgs", text)
    edited, heard = project.read_bytes(), Listener()
    for title in ("New", "Newer"):
        assert write_site_project(folder, title=title, reporter=heard)[-1] == second
        assert read_project(second).findtext("title") == title
    assert project.read_bytes() == edited
    assert "site.qgz was edited" in str(heard.messages)
    with pytest.raises(gr.OutputError, match="edited"):
        gr.write_qgis_project(project, heatmap=folder / "heatmap")
    second.write_bytes(b"no archive")
    assert write_site_project(folder)[-1].name == "site_3.qgz"
    assert second.read_bytes() == b"no archive"
    assert project.read_bytes() == edited


def test_projects_that_are_refused(results, tmp_path):
    with pytest.raises(gr.UsageError, match=r"\.qgz"):
        gr.write_qgis_project(tmp_path / "p.qgs", heatmap=results / "heatmap")
    with pytest.raises(gr.InputError, match="no such file"):
        gr.write_qgis_project(tmp_path / "p.qgz", heatmap=tmp_path)
    (tmp_path / "heatmap.gpkg").write_bytes(b"SQLite format 3\0 and no more")
    with pytest.raises(gr.InputError, match="not a heat map"):
        gr.write_qgis_project(tmp_path / "p.qgz", heatmap=tmp_path)
    assert not (tmp_path / "p.qgz").exists()


@pytest.mark.parametrize("code", [31467, 3857])
def test_a_guess_in_another_system(code):
    there = reprojected_position((690356.0, 5336183.0), "EPSG:25832", metric_crs(code, what=""))
    back = reprojected_position((*there, 521.0), f"EPSG:{code}", metric_crs(25832, what=""))
    assert back == pytest.approx((690356.0, 5336183.0, 521.0), abs=1e-3)


def test_a_guess_in_degrees_is_refused():
    with pytest.raises(gr.CrsError):
        reprojected_position((11.5, 48.1), "EPSG:4326", metric_crs(25832, what=""))


def test_a_project_in_german(results, tmp_path):
    """Names of layers, classes, dates and the sheet; what QGIS finds layers by stays."""
    path = tmp_path / "site.qgz"
    gr.write_qgis_project(
        path, heatmap=results / "heatmap", sensors=results / "sensors.gpkg", source="Stadt",
        language="de",
    )  # fmt: skip
    root = read_project(path)
    names = {layer.findtext("id"): layer.findtext("layername") for layer in root.iter("maplayer")}
    assert names["gis_radar_heatmap"] == "Trefferanteil, gesamter Zeitraum"
    leaves = {leaf.get("id"): leaf.get("name") for leaf in root.iter("layer-tree-layer")}
    assert {key: leaves[key] for key in names} == names
    labels = [each.get("label") for each in root.iter("range")]
    assert labels[:3] == ["0 %, nie getroffen", "bis 0,5 %", "0,5 bis 1 %"]
    layout = root.find("Layouts/Layout")
    assert layout.get("name") == "Bericht"
    texts = [item.get("labelText") or "" for item in layout.iter("LayoutItem")]
    assert "Quelle: Stadt" in texts
    assert any("dd.MM.yyyy" in text for text in texts)
    assert any(text.startswith("Trefferanteil: der Anteil") for text in texts)
    assert "dd.MM.yyyy" in root.findtext("properties/TitleLabel/Label")
    labels = [each.get("fieldName") for each in root.iter("text-style")]
    assert any("^2), 2, 'de')" in text for text in labels)  # 0,64 m, however QGIS is set
    with pytest.raises(gr.UsageError, match="there is no language 'fr'"):
        gr.write_qgis_project(path, heatmap=results / "heatmap", language="fr")


def test_occupancy_and_hit_share_are_two_fields(tmp_path):
    """Layers are renamed to the measure they show, fields keep their names."""
    dataset = fork_dataset(tmp_path / "dataset", [through(0, HOUR * STEPS_PER_HOUR + 200, LEFT)])
    gr.make_heatmap(dataset, interval="5s").write(tmp_path / "heatmap")
    gr.write_qgis_project(tmp_path / "site.qgz", heatmap=tmp_path / "heatmap", language="de")
    layers = {
        layer.findtext("layername"): {
            each.get("field"): each.get("name") for each in layer.iter("alias")
        }
        for layer in read_project(tmp_path / "site.qgz").iter("maplayer")
    }
    whole, ground = layers["Belegungsgrad, gesamter Zeitraum"], layers["Straße, nicht beobachtet"]
    assert (whole["occupancy"], whole["hit_share"]) == ("Belegungsgrad", "Trefferanteil")
    assert ground == whole
    assert layers["Belegungsgrad je Intervall"]["hit_share"] == "Trefferanteil"
    parts = {field: name for field, name in whole.items() if re.match(r"(hit|occ)_\d", field)}
    assert len(parts) == 4
    for field, name in parts.items():
        title, _, begin = name.rpartition(" ")
        assert title == whole["occupied_s" if field.startswith("occ") else "hit_s"]
        assert re.sub("[-:Z]", "", begin) == field[4:]


def test_the_map_clock_is_the_sites_over_a_change_of_clocks():
    """The offsets stand in the expression, as QGIS's know no zones; tried in QGIS by hand."""
    begin, end = "2025-10-25T22:00:00Z", "2025-10-26T23:00:00Z"
    text = map_clock(TimeRange(begin, end, 3600.0, "Europe/Berlin"), "de")
    assert text.count("< '2025-10-26T01:00:00', '7200 seconds', '3600 seconds'") == 2
    assert "' (Europe/Berlin, UTC+02:00)', ' (Europe/Berlin, UTC+01:00)'" in text
    assert "array_contains(@map_layer_ids, 'gis_radar_by_interval')" in text
    for name in ("America/New_York", "Asia/Kolkata"):
        assert name not in text
    west = map_clock(TimeRange(begin, begin, 0.5, "America/St_Johns"), "en")
    assert "'-9000 seconds'" in west
    assert "UTC-02:30" in west
