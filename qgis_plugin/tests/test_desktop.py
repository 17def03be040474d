"""The zip in an empty profile: the desktop of a planner, on a virtual screen."""

import shutil
import sys

from conftest import ROOT, SAMPLE, environment

sys.path.append(str(ROOT / "tools"))

from qgis_desktop import desktop_script, run_desktop, virtual_screen

SHOTS = ROOT / "out" / "qgis"

BODY = """
from qgis.core import QgsProject
@after(1)
def toolbox():
    assert "gis_radar_plugin" in plugins, plugins
    iface.mainWindow().showMaximized()
    for name in ("Browser", "MessageLog"):
        docks()[name].hide()
    docks()["ProcessingToolbox"].show()
    docks()["ProcessingToolbox"].searchBox.setText("gisradar")

@after(2)
def dialog():
    shot("toolbox.png")
    import processing
    global box
    box = processing.createAlgorithmDialog("gisradar:heatmap", {
        "DATASET": SITE + "/dataset", "INTERVAL": "20s",
        "TIMEZONE": "Europe/Berlin", "OUTPUT": OUT + "/map"})
    box.show()
    box.runButton().click()

@after(2.2)
def at_work():
    shot("dialog.png")

def wait_for_map():
    if not QgsProject.instance().mapLayersByName("Occupancy by interval"):
        steps.insert(0, (1, wait_for_map))
    else:
        from qgis.PyQt.QtWidgets import QPushButton
        offered = box.messageBar().currentItem().findChildren(QPushButton)
        say("buttons", [each.text() for each in offered])
        box.close()
        iface.mapCanvas().zoomToFullExtent()
steps.append((1, wait_for_map))

@after(1)
def zoom():
    layer = QgsProject.instance().mapLayersByName("Occupancy, raster")[0]
    canvas = iface.mapCanvas()
    canvas.setExtent(layer.extent())
    canvas.refresh()

@after(3)
def first():
    canvas = iface.mapCanvas()
    controller = canvas.temporalController()
    say("mode", int(controller.navigationMode()), "frames", controller.totalFrameCount())
    say("time", canvas.temporalRange().begin().toString("yyyy-MM-dd HH:mm:ss"))
    from qgis.PyQt.QtWidgets import QLabel
    clock = [label for label in canvas.findChildren(QLabel) if "UTC" in label.text()]
    say("clock", [label.text() for label in clock if label.isVisible()])
    shot("moment1.png")
    controller.setCurrentFrameNumber(3)

@after(3)
def second():
    shot("moment2.png")
    say("layers", len(QgsProject.instance().mapLayers()))
"""


def said_in_desktop(body, profiles, site, place):
    """Return what the steps of a script say in QGIS's window."""
    SHOTS.mkdir(parents=True, exist_ok=True)
    desktop = place / "profiles"
    shutil.copytree(profiles / "profiles", desktop / "profiles")
    script = desktop_script(
        body, SHOTS=str(SHOTS), SITE=str(site), OUT=str(place), SAMPLE=str(SAMPLE)
    )
    with virtual_screen(1600, 950, environment(profiles, TZ="America/New_York")) as around:
        done = run_desktop(script, place, desktop, around, "--profile", "default")
    assert done.returncode == 0, done.stdout + done.stderr
    return [line[5:] for line in done.stdout.splitlines() if line.startswith("SAID ")]


def test_the_desktop(profiles, site, tmp_path):
    """A heat map made in the dialog comes up styled, animated, with the clock of the site."""
    names = ("toolbox.png", "dialog.png", "moment1.png", "moment2.png")
    for name in names:
        (SHOTS / name).unlink(missing_ok=True)
    assert said_in_desktop(BODY, profiles, site, tmp_path) == [
        "buttons ['Open the picture', 'Show the folder']",
        "mode 1 frames 5",
        "time 2025-06-12 07:30:00",
        "clock ['Thu 2025-06-12 09:30:00 – 09:30:20 (Europe/Berlin, UTC+02:00)']",
        "layers 4",
    ]
    pictures = [(SHOTS / name).read_bytes() for name in names]
    assert all(len(picture) > 20_000 for picture in pictures)
    assert len(set(pictures)) == len(pictures)


OPENING = """
from qgis.core import QgsProject, QgsSettings
from qgis.gui import QgsProcessingAlgorithmDialogBase
from qgis.PyQt.QtWidgets import QApplication, QMessageBox, QPushButton
project = QgsProject.instance()
QgsSettings().setValue("app/askToSaveMemoryLayers", False)  # what lies in /tmp is none for QGIS

def opened_by(button, wanted):
    asked = []
    def answer():
        box = QApplication.activeModalWidget()
        if box is not None:
            shot("unsaved.png")
            asked.append("asked")
            box.button(getattr(QMessageBox.StandardButton, wanted)).click()
    QTimer.singleShot(1000, answer)
    button.click()
    say(wanted, *asked, os.path.basename(project.fileName()), project.title())

@after(1)
def sheets():
    iface.mainWindow().showMaximized()
    iface.addProject(SITE + "/site.qgz")
    import processing
    global box
    box = processing.createAlgorithmDialog("gisradar:exportreport", {
        "HEATMAP": SITE + "/heatmap", "OVER": 1, "DPI": 50, "OUTPUT": OUT + "/sheets"})
    box.show()
    box.runButton().click()

@after(1)
def sheets_are_there():  # made in the window's own thread
    project.setTitle("not saved")
    button = box.messageBar().currentItem().findChildren(QPushButton)[1]
    opened_by(button, "Cancel")
    opened_by(button, "Discard")

@after(1)
def wizard():
    box.close()
    window = plugins["gis_radar_plugin"].new_site()
    window.check_page.site_box.setFilePath(SAMPLE + "/SITE.toml")
    window.check_page.folder_box.setFilePath(OUT + "/run")
    window.accept()

def dialog_of(algorithm):
    for each in QApplication.topLevelWidgets():
        if isinstance(each, QgsProcessingAlgorithmDialogBase) and each.isVisible():
            if each.algorithm().name() == algorithm:
                return each

def wait_for_run():
    item = dialog_of("runsite").messageBar().currentItem()
    if item is None:
        steps.insert(0, (1, wait_for_run))
        return
    shot("run.png")
    buttons = {each.text(): each for each in item.findChildren(QPushButton)}
    say("buttons", list(buttons))
    group = project.layerTreeRoot().findGroup("Sample junction (simulated)")
    say([node.name() for node in group.findLayers()], project.timeSettings().timeStep())
    say(project.mapLayersByName("Vehicles")[0].temporalProperties().isActive())
    buttons["Make sheets..."].click()
    sheets = dialog_of("exportreport")
    given = sheets.createProcessingParameters()
    say(given["TITLE"], "-", given["SOURCE"][:15], os.path.relpath(given["OUTPUT"], OUT))
    sheets.close()
    project.setTitle("saved")
    opened_by(buttons["Open the project"], "Cancel")
    opened_by(buttons["Open the project"], "Save")
    opened_by(buttons["Open the project"], "Discard")
    project.read(OUT + "/sheets/report.qgz")
    say(project.title())
steps.append((1, wait_for_run))

@after(2)
def end():
    shot("opened.png")
    dialog_of("runsite").close()
"""


LAYERS_OF_A_RUN = [
    "Sensors", "Views", "Uncertainty (95 %)", "Vehicles", "Occupancy by interval",
    "Occupancy, whole time", "Occupancy, raster", "Road, not observed",
]  # fmt: skip


def test_another_project_is_opened_as_qgis_opens_it(profiles, site, tmp_path):
    """Over a project of ours, from sheets and the wizard's run: QGIS asks before it is lost."""
    shutil.copytree(site, tmp_path / "run")  # from which the run goes on
    assert said_in_desktop(OPENING, profiles, site, tmp_path) == [
        "Cancel asked site.qgz not saved",
        "Discard asked report.qgz Sample junction (simulated)",
        "buttons ['Open the report', 'Open the project', 'Make sheets...', 'Show the folder']",
        f"{LAYERS_OF_A_RUN} 0.5",
        "True",  # the project plays the vehicles, not the map
        "Sample junction (simulated) - gis_radar, MIT; run/sheets",
        "Cancel asked report.qgz saved",
        "Save asked site.qgz Sample junction (simulated)",
        "Discard site.qgz Sample junction (simulated)",
        "saved",
    ]
