"""The site wizard in QGIS: radars placed on the map, the file checked by the worker, its run."""

import math
import shutil

import pytest
from conftest import SAMPLE
from qgis.core import QgsApplication, QgsCoordinateReferenceSystem, QgsPointXY, QgsProject
from qgis.gui import QgsMapCanvas, QgsMessageBar
from qgis.PyQt.QtCore import QPoint, Qt
from qgis.PyQt.QtTest import QTest
from qgis.PyQt.QtWidgets import QApplication, QMainWindow


class Window:
    """As much of QGIS's window as the wizard asks for."""

    def __init__(self):
        self.main, self.opened = QMainWindow(), []
        self.canvas, self.bar = QgsMapCanvas(self.main), QgsMessageBar(self.main)
        self.main.setCentralWidget(self.canvas)
        self.main.resize(800, 600)
        self.main.show()  # the canvas gets its size

    def mainWindow(self):
        return self.main

    def mapCanvas(self):
        return self.canvas

    def messageBar(self):
        return self.bar

    def addProject(self, path):
        self.opened.append(path)


def wait_until(test, seconds=60.0):
    for _ in range(int(seconds * 20)):
        QApplication.processEvents()
        if test():
            return
        QTest.qWait(50)
    pytest.fail("nothing came of it in time")


@pytest.fixture
def wizard(provider, qgis_new_project):
    from gis_radar_plugin.wizard.wizard import SiteWizard

    opened = SiteWizard(Window())
    opened.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose, False)
    opened.show()
    yield opened
    wait_until(lambda: not QgsApplication.taskManager().activeTasks())
    opened.done(0)


@pytest.fixture
def place(tmp_path):
    folder = tmp_path / "Straße mit Ümlaut"
    folder.mkdir()
    for name in ("junction.osm", "scan.laz", "R1.parquet", "R2.parquet"):
        shutil.copyfile(SAMPLE / name, folder / name)
    return folder


def pixel(wizard, east, north):
    canvas = wizard.canvas
    from gis_radar_plugin.wizard.canvas import moved

    point = moved(QgsPointXY(east, north), wizard.lanes.crs, canvas.mapSettings().destinationCrs())
    found = canvas.getCoordinateTransform().transform(point)
    return QPoint(round(found.x()), round(found.y()))


def drag(wizard, start, end):
    view, left = wizard.canvas.viewport(), Qt.MouseButton.LeftButton
    none = Qt.KeyboardModifier.NoModifier
    QTest.mousePress(view, left, none, pixel(wizard, *start))
    QTest.mouseMove(view, pixel(wizard, *end))
    QTest.mouseRelease(view, left, none, pixel(wizard, *end))


def colour_at(wizard, radar):
    """Return the colour of the map where a radar stands."""
    drawn = wizard.canvas.grab().toImage()
    return drawn.pixelColor(pixel(wizard, radar.easting, radar.northing)).name()


def place_radars(wizard, place):
    """Place one radar by a drag, the other by a click, and name their recordings."""
    radars = wizard.radar_page
    assert not radars.isComplete()
    radars.place_button.click()
    assert not wizard.isVisible()  # the map is free
    drag(wizard, (690356.0, 5336183.0), (690436.0, 5336215.0))
    assert wizard.isVisible()
    radars.add_recordings([str(place / "R1.parquet")])
    radars.place_button.click()
    drag(wizard, (690383.0, 5336229.0), (690383.0, 5336229.0))
    radars.add_recordings([str(place / "R2.parquet")] * 2)


def test_from_the_map_to_a_run(wizard, place):
    """A drag and a click, in a map of another system; the real worker reads, checks, measures."""
    QgsProject.instance().setCrs(QgsCoordinateReferenceSystem("EPSG:3857"))
    wizard.canvas.setDestinationCrs(QgsCoordinateReferenceSystem("EPSG:3857"))
    page = wizard.map_page
    assert not page.isComplete()
    page.map_box.setFilePath(str(place / "junction.osm"))
    page.scan_box.setFilePath(str(place / "scan.laz"))
    wait_until(page.isComplete)
    assert page.status.text() == "48 lanelets, EPSG:25832"
    assert [layer.name() for layer in QgsProject.instance().mapLayers().values()] == [
        "Lanes of the new site"
    ]
    wizard.next()
    place_radars(wizard, place)
    radars = wizard.radar_page
    one, other = wizard.draft.sensors
    metres = wizard.canvas.mapUnitsPerPixel()
    assert math.hypot(one.easting - 690356.0, one.northing - 5336183.0) < 2 * metres
    assert one.heading == pytest.approx(math.degrees(math.atan2(32.0, 80.0)), abs=2.0)
    assert (one.name, other.name, other.heading) == ("R1", "R2", None)
    assert len(other.recordings) == 1
    radars.list.setCurrentRow(0)
    assert radars.wind.text() == "east"  # 68 degrees
    assert len(wizard._items) == 2
    assert [colour_at(wizard, each) for each in (one, other)] == ["#1d4ed8", "#60a5fa"]
    wizard.next()
    wizard.result_page.zone_box.setCurrentText("Nowhere/Land")
    assert not wizard.result_page.isComplete()
    wizard.result_page.zone_box.setCurrentText("Europe/Berlin")
    wizard.result_page.interval_box.setText("20 s; 1min")
    (place / "SITE.toml").write_text("by hand")
    wizard.next()
    check = wizard.check_page
    wait_until(check.isComplete)
    found = check.found.toPlainText()
    assert "SITE.toml was there already: it is now SITE_1.toml." in found
    assert (
        "R1: Thu 2025-06-12 09:30:00 – 09:31:39 (Europe/Berlin, UTC+02:00); 167,616 detections"
        in found
    )
    text = (place / "SITE.toml").read_text(encoding="utf-8")
    assert text == check.text.toPlainText().strip() + "\n"
    assert 'intervals = ["20s", "1min"]' in text
    assert "view = { azimuth_deg = 120.0, elevation_deg = 30.0, max_range_m = 190.0 }" in text
    assert (place / "SITE_1.toml").read_text() == "by hand"


def test_what_the_check_refuses_is_one_sentence(wizard, place):
    wizard.draft.map_file = str(place / "junction.osm")
    wizard.draft.title, wizard.draft.time_zone = "x", "Europe/Berlin"
    from gis_radar_plugin.wizard.draft import SensorDraft

    wizard.draft.sensors.append(SensorDraft("R1", [str(place / "R1.parquet")], 690356.0, 5336183.0))
    check = wizard.check_page
    check.site_box.setFilePath(str(place / "SITE.toml"))
    check.check()
    wait_until(check.check_button.isEnabled)
    assert "needs a scan" in check.found.toPlainText()
    assert not check.isComplete()


def test_a_map_that_is_none(wizard, place):
    (place / "no.osm").write_text("<osm/>")
    wizard.map_page.map_box.setFilePath(str(place / "no.osm"))
    wait_until(lambda: "no lanelets" in wizard.map_page.status.text())
    assert not wizard.map_page.isComplete()


@pytest.mark.parametrize("cancelled", [False, True])
def test_the_run_is_a_task(wizard, place, fake_worker, cancelled):
    """It reports, can be cancelled, and says at its end what to open."""
    results = place / "results"
    fake_worker(
        f"import pathlib\nout = pathlib.Path({str(results)!r})\n"
        "say(event='progress', stage='tiles', done=1, total=2)\n"
        "say(event='log', level='warning', message='odd <&>')\n"
        + ("time.sleep(60)" if cancelled else
           "out.mkdir()\n(out / 'report.html').write_text('x')\n"
           "say(event='result', outputs=[], summary={'tiles': 7})")
    )  # fmt: skip
    check, page = wizard.check_page, wizard.run_page
    check.site_box.setFilePath(str(place / "SITE.toml"))
    check.folder_box.setFilePath(str(results))
    page.initializePage()
    page.run()
    wait_until(lambda: "odd <&>" in page.log.toPlainText())
    if cancelled:
        page.cancel()
    wait_until(lambda: not page.is_running)
    shown = page.log.toPlainText()
    if cancelled:
        assert "Cancelled; nothing was left half-written." in shown
        assert page.stage.text() == "Not done: the reason is below."
    else:
        assert "tiles: 7" in shown
        assert page.stage.text() == f"Done. Results: {results}"
    assert page.open_buttons["report.html"].isEnabled() is not cancelled
    assert not page.open_buttons["site.qgz"].isEnabled()
    assert page.run_button.isEnabled()
