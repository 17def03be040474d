"""Radars on the map while a site is filled in: click where one stands, drag to where it looks."""

from __future__ import annotations

import math
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsCsException,
    QgsPointXY,
    QgsProject,
)
from qgis.gui import QgsMapCanvasItem, QgsMapTool
from qgis.PyQt.QtCore import QPointF, QRectF, Qt, pyqtSignal
from qgis.PyQt.QtGui import QBrush, QColor, QFont, QPainter, QPainterPath, QPen, QPolygonF

from .draft import SensorDraft

DRAGGED_PX = 12.0  # a shorter drag is a click: no direction
USUAL_VIEW = (120.0, 60.0)  # azimuth and the range that is drawn where none is known
_ARC = 24  # corners of a view's arc
_BLUE = QColor("#1d4ed8")


def moved(
    point: QgsPointXY, source: QgsCoordinateReferenceSystem, target: QgsCoordinateReferenceSystem
) -> QgsPointXY:
    """Return a point in another coordinate system; NaN where it cannot be transformed."""
    try:
        return QgsCoordinateTransform(source, target, QgsProject.instance()).transform(point)
    except QgsCsException:
        return QgsPointXY(math.nan, math.nan)


def heading_of(start: QgsPointXY, end: QgsPointXY) -> float:
    """Return the yaw from one point to another: degrees from grid east, anticlockwise."""
    return math.degrees(math.atan2(end.y() - start.y(), end.x() - start.x()))


class SensorItem(QgsMapCanvasItem):  # type: ignore[misc]
    """A radar drawn over the map: where it stands, its name, and where it looks.

    Parameters
    ----------
    canvas : QgsMapCanvas
        The map.
    crs : QgsCoordinateReferenceSystem
        Of the sensor's position.
    """

    def __init__(self, canvas: Any, crs: QgsCoordinateReferenceSystem) -> None:
        super().__init__(canvas)
        self._canvas = canvas
        self._crs = crs
        self._sensor: SensorDraft | None = None
        self._chosen = False
        self.setZValue(200)

    def show_sensor(self, sensor: SensorDraft, *, chosen: bool) -> None:
        """Draw a sensor, the chosen one in full colour."""
        self._sensor, self._chosen = sensor, chosen
        self.updatePosition()

    def updatePosition(self) -> None:  # noqa: N802
        """Follow the map as it is moved and zoomed; QGIS calls it."""
        self.prepareGeometryChange()
        self.setPos(0.0, 0.0)
        self.update()

    def boundingRect(self) -> QRectF:  # noqa: N802
        """Return what may be drawn on: the whole map."""
        return QRectF(0.0, 0.0, self._canvas.width(), self._canvas.height())

    def paint(self, painter: QPainter, _option: Any = None, _widget: Any = None) -> None:
        """Draw the view, the place and the name."""
        sensor = self._sensor
        if sensor is None or math.isnan(sensor.easting + sensor.northing):
            return
        here = self._on_canvas(0.0, 0.0)
        if math.isnan(here.x()):
            return
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        colour = QColor(_BLUE)
        colour.setAlpha(70 if self._chosen else 35)
        painter.setPen(QPen(_BLUE, 1.5 if self._chosen else 1.0))
        if sensor.heading is not None:
            painter.setBrush(QBrush(colour))
            painter.drawPolygon(self._wedge(sensor, here))
        painter.setBrush(QBrush(_BLUE if self._chosen else QColor("#60a5fa")))
        painter.setPen(QPen(QColor("white"), 2.0))
        painter.drawEllipse(here, 7.0, 7.0)
        self._write(painter, sensor.name, here + QPointF(10.0, -8.0))

    def _wedge(self, sensor: SensorDraft, here: QPointF) -> QPolygonF:
        """Return the view as corners on the canvas."""
        azimuth = sensor.seen.get("azimuth_deg", USUAL_VIEW[0])
        reach = sensor.seen.get("max_range_m", USUAL_VIEW[1])
        corners = [] if azimuth >= 360.0 else [here]
        for step in range(_ARC + 1):
            angle = math.radians((sensor.heading or 0.0) + azimuth * (step / _ARC - 0.5))
            corners.append(self._on_canvas(reach * math.cos(angle), reach * math.sin(angle)))
        return QPolygonF(corners)

    def _on_canvas(self, east: float, north: float) -> QPointF:
        """Return where so many metres from the sensor are on the canvas."""
        sensor = self._sensor
        assert sensor is not None  # noqa: S101 - nothing is drawn without  # nosec B101
        point = QgsPointXY(sensor.easting + east, sensor.northing + north)
        return QPointF(
            self.toCanvasCoordinates(
                moved(point, self._crs, self._canvas.mapSettings().destinationCrs())
            )
        )

    @staticmethod
    def _write(painter: QPainter, text: str, place: QPointF) -> None:
        """Write a name with a white edge, so that it is read over any map."""
        path = QPainterPath()
        path.addText(place, QFont("Open Sans", 11, QFont.Weight.Bold), text)
        painter.setBrush(Qt.BrushStyle.NoBrush)
        painter.setPen(QPen(QColor("white"), 4.0))
        painter.drawPath(path)
        painter.fillPath(path, QBrush(QColor("#111827")))


class PlaceTool(QgsMapTool):  # type: ignore[misc]
    """A tool of the map: a click is where a radar stands, a drag also where it looks.

    Parameters
    ----------
    canvas : QgsMapCanvas
        The map.
    crs : QgsCoordinateReferenceSystem
        Of the positions that it gives.
    """

    moved_to = pyqtSignal(float, float, object)  # easting, northing, heading or None: on the way
    placed = pyqtSignal(float, float, object)
    left = pyqtSignal()  # with nothing placed

    def __init__(self, canvas: Any, crs: QgsCoordinateReferenceSystem) -> None:
        super().__init__(canvas)
        self._crs = crs
        self._start: Any = None
        self.setCursor(Qt.CursorShape.CrossCursor)

    def canvasPressEvent(self, event: Any) -> None:  # noqa: N802
        """Begin at the place; QGIS calls it."""
        if event.button() == Qt.MouseButton.LeftButton:
            self._start = event.pos()

    def canvasMoveEvent(self, event: Any) -> None:  # noqa: N802
        """Show where it would look; QGIS calls it."""
        if self._start is not None:
            self.moved_to.emit(*self._place(event.pos()))

    def canvasReleaseEvent(self, event: Any) -> None:  # noqa: N802
        """End: place it, or leave by the right button; QGIS calls it."""
        if self._start is None:
            self.left.emit()
            return
        place = self._place(event.pos())
        self._start = None
        if not math.isnan(place[0] + place[1]):
            self.placed.emit(*place)

    def keyPressEvent(self, event: Any) -> None:  # noqa: N802
        """Leave by Escape; QGIS calls it."""
        if event.key() == Qt.Key.Key_Escape:
            self._start = None
            self.left.emit()

    def _place(self, end: Any) -> tuple[float, float, float | None]:
        """Return where a drag began, and where it leads, in the sensors' system."""
        canvas = self.canvas().mapSettings().destinationCrs()
        first, last = (
            moved(self.toMapCoordinates(each), canvas, self._crs) for each in (self._start, end)
        )
        way = end - self._start
        is_dragged = math.hypot(way.x(), way.y()) >= DRAGGED_PX
        return first.x(), first.y(), heading_of(first, last) if is_dragged else None
