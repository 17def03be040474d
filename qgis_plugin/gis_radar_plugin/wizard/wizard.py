"""The site wizard: a site file from a map, clicks on it and recordings; its check; its run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsMessageLog,
    QgsPointXY,
    QgsProject,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import Qt, QTemporaryDir
from qgis.PyQt.QtWidgets import QWizard

from ..base import WorkerAlgorithm, chosen_python
from ..loading import as_ground
from ..opening import open_dialog
from ..runner import Answer, WorkerError
from ..words import language, tr
from .canvas import PlaceTool, SensorItem, heading_of, moved
from .check_page import CheckPage
from .draft import SensorDraft, SiteDraft, open_draft
from .pages import MapPage, RadarPage, ResultPage
from .site_file import read_toml
from .tasks import WorkerTask

LANES = "gis_radar_wizard_lanes"
_TILE_M = "5"  # of the lanes that are shown: large ones are made in no time
_SAME_M = 0.01  # tiles of one map at two origins differ by rounding only
_AHEAD_M = 100.0  # of a point that a radar looks at: near, as maps of both systems bend


class SiteWizard(QWizard):  # type: ignore[misc]
    """The wizard; it is not modal, as radars are placed on the map of QGIS.

    Parameters
    ----------
    iface : QgisInterface
        The window.
    """

    def __init__(self, iface: Any) -> None:
        super().__init__(iface.mainWindow())
        self._iface = iface
        self.draft = SiteDraft(language="de" if language() == "de" else "en")
        self.written: dict[str, str] = {}  # site files that this wizard wrote
        self.lanes = Lanes(self)
        self.sensor_items: list[SensorItem] = []
        self._tool: PlaceTool | None = None
        self._tool_before: Any = None
        QgsProject.instance().cleared.connect(self.forget_drawing)
        self.setWindowTitle(tr("New site"))
        self.setWizardStyle(QWizard.WizardStyle.ModernStyle)
        self.setOption(QWizard.WizardOption.NoBackButtonOnStartPage)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setModal(False)
        buttons = QWizard.WizardButton
        for button, text in (
            (buttons.BackButton, tr("< Back")), (buttons.NextButton, tr("Next >")),
            (buttons.FinishButton, tr("Run now")), (buttons.CancelButton, tr("Close")),
        ):  # fmt: skip
            self.setButtonText(button, text)
        self.map_page, self.radar_page = MapPage(), RadarPage()
        self.result_page, self.check_page = ResultPage(), CheckPage()
        for page in (self.map_page, self.radar_page, self.result_page, self.check_page):
            self.addPage(page)
        self.resize(860, 700)

    @property
    def canvas(self) -> Any:
        """The map of QGIS."""
        return self._iface.mapCanvas()

    def open_site(self, path: Path) -> None:
        """Open an existing site file to change it; one that cannot be read changes nothing."""
        try:
            read = read_toml(chosen_python(), path)
            text = path.read_text(encoding="utf-8-sig")
            draft = open_draft(read, text, path.absolute().parent)
        except (OSError, ValueError, TypeError, IndexError) as error:
            line = tr("{file}: not a site file: {reason}")
            self.map_page.show_status(line.format(file=path, reason=error), good=False)
            return
        except WorkerError as error:
            self.map_page.show_status(str(error), good=False)
            return
        self.lanes.forget()
        self.forget_drawing()
        self.draft = draft
        self.setWindowTitle(f"{tr('Site')}: {path.name}")
        self.check_page.site_box.setFilePath(str(path))
        self.check_page.folder_box.setFilePath(str(path.parent / "results"))
        self.map_page.fill()
        self.result_page.fill()
        self.radar_page.refresh(0)

    # Radars on the map.

    def place_on_map(self, sensor: SensorDraft | None) -> None:
        """Let the user click where a radar stands; without `sensor`, a new one."""
        self._tool_before = self.canvas.mapTool()
        tool = PlaceTool(self.canvas, self.lanes.crs)
        tool.placed.connect(lambda *place: self._placed(sensor, *place))
        tool.moved_to.connect(self._draw_on_the_way)
        tool.left.connect(self._back_from_map)
        self._tool = tool
        self.canvas.setMapTool(tool)
        self.hide()
        self._iface.messageBar().pushMessage(
            "gis_radar",
            tr("Click where the radar stands, and drag to where it looks. Esc goes back."),
        )

    def _placed(
        self, sensor: SensorDraft | None, easting: float, northing: float, heading: float | None
    ) -> None:
        if sensor is None:
            self.radar_page.add(easting, northing, heading)
        else:
            sensor.easting, sensor.northing, sensor.heading = easting, northing, heading
            self.radar_page.refresh()
        self._back_from_map()

    def _draw_on_the_way(self, easting: float, northing: float, heading: float | None) -> None:
        shown = SensorDraft("", easting=easting, northing=northing, heading=heading)
        self._draw([*self.draft.sensors, shown], shown)

    def _back_from_map(self) -> None:
        if self._tool is None:
            return
        if self._tool_before is not None:
            self.canvas.setMapTool(self._tool_before)
        else:
            self.canvas.unsetMapTool(self._tool)
        self._tool = None
        self._iface.messageBar().clearWidgets()
        self.draw_sensors(self.radar_page.chosen())
        self.show()
        self.raise_()

    def draw_sensors(self, chosen: SensorDraft | None) -> None:
        """Draw the radars over the map."""
        self._draw(self.draft.sensors, chosen)

    def _draw(self, sensors: list[SensorDraft], chosen: SensorDraft | None) -> None:
        if self.lanes.crs is None:
            return
        while len(self.sensor_items) < len(sensors):
            self.sensor_items.append(SensorItem(self.canvas, self.lanes.crs))
        while len(self.sensor_items) > len(sensors):
            self.canvas.scene().removeItem(self.sensor_items.pop())
        for item, sensor in zip(self.sensor_items, sensors):
            item.show_sensor(sensor, chosen=sensor is chosen)

    def move_sensors(
        self, before: QgsCoordinateReferenceSystem, after: QgsCoordinateReferenceSystem
    ) -> None:
        """Keep the radars where they are in another system of the map."""
        for sensor in self.draft.sensors:
            start = QgsPointXY(sensor.easting, sensor.northing)
            if math.isnan(start.x() + start.y()):
                continue
            place = moved(start, before, after)
            if sensor.heading is not None:
                yaw = math.radians(sensor.heading)
                ahead = QgsPointXY(
                    start.x() + _AHEAD_M * math.cos(yaw), start.y() + _AHEAD_M * math.sin(yaw)
                )
                sensor.heading = heading_of(place, moved(ahead, before, after))
            sensor.easting, sensor.northing = place.x(), place.y()
        self.forget_drawing()
        self.radar_page.refresh()
        self.draw_sensors(self.radar_page.chosen())

    def shift_sensors(self, east_m: float, north_m: float) -> None:
        """Move the radars along with the lanes, whose origin has changed."""
        for sensor in self.draft.sensors:
            sensor.easting += east_m
            sensor.northing += north_m
        self.radar_page.refresh()

    def forget_drawing(self) -> None:
        """Take the radars off the map."""
        while self.sensor_items:
            self.canvas.scene().removeItem(self.sensor_items.pop())

    def accept(self) -> None:
        """Run the site in QGIS's own dialog, which shows how far it is, and end."""
        check = self.check_page
        given = {"SITE": check.site_box.filePath(), "OUTPUT": check.folder_box.filePath()}
        super().accept()  # the lanes go before those of the run come
        open_dialog("runsite", given).runButton().click()

    def done(self, result: int) -> None:
        """Stop what runs, and leave the map as it was."""
        self.check_page.let_go()
        self.lanes.let_go()
        if self._tool is not None:
            self.canvas.unsetMapTool(self._tool)
            self._tool = None
        self.forget_drawing()
        self.lanes.remove()
        super().done(result)


class Lanes:
    """The lanes of the chosen map as a layer of QGIS, made by the worker.

    Parameters
    ----------
    wizard : SiteWizard
        Whose map it is.
    """

    def __init__(self, wizard: SiteWizard) -> None:
        self._wizard = wizard
        self.crs: QgsCoordinateReferenceSystem | None = None
        self._crs_before: QgsCoordinateReferenceSystem | None = None  # of the radars so far
        self._layer_id = ""
        self._map = ""  # the file of the layer
        self._box: QgsRectangle | None = None  # where its lanes lie
        self._task: WorkerTask | None = None
        self._number = 0
        self._folder = QTemporaryDir()  # goes when the wizard goes

    def read(self, draft: SiteDraft) -> None:
        """Read the map of a draft, and cancel an earlier reading."""
        can, why = WorkerAlgorithm().canExecute()
        if not can:
            self._wizard.map_page.show_status(why, good=False)
            return
        self.let_go()
        self._number += 1
        place = Path(self._folder.path()) / f"lanes_{self._number}.gpkg"
        words = ["tiles", draft.map_file, "-o", str(place), "--length", _TILE_M]
        words += ["--crs", draft.crs] if draft.crs else []
        words += ["--origin", draft.origin.replace(" ", "")] if draft.origin else []
        self.crs = None
        self._wizard.map_page.show_status(tr("Reading the map..."), good=True)
        self._task = WorkerTask.start(
            tr("Map of the site"), words,
            lambda answer, _: self._read(place, draft.map_file, answer),
        )  # fmt: skip

    def let_go(self) -> None:
        """Stop reading, and ignore what was read."""
        if self._task is not None:
            self._task.let_go()
        self._task = None

    def forget(self) -> None:
        """Forget the map: another site is opened."""
        self.let_go()
        self.remove()
        self.crs = self._crs_before = self._box = None
        self._map = ""

    def _read(self, place: Path, source: str, answer: Answer | str) -> None:
        self._task = None
        page = self._wizard.map_page
        if isinstance(answer, str):
            page.show_status(answer, good=False)
            return
        self._show(place, source)
        lanelets = answer.summary.get("lanelets", 0)
        text = tr("{count} lanelets, {crs}").format(count=lanelets, crs=answer.summary.get("crs"))
        page.show_status(text, good=True)

    def _show(self, place: Path, source: str) -> None:
        """Put the lanes into the project, and show all of them."""
        self.remove()
        layer = QgsVectorLayer(f"{place}|layername=tiles", tr("Lanes of the new site"), "ogr")
        if not layer.isValid():
            QgsMessageLog.logMessage(f"{place}: no layer of tiles", "gis_radar")
            return
        as_ground(layer)
        layer.setCustomProperty(LANES, True)
        project, canvas = QgsProject.instance(), self._wizard.canvas
        if not project.mapLayers():
            project.setCrs(layer.crs())
        project.addMapLayer(layer)
        self.crs, self._layer_id = layer.crs(), layer.id()
        before, self._crs_before = self._crs_before, self.crs
        if before is not None and before != self.crs:
            self._wizard.move_sensors(before, self.crs)
        elif self._box is not None and self._map == source:
            self._follow(self._box, layer.extent())
        self._map, self._box = source, layer.extent()
        box, system = layer.extent(), canvas.mapSettings().destinationCrs()
        corners = [moved(QgsPointXY(x, y), layer.crs(), system)
                   for x in (box.xMinimum(), box.xMaximum())
                   for y in (box.yMinimum(), box.yMaximum())]  # fmt: skip
        east, north = [each.x() for each in corners], [each.y() for each in corners]
        shown = QgsRectangle(min(east), min(north), max(east), max(north))
        shown.scale(1.1)
        canvas.setExtent(shown)
        canvas.refresh()

    def _follow(self, before: QgsRectangle, after: QgsRectangle) -> None:
        """Move the radars with a map whose origin was changed, which shows by its equal size."""
        east_m, north_m = after.xMinimum() - before.xMinimum(), after.yMinimum() - before.yMinimum()
        ends = after.xMaximum() - before.xMaximum(), after.yMaximum() - before.yMaximum()
        same = abs(ends[0] - east_m) < _SAME_M and abs(ends[1] - north_m) < _SAME_M
        if same and math.hypot(east_m, north_m) > _SAME_M:
            self._wizard.shift_sensors(east_m, north_m)

    def remove(self) -> None:
        """Take the lanes out of the project."""
        if self._layer_id and QgsProject.instance().mapLayer(self._layer_id) is not None:
            QgsProject.instance().removeMapLayer(self._layer_id)
        self._layer_id = ""
