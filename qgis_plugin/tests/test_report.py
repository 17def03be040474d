"""Sheets in batch: PDF and PNG over places and intervals, and a project to change them by hand."""

import pytest
from conftest import SAMPLE
from helpers import Feedback, leftovers, one_sentence
from qgis.core import (
    QgsFeature,
    QgsGeometry,
    QgsLayoutItemLabel,
    QgsLayoutItemLegend,
    QgsLayoutItemMap,
    QgsLayoutItemPicture,
    QgsLayoutItemScaleBar,
    QgsPointXY,
    QgsProject,
    QgsVectorLayer,
)
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


@pytest.fixture
def report(run, site, tmp_path):
    results, heard = run(
        "exportreport",
        {
            "HEATMAP": str(site / "heatmap"), "PLACES": junctions(), "DPI": 60,
            "SENSORS": str(site / "sensors.gpkg"), "TIME_ZONE": "Europe/Berlin",
            "TITLE": "Verkehr", "SOURCE": "Stadt", "OUTPUT": str(tmp_path / "report"),
        },
    )  # fmt: skip
    assert heard.errors == []
    assert heard.percents
    return tmp_path / "report"


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
    assert "Verkehr: Nord/Süd" in texts
    assert "Source: Stadt" in texts
    assert any("09:30:00 – 09:30:20 (UTC+2)" in text for text in texts)
    assert any(text.endswith("2 / 12") for text in texts)
    (chart,) = [item for item in layout.items() if isinstance(item, QgsLayoutItemMap)]
    assert chart.temporalRange().begin().toString("HH:mm:ss") == "07:30:00"
    shown = {layer.name() for layer in chart.layersToRender()}
    assert "Occupancy by interval" in shown
    assert "Occupancy, whole time" not in shown
    atlas.endRender()


def test_a_report_replaces_an_earlier_one(run, report, site):
    before = len(list(report.iterdir()))
    results, heard = run(
        "exportreport",
        {"HEATMAP": str(site / "heatmap"), "WHAT": 1, "DPI": 60, "OUTPUT": str(report)},
    )
    assert heard.errors == []
    assert sorted(path.name for path in report.iterdir()) == [
        "Overview_whole.png", "pages.gpkg", "report.pdf", "report.qgz",
    ]  # fmt: skip
    assert before > 4


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
        ({"HEATMAP": str(SAMPLE)}, "is no heat map"),
        ({"OUTPUT": "/proc/gis_radar/report"}, "/proc/gis_radar"),
    ],
)
def test_refusals(run, site, tmp_path, given, said):
    call = {"HEATMAP": str(site / "heatmap"), "OUTPUT": str(tmp_path / "report")}
    results, heard = run("exportreport", call | given)
    assert results is None
    assert said in one_sentence(heard)
    assert leftovers(tmp_path) == []


def test_a_folder_of_others_is_left_alone(run, site, tmp_path):
    (tmp_path / "notes.txt").touch()
    call = {"HEATMAP": str(site / "heatmap"), "OUTPUT": str(tmp_path)}
    results, heard = run("exportreport", call)
    assert results is None
    assert "notes.txt" in one_sentence(heard)
