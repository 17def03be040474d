"""What the end of an algorithm offers to open."""

from helpers import run_algorithm
from qgis.gui import QgsMessageBar
from qgis.PyQt.QtCore import pyqtSlot
from qgis.PyQt.QtWidgets import QMainWindow, QPushButton


class Window(QMainWindow):
    """As much of QGIS's window as is asked for."""

    def __init__(self):
        super().__init__()
        self.bar, self.opened = QgsMessageBar(), []

    def mainWindow(self):
        return self

    def messageBar(self):
        return self.bar

    @pyqtSlot(str)
    def openFile(self, path):
        self.opened.append(path)


def test_buttons_open_what_was_made(provider, site, tmp_path, monkeypatch):
    from gis_radar_plugin import opening

    window, desktop = Window(), []
    monkeypatch.setattr(opening, "qgis_window", lambda: window)
    monkeypatch.setattr(
        opening.QDesktopServices, "openUrl", lambda url: desktop.append(url.toLocalFile())
    )
    project = tmp_path / "map.qgz"
    results, feedback = run_algorithm(
        "qgisproject", {"HEATMAP": str(site / "heatmap"), "OUTPUT": str(project)}
    )
    assert results, feedback.errors
    (button,) = window.bar.currentItem().findChildren(QPushButton)
    assert button.text() == "Open the project"
    button.click()
    assert window.opened == [str(project)]
    opening.offer("x", [("there", tmp_path), ("gone", tmp_path / "gone.pdf")])
    (button,) = window.bar.currentItem().findChildren(QPushButton)
    button.click()
    assert desktop == [str(tmp_path)]


def test_without_a_window_nothing_is_offered(provider, tmp_path, monkeypatch):
    from gis_radar_plugin import opening

    monkeypatch.setattr(opening, "qgis_window", lambda: None)
    assert opening.offer("x", [("there", tmp_path)]) is None
