"""The site wizard in QGIS: radars placed on the map, the file checked by the worker, its run."""

import math
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest
from conftest import SAMPLE, WORKER
from helpers import algorithm, context_of
from qgis.core import QgsApplication, QgsCoordinateReferenceSystem, QgsPointXY, QgsProject
from qgis.gui import QgsMapCanvas, QgsMessageBar
from qgis.PyQt import sip
from qgis.PyQt.QtCore import QCoreApplication, QEvent, QPoint, Qt
from qgis.PyQt.QtTest import QTest
from qgis.PyQt.QtWidgets import QApplication, QDialog, QMainWindow


class Window:
    """As much of QGIS's window as the wizard asks for."""

    def __init__(self):
        self.main = QMainWindow()
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


def wait_until(test, seconds=300.0):
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
    assert len(wizard.sensor_items) == 2
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
        "R1: Thu 2025-06-12 09:30:00 – 09:31:40 (Europe/Berlin, UTC+02:00); 167,616 detections"
        in found
    )
    text = (place / "SITE.toml").read_text(encoding="utf-8")
    assert text == check.text.toPlainText().strip() + "\n"
    check.check()
    wait_until(check.isComplete)
    assert check.found.toPlainText().count("The site can be run.") == 1  # of this check alone
    assert 'intervals = ["20s", "1min"]' in text
    assert "view = { azimuth_deg = 120.0, elevation_deg = 30.0, max_range_m = 190.0 }" in text
    assert (place / "SITE_1.toml").read_text() == "by hand"


def test_what_the_check_refuses_is_one_sentence(wizard, place):
    wizard.draft.map_file = str(place / "junction.osm")
    wizard.draft.title, wizard.draft.timezone = "x", "Europe/Berlin"
    from gis_radar_plugin.wizard.draft import SensorDraft

    wizard.draft.sensors.append(SensorDraft("R1", [str(place / "R1.parquet")], 690356.0, 5336183.0))
    check = wizard.check_page
    check.site_box.setFilePath(str(place / "SITE.toml"))
    check.check()
    wait_until(check.check_button.isEnabled)
    assert "needs a scan" in check.found.toPlainText()
    assert not check.isComplete()


@pytest.mark.parametrize("wrong", [True, False])
def test_the_check_says_of_each_sensor_whether_it_fits(wizard, place, fake_worker, wrong):
    rows = [
        ["sensor", "verdict", "evidence", "what to do"],
        ["R1", "fits", "96% of 48 vehicles drive along lanes", ""],
        ["R2", "does not fit", "yaw is off by 180 deg (0% of 41 vehicles)", "set yaw to 2.0"],
        ["R3", "too little traffic to tell", "4 vehicles move", "record more traffic"],
        ["R4", "fits, but", "its pose may be off (9 vehicles)", "set easting 6"],
    ]
    rows = rows if wrong else [each for each in rows if each[0] != "R2"]
    line = "R3: too little traffic to tell: 4 vehicles move"
    end = "say(event='error', message='R2: does not fit', hint='', code=4)\nsys.exit(4)"
    fake_worker(
        f"say(event='log', level='warning', message={line!r})\n"
        f"say(event='result', outputs=[], summary={{'plausibility': {rows!r}}})\n"
        f"{end if wrong else ''}\n"
    )
    check = wizard.check_page
    check.site_box.setFilePath(str(place / "SITE.toml"))
    check.folder_box.setFilePath(str(place / "results"))
    check.check()
    wait_until(check.check_button.isEnabled)
    found = check.found.toPlainText()
    assert "R1: fits: 96% of 48 vehicles drive along lanes" in found
    assert found.count(line) == 1
    refused = "R2: does not fit: yaw is off by 180 deg (0% of 41 vehicles)\n→ set yaw to 2.0\n"
    assert (refused in found) is wrong
    assert "R4: fits, but its pose may be off (9 vehicles)\n→ set easting 6\n" in found
    assert ("The site cannot be run: correct what does not fit" in found) is wrong
    assert check.isComplete() is not wrong


def test_a_map_that_is_none(wizard, place):
    (place / "no.osm").write_text("<osm/>")
    wizard.map_page.map_box.setFilePath(str(place / "no.osm"))
    wait_until(lambda: "no lanelets" in wizard.map_page.status.text())
    assert not wizard.map_page.isComplete()


def no_tasks():
    return not QgsApplication.taskManager().activeTasks()


@pytest.mark.parametrize("change", ["draft", "file"])
def test_a_check_of_what_was_there_before_counts_for_nothing(wizard, place, fake_worker, change):
    """Back, an edit and Next while a check runs, or another file: the old answer is dropped."""
    begun, changed = place / "begun", place / "changed"
    fake_worker(
        "import pathlib\ntext = pathlib.Path(words[1]).read_text()\n"
        "if 'good' in text:\n"
        f"    pathlib.Path({str(begun)!r}).touch()\n"
        f"    while not pathlib.Path({str(changed)!r}).exists():\n        time.sleep(0.05)\n"
        "    say(event='result', outputs=[], summary={})\n"
        "else:\n    say(event='error', message='the title is bad', hint='', code=2)\n"
        "    sys.exit(2)\n"
    )
    wizard.draft.title, check = "good", wizard.check_page
    check.site_box.setFilePath(str(place / "SITE.toml"))
    check.folder_box.setFilePath(str(place / "results"))
    check.initializePage()
    wait_until(begun.exists)
    if change == "draft":
        wizard.draft.title = "bad"
        check.initializePage()
    else:
        check.site_box.setFilePath(str(place / "OTHER.toml"))
    changed.touch()
    wait_until(no_tasks)
    found = check.found.toPlainText()
    assert not check.isComplete()
    assert "The site can be run." not in found
    assert ("the title is bad" in found) is (change == "draft")
    assert check.check_button.isEnabled()
    assert not check.bar.isVisible()


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("what", ["map", "check"])
def test_what_runs_ends_with_the_window(
    provider, qgis_new_project, place, fake_worker, monkeypatch, what
):
    """Nothing goes on, and nothing speaks to boxes that are gone."""
    from gis_radar_plugin.wizard.wizard import SiteWizard

    begun, failed = place / "begun", []
    fake_worker(f"open({str(begun)!r}, 'w').close()\ntime.sleep(600)")
    monkeypatch.setattr(sys, "excepthook", lambda *error: failed.append(error[1]))
    window = Window()
    wizard = SiteWizard(window)
    wizard.show()
    wizard.check_page.site_box.setFilePath(str(place / "SITE.toml"))
    wizard.check_page.folder_box.setFilePath(str(place / "results"))
    start = {
        "map": lambda: wizard.map_page.map_box.setFilePath(str(place / "junction.osm")),
        "check": wizard.check_page.check,
    }
    start[what]()
    wait_until(begun.exists)
    wizard.reject()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    assert sip.isdeleted(wizard)
    wait_until(no_tasks)
    QApplication.processEvents()
    assert failed == []


def test_radars_stay_where_they_are_in_another_system(wizard, place):
    """The coordinates of radars follow the system of the map."""
    from gis_radar_plugin.wizard.canvas import moved

    page = wizard.map_page
    page.map_box.setFilePath(str(place / "junction.osm"))
    wait_until(page.isComplete)
    wizard.radar_page.add(690356.0, 5336183.0, 20.0)
    wizard.radar_page.add(690383.0, 5336229.0, None)
    zones = [QgsCoordinateReferenceSystem(f"EPSG:{code}") for code in (25832, 25833)]
    page.crs_box.setCrs(zones[1])
    wait_until(page.isComplete)
    assert wizard.lanes.crs == zones[1]
    one, other = wizard.draft.sensors
    for radar, place_before in ((one, (690356.0, 5336183.0)), (other, (690383.0, 5336229.0))):
        wanted = moved(QgsPointXY(*place_before), *zones)
        assert (radar.easting, radar.northing) == pytest.approx((wanted.x(), wanted.y()), abs=0.01)
    assert other.heading is None
    # Grid norths of zones 6 degrees apart differ by 6 * sin(latitude).
    assert one.heading == pytest.approx(20.0 - 6.0 * math.sin(math.radians(48.15)), abs=0.1)
    assert wizard.radar_page.east_box.value() == pytest.approx(other.easting, abs=0.01)
    assert [colour_at(wizard, each) for each in (one, other)] == ["#60a5fa", "#1d4ed8"]


@pytest.mark.parametrize(
    ("pose", "text", "stated"),
    [
        ("", "", True), ("R1.json", '{"view": {"max_range_m": 300.0}}', False),
        ("R1.json", '{"yaw": 1.0}', True), ("R1.csv", "time,yaw,max_range_m\n", False),
        ("R1.csv", "time,yaw\n", True), ("gone.json", None, True),
    ],
)  # fmt: skip
def test_a_measured_view_is_not_stated_beside_that_of_a_pose(tmp_path, pose, text, stated):
    from gis_radar_plugin.wizard.draft import SensorDraft, SiteDraft

    file = str(tmp_path / pose) if pose else ""
    if text:
        (tmp_path / pose).write_text(text)
    radar = SensorDraft("R1", ["R1.parquet"], 1.0, 2.0, pose=file, measured={"max_range_m": 190.0})
    shown = SiteDraft(sensors=[radar]).text(tmp_path)
    assert ("view = { max_range_m = 190.0 }" in shown) is stated
    radar.view = {"max_range_m": 250.0}  # by hand: the user is told that the pose's counts
    assert "view = { max_range_m = 250.0 }" in SiteDraft(sensors=[radar]).text(tmp_path)


def test_the_run_is_that_of_the_toolbox(wizard, place, monkeypatch):
    """In QGIS's own dialog, which is filled in and begins; the lanes of the wizard are gone."""
    import processing

    shown, box = [], QDialog()
    box.runButton = lambda: SimpleNamespace(click=lambda: shown.append("runs"))
    monkeypatch.setattr(
        processing, "createAlgorithmDialog", lambda *given: shown.append(given) or box
    )
    wizard.check_page.site_box.setFilePath(str(place / "SITE.toml"))
    wizard.check_page.folder_box.setFilePath(str(place / "results"))
    wizard.accept()
    given = {"SITE": str(place / "SITE.toml"), "OUTPUT": str(place / "results")}
    assert shown == [("gisradar:runsite", given), "runs"]
    assert not wizard.isVisible()
    (place / "SITE.toml").touch()
    one, context = algorithm("runsite"), context_of(QgsProject.instance())
    assert one.checkParameterValues(given, context)[0]


def test_radars_are_drawn_until_another_project_is_there(wizard):
    from gis_radar_plugin.wizard.draft import SensorDraft

    wizard.lanes.crs = QgsCoordinateReferenceSystem("EPSG:25832")
    wizard.draft.sensors = [SensorDraft("R1", easting=690356.0, northing=5336183.0)]
    wizard.draw_sensors(None)
    assert len(wizard.sensor_items) == 1
    QgsProject.instance().clear()
    assert wizard.sensor_items == []


OPENED = """\
# by hand
title = "Old"
timezone = "Europe/Berlin"
owner = { name = "Jo", since = 2020 }

[map]
file = "junction.osm"
crs = "EPSG:25832"
streets = "streets.gpkg"

[scan]
files = ["sc*.laz"]

[tiles]
length = 1.0

[measure]
clearance = [0.0, 3.0]

[heatmap]
intervals = ["20s"]

[[sensor]]
name = "R1"
recordings = "R1*.parquet"
guess = [690356.0, 5336183.0, 520.5]
compass = "north-east"
method = "icp"
view = { azimuth_deg = 100.0, elevation_deg = 20.0 }

[[sensor]]
name = "R2"
recordings = ["R2.parquet"]
pose = "R2.json"
"""


@pytest.fixture
def old_site(place):
    path = place / "SITE.toml"
    path.write_text(OPENED, encoding="utf-8")
    shutil.copyfile(SAMPLE / "R2.json", place / "R2.json")
    return path


def test_a_site_that_was_opened_keeps_what_the_wizard_leaves_out(wizard, old_site):
    wizard.open_site(old_site)
    wait_until(wizard.map_page.isComplete)
    assert wizard.map_page.title_box.text() == "Old"
    assert wizard.draft.text(old_site.parent) == OPENED  # nothing is changed yet
    one, other = wizard.draft.sensors
    assert (one.heading, other.is_placed) == (45.0, True)
    assert wizard.radar_page.bearing_box.value() == pytest.approx(45.0)
    assert wizard.result_page.interval_box.text() == "20s"
    assert not wizard.result_page.boxes["vehicles_only"].isChecked()
    wizard.map_page.title_box.setText("New")
    wizard.map_page.boxes["map_source"].setText("City")
    wizard.radar_page.east_box.setValue(690357.0)
    wizard.radar_page.range_box.setValue(250.0)
    wizard.check_page.save()
    text = old_site.read_text(encoding="utf-8")
    changed = {
        "# by hand\n": "", '"Old"': '"New"', "690356.0": "690357.0",
        'streets = "streets.gpkg"': 'streets = "streets.gpkg"\nsource = "City"',
        "elevation_deg = 20.0 }": "elevation_deg = 20.0, max_range_m = 250.0 }",
    }  # fmt: skip
    expected = OPENED
    for old, new in changed.items():
        assert old in expected
        expected = expected.replace(old, new)
    # Inline tables at the top become tables of their own: the same values.
    expected = expected.replace('owner = { name = "Jo", since = 2020 }\n', "")
    expected = expected.replace("[map]", '[owner]\nname = "Jo"\nsince = 2020\n\n[map]')
    assert text == expected
    assert (old_site.parent / "SITE_1.toml").read_text(encoding="utf-8") == OPENED
    said = wizard.check_page.found.toPlainText()
    assert "Comments are in SITE_1.toml only; all its other keys are kept." in said
    wizard.check_page.site_box.setFilePath(str(old_site.parent.parent / "SITE.toml"))
    assert not wizard.check_page.save()
    assert "A site that was opened stays in" in wizard.check_page.found.toPlainText()


@pytest.mark.parametrize("text", ["title = ", "sensor = 3", "map = 1", '[[sensor]]\nguess = ["a"]'])
def test_what_is_no_site_file_changes_nothing(wizard, tmp_path, text):
    path = tmp_path / "x.toml"
    path.write_text(text)
    before = wizard.draft
    wizard.open_site(path)
    assert wizard.draft is before
    assert str(path) in wizard.map_page.status.text()
    assert "\n" not in wizard.map_page.status.text()


LOCAL = """
import sys, xml.etree.ElementTree as tree
from pyproj import Transformer
plane = Transformer.from_crs(4326, 25832, always_xy=True)
found = tree.parse(sys.argv[1])
for node in found.iter("node"):
    x, y = plane.transform(float(node.get("lon")), float(node.get("lat")))
    node.attrib.update(lat="", lon="")
    for key, value in (("local_x", x - 690000.0), ("local_y", y - 5336000.0)):
        tree.SubElement(node, "tag", k=key, v=repr(value))
found.write(sys.argv[1])
"""


def test_radars_follow_the_origin_of_a_local_map(wizard, place):
    path = place / "junction.osm"
    around = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    subprocess.run([WORKER, "-c", LOCAL, str(path)], check=True, env=around)
    page = wizard.map_page
    page.map_box.setFilePath(str(path))
    wait_until(lambda: "local_x" in page.status.text())
    page.crs_box.setCrs(QgsCoordinateReferenceSystem("EPSG:25832"))
    page.origin_box.setText("690000.0, 5336000.0")
    page.origin_box.editingFinished.emit()
    wait_until(page.isComplete)
    wizard.radar_page.add(690356.0, 5336183.0, 20.0)
    page.origin_box.setText("690100.0, 5335950.0")
    page.origin_box.editingFinished.emit()
    wait_until(page.isComplete)
    (radar,) = wizard.draft.sensors
    assert (radar.easting, radar.northing) == pytest.approx((690456.0, 5336133.0), abs=0.01)
    assert radar.heading == 20.0
