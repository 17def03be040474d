"""The zip in an empty profile: the desktop of a planner, on a virtual screen."""

import os
import shutil
import signal
import subprocess
import time

import pytest
from conftest import ROOT, environment

SHOTS = ROOT / "out" / "qgis"

STARTUP = """
import os, subprocess, sys, traceback
from qgis.PyQt.QtCore import QTimer
from qgis.core import Qgis, QgsApplication, QgsProject
from qgis.utils import iface, plugins
SHOTS, SITE, OUT = {shots!r}, {site!r}, {out!r}
steps = []

def shot(name):
    subprocess.run(["import", "-window", "root", os.path.join(SHOTS, name)], check=False)

def say(*words):
    print("SAID", *words, flush=True)

def after(seconds):
    def keep(step):
        steps.append((seconds, step))
        return step
    return keep

def go():
    if not steps:
        os._exit(0)
    seconds, step = steps.pop(0)
    def do():
        try:
            step()
        except Exception:
            traceback.print_exc()
            os._exit(1)
        go()
    QTimer.singleShot(int(seconds * 1000), do)

{body}
iface.initializationCompleted.connect(go)
"""

BODY = """
@after(1)
def toolbox():
    assert "gis_radar_plugin" in plugins, plugins
    iface.mainWindow().showMaximized()
    from qgis.PyQt.QtWidgets import QDockWidget, QTreeView
    for dock in iface.mainWindow().findChildren(QDockWidget):
        if dock.objectName() in ("Browser", "MessageLog"):
            dock.hide()
        if dock.objectName() == "ProcessingToolbox":
            dock.show()
            dock.searchBox.setText("gisradar")

@after(2)
def dialog():
    shot("toolbox.png")
    import processing
    global box
    box = processing.createAlgorithmDialog("gisradar:heatmap", {
        "OCCUPANCY": SITE + "/occupancy", "TILES": SITE + "/tiles.gpkg|layername=tiles",
        "INTERVAL": "20s", "OUTPUT": OUT + "/map"})
    box.show()
    box.runButton().click()

@after(2.2)
def at_work():
    shot("dialog.png")

def wait_for_map():
    if not QgsProject.instance().mapLayersByName("Occupancy by interval"):
        steps.insert(0, (1, wait_for_map))
    else:
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


@pytest.fixture
def screen(profiles):
    """A virtual screen with a window manager; QGIS's desktop dies on Qt's own."""
    display = f":{90 + os.getpid() % 900}"
    server = subprocess.Popen(
        ["Xvfb", display, "-screen", "0", "1600x950x24", "-nolisten", "tcp"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    time.sleep(1.0)
    manager = subprocess.Popen(
        ["openbox"], env=environment(profiles, DISPLAY=display),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    yield display
    for process in (manager, server):
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=10)


def test_the_desktop(profiles, site, screen, tmp_path):
    """A heat map made in the dialog comes up styled, animated, with a clock of local time."""
    SHOTS.mkdir(parents=True, exist_ok=True)
    names = ("toolbox.png", "dialog.png", "moment1.png", "moment2.png")
    for name in names:
        (SHOTS / name).unlink(missing_ok=True)
    startup = tmp_path / "startup.py"
    startup.write_text(
        STARTUP.format(shots=str(SHOTS), site=str(site), out=str(tmp_path), body=BODY)
    )
    desktop = tmp_path / "profiles"
    shutil.copytree(profiles / "profiles", desktop / "profiles")
    done = subprocess.run(
        ["qgis", "--nologo", "--noversioncheck", "--profiles-path", str(desktop),
         "--profile", "default", "--code", str(startup)],
        capture_output=True, text=True, timeout=350, check=False,
        env=environment(profiles, DISPLAY=screen, QT_QPA_PLATFORM="xcb", TZ="Europe/Berlin"),
    )  # fmt: skip
    said = [line[5:] for line in done.stdout.splitlines() if line.startswith("SAID ")]
    assert done.returncode == 0, done.stdout + done.stderr
    assert said == [
        "mode 1 frames 5",
        "time 2025-06-12 07:30:00",
        "clock ['Thu 2025-06-12 09:30:00 – 09:30:20 (UTC+2)']",
        "layers 4",
    ]
    pictures = [(SHOTS / name).read_bytes() for name in names]
    assert all(len(picture) > 20_000 for picture in pictures)
    assert len(set(pictures)) == len(pictures)
