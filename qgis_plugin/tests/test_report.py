"""Sheets in batch: PDF and PNG over places and intervals, and a project to change them by hand."""

import shutil
import sqlite3
import zipfile
from contextlib import closing

import pytest
from conftest import SAMPLE, WORKER
from helpers import Feedback, leftovers, one_sentence, run_algorithm
from osgeo import ogr
from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsExpressionContext,
    QgsExpressionContextUtils,
    QgsFeature,
    QgsGeometry,
    QgsLayoutItemLabel,
    QgsLayoutItemLegend,
    QgsLayoutItemMap,
    QgsLayoutItemPicture,
    QgsLayoutItemScaleBar,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsPointXY,
    QgsProject,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QDateTime, QSize, Qt
from qgis.PyQt.QtGui import QImage


def junctions():
    """Two places drawn by hand, in degrees as planners may have them."""
    layer = QgsVectorLayer("Point?crs=EPSG:4326&field=name:string", "junctions", "memory")
    for name, east, north in (("Nord/Süd", 11.5598, 48.1506), ("Ost", 11.5606, 48.1507)):
        row = QgsFeature(layer.fields())
        row["name"] = name
        row.setGeometry(QgsGeometry.fromPointXY(QgsPointXY(east, north)))
        assert layer.dataProvider().addFeatures([row])[0]
    QgsProject.instance().addMapLayer(layer)
    return layer.id()


@pytest.fixture(scope="module")
def report(provider, site, once):
    """A report, only to be read."""
    return once("report", lambda folder: export(site, folder / "report")) / "report"


def export(site, out):
    QgsProject.instance().clear()
    with pytest.MonkeyPatch.context() as around:
        around.setenv("GIS_RADAR_PYTHON", WORKER)
        results, heard = run_algorithm(
            "exportreport",
            {
                "HEATMAP": str(site / "heatmap"), "PLACES": junctions(), "DPI": 60,
                "SENSORS": str(site / "sensors.gpkg"), "WHAT": 0,
                "TITLE": "Verkehr [% 1+1 %]", "SOURCE": "Stadt [% env('PATH') %]",
                "OUTPUT": str(out),
            },
        )  # fmt: skip
    QgsProject.instance().clear()
    assert heard.errors == []
    assert heard.percents


@pytest.fixture
def earlier_report(report, tmp_path):
    """A report of one's own."""
    return shutil.copytree(report, tmp_path / "report")


def test_lanes_are_those_of_the_heat_maps_own_tiles(provider, site, tmp_path):
    from gis_radar_plugin.report.export import lanes_beside

    package = site / "heatmap" / "heatmap.gpkg"
    assert lanes_beside(package) == site / "tiles.gpkg"
    other = tmp_path / "site"
    (other / "heatmap").mkdir(parents=True)
    shutil.copy(package, other / "heatmap")
    shutil.copy(site / "tiles.gpkg", other)
    copied = other / "heatmap" / "heatmap.gpkg"
    assert lanes_beside(copied) == other / "tiles.gpkg"
    tiles = QgsVectorLayer(f"{other / 'tiles.gpkg'}|layername=tiles")
    assert tiles.dataProvider().deleteFeatures([next(tiles.getFeatures()).id()])
    del tiles
    assert lanes_beside(copied) is None  # tiles of another map


def test_sheets_are_named_as_their_heat_map(provider, site, monkeypatch):
    """The title and the sources of the site, unless others are given."""
    from gis_radar_plugin.algorithms import report as sheets

    class Asked:
        def __init__(self, **given):
            self.given = {"HEATMAP": str(site / "heatmap"), **given}

        def text(self, name):
            return self.given.get(name, "")

    title, source = sheets.title_and_source(Asked())
    assert title == "Sample junction (simulated)"
    assert source.endswith("the place is invented")
    assert sheets.title_and_source(Asked(TITLE="Ost", SOURCE="Stadt")) == ("Ost", "Stadt")
    for told in ({}, {"title": None, "sources": "x"}, {"title": "", "sources": []}):
        monkeypatch.setattr(sheets, "labels_of", lambda _, told=told: told)
        assert sheets.title_and_source(Asked()) == (
            "Traffic on the lanes",
            "roadside radar, gis_radar",
        )


def test_a_page_for_each_place_and_time(report):
    names = sorted(path.name for path in report.iterdir())
    times = ["20250612T073000Z", "20250612T073020Z", "20250612T073040Z", "20250612T073100Z",
             "20250612T073120Z", "whole"]  # fmt: skip
    pages = [f"{place}_{time}.png" for place in ("Nord_Süd", "Ost") for time in times]
    assert names == sorted([*pages, "pages.gpkg", "report.pdf", "report.qgz"])
    pdf = (report / "report.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") >= 12
    assert leftovers(report.parent) == []


def test_pages_show_their_time_and_place(report):
    pictures = {path.stem: QImage(str(path)) for path in report.glob("*.png")}
    assert len({(p.width(), p.height()) for p in pictures.values()}) == 1
    maps = {name: map_part(picture) for name, picture in pictures.items()}
    for name, part in maps.items():
        assert len({part.pixel(x, y) for x in range(0, part.width(), 3)
                    for y in range(0, part.height(), 3)}) > 20, name  # fmt: skip
    names = list(maps)
    same = [(a, b) for a in names for b in names if a < b and maps[a] == maps[b]]
    assert same == []


def map_part(picture):
    """Cut out the map, without title and page number."""
    wide, high = picture.width(), picture.height()
    return picture.copy(int(wide * 0.06), int(high * 0.2), int(wide * 0.65), int(high * 0.6))


def test_the_layout_has_all_of_a_sheet(report, qgis_new_project):
    project = QgsProject.instance()
    assert project.read(str(report / "report.qgz"))
    assert all(layer.isValid() for layer in project.mapLayers().values())
    layout = project.layoutManager().layoutByName("Report")
    kinds = {type(item) for item in layout.items()}
    assert {QgsLayoutItemMap, QgsLayoutItemLegend, QgsLayoutItemScaleBar,
            QgsLayoutItemPicture, QgsLayoutItemLabel} <= kinds  # fmt: skip
    atlas = layout.atlas()
    assert atlas.enabled()
    assert atlas.updateFeatures() == 12
    atlas.beginRender()
    assert atlas.first()
    assert atlas.next()
    texts = [item.currentText() for item in layout.items() if isinstance(item, QgsLayoutItemLabel)]
    assert "Verkehr [% 1+1 %]: Nord/Süd" in texts  # as typed, not evaluated
    assert "Source: Stadt [% env('PATH') %]" in texts
    assert any("09:30:00 – 09:30:20 (Europe/Berlin, UTC+02:00)" in text for text in texts)
    assert any(text.startswith("Occupancy: the estimated share") for text in texts)
    assert not any(text.startswith("Hit share") for text in texts)
    assert any(text.endswith("2 / 12") for text in texts)
    (chart,) = [item for item in layout.items() if isinstance(item, QgsLayoutItemMap)]
    assert chart.temporalRange().begin().toString("HH:mm:ss") == "07:30:00"
    shown = {layer.name() for layer in chart.layersToRender()}
    assert {"Occupancy by interval", "Lanes", "Stop lines", "Sensors"} <= shown
    assert "Occupancy, whole time" not in shown
    atlas.endRender()


FORM = "<editforminitcode>import os; os.abort()</editforminitcode>"


def test_no_code_of_a_style_comes_onto_the_sheets(run, site, tmp_path, qgis_new_project):
    """A heat map from elsewhere may have forms and actions; its symbols are drawn, no more."""
    heat = shutil.copytree(site / "heatmap", tmp_path / "heatmap")
    with closing(sqlite3.connect(heat / "heatmap.gpkg")) as database, database:
        change = "UPDATE layer_styles SET styleQML = replace(styleQML, '<mapTip', ? || '<mapTip')"
        database.execute(change, (FORM,))
    assert (
        "abort"
        in QgsVectorLayer(f"{heat}/heatmap.gpkg|layername=heatmap").editFormConfig().initCode()
    )
    out = tmp_path / "report"
    _, heard = run("exportreport", {"HEATMAP": str(heat), "OVER": 1, "DPI": 50, "OUTPUT": str(out)})
    assert heard.errors == []
    with zipfile.ZipFile(out / "report.qgz") as archive:
        assert all(b"os.abort" not in archive.read(name) for name in archive.namelist())
    assert QgsProject.instance().read(str(out / "report.qgz"))
    (layer,) = QgsProject.instance().mapLayersByName("Occupancy, whole time")
    assert layer.renderer().classAttribute() == "occupancy"


def test_a_report_replaces_an_earlier_one(run, earlier_report, site):
    before = len(list(earlier_report.iterdir()))
    results, heard = run(
        "exportreport",
        {
            "HEATMAP": str(site / "heatmap"),
            "WHAT": 1,
            "OVER": 1,
            "DPI": 60,
            "OUTPUT": str(earlier_report),
        },
    )
    assert heard.errors == []
    assert sorted(path.name for path in earlier_report.iterdir()) == [
        "Overview_whole.png", "pages.gpkg", "report.pdf", "report.qgz",
    ]  # fmt: skip
    assert before > 4


def test_places_are_found_without_a_layer(run, site, tmp_path):
    """Nothing but a heat map is given: the overview marks the frame of the junction."""
    out, places = tmp_path / "report", ["Junction_1", "Overview"]
    call = {"HEATMAP": str(site / "heatmap"), "WHAT": 1, "DPI": 110}
    results, heard = run("exportreport", call | {"OUTPUT": str(out)})
    assert heard.errors == []
    assert sorted(path.stem for path in out.glob("*.png")) == [f"{name}_whole" for name in places]
    assert QgsProject.instance().read(str(out / "report.qgz"))
    assert len(QgsProject.instance().mapLayersByName("Sensors")) == 1
    overview, junction = (QImage(str(out / f"{name}_whole.png")) for name in reversed(places))
    assert blue_dots(overview) > 50 + 2 * blue_dots(junction)  # without a frame of its own


def blue_dots(picture):
    """Count the dots in the colour of frames."""
    dots = picture.convertToFormat(QImage.Format.Format_RGBA8888)
    data = dots.constBits().asstring(dots.sizeInBytes())
    return sum(data[at : at + 3] == b"\x1d\x4e\xd8" for at in range(0, len(data), 4))


def lanes(*rows):
    """Tiles of straight lanes: id, height, observed time, and the points on them."""
    layer = QgsVectorLayer(
        "Polygon?crs=EPSG:25832&field=lanelet_id:integer&field=index:integer"
        "&field=height_m:double&field=observed_s:double", "heatmap", "memory",
    )  # fmt: skip
    for lanelet, height, observed, start, step in rows:
        for index in range(60):
            row = QgsFeature(layer.fields())
            row.setAttributes([lanelet, index, height, observed])
            x, y = start[0] + index * step[0], start[1] + index * step[1]
            row.setGeometry(QgsGeometry.fromPointXY(QgsPointXY(x, y)).buffer(0.25, 1))
            assert layer.dataProvider().addFeatures([row])[0]
    return layer


@pytest.mark.parametrize(
    ("second", "number"),
    [
        ((2, 0.0, 9.0, (15.0, -15.0), (0.0, 0.5)), 1),  # across
        ((2, None, 9.0, (15.0, -15.0), (0.0, 0.5)), 1),  # across, its height not known
        ((2, 6.0, 9.0, (15.0, -15.0), (0.0, 0.5)), 0),  # a bridge
        ((2, 0.0, 0.0, (15.0, -15.0), (0.0, 0.5)), 0),  # across, never observed
        ((2, 0.0, 9.0, (0.0, 0.4), (0.5, 0.0)), 0),  # beside
        ((2, 0.0, 9.0, (0.0, -2.0), (0.5, 0.1)), 0),  # merging
    ],
)
def test_what_is_a_junction(qgis_app, second, number):
    from gis_radar_plugin.report.junctions import junctions_of

    boxes = junctions_of(lanes((1, 0.0, 9.0, (0.0, 0.0), (0.5, 0.0)), second))
    assert len(boxes) == number
    for box in boxes:
        assert abs(box.center().x() - 15.0) < 2.0
        assert abs(box.center().y()) < 2.0


def test_junctions_far_apart_are_two(qgis_app):
    from gis_radar_plugin.report.junctions import junctions_of

    across = [(2, 0.0, 9.0, (2.0, -5.0), (0.0, 0.5)), (3, 0.0, 9.0, (60.0, -5.0), (0.0, 0.5))]
    near = (4, 0.0, 9.0, (8.0, -5.0), (0.0, 0.5))
    boxes = junctions_of(lanes((1, 0.0, 9.0, (0.0, 0.0), (1.2, 0.0)), near, *across))
    assert [round(box.center().x() / 10) for box in boxes] in ([0, 6], [1, 6], [6, 0], [6, 1])


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("Point", "has no coordinate system"),
        ("Point?crs=EPSG:25832", "holds nothing"),
        ("Point?crs=EPSG:4326", "has a place that is none on earth: Place 1"),
    ],
)
def test_places_that_are_none(run, site, tmp_path, kind, said):
    layer = QgsVectorLayer(kind, "mine", "memory")
    if said.startswith("has no"):
        layer.setCrs(QgsCoordinateReferenceSystem())
    if "on earth" in said:
        row = QgsFeature()
        row.setGeometry(QgsGeometry.fromPointXY(QgsPointXY(400.0, 95.0)))
        assert layer.dataProvider().addFeatures([row])[0]
    QgsProject.instance().addMapLayer(layer)
    call = {"HEATMAP": str(site / "heatmap"), "PLACES": layer.id()}
    results, heard = run("exportreport", call | {"OUTPUT": str(tmp_path / "report")})
    assert results is None
    assert said in one_sentence(heard)
    assert list(tmp_path.iterdir()) == []


def test_a_cancelled_report_leaves_nothing(run, site, tmp_path):
    results, heard = run(
        "exportreport",
        {"HEATMAP": str(site / "heatmap"), "DPI": 60, "OUTPUT": str(tmp_path / "report")},
        feedback=Feedback(cancel_after=2),
    )
    assert results is None
    assert one_sentence(heard) == "Cancelled; nothing was left half-written."
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"TIME_ZONE": "Middle/Earth"}, "'Middle/Earth' is no time zone"),
        ({"HEATMAP": str(SAMPLE)}, "heatmap.gpkg: no such file"),
        ({"OUTPUT": "/proc/gis_radar/report"}, "/proc/gis_radar"),
        ({"SENSORS": "/nowhere/sensors.gpkg"}, "/nowhere/sensors.gpkg is no file of sensors"),
    ],
)
def test_refusals(run, site, tmp_path, given, said):
    call = {"HEATMAP": str(site / "heatmap"), "OUTPUT": str(tmp_path / "report")}
    results, heard = run("exportreport", call | given)
    assert results is None
    assert said in one_sentence(heard)
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("name", ["notes.txt", "photo.png"])
def test_a_folder_of_others_is_left_alone(run, site, tmp_path, name):
    (tmp_path / name).touch()
    call = {"HEATMAP": str(site / "heatmap"), "OUTPUT": str(tmp_path)}
    results, heard = run("exportreport", call)
    assert results is None
    assert name in one_sentence(heard)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_picture_among_those_of_a_report_is_left_alone(run, earlier_report, site):
    (earlier_report / "photo.png").touch()
    before = sorted(earlier_report.iterdir())
    call = {"HEATMAP": str(site / "heatmap"), "OUTPUT": str(earlier_report)}
    results, heard = run("exportreport", call)
    assert results is None
    assert "photo.png" in one_sentence(heard)
    assert sorted(earlier_report.iterdir()) == before


def test_places_whose_files_would_be_one(qgis_app):
    from gis_radar_plugin.report.pages import Page, Place, with_distinct_names

    frame, time = QgsGeometry(), QDateTime.currentDateTimeUtc()
    places = with_distinct_names(
        [Place(name, frame) for name in ("Ost/West", "Ost West", "ost west", "Süd")]
    )
    files = [Page(place, time, time, whole=True).file_name().lower() for place in places]
    assert len(set(files)) == 4


def test_one_interval_is_the_whole_time(qgis_app):
    """A heat map without intervals has no page twice."""
    from gis_radar_plugin.report.pages import Place, pages_of

    time = QDateTime.currentDateTimeUtc()
    place, spans = Place("all", QgsGeometry()), [(time, time.addSecs(60))]
    assert [page.whole for page in pages_of([place], spans, whole=True, each=True)] == [True]
    assert [page.whole for page in pages_of([place], spans, whole=False, each=True)] == [False]
    spans.append((time.addSecs(60), time.addSecs(120)))
    assert len(list(pages_of([place], spans, whole=True, each=True))) == 3


def test_a_sheet_of_the_whole_time_ends_with_what_was_recorded(site, qgis_app):
    """The last interval may go on: the report and the project name what was recorded, too."""
    from gis_radar_plugin.report.pages import Place, pages_of, recorded_in

    recorded = recorded_in(site / "heatmap" / "heatmap.gpkg")
    begin, end = (each.toString(Qt.DateFormat.ISODate) for each in recorded)
    assert (begin, end) == ("2025-06-12T07:30:00Z", "2025-06-12T07:31:40Z")
    spans = [(recorded[0], recorded[0].addSecs(900))]
    (page,) = pages_of(
        [Place("all", QgsGeometry())], spans, whole=True, each=True, recorded=recorded
    )
    assert page.end == recorded[1]
    assert recorded_in(site / "no.gpkg") is None


@pytest.mark.parametrize(
    ("end", "text"),
    [
        ("07:30:00.300", "07:30:00.000 \u2013 07:30:00.300 (UTC)"),
        ("07:30:09.950", "07:30:00.000 \u2013 07:30:09.950 (UTC)"),
        ("07:30:10.050", "07:30:00 \u2013 07:30:10 (UTC)"),
    ],
)  # fmt: skip
def test_a_sheet_of_a_moment_names_its_milliseconds(qgis_app, tmp_path, end, text):
    """As the report, whose bound is 10 s: begin and end are never the same."""
    from gis_radar_plugin.report.pages import local_time, recorded_in, timezone

    package = ogr.GetDriverByName("GPKG").CreateDataSource(str(tmp_path / "heatmap.gpkg"))
    layer = package.CreateLayer("heatmap")
    layer.SetMetadataItem("begin", "2025-06-12T07:30:00Z")
    layer.SetMetadataItem("end", f"2025-06-12T{end}Z")
    del layer, package
    recorded = recorded_in(tmp_path / "heatmap.gpkg")
    assert local_time(*recorded, timezone("UTC")).endswith(text)


def test_a_frame_that_begins_beyond_the_overview_has_its_name(qgis_app, tmp_path):
    """Frames reach over the overview's edge, as their corners with the names do."""
    from gis_radar_plugin.report.export import write_pages
    from gis_radar_plugin.report.pages import Page, Place, timezone

    time, crs = QDateTime.currentDateTimeUtc(), QgsCoordinateReferenceSystem("EPSG:25832")
    frames = {"all": (0, 0, 100, 100), "in": (40, 40, 60, 60), "out": (-20, 70, 20, 120)}
    pages = [
        Page(Place(name, QgsGeometry.fromRect(QgsRectangle(*box))), time, time, whole=True)
        for name, box in frames.items()
    ]
    layer = write_pages(tmp_path / "pages.gpkg", pages, {True: ""}, crs, timezone("UTC"))
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setDestinationCrs(crs)
    settings.setOutputSize(QSize(600, 600))
    settings.setExtent(QgsRectangle(*frames["all"]))
    context = QgsExpressionContext()
    context.appendScope(QgsExpressionContextUtils.mapSettingsScope(settings))
    context.lastScope().setVariable("atlas_feature", next(layer.getFeatures()))
    settings.setExpressionContext(context)
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    names = {label.labelText for label in job.takeLabelingResults().allLabels()}
    assert names == {"in", "out"}
