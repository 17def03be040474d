"""Make the pictures of the documentation again, from the results of a demo.

    gis-radar demo -o demo
    python tools/docs_pictures.py demo              all
    python tools/docs_pictures.py demo qgis report  some

heatmap, localize: the demo's own pictures; report: in Chromium; occupancy, volumes: beside the
truth, with their captions; qgis: the desktop with toolbox, a running dialog and a page of its
report; wizard: placing a radar on the map. Needs Chromium, and QGIS with Xvfb, openbox and
ImageMagick (tools/get_browser_and_qgis.sh). Look at each picture afterwards.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from qgis_desktop import WAIT_S, desktop_script, run_desktop, virtual_screen

sys.path.append(str(Path(__file__).parents[1] / "bench"))

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SCREEN = (1440, 860)  # pixels
FLAGS = ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--force-device-scale-factor=1")
# Scripts for QGIS: its steps, so many seconds apart (`qgis_desktop.py`).

DESKTOP = """
from qgis.PyQt.QtWidgets import QProgressBar
from qgis.core import QgsRectangle
from qgis.utils import loadPlugin, startPlugin

@after(1)
def project():
    if "gis_radar_plugin" not in plugins:
        assert loadPlugin("gis_radar_plugin") and startPlugin("gis_radar_plugin")
    assert iface.addProject(DEMO + "/site.qgz")
    iface.mainWindow().showMaximized()
    for name in ("Browser", "MessageLog", "ProcessingToolbox"):
        if name in docks():
            docks()[name].hide()
    docks()["Temporal Controller"].show()

@after(3)
def moment():
    canvas = iface.mapCanvas()
    canvas.temporalController().setCurrentFrameNumber(80)  # 40 s: the east and the west wait
    canvas.setExtent(QgsRectangle(690340, 5336125, 690500, 5336255))
    iface.mainWindow().resizeDocks([docks()["Layers"]], [330], Qt.Horizontal)

@after(10)
def map_and_toolbox():
    shot("map.png")
    docks()["Temporal Controller"].hide()
    dock = docks()["ProcessingToolbox"]
    dock.show()
    dock.setFloating(True)
    dock.resize(400, 470)
    dock.searchBox.setText("gisradar")

@after(3)
def dialog():
    shot("toolbox.png", docks()["ProcessingToolbox"])
    docks()["ProcessingToolbox"].hide()
    import processing
    global box
    box = processing.createAlgorithmDialog("gisradar:runsite", {"SITE": SITE, "OUTPUT": OUT})
    box.resize(750, 560)
    box.show()
    box.runButton().click()

def at_work():
    bar = max(box.findChildren(QProgressBar), key=lambda each: each.value())
    if bar.value() < 50:
        steps.insert(0, (0.5, at_work))
    else:
        shot("dialog.png", box)
steps.append((5, at_work))
"""

WIZARD = """
from qgis.PyQt.QtCore import QPoint
from qgis.PyQt.QtTest import QTest
from qgis.PyQt.QtWidgets import QApplication
from qgis.core import QgsPointXY, QgsRectangle
from qgis.utils import loadPlugin, startPlugin

@after(1)
def begin():
    if "gis_radar_plugin" not in plugins:
        assert loadPlugin("gis_radar_plugin") and startPlugin("gis_radar_plugin")
    iface.mainWindow().showMaximized()
    for name in ("Browser", "MessageLog", "Layers"):
        docks()[name].hide()
    global wizard
    wizard = plugins["gis_radar_plugin"].new_site()
    wizard.map_page.map_box.setFilePath(JUNCTION + "/junction.osm")
    wizard.map_page.scan_box.setFilePath(JUNCTION + "/scan.laz")

def read():
    if not wizard.map_page.isComplete():
        steps.insert(0, (0.5, read))
steps.append((1, read))

def at(east, north):
    place = wizard.canvas.getCoordinateTransform().transform(QgsPointXY(east, north))
    return QPoint(round(place.x()), round(place.y()))

def drag(start, end):
    view, left, none = wizard.canvas.viewport(), Qt.MouseButton.LeftButton, Qt.NoModifier
    wizard.radar_page.place_button.click()
    QTest.mousePress(view, left, none, at(*start))
    QTest.mouseMove(view, at(*end))
    QApplication.processEvents()
    QTest.mouseRelease(view, left, none, at(*end))

@after(2)
def radars():
    wizard.next()
    wizard.canvas.setExtent(QgsRectangle(690290, 5336115, 690640, 5336290))
    wizard.resize(660, 560)

@after(3)
def dragged():
    drag((690356, 5336183), (690436, 5336215))
    wizard.radar_page.add_recordings([JUNCTION + "/R1.parquet"])
    drag((690383, 5336229), (690400, 5336190))
    wizard.radar_page.add_recordings([JUNCTION + "/R2.parquet"])
    wizard.radar_page.list.setCurrentRow(0)
    area = iface.mainWindow().geometry()
    wizard.move(area.right() - wizard.width() - 12, area.top() + 30)

@after(3)
def shown():
    shot("wizard.png")
    wizard.done(0)
"""


def main() -> None:
    """Make the named pictures, all by default."""
    demo, *chosen = sys.argv[1:] or sys.exit(__doc__)
    for name in chosen or list(PICTURES):
        PICTURES[name](Path(demo).resolve())


def heatmap(demo: Path) -> None:
    """Keep the demo's heat map."""
    keep(Image.open(demo / "heatmap" / "heatmap.png"), "heatmap", 2000)


def localize(demo: Path) -> None:
    """Keep the demo's figure of a pose."""
    keep(Image.open(demo / "sensors" / "R1" / "localization.png"), "localize", 2000)


def report(demo: Path) -> None:
    """Take a picture of the report's begin, in Chromium."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "report.png"
        run("chromium", *FLAGS, f"--user-data-dir={place}/profile", "--window-size=1180,1180",
            f"--screenshot={path}", (demo / "report.html").as_uri())  # fmt: skip
        keep(Image.open(path), "report", 1180)


def occupancy(demo: Path) -> None:
    """Draw occupancy beside the truth, and put the caption into docs/limits.md."""
    _beside_truth("demo_picture.py", demo, "occupancy", DOCS / "limits.md")


def volumes(demo: Path) -> None:
    """Draw volumes beside the true ones, and put the caption into README.md."""
    _beside_truth("volumes_picture.py", demo, "volumes", ROOT / "README.md")


def _beside_truth(script: str, demo: Path, name: str, page: Path) -> None:
    """Run a script of bench/vehicles that draws the demo, and keep its picture."""
    picture = DOCS / f"{name}.png"
    run(sys.executable, ROOT / "bench" / "vehicles" / script, demo, picture, "--into", page)
    keep(Image.open(picture), name, 1600)


def qgis(demo: Path) -> None:
    """Take pictures of the desktop, the toolbox, a running dialog, and a page of the report."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        shutil.copytree(ROOT / "sample_maps", place / "junction")
        script = desktop_script(
            DESKTOP, SHOTS=name, DEMO=str(demo), OUT=str(place / "results"),
            SITE=str(place / "junction" / "SITE.toml"),
        )  # fmt: skip
        with virtual_screen(*SCREEN, _qgis_environment(place)) as environment:
            checked(run_desktop(script, place, place, environment))
            run("qgis_process", "plugins", "enable", "gis_radar_plugin", environment=environment)
            run("qgis_process", "run", "gisradar:exportreport", "--", f"HEATMAP={demo}/heatmap",
                f"SENSORS={demo}/sensors.gpkg", "TITLE=Sample junction (simulated)",
                "SOURCE=gis_radar", "TIME_ZONE=Europe/Berlin", "DPI=103", f"OUTPUT={place}/report",
                environment=environment)  # fmt: skip
        for part, wide in (("map", SCREEN[0]), ("toolbox", 400), ("dialog", 750)):
            keep(Image.open(place / f"{part}.png"), f"qgis-{part}", wide)
        keep(Image.open(place / "report" / "Junction_1_whole.png"), "qgis-sheet", 1200)


def wizard(_demo: Path) -> None:
    """Take a picture of the site wizard, with the sample's radars placed on the map."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        shutil.copytree(ROOT / "sample_maps", place / "junction")
        script = desktop_script(WIZARD, SHOTS=name, JUNCTION=str(place / "junction"))
        with virtual_screen(*SCREEN, _qgis_environment(place)) as environment:
            checked(run_desktop(script, place, place, environment))
        keep(Image.open(place / "wizard.png"), "qgis-wizard", SCREEN[0])


PICTURES = {
    "heatmap": heatmap, "localize": localize, "report": report, "occupancy": occupancy,
    "volumes": volumes, "qgis": qgis, "wizard": wizard,
}  # fmt: skip


def _qgis_environment(place: Path) -> dict[str, str]:
    """Return the environment variables of a QGIS with the plugin and its own profile."""
    return {
        "HOME": os.environ["HOME"], "LANG": "C.UTF-8", "TZ": "Europe/Berlin",
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "XDG_RUNTIME_DIR": str(place),
        "QGIS_CUSTOM_CONFIG_PATH": str(place), "QGIS_PLUGINPATH": str(ROOT / "qgis_plugin"),
        "GIS_RADAR_PYTHON": sys.executable, "PYTHONPATH": str(ROOT),
    }  # fmt: skip


def run(*words: str | Path, environment: dict[str, str] | None = None) -> str:
    """Run a program and return its output; exit with it where it fails."""
    return checked(
        subprocess.run(
            [str(word) for word in words],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=WAIT_S,
        )
    )


def checked(done: subprocess.CompletedProcess[str]) -> str:
    """Return the output of a program; exit with it where it failed."""
    if done.returncode:
        sys.exit(f"{done.args[0]} failed:\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    return done.stdout


def keep(picture: Image.Image, name: str, wide: int) -> None:
    """Write a picture to docs with its own palette, at most `wide` pixels wide."""
    shown = picture.convert("RGB")
    if shown.width > wide:
        high = round(shown.height * wide / shown.width)
        shown = shown.resize((wide, high), Image.Resampling.LANCZOS)
    path = DOCS / f"{name}.png"
    few = shown.quantize(255, kmeans=3, dither=Image.Dither.NONE)  # k-means keeps rare colours
    few.save(path, optimize=True)
    print(f"{path}: {few.width} x {few.height}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
